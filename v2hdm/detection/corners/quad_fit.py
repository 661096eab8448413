"""Corners of far markings: the whole quadrilateral fitted to the grey image at once.

The grey value is modelled as ``b0 + b1 C + b2 u + b3 v``, with C the quadrilateral's coverage blurred by
a point spread. The ends of the four sides, the levels and the spread are found by Gauss-Newton with Cauchy
weights, first with a wider blur, which sees farther, then with one near the image's own. Where the sensor
was at its limit only the flanks of the sides count: how fast they rise tells the level that was cut off. The
pixels' places are those without the lens, so that all sides are straight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.corners.correlation import variance_inflation
from v2hdm.detection.corners.coverage import blurred_coverage
from v2hdm.detection.corners.grey import GreyBand
from v2hdm.detection.corners.patches import Patches, cut_patches
from v2hdm.detection.corners.straight import StraightFrames
from v2hdm.geometry.planar import signed_area
from v2hdm.geometry.quadrilateral import is_convex_px as is_convex
from v2hdm.geometry.quadrilateral import preceding, side_frames
from v2hdm.records import BoolArray, FloatArray

_WIDER_BLUR_PX = 0.8
_ITERATIONS = 4
_COARSE_STRIDE = 2
_ENOUGH_PX = 0.1
_MAX_SIDE_STEP_PX = 1.0
_MAX_CORNER_STEP_PX = 4.0
_MAX_MOVE_PX = 6.0
_MAX_MOVE_SHARE = 0.1
"""A fit that moves a corner by more than this, and than this share of the longest side, has gone astray
unless it fits the image so well that its start must have been too small."""

_GOOD_MISFIT = 0.15
_MAX_GROWTH = 4.0
_ENCLOSED_PX = 2.0
"""Such a fit still encloses where it started, but for so many px, and is at most so many times as large: the
network draws the thin ends of far markings short."""

_NOISE_MISFIT = 0.1
"""Share of the step up to the paint that noise and texture alone leave."""
_DAMPING = 1.0 + 1e-3 * np.eye(13)
_RIDGE = 1e-9 * np.eye(13)
_CAUCHY = 2.385
_MIN_SCATTER = 2e-3
_MIN_AMPLITUDE = 1e-3
_LEVEL_ITERATIONS = 2
_LEAST_SINE = 1e-3
_MAX_CORRELATION = 0.7
_BLUR_SIGMA_PX = 0.2
_MAX_BLUR_STEP_PX = 0.2
_BLUR_LIMITS_PX = (0.35, 3.0)
"""How far a marking's own blur is from the point spread: motion, focus, frayed paint."""

_CLIPPED_SHARE = 0.15
_LEAST_CLIPPED = 0.9
_BLOOM = 1.2
"""Where so many pixels are clipped, the outline is about this many blurs outside the paint."""

_UNKNOWNS = 13
_BLUR = 8
_LEVELS = 9
"""Places of the blur and of the first level among the unknowns."""

_CORNER = np.arange(4)
_END = 4 + (_CORNER - 1) % 4
"""Each corner is the start of its own side and the end of the one before, in this place among the moves."""


@dataclass(frozen=True)
class QuadFit:
    """Fitted quadrilaterals of M markings in recorded px.

    ``corners_px`` (M, 4, 2), ``covariance`` (M, 8, 8) px^2, ``amplitude`` (M,) step from ground to
    paint, ``misfit`` (M,) residual over amplitude, ``settled`` (M,) whether the fit stayed near its
    start, or grew from it, and convex, ``clipped`` (M,) whether the sensor was at its limit in a notable part
    of the marking, ``bright`` (M,) whether the paint was found to be bright enough for that.
    """

    corners_px: FloatArray
    covariance: FloatArray
    amplitude: FloatArray
    misfit: FloatArray
    settled: BoolArray
    clipped: BoolArray
    bright: BoolArray


def fit_quads(
    grey: GreyBand,
    owner: np.ndarray,
    owner_stride: int,
    blobs: np.ndarray,
    view: CameraView,
    corners_px: FloatArray,
    blur_px: float,
) -> QuadFit:
    """Fit quadrilaterals that start within about 2 px of ``corners_px`` (M, 4, 2).

    Args:
        grey: the image's grey values.
        owner: (h, w) 1 + index of the blob on each logit of the same band; other blobs' pixels are ignored.
        owner_stride: pixels per logit.
        blobs: (M,) index of each marking's own blob.
        view: the camera.
        corners_px: starting corners, recorded px.
        blur_px: the point spread's standard deviation, pixel aperture included.
    """
    frames = StraightFrames.about(view, corners_px)
    patches = cut_patches(grey, owner, owner_stride, blobs, frames, corners_px)
    start = frames.from_image(corners_px)
    clipped = np.asarray(patches.clipped > _CLIPPED_SHARE)
    inward_px = np.where(clipped, -_BLOOM * blur_px, 0.0)
    corners = start + _moved(_corner_from_side(start), np.repeat(inward_px[:, None], 8, axis=1))
    typical_px = np.full(len(start), blur_px)
    quads = _Quads(corners, np.hypot(typical_px, _WIDER_BLUR_PX), np.zeros((len(start), 4)))
    _iterate(patches.every(_COARSE_STRIDE), quads, 0.0, 1)
    quads.blur_px = typical_px
    system = _iterate(patches, quads, _BLUR_SIGMA_PX, _ITERATIONS)
    most_px = np.maximum(_MAX_MOVE_PX, _MAX_MOVE_SHARE * side_frames(start)[2].max(axis=1))
    settled = (np.abs(quads.corners - start).max(axis=(1, 2)) < most_px) & is_convex(quads.corners)
    rms = np.sqrt((patches.use * system.residual**2).sum(axis=1) / np.maximum(patches.use.sum(axis=1), 1))
    misfit = rms / system.amplitude
    settled |= (misfit < _GOOD_MISFIT) & _has_grown(start, quads.corners)
    # Misfit is paint that is missing on one side; a level beyond the sensor's is an extrapolation.
    doubt = (1 + (misfit / _NOISE_MISFIT) ** 2) * np.maximum(system.amplitude, 1.0) ** 2
    return QuadFit(
        *frames.to_image(quads.corners, doubt[:, None, None] * _covariance(system, patches)),
        system.amplitude,
        misfit,
        settled,
        clipped,
        # Pixels at the sensor's limit say that the paint is at least as bright.
        ~clipped | (quads.levels[:, [0, 3]].sum(axis=1) > _LEAST_CLIPPED),
    )


def _has_grown(start: FloatArray, corners: FloatArray) -> BoolArray:
    """Which quadrilaterals (M, 4, 2) enclose the smaller ones (M, 4, 2) that they come from."""
    _, normal, _ = side_frames(corners)
    outside_px = (normal[:, :, None] * (start[:, None] - corners[:, :, None])).sum(axis=-1).max(axis=(1, 2))
    small = np.abs(signed_area(corners)) < _MAX_GROWTH * np.abs(signed_area(start))
    return np.asarray(is_convex(corners) & (outside_px < _ENCLOSED_PX) & small)


@dataclass
class _Quads:
    """State of M markings: corners (M, 4, 2) in their frames, and blur (M,) px.

    ``levels`` (M, 4) are those of coverage, u, v and 1, all zero before they are first fitted.
    """

    corners: FloatArray
    blur_px: FloatArray
    levels: FloatArray

    def take(self, rows: np.ndarray) -> _Quads:
        """Some of the markings."""
        return _Quads(self.corners[rows], self.blur_px[rows], self.levels[rows])


@dataclass(frozen=True)
class _System:
    """Least squares about the current state of M markings with N pixels.

    The unknowns are moves of the four sides' starts, of their ends, the growth of the blur, then the levels.
    ``weight`` and ``residual`` (M, N); ``information`` (M, 13, 13) and ``gradient`` (M, 13), weighted;
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

    def expect_blur(self, excess_px: FloatArray, sigma_px: float) -> None:
        """Add that the blur (``excess_px`` (M,) too wide) is known to within ``sigma_px``; 0 holds it."""
        variance = (self.weight * self.residual**2).sum(axis=1) / np.maximum(self.weight.sum(axis=1), 1)
        stiffness = variance / sigma_px**2 if sigma_px else np.full(len(variance), 1e9)
        self.information[:, _BLUR, _BLUR] += stiffness
        self.gradient[:, _BLUR] -= stiffness * excess_px


def _iterate(patches: Patches, quads: _Quads, blur_sigma_px: float, iterations: int) -> _System:
    """Gauss-Newton until each marking's step is small; the system is that of its last step.

    ``quads`` are moved; their blur stays within about ``blur_sigma_px`` of what it is at first.
    """
    expected_px = quads.blur_px.copy()
    running = np.arange(len(expected_px))
    system = None
    for _ in range(iterations):
        now = quads.take(running)
        part = _linearise(patches, now)
        part.expect_blur(now.blur_px - expected_px[running], blur_sigma_px)
        if system is None:
            system = part
        else:
            system.put(running, part)
        step, wider, levels = _step(part)
        quads.corners[running] += step
        quads.blur_px[running] = np.clip(now.blur_px + wider, *_BLUR_LIMITS_PX)
        quads.levels[running] = now.levels + levels
        moving = np.abs(step).max(axis=(1, 2)) > _ENOUGH_PX
        patches, running = patches.take(moving), running[moving]
        if not len(running):
            break
    assert system is not None
    return system


def _step(system: _System) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Moves (M, 4, 2) of the corners, growth (M,) of the blur, change (M, 4) of the levels."""
    damped = system.information * _DAMPING + _RIDGE
    solved = np.linalg.solve(damped, system.gradient[..., None])[..., 0]
    by_side = np.clip(solved[:, :_BLUR], -_MAX_SIDE_STEP_PX, _MAX_SIDE_STEP_PX)
    step = np.clip(_moved(system.corner_from_side, by_side), -_MAX_CORNER_STEP_PX, _MAX_CORNER_STEP_PX)
    wider = np.clip(solved[:, _BLUR], -_MAX_BLUR_STEP_PX, _MAX_BLUR_STEP_PX)
    return np.asarray(step), np.asarray(wider), np.asarray(solved[:, _LEVELS:])


def _moved(corner_from_side: FloatArray, by_side: FloatArray) -> FloatArray:
    """Moves (M, 4, 2) of the corners by moves (M, 8) of the sides' starts and ends."""
    return np.asarray((corner_from_side @ by_side[..., None]).reshape(-1, 4, 2))


def _linearise(patches: Patches, quads: _Quads) -> _System:
    """The model and its derivative at the current state, and Cauchy weights; the best levels if asked for."""
    coverage, by_shape = blurred_coverage(quads.corners, patches.points, quads.blur_px)
    design = np.empty((len(coverage), _UNKNOWNS, coverage.shape[1]), dtype=np.float32)
    basis = design[:, _LEVELS:]
    basis[:, 0] = coverage
    basis[:, 1:] = patches.points
    if not quads.levels.any():
        weight = patches.use
        for _ in range(_LEVEL_ITERATIONS):
            quads.levels[:] = _best_levels(patches, basis, weight)
            _, weight = _residual(patches, basis, quads.levels)
    residual, weight = _residual(patches, basis, quads.levels)
    amplitude = np.maximum(quads.levels[:, 0], _MIN_AMPLITUDE)
    np.multiply(by_shape, amplitude[:, None, None], out=design[:, :_LEVELS], casting="same_kind")
    weighted = design * weight[:, None]
    return _System(
        weight,
        residual,
        (weighted @ design.swapaxes(1, 2)).astype(np.float64),
        (weighted @ residual[..., None])[..., 0].astype(np.float64),
        _corner_from_side(quads.corners),
        amplitude,
    )


def _best_levels(patches: Patches, basis: np.ndarray, weight: np.ndarray) -> FloatArray:
    """Levels (M, 4) of least squares for the shapes ``basis`` (M, 4, N)."""
    weighted = basis * weight[:, None]
    matrix = (weighted @ basis.swapaxes(1, 2)).astype(np.float64) + 1e-6 * np.eye(4)
    target = (weighted @ patches.values[..., None]).astype(np.float64)
    return np.asarray(np.linalg.solve(matrix, target)[..., 0])


def _residual(patches: Patches, basis: np.ndarray, levels: FloatArray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (M, N) of the levels (M, 4) and their Cauchy weights."""
    residual = patches.values - (levels[:, None].astype(np.float32) @ basis)[:, 0]
    residual *= patches.use
    ratio = np.abs(residual)
    scatter = np.maximum(1.4826 * patches.median_used(ratio), _MIN_SCATTER)
    ratio *= (1 / (_CAUCHY * scatter)).astype(np.float32)[:, None]
    ratio *= ratio
    ratio += np.float32(1)
    return residual, np.divide(patches.use, ratio, out=ratio)


def _corner_from_side(corners: FloatArray) -> FloatArray:
    """Moves (M, 8) of the sides' starts and ends along their normals to moves (M, 8) of the corners.

    Corner c moves with the end of side c - 1 and the start of side c, each along its own normal.
    """
    tangent, _, _ = side_frames(corners)
    before = preceding(tangent)
    determinant = before[..., 0] * tangent[..., 1] - before[..., 1] * tangent[..., 0]
    determinant = np.where(np.abs(determinant) < _LEAST_SINE, _LEAST_SINE, determinant)[..., None]
    jacobian = np.zeros((len(corners), 4, 2, 8))
    # Each lies along the other's line.
    jacobian[:, _CORNER, :, _CORNER] = (-before / determinant).swapaxes(0, 1)
    jacobian[:, _CORNER, :, _END] = (tangent / determinant).swapaxes(0, 1)
    return jacobian.reshape(-1, 8, 8)


def _covariance(system: _System, patches: Patches) -> FloatArray:
    """Corner covariance (M, 8, 8) from the residuals, inflated by their correlation in both directions."""
    by_side = np.linalg.inv(system.information + 1e-9 * np.eye(_UNKNOWNS))[:, :8, :8]
    residual, weight = system.residual, system.weight
    variance = (weight * residual**2).sum(axis=1) / np.maximum(weight.sum(axis=1) - _UNKNOWNS, 1)
    rows = np.arange(len(residual))[:, None]
    for neighbour in patches.neighbours:
        second = residual[rows, neighbour]
        pair = weight * weight[rows, neighbour] * (neighbour > 0)
        variance = variance * variance_inflation(residual, second, pair, _MAX_CORRELATION)
    jacobian = system.corner_from_side
    return np.asarray(variance[:, None, None] * (jacobian @ by_side @ np.swapaxes(jacobian, 1, 2)))
