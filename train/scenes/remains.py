"""Draws on the ground what looks like a marking and is none: litter, leaves, markings that were removed."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from train.scenes.clutter import plain_marks
from train.scenes.paint import arrow, crosswalk, rectangle, rhombus, stop_line
from v2hdm.records import FloatArray
from v2hdm.simulate.render.scene import Box, GroundMarks, placed

_SHIFT = 4  # bits of fraction of the coordinates that OpenCV is given
_MARGIN_PX = 3  # elements around an erased marking that are redrawn


def with_erased(rng: np.random.Generator, marks: GroundMarks | None, mean: float) -> GroundMarks | None:
    """The marks of a ground and the ghosts of ``mean`` markings, ground off, burnt off or painted over.

    What was removed is no marking any more, whatever still shows of it.
    """
    count = int(rng.poisson(mean))
    if not count:
        return marks
    marks = plain_marks() if marks is None else marks
    factor = marks.factor.copy()
    for _ in range(count):
        at = np.exp(rng.uniform(np.log(3), np.log(25))), rng.normal(0, 2.5)
        yaw = float(rng.normal(0, 0.1) if rng.random() < 0.8 else rng.uniform(-np.pi, np.pi))
        _ghost(rng, factor, [_on_raster(placed(shape, at, yaw), marks) for shape in _former(rng)])
    return GroundMarks(factor=factor, origin_map=marks.origin_map, resolution_m=marks.resolution_m)


def _former(rng: np.random.Generator) -> list[FloatArray]:
    """The shapes (N, 2) of what had been there."""
    kind = rng.integers(5)
    if kind == 0:
        return list(arrow(rng, 3.2))
    if kind == 1:
        return [
            rectangle(np.array([k * 9.0, 0.0]), rng.uniform(2, 6), rng.uniform(0.12, 0.3)) for k in range(3)
        ]
    if kind == 2:
        return [rectangle(np.zeros(2), 30.0, rng.uniform(0.12, 0.3))]
    if kind == 3:
        return list(stop_line(rng, 3.3) if rng.random() < 0.6 else crosswalk(rng, 5.0))
    return [rhombus(np.zeros(2), rng.uniform(0.6, 2.5), rng.uniform(0.4, 1.2))]


def _on_raster(shape_map: FloatArray, marks: GroundMarks) -> FloatArray:
    return np.asarray((shape_map - marks.origin_map) / marks.resolution_m)


def _ghost(rng: np.random.Generator, factor: NDArray[np.uint8], shapes_px: list[FloatArray]) -> None:
    """Multiply removed shapes (N, 2) into the ground: black paint, a ground surface, scraps that stayed."""
    points = np.vstack(shapes_px)
    low = np.clip(np.floor(points.min(axis=0)).astype(int) - _MARGIN_PX, 0, factor.shape[::-1])
    high = np.clip(np.ceil(points.max(axis=0)).astype(int) + _MARGIN_PX, 0, factor.shape[::-1])
    if (high - low < 1).any():
        return
    part = factor[low[1] : high[1], low[0] : high[0]]
    mask = np.zeros(part.shape, dtype=np.uint8)
    for shape in shapes_px:
        cv2.fillPoly(
            mask, [np.round((shape - low) * (1 << _SHIFT)).astype(np.int32)], 255, cv2.LINE_AA, _SHIFT
        )
    grown = int(rng.integers(1, 7))
    if rng.random() < 0.5:
        mask = cv2.dilate(mask, np.ones((grown, grown), np.uint8)).astype(np.uint8)
    inside = cv2.GaussianBlur(mask, (0, 0), float(rng.uniform(0.5, 2.0))).astype(np.float32) / 255
    rough = rng.standard_normal(part.shape).astype(np.float32)
    tone = np.exp(rng.uniform(-0.7, -0.1) if rng.random() < 0.6 else rng.uniform(0.05, 0.28))
    if rng.random() < 0.5:
        rough = np.asarray(cv2.GaussianBlur(rough, (0, 0), 3.0, sigmaY=0.7), dtype=np.float32)
        tone = tone * np.exp(rng.uniform(0.05, 0.2) * rough / rough.std())
    if rng.random() < 0.4:
        scraps = cv2.GaussianBlur(rough, (0, 0), float(rng.uniform(0.8, 2.0)))
        tone = np.where(scraps > rng.uniform(1.3, 2.5) * scraps.std(), rng.uniform(1.4, 2.0), tone)
    part[:] = np.clip(part * (1 + inside * (tone - 1)), 0, 255).astype(np.uint8)


def litter(rng: np.random.Generator, mean: float) -> tuple[Box, ...]:
    """Sheets, cardboard, bags, cans and boards on the ground, ``mean`` on average; half of them white."""
    out = []
    for _ in range(int(rng.poisson(mean))):
        x = float(np.exp(rng.uniform(np.log(2.5), np.log(22))))
        y = float(rng.normal(0, 3))
        kind = rng.choice(4, p=[0.5, 0.2, 0.2, 0.1])
        low, high = (
            ((0.15, 0.1, 0.002), (0.7, 0.6, 0.03)),
            ((0.2, 0.15, 0.08), (0.5, 0.45, 0.3)),
            ((0.06, 0.06, 0.05), (0.3, 0.1, 0.12)),
            ((0.8, 0.08, 0.02), (2.5, 0.25, 0.06)),
        )[int(kind)]
        length, wide, tall = (float(m) for m in rng.uniform(low, high))
        grey = rng.uniform(0.5, 0.85) if rng.random() < 0.55 else rng.uniform(0.03, 0.5)
        spread = 0.05 if grey > 0.5 else 0.4
        blue, green, red = (float(c) for c in np.clip(grey * np.exp(rng.normal(0, spread, 3)), 0.02, 0.85))
        yaw = float(rng.uniform(0, np.pi))
        out.append(
            Box(
                centre_map=(x, y),
                size_m=(length, wide, tall),
                yaw_rad=yaw,
                albedo_bgr=(blue, green, red),
                seed=int(rng.integers(1 << 20)),
            )
        )
    return tuple(out)
