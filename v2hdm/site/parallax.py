"""Test whether candidates lie on the ground, by their parallax as the vehicle moves.

Projected to the ground, a ground point approaches by the vehicle's motion, one at half the camera's height by
twice that, one moving with the vehicle not at all. With camera c, the ray from its nadir to the projected
point is r = a - s c, with s = 1 on the ground; images determine s by the motion between them. Where a vehicle
stood, most images of a moving or upright thing agree, and a robust solve drops the few that contradict them.
So paint and anything else are compared by how likely *all* sightings are, each of which may be of something
else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from v2hdm.adjust import PoseSigma
from v2hdm.association.ground import Located
from v2hdm.association.groups import Association
from v2hdm.association.sightings import Sightings
from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.site.candidates import CORRELATION

NOT_OBSERVED = "not observed to be on the ground"
NOT_ON_GROUND = "stands above the ground, or moves"

_GROUND = (1.0, 0.1, 0.03)
"""Mean of s on the ground, its standard deviation shared by a candidate's points and that of each point.

They have no unit. Chosen: shared is a bump of a tenth of the camera's height; of each point it is more than
the ground bends within a marking, which was measured as 0.003 on right drives and 0.008 on KITTI.
"""

_ELSEWHERE = ((2.0, 0.35, 0.35), (0.0, 0.5, 0.1))
"""The same of what is above the ground and of what moves along, chosen.

Above, at half the camera's height, are upright things, whose points differ in height. What moves along comes
nearer or goes farther with all its points together.
"""

_SILL_M = (0.35, 0.1)
"""Mean height, m, of sills and running boards of parked cars above the ground, and its standard deviation."""

_SILL_SHARE = 0.05  # of what is not on the ground, sills that look like dashes; chosen: they are rare
_NEVER = 1e-300  # share of sills where none can be, which keeps its logarithm finite
_LEAST_HEIGHTS = 3.0  # least height of a camera over that of a sill: lower cameras see lower sills

_OFF_SHARE = 0.07  # fraction of a marking's sightings that are of something else, as of its observations
_OFF_M = 1.0  # sigma, m, of such sightings about the marking: association reaches 1.5 m
_WIDENED = (256.0, 64.0, 16.0, 4.0, 1.0, 1.0, 1.0, 1.0)
"""Factors of the sightings' variance, from fit to fit.

The many images of a standing vehicle, which agree, must not make outliers of all others at once (graduated
non-convexity; Blake and Zisserman, Visual Reconstruction, 1987).
"""

_AT_ONCE = 100  # candidates in memory at a time
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

    def of_groups(self, begin: int, end: int) -> PointViews:
        """The sightings of the candidates from ``begin`` to before ``end``, which count from 0."""
        rows = np.flatnonzero((self.group >= begin) & (self.group < end))
        views = PointViews(**{name: values[rows] for name, values in vars(self).items()})
        return replace(views, group=views.group - begin)


@dataclass(frozen=True)
class Parallax:
    """Apparent motion of G candidates."""

    slope: FloatArray  # (G, P) s of each point, 1 on the ground
    covariance: FloatArray  # (G, P, P)
    log_odds: FloatArray  # (G,) of lying on the ground, from even prior odds

    def subset(self, rows: BoolArray) -> Parallax:
        """That of the candidates at ``rows`` (G,)."""
        return Parallax(**{name: values[rows] for name, values in vars(self).items()})

    def objections(self, min_probability: float) -> list[str | None]:
        """Objection to each candidate; None if it lies on the ground with this probability."""
        least = np.log(min_probability / (1 - min_probability))
        return [
            None if odds >= least else NOT_ON_GROUND if odds < -least else NOT_OBSERVED
            for odds in self.log_odds
        ]


def measure_parallax(views: PointViews, count: int, is_bar: BoolArray | None = None) -> Parallax:
    """Compare how likely the sightings of ``count`` candidates are on the ground, above it and moving along.

    What is above is at half the camera's height or, more rarely, a car's sill or running board; that looks
    like a bar, as the candidates ``is_bar`` (count,) do, or all. Each
    hypothesis has its own prior of s, and one of all s gives ``slope``. Unknown as well: positions, and
    a roll and pitch error common to all images. A sighting may be of something else, under each hypothesis
    alike; so what a solve would drop counts for the hypothesis that explains it.
    """
    share: FloatArray = np.full(count, _SILL_SHARE)
    if is_bar is not None:
        share[~is_bar] = 0.0
    parts = [
        _measure(views.of_groups(begin, min(begin + _AT_ONCE, count)), share[begin : begin + _AT_ONCE])
        for begin in range(0, max(count, 1), _AT_ONCE)
    ]
    return Parallax(
        slope=np.concatenate([part.slope for part in parts]),
        covariance=np.concatenate([part.covariance for part in parts]),
        log_odds=np.concatenate([part.log_odds for part in parts]),
    )


def _measure(views: PointViews, sill_share: FloatArray) -> Parallax:
    """:func:`measure_parallax` of all candidates at once, which are sills with a prior share (G,)."""
    count = len(sill_share)
    model = _Model.of(views, count)
    points = views.used.shape[1]
    alone = np.eye(points)
    together = np.ones((points, points))
    free = model.fit(1.0, _ANY_SLOPE**2 * alone)
    ground, raised, moving_along = (
        model.fit(mean, shared**2 * together + single**2 * alone).log_evidence
        for mean, shared, single in (_GROUND, *_ELSEWHERE)
    )
    sill = model.fit(*_of_sills(views, count)).log_evidence
    elsewhere = np.logaddexp(raised, moving_along) - np.log(len(_ELSEWHERE)) + np.log1p(-sill_share)
    log_odds = ground - np.logaddexp(elsewhere, sill + np.log(np.maximum(sill_share, _NEVER)))
    return Parallax(free.slope, free.covariance(), log_odds)


def _of_sills(views: PointViews, count: int) -> tuple[FloatArray, FloatArray]:
    """Mean (G,) and covariances (G, P, P) of s of sills under the cameras of ``count`` candidates."""
    height_m = np.ones(count)
    sightings = np.bincount(views.group, minlength=count)
    heights_m = np.bincount(views.group, views.height_m, minlength=count)
    np.divide(heights_m, sightings, out=height_m, where=sightings > 0)
    mean_m, sigma_m = _SILL_M
    mean = height_m / (height_m - np.minimum(mean_m, height_m / _LEAST_HEIGHTS))
    shared = mean**2 * sigma_m / height_m
    single = _GROUND[2]
    points = views.used.shape[1]
    covariance = shared[:, None, None] ** 2 * np.ones((points, points)) + single**2 * np.eye(points)
    return mean, covariance


class _Distances(NamedTuple):
    """Squared distances x' A x - 2 b' x + c, in sigmas, of N sightings from candidates with unknowns x."""

    terms: FloatArray  # (N, U (U + 1) / 2 + U) the upper triangle of each A, then b
    squared: FloatArray  # c (N,)
    log_det: FloatArray  # (N,) of the covariances

    @classmethod
    def of(cls, design: FloatArray, off_m: FloatArray, covariance_m2: FloatArray) -> _Distances:
        """Distances of ``off_m`` (N, R) from ``design`` (N, R, U) times the unknowns."""
        weight = np.linalg.inv(covariance_m2)
        weighted = np.swapaxes(design, 1, 2) @ weight
        row, column = np.triu_indices(design.shape[2])
        return cls(
            terms=np.hstack([(weighted @ design)[:, row, column], (weighted @ off_m[..., None])[..., 0]]),
            squared=np.einsum("ni,nij,nj->n", off_m, weight, off_m),
            log_det=np.linalg.slogdet(covariance_m2)[1],
        )

    def at(self, factors: FloatArray) -> FloatArray:
        """The squared distances (N,) at unknowns with these :func:`_factors` (N, ...)."""
        return np.asarray(np.maximum(np.einsum("nk,nk->n", self.terms, factors) + self.squared, 0.0))


def _factors(unknowns: FloatArray) -> FloatArray:
    """Factors (G, U (U + 1) / 2 + U) of the terms of distances at ``unknowns`` (G, U)."""
    row, column = np.triu_indices(unknowns.shape[1])
    return np.hstack([np.where(row == column, 1, 2) * unknowns[:, row] * unknowns[:, column], -2 * unknowns])


def _matrices(triangles: FloatArray, size: int) -> FloatArray:
    """Symmetric matrices (G, U, U), by their upper ``triangles`` (G, U (U + 1) / 2)."""
    row, column = np.triu_indices(size)
    matrices = np.empty((len(triangles), size, size))
    matrices[:, row, column] = triangles
    matrices[:, column, row] = triangles
    return matrices


class _Fit(NamedTuple):
    """G candidates under one prior of s."""

    slope: FloatArray  # (G, P)
    information: FloatArray  # (G, U, U) on all unknowns
    slopes: slice  # of s among these
    log_evidence: FloatArray  # (G,)

    def covariance(self) -> FloatArray:
        """The covariances (G, P, P) of s."""
        return np.asarray(np.linalg.inv(self.information)[:, self.slopes, self.slopes], dtype=np.float64)


@dataclass(frozen=True)
class _Model:
    """N sightings of G candidates, linear functions of the unknowns of these: places, 1 - s, tilt."""

    group: IntArray  # (N,)
    sums: _Sums  # by candidate
    effective: FloatArray  # (N,) images that each is worth
    coordinates: IntArray  # (N,) informative ones
    freedom: FloatArray  # (G,) that places and s use up
    inlier: _Distances
    outlier: _Distances
    sigma: FloatArray  # (U,) of the unknowns before any image; that of s is another under each hypothesis

    @classmethod
    def of(cls, views: PointViews, count: int) -> _Model:
        """The model of the sightings of ``count`` candidates."""
        group = views.group
        used = views.used
        points_each = used.shape[1]
        total = 2 * points_each
        points, ray = (np.where(used[..., None], at, 0.0) for at in (views.points_map, views.ray_map))
        centre = (points - ray).sum(axis=1) / used.sum(axis=1)[:, None]
        by_group = _Sums.by(group, count)
        sightings = by_group.of(used)
        middle = by_group.of(points) / np.maximum(sightings, 1)[..., None]
        view, images = _views(views, centre)
        # Recorded positions of a standing vehicle wander; its images are one view, from their mean.
        centre = (_Sums.by(view, len(images)).of(centre) / images[:, None])[view]
        reference = by_group.of(centre) / np.maximum(np.bincount(group, minlength=count), 1)[:, None]

        # Evaluated at the mean: derivatives at the ray itself would correlate with its error.
        by_pose = _by_pose(middle[group] - centre[:, None], views.height_m) * used[..., None, None]
        by_pose = by_pose.reshape(len(group), total, 6)
        is_used = np.repeat(used, 2, axis=1)
        by_slope = np.einsum("ij,nk->nikj", np.eye(points_each), centre - reference[group])
        by_slope = by_slope.reshape(-1, total, points_each)
        by_place = np.broadcast_to(np.eye(total), (len(group), total, total))
        design = np.concatenate([by_place, by_slope, by_pose[..., 3:5]], axis=2) * is_used[..., None]
        off_m = np.where(is_used, (points - middle[group]).reshape(-1, total), 0.0)
        covariance_m2 = _covariance(views, by_pose)
        is_used_pair = is_used[:, :, None] & is_used[:, None, :]
        # Half of what something else is off, such as a cut end or a neighbour, is common to its corners.
        correlation = (np.ones((points_each, points_each)) + np.eye(points_each)) / 2
        elsewhere_m2 = covariance_m2 + _OFF_M**2 * np.kron(correlation, np.eye(2)) * is_used_pair
        tilt_rad = np.max(views.pose_sigma[:, 3:5], initial=_LEVEL_RAD)
        return cls(
            group=group,
            sums=by_group,
            effective=1 / (1 + CORRELATION * (images[view] - 1)),
            coordinates=is_used.sum(axis=1),
            freedom=3.0 * (sightings > 0).sum(axis=1),
            inlier=_Distances.of(design, off_m, covariance_m2),
            outlier=_Distances.of(design, off_m, elsewhere_m2),
            sigma=np.repeat([_ANYWHERE_M, _ANY_SLOPE, tilt_rad], [total, points_each, 2]),
        )

    def fit(self, mean: float | FloatArray, covariance: FloatArray) -> _Fit:
        """Candidates whose s have a prior of ``mean`` and ``covariance`` (P, P); Laplace's evidence.

        Each candidate may have its own: (G,) and (G, P, P).

        Expectation maximisation decides which sightings are of something else, and how large the noise is.
        """
        count = len(self.freedom)
        points = covariance.shape[-1]
        slopes = slice(2 * points, 3 * points)
        prior = np.tile(np.diag(self.sigma**-2.0), (count, 1, 1))
        prior[:, slopes, slopes] = np.linalg.inv(covariance)
        expected = np.zeros((count, len(self.sigma)))
        expected[:, slopes] = np.reshape(1 - mean, (-1, 1))
        by_prior = (prior @ expected[..., None])[..., 0]
        unknowns = len(self.sigma)
        share = np.ones(len(self.group))
        spread = np.ones(count)
        for factor in _WIDENED:
            variance = np.maximum(factor, spread)[self.group]
            weight = self.effective * share / variance
            other = self.effective * (1 - share)
            terms = self.sums.of(self.inlier.terms, weight) + self.sums.of(self.outlier.terms, other)
            information = _matrices(terms[:, :-unknowns], unknowns) + prior
            gradient = terms[:, -unknowns:] + by_prior
            solved = np.asarray(np.linalg.solve(information, gradient[..., None])[..., 0], dtype=np.float64)
            factors = _factors(solved)[self.group]
            squared = self.inlier.at(factors)
            size = self.coordinates * np.log(variance) + self.inlier.log_det
            inlier = np.log1p(-_OFF_SHARE) - (squared / variance + size) / 2
            far = self.outlier.at(factors) + self.outlier.log_det
            either = np.logaddexp(inlier, np.log(_OFF_SHARE) - far / 2)
            share = np.exp(inlier - either)
            if factor == _WIDENED[-1]:
                steady = self.effective * share
                freedom = np.maximum(self.sums.of(steady * self.coordinates) - self.freedom, 1.0)
                spread = np.maximum(self.sums.of(steady * squared) / freedom, 1.0)
        away = solved - expected
        log_evidence = self.sums.of(self.effective * either)
        log_evidence -= np.einsum("gi,gij,gj->g", away, prior, away) / 2
        log_evidence += (np.linalg.slogdet(prior)[1] - np.linalg.slogdet(information)[1]) / 2
        return _Fit(1 - solved[:, slopes], information, slopes, log_evidence)


def _covariance(views: PointViews, by_pose: FloatArray) -> FloatArray:
    """Covariance (N, 2P, 2P), m^2, of sightings with derivatives ``by_pose`` (N, 2P, 6); 1 where not used."""
    spread = by_pose * views.pose_sigma[:, None]
    covariance = np.asarray(spread @ np.swapaxes(spread, 1, 2))
    for k in range(views.used.shape[1]):
        image_m2 = np.where(views.used[:, k, None, None], views.covariance_m2[:, k], np.eye(2))
        covariance[:, 2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += image_m2 + _LEAST_SIGMA_M**2 * np.eye(2)
    return covariance


class _Sums(NamedTuple):
    """Sums by group, of which there are G."""

    members: csr_array  # (G, N) 1 where a member is of a group

    @classmethod
    def by(cls, group: IntArray, count: int) -> _Sums:
        """By groups (N,)."""
        size = len(group)
        return cls(csr_array((np.ones(size), (group, np.arange(size))), shape=(count, size)))

    def of(self, values: FloatArray | BoolArray, weight: FloatArray | None = None) -> FloatArray:
        """Sums (G, ...) of values (N, ...), each with its ``weight`` (N,) or 1."""
        members = self.members
        if weight is not None:
            members = csr_array((weight[members.indices], members.indices, members.indptr), members.shape)
        totals = members @ values.reshape(len(values), -1).astype(np.float64, copy=False)
        return np.asarray(totals.reshape(members.shape[0], *values.shape[1:]))


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
