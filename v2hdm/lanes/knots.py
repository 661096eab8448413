"""Lanes in the adjustment: cubic splines with unknown knots, observed as lines through them.

A lane is a Catmull-Rom spline, which interpolates its knots: a piece of paint near a knot observes one point
of the line. That observation is a corner's, but with information of rank one: the position along the line is
unobserved. Nor is it unknown, as a prior holds knots along their line and they move across it alone.
Elimination, robust loss and covariance are the corners'.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from v2hdm.adjust import ControlPoints, Observations, Solution
from v2hdm.association.ground import ground_points, ground_points_with_jacobian
from v2hdm.association.sightings import Rig, frames_of
from v2hdm.geometry.planar import length_along
from v2hdm.lanes.lines import map_lanes
from v2hdm.lanes.points import (
    CENTRE_SIGMA_PX,
    HALF_WIDTH_M,
    NODE_SPACING_M,
    SAME_DIRECTION,
    ImageGround,
    LaneCloud,
    collect_lane_points,
    ground_by_rig,
)
from v2hdm.records import Drive, FloatArray, ImageDetections, IntArray, Lane
from v2hdm.site.options import LaneOptions
from v2hdm.surface.surface import Surface

_log = logging.getLogger(__name__)

_SPACING_M = 2.0  # spacing of knots, m: on a turn of 8 m radius the spline is a millimetre off the circle
_HELD_M = 0.01  # sigma, m, of a knot along its line, which nothing observes
OPEN_END_PX = 1000.0  # sigma, px, along its line of an observation that is no point: anywhere
_SLOPE_SIGMA = 0.02  # sigma of the angle between a piece of paint and its lane, rad
_LINE_SIGMA_M = 0.0015
"""Sigma, m, of a whole line in one image, by port 2's truth; without it 87 % lie within their 95 %."""

_MEDIAN_SQUARED = 0.455  # median of a chi-square distribution with one degree of freedom
_TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])  # (N, 2) directions times it are rotated to the left


@dataclass(frozen=True)
class Knots:
    """Knots of lanes, and observations of lines through them."""

    lanes: tuple[Lane, ...]  # as drawn after the adjustment without them
    # Of N knots:
    lane: IntArray  # (N,) index of the lane
    at_m: FloatArray  # (N,) arc length along it
    points_map: FloatArray  # (N, 2) m
    along: FloatArray  # (N, 2) unit direction of the lane
    unknown: IntArray  # (N,) index among the sufficiently observed knots, -1 for others
    # Of K observations:
    camera: IntArray  # (K,)
    frame: IntArray  # (K,)
    knot: IntArray  # (K,) index of the knot among the sufficiently observed ones
    pinhole_px: FloatArray  # (K, 2)
    row_share: FloatArray  # (K,) read-out time of the row
    line: FloatArray  # (K, 2) direction of the line in the image
    variance_px2: FloatArray  # (K,) across the line

    @property
    def count(self) -> int:
        """Number of knots that are unknowns of the adjustment."""
        return int(self.unknown.max(initial=-1)) + 1

    def observations(self, first: int) -> Observations:
        """As observations of corners numbered from ``first``; cameras and frames are the rig's."""
        normal = self.line @ _TURN
        variance_px2 = self.variance_px2[:, None, None]
        covariance_px = variance_px2 * normal[:, :, None] * normal[:, None]
        covariance_px += OPEN_END_PX**2 * self.line[:, :, None] * self.line[:, None]
        at = first + self.knot
        return Observations(self.camera, self.frame, at, self.pinhole_px, covariance_px, self.row_share)

    def held(self, first: int) -> ControlPoints:
        """The prior that holds corners numbered from ``first`` along their lines."""
        is_unknown = self.unknown >= 0
        sigma_m = np.tile([_HELD_M, np.inf], (self.count, 1))
        return ControlPoints(
            first + self.unknown[is_unknown], self.points_map[is_unknown], sigma_m, self.along[is_unknown]
        )


def find_knots(
    drive: Drive,
    detections: Sequence[ImageDetections],
    cameras: Sequence[str],
    rig: Rig,
    surface: Surface | None,
    options: LaneOptions,
) -> Knots | None:
    """Knots along a drive's lanes under ``rig``, which is over ``cameras``; None without any."""
    ground = ground_by_rig(drive, cameras, rig, surface)
    jitter_rad = drive.pose_noise.roll_pitch_rad
    cloud = collect_lane_points(drive, detections, ground, options.max_range_m, jitter_rad)
    lanes = map_lanes(cloud, options)
    if not lanes:
        return None
    course = _Course.of(lanes)
    px_from_map = np.asarray(np.linalg.inv(ground.map_from_pinhole_px))
    knots = course.knots
    passing = _passing(cloud, ground, course, px_from_map, _pairs(cloud, course, px_from_map))
    enough = np.bincount(passing.knot, minlength=len(knots.lane)) >= max(options.min_images, 2)
    unknown = np.where(enough, np.cumsum(enough) - 1, -1)
    alone = np.flatnonzero(np.bincount(knots.lane[enough], minlength=len(lanes)) == 0)
    if len(alone):
        x_m, y_m = lanes[alone[0]].points_map[0]
        _log.warning(
            "%d of %d lane lines are not in the adjustment, the first at (%.1f, %.1f): too few images "
            "show any one place of them; drive past once more, or lower mapping.lanes.min_images",
            len(alone), len(lanes), x_m, y_m,
        )  # fmt: skip
    names = list(cameras)
    camera = np.array([names.index(i.camera) if i.camera in names else -1 for i in drive.images])
    is_observed = enough[passing.knot]
    image = passing.image[is_observed]
    return Knots(
        lanes=lanes,
        lane=knots.lane,
        at_m=knots.at_m,
        points_map=knots.points_map,
        along=knots.along,
        unknown=unknown,
        camera=camera[image],
        frame=frames_of(drive).frame_of_image[image],
        knot=unknown[passing.knot[is_observed]],
        pinhole_px=passing.pinhole_px[is_observed],
        row_share=passing.row_share[is_observed],
        line=passing.line[is_observed],
        variance_px2=passing.variance_px2[is_observed],
    )


class _CourseKnots(NamedTuple):
    """N knots, evenly spaced along their lanes."""

    lane: IntArray  # (N,) index of the lane
    at_m: FloatArray  # (N,) arc length along it
    points_map: FloatArray  # (N, 2) m
    along: FloatArray  # (N, 2) unit direction of the lane


@dataclass(frozen=True)
class _Course:
    """Lanes as polylines by arc length: ``arc_m`` (V,) of ``points_map`` (V, 2), lanes one metre apart."""

    arc_m: FloatArray
    points_map: FloatArray
    begin_m: FloatArray
    length_m: FloatArray

    @classmethod
    def of(cls, lanes: Sequence[Lane]) -> _Course:
        arcs = [length_along(lane.points_map) for lane in lanes]
        length_m = np.array([arc[-1] for arc in arcs])
        begin_m = np.cumsum(length_m + 1.0) - length_m
        arc_m = np.concatenate([arc + begin for arc, begin in zip(arcs, begin_m, strict=True)])
        return cls(arc_m, np.concatenate([lane.points_map for lane in lanes]), begin_m, length_m)

    @cached_property
    def knots(self) -> _CourseKnots:
        """The knots of all lanes."""
        count = np.maximum(np.round(self.length_m / _SPACING_M), 1).astype(np.int64) + 1
        at_m = np.concatenate(
            [np.linspace(0.0, length, n) for length, n in zip(self.length_m, count, strict=True)]
        )
        lane = np.repeat(np.arange(len(count)), count)
        return _CourseKnots(lane, at_m, self.at(lane, at_m), self.along(lane, at_m))

    def at(self, lane: IntArray, at_m: FloatArray) -> FloatArray:
        """Points (N, 2) at arc lengths (N,) of lanes (N,)."""
        arc_m = self.begin_m[lane] + np.clip(at_m, 0.0, self.length_m[lane])
        return np.column_stack([np.interp(arc_m, self.arc_m, axis) for axis in self.points_map.T])

    def along(self, lane: IntArray, at_m: FloatArray) -> FloatArray:
        """Unit directions (N, 2) there."""
        at_m = np.clip(at_m, 0.0, self.length_m[lane])
        ahead, behind = (self.at(lane, at_m + sign * _SPACING_M / 2) for sign in (1, -1))
        return np.asarray((ahead - behind) / np.linalg.norm(ahead - behind, axis=1, keepdims=True))


class _LineImage(NamedTuple):
    """Images of lines on the ground at N points."""

    line: FloatArray  # (N, 2) unit direction in the image
    px_by_ahead: FloatArray  # (N,) px/m, along the line, of a motion ahead
    px_by_left: FloatArray  # (N, 2) px/m, along and across the line, of a motion to the left


def _image_of(px_from_map: FloatArray, points_map: FloatArray, along: FloatArray) -> _LineImage:
    """Images of the lines through ground points (N, 2) in the directions ``along`` (N, 2)."""
    _, px_by_map = ground_points_with_jacobian(px_from_map, points_map[:, None])
    ahead = (px_by_map[:, 0] @ along[..., None])[..., 0]
    px_by_ahead = np.linalg.norm(ahead, axis=1)
    line = ahead / px_by_ahead[:, None]
    left = (px_by_map[:, 0] @ (along @ _TURN)[..., None])[..., 0]
    px_by_left = np.column_stack([(line * left).sum(axis=1), (line @ _TURN * left).sum(axis=1)])
    return _LineImage(line, px_by_ahead, px_by_left)


class _Pairs(NamedTuple):
    """P points of a cloud, each with the nearest knot within half a spacing.

    Ahead is the foot of the point on its line, in the image: a point's own place along the line depends on
    its error across it, and so would the choice of points at the ends of a piece.
    """

    point: IntArray  # (P,)
    knot: IntArray  # (P,)
    ahead_m: FloatArray  # (P,) offset from the knot along the line
    off_m: FloatArray  # (P,) offset to the left of the line


def _pairs(cloud: LaneCloud, course: _Course, px_from_map: FloatArray) -> _Pairs:
    """The points of ``cloud`` that belong to knots."""
    lane, at_m, knots_map, along = course.knots
    reach_m = float(np.hypot(_SPACING_M, HALF_WIDTH_M))
    neighbours = cKDTree(cloud.points_map).sparse_distance_matrix(
        cKDTree(knots_map), reach_m, output_type="ndarray"
    )
    point = neighbours["i"].astype(np.int64)
    knot = neighbours["j"].astype(np.int64)
    points_map = cloud.points_map[point]
    ahead_m = ((points_map - knots_map[knot]) * along[knot]).sum(axis=1)
    foot_m = at_m[knot] + ahead_m
    foot_map = course.at(lane[knot], foot_m)
    off_m = ((points_map - foot_map) * (course.along(lane[knot], foot_m) @ _TURN)).sum(axis=1)
    line_image = _image_of(px_from_map[cloud.image[point]], foot_map, along[knot])
    ahead_m += off_m * line_image.px_by_left[:, 0] / line_image.px_by_ahead
    fits = np.abs((cloud.tangent[point] * along[knot]).sum(axis=1)) >= SAME_DIRECTION
    fits &= (np.abs(ahead_m) <= _SPACING_M / 2) & (np.abs(off_m) <= HALF_WIDTH_M)
    order = np.lexsort((np.abs(off_m), ~fits, point))
    best = order[np.unique(point[order], return_index=True)[1]]
    best = best[fits[best]]
    return _Pairs(point[best], knot[best], ahead_m[best], off_m[best])


class _Passing(NamedTuple):
    """K observations of lines that pass through knots."""

    image: IntArray  # (K,) image index
    knot: IntArray  # (K,) index among all knots
    pinhole_px: FloatArray  # (K, 2) of a point of the line beside the knot
    row_share: FloatArray  # (K,) read-out time of its row
    line: FloatArray  # (K, 2) direction of the line in the image
    variance_px2: FloatArray  # (K,) across the line


def _passing(
    cloud: LaneCloud, ground: ImageGround, course: _Course, px_from_map: FloatArray, pairs: _Pairs
) -> _Passing:
    """Observe the lines of ``pairs`` at their knots.

    A line is fitted to the points of a piece; their scatter about it gives their variance. Directions and
    weights are the course's: those of the points would be correlated with their errors, which turns the
    camera.
    """
    lane, _, knots_map, along = course.knots
    point, knot, ahead_m, off_m = pairs
    groups, group = np.unique(np.column_stack([cloud.image[point], knot]), axis=0, return_inverse=True)
    image, knot_of_group = groups.T
    group = group.ravel()
    foot_map = knots_map[knot] + ahead_m[:, None] * along[knot]
    line_image = _image_of(px_from_map[cloud.image[point]], foot_map, along[knot])
    weight = line_image.px_by_left[:, 1] ** 2

    def total(values: FloatArray) -> FloatArray:
        return np.bincount(group, weight * values, len(groups)).astype(np.float64)

    w, x, y, xy = (total(values) for values in (np.ones(len(group)), ahead_m, off_m, ahead_m * off_m))
    xx = total(ahead_m**2) + (CENTRE_SIGMA_PX / _SLOPE_SIGMA) ** 2
    left_m = (xx * y - x * xy) / (w * xx - x**2)
    slope = (w * xy - x * y) / (w * xx - x**2)
    off_px2 = weight * (off_m - left_m[group] - slope[group] * ahead_m) ** 2
    points = np.bincount(group)[group]
    free = points > 2
    scatter_px2 = off_px2[free] * points[free] / (points[free] - 2)
    point_px2 = np.median(scatter_px2) / _MEDIAN_SQUARED if free.any() else CENTRE_SIGMA_PX**2
    row_share = np.bincount(group, cloud.row_share[point]) / np.bincount(group)
    shown_map = knots_map[knot_of_group] + left_m[:, None] * (along[knot_of_group] @ _TURN)
    shown_map -= ground.at_rows(shown_map, image, row_share) - shown_map
    shown_px = ground_points(px_from_map[image], shown_map[:, None])[:, 0]
    line_image = _image_of(px_from_map[image], knots_map[knot_of_group], along[knot_of_group])
    across_px_by_left = line_image.px_by_left[:, 1]
    variance_px2 = point_px2 * across_px_by_left**2 * xx / (w * xx - x**2)
    # What all of a line in an image has in common counts once in its mean, so as many times in each knot.
    of_line = np.unique(np.column_stack([image, lane[knot_of_group]]), axis=0, return_inverse=True)[1].ravel()
    variance_px2 += np.bincount(of_line)[of_line] * (_LINE_SIGMA_M * across_px_by_left) ** 2
    return _Passing(image, knot_of_group, shown_px, row_share, line_image.line, variance_px2)


def draw_lanes(knots: Knots, solution: Solution, spacing_m: float = NODE_SPACING_M) -> tuple[Lane, ...]:
    """The lanes as splines through adjusted knots, with vertices about ``spacing_m`` apart and their sigmas.

    Between dashes, lines are the mean of their course before the adjustment, moved with the knots around,
    and of a natural spline; half the difference of the two is part of the sigma.
    """
    return tuple(
        _drawn(lane, knots, np.flatnonzero(knots.lane == number), solution, spacing_m)
        for number, lane in enumerate(knots.lanes)
    )


def _drawn(lane: Lane, knots: Knots, rows: IntArray, solution: Solution, spacing_m: float) -> Lane:
    """One lane with the knots ``rows``; unchanged if none of them is an unknown."""
    observed = np.flatnonzero(knots.unknown[rows] >= 0)
    if not len(observed):
        return lane
    corner = len(solution.corners_map) - knots.count + knots.unknown[rows[observed]]
    at_m = knots.at_m[rows]
    points_map = knots.points_map[rows]
    left = knots.along[rows] @ _TURN
    vertex_m = np.linspace(0.0, at_m[-1], max(round(float(at_m[-1]) / spacing_m), 1) + 1)
    by_knot = _catmull_rom(at_m, vertex_m)
    by_observed = _between(at_m[observed], at_m)
    moved_m = ((solution.corners_map[corner] - points_map[observed]) * left[observed]).sum(axis=1)
    drawn_map = by_knot @ (points_map + (by_observed @ moved_m)[:, None] * left)
    along = np.gradient(drawn_map, axis=0)
    left = along / np.linalg.norm(along, axis=1, keepdims=True) @ _TURN
    half_m = np.zeros(len(vertex_m))
    inner = (vertex_m >= at_m[observed[0]]) & (vertex_m <= at_m[observed[-1]])
    if len(observed) > 1:
        smooth = CubicSpline(at_m[observed], solution.corners_map[corner], bc_type="natural")
        half_m[inner] = ((smooth(vertex_m[inner]) - drawn_map[inner]) * left[inner]).sum(axis=1) / 2
    # A vertex depends on at most four neighbouring knots: their joint covariances suffice.
    weight = (by_knot @ by_observed).tocsr()
    weight.sort_indices()
    begin = np.minimum(weight.indices[weight.indptr[:-1]], max(len(observed) - 4, 0))
    begins, group = np.unique(begin, return_inverse=True)
    window = np.minimum(begins[:, None] + np.arange(4), len(observed) - 1)
    share = weight[np.arange(len(vertex_m))[:, None], window[group]].toarray()
    share[:, len(observed) :] = 0.0
    by_corner = (share[:, :, None] * left[:, None]).reshape(-1, 8)
    joint = solution.corner_covariance(corner[window])[group] * solution.variance_scale
    variance_m2 = np.einsum("vi,vij,vj->v", by_corner, joint, by_corner) + half_m**2
    return replace(lane, points_map=drawn_map + half_m[:, None] * left, sigma_m=np.sqrt(variance_m2))


def _between(at_m: FloatArray, places_m: FloatArray) -> csr_array:
    """Weights (M, N) of N ascending positions at M ``wanted_m``: linear, constant beyond the ends."""
    number = np.interp(places_m, at_m, np.arange(len(at_m)))
    low = np.minimum(number.astype(np.int64), max(len(at_m) - 2, 0))
    high = np.minimum(low + 1, len(at_m) - 1)
    row = np.tile(np.arange(len(places_m)), 2)
    value = np.concatenate([1 - (number - low), number - low])
    return csr_array((value, (row, np.concatenate([low, high]))), shape=(len(places_m), len(at_m)))


def _catmull_rom(at_m: FloatArray, places_m: FloatArray) -> csr_array:
    """Weights (M, N) of N evenly spaced knots at M arc lengths of the Catmull-Rom spline through them."""
    last = len(at_m) - 1
    number = places_m / (at_m[1] - at_m[0])
    low = np.clip(number.astype(np.int64), 0, last - 1)
    t = number - low
    value = 0.5 * np.array(
        [-t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3, t + 4 * t**2 - 3 * t**3, t**3 - t**2]
    )
    knot = low + np.arange(-1, 3)[:, None]
    # Extrapolates the curvature at the ends, P_-1 = 3 P_0 - 3 P_1 + P_2; a straight line for two knots.
    beyond = np.array([3.0, -3.0, 1.0] if last > 1 else [2.0, -1.0, 0.0])
    before = knot[0] < 0
    after = knot[3] > last
    value[1:, before] += beyond[:, None] * value[0, before]
    value[2::-1, after] += beyond[:, None] * value[3, after]
    value[0, before] = 0.0
    value[3, after] = 0.0
    row = np.broadcast_to(np.arange(len(places_m)), knot.shape)
    column = np.clip(knot, 0, last)
    return csr_array((value.ravel(), (row.ravel(), column.ravel())), shape=(len(places_m), len(at_m)))
