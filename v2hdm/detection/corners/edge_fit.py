"""Corners of near markings: each side's edge located in many grey profiles, corners where lines meet.

All markings of an image are fitted at once. A profile across a side is modelled as
``low + amplitude * Phi(-(t - offset) / blur)`` along the outward normal, t in px; lines are fitted
to the offsets by iteratively reweighted least squares with Tukey's biweight, so gaps, chips and
stains are voted out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.corners.correlation import variance_inflation
from v2hdm.detection.corners.covariance import corner_covariance
from v2hdm.detection.corners.grey import GreyBand
from v2hdm.detection.corners.normal import normal_cdf, normal_pdf
from v2hdm.geometry.quadrilateral import (
    following,
    interior_angles,
    intersect_sides,
    preceding,
    side_frames,
    width,
)
from v2hdm.records import BoolArray, FloatArray

_SEARCH_PX = 6.0
_SEARCH_PROFILES = 16
_SEARCH_SAMPLES = 25
_SEARCH_ITERATIONS = 3
_STRONG_SHARE = 0.3
_MAX_MOVE_PX = 24.0

_FIT_PX = 2.5
_FIT_PROFILES = 24
_FIT_SAMPLES = 13
_FIT_ITERATIONS = 4
_LAST_SHIFT_PX = 2.4
_MAX_UNEXPLAINED = 0.2
_START_BLUR_PX = 0.8
_BLUR_LIMITS_PX = (0.35, 3.0)
_INTERPOLATION_VARIANCE = 0.35**2

_LINE_ITERATIONS = 6
_SCATTER_ITERATIONS = 3
_TUKEY = 4.685
_MIN_SCATTER_PX = 0.02
_MIN_INLIERS = 8
_SHARP_SCATTER_PX = 0.1
_MOST_FRAYED_PX = 1.5
_FRAYED_SHARE = 0.8
"""Offsets of a sharp edge scatter by less than this, those of paint by not much more than that; what is over
is by this share an error of the whole side."""

_MAX_CORRELATION = 0.85


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

    sides: _Sides
    offset: FloatArray
    slope: FloatArray
    covariance: FloatArray
    inliers: FloatArray

    def corners(self) -> FloatArray:
        """Where neighbouring lines meet (M, 4, 2)."""
        point = self.sides.middle + self.sides.normal * self.offset[..., None]
        return intersect_sides(point, self.tilted_normal())

    def tilted_normal(self) -> FloatArray:
        """Normals (M, 4, 2) of the fitted lines, not of unit length: n - slope * t."""
        return self.sides.normal - self.slope[..., None] * self.sides.tangent


def fit_edges(grey: GreyBand, view: CameraView, corners_pinhole_px: FloatArray) -> EdgeFit:
    """Locate the sides of markings (M, 4, 2) that start within a few px of ``corners_pinhole_px``."""
    reach = np.clip(0.4 * width(corners_pinhole_px), 2.0, _SEARCH_PX)
    moved = _search_lines(grey, view, corners_pinhole_px, reach).corners()
    usable = np.isfinite(moved).all(axis=-1)
    usable &= np.abs(moved - corners_pinhole_px).max(axis=-1) < _MAX_MOVE_PX
    return _fit_lines(grey, view, np.where(usable[..., None], moved, corners_pinhole_px))


def _search_lines(grey: GreyBand, view: CameraView, corners: FloatArray, reach: FloatArray) -> _Lines:
    """Lines through the strongest falls of grey value outwards, within ``reach`` (M,) px of the sides."""
    place = np.linspace(-1.0, 1.0, _SEARCH_SAMPLES)
    sides = _Sides.of(corners, reach, _SEARCH_PROFILES)
    values = _profiles(grey, view, sides, place[:, None, None, None] * reach[:, None, None])
    values[~np.isfinite(values)] = np.nan
    half = _SEARCH_SAMPLES // 8
    total = np.zeros((_SEARCH_SAMPLES + 1, *values.shape[1:]), dtype=np.float32)
    np.cumsum(values, axis=0, out=total[1:])
    inside = total[half : -half - 1] - total[: -2 * half - 1]
    fall = inside - total[2 * half + 1 :] + total[half + 1 : -half]
    fall[np.isnan(fall)] = 0.0
    best = fall.argmax(axis=0)
    step = fall.max(axis=0)
    offset = place[best + half] * reach[:, None, None]
    strong = (step > 0) & (step > _STRONG_SHARE * step.max(axis=(1, 2), keepdims=True))
    return _robust_lines(sides, offset, strong, _SEARCH_ITERATIONS)


def _fit_lines(grey: GreyBand, view: CameraView, corners: FloatArray) -> EdgeFit:
    t = np.linspace(-_FIT_PX, _FIT_PX, _FIT_SAMPLES)[:, None, None, None]
    sides = _Sides.of(corners, np.full(len(corners), _FIT_PX), _FIT_PROFILES)
    profile = _fit_profiles(_profiles(grey, view, sides, t), t.astype(np.float32))
    lines = _robust_lines(sides, profile.offset, profile.good, _LINE_ITERATIONS)
    found = lines.inliers >= _MIN_INLIERS
    fitted = lines.corners()
    both = found & preceding(found, -1) & np.isfinite(fitted).all(axis=-1)
    corners = np.where(both[..., None], fitted, corners)
    return EdgeFit(
        corners_pinhole_px=corners,
        covariance=corner_covariance(
            corners, sides.middle, sides.tangent, lines.tilted_normal(), lines.covariance, both
        ),
        side_found=found,
        side_blur_px=np.sqrt(np.maximum(profile.blur**2 - _INTERPOLATION_VARIANCE, 0.0)),
        side_low=_masked_median(profile.low, profile.good),
        side_amplitude=_masked_median(profile.amplitude, profile.good),
    )


@dataclass(frozen=True)
class _Sides:
    """The sides of M markings and where ``along`` (M, 4, n) them, from their middles, profiles cross them.

    ``middle``, ``tangent`` and outward ``normal`` are (M, 4, 2).
    """

    middle: FloatArray
    tangent: FloatArray
    normal: FloatArray
    along: FloatArray

    @classmethod
    def of(cls, corners: FloatArray, reach: FloatArray, profiles: int) -> _Sides:
        """The sides between ``corners`` (M, 4, 2), with profiles of ``reach`` (M,) px to either side.

        Profiles keep off the corners, so that none crosses a neighbouring side or its blur.
        """
        tangent, normal, length = side_frames(corners)
        angle = interior_angles(corners)
        cotangent = np.maximum(1 / np.tan(np.clip(angle, 0.1, np.pi / 2)), 0.0)
        margin = reach[:, None] * cotangent + 2.0 / np.sin(angle)
        first = np.minimum(margin, 0.35 * length)
        last = length - np.minimum(following(margin, -1), 0.35 * length)
        fraction = (np.arange(profiles) + 0.5) / profiles
        along = (first - length / 2)[..., None] + (last - first)[..., None] * fraction
        return cls((corners + following(corners)) / 2, tangent, normal, along)


def _profiles(grey: GreyBand, view: CameraView, sides: _Sides, t: FloatArray) -> np.ndarray:
    """Grey values (samples, M, 4, n) at ``t`` (samples, M or 1, 1, 1) px along the outward normals."""
    foot = sides.middle[:, :, None] + sides.along[..., None] * sides.tangent[:, :, None]
    ends = foot + t[[0, -1], ..., None] * sides.normal[:, :, None]
    first, last = view.distort(ends.reshape(-1, 2)).reshape(2, -1, 2).astype(np.float32)
    # Across a dozen px the lens is straight to a hundredth of a px, so only the ends are distorted.
    share = np.linspace(0.0, 1.0, len(t), dtype=np.float32)[:, None, None]
    return grey.sample(first + share * (last - first)).reshape(len(t), *sides.along.shape)


@dataclass(frozen=True)
class _ProfileFit:
    """Of profiles (M, 4, n): ``offset`` px, ``low``, ``amplitude``, if ``good``; ``blur`` (M, 4) px."""

    offset: FloatArray
    low: FloatArray
    amplitude: FloatArray
    good: BoolArray
    blur: FloatArray


def _fit_profiles(values: np.ndarray, t: np.ndarray) -> _ProfileFit:
    """Gauss-Newton on every profile (samples, M, 4, n) at once; the blur is shared by a side.

    The levels are eliminated: only the part of the derivative that they cannot mimic moves the edge.
    """
    finite = np.isfinite(values).all(axis=0)
    y = np.where(finite, values, np.float32(0))
    mean = y.sum(axis=0) / len(t)
    y -= mean
    offset = np.zeros(finite.shape, dtype=np.float32)
    blur = np.full((*finite.shape[:2], 1), _START_BLUR_PX, dtype=np.float32)
    for _ in range(_FIT_ITERATIONS):
        x = (offset - t) / blur
        slope = normal_pdf(x)
        shape = normal_cdf(x, slope)
        mean_shape = shape.sum(axis=0) / len(t)
        shape -= mean_shape
        power = np.maximum((shape * shape).sum(axis=0), 1e-9)
        amplitude = (shape * y).sum(axis=0) / power
        residual = y - amplitude * shape
        usable = finite & (amplitude > 1e-4)
        slope *= amplitude / blur
        slope -= slope.sum(axis=0) / len(t)
        slope -= shape * ((shape * slope).sum(axis=0) / power)
        shift = (slope * residual).sum(axis=0) / np.maximum((slope * slope).sum(axis=0), 1e-12)
        offset = np.clip(offset + usable * np.clip(shift, -0.7, 0.7), -_FIT_PX, _FIT_PX)
        x *= slope
        blur = _update_blur(blur, x, residual, usable & (np.abs(offset) < _LAST_SHIFT_PX))
    explained = (residual * residual).sum(axis=0) < _MAX_UNEXPLAINED * np.maximum((y * y).sum(axis=0), 1e-12)
    typical = _masked_median(amplitude, usable).max(axis=1)[:, None, None]
    good = usable & (np.abs(offset) < _LAST_SHIFT_PX) & explained
    good &= (amplitude > 0.35 * typical) & (amplitude < 2.5 * typical)
    low = mean - amplitude * mean_shape
    return _ProfileFit(offset.astype(np.float64), low, amplitude, good, blur[..., 0].astype(np.float64))


def _update_blur(
    blur: np.ndarray, by_less: np.ndarray, residual: np.ndarray, usable: BoolArray
) -> np.ndarray:
    """One Gauss-Newton step on each side's blur (M, 4, 1), from the profiles (M, 4, n) that are usable.

    ``by_less`` (samples, M, 4, n) is the derivative by less blur.
    """
    gradient = (usable * (by_less * residual).sum(axis=0)).sum(axis=2, keepdims=True)
    power = (usable * (by_less * by_less).sum(axis=0)).sum(axis=2, keepdims=True)
    change = np.clip(gradient / np.maximum(power, 1e-12), -0.3, 0.3)
    return np.asarray(np.clip(blur - change, *_BLUR_LIMITS_PX), dtype=np.float32)


def _robust_lines(sides: _Sides, offset: FloatArray, good: BoolArray, iterations: int) -> _Lines:
    """Tukey lines through offsets (M, 4, n) at the profiles of the sides; the scatter soon stays as it is."""
    along = sides.along
    weight = good.astype(np.float64)
    terms = np.stack([np.ones_like(along), along, along * along, offset, along * offset], axis=-1)
    middle = np.maximum(good.sum(axis=-1) - 1, 0) // 2
    for iteration in range(iterations):
        constant, slope, sums = _weighted_line(weight, terms)
        residual = offset - constant[..., None] - slope[..., None] * along
        if iteration < _SCATTER_ITERATIONS:
            ordered = np.sort(np.where(good, np.abs(residual), np.inf), axis=-1)
            scatter = 1.4826 * _picked(ordered, middle)[..., None]
            per_limit = 1 / (_TUKEY * np.maximum(scatter, _MIN_SCATTER_PX))
        ratio = residual * per_limit
        weight = good * np.maximum(1 - ratio * ratio, 0) ** 2
    inliers = (weight > 0.1).sum(axis=-1)
    variance = (weight * residual**2).sum(axis=-1) / np.maximum(weight.sum(axis=-1) - 2, 1)
    variance = np.maximum(variance, _MIN_SCATTER_PX**2)
    neighbours = weight[..., 1:] * weight[..., :-1]
    variance *= variance_inflation(residual[..., 1:], residual[..., :-1], neighbours, _MAX_CORRELATION)
    covariance = variance[..., None, None] * _line_covariance(*sums)
    frayed = _frayed_px(residual, good)
    covariance[..., 0, 0] += frayed**2
    covariance[..., 1, 1] += (frayed / np.maximum(np.abs(along).max(axis=-1), 1.0)) ** 2
    return _Lines(sides, constant, slope, covariance, inliers)


def _frayed_px(residual: FloatArray, good: BoolArray) -> FloatArray:
    """By how much sides (M, 4) may be off as a whole, from the residuals of all their good profiles.

    Paint wears from its edges inwards, in chips longer than the profiles are apart: what scatters by more
    than a sharp edge does has no mean of zero.
    """
    square = (good * np.minimum(residual * residual, _MOST_FRAYED_PX**2)).sum(axis=-1)
    scatter = np.sqrt(square / np.maximum(good.sum(axis=-1), 1))
    return np.asarray(_FRAYED_SHARE * np.maximum(scatter - _SHARP_SCATTER_PX, 0.0))


_Sums = tuple[FloatArray, FloatArray, FloatArray]
"""Weighted sums (...) of 1, x and x^2."""


def _weighted_line(weight: FloatArray, terms: FloatArray) -> tuple[FloatArray, FloatArray, _Sums]:
    """Constant, slope and sums of lines from ``terms`` (..., n, 5): 1, x, x^2, y, x y."""
    s0, s1, s2, t0, t1 = np.moveaxis((weight[..., None, :] @ terms)[..., 0, :], -1, 0)
    s0, s2 = s0 + 1e-9, s2 + 1e-9
    determinant = np.maximum(s0 * s2 - s1 * s1, 1e-12)
    return (s2 * t0 - s1 * t1) / determinant, (s0 * t1 - s1 * t0) / determinant, (s0, s1, s2)


def _line_covariance(s0: FloatArray, s1: FloatArray, s2: FloatArray) -> FloatArray:
    """Covariance (..., 2, 2) of constant and slope for a variance of 1, from their sums."""
    inverse = np.stack([s2, -s1, -s1, s0], axis=-1) / np.maximum(s0 * s2 - s1 * s1, 1e-12)[..., None]
    return np.asarray(inverse.reshape(*s0.shape, 2, 2))


def _masked_median(values: np.ndarray, mask: BoolArray) -> np.ndarray:
    """Median along the last axis of the values under the mask; 0 where there is none."""
    ordered = np.sort(np.where(mask, values, np.inf), axis=-1)
    count = mask.sum(axis=-1)
    last = values.shape[-1] - 1
    low = _picked(ordered, np.maximum(count - 1, 0) // 2)
    high = _picked(ordered, np.minimum(count // 2, last))
    return np.where(count > 0, (low + high) / 2, 0.0)


def _picked(values: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Elements (M, 4) of values (M, 4, n) at the places (M, 4)."""
    flat = values.reshape(-1, values.shape[-1])
    return np.asarray(flat[np.arange(place.size), place.ravel()].reshape(place.shape))
