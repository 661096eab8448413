"""Corners of near markings: each side's edge located in many grey profiles, corners where lines meet.

All markings of an image are fitted at once. A profile across a side is modelled as
``low + amplitude * Phi(-(t - offset) / blur)`` along the outward normal, t in px; lines are fitted
to the offsets by iteratively reweighted least squares with Tukey's biweight, so gaps, chips and
stains are voted out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.grey import GreyBand
from v2hdm.detection.normal import normal_pdf_cdf
from v2hdm.detection.quad import interior_angles, intersect_sides, side_frames, width
from v2hdm.detection.view import CameraView
from v2hdm.records import BoolArray, FloatArray

_PROFILES = 24
_SEARCH_PX = 6.0
_SEARCH_SAMPLES = 25
_FIT_PX = 2.5
_FIT_SAMPLES = 13
_FIT_ITERATIONS = 4
_SEARCH_ITERATIONS = 4
_LINE_ITERATIONS = 8
_START_BLUR_PX = 0.8
_BLUR_LIMITS_PX = (0.35, 3.0)
_INTERPOLATION_VARIANCE = 0.35**2
_TUKEY = 4.685
_MIN_SCATTER_PX = 0.02
_MIN_INLIERS = 8
_LAST_SHIFT_PX = 2.4


@dataclass(frozen=True)
class EdgeFit:
    """Fitted sides of M markings.

    ``corners_pinhole_px`` (M, 4, 2) with ``covariance`` (M, 8, 8) px^2; ``side_found`` (M, 4);
    ``side_blur_px`` (M, 4) the measured edge blur, interpolation removed; ``side_low`` and
    ``side_amplitude`` (M, 4) the grey level outside and the step up to the paint.
    """

    corners_pinhole_px: FloatArray
    covariance: FloatArray
    side_found: BoolArray
    side_blur_px: FloatArray
    side_low: FloatArray
    side_amplitude: FloatArray


@dataclass(frozen=True)
class _Lines:
    """Lines through ``middle + tangent * s + normal * (offset + slope * s)`` with covariance (..., 2, 2)."""

    middle: FloatArray
    tangent: FloatArray
    normal: FloatArray
    offset: FloatArray
    slope: FloatArray
    covariance: FloatArray
    inliers: FloatArray

    def corners(self) -> FloatArray:
        """Where neighbouring lines meet (M, 4, 2)."""
        return intersect_sides(self.middle + self.normal * self.offset[..., None], self.tilted_normal())

    def tilted_normal(self) -> FloatArray:
        """Normals (M, 4, 2) of the fitted lines, not of unit length: n - slope * t."""
        return self.normal - self.slope[..., None] * self.tangent


def fit_edges(grey: GreyBand, view: CameraView, corners_pinhole_px: FloatArray) -> EdgeFit:
    """Locate the sides of markings (M, 4, 2) that start within a few px of ``corners_pinhole_px``."""
    reach = np.clip(0.4 * width(corners_pinhole_px), 2.0, _SEARCH_PX)
    found = _search_lines(grey, view, corners_pinhole_px, reach)
    moved = found.corners()
    usable = np.isfinite(moved).all(axis=-1) & (
        np.linalg.norm(moved - corners_pinhole_px, axis=-1) < 4 * _SEARCH_PX
    )
    moved = np.where(usable[..., None], moved, corners_pinhole_px)
    return _fit_lines(grey, view, moved)


def _search_lines(grey: GreyBand, view: CameraView, corners: FloatArray, reach: FloatArray) -> _Lines:
    """Lines through the strongest falls of grey value outwards, within ``reach`` (M,) px of the sides."""
    t = np.linspace(-1.0, 1.0, _SEARCH_SAMPLES) * reach[:, None]
    values, along, frames = _profiles(grey, view, corners, t, reach)
    half = 3
    total = np.cumsum(np.pad(values, [(0, 0)] * 3 + [(1, 0)]), axis=-1)
    inside = total[..., half : -half - 1] - total[..., : -2 * half - 1]
    outside = total[..., 2 * half + 1 :] - total[..., half + 1 : -half]
    fall = (inside - outside) / half
    best = np.nanargmax(np.where(np.isfinite(fall), fall, -np.inf), axis=-1)
    step = np.take_along_axis(fall, best[..., None], axis=-1)[..., 0]
    offset = np.take_along_axis(t, (best.reshape(len(t), -1) + half), axis=1).reshape(best.shape)
    strong = np.isfinite(step) & (
        step > 0.3 * np.nanmax(np.where(np.isfinite(step), step, 0), axis=(1, 2), keepdims=True)
    )
    return _robust_lines(frames, along, offset, strong, _SEARCH_ITERATIONS)


def _fit_lines(grey: GreyBand, view: CameraView, corners: FloatArray) -> EdgeFit:
    t = np.broadcast_to(np.linspace(-_FIT_PX, _FIT_PX, _FIT_SAMPLES), (len(corners), _FIT_SAMPLES))
    values, along, frames = _profiles(grey, view, corners, t, np.full(len(corners), _FIT_PX))
    profile = _fit_profiles(values, t[0].astype(np.float32))
    lines = _robust_lines(frames, along, profile.offset, profile.good, _LINE_ITERATIONS)
    found = lines.inliers >= _MIN_INLIERS
    fitted = lines.corners()
    both = found & np.roll(found, 1, axis=1) & np.isfinite(fitted).all(axis=-1)
    return EdgeFit(
        corners_pinhole_px=np.where(both[..., None], fitted, corners),
        covariance=_corner_covariance(lines, fitted, both),
        side_found=found,
        side_blur_px=np.sqrt(np.maximum(profile.blur**2 - _INTERPOLATION_VARIANCE, 0.0)),
        side_low=_masked_median(profile.low, profile.good),
        side_amplitude=_masked_median(profile.amplitude, profile.good),
    )


def _profiles(
    grey: GreyBand, view: CameraView, corners: FloatArray, t: FloatArray, reach: FloatArray
) -> tuple[np.ndarray, FloatArray, tuple[FloatArray, FloatArray, FloatArray]]:
    """Grey values (M, 4, profiles, samples) across each side, where along the side they are, its frame.

    Profiles keep off the corners, so that none crosses a neighbouring side or its blur.
    """
    tangent, normal, length = side_frames(corners)
    middle = (corners + np.roll(corners, -1, axis=1)) / 2
    angle = interior_angles(corners)
    cotangent = np.clip(1 / np.tan(np.clip(angle, 0.1, np.pi / 2)), 0.0, None)
    margin = reach[:, None] * cotangent + 2.0 / np.sin(angle)
    first = np.minimum(margin, 0.35 * length)
    last = length - np.minimum(np.roll(margin, -1, axis=1), 0.35 * length)
    fraction = (np.arange(_PROFILES) + 0.5) / _PROFILES
    along = first[..., None] + (last - first)[..., None] * fraction - length[..., None] / 2
    foot = middle[:, :, None] + along[..., None] * tangent[:, :, None]
    ends = foot[..., None, :] + t[:, None, None, [0, -1], None] * normal[:, :, None, None]
    ends_px = view.distort(ends.reshape(-1, 2)).reshape(-1, 2, 2)
    # Across a dozen px the lens is straight to a hundredth of a px, so only the ends are distorted.
    share = np.linspace(0.0, 1.0, t.shape[1])[:, None]
    points_px = ends_px[:, :1] * (1 - share) + ends_px[:, 1:] * share
    values = grey.sample(points_px).reshape(*along.shape, t.shape[1])
    return values, along, (middle, tangent, normal)


@dataclass(frozen=True)
class _ProfileFit:
    offset: FloatArray
    low: FloatArray
    amplitude: FloatArray
    good: BoolArray
    blur: FloatArray


def _fit_profiles(values: np.ndarray, t: np.ndarray) -> _ProfileFit:
    """Gauss-Newton on every profile (M, 4, n, samples) at once; the blur is shared by a side."""
    finite = np.isfinite(values).all(axis=-1)
    y = np.where(finite[..., None], values, 0).astype(np.float32)
    offset = np.zeros(y.shape[:-1], dtype=np.float32)
    blur = np.full(y.shape[:2], _START_BLUR_PX, dtype=np.float32)
    for _ in range(_FIT_ITERATIONS):
        x = (t - offset[..., None]) / blur[..., None, None]
        pdf, cdf = normal_pdf_cdf(-x)
        low, amplitude, residual = _fit_levels(cdf, y)
        usable = finite & (amplitude > 1e-4)
        slope = amplitude[..., None] * pdf / blur[..., None, None]
        # The levels are eliminated: only the part of the derivative that they cannot mimic moves the edge.
        _, _, slope = _fit_levels(cdf, slope)
        shift = (slope * residual).sum(axis=-1) / np.maximum((slope * slope).sum(axis=-1), 1e-12)
        offset = np.clip(offset + np.where(usable, np.clip(shift, -0.7, 0.7), 0), -_FIT_PX, _FIT_PX)
        blur = _update_blur(blur, x, slope, residual, usable & (np.abs(offset) < _LAST_SHIFT_PX))
    spread = y - y.mean(axis=-1, keepdims=True)
    explained = 1 - (residual**2).sum(axis=-1) / np.maximum((spread**2).sum(axis=-1), 1e-12)
    typical = _masked_median(amplitude, usable).max(axis=1)[:, None, None]
    good = (
        usable
        & (np.abs(offset) < _LAST_SHIFT_PX)
        & (explained > 0.8)
        & (amplitude > 0.35 * typical)
        & (amplitude < 2.5 * typical)
    )
    return _ProfileFit(offset.astype(np.float64), low, amplitude, good, blur.astype(np.float64))


def _fit_levels(shape: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares ``values ~ low + amplitude * shape`` along the last axis; low, amplitude, residual."""
    mean_shape = shape.mean(axis=-1, keepdims=True)
    mean_value = values.mean(axis=-1, keepdims=True)
    centred = shape - mean_shape
    amplitude = (centred * values).sum(axis=-1, keepdims=True) / np.maximum(
        (centred * centred).sum(axis=-1, keepdims=True), 1e-9
    )
    low = mean_value - amplitude * mean_shape
    return low[..., 0], amplitude[..., 0], values - low - amplitude * shape


def _update_blur(
    blur: np.ndarray, x: np.ndarray, slope: np.ndarray, residual: np.ndarray, usable: BoolArray
) -> np.ndarray:
    """One Gauss-Newton step on each side's blur (M, 4), from the profiles that are usable."""
    by_blur = np.where(usable[..., None], slope * x, 0)
    change = (by_blur * residual).sum(axis=(2, 3)) / np.maximum((by_blur * by_blur).sum(axis=(2, 3)), 1e-12)
    return np.asarray(np.clip(blur + np.clip(change, -0.3, 0.3), *_BLUR_LIMITS_PX), dtype=np.float32)


def _robust_lines(
    frames: tuple[FloatArray, FloatArray, FloatArray],
    along: FloatArray,
    offset: FloatArray,
    good: BoolArray,
    iterations: int,
) -> _Lines:
    """Tukey lines through offsets (M, 4, n) at positions ``along`` the sides."""
    weight = good.astype(np.float64)
    terms = np.stack([np.ones_like(along), along, along * along, offset, along * offset], axis=-1)
    middle = np.maximum(good.sum(axis=-1, keepdims=True) - 1, 0) // 2
    for _ in range(iterations):
        constant, slope, normal_matrix = _weighted_line(weight, terms)
        residual = offset - constant[..., None] - slope[..., None] * along
        ordered = np.sort(np.where(good, np.abs(residual), np.inf), axis=-1)
        scatter = 1.4826 * np.take_along_axis(ordered, middle, axis=-1)
        scatter = np.maximum(scatter, _MIN_SCATTER_PX)
        weight = good * np.maximum(1 - (residual / (_TUKEY * scatter)) ** 2, 0) ** 2
    inliers = (weight > 0.1).sum(axis=-1)
    variance = (weight * residual**2).sum(axis=-1) / np.maximum(weight.sum(axis=-1) - 2, 1)
    variance = np.maximum(variance, _MIN_SCATTER_PX**2) * _correlation_factor(residual, weight)
    covariance = variance[..., None, None] * np.linalg.inv(normal_matrix)
    return _Lines(*frames, constant, slope, covariance, inliers)


def _weighted_line(weight: FloatArray, terms: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Constant, slope and normal matrix of lines from ``terms`` (..., n, 5): 1, x, x^2, y, x y."""
    s0, s1, s2, t0, t1 = np.moveaxis((weight[..., None, :] @ terms)[..., 0, :], -1, 0)
    s0, s2 = s0 + 1e-9, s2 + 1e-9
    determinant = np.maximum(s0 * s2 - s1 * s1, 1e-12)
    constant, slope = (s2 * t0 - s1 * t1) / determinant, (s0 * t1 - s1 * t0) / determinant
    normal_matrix = np.stack([s0, s1, s1, s2], axis=-1).reshape(*s0.shape, 2, 2)
    return constant, slope, normal_matrix


def _correlation_factor(residual: FloatArray, weight: FloatArray) -> FloatArray:
    """By how much neighbouring profiles' correlation inflates the variance of a line: (1 + r) / (1 - r)."""
    pair = weight[..., 1:] * weight[..., :-1]
    product = (pair * residual[..., 1:] * residual[..., :-1]).sum(axis=-1)
    power = (pair * (residual[..., 1:] ** 2 + residual[..., :-1] ** 2)).sum(axis=-1) / 2
    r = np.clip(product / np.maximum(power, 1e-12), 0.0, 0.85)
    return np.asarray((1 + r) / (1 - r))


def _corner_covariance(lines: _Lines, corners: FloatArray, both: BoolArray) -> FloatArray:
    """Covariance (M, 8, 8) of corners that are intersections: neighbours share a side, so they correlate.

    A line's offset and slope move a corner by N dx = d_offset + s d_slope, N the two lines' normals.
    """
    markings = len(corners)
    jacobian = np.zeros((markings, 4, 2, 4, 2))
    normals = lines.tilted_normal()
    for corner in range(4):
        sides = [(corner - 1) % 4, corner]
        pair = normals[:, sides]
        inverse = np.linalg.inv(np.where(both[:, corner, None, None], pair, np.eye(2)))
        for n, side in enumerate(sides):
            s = ((corners[:, corner] - lines.middle[:, side]) * lines.tangent[:, side]).sum(axis=-1)
            lever = np.stack([np.ones_like(s), s], axis=-1)
            jacobian[:, corner, :, side, :] = inverse[:, :, n, None] * lever[:, None]
    jacobian[~both] = 0.0
    covariance = np.einsum("mcasi,msij,mdbsj->mcadb", jacobian, lines.covariance, jacobian, optimize=True)
    return np.asarray(covariance.reshape(markings, 8, 8))


def _masked_median(values: np.ndarray, mask: BoolArray) -> np.ndarray:
    """Median along the last axis of the values under the mask; 0 where there is none."""
    ordered = np.sort(np.where(mask, values, np.inf), axis=-1)
    count = mask.sum(axis=-1)
    last = values.shape[-1] - 1
    low = np.take_along_axis(ordered, np.clip((count - 1) // 2, 0, last)[..., None], axis=-1)[..., 0]
    high = np.take_along_axis(ordered, np.clip(count // 2, 0, last)[..., None], axis=-1)[..., 0]
    return np.where(count > 0, (low + high) / 2, 0.0)
