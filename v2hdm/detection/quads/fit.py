"""One fit for every marking, near and far: a quadrilateral in the log of the image's grey values.

In frames in which the lens bends nothing, the log grey of a pixel is modelled as ``light(s) + c x + log(1 +
(exp(k) - 1) C)``: C is the quadrilateral's coverage blurred by the point spread, k the log contrast of paint
over ground, ``light`` a piecewise linear function along the marking and c a slope across it. A shadow is a
factor on paint and ground alike, so it goes into the light and moves no side. Gauss-Newton with Cauchy
weights finds the ends of the four sides, blur, contrast and light, of all markings of an image at once.

Nothing is ever "not found". Every side has the residual variance of its own pixels, the outline that the
network drew is a weak observation of every side, and a side at the image's border is all but free. A crack
along one side, clipped paint, an occluder or the border thereby show as a large covariance in the direction
that they hide. A corner is where two sides meet, so that its covariance follows from theirs: where the end of
a side is vague, the corner may lie far along it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.quads.lattice import Lattice, lay_grid, lay_lattice
from v2hdm.detection.quads.patch import LensFrames, Patches
from v2hdm.detection.quads.state import State, System
from v2hdm.geometry.planar import Quad, is_convex_px
from v2hdm.records import OUTLINE_SIGMA_PX, BoolArray, FloatArray

TYPICAL_BLUR_PX = 0.75  # point spread of a focused camera, px, pixel aperture included

_SEARCH_BLUR = 0.6  # blur of a search, in distances of the grid's points: it sees sides from far away
_LEAST_SEARCH_BLUR_PX = 1.5  # least blur of a search, px
_SEARCH_SIGMA = 0.1  # how far the network's outline is from a side's end before the search, marking lengths
_SEARCH_STEPS = 4  # steps of a search at most; with fewer KITTI 0011 or port 2 has one false marking
_STEPS = 8  # steps of a fit at most

_BLOOM = 1.2  # offset, in blurs, of clipped paint's outline outside the paint
_MUCH_CLIPPED = 0.15  # share of a marking's pixels that are clipped from which that is so

_MOST_MOVED = 0.5  # a fit that moves its middle by more of its size follows something else
_MOST_GROWTH = 4.0  # a fit whose area grows or shrinks by a larger factor follows something else

OPEN_SIGMA = 3.0  # a side cut by the image's border is unknown within this many lengths of the marking
_BEYOND_PX = 6.0  # how far beyond the border a side that it cuts is started, px: farther than blur reaches

_MODEL_SIGMA_PX = 0.04
"""Error of a side along the pixels' rows, px, with no noise at all: a Gaussian is not quite a pixel's
aperture."""

STATISTICS = (
    "contrast",
    "fit_scatter",
    "worst_scatter",
    "inlier_share",
    "clipped_share",
    "blur_px",
    "log_end_sigma",
    "log_side_sigma",
    "log_moved_px",
    "log_last_step",
    "log_gap",
)
"""Names of the columns of :attr:`Fit.statistics`.

Log contrast of paint over ground; scatter of log grey over contrast, over all and on the worst side; mean
robust weight; share of clipped pixels; blur, px; log of the standard deviation of the two ends and of the two
long sides, px; log of the longest way of a corner from the outline and of the last step, px; log of how far
it is from a parallelogram on the ground, in the deviation that is expected.
"""

_TILT_SHARE = 0.5  # a side that is off as a whole is askew by this share of that

_WHOLE_SIDES = np.kron([[1.0, 1.0], [1.0, 1.0]], np.eye(4)) + _TILT_SHARE**2 * np.kron(
    [[1.0, -1.0], [-1.0, 1.0]], np.eye(4)
)
"""Covariance (8, 8) of the starts and ends of sides that are off as a whole by one."""

_CORNER = np.arange(4)  # indices of the corners, and of the sides that start there


class _Ends(NamedTuple):
    """Variances (M, 4), px^2, of the sides' ends along their normals."""

    start: FloatArray
    end: FloatArray
    joint: FloatArray  # their covariance

    @classmethod
    def of(cls, by_side: FloatArray) -> _Ends:
        """From the covariance (M, 8, 8) of starts and ends."""
        return cls(
            start=by_side[:, _CORNER, _CORNER],
            end=by_side[:, _CORNER + 4, _CORNER + 4],
            joint=by_side[:, _CORNER, _CORNER + 4],
        )


@dataclass(frozen=True)
class Fit:
    """M fitted quadrilaterals in their frames."""

    frames: LensFrames
    quad: Quad
    # (M, 8, 8), px^2, of moves of the sides' starts and ends along outward normals
    side_covariance: FloatArray
    statistics: FloatArray  # (M, len(STATISTICS)) how well the model explains the pixels
    open_sides: BoolArray  # (M, 4) those cut by the image's border

    @cached_property
    def corners_px(self) -> FloatArray:
        """Corners (M, 4, 2), recorded px."""
        return self.frames.to_px(self.quad.corners)

    def covariance_px(self, side_sigma_px: FloatArray | None = None) -> FloatArray:
        """Covariance (M, 8, 8) of the corners, px^2; sides are off by ``side_sigma_px`` (M, 4) besides."""
        by_side = self.side_covariance
        if side_sigma_px is not None:
            sigma = np.tile(side_sigma_px, 2)
            by_side = by_side + sigma[:, :, None] * _WHOLE_SIDES * sigma[:, None, :]
        jacobian = self.quad.corner_from_side
        covariance = jacobian @ by_side @ jacobian.swapaxes(1, 2) + self._second_order(by_side)
        jacobian = self.frames.jacobian(self.quad.corners)
        return np.asarray(jacobian @ covariance @ jacobian.swapaxes(1, 2))

    def side_variance(self) -> FloatArray:
        """Variance (M, 4), px^2, of the place of each side's middle along its normal."""
        ends = _Ends.of(self.side_covariance)
        return np.asarray((ends.start + ends.end + 2 * ends.joint) / 4)

    def _second_order(self, by_side: FloatArray) -> FloatArray:
        """Covariance (M, 8, 8), px^2, that the error of a side's direction adds where its end is vague.

        A corner that may lie far along a side is off across it by its way times the error of the side's
        direction.
        """
        ends = _Ends.of(by_side)
        normal = self.quad.normal
        askew = np.maximum(ends.start + ends.end - 2 * ends.joint, 0)
        tilt_variance = askew / np.maximum(self.quad.length, 1.0) ** 2
        covariance = np.zeros((len(normal), 4, 2, 4, 2))
        # Corner c runs along side c if the end of side c - 1 is vague, along side c - 1 if the start of c is.
        for side, slack in ((_CORNER, np.roll(ends.end, 1, axis=1)), (_CORNER - 1, ends.start)):
            variance = tilt_variance[:, side] * slack
            outer = normal[:, side, :, None] * normal[:, side, None, :]
            covariance[:, _CORNER, :, _CORNER] += (variance[..., None, None] * outer).swapaxes(0, 1)
        return covariance.reshape(-1, 8, 8)


def fit_quadrilaterals(
    patches: Patches,
    camera: RoadCamera,
    corners_px: FloatArray,
    open_sides: BoolArray,
    blur_px: float = TYPICAL_BLUR_PX,
) -> Fit:
    """Fit quadrilaterals that start at ``corners_px`` (M, 4, 2), the network's outlines, recorded px.

    The first steps look at a coarse grid all over each, and at the network's probability of paint there as a
    second picture of the same shape; the last at the pixels about its sides. ``open_sides`` (M, 4) are those
    that the image's border cuts, ``blur_px`` is the point spread's sigma, pixel aperture included.
    """
    frames = LensFrames.about(camera, corners_px)
    # Out of sight, so that the pixels at the border say nothing of where such a side is.
    beyond_px = np.tile(np.where(open_sides, _BEYOND_PX, 0.0), 2)
    start = Quad(frames.from_image(corners_px)).moved(beyond_px)
    open_sigma_px = OPEN_SIGMA * start.length.max(axis=1)[:, None]

    searched, searched_px = _search(patches, frames, start, open_sides, blur_px)
    lattice = lay_lattice(patches, frames, searched_px)
    inward_px = -_BLOOM * blur_px * np.minimum(lattice.clipped[:, 0] / _MUCH_CLIPPED, 1.0)
    within_bloom = searched.moved(np.repeat(inward_px[:, None], 8, axis=1))
    sigma_px = np.tile(np.where(open_sides, open_sigma_px, OUTLINE_SIGMA_PX), 2)
    state = State.at(within_bloom, np.full(len(corners_px), blur_px), blur_px, sigma_px, frames)
    system = state.settle(lattice, _STEPS)

    covariance = np.linalg.inv(system.information)[:, :8, :8]
    last = system.side_step
    covariance = covariance + last[:, :, None] * last[:, None, :] + _MODEL_SIGMA_PX**2 * np.eye(8)
    is_astray = ~_sound(state.quad, searched)
    corners = state.quad.corners.copy()
    corners[is_astray] = searched.corners[is_astray]
    covariance[is_astray] = np.einsum("mi,ij->mij", sigma_px[is_astray] ** 2, np.eye(8))
    state.quad = Quad(corners)
    moved_px = np.abs(corners - start.corners).max(axis=(1, 2))
    statistics = _statistics(state, system, lattice, covariance, moved_px)
    return Fit(frames, state.quad, covariance, statistics, open_sides)


def _search(
    patches: Patches, frames: LensFrames, start: Quad, open_sides: BoolArray, blur_px: float
) -> tuple[Quad, FloatArray]:
    """Quadrilaterals after the first steps, from a ``start``, and their corners (M, 4, 2), recorded px.

    Those that got lost are at the start.
    """
    start_px = frames.to_px(start.corners)
    grid = lay_grid(patches, frames, start_px)
    search_blur_px = np.maximum(_SEARCH_BLUR * grid.spacing_px, _LEAST_SEARCH_BLUR_PX)
    length_px = start.length.max(axis=1)[:, None]
    sigma_px = np.tile(np.where(open_sides, OPEN_SIGMA, _SEARCH_SIGMA) * length_px, 2)
    state = State.at(start, search_blur_px, blur_px, sigma_px, frames)
    state.settle(grid.lattice, _SEARCH_STEPS, grid.paint)
    searched = state.quad.corners.copy()
    is_lost = ~_sound(state.quad, start)
    searched[is_lost] = start.corners[is_lost]
    searched_px = frames.to_px(searched)
    # Beyond the image a lens model may fold.
    is_within = frames.camera.inside(searched_px, -OPEN_SIGMA * OUTLINE_SIGMA_PX).all(axis=1)
    is_folded = ~is_within & ~open_sides.any(axis=1)
    is_folded |= ~(np.ptp(searched_px, axis=1).max(axis=1) < 2 * np.ptp(start_px, axis=1).max(axis=1))
    searched[is_folded] = start.corners[is_folded]
    searched_px[is_folded] = start_px[is_folded]
    return Quad(searched), searched_px


def _sound(quad: Quad, before: Quad) -> BoolArray:
    """Which quadrilaterals (M,) are convex and share about the place and size of those ``before``."""
    corners = quad.corners
    old = before.corners
    moved = np.abs(corners.mean(axis=1) - old.mean(axis=1)).max(axis=1)
    growth = quad.area / np.maximum(before.area, 1e-6)
    is_alike = moved < _MOST_MOVED * np.ptp(old, axis=1).max(axis=1) + 2 * OUTLINE_SIGMA_PX
    is_alike &= (growth < _MOST_GROWTH) & (growth > 1 / _MOST_GROWTH)
    return np.asarray(is_convex_px(corners) & np.isfinite(corners).all(axis=(1, 2)) & is_alike)


def _statistics(
    state: State, system: System, lattice: Lattice, covariance: FloatArray, moved_px: FloatArray
) -> FloatArray:
    """The :data:`STATISTICS` (M, len(STATISTICS)) of a fit."""
    contrast = np.maximum(np.abs(state.contrast), 0.05)
    variance = covariance[:, np.arange(8), np.arange(8)]
    side_sigma = np.sqrt(np.maximum(variance, 1e-8)).reshape(-1, 2, 4).mean(axis=1)
    lengthwise = state.quad.lengthwise
    of_opposite_sides = (side_sigma[:, :2] + side_sigma[:, 2:]) / 2
    long_side_sigma = np.where(lengthwise, of_opposite_sides[:, 0], of_opposite_sides[:, 1])
    end_sigma = np.where(lengthwise, of_opposite_sides[:, 1], of_opposite_sides[:, 0])
    columns = {
        "contrast": state.contrast,
        "fit_scatter": np.log(np.sqrt((system.scatter**2).mean(axis=1)) / contrast),
        "worst_scatter": np.log(system.scatter.max(axis=1) / contrast),
        "inlier_share": system.inliers,
        "clipped_share": lattice.clipped[:, 0],
        "blur_px": state.blur_px,
        "log_end_sigma": np.log(end_sigma),
        "log_side_sigma": np.log(long_side_sigma),
        "log_moved_px": np.log(moved_px + 0.1),
        "log_last_step": np.log(np.abs(system.side_step).max(axis=1) + 0.01),
        "log_gap": np.log(np.linalg.norm(state.open_gap(), axis=1) + 0.1),
    }
    return np.column_stack([columns[name] for name in STATISTICS])
