"""Test whether candidates lie on the ground, by their parallax as the vehicle moves.

Projected to the ground, a ground point approaches by the vehicle's motion, one at half the camera's height by
twice that, one moving with the vehicle not at all. With camera c, the ray from its nadir to the projected
point is r = a - s c, with s = 1 on the ground; images determine s by the motion between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from v2hdm.adjust import PoseSigma
from v2hdm.association.ground import Located
from v2hdm.association.groups import Association
from v2hdm.association.sightings import Sightings
from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.site.candidates import CORRELATION

NOT_OBSERVED = "not observed to be on the ground"
NOT_ON_GROUND = "stands above the ground, or moves"

_ELSEWHERE = ((2.0, 0.5), (0.0, 0.5))
"""Mean and standard deviation of s of other things: at half the camera's height, or moving along."""

_UNEVEN = 0.1  # sigma of s on the ground: a bump of a tenth of the camera's height, or poor fits from afar
_ONE_VIEW_M = 0.1  # motion, m, within which images are one view with one error: the same texture by an edge
_POSE_SIGMAS = 4.0  # largest distance, in sigmas, of recorded positions of one place

_LEVEL_RAD = 1e-5  # standard deviation, rad, of an attitude treated as exact
_LEAST_SIGMA_M = 1e-3  # floor of a point's standard deviation, m, however precise an image states it
_ANYWHERE_M = 1e3  # standard deviation, m, of a point's prior position about its mean
_ANY_SLOPE = 10.0  # prior standard deviation of s: nothing approaches much faster than the vehicle moves


@dataclass(frozen=True)
class PointViews:
    """N sightings of P points each."""

    group: IntArray  # (N,) candidate
    camera: IntArray
    points_map: FloatArray  # (N, P, 2) m, on the ground
    ray_map: FloatArray  # (N, P, 2) to there from the camera's nadir
    covariance_m2: FloatArray  # (N, P, 2, 2) without that of poses
    used: BoolArray  # (N, P) whether informative; other entries are arbitrary
    height_m: FloatArray  # (N,) of the camera
    pose_sigma: FloatArray  # (N, 6) of the poses' errors

    @classmethod
    def of_corners(
        cls,
        association: Association,
        sightings: Sightings,
        located: Located,
        variance_factor: float,
        pose_sigma: Sequence[PoseSigma],
    ) -> PointViews:
        """Informative corners of ``located``, their covariances times ``variance_factor``."""
        used = association.in_group_order(located.informs)
        rows = np.flatnonzero((association.group >= 0) & used.any(axis=1))
        corners, rays, covariance = (
            association.in_group_order(values)[rows]
            for values in (located.corners_map, located.ray_map, variance_factor * located.covariance_m2)
        )
        by_session = np.array([sigma.by_state() for sigma in pose_sigma])
        return cls(
            group=association.group[rows],
            camera=sightings.camera[rows],
            points_map=corners,
            ray_map=rays,
            covariance_m2=covariance,
            used=used[rows],
            height_m=located.height_m[rows],
            pose_sigma=by_session[sightings.session[sightings.frame[rows]]],
        )


@dataclass(frozen=True)
class Parallax:
    """Apparent motion of G candidates: ``slope`` (G, P), s of each point, 1 on the ground, and covariance."""

    slope: FloatArray
    covariance: FloatArray

    @property
    def log_odds(self) -> FloatArray:
        """Log-odds (G,) of a candidate lying on the ground, from even prior odds."""
        count = self.slope.shape[1]
        # Points of an upright object differ in height: half of the variance is each point's own.
        correlation = (np.ones((count, count)) + np.eye(count)) / 2
        elsewhere = [
            _log_normal(self.slope - mean, self.covariance + sigma**2 * correlation)
            for mean, sigma in _ELSEWHERE
        ]
        ground = _log_normal(self.slope - 1, self.covariance + _UNEVEN**2 * correlation)
        raised, moving_along = elsewhere
        return np.asarray(ground - np.logaddexp(raised, moving_along) + np.log(len(_ELSEWHERE)))

    def objections(self, min_probability: float) -> list[str | None]:
        """Objection to each candidate; None if it lies on the ground with this probability."""
        least = np.log(min_probability / (1 - min_probability))
        return [
            None if odds >= least else NOT_ON_GROUND if odds < -least else NOT_OBSERVED
            for odds in self.log_odds
        ]


def measure_parallax(views: PointViews, count: int) -> Parallax:
    """Estimate s of the points of ``count`` candidates by weighted least squares.

    Unknown as well: their positions, and a roll and pitch error common to all images.
    """
    group = views.group
    used = views.used
    points_each = used.shape[1]
    total = 2 * points_each
    slopes = slice(2 * points_each, 3 * points_each)
    points, ray = (np.where(used[..., None], values, 0.0) for values in (views.points_map, views.ray_map))
    centre = (points - ray).sum(axis=1) / used.sum(axis=1)[:, None]
    sightings = _sum(used, group, count)
    middle = _sum(points, group, count) / np.maximum(sightings, 1)[..., None]
    view, images = _views(views, centre)
    # Recorded positions of a standing vehicle wander; its images are one view, from their mean.
    centre = (_sum(centre, view, len(images)) / images[:, None])[view]
    reference = _sum(centre, group, count) / np.maximum(np.bincount(group, minlength=count), 1)[:, None]

    # Evaluated at the mean: derivatives at the ray itself would correlate with its error.
    by_pose = _by_pose(middle[group] - centre[:, None], views.height_m) * used[..., None, None]
    by_pose = by_pose.reshape(len(group), total, 6)
    is_used = np.repeat(used, 2, axis=1)
    spread = by_pose * views.pose_sigma[:, None]
    covariance = spread @ np.swapaxes(spread, 1, 2)
    for k in range(points_each):
        image_m2 = np.where(used[:, k, None, None], views.covariance_m2[:, k], np.eye(2))
        image_m2 += _LEAST_SIGMA_M**2 * np.eye(2)
        covariance[:, 2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += image_m2
    effective = 1 / (1 + CORRELATION * (images[view] - 1))
    weight = np.linalg.inv(covariance) * effective[:, None, None]

    by_slope = np.einsum("ij,nk->nikj", np.eye(points_each), centre - reference[group]).reshape(
        -1, total, points_each
    )
    by_place = np.broadcast_to(np.eye(total), (len(group), total, total))
    design = np.concatenate([by_place, by_slope, by_pose[..., 3:5]], axis=2) * is_used[..., None]
    off_m = np.where(is_used, (points - middle[group]).reshape(-1, total), 0.0)[..., None]
    weighted = np.swapaxes(design, 1, 2) @ weight
    tilt_rad = np.max(views.pose_sigma[:, 3:5], initial=_LEVEL_RAD)
    sigma = np.repeat([_ANYWHERE_M, _ANY_SLOPE, tilt_rad], [total, points_each, 2])
    information = _sum(weighted @ design, group, count) + np.diag(sigma**-2.0)
    gradient = _sum(weighted @ off_m, group, count)
    inverse = np.linalg.inv(information)
    solved = (inverse @ gradient)[..., 0]

    squared = _sum(np.swapaxes(off_m, 1, 2) @ weight @ off_m, group, count)[:, 0, 0]
    squared -= np.sum(solved * gradient[..., 0], axis=1)
    freedom = _sum(2 * effective * used.sum(axis=1), group, count) - 3 * (sightings > 0).sum(axis=1)
    scale = np.maximum(1.0, squared / np.maximum(freedom, 1.0))
    return Parallax(1 - solved[:, slopes], scale[:, None, None] * inverse[:, slopes, slopes])


def _log_normal(off: FloatArray, covariance: FloatArray) -> FloatArray:
    """Log density (G,) of deviations (G, P), up to a constant."""
    squared = np.sum(off * np.linalg.solve(covariance, off[..., None])[..., 0], axis=1)
    return np.asarray(-0.5 * (squared + np.linalg.slogdet(covariance)[1]))


def _sum(values: FloatArray | BoolArray, group: IntArray, count: int) -> FloatArray:
    """Sums (G, ...) of values (N, ...) by group (N,)."""
    totals = np.zeros((count, *values.shape[1:]))
    np.add.at(totals, group, values)
    return totals


def _by_pose(ray: FloatArray, height_m: FloatArray) -> FloatArray:
    """Jacobian (N, P, 2, 6) of ground points at the ends of rays (N, P, 2) by :data:`POSE_STATES`."""
    x = ray[..., 0]
    y = ray[..., 1]
    ones = np.ones_like(x)
    zeros = np.zeros_like(x)
    h = np.broadcast_to(height_m[:, None], x.shape)
    columns = (
        (ones, zeros),
        (zeros, ones),
        (x / h, y / h),
        (x * y / h, h + y * y / h),
        (-h - x * x / h, -x * y / h),
        (-y, x),
    )
    return np.stack([np.stack(column, axis=-1) for column in columns], axis=-1)


def _views(views: PointViews, centre: FloatArray) -> tuple[IntArray, IntArray]:
    """View (N,) of each sighting, and images per view; a camera that moved enough begins a new one."""
    reach_m = _ONE_VIEW_M + _POSE_SIGMAS * views.pose_sigma[:, 0]
    view_of_camera: dict[tuple[int, int], int] = {}
    first: list[int] = []
    view = np.zeros(len(centre), dtype=np.int64)
    for n, key in enumerate(zip(views.group.tolist(), views.camera.tolist(), strict=True)):
        is_new = key not in view_of_camera
        if not is_new:
            moved_x_m, moved_y_m = centre[n] - centre[first[view_of_camera[key]]]
            is_new = np.hypot(moved_x_m, moved_y_m) > reach_m[n]
        if is_new:
            view_of_camera[key] = len(first)
            first.append(n)
        view[n] = view_of_camera[key]
    return view, np.bincount(view, minlength=len(first))
