"""Which marking of the map each detection shows, and what that says of the vehicle's state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import chi2

from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.quadrilateral import SHIFTS
from v2hdm.localization.motion import POSE, State, pose_of
from v2hdm.records import BoolArray, FloatArray, HdMap, IntArray, Marking

_GATE = float(chi2.isf(1e-3, 8))
"""Squared distance, in sigmas, up to which a detection fits: one in a thousand is farther."""

_CLEARER_BY = 9.0
"""How much worse, in the same unit, any other marking must fit: odds of ninety to one."""

_REACH_SIGMAS = 4.0
"""How far from where a detection seems to lie its marking is looked for."""

_LEAST_REACH_M = 1.5
"""And at least so far: the far corners of a cut marking are not where they seem."""

_UNKNOWN_SIGMA_M = 0.02
"""Sigma of a corner of a map that states none."""

SHIFT_ROWS = (2 * SHIFTS[..., None] + np.arange(2)).reshape(4, 8)
"""Rows (4, 8) of the stacked corners of a detection, for each corner that may be the marking's first."""

_REPEATS = 2.8
"""Factor of a detection's covariance: an edge that shadow or wear misplaces stays so in the next images.

Errors of one corner correlate by about .2 from image to image (:mod:`v2hdm.mapping.site_model.places`); over
the ten frames that the filter remembers that is 1 + 9 x .2.
"""

_ITERATIONS = 3
"""Of an update; half a metre off at the first, a few millimetres at the third."""

_STEP = np.array([1e-4, 1e-4, 1e-5, 1e-5, 1e-5])
"""Steps of the differences by x, y, heading, roll, pitch: m and rad."""


@dataclass(frozen=True)
class Seen:
    """One detection: its class, camera, and corners (4, 2) with covariances (4, 2, 2) in pinhole pixels.

    ``informs`` (4,) says which corners say anything; a corner on a known line has a large sigma along it.
    """

    kind: str
    intrinsic: FloatArray
    cam_from_vehicle: FloatArray
    corners_px: FloatArray
    covariance_px: FloatArray
    informs: BoolArray


@dataclass(frozen=True)
class Match:
    """A detection and the marking of the map that it shows.

    ``rows`` (2 K,) of the detection's stacked corners, those that say anything, are the rows ``kept`` of the
    marking's. ``noise`` (2 K, 2 K) is the covariance of both, px^2.
    """

    marking: int
    seen: Seen
    rows: IntArray
    kept: BoolArray
    noise: FloatArray
    corners_map: FloatArray

    def against(self, mean: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The residual (2 K,), px, at a state (7,), and the derivative (2 K, 7) of what is expected."""
        expected, _ = _project(self.seen, mean[POSE], self.corners_map)
        derivative = _by_state(self.seen, mean, self.corners_map[None])[0]
        residual = self.seen.corners_px.reshape(8)[self.rows] - expected.reshape(8)[self.kept]
        return residual, derivative[self.kept]


class Markings:
    """The map's markings, to be looked up by place.

    Of their errors, what all share (drift, survey) shifts the vehicle with them: of variance ``shared_m2`` a
    coordinate, it is no noise between two of them.
    """

    def __init__(self, hd_map: HdMap) -> None:
        self._corners = np.stack([marking.corners_map for marking in hd_map.markings])
        total = np.stack([_covariance(marking) for marking in hd_map.markings])
        variance = np.einsum("nii->n", total) / 8
        own = np.array([marking.relative_sigma_m or np.inf for marking in hd_map.markings]) ** 2
        share = np.minimum(own / variance, 1.0)
        self._covariance = share[:, None, None] * total
        self.shared_m2 = float(np.median((1 - share) * variance))
        self._kind = np.array([marking.kind for marking in hd_map.markings])
        self._tree = cKDTree(self._corners.mean(axis=1))

    def match(self, seen: Seen, state: State) -> Match | None:
        """The one marking that fits a detection; None where none does, or more than one."""
        candidates = self._near(seen, state)
        if not len(candidates):
            return None
        corners = self._corners[candidates]
        expected, depth_m = _project(seen, state.mean[POSE], corners)
        derivative = _by_state(seen, state.mean, corners)
        informs = np.repeat(seen.informs, 2)
        fits: list[tuple[float, Match]] = []
        for row in np.flatnonzero(depth_m.min(axis=1) > 0).tolist():
            by_place = _by_place(seen, state.mean[POSE], corners[row])
            noise = by_place @ self._covariance[candidates[row]] @ by_place.T
            each = [
                self._fit(seen, state, SHIFT_ROWS[shift], informs, expected[row], derivative[row], noise)
                for shift in range(4)
            ]
            squared, worth, rows, kept, total = min(each, key=lambda one: one[1])
            if squared <= _GATE:
                fits.append((worth, Match(int(candidates[row]), seen, rows, kept, total, corners[row])))
        fits.sort(key=lambda one: one[0])
        if not fits or (len(fits) > 1 and fits[1][0] < fits[0][0] + _CLEARER_BY):
            return None
        return fits[0][1]

    @staticmethod
    def _fit(
        seen: Seen,
        state: State,
        order: IntArray,
        informs: BoolArray,
        expected: FloatArray,
        derivative: FloatArray,
        map_noise: FloatArray,
    ) -> tuple[float, float, IntArray, BoolArray, FloatArray]:
        """Squared distance, in sigmas, and less the log likelihood; rows, kept, noise of :class:`Match`."""
        kept = informs[order]
        rows = order[kept]
        noise = _REPEATS * _block(seen.covariance_px)[np.ix_(rows, rows)] + map_noise[np.ix_(kept, kept)]
        residual = seen.corners_px.reshape(8)[rows] - expected.reshape(8)[kept]
        slope = derivative[kept]
        total = noise + slope @ state.covariance @ slope.T
        squared = float(residual @ np.linalg.solve(total, residual))
        return squared, squared + float(np.linalg.slogdet(total)[1]), rows, kept, noise

    def _near(self, seen: Seen, state: State) -> IntArray:
        """The markings of its class that lie about where a detection seems to."""
        ground = _on_ground(seen, state.mean[POSE])
        if ground is None:
            return np.zeros(0, dtype=np.int64)
        reach_m = _LEAST_REACH_M + _REACH_SIGMAS * (
            state.sigma_m
            + float(np.sqrt(state.covariance[2, 2])) * float(np.linalg.norm(ground - state.mean[:2]))
        )
        near = np.array(sorted(self._tree.query_ball_point(ground, reach_m)), dtype=np.int64)
        return near[self._kind[near] == seen.kind] if len(near) else near


def update(state: State, match: Match) -> State:
    """The state after a match: a Kalman update, iterated as no projection is linear, in Joseph's form."""
    mean = state.mean
    for _ in range(_ITERATIONS):
        residual, slope = match.against(mean)
        innovation = slope @ state.covariance @ slope.T + match.noise
        gain = np.linalg.solve(innovation, slope @ state.covariance).T
        mean = state.mean + gain @ (residual - slope @ (state.mean - mean))
    left = np.eye(7) - gain @ slope
    covariance = left @ state.covariance @ left.T + gain @ match.noise @ gain.T
    return State(mean, (covariance + covariance.T) / 2)


def locate(state: State, seen: Sequence[Seen], markings: Markings) -> tuple[State, list[int]]:
    """The state after one frame's detections, and the markings matched.

    What only one marking explains is used first, near ones before far ones; then the rest is tried again
    with the better state.
    """
    matched: list[int] = []
    waiting = sorted(seen, key=lambda one: -float(one.corners_px[:, 1].max()))
    while waiting:
        later = []
        for one in waiting:
            match = markings.match(one, state)
            if match is None or match.marking in matched:
                later.append(one)
                continue
            state = update(state, match)
            matched.append(match.marking)
        if len(later) == len(waiting):
            break
        waiting = later
    return state, matched


def _covariance(marking: Marking) -> FloatArray:
    return np.eye(8) * _UNKNOWN_SIGMA_M**2 if marking.covariance_m2 is None else marking.covariance_m2


def _project(seen: Seen, pose: FloatArray, corners_map: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 4, 2) and depths (N, 4) of markings (N, 4, 2) from a pose (5,)."""
    cam_from_map = seen.cam_from_vehicle @ np.linalg.inv(pose_of(pose))
    pixels, depth_m = project_ground(seen.intrinsic, cam_from_map, corners_map.reshape(-1, 2))
    return pixels.reshape(*corners_map.shape[:-2], 4, 2), depth_m.reshape(*corners_map.shape[:-2], 4)


def _by_state(seen: Seen, mean: FloatArray, corners_map: FloatArray) -> FloatArray:
    """Derivative (N, 8, 7) of the pixels of markings (N, 4, 2) by a state (7,)."""
    out = np.zeros((len(corners_map), 8, 7))
    for column, step in zip(POSE, np.diag(_STEP), strict=True):
        up, _ = _project(seen, mean[POSE] + step, corners_map)
        down, _ = _project(seen, mean[POSE] - step, corners_map)
        out[:, :, column] = (up - down).reshape(-1, 8) / (2 * step.max())
    return out


def _by_place(seen: Seen, pose: FloatArray, corners_map: FloatArray) -> FloatArray:
    """Derivative (8, 8) of a marking's pixels by its corners in the map."""
    out = np.zeros((8, 8))
    step_m = 1e-4
    for axis in range(2):
        shift = step_m * np.eye(2)[axis]
        up, _ = _project(seen, pose, corners_map[None] + shift)
        down, _ = _project(seen, pose, corners_map[None] - shift)
        slope = (up - down)[0] / (2 * step_m)
        for corner in range(4):
            out[2 * corner : 2 * corner + 2, 2 * corner + axis] = slope[corner]
    return out


def _block(covariance_px: FloatArray) -> FloatArray:
    out = np.zeros((8, 8))
    for corner in range(4):
        part = slice(2 * corner, 2 * corner + 2)
        out[part, part] = covariance_px[corner]
    return out


def _on_ground(seen: Seen, pose: FloatArray) -> FloatArray | None:
    """Where on the ground (2,) the middle of the corners that say anything lies; None above the horizon."""
    middle = np.append(seen.corners_px[seen.informs].mean(axis=0), 1.0)
    map_from_cam = np.linalg.inv(seen.cam_from_vehicle @ np.linalg.inv(pose_of(pose)))
    ray = map_from_cam[:3, :3] @ np.linalg.solve(seen.intrinsic, middle)
    if ray[2] >= 0:
        return None
    return np.asarray((map_from_cam[:3, 3] - ray * map_from_cam[2, 3] / ray[2])[:2])
