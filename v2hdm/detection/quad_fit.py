"""Corners of far markings: the whole quadrilateral fitted to the grey image at once.

The grey value is modelled as ``b0 + b1 C + b2 u + b3 v``, with C the quadrilateral's coverage blurred by
the point spread. The ends of the four sides and four levels are found by Gauss-Newton with Cauchy
weights, first with a wider blur, which sees farther, then with the image's own. The fit runs in
recorded pixels; the lens' small bow of the sides is undone afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.coverage import blurred_coverage
from v2hdm.detection.grey import GreyBand
from v2hdm.detection.patches import Patches, cut_patches
from v2hdm.detection.quad import intersect_sides, is_convex, side_frames
from v2hdm.detection.view import CameraView
from v2hdm.records import BoolArray, FloatArray

_WIDER_BLUR_PX = 0.8
_COARSE_ITERATIONS = 3
_FINE_ITERATIONS = 3
_COARSE_STEP_PX = 0.5
_FINE_STEP_PX = 0.1
_MAX_SIDE_STEP_PX = 1.0
_MAX_CORNER_STEP_PX = 4.0
_MAX_MOVE_PX = 6.0
_DAMPING = 1e-3
_CAUCHY = 2.385
_MIN_SCATTER = 2e-3
_MIN_AMPLITUDE = 1e-3
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
    patches = cut_patches(grey, owner, owner_stride, blobs, corners_px)
    start = corners_px - patches.origin_px[:, None]
    wider_px = float(np.hypot(blur_px, _WIDER_BLUR_PX))
    corners, _ = _iterate(patches, start, wider_px, _COARSE_ITERATIONS, _COARSE_STEP_PX)
    corners, system = _iterate(patches, corners, blur_px, _FINE_ITERATIONS, _FINE_STEP_PX)
    settled = (np.abs(corners - start).max(axis=(1, 2)) < _MAX_MOVE_PX) & is_convex(corners)
    rms = np.sqrt((patches.use * system.residual**2).sum(axis=1) / np.maximum(patches.use.sum(axis=1), 1))
    return QuadFit(
        corners + patches.origin_px[:, None],
        _covariance(system, patches),
        system.amplitude,
        rms / system.amplitude,
        settled,
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
    """Least squares about the current corners of M markings with N pixels.

    The unknowns are moves of the four sides' starts, of their ends, then the levels. ``weight`` and
    ``residual`` (M, N); ``information`` (M, 12, 12) and ``gradient`` (M, 12), weighted;
    ``corner_from_side`` (M, 8, 8) takes moves of the sides to moves of the corners; ``amplitude`` (M,).
    """

    weight: np.ndarray
    residual: np.ndarray
    information: FloatArray
    gradient: FloatArray
    corner_from_side: FloatArray
    amplitude: FloatArray

    def put(self, rows: np.ndarray, other: _System) -> None:
        """Overwrite the markings ``rows`` with those of ``other``."""
        for name, value in vars(self).items():
            value[rows] = getattr(other, name)


def _iterate(
    patches: Patches, corners: FloatArray, blur_px: float, iterations: int, enough_px: float
) -> tuple[FloatArray, _System]:
    """Gauss-Newton until each marking's step is below ``enough_px``; the system is that of its last step."""
    corners = corners.copy()
    running = np.arange(len(corners))
    system = None
    for _ in range(iterations):
        part = _linearise(patches, corners[running], blur_px, system.weight[running] if system else None)
        if system is None:
            system = part
        else:
            system.put(running, part)
        step = _step(part)
        corners[running] += step
        moving = np.abs(step).max(axis=(1, 2)) > enough_px
        patches, running = patches.take(moving), running[moving]
        if not len(running):
            break
    assert system is not None
    return corners, system


def _step(system: _System) -> FloatArray:
    information = system.information.copy()
    diagonal = np.einsum("mii->mi", information)
    diagonal *= 1 + _DAMPING
    diagonal += 1e-9
    by_side = np.linalg.solve(information, system.gradient[..., None])[:, :8]
    by_side = np.clip(by_side, -_MAX_SIDE_STEP_PX, _MAX_SIDE_STEP_PX)
    step = (system.corner_from_side @ by_side).reshape(-1, 4, 2)
    return np.asarray(np.clip(step, -_MAX_CORNER_STEP_PX, _MAX_CORNER_STEP_PX))


def _linearise(patches: Patches, corners: FloatArray, blur_px: float, weight: np.ndarray | None) -> _System:
    """The model and its derivative at the current corners, the best levels, and Cauchy weights."""
    coverage, by_side = blurred_coverage(corners, patches.points, blur_px)
    design = np.empty((len(corners), 12, coverage.shape[1]), dtype=np.float32)
    design[:, 8] = coverage
    design[:, 9:] = patches.points
    if weight is None:
        _, _, weight = _fit_levels(patches, design[:, 8:], patches.use)
    levels, residual, weight = _fit_levels(patches, design[:, 8:], weight)
    amplitude = np.maximum(levels[:, 0], _MIN_AMPLITUDE)
    np.multiply(by_side, amplitude[:, None, None], out=design[:, :8])
    weighted = design * weight[:, None]
    return _System(
        weight,
        residual,
        (weighted @ np.swapaxes(design, 1, 2)).astype(np.float64),
        (weighted @ residual[..., None])[..., 0].astype(np.float64),
        _corner_from_side(corners),
        amplitude.astype(np.float64),
    )


def _fit_levels(
    patches: Patches, basis: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Levels (M, 4) for the shapes ``basis`` (M, 4, N), the residuals they leave, their Cauchy weights."""
    weighted = basis * weight[:, None]
    matrix = (weighted @ np.swapaxes(basis, 1, 2)).astype(np.float64) + 1e-6 * np.eye(4)
    target = (weighted @ patches.values[..., None]).astype(np.float64)
    levels = np.linalg.solve(matrix, target)[..., 0].astype(np.float32)
    residual = (patches.values - (levels[:, None] @ basis)[:, 0]) * patches.use
    scatter = np.maximum(1.4826 * patches.median_used(np.abs(residual)), _MIN_SCATTER)
    ratio = residual * (1 / (_CAUCHY * scatter[:, None])).astype(np.float32)
    return levels, residual, patches.use / (1 + ratio * ratio)


def _corner_from_side(corners: FloatArray) -> FloatArray:
    """Moves (M, 8) of the sides' starts and ends along their normals to moves (M, 8) of the corners.

    Corner c moves with the end of side c - 1 and the start of side c, each along its own normal.
    """
    _, normal, _ = side_frames(corners)
    before = np.roll(normal, 1, axis=1)
    determinant = before[..., 0] * normal[..., 1] - before[..., 1] * normal[..., 0]
    determinant = np.where(np.abs(determinant) < 1e-3, 1e-3, determinant)[..., None]
    by_end = np.stack([normal[..., 1], -normal[..., 0]], axis=-1) / determinant
    by_start = np.stack([-before[..., 1], before[..., 0]], axis=-1) / determinant
    jacobian = np.zeros((len(corners), 4, 2, 8))
    for corner in range(4):
        jacobian[:, corner, :, corner] = by_start[:, corner]
        jacobian[:, corner, :, 4 + (corner - 1) % 4] = by_end[:, corner]
    return jacobian.reshape(-1, 8, 8)


def _covariance(system: _System, patches: Patches) -> FloatArray:
    """Corner covariance (M, 8, 8) from the residuals, inflated by their correlation in both directions."""
    by_side = np.linalg.inv(system.information + 1e-9 * np.eye(12))[:, :8, :8]
    effective = np.maximum(system.weight.sum(axis=1) - 12, 1)
    variance = (system.weight * system.residual**2).sum(axis=1) / effective
    for neighbour in patches.neighbours:
        variance = variance * _correlation_factor(system.residual, system.weight, neighbour)
    jacobian = system.corner_from_side
    return np.asarray(variance[:, None, None] * (jacobian @ by_side @ np.swapaxes(jacobian, 1, 2)))


def _correlation_factor(residual: np.ndarray, weight: np.ndarray, neighbour: np.ndarray) -> FloatArray:
    """(1 + r) / (1 - r), with r (M,) the correlation of residuals with those of the neighbouring pixels."""
    second = np.take_along_axis(residual, neighbour, axis=1)
    pair = weight * np.take_along_axis(weight, neighbour, axis=1) * (neighbour > 0)
    power = (pair * (residual**2 + second**2)).sum(axis=1) / 2
    r = np.clip((pair * residual * second).sum(axis=1) / np.maximum(power, 1e-12), 0.0, 0.7)
    return np.asarray((1 + r) / (1 - r), dtype=np.float64)
