"""A simple follower of a recorded path: pure pursuit (Coulter 1992) about the path's own curvature."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.interpolate import make_smoothing_spline

from tests.benchmarks.made.van import STEP_S, WHEELBASE_M
from v2hdm.geometry.planar import wrapped
from v2hdm.records import FloatArray

_SAMPLE_M = 0.1  # way between two points of a planned path
_WINDOW_M = 5.0  # way about the last foot point, in which the next one is looked for
_AHEAD_S, _AHEAD_M = 0.6, 1.2  # the follower aims at the path so far ahead, as seconds of driving and least
_LAG_S = 0.17  # time that the steering lags behind: the path's curvature is asked for so much earlier
_SETTLE_S = 4.0  # time in which a steering that pulls aside is corrected


class Foot(NamedTuple):
    """The place of a path nearest to a vehicle, and how the vehicle is off there."""

    station_m: float
    left_m: float  # of the vehicle, to the left of the path
    turned_rad: float  # the vehicle's heading less the path's


@dataclass(frozen=True)
class PlannedPath:
    """A path by its length: (N,) stations, m, headings, rad, and curvatures, 1/m; (N, 2) points, m."""

    station_m: FloatArray
    points_map: FloatArray
    yaw_rad: FloatArray
    curvature: FloatArray

    @classmethod
    def recorded(cls, places_map: FloatArray) -> PlannedPath:
        """The smooth path through recorded positions (K, 2) of the vehicle's origin."""
        way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places_map, axis=0), axis=1))])
        at_m = np.arange(0.0, way_m[-1], _SAMPLE_M)
        splines = [make_smoothing_spline(way_m, places_map[:, axis]) for axis in (0, 1)]
        points = np.column_stack([spline(at_m) for spline in splines])
        (vx, vy), (ax, ay) = ([spline(at_m, order) for spline in splines] for order in (1, 2))
        station_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        curvature = (vx * ay - vy * ax) / np.hypot(vx, vy) ** 3
        return cls(station_m, points, np.unwrap(np.arctan2(vy, vx)), curvature)

    @property
    def length_m(self) -> float:
        """Its length."""
        return float(self.station_m[-1])

    def foot(self, place_map: FloatArray, heading_rad: float, about_m: float) -> Foot:
        """The nearest place to a vehicle within some metres of a station."""
        first, last = np.searchsorted(self.station_m, [about_m - _WINDOW_M, about_m + _WINDOW_M])
        offsets = place_map - self.points_map[first:last]
        nearest = int((offsets**2).sum(axis=1).argmin())
        number = int(first) + nearest
        yaw_rad = float(self.yaw_rad[number])
        cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
        x_m, y_m = offsets[nearest].tolist()
        along_m = cos * x_m + sin * y_m
        return Foot(
            station_m=float(self.station_m[number] + along_m),
            left_m=float(cos * y_m - sin * x_m),
            turned_rad=float(wrapped(heading_rad - yaw_rad - self.curvature[number] * along_m)),
        )

    def curvature_at(self, station_m: float) -> float:
        """The curvature, 1/m, at a station."""
        return float(np.interp(station_m, self.station_m, self.curvature))


@dataclass
class Follower:
    """Steers along a path, by poses alone."""

    path: PlannedPath
    station_m: float = 0.0
    pulled_per_m: float = 0.0  # curvature by which the steering pulls aside, as estimated

    def steer(self, place_map: FloatArray, heading_rad: float, speed_m_s: float) -> float:
        """The steering angle, rad, at a pose and a speed; to be called every :data:`STEP_S`."""
        foot = self.path.foot(place_map, heading_rad, self.station_m)
        self.station_m = foot.station_m
        ahead_m = max(_AHEAD_S * speed_m_s, _AHEAD_M)
        # The circle to where the path would be ahead, were it straight: what pure pursuit adds to its bend.
        back = -2.0 * (foot.left_m + ahead_m * foot.turned_rad) / ahead_m**2
        self.pulled_per_m -= back * STEP_S / _SETTLE_S
        bend = self.path.curvature_at(foot.station_m + _LAG_S * speed_m_s)
        return float(np.arctan(WHEELBASE_M * (bend + back - self.pulled_per_m)))
