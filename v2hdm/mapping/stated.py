"""Sizes that a user states for classes and corners that a survey has measured, as constraints on corners."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from v2hdm.adjust import ControlPoints, KnownLengths, PoseSigma
from v2hdm.io.maps.surveyed import match
from v2hdm.mapping.options import SizeOptions, SurveyOptions
from v2hdm.records import DIAMOND, FloatArray, IntArray

_DIAGONALS = (((0, 2),), ((1, 3),))
_SIDES = (((0, 1), (3, 2)), ((1, 2), (0, 3)))
"""Pairs of corners that are as far apart as a marking is long, or wide; the map decides which."""


def known_lengths(
    sizes: SizeOptions, kind: Sequence[str], corners_map: FloatArray, corner_index: IntArray
) -> KnownLengths | None:
    """The distances between corners that stated sizes imply, None if there are none.

    Of a diamond the size is that of its diagonals, of all others that of its sides. A marking that is not of
    its class's size is another thing, or cut off; nothing is known of it. ``kind`` (G,) is the class of every
    group, ``corners_map`` (G, 4, 2) rough positions, nan where unknown, and ``corner_index`` (G, 4) the
    corners' numbers in the adjustment, -1 for none.
    """
    found: list[tuple[int, int, float]] = []
    for name, size in sizes.by_class_m.items():
        spans = _DIAGONALS if name == DIAMOND else _SIDES
        for group in np.flatnonzero(np.array(kind) == name):
            corners = corners_map[group]
            apart = [[np.linalg.norm(corners[a] - corners[b]) for a, b in span] for span in spans]
            seen = np.array([np.mean(distances) for distances in apart])
            wanted = np.array(size) if seen[0] >= seen[1] else np.array(size)[::-1]
            # Also false where a corner is nowhere: then it is not known which of the two is the longer one.
            if not (np.abs(seen - wanted) <= sizes.tolerance * wanted).all():
                continue
            for span, metres in zip(spans, wanted, strict=True):
                ends = corner_index[group][np.array(span)]
                found += [(a, b, metres) for a, b in ends[(ends >= 0).all(axis=1)].tolist()]
    if not found:
        return None
    first, second, length_m = (np.array(column) for column in zip(*found, strict=True))
    return KnownLengths(first, second, length_m, np.full(len(found), sizes.sigma_m))


def control_points(
    survey: SurveyOptions, corners_map: FloatArray, corner_index: IntArray, poses: PoseSigma
) -> ControlPoints | None:
    """The corners that surveyed points belong to, None if there are none; points out of reach are left out.

    ``corners_map`` and ``corner_index`` are as of :func:`known_lengths`. ``poses`` is how far the recorded
    poses are off; neighbouring corners share their drift.
    """
    points = np.array([one.position_map for one in survey.control], dtype=np.float64).reshape(-1, 2)
    sigma_m = np.array([one.sigma_m for one in survey.control], dtype=np.float64).reshape(-1, 2)
    known = (corner_index >= 0) & np.isfinite(corners_map).all(axis=-1)
    if not len(points) or not known.any():
        return None
    off_m, _ = KDTree(corners_map[known]).query(points)
    near = np.flatnonzero(off_m <= survey.reach_m)
    covariance = _covariance(points[near], sigma_m[near], poses)
    found = match(points[near], corners_map[known], survey.reach_m, covariance)
    used = near[found >= 0]
    if not len(used):
        return None
    return ControlPoints(corner_index[known][found[found >= 0]], points[used], sigma_m[used])


def _covariance(points: FloatArray, sigma_m: FloatArray, poses: PoseSigma) -> FloatArray:
    """Joint covariance (2N, 2N), m^2, of corners minus points (N, 2), before the survey has moved the map."""
    drift, apart_m = poses.position_drift, np.linalg.norm(points[:, None] - points, axis=-1)
    shared = drift.sigma**2 * np.exp(-apart_m / drift.over_m)
    own = (poses.position_m**2 - drift.sigma**2) * np.eye(len(points))
    return np.kron(shared + own, np.eye(2)) + np.diag(sigma_m.ravel() ** 2)


def name_of(survey: SurveyOptions, point_map: FloatArray) -> str:
    """The name of the control point at ``point_map`` (2,), which is one of those of the survey."""
    return next(one.id for one in survey.control if np.array_equal(one.position_map, point_map))


def without_corner(survey: SurveyOptions, control: ControlPoints | None) -> list[str]:
    """The names of the control points that ``control`` makes no use of."""
    used = set() if control is None else set(map(tuple, control.points_map.tolist()))
    return [one.id for one in survey.control if tuple(one.position_map) not in used]
