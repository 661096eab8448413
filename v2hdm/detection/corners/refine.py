"""From starting quadrilaterals to markings: corners below the pixel, each with a covariance.

Near markings get their sides located one by one, which is the most accurate where a side shows enough
undisturbed profiles; far ones are fitted as a whole, which still works when they are a few px high.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.corners.both_sides import painted_parts
from v2hdm.detection.corners.confidence import confidence
from v2hdm.detection.corners.edge_fit import EdgeFit, fit_edges
from v2hdm.detection.corners.evidence import Claim, gather, grey_steps, whole_ends
from v2hdm.detection.corners.foreground import Foreground
from v2hdm.detection.corners.found import Corners, block_diagonal, is_cut, largest_sigma
from v2hdm.detection.corners.grey import GreyBand, linear_grey
from v2hdm.detection.corners.outline_fit import fit_outlines
from v2hdm.detection.corners.quad_fit import fit_quads
from v2hdm.detection.corners.rectified import rectified_views
from v2hdm.detection.corners.straight import Quads
from v2hdm.detection.options import DetectorOptions
from v2hdm.geometry.quadrilateral import is_convex_px as is_convex
from v2hdm.geometry.quadrilateral import side_frames, width
from v2hdm.records import DIAMOND, LANE_DASH, BoolArray, FloatArray, MarkingDetection

TYPICAL_BLUR_PX = 0.75
"""Point spread of a focused camera, pixel aperture included: what is assumed until it is measured."""

_NEAR_WIDTH_PX = 15.0
_NEAR_SIDE_PX = 14.0
_LARGE_PX = 200.0
"""What is so large has sides to be located one by one, or it has none that can be trusted."""

_COVARIANCE_FACTOR = 1.4
_COVARIANCE_FLOOR_PX = 0.03
_MAX_MISFIT = 0.2
_MIN_AMPLITUDE = 0.01
_MAX_LEVEL_RATIO = 2.0
_BLUR_QUANTILE = 0.4
_BLUR_PRIOR_SIDES = 6
_BLUR_LIMITS_PX = (0.45, 1.5)
_AROUND_PX = 16
_BLOOM_SIGMA_PX = 0.5
"""Where the sensor was at its limit, edges are this far from where they seem to be."""
_UNEVEN_SIGMA_PX = 2.0
"""RMS error of corners at worn and shaded sides."""

_MAX_OUTLINE_SIGMA_PX = 2.0
_MAX_OUTLINE_GAP_PX = 4.0
"""Corners of the outline are this far from those of the image at most where it is the marking's."""
_OWN_END_PX = 3.0
"""The stretch of a piece that ends this near to the piece's own end has not been cut there."""


@dataclass(frozen=True)
class QuadStart:
    """A blob's quadrilateral ``corners_pinhole_px`` (4, 2) before refinement.

    ``claims`` are what the network says for each class that it may be of, the likeliest first; ``blob`` is
    the blob's index, ``outline_pinhole_px`` (N, 2) its outline.
    """

    claims: dict[str, Claim]
    corners_pinhole_px: FloatArray
    blob: int
    outline_pinhole_px: FloatArray

    @property
    def kind(self) -> str:
        """The likeliest class."""
        return next(iter(self.claims))


@dataclass
class _Fitted:
    """M starts, the corners ``found``, and each in every class that it may be of, R rows in all.

    ``row_start`` (R,) is the start of a row, ``kinds`` its class, ``ground`` (R, 4, 2) its corners on the
    ground, ``evidence`` (R, F) what there is for it, ``views`` (R, C, 20, 20) what it
    looks like. ``uneven`` (M, 4) are corners of doubtful
    sides, ``spoilt_ends`` (M, 4) those of ends, were it a dash.
    """

    starts: list[QuadStart]
    found: Corners
    row_start: np.ndarray
    kinds: list[str]
    ground: FloatArray
    evidence: FloatArray
    views: np.ndarray
    uneven: BoolArray
    spoilt_ends: BoolArray

    def judged(self) -> tuple[list[str], FloatArray]:
        """The class (M,) of each for which there is most evidence, and its confidence."""
        score = confidence(self.evidence, self.views, self.kinds, self.ground)
        # Stable, so that the likeliest by the network comes first among equals.
        best = np.lexsort((-np.arange(len(score)), score))
        chosen = dict(zip(self.row_start[best].tolist(), best.tolist(), strict=True))
        rows = [chosen[m] for m in range(len(self.starts))]
        return [self.kinds[row] for row in rows], score[rows]


def fit_markings(
    image_bgr: np.ndarray,
    view: CameraView,
    starts: list[QuadStart],
    foreground: Foreground,
    options: DetectorOptions,
) -> list[MarkingDetection]:
    """Refine the corners of one image's markings; where that fails they are those of the start, not valid.

    Markings are kept if the evidence for them reaches ``options.min_confidence``.
    """
    fitted = _fitted(image_bgr, view, starts, foreground, options)
    if not fitted:
        return []
    kinds, score = fitted.judged()
    found = fitted.found
    if options.vague_corners:
        _take_outlines(found, fitted.starts, view, options)
        found.valid[is_cut(found, view)] = False
    doubt_corners(found, fitted.uneven, fitted.spoilt_ends, kinds, options.vague_corners)
    return [
        MarkingDetection(kind, float(score[m]), found.px[m], found.covariance[m], found.valid[m])
        for m, kind in enumerate(kinds)
        if score[m] >= options.min_confidence
    ]


def _fitted(
    image_bgr: np.ndarray,
    view: CameraView,
    starts: list[QuadStart],
    foreground: Foreground,
    options: DetectorOptions,
) -> _Fitted | None:
    """The starts fitted to the image, and the evidence for each; None for none."""
    if not starts:
        return None
    start, start_px = _stacked(starts, view)
    grey = _grey_around(image_bgr, view, start_px, foreground)
    starts = _without_tails(starts, grey, foreground, view, options.max_range_m)
    if not starts:
        return None
    start, start_px = _stacked(starts, view)
    blobs = np.array([s.blob for s in starts])
    near = _is_near(start)
    found, blur_px = Corners.at(start_px), options.blur_px
    if near.any():
        edges = fit_edges(grey, view, start[near])
        _take_edges(found, near, edges, view)
        blur_px = blur_px or _measured_blur(edges)
    far = ~found.valid.any(axis=1) & (~near | (np.ptp(found.px, axis=1).max(axis=1) < _LARGE_PX))
    if far.any():
        shared = _Far(foreground, blobs, view, blur_px or TYPICAL_BLUR_PX)
        overexposed = _take_quads(found, np.flatnonzero(far), grey, shared, 0.0)
        if options.vague_corners and len(overexposed):
            _take_quads(found, overexposed, grey.at_limit, shared, _BLOOM_SIGMA_PX)
    found.covariance = _COVARIANCE_FACTOR * found.covariance + _COVARIANCE_FLOOR_PX**2 * np.eye(8)
    quads = Quads.seen(view, found.px)
    steps = grey_steps(grey, quads)
    runs_on, uneven = steps.runs_on(), steps.uneven()
    found.valid &= ~runs_on
    _reject(found, view, options)
    row_start = np.repeat(np.arange(len(starts)), [len(s.claims) for s in starts])
    claims = [claim for s in starts for claim in s.claims.values()]
    ground = view.ground(view.undistort(found.px.reshape(-1, 2))).reshape(found.px.shape)[row_start]
    row_quads, row_valid = quads.take(row_start), found.valid[row_start]
    evidence = gather(steps.take(row_start), foreground, view, row_quads, ground, claims, row_valid)
    kinds = [kind for s in starts for kind in s.claims]
    views = rectified_views(image_bgr, view, foreground, row_quads, ground, kinds)
    ends = whole_ends(runs_on | uneven, side_frames(found.px)[2])
    return _Fitted(starts, found, row_start, kinds, ground, evidence, views, uneven, ends)


def _stacked(starts: list[QuadStart], view: CameraView) -> tuple[FloatArray, FloatArray]:
    """Corners (M, 4, 2) of all starts, pinhole and recorded px."""
    start = np.stack([s.corners_pinhole_px for s in starts])
    return start, view.distort(start.reshape(-1, 2)).reshape(start.shape)


def _without_tails(
    starts: list[QuadStart], grey: GreyBand, foreground: Foreground, view: CameraView, max_range_m: float
) -> list[QuadStart]:
    """The starts, where dashes run on without paint in the grey with what is paint of them, and in range."""
    dashes = [m for m, start in enumerate(starts) if start.kind == LANE_DASH]
    if not dashes:
        return starts
    corners = np.stack([starts[m].corners_pinhole_px for m in dashes])
    parts = painted_parts(grey, foreground, view, corners)
    if not parts:
        return starts
    stay = set(range(len(starts))) - {dashes[d] for d in parts}
    found = [starts[m] for m in sorted(stay)]
    for d, quads in parts.items():
        near = [q for q in quads if is_convex(q) and view.range_m(view.ground(q).mean(axis=0)) <= max_range_m]
        found += [_cut(starts[dashes[d]], quad) for quad in near]
    return found


def _cut(start: QuadStart, corners: FloatArray) -> QuadStart:
    """The stretch ``corners`` (4, 2) of a start; of its outline what lies beside that.

    Where it is cut there is no outline, so that only the image can give its corners.
    """
    first, last = corners[[0, 3]].mean(axis=0), corners[[1, 2]].mean(axis=0)
    length_px = max(float(np.linalg.norm(last - first)), 1e-9)
    along_px, own_px = (
        (points - first) @ (last - first) / length_px
        for points in (start.outline_pinhole_px, start.corners_pinhole_px)
    )
    low_px, high_px = np.sort(own_px).reshape(2, 2).mean(axis=1)
    keep = (along_px > 0) | (low_px > -_OWN_END_PX)
    keep &= (along_px < length_px) | (high_px < length_px + _OWN_END_PX)
    return replace(start, corners_pinhole_px=corners, outline_pinhole_px=start.outline_pinhole_px[keep])


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


def _take_edges(found: Corners, near: BoolArray, edges: EdgeFit, view: CameraView) -> None:
    """Enter the fitted sides: a corner is valid where both its sides were found and look alike."""
    corners = edges.corners_pinhole_px
    flat = corners.reshape(-1, 2)
    found.px[near] = view.distort(flat).reshape(corners.shape)
    jacobian = block_diagonal(view.distort_jacobian(flat).reshape(-1, 4, 2, 2))
    found.covariance[near] = jacobian @ edges.covariance @ np.swapaxes(jacobian, 1, 2)
    alike = _consistent_levels(edges)
    good = edges.side_found & alike
    found.occluded[near] = (edges.side_found & ~alike).any(axis=1)
    found.valid[near] = good & np.roll(good, 1, axis=1) & is_convex(corners)[:, None]


def _consistent_levels(edges: EdgeFit) -> BoolArray:
    """Sides (M, 4) whose ratio of paint to ground is near that of the marking's other sides.

    A shadow darkens paint and ground alike and leaves the ratio; at an occluder's edge, which looks
    just as sharp, the ground's grey value is replaced by another.
    """
    ratio = np.log((edges.side_low + edges.side_amplitude + 1e-3) / np.maximum(edges.side_low + 1e-3, 1e-4))
    typical = np.median(np.where(edges.side_found, ratio, np.nan_to_num(ratio)), axis=1, keepdims=True)
    return np.asarray(np.abs(ratio - typical) < np.log(_MAX_LEVEL_RATIO))


@dataclass(frozen=True)
class _Far:
    """What fits to far markings share: ``blobs`` (M,) of all markings, and the point spread ``blur_px``."""

    foreground: Foreground
    blobs: np.ndarray
    view: CameraView
    blur_px: float


def _take_quads(found: Corners, group: np.ndarray, grey: GreyBand, far: _Far, bloom_px: float) -> np.ndarray:
    """Enter whole quadrilaterals fitted to the markings ``group`` (indices), in doubt by ``bloom_px`` more.

    The corners of those that are overexposed are near where they should be, but valid only where flanks tell.

    Returns:
        Those of ``group`` that are overexposed and not fitted well.
    """
    foreground = far.foreground
    owner = foreground.owner[(grey.top - foreground.top) // foreground.stride :]
    fit = fit_quads(grey, owner, foreground.stride, far.blobs[group], far.view, found.px[group], far.blur_px)
    corners, covariance = fit.corners_px, fit.covariance + bloom_px**2 * np.eye(8)
    good = fit.settled & (fit.misfit < _MAX_MISFIT) & (fit.amplitude > _MIN_AMPLITUDE)
    good &= np.isfinite(corners).all(axis=(1, 2))
    found.px[group[good]] = corners[good]
    found.covariance[group[good]] = covariance[good]
    told = fit.bright & (largest_sigma(covariance).max(axis=1) < _BLOOM_SIGMA_PX)
    good &= ~fit.clipped | told
    found.valid[group[good]] = True
    return np.asarray(group[fit.clipped & ~good])


def _take_outlines(
    found: Corners, starts: list[QuadStart], view: CameraView, options: DetectorOptions
) -> None:
    """Enter corners of the network's outline where the image gave none.

    Not where something stands before the marking, and not where the corners that the image did give
    show that the outline is that of something else.
    """
    asked = np.flatnonzero(~found.occluded & ~found.valid.all(axis=1))
    if not len(asked):
        return
    start = np.stack([starts[m].corners_pinhole_px for m in asked])
    fit = fit_outlines([starts[m].outline_pinhole_px for m in asked], start)
    corners = np.where(fit.found[..., None], fit.corners_pinhole_px, start)
    flat = corners.reshape(-1, 2)
    px = view.distort(flat).reshape(corners.shape)
    jacobian = block_diagonal(view.distort_jacobian(flat).reshape(-1, 4, 2, 2))
    covariance = jacobian @ fit.covariance @ np.swapaxes(jacobian, 1, 2)
    apart = np.linalg.norm(px - found.px[asked], axis=2)
    agrees = (~(found.valid[asked] & fit.found) | (apart < _MAX_OUTLINE_GAP_PX)).all(axis=1)
    usable = fit.found & agrees[:, None] & view.inside(px, options.border_px)
    usable &= largest_sigma(covariance) <= _MAX_OUTLINE_SIGMA_PX
    for m, at, matrix, use in zip(asked, px, covariance, usable & ~found.valid[asked], strict=True):
        corner = np.flatnonzero(use)
        columns = (2 * corner[:, None] + np.arange(2)).ravel()
        found.px[m, corner] = at[corner]
        found.covariance[m, columns], found.covariance[m, :, columns] = 0.0, 0.0
        found.covariance[m][np.ix_(columns, columns)] = matrix[np.ix_(columns, columns)]
        found.valid[m, corner] = True


def doubt_corners(
    found: Corners, uneven: BoolArray, spoilt_ends: BoolArray, kinds: list[str], vague: bool
) -> None:
    """Corners (M, 4) at uneven sides of a diamond, and at spoilt ends of anything longer, are not valid.

    Diamonds keep theirs as vague ones where such are asked for: wear and shadow shorten a diamond by little,
    a dash by as much as they like.
    """
    diamond = (np.array(kinds) == DIAMOND)[:, None]
    doubtful = np.where(diamond, uneven, spoilt_ends)
    kept = doubtful & found.valid & vague & diamond
    marking, corner = np.nonzero(kept)
    for place in (2 * corner, 2 * corner + 1):
        found.covariance[marking, place, place] += _UNEVEN_SIGMA_PX**2
    found.valid &= ~doubtful | kept


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


def _reject(found: Corners, view: CameraView, options: DetectorOptions) -> None:
    """Mark the corners that are too uncertain or too near the border as not valid."""
    found.valid &= largest_sigma(found.covariance) <= options.max_corner_sigma_px
    found.valid &= view.inside(found.px, options.border_px)
    found.occluded |= is_cut(found, view)
    found.valid[found.occluded & found.valid.all(axis=1)] = False
