"""How well surveyed points agree with a mounting and with the intrinsics."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2, f

from v2hdm.calibration.fit import Fit, fit_mountings
from v2hdm.calibration.likelihood import STATED_AS, Seen
from v2hdm.geometry.ipm import (
    apply_in_front,
    facing_ipm,
    homography_jacobian,
    ipm_from_extrinsic,
    pinhole_px_from_ground,
    project_ground,
)
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.records import CameraInfo, FloatArray

_UNKNOWNS = 6
_FOCAL_ROUNDS = 3
_AROUND = 12
"""Places on the circle of :func:`known_around`."""


@dataclass(frozen=True)
class Residuals:
    """N points under a mounting.

    Attributes:
        off_px: (N, 2) recorded less predicted pixel.
        off_m: (N, 2) where the IPM puts the pixel, less where the point was surveyed; nan above the horizon.
        sigmas: (N,) distance of the point from what all others predict, in standard deviations.
        probability: (N,) of a right point being as far off by chance.
        known_m: (N,) standard deviation of the IPM there, in the direction known worst.
    """

    off_px: FloatArray
    off_m: FloatArray
    sigmas: FloatArray
    probability: FloatArray
    known_m: FloatArray


def residuals(fit: Fit) -> Residuals:
    """The residuals of every point, wrong ones included."""
    seen, mounting = fit.seen, fit.cam_from_vehicle
    predicted, depth = project_ground(seen.info.intrinsic, mounting, seen.points_vehicle)
    off_px = np.where(depth[:, None] > 0, seen.points_px - distort_points(seen.info, predicted), np.nan)
    ipm = facing_ipm(ipm_from_extrinsic(seen.info, mounting), _ground_in_view(fit))
    off_m = apply_in_front(ipm, undistort_points(seen.info, seen.points_px)) - seen.points_vehicle
    slopes = seen.jacobian(mounting)
    stated = seen.covariance(mounting)
    by_mounting = slopes @ (fit.covariance / fit.factor) @ np.swapaxes(slopes, 1, 2)
    sigmas, probability = _held_out(fit, stated, by_mounting)
    return Residuals(
        off_px=off_px,
        off_m=np.asarray(off_m),
        sigmas=sigmas,
        probability=probability,
        known_m=known_ground(fit, seen.points_vehicle),
    )


def _ground_in_view(fit: Fit) -> FloatArray:
    """A right point, in front of the camera."""
    _, depth = project_ground(fit.seen.info.intrinsic, fit.cam_from_vehicle, fit.seen.points_vehicle)
    return np.asarray(fit.seen.points_vehicle[int(np.argmax(np.where(depth > 0, fit.right, -1.0)))])


def known_ground(fit: Fit, places_vehicle: FloatArray) -> FloatArray:
    """Standard deviation (M,) of the IPM at ground places (M, 2), in the direction known worst, m.

    Infinite for places behind the camera.
    """
    seen, mounting = fit.seen, fit.cam_from_vehicle
    count = len(places_vehicle)
    places = replace(
        seen,
        points_px=np.zeros((count, 2)),
        pinhole_px=np.zeros((count, 2)),
        by_pinhole=np.broadcast_to(np.eye(2), (count, 2, 2)),
        points_vehicle=places_vehicle,
    )
    slopes = places.jacobian(mounting)
    homography = pinhole_px_from_ground(seen.info.intrinsic, mounting)
    by_ground = homography_jacobian(homography, places_vehicle)
    in_front = np.isfinite(by_ground).all(axis=(1, 2))
    out = np.full(count, np.inf)
    back = np.linalg.inv(by_ground[in_front]) @ slopes[in_front]
    on_ground = back @ fit.covariance @ np.swapaxes(back, 1, 2)
    out[in_front] = np.sqrt(np.maximum(np.linalg.eigvalsh(on_ground)[:, -1], 0.0))
    return out


def known_around(fit: Fit) -> float:
    """The worst of :func:`known_ground` at the right points and on a circle around them, as wide as they are.

    Points along a line know the ground on that line, and none beside it.
    """
    right = fit.seen.points_vehicle[fit.is_right]
    radius = np.ptp(right, axis=0).max() / 2
    angles = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    middle = (right.min(axis=0) + right.max(axis=0)) / 2
    circle = middle + radius * np.column_stack([np.cos(angles), np.sin(angles)])
    known = known_ground(fit, np.vstack([right, circle]))
    in_front = known[np.isfinite(known)]
    return float(in_front.max()) if len(in_front) else np.inf


def _held_out(fit: Fit, stated: FloatArray, by_mounting: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far each point is from what the others predict, under the noise that the others show.

    Of a point that took part, q V - J C J' is the covariance of its residual, of another q V + J C J': either
    way r' cov^-1 r is its squared distance from the others' prediction.
    """
    residual = fit.seen.residual_px(fit.cam_from_vehicle)
    took_part = np.where(fit.is_right, -1.0, 1.0)[:, None, None]
    inverse = np.linalg.pinv(stated + took_part * by_mounting, rcond=1e-9, hermitian=True)
    square = np.einsum("ni,nij,nj->n", residual, inverse, residual)
    own = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(stated), residual)
    total = float(own[fit.is_right].sum())
    count = 2.0 * (fit.is_right.sum() - fit.is_right)
    free = np.maximum(count - _UNKNOWNS, 0.0) + STATED_AS
    others = (np.maximum(total - np.where(fit.is_right, square, 0.0), 0.0) + STATED_AS) / free
    ratio = square / others
    return np.sqrt(ratio), np.asarray(f.sf(ratio / 2, 2, free))


@dataclass(frozen=True)
class Scatter:
    """By how much the right points scatter more than stated, and the chance of that or more."""

    ratio: float
    limit: float
    probability: float


def scatter(fit: Fit, chance: float) -> Scatter:
    """The chi-square of the right points against the noise as stated; ``limit`` belongs to ``chance``."""
    residual = fit.seen.residual_px(fit.cam_from_vehicle)[fit.is_right]
    stated = fit.seen.covariance(fit.cam_from_vehicle)[fit.is_right]
    total = float(np.einsum("ni,nij,nj->", residual, np.linalg.inv(stated), residual))
    free = max(2 * len(residual) - _UNKNOWNS, 1)
    return Scatter(
        float(np.sqrt(total / free)),
        float(np.sqrt(chi2.isf(chance, free) / free)),
        float(chi2.sf(total, free)),
    )


@dataclass(frozen=True)
class Lens:
    """Whether the points agree with the intrinsics.

    Attributes:
        probability: of as large a disagreement by chance, with both focal lengths freed.
        focal: by what share the points want the focal length longer, and the standard deviation of that.
    """

    probability: float
    focal: tuple[float, float]


def lens(fit: Fit) -> Lens:
    """Test the intrinsics: a homography has two degrees of freedom more than a mounting."""
    probability, focal, sigma = _freed(fit)
    total = 1 + focal
    for _ in range(_FOCAL_ROUNDS if abs(focal) > sigma else 0):
        points_px, points_vehicle, noise = fit.seen.points_px, fit.seen.points_vehicle, fit.seen.noise
        seen = Seen.of_pixels(points_px, points_vehicle, _longer(fit.seen.info, total), noise)
        again = fit_mountings(seen, starts=1)
        if not again:
            break
        _, focal, sigma = _freed(again[0])
        total *= 1 + focal
    return Lens(probability, (total - 1, sigma))


def _freed(fit: Fit) -> tuple[float, float, float]:
    """The chance of the disagreement, and the focal length's relative error with its sigma."""
    seen = fit.seen
    right = fit.is_right
    stated = np.linalg.inv(seen.covariance(fit.cam_from_vehicle)[right])
    slopes = seen.jacobian(fit.cam_from_vehicle)[right]
    residual = seen.residual_px(fit.cam_from_vehicle)[right]
    (cx, cy) = seen.info.intrinsic[:2, 2]
    from_centre = seen.points_px[right] - (cx, cy)
    # Longer by a share, a focal length moves the predicted pixel away from the centre by that share.
    each = np.zeros((len(residual), 2, 2))
    each[:, [0, 1], [0, 1]] = from_centre
    gains = {}
    for name, more in (("both", each), ("one", from_centre[..., None])):
        own = np.einsum("nij,nik,njl->kl", stated, more, more)
        shared = np.einsum("nij,nik,njl->kl", stated, more, slopes)
        mounting = np.einsum("nij,nik,njl->kl", stated, slopes, slopes)
        wanted = np.einsum("nij,nik,nj->k", stated, more, residual)
        pull = np.einsum("nij,nik,nj->k", stated, slopes, residual)
        through = shared @ np.linalg.pinv(mounting)
        left, force = own - through @ shared.T, wanted - through @ pull
        step = -np.linalg.pinv(left, hermitian=True) @ force
        gains[name] = (float(-step @ force), step, left)
    total = float(np.einsum("ni,nij,nj->", residual, stated, residual))
    free = max(2 * len(residual) - _UNKNOWNS - 2, 0) + STATED_AS
    gain, _, _ = gains["both"]
    noise = (max(total - gain, 0.0) + STATED_AS) / free
    _, step, left = gains["one"]
    return float(f.sf(gain / 2 / noise, 2, free)), float(step[0]), float(np.sqrt(noise / left[0, 0]))


def _longer(info: CameraInfo, factor: float) -> CameraInfo:
    intrinsic = info.intrinsic.copy()
    intrinsic[:2, :2] *= factor
    return replace(info, intrinsic=intrinsic)
