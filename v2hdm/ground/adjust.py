"""Robust least squares: the mounting under which matched pixels show the same ground, given a prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.least_squares import Normal, first_of_inverse, gauss_newton
from v2hdm.geometry.planar import cross
from v2hdm.geometry.rigid import rotation_from_vector
from v2hdm.ground.model import GroundHits, Mount, by_lens, by_pixel, hit_ground
from v2hdm.ground.prior import Observations, Prior
from v2hdm.records import FloatArray, IntArray

PIXEL_SIGMA = 0.4
"""Largest standard deviation of a patch's position in an image, px; the unit of the residuals."""

_LEAST_PIXEL_SIGMA = (
    0.1  # least standard deviation of a patch's position, px, from interpolation and the grid
)
_RAYLEIGH_MEDIAN = np.sqrt(2 * np.log(2))  # median length of a 2D vector with unit standard deviations
_CAUCHY = 2.5  # whitened residual at which Cauchy's weight is 1/2

# Systematic error of a good lens model and of matching, px, smooth over the image and equal in all images:
# small against a pixel, but common to thousands of matches.
_LENS_SIGMA_PX = 0.1

# Standard deviation of the fall of a crowned road to both sides of the vehicle, m per m: it looks like lens
# distortion (AASHTO, A Policy on Geometric Design of Highways and Streets, 7th ed., 4.2.2).
_ROOF_SIGMA = 0.03
_HALF_TRACK_M = 0.8  # distance, m, of a vehicle's wheels from the crown that it drives on
_BENDS = 6  # coefficients of a smooth error of each pixel coordinate, a quadratic polynomial

_LARGEST_TURN_RAD = 0.05  # largest turn of a step, rad, within which the equations are linear
_LARGEST_SHIFT_M = 0.2  # largest shift of a step, m, within which the equations are linear
_STEPS = 20  # steps after which the iteration ends, converged or not
_CONVERGED = 0.02  # step, in standard deviations, that ends the iteration
_DAMPING = 1e-3  # damping against endless overshoot of a correlated focal length and height
_LARGEST_NOISE_PX = 2.0  # limit of the removed noise, px: beyond is no noise of a pixel
_STRETCHES = 12  # segments of the route, several metres each: longer than the correlation of most errors

TURN = slice(0, 3)  # places of the mount's turn among the unknowns
CENTRE = slice(3, 6)  # places of the camera's centre among the unknowns
BENDS = slice(6, 6 + 2 * _BENDS)  # places of the smooth pixel error among the unknowns
_ROOF = BENDS.stop  # place of the road's fall among the unknowns


@dataclass(frozen=True)
class Adjusted:
    """The solution.

    The ``mount`` contains a freed lens; ``extra`` is the freed parameter, 0 without one. ``covariance``
    (K, K) is of turn (3, rad), centre (3, m) and the freed parameter. ``pose_errors`` (I, 6) are
    :data:`~v2hdm.ground.prior.STATES`, ``bends`` (12,), px, the smooth pixel error, ``roof`` the ground's
    fall to both sides of the path, m per m. ``poses`` (I, 4, 4) are ``map_from_vehicle`` with their errors
    and the parameter applied. ``residual`` (N,) is the norm over both pixels in units of :data:`PIXEL_SIGMA`,
    ``weight`` (N,) its Cauchy weight. ``data_variance`` (K,) is the part of the variances from matches and
    poses, ``stretch_variance`` (K,) the same, clustered by segments of the route. ``sigma_px`` is the
    standard deviation of the pixels.
    """

    mount: Mount
    extra: float
    covariance: FloatArray
    pose_errors: FloatArray
    bends: FloatArray
    roof: float
    poses: FloatArray
    residual: FloatArray
    weight: FloatArray
    data_variance: FloatArray
    stretch_variance: FloatArray
    sigma_px: float


@dataclass(frozen=True)
class _Unknowns:
    """The estimate: mounting, freed parameter, errors of poses (I, 6) and pixels (12,), and roof."""

    mount: Mount
    extra: float
    errors: FloatArray
    bends: FloatArray
    roof: float


class Errors(NamedTuple):
    """The errors that a solution of other matches states: fewer steps lead from there."""

    pose_errors: FloatArray  # (I, 6)
    bends: FloatArray  # (12,) px
    roof: float

    @classmethod
    def of(cls, solution: Adjusted, images: IntArray) -> Errors:
        """The errors of a solution, of some of its ``images`` (I,)."""
        return cls(solution.pose_errors[images], solution.bends, solution.roof)


class _Side(NamedTuple):
    """One side of N matches on the ground."""

    image: IntArray  # (N,)
    px: FloatArray  # (N, 2) that the rays go through
    hits: GroundHits
    by_px: FloatArray  # (N, 2, 2) of the ground points
    terms: FloatArray  # (N, 6) of the smooth pixel error
    falling: FloatArray  # (N, 2) by the road's fall
    points_map: FloatArray  # (N, 2) m


class _Differences(NamedTuple):
    """The ground points of N matches' first pixels less those of their second ones."""

    residual: FloatArray  # (N, 2) m
    jacobian: FloatArray  # (N, 2, K) by the unknowns that all images share, and by both poses
    root: FloatArray  # (N, 2, 2) whitens


@dataclass(frozen=True)
class _Weighted(Normal):
    """Normal equations, residual norms (N,), weights (N,) and each match's ``score`` (N, U)."""

    length: FloatArray
    weight: FloatArray
    score: FloatArray
    sigma_px: float


def adjust(
    observations: Observations,
    prior: Prior,
    start: Mount,
    free: str | None = None,
    tolerance: float = 1.0,
    without: Adjusted | None = None,
    initial: Errors | None = None,
) -> Adjusted:
    """Estimate the mounting, with the parameter ``free`` if given, with Cauchy weights.

    ``free`` is ``clock_s``, ``focal_scale``, ``distortion_k1`` or ``grade``; ``tolerance`` multiplies the
    residual at which weights fall. It starts from ``start`` and the ``initial`` errors, or from the solution
    ``without`` the parameter for the same images.
    """
    # Steps move a ground point by centimetres: its distance from the path is computed once.
    hits = [hit_ground(start, half.px, prior.poses[half.image]) for half in _halves(observations)]
    lower_m = tuple(_beside_m(prior.course_map, hit.points_map) - _HALF_TRACK_M for hit in hits)
    problem = _Problem(observations, prior, free, tolerance, lower_m)
    damping = 0.0
    begin = _Unknowns(start, 0.0, np.zeros((len(prior.poses), 6)), np.zeros(2 * _BENDS), 0.0)
    if initial is not None:
        begin = replace(begin, errors=initial.pose_errors, bends=initial.bends, roof=initial.roof)
    if without is not None:
        begin = _Unknowns(without.mount, 0.0, without.pose_errors, without.bends, without.roof)
        damping = _DAMPING
        problem = replace(problem, sigma_px=without.sigma_px)
    fit = gauss_newton(
        problem.linearise, begin, retract=problem.moved, limit=_short, steps=_STEPS, tolerance=_CONVERGED,
        damping=damping,
    )  # fmt: skip
    unknowns = fit.x
    last = fit.last
    reported = [*range(6), *range(_ROOF + 1, problem.shared)]
    of_shared = first_of_inverse(last.information, problem.shared)
    return Adjusted(
        mount=unknowns.mount,
        extra=unknowns.extra,
        covariance=of_shared[np.ix_(reported, reported)],
        pose_errors=unknowns.errors,
        bends=unknowns.bends,
        roof=unknowns.roof,
        poses=problem.poses(unknowns),
        residual=last.length,
        weight=last.weight,
        data_variance=(np.diag(of_shared) - of_shared**2 @ problem.stiffness)[reported],
        stretch_variance=_by_stretch(last.score @ of_shared, observations.first)[reported],
        sigma_px=last.sigma_px,
    )


def _by_stretch(moved: FloatArray, image: IntArray) -> FloatArray:
    """Cluster-robust variances (U,) of unknowns, each moved by (N, U) by the matches.

    The clusters are segments of the route with equally many matches (Liang and Zeger, Biometrika 73, 1986);
    ``image`` (N,) orders the matches along it.
    """
    ends = np.quantile(image, np.arange(1, _STRETCHES) / _STRETCHES)
    stretches, place = np.unique(np.searchsorted(ends, image), return_inverse=True)
    sums = np.zeros((len(stretches), moved.shape[1]))
    np.add.at(sums, place, moved)
    return np.asarray(len(sums) * np.var(sums, axis=0, ddof=1 if len(sums) > 1 else 0))


def _short(step: FloatArray) -> FloatArray:
    """The step, shortened to where the equations are linear."""
    turn = np.abs(step[TURN]).max()
    shift = np.abs(step[CENTRE]).max()
    return np.asarray(step / max(1.0, float(turn) / _LARGEST_TURN_RAD, float(shift) / _LARGEST_SHIFT_M))


@dataclass(frozen=True)
class _Problem:
    """Unknowns, in order: turn, centre, bends, roof, a freed parameter if any, six errors of every pose.

    A unit of roof lowers the ground by ``lower_m`` (N,), in both images; ``sigma_px`` is the pixels' standard
    deviation, None to re-estimate it with every step.
    """

    observations: Observations
    prior: Prior
    free: str | None
    tolerance: float
    lower_m: tuple[FloatArray, ...]
    sigma_px: float | None = None

    @property
    def shared(self) -> int:
        """Number of unknowns that all images share: without the poses' errors."""
        return _ROOF + 1 + (self.free is not None)

    @property
    def stiffness(self) -> FloatArray:
        """Prior information (U,) of the unknowns without the poses' errors."""
        stiffness = np.zeros(self.shared)
        # Weak priors keep few matches from being singular: 1 rad for an angle, ten units for a parameter.
        stiffness[TURN] = 1.0
        stiffness[_ROOF + 1 :] = 0.01
        stiffness[_ROOF] = _ROOF_SIGMA**-2
        stiffness[CENTRE] = self.prior.centre_sigma_m**-2
        stiffness[BENDS] = _LENS_SIGMA_PX**-2
        return stiffness

    def moved(self, now: _Unknowns, step: FloatArray) -> _Unknowns:
        """The estimate after a step."""
        mount = now.mount.moved(step[TURN], step[CENTRE])
        extra = now.extra
        if self.free is not None:
            change = float(step[self.shared - 1])
            extra += change
            if self.free == "focal_scale":
                mount = mount.with_focal_scale((1 + extra) / (1 + now.extra) - 1)
            elif self.free == "distortion_k1":
                mount = mount.with_k1(change)
        errors = now.errors + step[self.shared :].reshape(-1, 6)
        return _Unknowns(mount, extra, errors, now.bends + step[BENDS], now.roof + float(step[_ROOF]))

    def poses(self, now: _Unknowns) -> FloatArray:
        """Poses (I, 4, 4) with their estimated errors and the freed parameter applied."""
        prior = self.prior
        turn = now.errors[:, :3].copy()
        shift = now.errors[:, 3:].copy()
        if self.free == "clock_s":
            shift[:, :2] += now.extra * prior.velocity[:, :2]
            turn[:, 2] += now.extra * prior.velocity[:, 2]
        if self.free == "grade":
            shift[:, 2] -= now.extra * prior.climb_m
        out = prior.poses.copy()
        out[:, :3, 3] += (prior.poses[:, :3, :3] @ shift[:, :, None])[..., 0]
        out[:, :3, :3] = prior.poses[:, :3, :3] @ np.array([rotation_from_vector(vector) for vector in turn])
        return out

    def linearise(self, now: _Unknowns) -> _Weighted:
        """Normal equations, with the pixel noise estimated from the residuals."""
        differences = self._differences(now)
        residual = differences.residual
        root = differences.root
        length = np.linalg.norm((root @ residual[:, :, None])[..., 0], axis=1)
        usable = np.isfinite(length)
        scale = float(np.median(length[usable])) / _RAYLEIGH_MEDIAN if usable.any() else 1.0
        sigma_px = self.sigma_px or float(
            np.clip(PIXEL_SIGMA * scale, _LEAST_PIXEL_SIGMA, self.tolerance * PIXEL_SIGMA)
        )
        unit = PIXEL_SIGMA / sigma_px
        far = _CAUCHY * self.tolerance
        weight = np.where(usable, 1 / (1 + (length * unit / far) ** 2), 0.0)
        good = weight > 0
        scaled = np.sqrt(weight[good])[:, None, None] * (root * unit)[good]
        rows = scaled @ differences.jacobian[good]
        value = (scaled @ residual[good][:, :, None])[..., 0]
        information, gradient = self._sum_pairs(rows, value, self.observations.only(good))
        score = np.zeros((len(weight), self.shared))
        score[good] = np.einsum("nij,ni->nj", rows[:, :, : self.shared], value)
        prior_cost = self._add_priors(now, information, gradient)
        cost = -0.5 * far**2 * float(np.log(weight[good]).sum()) + prior_cost
        return _Weighted(information, gradient, cost, length, weight, score, sigma_px)

    def _differences(self, now: _Unknowns) -> _Differences:
        """The differences of the matches' ground points.

        Once the noise is known they are linearised at pixels with the most likely noise removed. Jacobians at
        observed pixels correlate with the noise: over thousands of matches, focal lengths come out up to 1 %
        too long (Pope, Some pitfalls to be avoided in the iterative adjustment of nonlinear problems, 1972).
        """
        poses = self.poses(now)
        sides = self._sides(now, poses, (0 * self.observations.first_px,) * 2)
        root = _whitening(sides)
        if self.sigma_px is not None:
            whitened = root @ (sides[0].points_map - sides[1].points_map)[:, :, None]
            pull = PIXEL_SIGMA**2 * np.nan_to_num(np.swapaxes(root, 1, 2) @ whitened)
            slopes = (sides[0].by_px, -sides[1].by_px)
            likeliest = ((np.swapaxes(np.nan_to_num(by_px), 1, 2) @ pull)[..., 0] for by_px in slopes)
            limit_px = _LARGEST_NOISE_PX
            sides = self._sides(now, poses, [np.clip(noise, -limit_px, limit_px) for noise in likeliest])
            root = _whitening(sides)
        first, second = sides
        by_shared = self._by_shared(now, poses, first) - self._by_shared(now, poses, second)
        jacobian = np.concatenate([by_shared, first.hits.by_pose(), -second.hits.by_pose()], axis=2)
        return _Differences(first.points_map - second.points_map, jacobian, root)

    def _sides(self, now: _Unknowns, poses: FloatArray, noise_px: Sequence[FloatArray]) -> list[_Side]:
        """Both sides of the matches with ``noise_px`` (N, 2) of each removed, to first order put back."""
        sides = []
        for half, off_px, lower_m in zip(_halves(self.observations), noise_px, self.lower_m, strict=True):
            px = half.px - off_px
            hits = hit_ground(now.mount, px, poses[half.image])
            by_px = by_pixel(now.mount, hits)
            terms = _terms(now.mount, px)
            falling = hits.by_fall(lower_m)
            moved_px = off_px + terms @ now.bends.reshape(2, _BENDS).T
            points_map = hits.points_map + (by_px @ moved_px[:, :, None])[..., 0] + now.roof * falling
            sides.append(_Side(half.image, px, hits, by_px, terms, falling, points_map))
        return sides

    def _by_shared(self, now: _Unknowns, poses: FloatArray, side: _Side) -> FloatArray:
        """Jacobian (N, 2, S) of ground points by the unknowns that all images share."""
        hits = side.hits
        bending = side.by_px[..., None] * side.terms[:, None, None]
        columns = [hits.by_mount(), bending.reshape(-1, 2, 2 * _BENDS), side.falling[:, :, None]]
        if self.free == "clock_s":
            columns.append(hits.by_motion(self.prior.velocity[side.image])[:, :, None])
        elif self.free == "grade":
            columns.append(-hits.by_fall(self.prior.climb_m[side.image])[:, :, None])
        elif self.free is not None:
            columns.append(by_lens(now.mount, side.px, poses[side.image], self.free)[:, :, None])
        return np.concatenate(columns, axis=2)

    def _sum_pairs(
        self, rows: FloatArray, value: FloatArray, observations: Observations
    ) -> tuple[FloatArray, FloatArray]:
        """Information (U, U) and gradient (U,) of the matches, with a block of two poses per pair."""
        shared = self.shared
        size = shared + 6 * len(self.prior.poses)
        information = np.zeros((size, size))
        gradient = np.zeros(size)
        pair = observations.pair
        cuts = np.flatnonzero(np.diff(pair)) + 1
        for low, high in zip([0, *cuts], [*cuts, len(pair)], strict=True):
            if high == low:
                continue
            block = rows[low:high].reshape(-1, shared + 12)
            images = (int(observations.first[low]), int(observations.second[low]))
            of_poses = [shared + 6 * image + np.arange(6) for image in images]
            place = np.concatenate([np.arange(shared), *of_poses])
            information[np.ix_(place, place)] += block.T @ block
            gradient[place] += block.T @ value[low:high].ravel()
        return information, gradient

    def _add_priors(self, now: _Unknowns, information: FloatArray, gradient: FloatArray) -> float:
        """Add the priors to the normal equations, in place; returns their cost."""
        cost = 0.0
        for state in range(6):
            place = self.shared + 6 * np.arange(len(self.prior.poses)) + state
            pull = self.prior.pose_information[state] @ now.errors[:, state]
            information[np.ix_(place, place)] += self.prior.pose_information[state]
            gradient[place] += pull
            cost += 0.5 * float(now.errors[:, state] @ pull)
        stiffness = self.stiffness
        off = np.zeros(self.shared)
        off[CENTRE] = now.mount.centre_vehicle - self.prior.centre_vehicle
        off[BENDS] = now.bends
        off[_ROOF] = now.roof
        place = np.arange(self.shared)
        information[place, place] += stiffness
        gradient[place] += stiffness * off
        return cost + 0.5 * float(stiffness @ off**2)


class _Half(NamedTuple):
    """One side of N matches."""

    image: IntArray  # (N,)
    px: FloatArray  # (N, 2)


def _halves(observations: Observations) -> tuple[_Half, _Half]:
    """The matches' first and second images and pixels."""
    first = _Half(observations.first, observations.first_px)
    return first, _Half(observations.second, observations.second_px)


def _beside_m(course_map: FloatArray, points_map: FloatArray) -> FloatArray:
    """Distance (N,), m, of points (N, 2) from the driven path (P, 2)."""
    ahead = np.gradient(course_map, axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)  # of a vehicle that stands
    middle = course_map.mean(axis=0)  # far from the origin squares lose digits
    course = course_map - middle
    beside_m = []
    for points in np.array_split(points_map - middle, len(points_map) // 1000 + 1):
        # The squared distances but for the point's own square; all differences take five times as long.
        nearest = np.argmin(np.square(course).sum(axis=1) - 2 * points @ course.T, axis=1)
        beside_m.append(np.abs(cross(ahead[nearest], points - course[nearest])))
    return np.concatenate(beside_m)


def _terms(mount: Mount, px: FloatArray) -> FloatArray:
    """Terms (N, 6) of the smooth error of each pixel coordinate."""
    u, v = (2 * px / [mount.info.width, mount.info.height] - 1).T
    return np.stack([np.ones(len(u)), u, v, u * u, u * v, v * v], axis=1)


def _whitening(sides: Sequence[_Side]) -> FloatArray:
    """Roots (N, 2, 2) that whiten the differences of both sides' points; nan where one misses the ground."""
    first, second = (PIXEL_SIGMA * side.by_px for side in sides)
    spread = first @ np.swapaxes(first, 1, 2) + second @ np.swapaxes(second, 1, 2)
    usable = np.isfinite(spread).all(axis=(1, 2))
    root = np.full(spread.shape, np.nan)
    root[usable] = np.linalg.inv(np.linalg.cholesky(spread[usable]))
    return root
