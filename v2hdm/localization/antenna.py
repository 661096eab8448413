"""One RTK antenna: what its positions say of a belief, and the heading that its course tells before one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from v2hdm.localization.belief import HEADING, Belief, corrected
from v2hdm.localization.places import Prior, vehicle_at
from v2hdm.records import FloatArray

_COURSE_S = 10.0  # time, s, over which the odometry lays out a course
_BIAS_RAD_S = 0.003  # standard deviation of its bias, rad/s
_LEAST_RAD = np.deg2rad(1.0)  # standard deviation, rad, that a course has at least: slip, the antenna's place
_LEAST_M = 0.5  # standard deviation, m, of a place to search about: the map's own error is unknown
_GATE = 3.717  # sigmas that one position in a thousand exceeds


class Fix(NamedTuple):
    """A position (2,) of the antenna in the map by RTK, m, and its standard deviation."""

    stamp_s: float
    place_map: FloatArray
    sigma_m: float


class _Passed(NamedTuple):
    place_local: complex  # of the antenna, where the odometry counts from
    fix: Fix


@dataclass
class Antenna:
    """An antenna ``ahead_left_m`` (2,) of the vehicle's origin, and its last positions."""

    ahead_left_m: FloatArray
    passed: list[_Passed] = field(default_factory=list)

    def note(self, fix: Fix, local_from_vehicle: FloatArray) -> None:
        """Take a position at which the odometry's pose was (3,)."""
        antenna = vehicle_at(local_from_vehicle, np.array([*self.ahead_left_m, 0.0]))
        self.passed.append(_Passed(complex(antenna[0], antenna[1]), fix))
        self.passed = [item for item in self.passed if fix.stamp_s - item.fix.stamp_s < _COURSE_S]

    def prior(self, local_from_vehicle: FloatArray, stated: Prior | None) -> Prior:
        """Where the vehicle is at a pose (3,) of the odometry: headed as its course, once it has one.

        Before, the heading is the stated one, or unknown.
        """
        local = np.array([item.place_local for item in self.passed])
        at_map = np.array([complex(*item.fix.place_map) for item in self.passed])
        weight = np.array([item.fix.sigma_m for item in self.passed]) ** -2.0
        middle = (weight @ local) / weight.sum()
        middle_map = (weight @ at_map) / weight.sum()
        spread_m2 = weight @ np.abs(local - middle) ** 2 / weight.sum()
        length_s = self.passed[-1].fix.stamp_s - self.passed[0].fix.stamp_s
        # In the middle of the course the heading is known best; from there on the odometry's bias turns it.
        variance = 1 / max(weight.sum() * spread_m2, 1e-9) + (0.5 * _BIAS_RAD_S * length_s) ** 2
        sigma_rad = float(np.sqrt(variance + _LEAST_RAD**2))
        turn = float(np.angle((weight * (local - middle).conj()) @ (at_map - middle_map)))
        if stated is not None and stated.sigma_rad < sigma_rad:
            turn = float(stated.pose[2] - local_from_vehicle[2])
            sigma_rad = stated.sigma_rad
        begin = middle_map - np.exp(1j * turn) * middle
        pose = vehicle_at(np.array([begin.real, begin.imag, turn]), local_from_vehicle)
        sigma_m = float(np.hypot(max(self.passed[-1].fix.sigma_m, _LEAST_M), np.sqrt(spread_m2) * sigma_rad))
        return Prior(pose, sigma_m, min(sigma_rad, np.pi))


class Update(NamedTuple):
    """A belief after a position by RTK, and a sentence where both contradict each other."""

    belief: Belief
    problem: str | None


def with_fix(belief: Belief, fix: Fix, ahead_left_m: FloatArray, shared_m2: float) -> Update:
    """The belief after a position; ``shared_m2`` is the variance of the map's place.

    A position that it contradicts changes nothing.
    """
    c = np.cos(belief.mean[HEADING])
    s = np.sin(belief.mean[HEADING])
    arm = np.array([[c, -s], [s, c]]) @ ahead_left_m
    slope = belief.root[:2] + np.outer([-arm[1], arm[0]], belief.root[HEADING])
    total_m2 = fix.sigma_m**2 + shared_m2
    spread = slope @ slope.T + total_m2 * np.eye(2)
    off = fix.place_map - belief.mean[:2] - arm
    if off @ np.linalg.solve(spread, off) > _GATE**2:
        return Update(
            belief,
            f"RTK is {np.linalg.norm(off):.2f} m from where the markings put the vehicle: is the map in its "
            "datum, and the antenna where it is stated?",
        )
    sigma_m = np.sqrt(total_m2)
    return Update(corrected(belief, off / sigma_m, slope / sigma_m), None)
