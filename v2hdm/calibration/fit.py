r"""The most likely mounting of a camera that sees surveyed ground points.

A point k of the ground, X_k, was surveyed with an error of ``survey_m`` a coordinate and clicked with one of
``pixel_px``. To first order the recorded pixel then differs from the predicted one by r_k, of covariance

    q V_k,   V_k = pixel_px^2 I + G_k G_k' survey_m^2,   G_k the derivative of the pixel by the ground point.

A share of the points is wrong altogether, a slip of hand or pen: their pixels may be anywhere in the image.
So p(r_k) = (1 - e) N(r_k; 0, q V_k) + e / (width height). The factor q corrects the stated errors. Its prior
is a scaled inverse chi-square about 1: the statement counts as much as :data:`STATED_AS` observations.

Starts come from the direct linear transform (kornia's ``find_homography_dlt``) of all points and of many
subsets of four, of which some hold no wrong point. The most likely ones are refined by Gauss-Newton, with
the noise factor and the points' weights by expectation maximisation around it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
import torch
from kornia.geometry.conversions import convert_points_from_homogeneous
from kornia.geometry.homography import find_homography_dlt
from kornia.geometry.linalg import transform_points

from v2hdm.geometry.ipm import extrinsic_from_ipm, homography_jacobian, pinhole_px_from_ground
from v2hdm.geometry.least_squares import Normal, covariance_of, gauss_newton, normal_equations
from v2hdm.geometry.lens import distort_jacobian, undistort_points
from v2hdm.geometry.rigid import exp, hat
from v2hdm.geometry.tensors import inverse_depth
from v2hdm.records import BoolArray, CameraInfo, FloatArray

_WRONG_SHARE = 0.02  # prior probability that a point is wrong altogether: one slip in five tables of ten
STATED_AS = 4.0  # observations that the stated errors count for: people know theirs to a factor of about 1.4
UNKNOWNS = 6  # number of unknowns of a mounting

_LEAST_VARIANCE_PX2 = 1e-9  # variance, px^2, that keeps V invertible where neither error is stated

# Share of V's trace that keeps V invertible near the horizon, where one variance dwarfs the other.
_LEAST_SHARE = 1e-12

_SUBSETS = 300  # subsets of four points that are tried; of ten points these are all 210
_REFINED = 4  # starts that are refined
_SINGULAR = 1e-14  # reciprocal condition of a homography below which its points lie on a line

# Noise factors q under which a start is scored; the refinement finds its own.
_FACTORS = np.array([1.0, 10.0, 100.0, 1e3, 1e4])

_ROUNDS = 60  # rounds of expectation maximisation after which a refinement ends, converged or not
_STEPS = 30  # steps of Gauss-Newton after which a round ends, converged or not
_DAMPING = 1e-6  # damping of the steps, which keeps directions finite that the points leave free
_SETTLED = 1e-10  # relative change of the log posterior that ends the rounds
_ALIKE = 1e-3  # entries of cam_from_vehicle, m and 1, up to which two fits are one: fits converge to this


@dataclass(frozen=True)
class Noise:
    """Standard deviations a coordinate: of clicking, ``pixel_px``, and of surveying, ``survey_m``."""

    pixel_px: float = 0.5
    survey_m: float = 0.01


@dataclass(frozen=True)
class SeenPoints:
    """N points of a camera: recorded and pinhole pixels, their derivative ``by_pinhole`` (N, 2, 2)."""

    info: CameraInfo
    points_px: FloatArray
    pinhole_px: FloatArray
    by_pinhole: FloatArray
    points_vehicle: FloatArray
    noise: Noise

    @classmethod
    def of(
        cls, points_px: FloatArray, points_vehicle: FloatArray, info: CameraInfo, noise: Noise
    ) -> SeenPoints:
        """Recorded pixels (N, 2) of ground points (N, 2) as the camera ``info`` saw them."""
        pinhole_px = undistort_points(info, points_px)
        return cls(info, points_px, pinhole_px, distort_jacobian(info, pinhole_px), points_vehicle, noise)

    @property
    def count(self) -> int:
        """N."""
        return len(self.points_px)

    def covariance(self, cam_from_vehicle: FloatArray) -> FloatArray:
        """V (..., N, 2, 2), px^2, under mountings (..., 4, 4)."""
        pinhole_from_ground = pinhole_px_from_ground(self.info.intrinsic, cam_from_vehicle)
        by_ground = self.by_pinhole @ homography_jacobian(pinhole_from_ground, self.points_vehicle)
        # A point behind the camera has no pixel to err by.
        by_ground = np.nan_to_num(by_ground, nan=0.0, posinf=0.0, neginf=0.0)
        surveyed = self.noise.survey_m**2 * by_ground @ np.swapaxes(by_ground, -1, -2)
        least = _LEAST_VARIANCE_PX2 + _LEAST_SHARE * np.trace(surveyed, axis1=-2, axis2=-1)
        return np.asarray(surveyed + (self.noise.pixel_px**2 + least)[..., None, None] * np.eye(2))

    def residual_px(self, cam_from_vehicle: FloatArray) -> FloatArray:
        """Predicted less recorded pixels (..., N, 2), to first order; far off behind the camera."""
        batch = cam_from_vehicle.shape[:-2]
        mountings = torch.as_tensor(cam_from_vehicle).reshape(-1, 4, 4)
        ground = torch.as_tensor(np.column_stack([self.points_vehicle, np.zeros(self.count)]))
        cam = transform_points(mountings, ground.expand(len(mountings), -1, -1))
        reciprocal, _ = inverse_depth(cam[..., 2:])
        rays = convert_points_from_homogeneous(torch.cat([cam[..., :2], 1 / reciprocal], dim=-1))
        intrinsic = torch.as_tensor(self.info.intrinsic).expand(len(mountings), 3, 3)
        off = transform_points(intrinsic, rays).numpy() - self.pinhole_px
        return np.asarray((self.by_pinhole @ off[..., None])[..., 0].reshape((*batch, self.count, 2)))

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

    def squared(self, cam_from_vehicle: FloatArray, covariance: FloatArray) -> FloatArray:
        """Squared residuals (..., N) in standard deviations, for q = 1."""
        residual = self.residual_px(cam_from_vehicle)
        solved = np.linalg.solve(covariance, residual[..., None])[..., 0]
        return np.asarray((residual * solved).sum(axis=-1))

    def mixture(
        self, square: FloatArray, covariance: FloatArray, factor: FloatArray | float
    ) -> tuple[FloatArray, FloatArray]:
        """Log density (..., N) of points that may be wrong, and the probability that each is right."""
        q = np.asarray(factor)[..., None]
        log_right = -square / (2 * q) - np.log(2 * np.pi * q * np.sqrt(np.linalg.det(covariance)))
        right = np.log1p(-_WRONG_SHARE) + log_right
        log_anywhere = -float(np.log(self.info.width * self.info.height))
        total = np.logaddexp(right, np.log(_WRONG_SHARE) + log_anywhere)
        return total, np.asarray(np.exp(right - total))

    def log_posterior(
        self, square: FloatArray, covariance: FloatArray, factor: FloatArray | float
    ) -> FloatArray:
        """Log posterior (...), up to a constant, of mountings with these squared residuals (..., N)."""
        total, _ = self.mixture(square, covariance, factor)
        return np.asarray(total.sum(axis=-1) - 0.5 * STATED_AS * (np.log(factor) + 1 / factor - 1))


@dataclass(frozen=True)
class Fit:
    """A mounting and how well the points determine it."""

    points: SeenPoints
    cam_from_vehicle: FloatArray  # (4, 4)
    # (6, 6) of the left tangent, infinite on the diagonal where the points leave it free
    covariance: FloatArray
    factor: float  # q, of the stated variances
    right: FloatArray  # (N,) probability that each point is right
    log_posterior: float

    @property
    def is_right(self) -> BoolArray:
        """Which points (N,) are more likely right than wrong."""
        return np.asarray(self.right > 0.5)


def fit_mountings(points: SeenPoints, starts: int = _REFINED, rounds: int = _ROUNDS) -> list[Fit]:
    """Mountings that explain the points, the most likely first; none where all points lie on a line."""
    fits: list[Fit] = []
    for start in _starts(points, starts):
        fit = _refine(points, start, rounds)
        of_same_points = [other for other in fits if np.array_equal(fit.is_right, other.is_right)]
        differences = [fit.cam_from_vehicle - other.cam_from_vehicle for other in of_same_points]
        if all(np.abs(difference).max() >= _ALIKE for difference in differences):
            fits.append(fit)
    return sorted(fits, key=lambda fit: -fit.log_posterior)


def _starts(points: SeenPoints, count: int) -> list[FloatArray]:
    """The most likely mountings (4, 4) by direct linear transforms."""
    weights = torch.as_tensor(_subsets(points.count))
    ground = torch.as_tensor(points.points_vehicle).expand(len(weights), -1, -1)
    pixels = torch.as_tensor(points.pinhole_px).expand(len(weights), -1, -1)
    homographies = find_homography_dlt(ground, pixels, weights).numpy()
    regular = [
        homography
        for homography in homographies
        if np.isfinite(homography).all() and 1 / np.linalg.cond(homography) > _SINGULAR
    ]
    mountings = [extrinsic_from_ipm(points.info, np.linalg.inv(homography)) for homography in regular]
    candidates = np.array([mounting for mounting in mountings if np.isfinite(mounting).all()])
    if not len(candidates):
        return []
    covariance = points.covariance(candidates)
    square = points.squared(candidates, covariance)
    scores = points.log_posterior(square, covariance, np.tile(_FACTORS[:, None], len(candidates)))
    return [candidates[k] for k in np.argsort(-np.max(scores, axis=0), kind="stable")[:count].tolist()]


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


def _refine(points: SeenPoints, mounting: FloatArray, rounds: int) -> Fit:
    """The optimum that a start (4, 4) leads to."""
    covariance = points.covariance(mounting)
    square = points.squared(mounting, covariance)
    factor = float(_FACTORS[np.argmax(points.log_posterior(square, covariance, _FACTORS))])
    before = -np.inf
    for _ in range(rounds):
        covariance = points.covariance(mounting)
        square = points.squared(mounting, covariance)
        _, right = points.mixture(square, covariance, factor)
        # The mounting takes six of the right points' coordinates, so that fewer are left to estimate q.
        free = max(2 * right.sum() - UNKNOWNS, 0.0)
        factor = float((right @ square + STATED_AS) / (free + STATED_AS))
        after = float(points.log_posterior(square, covariance, factor))
        if abs(after - before) < _SETTLED * max(abs(after), 1.0):
            break
        before = after
        mounting = _descend(points, mounting, covariance, factor)
    slopes = points.jacobian(mounting)
    weight = right[:, None, None] / factor * np.linalg.inv(covariance)
    information = normal_equations(np.zeros((points.count, 2)), slopes, weight).information
    return Fit(points, mounting, covariance_of(information), factor, right, after)


def _descend(points: SeenPoints, mounting: FloatArray, covariance: FloatArray, factor: float) -> FloatArray:
    """The most likely mounting for a given q and V."""
    precision = np.linalg.inv(covariance) / factor

    def linearise(now: FloatArray) -> Normal:
        residual = points.residual_px(now)
        square = factor * np.einsum("ni,nij,nj->n", residual, precision, residual)
        total, right = points.mixture(square, covariance, factor)
        equations = normal_equations(residual, points.jacobian(now), right[:, None, None] * precision)
        return Normal(equations.information, equations.gradient, -float(total.sum()))

    descent = gauss_newton(
        linearise, mounting, retract=lambda now, step: exp(step) @ now, steps=_STEPS, damping=_DAMPING
    )
    return descent.x
