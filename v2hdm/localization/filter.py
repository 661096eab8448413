"""The filter behind localisation: the vehicle's state, its motion, and what a matched marking says of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtri

from v2hdm.association.groups import CLEARER_BY
from v2hdm.geometry.ipm import (
    apply_in_front,
    ground_from_pinhole_px,
    homography_jacobian,
    pinhole_px_from_ground,
    project_ground,
)
from v2hdm.geometry.least_squares import Normal, gauss_newton
from v2hdm.geometry.planar import SHIFTS, align, block_diagonal
from v2hdm.geometry.rigid import inverse, rotation_from_euler
from v2hdm.records import UNSTATED_SIGMA_M, BoolArray, FloatArray, HDMap, IntArray

# Standard deviation of the acceleration that holds for a second: a yard truck brakes with 2 to 3 m/s^2.
_ACCELERATION_M_S2 = 1.5
# Standard deviation of the yaw acceleration: full lock within about two seconds at walking pace.
_TURN_ACCELERATION_RAD_S2 = 0.3
# Standard deviation of the sideways speed: tyres slip, and the poses' origin may lie off the rear axle.
_SLIP_M_S = 0.05

# Before the first frame, speed and yaw rate are anything that a vehicle does in a yard.
_START_SPEED_M_S = 5.0  # standard deviation of the speed then, m/s
_START_TURN_RAD_S = 0.3  # standard deviation of the yaw rate then, rad/s

# Squared distance, in sigmas, up to which a detection fits: one in a thousand is farther.
_LARGEST_SQUARE = float(chdtri(8, 1e-3))

# Radius about where a detection seems to lie, in sigmas of the place, in which its marking is looked for.
_REACH_SIGMAS = 4.0
_LEAST_REACH_M = 1.5  # least such radius, m: the far corners of a cut marking are not where they seem

# Factor of a detection's covariance: an edge that shadow or wear misplaces stays so in the next images.
# Errors of one corner correlate by about 0.2 from image to image; over the ten frames that the filter
# remembers that is 1 + 9 x 0.2.
_REPEATS = 2.8
_ITERATIONS = 3  # steps of an update: half a metre off at the first, a few millimetres at the third
# Change of a state, m or rad, after which the next iteration would change no pixel by a tenth.
_SETTLED = 1e-3

X, Y, HEADING, SPEED, TURN, ROLL, PITCH = range(7)
"""The states: place, m, heading, rad, speed, m/s, yaw rate, rad/s; roll and pitch of one frame, rad."""

POSE = [X, Y, HEADING, ROLL, PITCH]  # the states that an image depends on
_STEP = np.array([1e-4, 1e-4, 1e-5, 1e-5, 1e-5])  # steps of the differences by POSE: m and rad
# Rows (4, 8) of the stacked corners of a detection, for each corner that may be the marking's first.
_SHIFT_ROWS = (2 * SHIFTS[..., None] + np.arange(2)).reshape(4, 8)


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
    pose = np.zeros((*parts.shape[:-1], 4, 4))
    flat = parts.reshape(-1, 5)
    rotation = rotation_from_euler(flat[:, 3], flat[:, 4], flat[:, 2])
    pose[..., :3, :3] = rotation.reshape((*parts.shape[:-1], 3, 3))
    pose[..., :2, 3] = parts[..., :2]
    pose[..., 3, 3] = 1.0
    return pose


def start(map_from_vehicle: FloatArray, sigma_m: float, sigma_rad: float, attitude_rad: float) -> State:
    """The state at a pose that is known by ``sigma_m`` a coordinate and ``sigma_rad`` of heading."""
    heading = np.arctan2(map_from_vehicle[1, 0], map_from_vehicle[0, 0])
    mean = np.array([*map_from_vehicle[:2, 3], heading, 0.0, 0.0, 0.0, 0.0])
    sigma = [sigma_m, sigma_m, sigma_rad, _START_SPEED_M_S, _START_TURN_RAD_S, attitude_rad, attitude_rad]
    return State(mean, np.diag(np.square(sigma)))


def predict(state: State, step_s: float, attitude_rad: float) -> State:
    """The state ``step_s`` later: constant speed and yaw rate, white accelerations; roll and pitch afresh."""
    x, y, heading, speed, turn = state.mean[:5]
    middle = heading + turn * step_s / 2
    ahead = np.array([np.cos(middle), np.sin(middle)])
    left = np.array([-ahead[1], ahead[0]])
    place = np.array([x, y]) + speed * step_s * ahead
    mean = np.array([*place, heading + turn * step_s, speed, turn, 0, 0])
    change = np.eye(7)
    change[:2, HEADING] = speed * step_s * left
    change[:2, SPEED] = step_s * ahead
    change[:2, TURN] = speed * step_s**2 / 2 * left
    change[HEADING, TURN] = step_s
    change[ROLL:, :] = 0.0
    push = np.zeros((7, 2))
    push[:2, 0] = step_s**2 / 2 * ahead
    push[SPEED, 0] = step_s
    push[:2, 1] = speed * step_s**3 / 6 * left
    push[HEADING, 1] = step_s**2 / 2
    push[TURN, 1] = step_s
    noise = np.square([_ACCELERATION_M_S2, _TURN_ACCELERATION_RAD_S2])
    covariance = change @ state.covariance @ change.T + (push * noise) @ push.T
    covariance[:2, :2] += (_SLIP_M_S * step_s) ** 2 * np.outer(left, left)
    covariance[[ROLL, PITCH], [ROLL, PITCH]] += attitude_rad**2
    return State(mean, covariance)


@dataclass(frozen=True)
class Sighting:
    """One detection: class, camera, corners (4, 2), pinhole px, covariances (4, 2, 2), which inform."""

    kind: str
    intrinsic: FloatArray
    cam_from_vehicle: FloatArray
    corners_px: FloatArray
    covariance_px: FloatArray
    informs: BoolArray

    def project(self, pose: FloatArray, corners_map: FloatArray) -> FloatArray:
        """Pixels (..., 4, 2) of a marking (4, 2) from poses (..., 5)."""
        return project_ground(self.intrinsic, self.cam_from_vehicle @ inverse(pose_of(pose)), corners_map)[0]

    def by_state(self, mean: FloatArray, corners_map: FloatArray) -> FloatArray:
        """Derivative (8, 7) of the pixels of a marking (4, 2) by a state (7,), by central differences."""
        steps = np.diag(_STEP)
        pixels = self.project(mean[POSE] + np.concatenate([steps, -steps]), corners_map).reshape(10, 8)
        derivative = np.zeros((8, 7))
        derivative[:, POSE] = ((pixels[:5] - pixels[5:]) / (2 * _STEP[:, None])).T
        return derivative

    def by_place(self, pose: FloatArray, corners_map: FloatArray) -> FloatArray:
        """Derivative (8, 8) of a marking's pixels by its corners in the map."""
        px_from_map = pinhole_px_from_ground(self.intrinsic, self.cam_from_vehicle @ inverse(pose_of(pose)))
        return np.asarray(block_diagonal(homography_jacobian(px_from_map, corners_map)[None])[0])

    def on_ground(self, pose: FloatArray) -> FloatArray:
        """Where on the ground the corners (4, 2) lie; nan above the horizon."""
        cam_from_map = self.cam_from_vehicle @ inverse(pose_of(pose))
        return apply_in_front(ground_from_pinhole_px(self.intrinsic, cam_from_map), self.corners_px)


@dataclass(frozen=True)
class Match:
    """A detection and a marking of the map that it may show."""

    sighting: Sighting
    rows: IntArray  # (2 K,) of the detection's stacked corners that say anything
    is_informed: BoolArray  # (8,) which of the marking's stacked corners these are
    noise: FloatArray  # (2 K, 2 K) covariance of both, px^2
    corners_map: FloatArray

    def against(self, mean: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The residual (2 K,), px, at a state (7,), and the derivative (2 K, 7) of the expected pixels."""
        expected = self.sighting.project(mean[POSE], self.corners_map)
        residual = self.sighting.corners_px.reshape(8)[self.rows] - expected.reshape(8)[self.is_informed]
        return residual, self.sighting.by_state(mean, self.corners_map)[self.is_informed]


class Markings:
    """The map's markings, to be looked up by place.

    Of their errors, a part that all share (drift, survey) shifts the vehicle with them: of variance
    ``shared_m2`` a coordinate, it is no noise between two of them.
    """

    def __init__(self, hd_map: HDMap) -> None:
        self._corners = np.stack([marking.corners_map for marking in hd_map.markings])
        stated = [marking.covariance_m2 for marking in hd_map.markings]
        unstated_m2 = UNSTATED_SIGMA_M**2 * np.eye(8)
        total_m2 = np.stack(
            [unstated_m2 if covariance_m2 is None else covariance_m2 for covariance_m2 in stated]
        )
        variance_m2 = np.einsum("nii->n", total_m2) / 8
        relative_m2 = np.array([marking.relative_sigma_m or np.inf for marking in hd_map.markings]) ** 2
        share = np.minimum(relative_m2 / variance_m2, 1.0)
        self._covariance = share[:, None, None] * total_m2
        self.shared_m2 = float(np.median((1 - share) * variance_m2))
        self._kind = np.array([marking.kind for marking in hd_map.markings])
        self._tree = cKDTree(self._corners.mean(axis=1))

    def match(self, sighting: Sighting, state: State) -> tuple[int, State] | None:
        """The one marking that fits a detection, and the state after it; None where not just one fits."""
        ground = sighting.on_ground(state.mean[POSE])
        is_on_ground = sighting.informs & np.isfinite(ground).all(axis=1)
        candidates = self._near(sighting.kind, ground[is_on_ground], state)
        if not len(candidates):
            return None
        corners = self._corners[candidates]
        shifts = align(corners, np.ones(corners.shape[:2], dtype=bool), ground, is_on_ground).shift
        fits: list[tuple[int, Fit]] = []
        for marking, shift in zip(candidates.tolist(), shifts.tolist(), strict=True):
            pair = self._pair(sighting, state, marking, _SHIFT_ROWS[shift])
            if not np.isfinite(pair.noise).all():  # a corner is behind the camera
                continue
            candidate = fit(state, pair)
            if candidate.squared <= _LARGEST_SQUARE:
                fits.append((marking, candidate))
        fits.sort(key=lambda marking_and_fit: marking_and_fit[1].loss)
        if not fits or (len(fits) > 1 and fits[1][1].loss < fits[0][1].loss + CLEARER_BY):
            return None
        marking, best = fits[0]
        return marking, best.state

    def _pair(self, sighting: Sighting, state: State, marking: int, order: IntArray) -> Match:
        """A detection beside ``marking``, whose stacked corners are the detection's in ``order`` (8,)."""
        is_informed = np.repeat(sighting.informs, 2)[order]
        rows = order[is_informed]
        corners = self._corners[marking]
        by_place = sighting.by_place(state.mean[POSE], corners)[is_informed]
        noise = _REPEATS * block_diagonal(sighting.covariance_px[None])[0][np.ix_(rows, rows)]
        return Match(
            sighting, rows, is_informed, noise + by_place @ self._covariance[marking] @ by_place.T, corners
        )

    def _near(self, kind: str, ground: FloatArray, state: State) -> IntArray:
        """The markings of a class that lie about where corners (K, 2) seem to."""
        if not len(ground):
            return np.zeros(0, dtype=np.int64)
        middle = ground.mean(axis=0)
        arm_m = float(np.linalg.norm(middle - state.mean[:2]))
        turned_m = arm_m * float(np.sqrt(state.covariance[HEADING, HEADING]))
        reach_m = _LEAST_REACH_M + _REACH_SIGMAS * (state.sigma_m + turned_m)
        in_reach = np.array(sorted(self._tree.query_ball_point(middle, reach_m)), dtype=np.int64)
        return in_reach[self._kind[in_reach] == kind] if len(in_reach) else in_reach


class Fit(NamedTuple):
    """A match, taken for true."""

    state: State  # after it
    squared: float  # squared distance, in sigmas
    loss: float  # minus twice the log likelihood, up to a constant


def fit(state: State, match: Match) -> Fit:
    """Update a state by a match.

    An iterated extended Kalman update, as least squares over the state whitened by its covariance.
    """
    values, axes = np.linalg.eigh(state.covariance)
    spread = axes * np.sqrt(np.maximum(values, 0.0))
    weight = np.linalg.inv(match.noise)

    def linearise(whitened: FloatArray) -> Normal:
        residual, slope = match.against(state.mean + spread @ whitened)
        slope = slope @ spread
        weighed = slope.T @ weight
        gradient = whitened - weighed @ residual
        cost = 0.5 * float(whitened @ whitened + residual @ weight @ residual)
        return Normal(np.eye(7) + weighed @ slope, gradient, cost)

    def settled(step: FloatArray) -> bool:
        return bool(np.abs(spread @ step)[POSE].max() < _SETTLED)

    optimum = gauss_newton(linearise, np.zeros(7), steps=_ITERATIONS, settled=settled)
    squared = 2 * optimum.predicted_cost
    covariance = optimum.covariance
    # The equations of a corner that would lie at the horizon are singular, and say nothing.
    if not (np.isfinite(squared) and np.isfinite(covariance).all()):
        return Fit(state, np.inf, np.inf)
    state_after = State(state.mean + spread @ optimum.x, spread @ covariance @ spread.T)
    volume = np.linalg.slogdet(match.noise)[1] + np.linalg.slogdet(optimum.last.information)[1]
    return Fit(state_after, squared, squared + float(volume))


def locate(state: State, sightings: Sequence[Sighting], markings: Markings) -> tuple[State, list[int]]:
    """The state after one frame's detections, the unambiguous ones first, and the markings matched."""
    matched: list[int] = []
    waiting = sorted(sightings, key=lambda sighting: -float(sighting.corners_px[:, 1].max()))
    while waiting:
        later = []
        for sighting in waiting:
            matching = markings.match(sighting, state)
            if matching is None or matching[0] in matched:
                later.append(sighting)
                continue
            marking, state = matching
            matched.append(marking)
        if len(later) == len(waiting):
            break
        waiting = later
    return state, matched
