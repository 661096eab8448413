"""Are decisions on paint against a design right? A design is moved by known amounts, and the map stays.

``python -m tests.benchmarks.as_built RESULT DESIGN [--seeds 5]`` takes the result of a rendered port and its
true map as the design. In each seed two fifths of the shapes are moved by up to 10 cm, a tenth is turned by
up to 5 degrees, three in a hundred are taken out of the design (extra paint), twelve are added where none is
painted; and the whole lies in place, is shifted by half a metre, or by 9 m and .3 degrees. It prints, a line
each, how many decisions are right and wrong, how many shapes are unsure, what of the added ones is missing,
and whether the motion of the whole is named.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v2hdm.asbuilt.comparison import Comparison, compare_with_design
from v2hdm.asbuilt.decisions import Fate, Tolerances, axes_of, sizes_of
from v2hdm.asbuilt.design import Design, DesignShape, outline_of
from v2hdm.asbuilt.ground import read_mosaic
from v2hdm.asbuilt.reading import read_design
from v2hdm.geometry.planar import turned_left
from v2hdm.library import read_map
from v2hdm.records import FloatArray

MOTIONS = ((0.0, 0.0, 0.0), (0.4, -0.3, 0.0), (3.2, 8.0, 0.3))
"""Motions of the whole design: east, m, north, m, and turned, deg."""

MOVED_M = 0.1  # largest move of a shape, m
TURNED_DEG = 5.0  # largest turn of a shape, deg
ADDED = 12  # shapes that are not painted
ASIDE_M = 1.7  # distance, m, at which they lie north of others


class Case(NamedTuple):
    """A design, which of its shapes conform by name, and how many shapes were taken out."""

    design: Design
    conforms: Mapping[str, bool]
    taken: int


def turned(points: FloatArray, turn_deg: float) -> FloatArray:
    """Points (N, 2) turned about the origin."""
    angle = np.deg2rad(turn_deg)
    return points @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def case_of(shapes: Sequence[DesignShape], tolerance: Tolerances, seed: int, motion: Sequence[float]) -> Case:
    """Shapes moved by known amounts, and the whole by a ``motion``."""
    rng = np.random.default_rng(seed)
    *_, turn_deg = motion
    shift = np.array(motion[:2])
    out = []
    conforms = {}
    count = 0
    for shape in shapes:
        if rng.random() < 0.03:
            count = count + 1
            continue
        offset = np.zeros(2)
        turn = 0.0
        chance = rng.random()
        if chance < 0.4:
            direction = rng.uniform(0, 2 * np.pi)
            offset = rng.uniform(0, MOVED_M) * np.array([np.cos(direction), np.sin(direction)])
        elif chance < 0.5:
            turn = rng.uniform(-TURNED_DEG, TURNED_DEG)
        middle = shape.outline_map.mean(axis=0)
        outline = turned(shape.outline_map - middle, turn) + middle + offset
        conforms[shape.name] = within(outline, -offset, turn, tolerance)
        out.append(replace(shape, outline_map=turned(outline, turn_deg) + shift))
    for number in range(ADDED):
        pattern = shapes[rng.integers(len(shapes))]
        outline = turned(pattern.outline_map + np.array([0, ASIDE_M]), turn_deg) + shift
        out.append(DesignShape(f"added {number}", pattern.kind, outline))
    return Case(Design(tuple(out)), conforms, count)


def within(outline: FloatArray, off_m: FloatArray, turn_deg: float, tolerance: Tolerances) -> bool:
    """Whether paint that lies ``off_m`` (2,) from a shape, and turned, conforms to it."""
    corners = outline_of(outline).corners_map
    sizes = sizes_of(corners, axes_of(corners))
    along_m = abs(float(off_m @ sizes.ahead))
    across_m = abs(float(off_m @ turned_left(sizes.ahead)))
    aside_m = np.tan(np.deg2rad(abs(turn_deg))) * sizes.length_m / 2
    return bool(max(along_m, across_m, aside_m) <= tolerance.place_m)


def line_of(case: Case, comparison: Comparison) -> str:
    """The line on a case."""
    judged = [finding for finding in comparison.findings if finding.name in case.conforms]
    decided = [finding for finding in judged if finding.fate in (Fate.RIGHT, Fate.OFF)]
    right = sum((finding.fate is Fate.RIGHT) == case.conforms[finding.name] for finding in decided)
    unsure = sum(finding.fate is Fate.UNSURE for finding in judged)
    added = [finding for finding in comparison.findings if finding.name.startswith("added")]
    missing = sum(finding.fate is Fate.MISSING for finding in added)
    false_missing = comparison.count(Fate.MISSING) - missing
    misfit = comparison.misfit
    extra = f"{comparison.count(Fate.EXTRA)} extra of {case.taken}"
    whole = f"lies off: {misfit.is_significant}" if misfit is not None else "not told"
    return (
        f"{right} right, {len(decided) - right} wrong, {unsure} unsure; of {len(added)} not painted "
        f"{missing} missing, {false_missing} others; {extra}; {whole}"
    )


def main() -> None:
    """Run all cases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("result", type=Path)
    parser.add_argument("design", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parsed = parser.parse_args()
    hd_map = read_map(parsed.result)
    shapes = read_design(parsed.design, hd_map).shapes
    mosaic = read_mosaic(parsed.result)
    tolerance = Tolerances()
    for motion in MOTIONS:
        for seed in range(parsed.seeds):
            case = case_of(shapes, tolerance, seed, motion)
            start = time.process_time()
            comparison = compare_with_design(hd_map, case.design, tolerance, mosaic)
            spent_s = time.process_time() - start
            print(f"{motion} seed {seed}: {line_of(case, comparison)}; {spent_s:.1f} s", flush=True)


if __name__ == "__main__":
    main()
