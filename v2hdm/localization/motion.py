"""The state of a vehicle that localises itself, and how it moves between two frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.records import FloatArray

ACCELERATION_M_S2 = 1.5
"""Standard deviation of the acceleration that holds for a second: a yard truck brakes with 2 to 3 m/s^2."""

TURN_ACCELERATION_RAD_S2 = 0.3
"""The same of the yaw rate: full lock within about two seconds at walking pace."""

SLIP_M_S = 0.05
"""Standard deviation of the sideways speed: tyres slip, and the poses' origin may lie off the rear axle."""

_START_SPEED_M_S, _START_TURN_RAD_S = 5.0, 0.3
"""Sigmas of speed and yaw rate before the first frame: anything that a vehicle does in a yard."""

X, Y, HEADING, SPEED, TURN, ROLL, PITCH = range(7)
"""The states: place, m, heading, rad, speed, m/s, yaw rate, rad/s; roll and pitch of one frame, rad."""

POSE = [X, Y, HEADING, ROLL, PITCH]
"""The states that an image depends on."""


@dataclass(frozen=True)
class State:
    """Mean (7,) and covariance (7, 7) of the states."""

    mean: FloatArray
    covariance: FloatArray

    @property
    def map_from_vehicle(self) -> FloatArray:
        """The pose (4, 4)."""
        return pose_of(self.mean[POSE])

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the place, both directions together."""
        return float(np.sqrt(np.trace(self.covariance[:2, :2])))


def pose_of(parts: FloatArray) -> FloatArray:
    """Poses (..., 4, 4) of x, y, heading, roll and pitch (..., 5)."""
    out = np.zeros((*parts.shape[:-1], 4, 4))
    flat = parts.reshape(-1, 5)
    turned = rotation_from_euler(flat[:, 3], flat[:, 4], flat[:, 2])
    out[..., :3, :3] = turned.reshape(*parts.shape[:-1], 3, 3)
    out[..., :2, 3], out[..., 3, 3] = parts[..., :2], 1.0
    return out


def start(map_from_vehicle: FloatArray, sigma_m: float, sigma_rad: float, attitude_rad: float) -> State:
    """The state at a pose that is known by ``sigma_m`` a coordinate and ``sigma_rad`` of heading."""
    heading = np.arctan2(map_from_vehicle[1, 0], map_from_vehicle[0, 0])
    mean = np.array([*map_from_vehicle[:2, 3], heading, 0.0, 0.0, 0.0, 0.0])
    sigma = [sigma_m, sigma_m, sigma_rad, _START_SPEED_M_S, _START_TURN_RAD_S, attitude_rad, attitude_rad]
    return State(mean, np.diag(np.square(sigma)))


def predict(state: State, step_s: float, attitude_rad: float) -> State:
    """The state ``step_s`` later: constant speed and yaw rate, disturbed by white accelerations.

    Roll and pitch start afresh, with the standard deviation ``attitude_rad``: the road and the
    springs are not modelled.
    """
    x, y, heading, speed, turn = state.mean[:5]
    middle = heading + turn * step_s / 2
    ahead = np.array([np.cos(middle), np.sin(middle)])
    left = np.array([-ahead[1], ahead[0]])
    mean = np.array(
        [*(np.array([x, y]) + speed * step_s * ahead), heading + turn * step_s, speed, turn, 0, 0]
    )
    change = np.eye(7)
    change[:2, HEADING] = speed * step_s * left
    change[:2, SPEED] = step_s * ahead
    change[:2, TURN] = speed * step_s**2 / 2 * left
    change[HEADING, TURN] = step_s
    change[ROLL:, :] = 0.0
    pushed = np.zeros((7, 2))
    pushed[:2, 0], pushed[SPEED, 0] = step_s**2 / 2 * ahead, step_s
    pushed[:2, 1] = speed * step_s**3 / 6 * left
    pushed[HEADING, 1], pushed[TURN, 1] = step_s**2 / 2, step_s
    noise = np.square([ACCELERATION_M_S2, TURN_ACCELERATION_RAD_S2])
    covariance = change @ state.covariance @ change.T + (pushed * noise) @ pushed.T
    covariance[:2, :2] += (SLIP_M_S * step_s) ** 2 * np.outer(left, left)
    covariance[[ROLL, PITCH], [ROLL, PITCH]] += attitude_rad**2
    return State(mean, covariance)
