"""What surveyed points say of a camera's mounting: the likelihood of their pixels.

A point k of the ground, X_k, was surveyed with an error of ``survey_m`` a coordinate and clicked with one of
``pixel_px``. To first order the recorded pixel then differs from the predicted one by r_k, of covariance

    q V_k,   V_k = pixel_px^2 I + G_k G_k' survey_m^2,   G_k the derivative of the pixel by the ground point.

A share of the points is wrong altogether, a slip of hand or pen: their pixels may be anywhere in the image.
So p(r_k) = (1 - e) N(r_k; 0, q V_k) + e / (width height). The factor q corrects the stated errors. Its prior
is a scaled inverse chi-square about 1: the statement counts as much as :data:`STATED_AS` observations.

The most likely mounting of a camera that sees surveyed points.

Starts come from the direct linear transform (kornia's ``find_homography_dlt``) of all points and of many
subsets of four, of which some hold no wrong point. The most likely ones are refined by LBFGS on whitened
variables, the noise factor and the points' weights by expectation maximisation around it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
import torch
from kornia.geometry.homography import find_homography_dlt
from torch import Tensor

from v2hdm.adjust.lbfgs import minimise
from v2hdm.calibration.points import SurveyedPoints
from v2hdm.geometry.ipm import extrinsic_from_ipm, homography_jacobian, pinhole_px_from_ground
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.geometry.rigid import hat
from v2hdm.geometry.tensors import apply, exp, inverse_depth
from v2hdm.records import CameraInfo, FloatArray

WRONG_SHARE = 0.02
"""Prior probability that a point is wrong altogether: one slip in five tables of ten."""

STATED_AS = 4.0
"""Observations that the stated errors count for: people know theirs to a factor of about 1.4."""

_BESIDE_M = 1e-9
"""Variance that keeps V invertible where neither error is stated, px^2."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations a coordinate: of clicking, ``pixel_px``, and of surveying, ``survey_m``."""

    pixel_px: float = 0.5
    survey_m: float = 0.01


@dataclass(frozen=True)
class Seen:
    """N points and their camera: recorded pixels, pinhole pixels and the lens between them.

    ``by_pinhole`` (N, 2, 2) is the derivative of the recorded pixel by the pinhole pixel.
    """

    info: CameraInfo
    points_px: FloatArray
    pinhole_px: FloatArray
    by_pinhole: FloatArray
    points_vehicle: FloatArray
    noise: Noise

    @classmethod
    def of(cls, points: SurveyedPoints, info: CameraInfo, noise: Noise) -> Seen:
        """The points as the camera ``info`` saw them."""
        return cls.of_pixels(points.points_px, points.points_vehicle, info, noise)

    @classmethod
    def of_pixels(
        cls, points_px: FloatArray, points_vehicle: FloatArray, info: CameraInfo, noise: Noise
    ) -> Seen:
        """Recorded pixels (N, 2) of ground points (N, 2) as the camera ``info`` saw them."""
        pinhole_px = undistort_points(info, points_px)
        steps = 0.5 * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        moved = distort_points(info, (pinhole_px[:, None] + steps).reshape(-1, 2)).reshape(-1, 4, 2)
        by_pinhole = np.stack([moved[:, 0] - moved[:, 1], moved[:, 2] - moved[:, 3]], axis=2)
        return cls(info, points_px, pinhole_px, by_pinhole, points_vehicle, noise)

    @property
    def count(self) -> int:
        """N."""
        return len(self.points_px)

    @property
    def log_anywhere(self) -> float:
        """Log density of the pixel of a wrong point."""
        return -float(np.log(self.info.width * self.info.height))

    def covariance(self, cam_from_vehicle: FloatArray) -> FloatArray:
        """V (..., N, 2, 2), px^2, under mountings (..., 4, 4)."""
        pinhole_from_ground = pinhole_px_from_ground(self.info.intrinsic, cam_from_vehicle)
        by_ground = self.by_pinhole @ homography_jacobian(pinhole_from_ground, self.points_vehicle)
        # A point behind the camera has no pixel to err by.
        by_ground = np.nan_to_num(by_ground, nan=0.0, posinf=0.0, neginf=0.0)
        clicked = (self.noise.pixel_px**2 + _BESIDE_M) * np.eye(2)
        return np.asarray(clicked + self.noise.survey_m**2 * by_ground @ np.swapaxes(by_ground, -1, -2))

    def residual_px(self, cam_from_vehicle: FloatArray) -> FloatArray:
        """Predicted less recorded pixels (..., N, 2), to first order; far off behind the camera."""
        matrices = torch.as_tensor(cam_from_vehicle)
        return np.asarray(self.residual(matrices).numpy())

    def residual(self, cam_from_vehicle: Tensor) -> Tensor:
        """As :meth:`residual_px`, differentiable."""
        ground = torch.as_tensor(np.column_stack([self.points_vehicle, np.zeros(self.count)]))
        cam = apply(cam_from_vehicle, ground)
        reciprocal, _ = inverse_depth(cam[..., 2])
        intrinsic = torch.as_tensor(self.info.intrinsic)
        rays = cam[..., :2] * reciprocal[..., None]
        predicted = rays @ intrinsic[:2, :2].mT + intrinsic[:2, 2]
        off = predicted - torch.as_tensor(self.pinhole_px)
        return (torch.as_tensor(self.by_pinhole) @ off[..., None])[..., 0]

    def jacobian(self, cam_from_vehicle: FloatArray) -> FloatArray:
        """Derivative (N, 2, 6) of :meth:`residual_px` by the left tangent of ``cam_from_vehicle``."""
        cam = np.column_stack([self.points_vehicle, np.zeros(self.count)]) @ cam_from_vehicle[:3, :3].T
        cam = cam + cam_from_vehicle[:3, 3]
        reciprocal, slope = (part.numpy() for part in inverse_depth(torch.as_tensor(cam[:, 2])))
        by_cam = np.zeros((self.count, 2, 3))
        by_cam[:, :, :2] = reciprocal[:, None, None] * np.eye(2)
        by_cam[:, :, 2] = cam[:, :2] * slope[:, None]
        moved = np.concatenate([np.broadcast_to(np.eye(3), (self.count, 3, 3)), -hat(cam)], axis=2)
        return np.asarray(self.by_pinhole @ self.info.intrinsic[:2, :2] @ by_cam @ moved)


def squared(residual_px: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared residuals (..., N) in standard deviations, for q = 1."""
    solved = np.linalg.solve(covariance, residual_px[..., None])[..., 0]
    return np.asarray((residual_px * solved).sum(axis=-1))


def log_right(square: FloatArray, covariance: FloatArray, factor: FloatArray) -> FloatArray:
    """Log density (..., N) of right points; ``factor`` (...) is q."""
    determinant = np.linalg.det(covariance)
    q = np.asarray(factor)[..., None]
    return np.asarray(-square / (2 * q) - np.log(2 * np.pi * q * np.sqrt(determinant)))


def mixture(seen: Seen, log_of_right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Log density (..., N) of points that may be wrong, and the probability (..., N) that each is right."""
    right = np.log1p(-WRONG_SHARE) + log_of_right
    total = np.logaddexp(right, np.log(WRONG_SHARE) + seen.log_anywhere)
    return total, np.asarray(np.exp(right - total))


def log_prior_of_factor(factor: FloatArray) -> FloatArray:
    """Log prior density of log q, up to a constant: 0 at q = 1."""
    return np.asarray(-0.5 * STATED_AS * (np.log(factor) + 1 / factor - 1))


_SUBSETS = 300
"""Subsets of four points that are tried; of ten points these are all 210."""

_REFINED = 4
"""Starts that are refined."""

_ROUNDS = 60
"""Whitenings after which a refinement ends, converged or not."""

_FACTORS = np.array([1.0, 10.0, 100.0, 1e3, 1e4])
"""Noise factors q under which a start is judged; the refinement finds its own."""

_LBFGS_STEPS = 12
_TOLERANCE = 1e-16
_SETTLED = 1e-10
_SINGULAR = 1e-14
"""Relative size below which an eigenvalue of the information is rounding."""

_UNKNOWNS = 6


@dataclass(frozen=True)
class Fit:
    """A mounting and what the points leave open of it.

    Attributes:
        seen: the points.
        cam_from_vehicle: (4, 4).
        covariance: (6, 6) of its left tangent; infinite on the diagonal where the points leave it free.
        factor: q, what the stated variances are multiplied by.
        right: (N,) probability that each point is right.
        log_posterior: of the mounting, up to a constant of the points.
    """

    seen: Seen
    cam_from_vehicle: FloatArray
    covariance: FloatArray
    factor: float
    right: FloatArray
    log_posterior: float

    @property
    def is_right(self) -> np.ndarray:
        """Which points (N,) are more likely right than wrong."""
        return np.asarray(self.right > 0.5)


def fit_mountings(seen: Seen, starts: int = _REFINED, rounds: int = _ROUNDS) -> list[Fit]:
    """Mountings that explain the points, the most likely first; none where all points lie on a line.

    Args:
        seen: the points.
        starts: how many are refined.
        rounds: whitenings that each may take.
    """
    found: list[Fit] = []
    for start in _starts(seen, starts):
        fit = _refine(seen, start, rounds)
        if not any(np.array_equal(fit.is_right, other.is_right) and _near(fit, other) for other in found):
            found.append(fit)
    return sorted(found, key=lambda one: -one.log_posterior)


def _near(fit: Fit, other: Fit) -> bool:
    """Whether two fits are one up to their convergence."""
    return bool(np.abs(fit.cam_from_vehicle - other.cam_from_vehicle).max() < 1e-3)


def _starts(seen: Seen, count: int) -> list[FloatArray]:
    """The most likely mountings (4, 4) by direct linear transforms."""
    weights = torch.as_tensor(_subsets(seen.count))
    ground = torch.as_tensor(seen.points_vehicle).expand(len(weights), -1, -1)
    pixels = torch.as_tensor(seen.pinhole_px).expand(len(weights), -1, -1)
    homographies = find_homography_dlt(ground, pixels, weights).numpy()
    mountings = []
    for matrix in homographies:
        if np.isfinite(matrix).all() and 1 / np.linalg.cond(matrix) > _SINGULAR:
            mounting = extrinsic_from_ipm(seen.info, np.linalg.inv(matrix))
            if np.isfinite(mounting).all():
                mountings.append(mounting)
    if not mountings:
        return []
    candidates = np.array(mountings)
    covariance = seen.covariance(candidates)
    square = squared(seen.residual_px(candidates), covariance)
    scores = np.max(
        [_log_posterior(seen, square, covariance, np.full(len(candidates), q)) for q in _FACTORS], axis=0
    )
    best = np.argsort(-scores, kind="stable")[:count].tolist()
    return [candidates[k] for k in best]


def _subsets(count: int) -> FloatArray:
    """Weights (S, N): all points, then subsets of four of them."""
    if comb(count, 4) <= _SUBSETS:
        chosen = np.array(list(combinations(range(count), 4)))
    else:
        rng = np.random.default_rng(0)
        chosen = np.array([rng.choice(count, 4, replace=False) for _ in range(_SUBSETS)])
    weights = np.zeros((len(chosen) + 1, count))
    weights[0] = 1.0
    np.put_along_axis(weights[1:], chosen, 1.0, axis=1)
    return weights


def _log_posterior(seen: Seen, square: FloatArray, covariance: FloatArray, factor: FloatArray) -> FloatArray:
    total, _ = mixture(seen, log_right(square, covariance, factor))
    return np.asarray(total.sum(axis=-1) + log_prior_of_factor(factor))


def _refine(seen: Seen, start: FloatArray, rounds: int) -> Fit:
    """The optimum that a start leads to."""
    mounting = torch.as_tensor(start)
    covariance = seen.covariance(start)
    square = squared(seen.residual_px(start), covariance)
    scores = [float(_log_posterior(seen, square, covariance, np.array(q))) for q in _FACTORS]
    factor = float(_FACTORS[int(np.argmax(scores))])
    before = -np.inf
    for _ in range(rounds):
        now = mounting.numpy()
        covariance = seen.covariance(now)
        square = squared(seen.residual_px(now), covariance)
        _, right = mixture(seen, log_right(square, covariance, np.array(factor)))
        # The mounting takes six of the right points' coordinates, so that fewer are left to tell q.
        free = max(2 * right.sum() - _UNKNOWNS, 0.0)
        factor = float((right @ square + STATED_AS) / (free + STATED_AS))
        after = float(_log_posterior(seen, square, covariance, np.array(factor)))
        if abs(after - before) < _SETTLED * max(abs(after), 1.0):
            break
        before = after
        mounting = _descend(seen, mounting, covariance, factor, right)
    final = mounting.numpy()
    information = _information(seen, final, covariance, right) / factor
    return Fit(seen, final, _inverse(information), factor, right, after)


def _descend(
    seen: Seen, mounting: Tensor, covariance: FloatArray, factor: float, right: FloatArray
) -> Tensor:
    """The mounting after one whitening, of a given q and V."""
    values, axes = np.linalg.eigh(_information(seen, mounting.numpy(), covariance, right) / factor)
    values = np.maximum(values, _SINGULAR * max(values[-1], 1e-300))
    whiten = torch.as_tensor(axes / np.sqrt(values))
    root = torch.linalg.inv(torch.linalg.cholesky(torch.as_tensor(factor * covariance)))
    volume = np.pi * 2 * factor * np.sqrt(np.linalg.det(covariance))
    # A wrong point's density as a share of a right one's at its best.
    anywhere = torch.as_tensor(WRONG_SHARE / (1 - WRONG_SHARE) * np.exp(seen.log_anywhere) * volume)

    def cost_at(whitened: Tensor) -> Tensor:
        residual = seen.residual(exp(whiten @ whitened) @ mounting)
        half = 0.5 * (root @ residual[..., None])[..., 0].square().sum(-1)
        return (torch.log1p(anywhere) - torch.logaddexp(-half, torch.log(anywhere))).sum()

    def objective(whitened: Tensor) -> tuple[Tensor, Tensor]:
        at = whitened.detach().requires_grad_()
        with torch.enable_grad():
            cost = cost_at(at)
            (gradient,) = torch.autograd.grad(cost, at)
        return cost.detach(), gradient

    zero = torch.zeros(_UNKNOWNS, dtype=torch.float64)
    cost, gradient = objective(zero)
    if not float(gradient.abs().sum()) > 0:
        return mounting
    reached = minimise(objective, cost, gradient, _TOLERANCE, _LBFGS_STEPS).whitened
    return exp(whiten @ reached) @ mounting


def _information(seen: Seen, mounting: FloatArray, covariance: FloatArray, right: FloatArray) -> FloatArray:
    """The Gauss-Newton information (6, 6) for q = 1."""
    slopes = seen.jacobian(mounting)
    weighted = right[:, None, None] * np.linalg.solve(covariance, slopes)
    return np.asarray(np.einsum("nij,nik->jk", slopes, weighted))


def _inverse(information: FloatArray) -> FloatArray:
    """Its inverse; infinite variances where it is singular."""
    scale = np.sqrt(np.diag(information))
    if not (scale > 0).all():
        return np.diag(np.full(_UNKNOWNS, np.inf))
    values, axes = np.linalg.eigh(information / np.outer(scale, scale))
    if values[0] < 1e-12 * values[-1]:
        return np.diag(np.full(_UNKNOWNS, np.inf))
    return np.asarray((axes / values) @ axes.T / np.outer(scale, scale))
