"""Robust least squares: the mounting under which matched pixels show the same ground, given a prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.geometry.least_squares import Normal, gauss_newton
from v2hdm.geometry.planar import cross
from v2hdm.geometry.rigid import rotation_from_vector
from v2hdm.ground.model import GroundHits, Mount, by_lens, by_pixel, hit_ground
from v2hdm.ground.prior import Observations, Prior
from v2hdm.records import FloatArray, IntArray

PIXEL_SIGMA = 0.4
"""Largest standard deviation of a patch's place in an image, px; the unit of the residuals."""

_LEAST_PIXEL_SIGMA = 0.1  # interpolation and the grid itself limit the matches to this, px
# Median length of a plane vector whose components have a standard deviation of one.
_RAYLEIGH_MEDIAN = np.sqrt(2 * np.log(2))
_CAUCHY = 2.5  # length of a whitened residual from which on it loses its weight
# How far a good lens model and the matching are off, px, smoothly over the image and alike in all: little
# against a pixel, but thousands of matches share it.
_LENS_SIGMA_PX = 0.1
# Fall of a road to both sides of a crown beneath the vehicle, whose wheels stand half a track beside it: it
# looks like a bent lens (AASHTO, A Policy on Geometric Design of Highways and Streets, 7th ed., 4.2.2).
_ROOF_SIGMA, _HALF_TRACK_M = 0.03, 0.8
_BENDS = 6  # terms of a smooth error of each pixel coordinate: a polynomial of the second degree
# Longer steps leave the range in which the equations are linear.
_LARGEST_TURN_RAD, _LARGEST_SHIFT_M = 0.05, 0.2
_STEPS = 20
_CONVERGED = 0.02  # a step below so many standard deviations is the last
_DAMPING = 1e-3  # without it, a focal length and a height that slide together overshoot for ever
_LARGEST_NOISE_PX = 2.0  # what is further off is no noise of a pixel
_STRETCHES = 12  # of the route: several metres each, longer than most errors go together

TURN, CENTRE, BENDS = slice(0, 3), slice(3, 6), slice(6, 6 + 2 * _BENDS)
_ROOF = BENDS.stop


@dataclass(frozen=True)
class Adjusted:
    """The solution.

    Attributes:
        mount: with the lens as freed.
        extra: the freed parameter's value, 0 without one.
        covariance: (K, K) of turn (3, rad), centre (3, m) and the freed parameter, if any.
        pose_errors: (I, 6) estimated :data:`~v2hdm.ground.prior.STATES`.
        bends: (12,) estimated smooth error of the pixels, px.
        roof: estimated fall of the ground to both sides of the path, m per m.
        poses: (I, 4, 4) ``map_from_vehicle`` with their errors, and the parameter, taken in.
        residual: (N,) lengths in units of :data:`PIXEL_SIGMA` over both pixels.
        weight: (N,) 1 for a match that fits, 0 for one that does not.
        data_variance: (K,) the part of the variances that comes from the matches and the poses.
        stretch_variance: (K,) that part as the stretches of the route disagree.
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


@dataclass(frozen=True)
class _Unknowns:
    """The estimate: mounting, freed parameter, errors of the poses (I, 6) and of the pixels (12,), roof."""

    mount: Mount
    extra: float
    errors: FloatArray
    bends: FloatArray
    roof: float


@dataclass(frozen=True)
class _Weighted(Normal):
    """The normal equations, lengths (N,) of residuals, weights (N,) and each match's ``score`` (N, U)."""

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
    near: Adjusted | None = None,
) -> Adjusted:
    """Find the mounting, beside one parameter ``free`` if any, with Cauchy's weights.

    Args:
        observations: the matches.
        prior: poses, survey and their noise.
        start: where to start from.
        free: ``clock_s``, ``focal_scale``, ``distortion_k1`` or ``grade``, or None.
        tolerance: factor on the length of residual from which on a match loses its weight.
        near: a solution for the same images, without the parameter, to start from instead.
    """
    # Steps move a ground point by centimetres: its distance from the path is taken once.
    hits = (hit_ground(start, px, prior.poses[image]) for image, px in _both(observations))
    lower_m = tuple(_beside_m(prior.course_map, one.points_map) - _HALF_TRACK_M for one in hits)
    problem = _Problem(observations, prior, free, tolerance, lower_m)
    damping = 0.0
    begin = _Unknowns(start, 0.0, np.zeros((len(prior.poses), 6)), np.zeros(2 * _BENDS), 0.0)
    if near is not None:
        begin, damping = _Unknowns(near.mount, 0.0, near.pose_errors, near.bends, near.roof), _DAMPING
        problem = replace(problem, sigma_px=problem.linearise(begin).sigma_px)
    fit = gauss_newton(
        problem.linearise, begin, retract=problem.moved, limit=_short, steps=_STEPS, tolerance=_CONVERGED,
        damping=damping,
    )  # fmt: skip
    found, last = fit.x, fit.last
    wanted = [*range(6), *range(_ROOF + 1, problem.known)]
    inverse = np.linalg.inv(last.information)
    own = inverse[: problem.known, : problem.known]
    return Adjusted(
        mount=found.mount,
        extra=found.extra,
        covariance=np.asarray(inverse[np.ix_(wanted, wanted)]),
        pose_errors=found.errors,
        bends=found.bends,
        roof=found.roof,
        poses=problem.poses(found),
        residual=last.length,
        weight=last.weight,
        data_variance=(np.diag(own) - own**2 @ problem.stiffness)[wanted],
        stretch_variance=_by_stretch(last.score @ own, observations.first)[wanted],
    )


def _by_stretch(moved: FloatArray, image: IntArray) -> FloatArray:
    """Variances (U,) of unknowns that each match moves by (N, U), errors going together along the route.

    It is a cluster-robust variance (Liang and Zeger, Biometrika 73, 1986) whose clusters are stretches with
    as many matches each; ``image`` (N,) says where on the route a match is.
    """
    ends = np.quantile(image, np.arange(1, _STRETCHES) / _STRETCHES)
    stretches, place = np.unique(np.searchsorted(ends, image), return_inverse=True)
    sums = np.zeros((len(stretches), moved.shape[1]))
    np.add.at(sums, place, moved)
    return np.asarray(len(sums) * np.var(sums, axis=0, ddof=1 if len(sums) > 1 else 0))


def _short(step: FloatArray) -> FloatArray:
    turn, shift = np.abs(step[TURN]).max(), np.abs(step[CENTRE]).max()
    return np.asarray(step / max(1.0, float(turn) / _LARGEST_TURN_RAD, float(shift) / _LARGEST_SHIFT_M))


@dataclass(frozen=True)
class _Problem:
    """Unknowns, in order: turn, centre, bends, roof, a freed parameter if any, six errors of every pose.

    ``lower_m`` (N,) is by how much a unit of roof lowers the ground, in both images; ``sigma_px`` is the
    standard deviation of the pixels, None to estimate it anew with every step.
    """

    observations: Observations
    prior: Prior
    free: str | None
    tolerance: float
    lower_m: tuple[FloatArray, ...]
    sigma_px: float | None = None

    @property
    def known(self) -> int:
        """The number of unknowns beside the poses' errors."""
        return _ROOF + 1 + (self.free is not None)

    @property
    def stiffness(self) -> FloatArray:
        """Prior information (U,) of the unknowns beside the poses' errors."""
        stiffness = np.zeros(self.known)
        # Too few matches must not make it singular: an angle is known to a radian, a parameter to ten units.
        stiffness[TURN], stiffness[_ROOF + 1 :] = 1.0, 0.01
        stiffness[_ROOF] = _ROOF_SIGMA**-2
        stiffness[CENTRE], stiffness[BENDS] = self.prior.centre_sigma_m**-2, _LENS_SIGMA_PX**-2
        return stiffness

    def moved(self, now: _Unknowns, step: FloatArray) -> _Unknowns:
        """The estimate after a step."""
        mount, extra = now.mount.moved(step[TURN], step[CENTRE]), now.extra
        if self.free is not None:
            change = float(step[self.known - 1])
            extra += change
            if self.free == "focal_scale":
                mount = mount.with_focal_scale((1 + extra) / (1 + now.extra) - 1)
            elif self.free == "distortion_k1":
                mount = mount.with_k1(change)
        errors = now.errors + step[self.known :].reshape(-1, 6)
        return _Unknowns(mount, extra, errors, now.bends + step[BENDS], now.roof + float(step[_ROOF]))

    def poses(self, now: _Unknowns) -> FloatArray:
        """The poses (I, 4, 4) with their estimated errors and the freed parameter taken in."""
        prior = self.prior
        turn, shift = now.errors[:, :3].copy(), now.errors[:, 3:].copy()
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
        """The normal equations, the scale of the pixels' errors estimated from the residuals."""
        residual, jacobian, root = self._differences(now)
        length = np.linalg.norm((root @ residual[:, :, None])[..., 0], axis=1)
        usable = np.isfinite(length)
        scale = float(np.median(length[usable])) / _RAYLEIGH_MEDIAN if usable.any() else 1.0
        sigma_px = self.sigma_px or float(
            np.clip(PIXEL_SIGMA * scale, _LEAST_PIXEL_SIGMA, self.tolerance * PIXEL_SIGMA)
        )
        unit, far = PIXEL_SIGMA / sigma_px, _CAUCHY * self.tolerance
        weight = np.where(usable, 1 / (1 + (length * unit / far) ** 2), 0.0)
        good = weight > 0
        scaled = np.sqrt(weight[good])[:, None, None] * (root * unit)[good]
        rows, value = scaled @ jacobian[good], (scaled @ residual[good][:, :, None])[..., 0]
        information, gradient = self._sum_pairs(rows, value, self.observations.only(good))
        score = np.zeros((len(weight), self.known))
        score[good] = np.einsum("nij,ni->nj", rows[:, :, : self.known], value)
        cost = -0.5 * far**2 * float(np.log(weight[good]).sum()) + self._add_priors(
            now, information, gradient
        )
        return _Weighted(information, gradient, cost, length, weight, score, sigma_px)

    def _differences(
        self, now: _Unknowns, noise_px: Sequence[FloatArray] | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Differences (N, 2) m, their derivatives by the unknowns and by both poses, whitening (N, 2, 2).

        Once the pixels' scale is known they are taken where pixels would be without their likeliest noise:
        derivatives at pixels as seen go with it, and thousands of matches add that up to a focal length up to
        a per cent too long (Pope, Some pitfalls to be avoided in the iterative adjustment of nonlinear
        problems, 1972).
        """
        seen, poses = self.observations, self.poses(now)
        points, known, pose, slopes = [], [], [], []
        spread = np.zeros((len(seen.first), 2, 2))
        off = noise_px or (0 * seen.first_px,) * 2
        for (image, seen_px), off_px, lower_m in zip(_both(seen), off, self.lower_m, strict=True):
            px = seen_px - off_px
            hits = hit_ground(now.mount, px, poses[image])
            by_px = by_pixel(now.mount, hits)
            bending = _bending(now.mount, px, by_px)
            falling = hits.by_fall(lower_m)
            columns = [hits.by_mount(), bending, falling[:, :, None]]
            if self.free is not None:
                columns.append(self._by_parameter(now.mount, hits, px, poses[image], image)[:, :, None])
            by_noise = (by_px @ off_px[:, :, None])[..., 0]
            points.append(hits.points_map + bending @ now.bends + now.roof * falling + by_noise)
            known.append(np.concatenate(columns, axis=2))
            pose.append(hits.by_pose())
            slopes.append(by_px)
            blur = PIXEL_SIGMA * by_px
            spread = spread + blur @ np.swapaxes(blur, 1, 2)
        usable = np.isfinite(spread).all(axis=(1, 2))
        root = np.full(spread.shape, np.nan)
        root[usable] = np.linalg.inv(np.linalg.cholesky(spread[usable]))
        if self.sigma_px is not None and noise_px is None:
            whitened = root @ (points[0] - points[1])[:, :, None]
            pull = PIXEL_SIGMA**2 * np.nan_to_num(np.swapaxes(root, 1, 2) @ whitened)
            likeliest = (np.swapaxes(np.nan_to_num(by_px), 1, 2) @ pull for by_px in (slopes[0], -slopes[1]))
            limit_px = _LARGEST_NOISE_PX
            return self._differences(now, [np.clip(one[..., 0], -limit_px, limit_px) for one in likeliest])
        jacobian = np.concatenate([known[0] - known[1], pose[0], -pose[1]], axis=2)
        return points[0] - points[1], jacobian, root

    def _by_parameter(
        self, mount: Mount, hits: GroundHits, px: FloatArray, poses: FloatArray, image: IntArray
    ) -> FloatArray:
        """Derivative (N, 2) of ground points by the freed parameter."""
        if self.free == "clock_s":
            return hits.by_motion(self.prior.velocity[image])
        if self.free == "grade":
            return -hits.by_fall(self.prior.climb_m[image])
        return by_lens(mount, px, poses, str(self.free))

    def _sum_pairs(
        self, rows: FloatArray, value: FloatArray, seen: Observations
    ) -> tuple[FloatArray, FloatArray]:
        """Information (U, U) and gradient (U,) of the matches, a block of two poses per pair."""
        known = self.known
        size = known + 6 * len(self.prior.poses)
        information, gradient = np.zeros((size, size)), np.zeros(size)
        cuts = np.flatnonzero(np.diff(seen.pair)) + 1
        for low, high in zip([0, *cuts], [*cuts, len(seen.pair)], strict=True):
            if high == low:
                continue
            block = rows[low:high].reshape(-1, known + 12)
            images = (int(seen.first[low]), int(seen.second[low]))
            at = np.concatenate([np.arange(known), *(known + 6 * image + np.arange(6) for image in images)])
            information[np.ix_(at, at)] += block.T @ block
            gradient[at] += block.T @ value[low:high].ravel()
        return information, gradient

    def _add_priors(self, now: _Unknowns, information: FloatArray, gradient: FloatArray) -> float:
        """Add what is stated to the normal equations, in place; returns its cost."""
        cost = 0.0
        for state in range(6):
            at = self.known + 6 * np.arange(len(self.prior.poses)) + state
            pull = self.prior.pose_information[state] @ now.errors[:, state]
            information[np.ix_(at, at)] += self.prior.pose_information[state]
            gradient[at] += pull
            cost += 0.5 * float(now.errors[:, state] @ pull)
        stiffness = self.stiffness
        off = np.zeros(self.known)
        off[CENTRE], off[BENDS] = now.mount.centre_vehicle - self.prior.centre_vehicle, now.bends
        off[_ROOF] = now.roof
        place = np.arange(self.known)
        information[place, place] += stiffness
        gradient[place] += stiffness * off
        return cost + 0.5 * float(stiffness @ off**2)


def _both(seen: Observations) -> tuple[tuple[IntArray, FloatArray], tuple[IntArray, FloatArray]]:
    """The image (N,) and the pixel (N, 2) of each match, of its first image and of its second."""
    return (seen.first, seen.first_px), (seen.second, seen.second_px)


def _beside_m(course_map: FloatArray, points_map: FloatArray) -> FloatArray:
    """How far (N,) points (N, 2) lie beside the driven path (P, 2)."""
    ahead = np.gradient(course_map, axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)  # of a vehicle that stands
    out = []
    for points in np.array_split(points_map, len(points_map) // 1000 + 1):
        off = points[:, None] - course_map[None]
        near = np.argmin(np.square(off).sum(axis=2), axis=1)
        out.append(np.abs(cross(ahead[near], off[np.arange(len(near)), near])))
    return np.concatenate(out)


def _bending(mount: Mount, px: FloatArray, by_px: FloatArray) -> FloatArray:
    """Derivative (N, 2, 12) of ground points by the terms of a smooth error of the pixels, in px."""
    u, v = (2 * px / [mount.info.width, mount.info.height] - 1).T
    terms = np.stack([np.ones(len(u)), u, v, u * u, u * v, v * v], axis=1)
    return np.concatenate([by_px[:, :, k, None] * terms[:, None] for k in (0, 1)], axis=2)
