"""Corners of far markings: the whole quadrilateral fitted to the grey image at once.

The grey value is modelled as ``b0 + b1 C + b2 u + b3 v``, with C the quadrilateral's coverage blurred by
the point spread. Eight corner coordinates and four levels are found by Gauss-Newton with Cauchy
weights, first on a smoothed image, then on the image itself. The fit runs in recorded pixels; the
lens' small bow of the sides is undone afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from v2hdm.detection.coverage import blurred_coverage
from v2hdm.detection.grey import GreyBand
from v2hdm.detection.quad import intersect_sides, is_convex, side_frames
from v2hdm.detection.view import CameraView
from v2hdm.records import BoolArray, FloatArray

_MARGIN_PX = 4
_SMOOTHING_PX = 1.2
_MAX_PATCH = np.array([56, 48])
_COARSE_ITERATIONS = 3
_FINE_ITERATIONS = 4
_MAX_STEP_PX = 1.0
_MAX_MOVE_PX = 6.0
_DAMPING = 1e-3
_CAUCHY = 2.385
_GAUSS_POINTS = (0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0))


@dataclass(frozen=True)
class QuadFit:
    """Fitted quadrilaterals of M markings in recorded px, before the lens' bow is undone.

    ``corners_px`` (M, 4, 2), ``covariance`` (M, 8, 8) px^2, ``amplitude`` (M,) step from ground to
    paint, ``misfit`` (M,) residual over amplitude, ``settled`` (M,) whether the fit stayed near its
    start and convex.
    """

    corners_px: FloatArray
    covariance: FloatArray
    amplitude: FloatArray
    misfit: FloatArray
    settled: BoolArray


@dataclass(frozen=True)
class _Patches:
    """Pixels around each marking: ``columns`` (M, W), ``rows`` (M, H), grey ``values`` (M, H, W).

    ``smoothed`` are the grey values after a Gaussian, ``use`` is 1 where a pixel takes part.
    """

    columns: FloatArray
    rows: FloatArray
    values: np.ndarray
    smoothed: np.ndarray
    use: np.ndarray


def fit_quads(
    grey: GreyBand,
    owner: np.ndarray,
    owner_stride: int,
    blobs: np.ndarray,
    corners_px: FloatArray,
    blur_px: float,
) -> QuadFit:
    """Fit quadrilaterals that start within about 2 px of ``corners_px`` (M, 4, 2).

    Args:
        grey: the image's grey values.
        owner: (h, w) 1 + index of the blob on each logit of the same band; other blobs' pixels are ignored.
        owner_stride: pixels per logit.
        blobs: (M,) index of each marking's own blob.
        corners_px: starting corners, recorded px.
        blur_px: the point spread's standard deviation, pixel aperture included.
    """
    patches = _cut_patches(grey, owner, owner_stride, blobs, corners_px)
    coarse_blur_px = float(np.hypot(blur_px, _SMOOTHING_PX))
    corners = _iterate(patches, patches.smoothed, corners_px, coarse_blur_px, _COARSE_ITERATIONS)
    corners = _iterate(patches, patches.values, corners, blur_px, _FINE_ITERATIONS)
    system = _linearise(patches, patches.values, corners, blur_px)
    settled = (np.abs(corners - corners_px).max(axis=(1, 2)) < _MAX_MOVE_PX) & is_convex(corners)
    amplitude = system.levels[:, 1]
    return QuadFit(
        corners, _covariance(system), amplitude, system.scatter / np.maximum(amplitude, 1e-6), settled
    )


def unbow_corners(view: CameraView, corners_px: FloatArray) -> FloatArray:
    """Pinhole corners (M, 4, 2) of quadrilaterals that were fitted with straight sides in the recorded image.

    A straight line fitted to a shallow arc crosses it at the two Gauss points of their common chord; so the
    true side is the line through those two points once the lens is undone.
    """
    following = np.roll(corners_px, -1, axis=1)
    points = np.stack([corners_px * (1 - s) + following * s for s in _GAUSS_POINTS], axis=2)
    points = view.undistort(points.reshape(-1, 2)).reshape(points.shape)
    along = points[:, :, 1] - points[:, :, 0]
    normal = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    return intersect_sides(points[:, :, 0], normal)


@dataclass(frozen=True)
class _System:
    """Least squares about the current corners: ``design`` (M, 12, H, W), eight coordinates, then levels."""

    design: np.ndarray
    weight: np.ndarray
    residual: np.ndarray
    levels: FloatArray
    scatter: FloatArray


def _cut_patches(
    grey: GreyBand, owner: np.ndarray, owner_stride: int, blobs: np.ndarray, corners_px: FloatArray
) -> _Patches:
    low = np.floor(corners_px.min(axis=1)).astype(np.intp) - _MARGIN_PX
    size = (np.ceil(corners_px.max(axis=1)).astype(np.intp) + _MARGIN_PX + 1 - low).max(axis=0)
    # A large patch has pixels to spare: neighbours say nearly the same, so every second or third does.
    step = -(-size // _MAX_PATCH)
    columns, rows = (low[:, axis, None] + np.arange(0, size[axis], step[axis]) for axis in (0, 1))
    height, width = grey.values.shape
    j = np.clip(columns, 0, width - 1)[:, None, :]
    i = np.clip(rows - grey.top, 0, height - 1)[:, :, None]
    inside = (j == columns[:, None, :]) & (i == (rows - grey.top)[:, :, None])
    cell_owner = owner[i // owner_stride, j // owner_stride]
    mine = (cell_owner == 0) | (cell_owner == blobs[:, None, None] + 1)
    _, normal, _ = side_frames(corners_px)
    reach = (
        normal[..., 0, None, None] * columns[:, None, None, :]
        + normal[..., 1, None, None] * rows[:, None, :, None]
        - (normal * corners_px).sum(axis=-1)[..., None, None]
    ).max(axis=1)
    use = (inside & mine & (reach < _MARGIN_PX)).astype(np.float32)
    first, last = int(i.min()), int(i.max()) + 1
    smoothed = cv2.GaussianBlur(grey.values[first:last], (0, 0), _SMOOTHING_PX)
    return _Patches(
        columns.astype(np.float64), rows.astype(np.float64), grey.values[i, j], smoothed[i - first, j], use
    )


def _iterate(
    patches: _Patches, values: np.ndarray, corners: FloatArray, blur_px: float, iterations: int
) -> FloatArray:
    for _ in range(iterations):
        system = _linearise(patches, values, corners, blur_px)
        weighted = (system.design * system.weight[:, None]).reshape(len(corners), 12, -1)
        flat = system.design.reshape(len(corners), 12, -1)
        normal_matrix = (weighted @ np.swapaxes(flat, 1, 2)).astype(np.float64)
        gradient = (weighted @ system.residual.reshape(len(corners), -1, 1)).astype(np.float64)
        diagonal = np.einsum("mii->mi", normal_matrix)
        diagonal *= 1 + _DAMPING
        diagonal += 1e-9
        step = np.linalg.solve(normal_matrix, gradient)[:, :8, 0].reshape(-1, 4, 2)
        corners = corners + np.clip(step, -_MAX_STEP_PX, _MAX_STEP_PX)
    return corners


def _linearise(patches: _Patches, values: np.ndarray, corners: FloatArray, blur_px: float) -> _System:
    """The model and its derivative at the current corners, the best levels, and Cauchy weights."""
    markings, height, width = values.shape
    coverage, by_corner = blurred_coverage(corners, patches.columns, patches.rows, blur_px)
    centre = corners.mean(axis=1)
    design = np.empty((markings, 12, height, width), dtype=np.float32)
    design[:, 8] = 1.0
    design[:, 9] = coverage
    design[:, 10] = (patches.columns - centre[:, :1])[:, None, :] / 10
    design[:, 11] = (patches.rows - centre[:, 1:])[:, :, None] / 10
    weight = patches.use
    for _ in range(2):
        flat = design[:, 8:].reshape(markings, 4, -1)
        weighted = flat * weight.reshape(markings, 1, -1)
        matrix = (weighted @ np.swapaxes(flat, 1, 2)).astype(np.float64) + 1e-6 * np.eye(4)
        levels = np.linalg.solve(matrix, (weighted @ values.reshape(markings, -1, 1)).astype(np.float64))[
            ..., 0
        ]
        model = np.einsum("mk,mkhw->mhw", levels.astype(np.float32), design[:, 8:])
        residual = (values - model) * (patches.use > 0)
        scatter = np.maximum(1.4826 * _median_used(np.abs(residual), patches.use), 2e-3)
        weight = patches.use / (1 + (residual / (_CAUCHY * scatter[:, None, None])) ** 2)
    amplitude = np.maximum(levels[:, 1], 1e-3).astype(np.float32)
    design[:, :8] = amplitude[:, None, None, None] * by_corner.reshape(markings, 8, height, width)
    rms = np.sqrt((patches.use * residual**2).sum(axis=(1, 2)) / np.maximum(patches.use.sum(axis=(1, 2)), 1))
    return _System(
        design, weight.astype(np.float32), residual.astype(np.float32), levels, rms.astype(np.float64)
    )


def _covariance(system: _System) -> FloatArray:
    """Corner covariance (M, 8, 8) from the residuals, inflated by their correlation in both directions."""
    markings = len(system.weight)
    flat = system.design.reshape(markings, 12, -1).astype(np.float64)
    weight = system.weight.reshape(markings, 1, -1)
    information = (flat * weight) @ np.swapaxes(flat, 1, 2) + 1e-9 * np.eye(12)
    effective = np.maximum(system.weight.sum(axis=(1, 2)) - 12, 1)
    variance = (system.weight * system.residual**2).sum(axis=(1, 2)) / effective
    factor = np.ones(markings)
    for axis in (1, 2):
        factor *= _correlation_factor(system.residual, system.weight, axis)
    return np.asarray((variance * factor)[:, None, None] * np.linalg.inv(information)[:, :8, :8])


def _correlation_factor(residual: np.ndarray, weight: np.ndarray, axis: int) -> FloatArray:
    """(1 + r) / (1 - r), with r (M,) the correlation of neighbouring residuals along an axis."""
    first = np.take(residual, np.arange(residual.shape[axis] - 1), axis)
    second = np.take(residual, np.arange(1, residual.shape[axis]), axis)
    pair = np.take(weight, np.arange(weight.shape[axis] - 1), axis) * np.take(
        weight, np.arange(1, weight.shape[axis]), axis
    )
    power = (pair * (first**2 + second**2)).sum(axis=(1, 2)) / 2
    r = np.clip((pair * first * second).sum(axis=(1, 2)) / np.maximum(power, 1e-12), 0.0, 0.7)
    return np.asarray((1 + r) / (1 - r), dtype=np.float64)


def _median_used(values: np.ndarray, use: np.ndarray) -> FloatArray:
    """Median (M,) of values (M, H, W) where ``use`` is set."""
    markings = len(values)
    ordered = np.sort(np.where(use > 0, values, np.inf).reshape(markings, -1), axis=1)
    middle = np.maximum((use > 0).sum(axis=(1, 2)) // 2 - 1, 0)
    median = ordered[np.arange(markings), middle]
    return np.where(np.isfinite(median), median, 0.0).astype(np.float64)
