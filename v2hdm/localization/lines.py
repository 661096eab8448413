"""The solid lines of a map, and what pieces of them in an image say of the place across them.

A piece of a line in an image tells its distance and its direction, not where along the line it is. Its points
are wrong together over some metres; the map's line is wrong by the same in every image. The former is in the
covariance of the points, the latter a state: each stretch of a line has an error at either end.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import cross, length_along, turned_left
from v2hdm.localization.belief import CAMERA, VEHICLE, Belief, with_markings
from v2hdm.localization.joint import Scene, largest_square
from v2hdm.localization.observation import Observation, Taken, take
from v2hdm.localization.seeing import expect_points, ground_points
from v2hdm.records import LANE_LINE, UNSTATED_SIGMA_M, BoolArray, FloatArray, HDMap, IntArray, Lane

_STRETCH_M = 20.0  # longest stretch, m, whose error across runs straight from end to end
_ALIKE = 0.5  # correlation of the errors of a stretch's ends
_PAINT_M = 0.005  # standard deviation, m, of what wear and dirt shift a line's centre by in all images
# Errors of the points of a piece across it, as 150 pieces on renders show (port 2 with words): 0.1 to 0.5 px,
# and alike over some metres.
_POINT_PX = 0.5  # standard deviation, px
_POINT_ALIKE_M = 2.0  # distance, m, over which the errors of neighbouring points are alike
_POINT_ALONE_PX = 0.1  # standard deviation, px, of what each point has alone
_LEAST_M = 2.5  # length, m, from which a piece has a direction
_LEAST_POINTS = 4  # and its points
_RANGE_M = 28.0  # distance, m, of the lines that are looked for
_REACH_M = 1.0  # distance, m, of a piece from a line that it may show
_REACH_SIGMAS = 4.0  # in sigmas of the place, beside
_STEP_M = 1e-6  # least length, m, of a segment


class Feet(NamedTuple):
    """For points (P) the nearest ones on a line."""

    points_map: FloatArray  # (P, 3)
    left: FloatArray  # (P, 2) unit vectors to the line's left
    stretch: IntArray  # (P,) its feature's number
    share: FloatArray  # (P,) of the way from the stretch's begin to its end
    beside_m: FloatArray  # (P,) how far the points lie to the left
    is_beside: BoolArray  # (P,) not beyond the line's ends

    def subset(self, rows: BoolArray) -> Feet:
        """The feet of some of the points."""
        return Feet(
            self.points_map[rows],
            self.left[rows],
            self.stretch[rows],
            self.share[rows],
            self.beside_m[rows],
            self.is_beside[rows],
        )


class LineMap:
    """The solid lines of a map in stretches, which are features numbered from ``first`` on.

    ``shared_m2`` is the variance of what all of the map's errors share: a vehicle shifts with it.
    """

    def __init__(self, hd_map: HDMap, shared_m2: float, first: int) -> None:
        painted = [line for lane in hd_map.lanes for line in lane.painted]
        lines = [line for line in painted if line.kind == LANE_LINE and len(line.points_map) > 1]
        self.first = first
        self._begin: FloatArray = np.zeros((0, 3))
        self._end: FloatArray = np.zeros((0, 3))
        self._line: IntArray = np.zeros(0, dtype=np.int64)
        self._stretch: IntArray = np.zeros(0, dtype=np.int64)
        self._shares: FloatArray = np.zeros((0, 2))
        self._is_end: BoolArray = np.zeros((0, 2), dtype=bool)  # whether the line ends there
        self._variance_m2: list[float] = []
        for number, line in enumerate(lines):
            self._add(line, number, shared_m2)
        count = len(self._variance_m2)
        middles = (self._begin + self._end)[:, :2] / 2
        of_stretch = [middles[self._stretch == stretch] for stretch in range(count)]
        self._centres = np.array([points.mean(axis=0) for points in of_stretch]).reshape(-1, 2)

    def __len__(self) -> int:
        return len(self._variance_m2)

    def _add(self, line: Lane, number: int, shared_m2: float) -> None:
        heights_m = np.zeros(len(line.points_map)) if line.heights_m is None else line.heights_m
        points = np.column_stack([line.points_map, heights_m])
        way_m = length_along(line.points_map)
        pieces = max(1, int(np.ceil(way_m[-1] / _STRETCH_M)))
        length_m = max(way_m[-1], _STEP_M) / pieces
        middle_m = (way_m[:-1] + way_m[1:]) / 2
        stretch = np.minimum((middle_m / length_m).astype(np.int64), pieces - 1)
        shares = np.column_stack([way_m[:-1], way_m[1:]]) / length_m - stretch[:, None]
        is_end = np.zeros((len(stretch), 2), dtype=bool)
        is_end[0, 0] = is_end[-1, 1] = True
        sigma_m = np.full(len(points), UNSTATED_SIGMA_M) if line.sigma_m is None else line.sigma_m
        used, stretch = np.unique(stretch, return_inverse=True)
        self._stretch = np.concatenate([self._stretch, stretch + len(self)])
        for of_stretch in range(len(used)):
            total_m2 = float(np.median(sigma_m[1:][stretch == of_stretch] ** 2))
            self._variance_m2.append(max(total_m2 - shared_m2, 0.0) + _PAINT_M**2)
        self._begin = np.concatenate([self._begin, points[:-1]])
        self._end = np.concatenate([self._end, points[1:]])
        self._line = np.concatenate([self._line, np.full(len(points) - 1, number)])
        self._shares = np.concatenate([self._shares, shares])
        self._is_end = np.concatenate([self._is_end, is_end])

    def prior(self, feature: int) -> FloatArray:
        """The covariance (2, 2) of the errors across of both ends of a stretch."""
        return self._variance_m2[feature - self.first] * np.array([[1.0, _ALIKE], [_ALIKE, 1.0]])

    def near(self, place_map: FloatArray, radius_m: float) -> IntArray:
        """The segments of stretches within a distance of a place."""
        if not len(self):
            return np.zeros(0, dtype=np.int64)
        is_near = np.linalg.norm(self._centres - place_map, axis=1) < radius_m + _STRETCH_M / 2
        return np.flatnonzero(is_near[self._stretch])

    def feet(self, points_map: FloatArray, segments: IntArray) -> dict[int, Feet]:
        """For points (P, 2) the nearest ones on each line that some segments belong to, by its number."""
        begin = self._begin[segments]
        along = self._end[segments] - begin
        length2_m2 = np.maximum((along[:, :2] ** 2).sum(axis=1), _STEP_M**2)
        from_begin = points_map[:, None] - begin[None, :, :2]
        share = (from_begin * along[None, :, :2]).sum(axis=2) / length2_m2
        inside = np.clip(share, 0.0, 1.0)
        distance_m = np.linalg.norm(from_begin - inside[..., None] * along[None, :, :2], axis=2)
        points = np.arange(len(points_map))
        out = {}
        for line in np.unique(self._line[segments]).tolist():
            on_line = np.flatnonzero(self._line[segments] == line)
            nearest = on_line[distance_m[:, on_line].argmin(axis=1)]
            of_segment = segments[nearest]
            at = inside[points, nearest]
            ahead = along[nearest, :2] / np.sqrt(length2_m2[nearest])[:, None]
            is_before = (share[points, nearest] < 0) & self._is_end[of_segment, 0]
            is_behind = (share[points, nearest] > 1) & self._is_end[of_segment, 1]
            low, high = self._shares[of_segment].T
            out[line] = Feet(
                points_map=begin[nearest] + at[:, None] * along[nearest],
                left=turned_left(ahead),
                stretch=self.first + self._stretch[of_segment],
                share=low + at * (high - low),
                beside_m=cross(ahead, from_begin[points, nearest]),
                is_beside=~(is_before | is_behind),
            )
        return out


def with_lines(belief: Belief, scene: Scene, line_map: LineMap, pieces_px: Sequence[FloatArray]) -> Taken:
    """The belief after pieces of lines (P, 2) in an image, pinhole px, each on the line that it shows."""
    segments = line_map.near(belief.mean[:2], _RANGE_M)
    if not len(segments) or not pieces_px:
        return Taken(belief, ())
    reach_m = _REACH_M + _REACH_SIGMAS * belief.sigma_m
    pose = belief.map_from_vehicle(scene.plane)
    candidates: list[tuple[int, int, FloatArray, Feet]] = []
    for number, points_px in enumerate(pieces_px):
        points_map = ground_points(points_px, pose, scene.plane, scene.calibration)
        is_near = np.linalg.norm(points_map - belief.mean[:2], axis=1) < _RANGE_M  # not where that is nan
        if not is_near.any():
            continue
        for line, feet in line_map.feet(points_map[is_near], segments).items():
            is_used = feet.is_beside
            near_feet = feet.subset(is_used)
            if is_used.sum() < _LEAST_POINTS or np.abs(near_feet.beside_m).mean() > reach_m:
                continue
            candidates.append((number, line, points_px[is_near][is_used], near_feet))
    features = sorted({int(stretch) for *_, feet in candidates for stretch in feet.stretch})
    unheld = [feature for feature in features if feature not in belief.markings]
    held = with_markings(belief, unheld, [line_map.prior(feature) for feature in unheld])
    observations = [_observed(held, scene, *candidate) for candidate in candidates]
    update = take(held, [observation for observation in observations if observation is not None])
    return update if update.observations else Taken(belief, ())


def _observed(
    belief: Belief, scene: Scene, piece: int, line: int, points_px: FloatArray, feet: Feet
) -> Observation | None:
    """The distance, m, and direction, rad, of a piece from a line; None where it is no straight part of it.

    Both are fitted to the points in the image, whose errors are known there.
    """
    error_m = _line_errors(belief, feet)
    on_line = feet.points_map.copy()
    on_line[:, :2] += error_m[:, None] * feet.left
    expected = expect_points(belief, scene.plane, scene.camera, scene.calibration, on_line)
    along_m = length_along(on_line[:, :2])
    if not np.isfinite(expected.px).all() or along_m[-1] < _LEAST_M:
        return None
    ahead_px = (expected.by_place @ -turned_left(feet.left)[..., None])[..., 0]
    left_px = (expected.by_place @ feet.left[..., None])[..., 0]
    across = turned_left(ahead_px) / np.linalg.norm(ahead_px, axis=1, keepdims=True)
    px_by_m = (across * left_px).sum(axis=1)
    from_middle_m = along_m - along_m.mean()
    basis = px_by_m[:, None] * np.column_stack([np.ones(len(along_m)), from_middle_m])
    apart_m = np.abs(along_m[:, None] - along_m)
    noise_px2 = _POINT_PX**2 * np.exp(-apart_m / _POINT_ALIKE_M) + _POINT_ALONE_PX**2 * np.eye(len(along_m))
    weighted = np.linalg.solve(noise_px2, basis)
    noise = np.linalg.inv(basis.T @ weighted)
    gain = noise @ weighted.T
    residual_px = (across * (points_px - expected.px)).sum(axis=1)
    residual = gain @ residual_px
    left_over = residual_px - basis @ residual
    misfit = float(left_over @ np.linalg.solve(noise_px2, left_over))
    if misfit > largest_square(np.array(len(along_m) - 2.0)):
        return None
    by_states = (across[:, None] @ expected.by_states)[:, 0]
    slope = _spread(belief, scene, feet, by_states[:, :VEHICLE], px_by_m)
    begin = VEHICLE + CAMERA * scene.camera
    slope += by_states[:, VEHICLE:] @ belief.root[begin : begin + CAMERA]
    features = tuple(sorted({int(stretch) for stretch in feet.stretch}))
    return Observation(piece, line, residual, noise, gain @ slope, features)


def _line_errors(belief: Belief, feet: Feet) -> FloatArray:
    """How far to the left (P,), m, a line is believed to be of where the map has it."""
    error_m = np.zeros(len(feet.stretch))
    for stretch in np.unique(feet.stretch).tolist():
        state = belief.state_of(stretch)
        is_on = feet.stretch == stretch
        if state is not None:
            begin_m, end_m = belief.mean[state : state + 2]
            error_m[is_on] = begin_m + feet.share[is_on] * (end_m - begin_m)
    return error_m


def _spread(
    belief: Belief, scene: Scene, feet: Feet, by_vehicle: FloatArray, px_by_m: FloatArray
) -> FloatArray:
    """The derivative (P, n) of the points' places across by the whitened states, but for the camera's."""
    out = by_vehicle @ belief.root[:VEHICLE]
    for stretch in np.unique(feet.stretch).tolist():
        state = belief.state_of(stretch)
        is_on = feet.stretch == stretch
        if state is not None:
            shares = np.column_stack([1 - feet.share[is_on], feet.share[is_on]])
            out[is_on] += px_by_m[is_on, None] * (shares @ belief.root[state : state + 2])
    return np.asarray(out)
