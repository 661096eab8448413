"""Areas of the map, such as words and hatched boxes: rectangles about what most of their images show.

Each image of an area shows the hull of its paint. A side of the rectangle lies where the hulls end in its
direction. Images whose border cuts a hull there do not count, so that they never shrink an area; images in
which something hides a part of it weigh little.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import smallest_rectangle, turned_left
from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.site.candidates import CORRELATION

_EDGE_SIGMA_M = 0.01
"""Standard deviation, m, of a side's error that all images share: letters end at different heights, and the
network rounds them."""
_STRAY = 0.2  # share of hulls that end elsewhere: things hide paint, other paint is taken for it
_FARTHER = 0.75  # quantile of the reaches at which the search for a side begins
_SCALE_WEIGHT = 1.0  # images that the stated scatter of reaches is worth
_PARTLY = 3.0  # factor of a side's sigma in an image that shows only part of it: letters differ in height
_STEPS = 20  # steps of the robust mean, which settles within ten
LEAST_IMAGES = 2  # images that must show a side: one may err
_LEAST_ANGLE_RAD = 0.003  # standard deviation of the direction that all images share, rad


class Rectangle(NamedTuple):
    """A rectangle about an area."""

    vertices: FloatArray  # (4, 2) m, counter-clockwise, each where a side meets the next
    covariance: FloatArray  # (8, 8), m^2
    images: IntArray  # (4,) how many images show paint up to each side


def fit_rectangle(
    outline_map: FloatArray,
    outlines_map: Sequence[FloatArray],
    seen_sides: Sequence[BoolArray],
    image: IntArray,
    shown: Callable[[FloatArray], BoolArray],
    sigma_m: Callable[[FloatArray], FloatArray],
) -> Rectangle:
    """The rectangle of an area whose images have ``outline_map`` (N, 2) in common.

    ``outlines_map`` are S hulls (K, 2) on the ground, each in an ``image`` (S,) of I; ``seen_sides`` (K,) are
    true where nothing cuts a hull. ``shown`` tells which points (M, 2) lie inside each image (I, M),
    ``sigma_m`` the standard deviation of an outline's points (M, 2) in each image (I, M).
    """
    normals, pivot = _directions(outline_map)
    turned_rad, angle_sigma = _turn(outlines_map, seen_sides, normals)
    normals = np.cos(turned_rad) * normals + np.sin(turned_rad) * turned_left(normals)
    reach = (outline_map - pivot) @ normals.T
    side_m = reach.max(axis=0)
    is_shown = shown(_corners(normals, pivot, side_m))
    size_m = float(np.ptp(reach, axis=0).max())
    variance_m2 = np.zeros(4)
    images = np.zeros(4, dtype=np.int64)
    for side, normal in enumerate(normals):
        whole = is_shown[:, side] & is_shown[:, side - 1]
        along = [(outline - pivot) @ normal for outline in outlines_map]
        reached = _reaches(along, seen_sides, image, len(is_shown))
        usable = np.flatnonzero(np.isfinite(reached))
        images[side] = len(usable)
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
    side_covariance = np.diag([*(variance_m2 + _EDGE_SIGMA_M**2), angle_sigma**2])
    return Rectangle(corners, jacobian @ side_covariance @ jacobian.T, images)


def _reaches(
    along: Sequence[FloatArray], seen_sides: Sequence[BoolArray], image: IntArray, count: int
) -> FloatArray:
    """The farthest reach (I,) of the hulls in each image, by ``along`` (K,); -inf where it is none or cut."""
    reached = np.full(count, -np.inf)
    is_cut = np.zeros(count, dtype=np.bool_)
    for reach, is_seen, number in zip(along, seen_sides, image.tolist(), strict=True):
        farthest = int(reach.argmax())
        if reach[farthest] > reached[number]:
            reached[number] = reach[farthest]
            is_cut[number] = not (is_seen[farthest] or is_seen[farthest - 1])
    return np.where(is_cut, -np.inf, reached)


def _directions(outline_map: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Outer normals (4, 2) of the smallest rectangle around an outline, and its middle (2,)."""
    box = smallest_rectangle(outline_map)
    sides = np.roll(box, -1, axis=0) - box
    longer = sides[np.linalg.norm(sides, axis=1).argmax()]
    ahead = longer / np.linalg.norm(longer)
    left = turned_left(ahead)
    return np.array([-left, ahead, left, -ahead]), box.mean(axis=0)


def _corners(normals: FloatArray, pivot: FloatArray, side_m: FloatArray) -> FloatArray:
    """The corners (4, 2), each where a side meets the next."""
    following = np.roll(np.arange(4), -1)
    return np.asarray(pivot + side_m[:, None] * normals + (side_m[:, None] * normals)[following])


def _turn(
    outlines_map: Sequence[FloatArray], seen_sides: Sequence[BoolArray], normals: FloatArray
) -> tuple[float, float]:
    """The median angle, rad, by which whole hulls are turned from the normals, and its standard deviation."""
    whole = [outline for outline, is_seen in zip(outlines_map, seen_sides, strict=True) if is_seen.all()]
    angles = []
    for outline in whole:
        normal = _directions(outline)[0][1]
        across = normal @ turned_left(normals[1])
        along = normal @ normals[1]
        turned = (np.arctan2(across, along) + np.pi / 4) % (np.pi / 2) - np.pi / 4
        if abs(turned) < np.pi / 12:
            angles.append(turned)
    if len(angles) < LEAST_IMAGES:
        return 0.0, 0.05
    spread = float(1.4826 * np.median(np.abs(angles - np.median(angles))))
    shared = (1 + CORRELATION * (len(angles) - 1)) / len(angles)
    return float(np.median(angles)), float(np.hypot(spread * np.sqrt(shared), _LEAST_ANGLE_RAD))


def _robust_mean(values: FloatArray, sigmas: FloatArray, size_m: float) -> tuple[float, float]:
    """Mean of reaches (N,) with sigmas (N,), and its variance; strays may be anywhere within ``size_m``.

    Expectation maximisation of that mixture. It starts among the farther reaches, for things before the paint
    shorten them. Errors of neighbouring images are correlated, so the variance falls less with their number.
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
