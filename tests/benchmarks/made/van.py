"""A port's van that is steered: a kinematic bicycle on springs, and the odometry that it has."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from v2hdm.geometry.rigid import make_transform, rotation_from_euler
from v2hdm.localization.motion import Motion
from v2hdm.records import FloatArray

STEP_S = 0.02
"""Time, s, between two steps of the van, two samples of its odometry, and two commands of its steering."""

WHEELBASE_M = 2.8  # of a van
BACK_M, AHEAD_M = 1.2, 3.7
"""How far its outline reaches behind and ahead of its origin under the rear axle: as far as its cameras."""
HALF_WIDTH_M = 1.05
"""A yard tractor, 2.5 m wide, would touch the borders in port 1's bends on the recorded path itself."""

_STEER_LAG_S = 0.15  # time constant of the steering's actuator
_MOST_STEER_RAD = 0.6  # full lock
_MOST_STEER_RAD_S = 0.5  # fastest that the actuator turns
_STEER_OFF_RAD = np.deg2rad(0.3)  # standard deviation of the steering's zero, another on each drive
_SPEED_LAG_S = 0.5  # time constant of engine and brakes
_SLIP_M_SQRT_S = 0.004  # way sideways that tyres slip within a second, m (one sigma)
# Roll and pitch of the body: standard deviations of a fast and a lasting part, and the times they last.
_SWAY_RAD, _SWAY_S = np.array([0.0015, 0.0015]), np.array([0.25, 4.0])
_HEAVE_M, _HEAVE_S = 0.005, 0.25  # and of its height

_SCALE = 0.01  # standard deviation of the odometry's speed scale
_BIAS_RAD_S = np.deg2rad(0.01)  # standard deviation of its gyro's bias
_SPEED_M_SQRT_S, _YAW_RAD_SQRT_S = 0.01, 2e-4  # and their noise, of way and heading after a second


@dataclass
class Van:
    """Where a van truly is, and how it moves; all errors of its parts are drawn by ``rng``."""

    rng: np.random.Generator
    place_map: FloatArray  # (2,) of the origin under the rear axle, m
    heading_rad: float
    speed_m_s: float = 0.0
    steer_rad: float = 0.0
    stamp_s: float = 0.0
    yaw_rate_rad_s: float = 0.0
    sway_rad: FloatArray = field(default_factory=lambda: np.zeros((2, 2)))  # of roll and pitch, by part
    heave_m: float = 0.0

    def __post_init__(self) -> None:
        self.steer_off_rad = self.rng.normal(0.0, _STEER_OFF_RAD)
        self._scale = 1 + self.rng.normal(0.0, _SCALE)
        self._bias_rad_s = self.rng.normal(0.0, _BIAS_RAD_S)

    @property
    def map_from_vehicle(self) -> FloatArray:
        """The true pose (4, 4)."""
        roll, pitch = self.sway_rad.sum(axis=1).tolist()
        angles = (np.array([angle]) for angle in (roll, pitch, self.heading_rad))
        return make_transform(rotation_from_euler(*angles)[0], np.array([*self.place_map, self.heave_m]))

    def step(self, steer_rad: float, speed_m_s: float) -> None:
        """Go on for :data:`STEP_S` with a wanted steering angle and a wanted speed."""
        wanted_rad = np.clip(steer_rad, -_MOST_STEER_RAD, _MOST_STEER_RAD) + self.steer_off_rad
        turn_rad = (wanted_rad - self.steer_rad) * (1 - np.exp(-STEP_S / _STEER_LAG_S))
        most_rad = _MOST_STEER_RAD_S * STEP_S
        self.steer_rad += float(np.clip(turn_rad, -most_rad, most_rad))
        self.speed_m_s += (speed_m_s - self.speed_m_s) * (1 - np.exp(-STEP_S / _SPEED_LAG_S))
        self.yaw_rate_rad_s = self.speed_m_s * float(np.tan(self.steer_rad)) / WHEELBASE_M
        middle_rad = self.heading_rad + 0.5 * self.yaw_rate_rad_s * STEP_S
        ahead = np.array([np.cos(middle_rad), np.sin(middle_rad)])
        is_moving = min(self.speed_m_s, 1.0)
        slip_m = is_moving * _SLIP_M_SQRT_S * np.sqrt(STEP_S) * self.rng.standard_normal()
        left = np.array([-ahead[1], ahead[0]])
        self.place_map = self.place_map + self.speed_m_s * STEP_S * ahead + slip_m * left
        self.heading_rad += self.yaw_rate_rad_s * STEP_S
        self.stamp_s += STEP_S
        self._sway(is_moving)

    def _sway(self, is_moving: float) -> None:
        """Let the body roll, pitch and heave: Gauss-Markov processes that fade where it stands."""
        keeps = np.exp(-STEP_S / _SWAY_S)
        push = is_moving * _SWAY_RAD * np.sqrt(1 - keeps**2)
        self.sway_rad = keeps * self.sway_rad + push * self.rng.standard_normal((2, 2))
        keep = np.exp(-STEP_S / _HEAVE_S)
        push_m = is_moving * _HEAVE_M * np.sqrt(1 - keep**2)
        self.heave_m = float(keep * self.heave_m + push_m * self.rng.standard_normal())

    def odometry(self) -> Motion:
        """The odometry's measurement now, with its errors."""
        speed_m_s = self.speed_m_s * self._scale
        yaw_rate_rad_s = self.yaw_rate_rad_s + self._bias_rad_s
        if self.speed_m_s > 0.01:
            speed_m_s += self.rng.normal(0.0, _SPEED_M_SQRT_S / np.sqrt(STEP_S))
        yaw_rate_rad_s += self.rng.normal(0.0, _YAW_RAD_SQRT_S / np.sqrt(STEP_S))
        return Motion(self.stamp_s, float(speed_m_s), float(yaw_rate_rad_s))


def clearance_m(van: Van, borders_map: FloatArray) -> float:
    """The way, m, from a van's outline to the nearest of points (N, 2); negative inside of it."""
    offset = borders_map - van.place_map
    cos, sin = np.cos(van.heading_rad), np.sin(van.heading_rad)
    ahead_m = cos * offset[:, 0] + sin * offset[:, 1] - 0.5 * (AHEAD_M - BACK_M)
    left_m = cos * offset[:, 1] - sin * offset[:, 0]
    beyond = np.stack([np.abs(ahead_m) - 0.5 * (AHEAD_M + BACK_M), np.abs(left_m) - HALF_WIDTH_M])
    outside_m = np.linalg.norm(np.maximum(beyond, 0.0), axis=0)
    return float((outside_m + np.minimum(beyond.max(axis=0), 0.0)).min(initial=np.inf))


def outlines(van_poses: FloatArray) -> Iterator[FloatArray]:
    """The outlines (4, 2) in the map of a van at poses (N, 3) of x, y and heading."""
    corners = np.array(
        [[AHEAD_M, HALF_WIDTH_M], [-BACK_M, HALF_WIDTH_M], [-BACK_M, -HALF_WIDTH_M], [AHEAD_M, -HALF_WIDTH_M]]
    )
    for x, y, heading_rad in van_poses.tolist():
        cos, sin = np.cos(heading_rad), np.sin(heading_rad)
        yield corners @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
