"""Corners that the user has surveyed, found among those of the map."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from v2hdm.adjust import ControlPoints
from v2hdm.mapping.options import SurveyOptions
from v2hdm.records import FloatArray, IntArray


def control_points(
    survey: SurveyOptions, corners_map: FloatArray, corner_index: IntArray
) -> ControlPoints | None:
    """The corners that surveyed points are of, None if there are none.

    A point is of the corner nearest to it, if that lies within reach; a corner of the point nearest to it.
    Points without a corner are left out: not every camera sees every one.

    Args:
        survey: What the user says.
        corners_map: (G, 4, 2) about where the corners lie, nan where nobody knows.
        corner_index: (G, 4) the corners' numbers in the adjustment, -1 for none.
    """
    points = np.array(survey.points_map, dtype=np.float64).reshape(-1, 2)
    known = (corner_index >= 0) & np.isfinite(corners_map).all(axis=-1)
    if not len(points) or not known.any():
        return None
    off_m, nearest = KDTree(corners_map[known]).query(points, distance_upper_bound=survey.reach_m)
    # The nearest first, so that of two points of one corner the nearer one is kept.
    order = np.argsort(off_m)[: np.count_nonzero(np.isfinite(off_m))]
    corner, first = np.unique(corner_index[known][nearest[order]], return_index=True)
    if not len(corner):
        return None
    return ControlPoints(corner, points[order[first]], np.full(len(corner), survey.sigma_m))


def without_corner(survey: SurveyOptions, control: ControlPoints | None) -> FloatArray:
    """The surveyed points (N, 2) that ``control`` makes no use of."""
    points = np.array(survey.points_map, dtype=np.float64).reshape(-1, 2)
    used = np.zeros((0, 2)) if control is None else control.points_map
    return np.asarray(points[~(points[:, None] == used).all(axis=-1).any(axis=-1)])
