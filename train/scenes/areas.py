"""Paint that covers ground: boxes to be kept clear, hatched areas, whole crosswalks, rows of bays."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from train.scenes.paint import rectangle
from train.scenes.signs import bar
from v2hdm.geometry.planar import clip_convex
from v2hdm.records import CROSSWALK_BAR, STOP_LINE, FloatArray

_SIZES_M = (
    ((3.0, 3.0), (11.0, 9.0)), ((4.0, 1.0), (6.0, 2.0)), ((1.5, 1.5), (7.0, 6.0)),
    ((5.0, 1.5), (16.0, 4.0)), ((0.8, 0.8), (6.0, 5.0)), ((1.5, 1.5), (3.0, 3.0)),
)  # fmt: skip
"""Least and largest length and width by kind: boxes of junctions, aisles, areas, islands, crosses, yards."""

_MOST_LINES = 60  # number of lines across an area, more would be a tone


def hatched_area(rng: np.random.Generator) -> tuple[list[FloatArray], FloatArray]:
    """Convex parts of a framed area with lines across it, and its outline (N, 2), about the origin.

    It is a yellow box of a junction, an aisle beside a bay, a no-parking area, an island that tapers, a
    rectangle with a cross, or a small box of a yard.
    """
    kind = int(rng.choice(6, p=[0.3, 0.13, 0.17, 0.13, 0.12, 0.15]))
    low, high = _SIZES_M[kind]
    long_m, wide_m = (float(m) for m in rng.uniform(low, high))
    outline = rectangle(np.zeros(2), long_m, wide_m)
    if kind == 3:
        begin, end = rng.uniform([0.0, 0.5], [0.4, 1.0]) * (1 if rng.random() < 0.5 else -1) % 1.0
        outline = outline * np.array([[1, begin + 0.01], [1, end + 0.01], [1, end + 0.01], [1, begin + 0.01]])
    thick_m = float(rng.uniform(0.08, 0.24))
    parts = [] if kind == 4 and rng.random() < 0.3 else list(frame(outline, thick_m))
    if kind == 4:
        return [*parts, bar(outline[0], outline[2], thick_m), bar(outline[1], outline[3], thick_m)], outline
    lean = float(rng.uniform(0.45, 1.1) * rng.choice([-1, 1]))
    crossed = rng.random() < {0: 0.85, 5: 0.5}.get(kind, 0.2)
    pitch_m = float(rng.uniform(0.9, 2.4) if kind == 0 else rng.uniform(0.35, 1.3))
    line_m = thick_m * float(rng.uniform(0.7, 1.1))
    for yaw in (lean, -lean)[: 1 + crossed]:
        parts += _hatching(outline, pitch_m, line_m, yaw)
    return parts, outline


def frame(outline: FloatArray, thick_m: float) -> Iterator[FloatArray]:
    """Bars (4, 2) along the sides of an outline (N, 2), their ends beyond its corners."""
    for start, end in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        ahead = (end - start) * (thick_m / 2 / max(float(np.linalg.norm(end - start)), 1e-6))
        yield bar(start - ahead, end + ahead, thick_m)


def _hatching(outline: FloatArray, pitch_m: float, thick_m: float, yaw_rad: float) -> list[FloatArray]:
    """Parallel lines, in a direction, within a convex outline (N, 2)."""
    across = np.array([-np.sin(yaw_rad), np.cos(yaw_rad)])
    places = outline @ across
    reach_m = 2 * float(np.linalg.norm(np.ptp(outline, axis=0)))
    out = []
    for at in np.arange(places.min() + pitch_m / 2, places.max(), pitch_m)[:_MOST_LINES]:
        line = clip_convex(rectangle(at * across, reach_m, thick_m, yaw_rad), outline)
        out += [line] if len(line) > 2 else []
    return out


def whole_crosswalk(rng: np.random.Generator, extent_m: float) -> list[tuple[str, FloatArray]]:
    """Kinds and shapes of a crosswalk across the way, from 0 to ``extent_m`` to the left.

    It has bars, bars between two lines, or two lines alone, which look like stop lines and are called so.
    """
    long_m = float(rng.uniform(2.0, 6.0))
    bar_m = float(rng.uniform(0.3, 0.65))
    pitch_m = bar_m * float(rng.uniform(1.6, 2.8))
    line_m = float(rng.uniform(0.12, 0.35))
    style = int(rng.choice(3, p=[0.5, 0.25, 0.25]))
    lean = float(rng.normal(0, 0.12)) if rng.random() < 0.3 else 0.0
    shapes: list[tuple[str, FloatArray]] = []
    if style != 2:
        shapes += [
            (CROSSWALK_BAR, rectangle(np.array([0.0, left]), long_m, bar_m))
            for left in np.arange(bar_m / 2, extent_m, pitch_m)
        ]
    if style != 0:
        kind = CROSSWALK_BAR if style == 1 else STOP_LINE
        gap_m = float(rng.choice([0.0, rng.uniform(0.1, 0.5)])) if style == 1 else 0.0
        shapes += [
            (kind, rectangle(np.array([side * (long_m / 2 + gap_m), extent_m / 2]), line_m, extent_m))
            for side in (-1, 1)
        ]
    askew = np.array([[1.0, 0.0], [lean, 1.0]])
    return [(kind, shape @ askew) for kind, shape in shapes]


def give_way(rng: np.random.Generator, extent_m: float) -> Iterator[FloatArray]:
    """A give-way line from 0 to ``extent_m`` to the left: rows of short broad dashes, or shark's teeth."""
    if rng.random() < 0.4:
        size = rng.uniform(0.4, 0.75)
        long = size * rng.uniform(1.0, 1.6)
        ahead = rng.choice([-1, 1])
        for left in np.arange(size / 2, extent_m, size * rng.uniform(1.15, 2.0)):
            tooth = np.array([[0.0, -size / 2], [long, 0.0], [0.0, size / 2]]) * (ahead, 1)
            yield tooth[::ahead] + np.array([0.0, left])
        return
    thick = rng.uniform(0.15, 0.5)
    dash = rng.uniform(0.3, 0.8)
    gap = dash * rng.uniform(0.35, 1.1)
    for row in range(1 + (rng.random() < 0.4)):
        for left in np.arange(dash / 2, extent_m, dash + gap):
            yield rectangle(np.array([2.0 * row * thick, left]), thick, dash)
