"""Shapes common to the markings of a class, and errors of painted edges common to all images.

The diamonds of a yard are painted with one stencil, the dashes of a road with one roller. A hundred
well-observed markings predict the size of the next one, seen four times with one corner under a puddle
(empirical Bayes: Efron and Morris, Stein's estimation rule and its competitors, JASA 1973). All classes are
parallelograms: half the diagonals define a shape.

Every image measures a worn or dirty edge in the same wrong place. That error neither averages out nor shows
in residuals, but it makes each marking deviate from the shape of its class: most by a millimetre, some by
centimetres. A Gaussian variance per marking with an inverse-gamma prior, and hence deviations of Student's t
distribution, describe both (Lange, Little and Taylor, Robust statistical modeling using the t distribution,
JASA 1989). The class determines the prior; a marking's posterior variance is added to its corners'.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.distance import cdist
from scipy.special import chdtri, gammaln

from v2hdm.geometry.planar import turned_left
from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.site.candidates import Candidates

_LEAST_MEMBERS = 8  # least markings of one shape of a class

_STENCIL_M = 0.03  # sigma, m, of a corner's coordinate about a stencil's shape: a brush's width

_FEWEST_MEMBERS = 3
"""Least markings of a shape if they are at least half of the class and hardly agree by chance: from three on,
two agree against a third. Beside a more common shape, its fragments soon agree by threes."""

_LEAST_SHARE = 0.1  # least fraction of a class's markings with a shape of the class

MEMBER_M = 0.05  # largest deviation of a member's corners from its shape, m
_MEMBER_SHARE = 0.08
"""Largest such deviation relative to the longer diagonal: large paint is laid out less exactly."""

SHAPE_SIGMA_M = 0.01
"""Least sigma of a painted corner about the stencil's, m."""

_ELONGATED = 2.0
"""Ratio of length to width from which paint is rolled by the metre: common width, individual length."""

_GAUSS_NEWTON_STEPS = 3  # steps that refine a laid shape

_COMPARED_AT_ONCE = 500  # candidates that are compared with all at once, which bounds the memory; chosen


@dataclass(frozen=True)
class Shape:
    """A parallelogram (4, 2) about its centre, m, common to a class up to ``sigma_m`` per coordinate.

    A fraction ``share`` of the class's markings has it.
    """

    corners: FloatArray
    sigma_m: float
    share: float

    @property
    def is_elongated(self) -> bool:
        """Whether it is rolled by the metre."""
        sides = np.linalg.norm(self.corners[1:3] - self.corners[:2], axis=1)
        return bool(sides.max() >= _ELONGATED * sides.min())


@dataclass(frozen=True)
class Laid:
    """A shape laid on each of N candidates: ``corners_map`` (N, 4, 2).

    ``shift`` (N,) and ``rotation`` (N, 2, 2) placed it, ``centre`` (N, 2) is its centre, ``directions``
    (N, 5, 8) are orthonormal non-rigid directions of the corners.
    """

    corners_map: FloatArray
    rotation: FloatArray
    centre: FloatArray
    shift: IntArray

    @cached_property
    def directions(self) -> FloatArray:
        """Orthonormal directions (N, 5, 8)."""
        basis = np.linalg.qr(rigid_motions(self.corners_map), mode="complete")[0]
        return np.asarray(np.swapaxes(basis[:, :, 3:], 1, 2))

    def in_frame_of_shape(self, corners_map: FloatArray) -> FloatArray:
        """Corners (N, 4, 2) in the frame and order of the shape."""
        turned = (corners_map - self.centre[:, None]) @ self.rotation
        order = (np.arange(4) - self.shift[:, None]) % 4
        return np.asarray(np.take_along_axis(turned, order[..., None], axis=1))


def parallelograms(corners: FloatArray) -> FloatArray:
    """Nearest parallelograms (..., 4, 2), about their centres, of corners (..., 4, 2)."""
    arms = (corners[..., :2, :] - corners[..., 2:, :]) / 2
    return np.concatenate([arms, -arms], axis=-2)


def lay(shape: FloatArray, sigma_m: float, candidates: Candidates) -> tuple[Laid, Laid]:
    """Align a parallelogram (4, 2) with ``candidates``, weighted by their full covariances.

    By its symmetry there are two alignments, shifted by one corner: the better one comes first.
    """
    information = np.asarray(np.linalg.inv(candidates.covariance_m2 + sigma_m**2 * np.eye(8)), np.float64)
    alignments = [_lay(np.roll(shape, -shift, axis=0), candidates, information) for shift in (0, 1)]
    best = np.argmin(np.stack([alignment.squared for alignment in alignments]), axis=0)
    rows = np.arange(len(candidates))
    placed = np.stack([alignment.corners_map for alignment in alignments])
    rotation = np.stack([alignment.rotation for alignment in alignments])
    centre = np.stack([alignment.centre for alignment in alignments])
    first, second = (
        Laid(placed[shift, rows], rotation[shift, rows], centre[shift, rows], shift)
        for shift in (best, 1 - best)
    )
    return first, second


class _Alignment(NamedTuple):
    """A shape aligned with each of N candidates, from one of its corners."""

    corners_map: FloatArray  # (N, 4, 2) m
    rotation: FloatArray  # (N, 2, 2)
    centre: FloatArray  # (N, 2) m
    squared: FloatArray  # (N,) squared Mahalanobis distance of the candidate's corners


def _lay(shape: FloatArray, candidates: Candidates, information: FloatArray) -> _Alignment:
    """Align ``shape`` (4, 2), whose first corner belongs to the candidates' first."""
    corners = candidates.corners_map
    # A shift common to all corners is irrelevant to their weights.
    by_corner_m2 = candidates.covariance_m2.reshape(-1, 4, 2, 4, 2)
    common_m2 = np.einsum("naibi->n", by_corner_m2) / 32
    weight = 1 / np.maximum(candidates.sigma_m**2 / 2 - common_m2[:, None], 1e-6)
    total = weight.sum(axis=1, keepdims=True)
    target_centre = np.einsum("nc,ncx->nx", weight, corners) / total
    shape_centre = weight @ shape / total
    # With complex numbers the rotation is the argument of the weighted sum of targets over shapes.
    arms = (shape - shape_centre[:, None]) @ [1, 1j]
    target_arms = (corners - target_centre[:, None]) @ [1, 1j]
    turn = np.angle(np.sum(weight * target_arms * arms.conj(), axis=1))
    centre = target_centre - (_turned(turn) @ shape_centre[..., None])[..., 0]
    for _ in range(_GAUSS_NEWTON_STEPS):
        placed = shape @ np.swapaxes(_turned(turn), 1, 2) + centre[:, None]
        off = (corners - placed).reshape(-1, 8, 1)
        rigid = rigid_motions(placed)
        normal = np.swapaxes(rigid, 1, 2) @ information @ rigid
        step = np.linalg.solve(normal, np.swapaxes(rigid, 1, 2) @ information @ off)[..., 0]
        turn = turn + step[:, 2]
        centre = centre + step[:, :2]
    placed = shape @ np.swapaxes(_turned(turn), 1, 2) + centre[:, None]
    off = (corners - placed).reshape(-1, 8, 1)
    squared = (np.swapaxes(off, 1, 2) @ information @ off)[:, 0, 0]
    return _Alignment(placed, _turned(turn), centre, squared)


def _turned(angle: FloatArray) -> FloatArray:
    """Rotations (N, 2, 2)."""
    cosine = np.cos(angle)
    sine = np.sin(angle)
    return np.stack([np.stack([cosine, -sine], axis=-1), np.stack([sine, cosine], axis=-1)], axis=-2)


def rigid_motions(corners: FloatArray) -> FloatArray:
    """Derivatives (N, 8, 3) of corners (N, 4, 2) by translation and rotation about their centre."""
    arms = corners - corners.mean(axis=1, keepdims=True)
    turning = turned_left(arms).reshape(-1, 8, 1)
    shifting = np.broadcast_to(np.tile(np.eye(2), (4, 1)), (len(corners), 8, 2))
    return np.concatenate([shifting, turning], axis=2)


def learn_shapes(candidates: Candidates) -> tuple[Shape, ...]:
    """The shapes of a class's markings, most common first."""
    whole = np.flatnonzero(candidates.known.all(axis=1))
    least = max(_LEAST_MEMBERS, _LEAST_SHARE * len(whole))
    shapes: list[Shape] = []
    while len(whole) >= _FEWEST_MEMBERS:
        unexplained = candidates.subset(whole)
        corners, members = _commonest(unexplained)
        count = int(np.count_nonzero(members))
        if count < _FEWEST_MEMBERS:
            break
        spread_m, formal_m = _spread_m(corners, unexplained.subset(members))
        # With so few members, of five directions each, mean and variance are uncertain: sigma of Student's t
        # distribution about a mean (Gelman et al., Bayesian Data Analysis, section 3.2). The members' own
        # errors leave it uncertain, too.
        freedom = 5 * (count - 1)
        wider = float(np.sqrt((1 + 1 / count) * freedom / (freedom - 2)))
        sigma_m = float(np.hypot(spread_m * wider, formal_m / np.sqrt(count)))
        shape = Shape(corners, sigma_m, count / len(candidates))
        if count < least and (shapes or 2 * count < len(whole)):
            break
        if count < least and _agreement(shape, unexplained.subset(members)) < 0:
            break
        shapes.append(shape)
        whole = whole[~members]
    return tuple(shapes)


def _commonest(candidates: Candidates) -> tuple[FloatArray, BoolArray]:
    """The most common shape (4, 2) of N candidates, and its members (N,)."""
    # Sides and diagonals, each pair sorted: independent of the first corner.
    corners_map = candidates.corners_map
    side = np.linalg.norm(np.roll(corners_map, -1, axis=1) - corners_map, axis=2)
    diagonals = np.linalg.norm(corners_map[:, 2:] - corners_map[:, :2], axis=2)
    pairs = 0.5 * (side[:, :2] + side[:, 2:]), diagonals
    lengths = np.concatenate([np.sort(pair, axis=1) for pair in pairs], axis=1)
    limit_m = np.maximum(MEMBER_M, _MEMBER_SHARE * lengths.max(axis=1))
    typical = _most_typical(lengths, limit_m)
    shape = parallelograms(candidates.corners_map[typical])
    members = np.zeros(len(candidates), dtype=bool)
    for _ in range(2):
        laid = lay(shape, MEMBER_M, candidates)[0]
        missed = np.linalg.norm(candidates.corners_map - laid.corners_map, axis=2).max(axis=1)
        members = np.asarray(missed <= limit_m[typical])
        if not members.any():
            break
        shape = parallelograms(np.median(laid.in_frame_of_shape(candidates.corners_map)[members], axis=0))
    return shape, members


def _most_typical(lengths: FloatArray, limit_m: FloatArray) -> int:
    """The candidate within whose limit (N,), m, in each of its ``lengths`` (N, 4) the most others are.

    Of these it is the one that differs least from all, in limits.
    """
    typicality = np.empty(len(lengths))
    for rows in np.array_split(np.arange(len(lengths)), -(-len(lengths) // _COMPARED_AT_ONCE)):
        difference_m = cdist(lengths[rows], lengths, "chebyshev")
        alike = (difference_m <= limit_m[rows, None]).sum(axis=1)
        typicality[rows] = alike - difference_m.mean(axis=1) / limit_m[rows]
    return int(np.argmax(typicality))


class _Deviations(NamedTuple):
    """Deviations of N candidates from a shape laid on them."""

    laid: Laid
    off: FloatArray  # (N, 5, 1) m, in the directions of ``laid``
    formal: FloatArray  # (N, 5, 5) their covariance, m^2, from the candidates' alone


def _deviations(shape: FloatArray, sigma_m: float, candidates: Candidates) -> _Deviations:
    """Deviations of candidates from a shape (4, 2) with ``sigma_m`` per coordinate."""
    laid = lay(shape, sigma_m, candidates)[0]
    directions = laid.directions
    off = directions @ (candidates.corners_map - laid.corners_map).reshape(-1, 8, 1)
    return _Deviations(laid, off, directions @ candidates.covariance_m2 @ np.swapaxes(directions, 1, 2))


def _spread_m(shape: FloatArray, candidates: Candidates) -> tuple[float, float]:
    """Scatter of members' corners about their shape net of their covariances, and by these, by medians."""
    _, off, formal = _deviations(shape, SHAPE_SIGMA_M, candidates)
    expected = float(chdtri(off.shape[1], 0.5))
    low = SHAPE_SIGMA_M
    high = float(np.abs(off).max()) + SHAPE_SIGMA_M
    for _ in range(20):
        sigma_m = np.sqrt(low * high)
        innovation = formal + sigma_m**2 * np.eye(off.shape[1])
        squared = (np.swapaxes(off, 1, 2) @ np.linalg.solve(innovation, off))[:, 0, 0]
        low, high = (sigma_m, high) if np.median(squared) > expected else (low, sigma_m)
    formal_m2 = np.median(np.trace(formal, axis1=1, axis2=2)) / off.shape[1]
    return float(low), float(np.sqrt(formal_m2))


def _agreement(shape: Shape, members: Candidates) -> float:
    """Log-likelihood ratio of one stencil against any sizes among which members of a shape are chosen.

    Paint that is rolled by the metre has one width anyway: there only the length counts.
    """
    laid, off, formal = _deviations(shape.corners, shape.sigma_m, members)
    sides = laid.corners_map[:, 1:3] - laid.corners_map[:, :2]
    sides_m = np.linalg.norm(sides, axis=2, keepdims=True)
    is_free = sides_m >= sides_m.max(axis=1, keepdims=True) if shape.is_elongated else np.ones_like(sides_m)
    signs = np.array([[-0.5, 0.5, 0.5, -0.5], [-0.5, -0.5, 0.5, 0.5]])  # of corners from the centre, by side
    longer = signs[:, :, None] * (is_free * sides / sides_m)[:, :, None]
    stretched = laid.directions @ np.swapaxes(longer.reshape(-1, 2, 8), 1, 2)
    # A side that is longer by twice the limit moves both of its ends by it; any such length is as likely.
    limit_m = max(MEMBER_M, _MEMBER_SHARE * 2 * float(np.linalg.norm(shape.corners, axis=1).max()))
    any_size_m2 = (2 * limit_m) ** 2 / 3
    alike = formal + _STENCIL_M**2 * np.eye(off.shape[1])
    unlike = alike + any_size_m2 * stretched @ np.swapaxes(stretched, 1, 2)
    return _log_likelihood(off, alike) - _log_likelihood(off, unlike)


def _log_likelihood(off: FloatArray, covariance: FloatArray) -> float:
    """Log-likelihood of deviations (N, 5, 1) with a covariance (N, 5, 5), but for a constant."""
    squared = np.swapaxes(off, 1, 2) @ np.linalg.solve(covariance, off)
    return -0.5 * float(np.sum(squared[:, 0, 0] + np.linalg.slogdet(covariance)[1]))


_FREEDOM_BOUNDS = (1.0, 30.0)
"""Limits of the t distribution's degrees of freedom: from Cauchy's tails to nearly Gaussian ones."""

_SIGMA_BOUNDS_M = (1e-4, 0.05)
"""Limits of the scale of a paint error, m: from a survey's rounding to a line's width."""

EDGE_SIGMA_M = 0.004
"""Largest sigma of a painted edge common to all images, m: the raggedness of a sprayed line. A class whose
typical marking scatters by more was painted so: that scatter is no error of the map."""

_START = (0.002, 3.0)  # scale, m, and degrees of freedom with which the search for a paint error begins


@dataclass(frozen=True)
class PaintError:
    """Student's t distribution of a corner's coordinate: scale ``sigma_m`` and degrees of ``freedom``."""

    sigma_m: float
    freedom: float

    def variance_m2(self, deviation: FloatArray, formal: FloatArray) -> float:
        """Posterior variance, m^2, of a marking's edge errors, given its deviation from its class.

        ``deviation`` (m,), m, is in orthonormal directions, ``formal`` (m, m) its covariance without paint
        errors.
        """
        count = len(deviation)
        excess_m2 = max(float(deviation @ deviation) - float(np.trace(formal)), 0.0)
        posterior_m2 = (self.freedom * self.sigma_m**2 + excess_m2) / (self.freedom + count)
        painted_m2 = max(self.sigma_m**2 - EDGE_SIGMA_M**2, 0.0)
        return max(posterior_m2 - painted_m2, 0.0)


def learn_paint_error(deviations: Sequence[FloatArray], formal: Sequence[FloatArray]) -> PaintError:
    """Maximum likelihood distribution of deviations (m,) with formal covariances (m, m).

    Without deviations, the start of the search.
    """
    if not deviations:
        start_m, start_freedom = _START
        return PaintError(start_m, start_freedom)
    count = np.array([len(deviation) for deviation in deviations])
    squared = np.array([float(deviation @ deviation) for deviation in deviations])
    formal_m2 = np.array([float(np.trace(covariance)) for covariance in formal]) / count

    def cost(parameters: FloatArray) -> float:
        sigma_m, freedom = np.exp(parameters)
        variance = sigma_m**2 + formal_m2
        likelihood = gammaln((freedom + count) / 2) - gammaln(freedom / 2)
        likelihood -= count / 2 * np.log(freedom * np.pi * variance)
        likelihood -= (freedom + count) / 2 * np.log1p(squared / (freedom * variance))
        return -float(likelihood.sum())

    bounds = [np.log(_SIGMA_BOUNDS_M).tolist(), np.log(_FREEDOM_BOUNDS).tolist()]
    optimum = minimize(cost, np.log(_START), method="L-BFGS-B", bounds=bounds)
    sigma_m, freedom = np.exp(optimum.x)
    return PaintError(float(sigma_m), float(freedom))
