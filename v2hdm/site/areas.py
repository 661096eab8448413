"""Areas of the map, such as words and hatched boxes: rectangles about what most of their images show.

Each image of an area shows the hull of its paint. How far the hulls reach in the direction of each side of
the rectangle gives that side's place: in images that the border does not cut there, so that it never shrinks
one, and with little weight where something hides a part.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.site.candidates import CORRELATION

_EDGE_SIGMA_M = 0.01
"""Standard deviation, m, of a side's error that all images share: letters end at different heights, and the
network rounds them."""
_STRAY = 0.2  # share of hulls that end elsewhere: things hide paint, other paint is taken for it
_FARTHER = 0.75  # place, in order, of the reach that the search for a side begins with
_SCALE_WEIGHT = 1.0  # images that the stated scatter of reaches is worth
_PARTLY = 3.0  # how much less sure a side is of which an image shows a part: letters differ in height
_STEPS = 20  # steps of the robust mean, which settles within ten
LEAST_IMAGES = 2  # images that must show a side: one may err
_LEAST_ANGLE_RAD = 0.003  # standard deviation of the direction that all images share, rad


class Rectangle(NamedTuple):
    """A rectangle about an area."""

    vertices: FloatArray  # (4, 2) m, counter-clockwise, each where a side meets the next
    covariance: FloatArray  # (8, 8), m^2
    seen: IntArray  # (4,) how many images show paint up to each side


def fit_rectangle(
    outline_map: FloatArray,
    outlines_map: Sequence[FloatArray],
    seen_sides: Sequence[BoolArray],
    image: IntArray,
    shown: Callable[[FloatArray], BoolArray],
    sigma_m: Callable[[FloatArray], FloatArray],
) -> Rectangle:
    """The rectangle of an area whose images have ``outline_map`` (N, 2) in common.

    ``outlines_map`` (K, 2) are hulls on the ground, each of an ``image`` (S,) of I; ``seen_sides`` (K,) those
    sides that nothing cuts. ``shown`` tells which points (M, 2) lie inside the images (I, M), ``sigma_m`` how
    uncertain a point (M, 2) of an outline is in each (I, M).
    """
    normals, pivot = _directions(outline_map)
    turned_rad, angle_sigma = _turn(outlines_map, seen_sides, normals)
    c, s = np.cos(turned_rad), np.sin(turned_rad)
    normals = normals @ np.array([[c, s], [-s, c]])
    reach = (outline_map - pivot) @ normals.T
    side_m = reach.max(axis=0)
    is_shown = shown(_corners(normals, pivot, side_m))
    size_m = float(np.ptp(reach, axis=0).max())
    variance_m2 = np.zeros(4)
    seen = np.zeros(4, dtype=np.int64)
    for side, normal in enumerate(normals):
        whole = is_shown[:, side] & is_shown[:, side - 1]
        reached = np.full(len(is_shown), -np.inf)
        trusted = np.zeros(len(is_shown), dtype=np.bool_)
        for outline, is_seen, number in zip(outlines_map, seen_sides, image.tolist(), strict=True):
            along = (outline - pivot) @ normal
            farthest = int(along.argmax())
            if along[farthest] > reached[number]:
                reached[number] = along[farthest]
                trusted[number] = is_seen[farthest] or is_seen[farthest - 1]
        usable = np.flatnonzero(trusted & np.isfinite(reached))
        seen[side] = len(usable)
        middle = (pivot + side_m[side] * normal)[None]
        if len(usable):
            sigmas = sigma_m(middle)[:, 0] * np.where(whole, 1.0, _PARTLY)
            side_m[side], variance_m2[side] = _robust_mean(reached[usable], sigmas[usable], size_m)
        else:
            variance_m2[side] = float(np.ptp(reach[:, side]) ** 2)
    corners = _corners(normals, pivot, side_m)
    arms = corners - corners.mean(axis=0)
    jacobian = np.zeros((8, 5))
    for corner in range(4):
        rows = slice(2 * corner, 2 * corner + 2)
        jacobian[rows, corner] = normals[corner]
        jacobian[rows, (corner + 1) % 4] = normals[(corner + 1) % 4]
        jacobian[rows, 4] = [-arms[corner, 1], arms[corner, 0]]
    own = np.diag([*(variance_m2 + _EDGE_SIGMA_M**2), angle_sigma**2])
    return Rectangle(corners, jacobian @ own @ jacobian.T, seen)


def _directions(outline_map: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Outer normals (4, 2) of the smallest rectangle around an outline, and its middle (2,)."""
    middle = outline_map.mean(axis=0)
    box = cv2.boxPoints(cv2.minAreaRect((outline_map - middle).astype(np.float32))).astype(np.float64)
    sides = np.roll(box, -1, axis=0) - box
    longer = sides[np.linalg.norm(sides, axis=1).argmax()]
    ahead = longer / np.linalg.norm(longer)
    left = np.array([-ahead[1], ahead[0]])
    return np.array([-left, ahead, left, -ahead]), middle + box.mean(axis=0)


def _corners(normals: FloatArray, pivot: FloatArray, side_m: FloatArray) -> FloatArray:
    """The corners (4, 2), each where a side meets the next."""
    following = np.roll(np.arange(4), -1)
    return np.asarray(pivot + side_m[:, None] * normals + (side_m[:, None] * normals)[following])


def _turn(
    outlines_map: Sequence[FloatArray], seen_sides: Sequence[BoolArray], normals: FloatArray
) -> tuple[float, float]:
    """By how much, rad, whole hulls are turned from the normals on average, and its standard deviation."""
    whole = [outline for outline, is_seen in zip(outlines_map, seen_sides, strict=True) if is_seen.all()]
    angles = []
    for outline in whole:
        normal = _directions(outline)[0][1]
        across, along = normal @ np.array([-normals[1][1], normals[1][0]]), normal @ normals[1]
        turned = (np.arctan2(across, along) + np.pi / 4) % (np.pi / 2) - np.pi / 4
        if abs(turned) < np.pi / 12:
            angles.append(turned)
    if len(angles) < LEAST_IMAGES:
        return 0.0, 0.05
    spread = float(1.4826 * np.median(np.abs(angles - np.median(angles))))
    shared = (1 + CORRELATION * (len(angles) - 1)) / len(angles)
    return float(np.median(angles)), float(np.hypot(spread * np.sqrt(shared), _LEAST_ANGLE_RAD))


def _robust_mean(values: FloatArray, sigmas: FloatArray, size_m: float) -> tuple[float, float]:
    """Mean of reaches (N,) with sigmas (N,), some of which are anywhere within a size, and its variance.

    Expectation maximisation of that mixture. It starts among the farther reaches: what hides paint shortens
    them. Errors of neighbouring images are correlated: the variance falls less than that of independent ones.
    """
    mean = float(np.quantile(values, _FARTHER))
    scale = 1.0
    stray = np.log(_STRAY / max(size_m, 0.1))
    for _ in range(_STEPS):
        squared = ((values - mean) / sigmas) ** 2
        fits = np.log((1 - _STRAY) / (np.sqrt(2 * np.pi) * scale * sigmas)) - 0.5 * squared / scale**2
        inlier = 1.0 / (1.0 + np.exp(np.minimum(stray - fits, 50.0)))
        weight = inlier / sigmas**2
        mean = float(weight @ values / weight.sum())
        squared = ((values - mean) / sigmas) ** 2
        scale = float(np.sqrt((_SCALE_WEIGHT + inlier @ squared) / (_SCALE_WEIGHT + inlier.sum())))
    effective = weight.sum() ** 2 / (weight**2).sum()
    return mean, float(scale**2 / weight.sum() * (1 + CORRELATION * (effective - 1)))
