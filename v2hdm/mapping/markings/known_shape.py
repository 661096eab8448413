"""Markings too worn or too hidden to be solved corner by corner, placed by the shape of their class.

The diamonds of a yard are painted with one stencil. Where most of a class has one shape, a marking of it of
which a few corners were seen, some only once, is that shape moved and turned to fit them. Whether what
results is a marking is then judged like any other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.mapping.association.groups import FusedGroups
from v2hdm.mapping.markings.completion import SolvedCorners
from v2hdm.mapping.markings.shape_prior import SHAPE_SIGMA_M, class_shapes, miss_limit_m, rigid_onto
from v2hdm.records import FloatArray, IntArray

_LEAST_SEEN = 6
_LEAST_SEEN_OF_TWO = 8
"""Sightings of the corners that a shape is laid on, all together: one image may err, and two corners can be
those of anything, such as the head of an arrow, so that more images must agree on what it is."""

_MAX_VAGUE_SHARE = 0.35
"""How far corners that may not be used as points may be off, as a share of the longer diagonal."""


@dataclass(frozen=True)
class _Fit:
    """A shape laid on corners: ``corners_map`` (4, 2), ``covariance`` (8, 8), and its largest ``miss_m``."""

    corners_map: FloatArray
    covariance: FloatArray
    miss_m: float


def with_known_shapes(
    solved: SolvedCorners,
    fused: FusedGroups,
    vague_map: FloatArray,
    doubtful: IntArray,
    kind: IntArray,
    accepted: IntArray,
) -> SolvedCorners:
    """Place the groups ``doubtful`` by the shape of their class where their corners fit it.

    Args:
        solved: The corners so far.
        fused: Where every corner was seen, be it once.
        vague_map: (G, 4, 2) about where every corner is, be it one that may not be used as a point.
        doubtful: (D,) groups that lack corners or are of an odd shape.
        kind: (G,) class of every group.
        accepted: (A,) groups that were accepted.

    Returns:
        The corners, with those groups placed of which three or two corners fit.
    """
    corners, covariance = solved.corners_map.copy(), solved.covariance_m2.copy()
    completed = solved.completed.copy()
    shapes = class_shapes(solved, kind, accepted)
    for group in doubtful:
        shape = shapes.get(int(kind[group]))
        if shape is None:
            continue
        sigma_m = np.sqrt(np.trace(fused.covariance_m2[group], axis1=1, axis2=2) / 2)
        fit = fit_shape(shape.corners, fused.corners_map[group], sigma_m, fused.seen[group], vague_map[group])
        if fit is not None:
            corners[group], covariance[group] = fit.corners_map, fit.covariance
            completed[group] = True
    return SolvedCorners(corners, covariance, completed)


def fit_shape(
    shape: FloatArray, seen_map: FloatArray, sigma_m: FloatArray, times: IntArray, vague_map: FloatArray
) -> _Fit | None:
    """Lay a shape (4, 2) on corners (4, 2), nan if unseen, known to ``sigma_m`` (4,), seen ``times`` (4,).

    Of four corners that were seen one may be wrong. ``vague_map`` (4, 2), about where the corners are, tells
    one turn of the shape from another. None where no turn fits, or where two that are not the same do.
    """
    seen = np.flatnonzero(np.isfinite(seen_map).all(axis=1))
    longest_m = float(_diagonals(shape).max())
    limit_m = miss_limit_m(longest_m)
    for used in _subsets(seen):
        if times[used].sum() < (_LEAST_SEEN if len(used) > 2 else _LEAST_SEEN_OF_TWO):
            continue
        fits = [
            fit
            for shift in range(4)
            if (fit := _rigid(np.roll(shape, -shift, axis=0), seen_map, sigma_m, used)).miss_m <= limit_m
        ]
        if len(used) == 2:
            fits = [fit for fit in fits if _is_near(fit, vague_map, _MAX_VAGUE_SHARE * longest_m)]
        if not fits:
            continue
        best = min(fits, key=lambda fit: fit.miss_m)
        if all(_same(best, fit, limit_m) for fit in fits):
            return best
    return None


def _subsets(seen: IntArray) -> list[IntArray]:
    """Which corners to fit to, most trusted first: all of them, or three of four."""
    if len(seen) == 4:
        return [seen, *(np.delete(seen, left_out) for left_out in range(4))]
    return [seen] if len(seen) >= 2 else []


def _rigid(shape: FloatArray, seen_map: FloatArray, sigma_m: FloatArray, used: IntArray) -> _Fit:
    """Move and turn a shape onto the corners ``used``, by weighted least squares."""
    weight = 1 / (sigma_m[used] ** 2 + SHAPE_SIGMA_M**2)
    rotation, shift = rigid_onto(shape[used], seen_map[used], weight)
    corners = shape @ rotation.T + shift
    arms = corners - weight @ corners[used] / weight.sum()
    jacobian = np.zeros((4, 2, 3))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
    jacobian[:, :, 2] = np.stack([-arms[:, 1], arms[:, 0]], axis=1)
    information = np.einsum("c,cij,cik->jk", weight, jacobian[used], jacobian[used])
    flat = jacobian.reshape(8, 3)
    covariance = flat @ np.linalg.inv(information) @ flat.T + SHAPE_SIGMA_M**2 * np.eye(8)
    miss_m = float(np.linalg.norm(corners[used] - seen_map[used], axis=1).max())
    return _Fit(corners, covariance, miss_m)


def _is_near(fit: _Fit, vague_map: FloatArray, limit_m: float) -> bool:
    """Whether every corner of a fit is about where it was seen; corners that nobody saw speak against it."""
    apart = np.linalg.norm(fit.corners_map - vague_map, axis=1)
    return bool(np.isfinite(apart).all() and apart.max() <= limit_m)


def _same(first: _Fit, second: _Fit, limit_m: float) -> bool:
    """Whether two fits cover the same ground, whichever corner each calls the first."""
    apart = np.linalg.norm(first.corners_map[:, None] - second.corners_map, axis=2)
    return bool(apart.min(axis=1).max() <= limit_m)


def _diagonals(shape: FloatArray) -> FloatArray:
    """Lengths (2,) of the diagonals."""
    return np.asarray(np.linalg.norm(shape[2:] - shape[:2], axis=1))
