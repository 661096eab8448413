"""From starting quadrilaterals to markings: corners below the pixel, each with a covariance.

Near markings get their sides located one by one, which is the most accurate where a side shows enough
undisturbed profiles; far ones are fitted as a whole, which still works when they are a few px high.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.edge_fit import EdgeFit, fit_edges
from v2hdm.detection.grey import GreyBand, linear_grey
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.quad import is_convex, side_frames, width
from v2hdm.detection.quad_fit import fit_quads, unbow_corners
from v2hdm.detection.view import CameraView
from v2hdm.records import BoolArray, FloatArray, MarkingDetection

TYPICAL_BLUR_PX = 0.75
"""Point spread of a focused camera, pixel aperture included: what is assumed until it is measured."""

_NEAR_WIDTH_PX = 15.0
_NEAR_SIDE_PX = 14.0
_FAR_MAX_PX = 200.0
_COVARIANCE_FACTOR = 1.4
_COVARIANCE_FLOOR_PX = 0.03
_MAX_MISFIT = 0.2
_MIN_AMPLITUDE = 0.01
_MAX_LEVEL_RATIO = 2.0
_BLUR_QUANTILE = 0.4
_BLUR_PRIOR_SIDES = 6
_BLUR_LIMITS_PX = (0.45, 1.5)
_AROUND_PX = 16
_MIN_VALID_CORNERS = 2


@dataclass(frozen=True)
class QuadStart:
    """A blob's quadrilateral ``corners_pinhole_px`` (4, 2) before refinement; ``blob`` is its index."""

    kind: str
    score: float
    corners_pinhole_px: FloatArray
    blob: int


@dataclass(frozen=True)
class Foreground:
    """Which blob owns each logit: ``owner`` (h, w) 1 + index or 0, ``stride`` px apart, from row ``top``."""

    owner: np.ndarray
    stride: int
    top: int


@dataclass
class _Corners:
    """Refined corners of M markings: ``px`` (M, 4, 2), ``covariance`` (M, 8, 8), ``valid`` (M, 4)."""

    px: FloatArray
    covariance: FloatArray
    valid: BoolArray


def fit_markings(
    image_bgr: np.ndarray,
    view: CameraView,
    starts: list[QuadStart],
    foreground: Foreground,
    options: DetectorOptions,
) -> list[MarkingDetection]:
    """Refine the corners of one image's markings; those with fewer than two valid ones are dropped."""
    if not starts:
        return []
    start = np.stack([s.corners_pinhole_px for s in starts])
    blobs = np.array([s.blob for s in starts])
    start_px = view.distort(start.reshape(-1, 2)).reshape(start.shape)
    grey = _grey_around(image_bgr, view, start_px, foreground)
    near = _is_near(start)
    found = _Corners(
        start_px,
        np.tile(np.eye(8), (len(starts), 1, 1)),
        np.zeros((len(starts), 4), dtype=np.bool_),
    )
    blur_px = options.blur_px
    if near.any():
        edges = fit_edges(grey, view, start[near])
        _take_edges(found, near, edges, view)
        blur_px = blur_px or _measured_blur(edges)
    far = ~found.valid.any(axis=1) & (np.ptp(found.px, axis=1).max(axis=1) < _FAR_MAX_PX)
    if far.any():
        _take_quads(found, np.flatnonzero(far), grey, foreground, blobs, view, blur_px or TYPICAL_BLUR_PX)
    found.covariance = _COVARIANCE_FACTOR * found.covariance + _COVARIANCE_FLOOR_PX**2 * np.eye(8)
    _reject(found, view, options)
    return [
        MarkingDetection(s.kind, s.score, found.px[m], found.covariance[m], found.valid[m])
        for m, s in enumerate(starts)
        if np.count_nonzero(found.valid[m]) >= _MIN_VALID_CORNERS
    ]


def _is_near(corners: FloatArray) -> BoolArray:
    shortest = side_frames(corners)[2].min(axis=1)
    return np.asarray((width(corners) >= _NEAR_WIDTH_PX) & (shortest >= _NEAR_SIDE_PX))


def _grey_around(
    image_bgr: np.ndarray, view: CameraView, corners_px: FloatArray, foreground: Foreground
) -> GreyBand:
    """Linear grey around markings that start at recorded ``corners_px`` (M, 4, 2)."""
    low = np.floor(corners_px.min(axis=1)).astype(np.intp) - _AROUND_PX
    high = np.ceil(corners_px.max(axis=1)).astype(np.intp) + _AROUND_PX
    top = max(foreground.top, int(low[:, 1].min()))
    top -= (top - foreground.top) % foreground.stride
    bottom = min(view.info.height, max(int(high[:, 1].max()), top + 1))
    return linear_grey(image_bgr, top, bottom, np.hstack([low, high]), view.camera.linear_response)


def _take_edges(found: _Corners, near: BoolArray, edges: EdgeFit, view: CameraView) -> None:
    """Enter the fitted sides: a corner is valid where both its sides were found and look alike."""
    corners = edges.corners_pinhole_px
    flat = corners.reshape(-1, 2)
    found.px[near] = view.distort(flat).reshape(corners.shape)
    jacobian = _block_diagonal(view.distort_jacobian(flat).reshape(-1, 4, 2, 2))
    found.covariance[near] = jacobian @ edges.covariance @ np.swapaxes(jacobian, 1, 2)
    good = edges.side_found & _consistent_levels(edges)
    found.valid[near] = good & np.roll(good, 1, axis=1) & is_convex(corners)[:, None]


def _consistent_levels(edges: EdgeFit) -> BoolArray:
    """Sides (M, 4) whose ratio of paint to ground is near that of the marking's other sides.

    A shadow darkens paint and ground alike and leaves the ratio; at an occluder's edge, which looks
    just as sharp, the ground's grey value is replaced by another.
    """
    ratio = np.log((edges.side_low + edges.side_amplitude + 1e-3) / np.maximum(edges.side_low + 1e-3, 1e-4))
    typical = np.median(np.where(edges.side_found, ratio, np.nan_to_num(ratio)), axis=1, keepdims=True)
    return np.asarray(np.abs(ratio - typical) < np.log(_MAX_LEVEL_RATIO))


def _take_quads(
    found: _Corners,
    group: np.ndarray,
    grey: GreyBand,
    foreground: Foreground,
    blobs: np.ndarray,
    view: CameraView,
    blur_px: float,
) -> None:
    """Enter whole quadrilaterals fitted to the markings ``group`` (indices)."""
    owner = foreground.owner[(grey.top - foreground.top) // foreground.stride :]
    fit = fit_quads(grey, owner, foreground.stride, blobs[group], found.px[group], blur_px)
    corners = view.distort(unbow_corners(view, fit.corners_px).reshape(-1, 2)).reshape(-1, 4, 2)
    good = fit.settled & (fit.misfit < _MAX_MISFIT) & (fit.amplitude > _MIN_AMPLITUDE)
    good &= np.isfinite(corners).all(axis=(1, 2))
    found.px[group[good]] = corners[good]
    found.covariance[group[good]] = fit.covariance[good]
    found.valid[group[good]] = True


def _measured_blur(edges: EdgeFit) -> float | None:
    """The point spread from the sides of near markings, drawn to the typical one where they are few.

    Motion and frayed paint only ever widen an edge, so a low quantile is taken.
    """
    blurs = edges.side_blur_px[edges.side_found]
    if not len(blurs):
        return None
    measured = float(np.quantile(blurs, _BLUR_QUANTILE))
    blur_px = (len(blurs) * measured + _BLUR_PRIOR_SIDES * TYPICAL_BLUR_PX) / (len(blurs) + _BLUR_PRIOR_SIDES)
    return float(np.clip(blur_px, *_BLUR_LIMITS_PX))


def _reject(found: _Corners, view: CameraView, options: DetectorOptions) -> None:
    """Mark the corners that are too uncertain or too near the border as not valid."""
    blocks = found.covariance.reshape(-1, 4, 2, 4, 2)[:, range(4), :, range(4)].transpose(1, 0, 2, 3)
    largest = np.linalg.eigvalsh(np.nan_to_num(blocks, nan=1e6, posinf=1e6))[..., -1]
    found.valid &= np.sqrt(np.maximum(largest, 0)) <= options.max_corner_sigma_px
    found.valid &= view.inside(found.px, options.border_px)


def _block_diagonal(blocks: FloatArray) -> FloatArray:
    """(M, 4, 2, 2) blocks to (M, 8, 8)."""
    full = np.zeros((len(blocks), 4, 2, 4, 2))
    for corner in range(4):
        full[:, corner, :, corner] = blocks[:, corner]
    return full.reshape(-1, 8, 8)
