"""Corners that the user has surveyed, found among those of the map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from v2hdm.adjust import ControlPoints
from v2hdm.mapping.options import ControlOptions, SurveyOptions
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
    points, sigma_m = _arrays(survey.control)
    known = (corner_index >= 0) & np.isfinite(corners_map).all(axis=-1)
    if not len(points) or not known.any():
        return None
    off_m, nearest = KDTree(corners_map[known]).query(points, distance_upper_bound=survey.reach_m)
    # The nearest first, so that of two points of one corner the nearer one is kept.
    order = np.argsort(off_m)[: np.count_nonzero(np.isfinite(off_m))]
    corner, first = np.unique(corner_index[known][nearest[order]], return_index=True)
    if not len(corner):
        return None
    used = order[first]
    return ControlPoints(corner, points[used], sigma_m[used])


def name_of(survey: SurveyOptions, point_map: FloatArray) -> str:
    """The name of the control point at ``point_map`` (2,), which is one of those of the survey."""
    return next(one.id for one in survey.control if np.array_equal(one.position_map, point_map))


def without_corner(survey: SurveyOptions, control: ControlPoints | None) -> list[str]:
    """The names of the control points that ``control`` makes no use of."""
    used = set() if control is None else {name_of(survey, point) for point in control.points_map}
    return [one.id for one in survey.control if one.id not in used]


def _arrays(points: Sequence[ControlOptions]) -> tuple[FloatArray, FloatArray]:
    """Positions and sigmas (N, 2) of control points, m."""
    positions = np.array([one.position_map for one in points], dtype=np.float64).reshape(-1, 2)
    return positions, np.array([one.sigma_m for one in points], dtype=np.float64).reshape(-1, 2)
