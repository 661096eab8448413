"""The ground as known before its markings: usual slopes, its smoothness, and recorded heights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, cholesky_banded
from scipy.spatial import cKDTree

from v2hdm.records import FloatArray, PoseNoise, Road
from v2hdm.surface.basis import ACROSS, ACROSS_KNOTS, GRADES, HINGES, Knots

_SLOPE_SIGMA = 0.03
"""Standard deviation of a change of slope: roads fall by 1.5 to 2.5 % to each side of a crown (AASHTO, A
Policy on Geometric Design of Highways and Streets, 7th ed., section 4.2.2)."""

_GRADE_SIGMA = 0.1  # standard deviation of the grade of the whole map: the steepest roads rise by 10 to 15 %

CURVATURE = 1e-3  # typical second difference, 1/m: a crest of 1 km radius, bank changing by 1 % in 10 m
SIZES_SIGMA = 2.0  # standard deviation of the logarithm of second differences, over all roads
_RIDGE_M = 30.0  # standard deviation, m, of the spline's coefficients: keeps the information matrix regular

LEAN = (0.003, 1e4)
"""Sigma, rad, and correlation length, m, of the sensor's roll on the vehicle, which is constant: only turns
separate it from bank."""


@dataclass(frozen=True)
class Recorded:
    """Heights and slopes recorded on the path, with errors that are sums of correlated processes."""

    road: Road | None  # None on a level road
    heights: tuple[tuple[float, float], ...] = ((0.1, 20.0),)  # sigma, m, and correlation length, m
    slopes: tuple[tuple[float, float], ...] = ((0.01, 10.0),)  # sigma, and correlation length, m

    @classmethod
    def of(cls, road: Road | None, noise: PoseNoise) -> Recorded:
        """From a drive: GNSS heights are 1.5 times as uncertain as positions; a level road is a weak guess.

        The road's heights and slopes are means over 10 m, which leaves a third of the poses' white noise.
        """
        if road is None:
            return cls(None)
        drift_m = noise.position_drift_m
        white_m = np.sqrt(max(noise.position_m**2 - drift_m**2, 0.0)) / 3
        heights = ((1.5 * drift_m, noise.position_drift_over_m), (1.5 * float(white_m), 10.0))
        return cls(road, heights, ((0.004, 10.0),))

    def at(self, points_map: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Heights (N,) and slopes (N, 2) along map x and y at points (N, 2) of the path."""
        if self.road is None:
            return np.zeros(len(points_map)), np.zeros((len(points_map), 2))
        _, nearest = cKDTree(self.road.points_map).query(points_map)
        slope = self.road.slope[nearest]
        off = points_map - self.road.points_map[nearest]
        return self.road.height_m[nearest] + np.einsum("ni,ni->n", slope, off), slope


@dataclass(frozen=True)
class Smoothness:
    """The prior of a surface's B parameters by the sizes of its second differences.

    ``by_order`` (3, N, N) are the squared differences of the spline's N coefficients, along the path twice,
    once and not at all; ``bands`` (3, W, N) are their lower diagonals.
    """

    by_order: FloatArray
    bands: FloatArray

    @classmethod
    def of(cls, knots: Knots) -> Smoothness:
        """The prior over some knots along the path."""
        along = _squared_differences(knots)
        across = _squared_differences(ACROSS_KNOTS)
        by_order = np.stack([np.kron(along[order], across[2 - order]) for order in (2, 1, 0)])
        # Differences along the path reach two knots ahead, those across it no further than a row of knots.
        width = min(3 * ACROSS, by_order.shape[1])
        bands = np.zeros((3, width, by_order.shape[1]))
        for below in range(width):
            bands[:, below, : by_order.shape[1] - below] = by_order.diagonal(-below, axis1=1, axis2=2)
        return cls(by_order, bands)

    def prior(self, sizes: FloatArray) -> FloatArray:
        """Prior information (B, B) for log standard deviations (3,) of the second differences."""
        spline = np.tensordot(np.exp(-2 * sizes), self.by_order, axes=1)
        spline.flat[:: len(spline) + 1] += _RIDGE_M**-2
        return np.asarray(block_diag(np.diag(_of_slopes()), spline))

    def log_root(self, sizes: FloatArray) -> float:
        """Half the logarithm of the prior information's determinant; raises LinAlgError by rounding."""
        bands = np.tensordot(np.exp(-2 * sizes), self.bands, axes=1)
        bands[0] += _RIDGE_M**-2
        root = cholesky_banded(bands, lower=True, check_finite=False)
        return float(np.log(root[0]).sum() + np.log(_of_slopes()).sum() / 2)


def _of_slopes() -> FloatArray:
    """Prior information of the parameters before the spline's."""
    return np.repeat([_GRADE_SIGMA, _SLOPE_SIGMA], [GRADES, HINGES]) ** -2.0


def _squared_differences(knots: Knots) -> list[FloatArray]:
    """By order 0, 1 and 2: the matrix (N, N) of the squared differences of N coefficients."""
    unit = np.eye(knots.functions)
    first = np.diff(unit, axis=0) / knots.step_m
    second = np.diff(unit, 2, axis=0) / knots.step_m**2
    return [difference.T @ difference for difference in (unit, first, second)]
