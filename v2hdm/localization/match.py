"""Which marking of the map each detection shows, and what that says of the vehicle's state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import chi2

from v2hdm.geometry.ipm import homography_jacobian, pinhole_px_from_ground, project_ground
from v2hdm.geometry.quadrilateral import SHIFTS, align, block_diagonal
from v2hdm.geometry.rigid import inverse
from v2hdm.localization.motion import HEADING, POSE, State, pose_of
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

Errors of one corner correlate by about .2 from image to image (:mod:`v2hdm.site.candidates`); over
the ten frames that the filter remembers that is 1 + 9 x .2.
"""

_ITERATIONS = 3
"""Of an update; half a metre off at the first, a few millimetres at the third."""

_SETTLED = 1e-3
"""Change of a state, m or rad, after which the next iteration would change no pixel by a tenth."""

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
    """A detection and a marking of the map that it may show.

    ``rows`` (2 K,) of the detection's stacked corners, those that say anything, are the rows ``kept`` of the
    marking's. ``noise`` (2 K, 2 K) is the covariance of both, px^2.
    """

    seen: Seen
    rows: IntArray
    kept: BoolArray
    noise: FloatArray
    corners_map: FloatArray

    def against(self, mean: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The residual (2 K,), px, at a state (7,), and the derivative (2 K, 7) of what is expected."""
        expected = _project(self.seen, mean[POSE], self.corners_map)
        derivative = _by_state(self.seen, mean, self.corners_map)
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

    def match(self, seen: Seen, state: State) -> tuple[int, State] | None:
        """The one marking that fits a detection, and the state after it; None where not just one fits."""
        ground = _on_ground(seen, state.mean[POSE])
        known = seen.informs & np.isfinite(ground).all(axis=1)
        candidates = self._near(seen.kind, ground[known], state)
        if not len(candidates):
            return None
        corners = self._corners[candidates]
        shifts = align(corners, np.ones(corners.shape[:2], dtype=bool), ground, known).shift
        fits: list[tuple[float, int, State]] = []
        for marking, shift in zip(candidates.tolist(), shifts.tolist(), strict=True):
            pair = self._pair(seen, state, marking, SHIFT_ROWS[shift])
            if not np.isfinite(pair.noise).all():  # a corner is behind the camera
                continue
            after, squared, worth = fit(state, pair)
            if squared <= _GATE:
                fits.append((worth, marking, after))
        fits.sort(key=lambda one: one[0])
        if not fits or (len(fits) > 1 and fits[1][0] < fits[0][0] + _CLEARER_BY):
            return None
        return fits[0][1:]

    def _pair(self, seen: Seen, state: State, marking: int, order: IntArray) -> Match:
        kept = np.repeat(seen.informs, 2)[order]
        rows, corners = order[kept], self._corners[marking]
        by_place = _by_place(seen, state.mean[POSE], corners)[kept]
        noise = _REPEATS * block_diagonal(seen.covariance_px[None])[0][np.ix_(rows, rows)]
        return Match(seen, rows, kept, noise + by_place @ self._covariance[marking] @ by_place.T, corners)

    def _near(self, kind: str, ground: FloatArray, state: State) -> IntArray:
        """The markings of a class that lie about where corners (K, 2) seem to."""
        if not len(ground):
            return np.zeros(0, dtype=np.int64)
        middle = ground.mean(axis=0)
        arm_m = float(np.linalg.norm(middle - state.mean[:2]))
        turned_m = arm_m * float(np.sqrt(state.covariance[HEADING, HEADING]))
        reach_m = _LEAST_REACH_M + _REACH_SIGMAS * (state.sigma_m + turned_m)
        near = np.array(sorted(self._tree.query_ball_point(middle, reach_m)), dtype=np.int64)
        return near[self._kind[near] == kind] if len(near) else near


def fit(state: State, match: Match) -> tuple[State, float, float]:
    """The state after a match, its squared distance, in sigmas, and that less twice the log likelihood.

    A Kalman update in Joseph's form, iterated as no projection is linear: the distance is what is left of
    pixels and state where both are best.
    """
    mean, squared = state.mean, np.inf
    for _ in range(_ITERATIONS):
        residual, slope = match.against(mean)
        innovation = slope @ state.covariance @ slope.T + match.noise
        off = residual - slope @ (state.mean - mean)
        weighed = np.linalg.solve(innovation, off)
        squared = float(off @ weighed)
        before, mean = mean, state.mean + state.covariance @ slope.T @ weighed
        if np.abs(mean - before)[POSE].max() < _SETTLED:
            break
    gain = np.linalg.solve(innovation, slope @ state.covariance).T
    left = np.eye(7) - gain @ slope
    covariance = left @ state.covariance @ left.T + gain @ match.noise @ gain.T
    if not np.isfinite(squared):
        squared = np.inf
    return (
        State(mean, (covariance + covariance.T) / 2),
        squared,
        squared + float(np.linalg.slogdet(innovation)[1]),
    )


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
            found = markings.match(one, state)
            if found is None or found[0] in matched:
                later.append(one)
                continue
            matched.append(found[0])
            state = found[1]
        if len(later) == len(waiting):
            break
        waiting = later
    return state, matched


def _covariance(marking: Marking) -> FloatArray:
    return np.eye(8) * _UNKNOWN_SIGMA_M**2 if marking.covariance_m2 is None else marking.covariance_m2


def _project(seen: Seen, pose: FloatArray, corners_map: FloatArray) -> FloatArray:
    """Pixels (..., 4, 2) of a marking (4, 2) from poses (..., 5)."""
    cam_from_map = seen.cam_from_vehicle @ inverse(pose_of(pose))
    return project_ground(seen.intrinsic, cam_from_map, corners_map)[0]


def _by_state(seen: Seen, mean: FloatArray, corners_map: FloatArray) -> FloatArray:
    """Derivative (8, 7) of the pixels of a marking (4, 2) by a state (7,), by central differences."""
    steps = np.diag(_STEP)
    pixels = _project(seen, mean[POSE] + np.concatenate([steps, -steps]), corners_map).reshape(10, 8)
    out = np.zeros((8, 7))
    out[:, POSE] = ((pixels[:5] - pixels[5:]) / (2 * _STEP[:, None])).T
    return out


def _by_place(seen: Seen, pose: FloatArray, corners_map: FloatArray) -> FloatArray:
    """Derivative (8, 8) of a marking's pixels by its corners in the map."""
    pixels_from_map = pinhole_px_from_ground(seen.intrinsic, seen.cam_from_vehicle @ inverse(pose_of(pose)))
    return np.asarray(block_diagonal(homography_jacobian(pixels_from_map, corners_map)[None])[0])


def _on_ground(seen: Seen, pose: FloatArray) -> FloatArray:
    """Where on the ground a detection's corners (4, 2) lie; nan above the horizon."""
    map_from_cam = pose_of(pose) @ inverse(seen.cam_from_vehicle)
    pixels = np.column_stack([seen.corners_px, np.ones(4)])
    rays = np.linalg.solve(seen.intrinsic, pixels.T).T @ map_from_cam[:3, :3].T
    down = np.where(rays[:, 2:] < 0, rays[:, 2:], np.nan)
    return np.asarray((map_from_cam[:3, 3] - rays * map_from_cam[2, 3] / down)[:, :2])
