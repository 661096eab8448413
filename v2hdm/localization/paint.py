"""A map's markings as arrays: places, what their errors share and what not, and the ground beneath."""

from __future__ import annotations

import math

import numpy as np

from v2hdm.localization.belief import Plane
from v2hdm.records import SEEN_ACROSS, UNSTATED_DRIFT_OVER_M, UNSTATED_SIGMA_M, FloatArray, HDMap, IntArray

_VIEW_M = 20.0  # distance, m, between what a vehicle sees ahead and behind
_CELL_M = 10.0  # cell size of the lookup grid of markings, m
_GROUND_M = 8.0  # distance, m, over which the ground counts as a plane: a truck's length
_GROUND_SIGMA = 0.1  # standard deviation of a slope before any height is known, m/m
_HEIGHT_SIGMA_M = 0.03  # standard deviation of a marking's height about the plane, m
_PLANE_M = 1.0  # cell size of the grid of ground planes, m
_MOST_PLANES = 256  # planes that are kept


class Paint:
    """The markings of a map, by number.

    Of their errors, a part that all share (drift, survey) shifts the vehicle with them: of variance
    ``shared_m2`` a coordinate, and turns it, for the drift is another ahead than behind: ``shared_rad2``.
    It is no noise between two of them. ``centre_m2`` (M, 2, 2) is the rest of a centre's, ``shape_m2``
    (M, 8, 8) that of the corners about it.
    """

    def __init__(self, hd_map: HDMap) -> None:
        markings = hd_map.markings
        flat = np.array([marking.corners_map for marking in markings], dtype=np.float64).reshape(-1, 4, 2)
        heights = [np.zeros(4) if m.heights_m is None else m.heights_m for m in markings]
        self.corners_map: FloatArray = np.concatenate([flat, np.array(heights).reshape(-1, 4, 1)], axis=2)
        self.centres_map: FloatArray = flat.mean(axis=1)
        self.kinds = np.array([marking.kind for marking in markings])
        unstated_m2 = UNSTATED_SIGMA_M**2 * np.eye(8)
        covariances = [marking.covariance_m2 for marking in markings]
        total_m2 = np.array(
            [unstated_m2 if covariance is None else covariance for covariance in covariances]
        ).reshape(-1, 8, 8)
        mean = np.tile(np.eye(2), 4) / 4
        variance_m2 = np.trace(mean @ total_m2 @ mean.T, axis1=1, axis2=2) / 2
        relative_m2 = np.array([marking.relative_sigma_m or np.inf for marking in markings]) ** 2
        share = np.minimum(relative_m2 / np.maximum(variance_m2, 1e-12), 1.0)
        self.shared_m2 = float(np.median((1 - share) * variance_m2)) if len(markings) else 0.0
        ratio = _VIEW_M / (hd_map.drift_over_m or UNSTATED_DRIFT_OVER_M)
        self.shared_rad2 = 2 * (1 - np.exp(-ratio)) * self.shared_m2 / _VIEW_M**2
        self.centre_m2: FloatArray = share[:, None, None] * (mean @ total_m2 @ mean.T)
        about = np.eye(8) - np.tile(mean, (4, 1))
        self.shape_m2: FloatArray = about @ total_m2 @ about.T
        cells = np.floor(self.centres_map / _CELL_M).astype(np.int64)
        self._cells: dict[tuple[int, int], list[int]] = {}
        for number, (column, row) in enumerate(cells.tolist()):
            self._cells.setdefault((column, row), []).append(number)
        self._planes: dict[tuple[int, int], Plane] = {}  # by square

    def __len__(self) -> int:
        return len(self.kinds)

    def near(self, place_map: FloatArray, radius_m: float) -> IntArray:
        """The markings whose centres lie within a distance of a place, by number."""
        low = np.floor((place_map - radius_m) / _CELL_M).astype(np.int64).tolist()
        high = np.floor((place_map + radius_m) / _CELL_M).astype(np.int64).tolist()
        if (high[0] - low[0]) * (high[1] - low[1]) > len(self._cells):
            numbers = np.arange(len(self))
        else:
            columns = range(low[0], high[0] + 1)
            rows = range(low[1], high[1] + 1)
            finding = [n for column in columns for row in rows for n in self._cells.get((column, row), ())]
            numbers = np.array(sorted(finding), dtype=np.int64)
        distance_m = np.linalg.norm(self.centres_map[numbers] - place_map, axis=1)
        return np.asarray(numbers[distance_m <= radius_m])

    def looks_like(self, numbers: IntArray, kind: str) -> np.ndarray:
        """Which of some markings (M,) a camera may take for a class."""
        kinds = self.kinds[numbers]
        return np.asarray((kinds == kind) | (kinds == SEEN_ACROSS.get(kind, kind)))

    def ground(self, place_map: FloatArray) -> Plane:
        """The plane of the ground about a place, of the heights of the markings there."""
        column = math.floor(place_map[0] / _PLANE_M)
        row = math.floor(place_map[1] / _PLANE_M)
        plane = self._planes.get((column, row))
        if plane is None:
            plane = self._fitted_plane(_PLANE_M * (np.array([column, row]) + 0.5))
            if len(self._planes) >= _MOST_PLANES:
                self._planes.clear()
            self._planes[column, row] = plane
        return plane

    def _fitted_plane(self, place_map: FloatArray) -> Plane:
        numbers = self.near(place_map, 2 * _GROUND_M)
        points = self.corners_map[numbers].reshape(-1, 3)
        offset = points[:, :2] - place_map
        weight = np.exp(-0.5 * (offset**2).sum(axis=1) / _GROUND_M**2) / _HEIGHT_SIGMA_M**2
        design = np.column_stack([np.ones(len(points)), offset])
        normal = design.T @ (weight[:, None] * design) + np.diag([1e-6, *(2 * [_GROUND_SIGMA**-2])])
        height_m, by_x, by_y = np.linalg.solve(normal, design.T @ (weight * points[:, 2])).tolist()
        return Plane(height_m, (by_x, by_y))
