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

import numpy as np

from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.quads.lattice import (
    KNOTS,
    Lattice,
    add_paint,
    blurred_coverage,
    lay_grid,
    lay_lattice,
    pixel_weights,
)
from v2hdm.detection.quads.patch import LensFrames, Patches
from v2hdm.geometry.planar import Quad, following, is_convex_px
from v2hdm.records import OUTLINE_SIGMA_PX, BoolArray, FloatArray

TYPICAL_BLUR_PX = 0.75  # point spread of a focused camera, px, pixel aperture included

_BLUR_SIGMA_PX = 0.2  # how far one marking's blur is from the typical one, px: motion, focus, frayed paint
_BLUR_LIMITS_PX = (0.35, 3.0)
_SEARCH_BLUR = 0.6
_LEAST_SEARCH_BLUR_PX = 1.5
"""Blur of the first steps, in distances of the grid's points and px: a wide one sees sides from far away."""

_SEARCH_SIGMA = 0.1  # how far the network's outline is from a side's end before the search, marking lengths

_CLOSURE_SHARE = 0.03
_CLOSURE_M = 0.005
"""Standard deviation of the sum of opposite corners, in parts of the root of the area and at least in m.

Stencils are true to 5 mm; a guess of the mounting that is 2 degrees off makes 3 % of a parallelogram.
"""

# Where this share of a marking's pixels is clipped, its outline lies about so many blurs outside the paint.
_BLOOM = 1.2
_MUCH_CLIPPED = 0.15

_MOST_MOVED = 0.5
_MOST_GROWTH = 4.0
"""A fit that moves its middle by more of its size, or grows or shrinks by more, follows something else."""

OPEN_SIGMA = 3.0  # a side cut by the image's border is unknown within this many lengths of the marking
_BEYOND_PX = 6.0  # how far beyond the border a side that it cuts is started, px: farther than blur reaches

_CONTRAST = 0.95
_CONTRAST_SIGMA = 1.0
"""Log contrast of paint over ground, as measured on asphalt, widened for worn and for fresh paint."""

_MOST_CONTRAST = 4.0  # log contrast of white paint on the blackest ground
_LIGHT_STEP = 0.4  # by how much the log light differs between knots: a shadow's border is a few of that

# Least scatter at the first step of search and fit, halved at each: the next may explain what one rejects.
_WIDE_SCATTER = 0.4
_FINAL_SCATTER = 0.1

_MODEL_SIGMA_PX = 0.04
"""Error of a side along the pixels' rows, px, with no noise at all: a Gaussian is not quite a pixel's
aperture."""

_SEARCH_STEPS = 4
_STEPS = 8
_MAX_STEP = 2.0  # longest step of a side, in blurs
_SETTLED_PX = 0.05
_FOUND_PX = 0.3  # steps of fit and of search that are shorter than this are the last, px
_INSIGNIFICANT = 0.01  # and so are those by which chi-square was to fall by no more than this
_BLUR = 8
_K = 9
_LIGHT = 10
_SLOPE = _LIGHT + KNOTS
_UNKNOWNS = _SLOPE + 1
"""Places among the unknowns: starts of the sides 0 to 3, their ends 4 to 7, blur, contrast, light, slope."""

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

_ALTERNATING = np.array([1.0, -1.0, 1.0, -1.0])
_DIFFERENCE = np.diff(np.eye(KNOTS), axis=0)
_ROUGHNESS = (_DIFFERENCE.T @ _DIFFERENCE + 1e-6 * np.eye(KNOTS)) / _LIGHT_STEP**2
_PRIOR = np.zeros((_UNKNOWNS, _UNKNOWNS))
_PRIOR[_BLUR, _BLUR] = 1 / _BLUR_SIGMA_PX**2
_PRIOR[_K, _K] = 1 / _CONTRAST_SIGMA**2
_PRIOR[_SLOPE, _SLOPE] = 1 / _LIGHT_STEP**2
_PRIOR[_LIGHT:_SLOPE, _LIGHT:_SLOPE] = _ROUGHNESS
"""Information that the typical blur and contrast are of, and that light changes little."""

_HELD = 1e9  # information of a blur that is held
_SIDES = np.arange(8)

_TILT_SHARE = 0.5  # a side that is off as a whole is askew by this share of that
_WHOLE_SIDES = np.kron([[1.0, 1.0], [1.0, 1.0]], np.eye(4)) + _TILT_SHARE**2 * np.kron(
    [[1.0, -1.0], [-1.0, 1.0]], np.eye(4)
)
"""Covariance of the starts and ends of sides that are off as a whole by one."""

_CORNER = np.arange(4)


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
        start, end, both = _ends(self.side_covariance)
        return np.asarray((start + end + 2 * both) / 4)

    def _second_order(self, by_side: FloatArray) -> FloatArray:
        """Covariance (M, 8, 8), px^2, that the error of a side's direction adds where its end is vague.

        A corner that may lie far along a side is off across it by its way times the error of the side's
        direction.
        """
        start, end, both = _ends(by_side)
        normal = self.quad.normal
        tilt = np.maximum(start + end - 2 * both, 0) / np.maximum(self.quad.length, 1.0) ** 2
        out = np.zeros((len(normal), 4, 2, 4, 2))
        # Corner c runs along side c if the end of side c - 1 is vague, along side c - 1 if the start of c is.
        for of, slack in ((_CORNER, np.roll(end, 1, axis=1)), (_CORNER - 1, start)):
            variance = tilt[:, of] * slack
            outer = normal[:, of, :, None] * normal[:, of, None, :]
            out[:, _CORNER, :, _CORNER] += (variance[..., None, None] * outer).swapaxes(0, 1)
        return out.reshape(-1, 8, 8)


def _ends(by_side: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Variances (M, 4) of each side's start and end, and their covariance."""
    start = by_side[:, _CORNER, _CORNER]
    end = by_side[:, _CORNER + 4, _CORNER + 4]
    return start, end, by_side[:, _CORNER, _CORNER + 4]


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
    corners_px = frames.to_px(start.corners)
    length_px = start.length.max(axis=1)[:, None]

    grid, paint, spacing_px = lay_grid(patches, frames, corners_px)
    search_blur_px = np.maximum(_SEARCH_BLUR * spacing_px, _LEAST_SEARCH_BLUR_PX)
    sigma_px = np.tile(np.where(open_sides, OPEN_SIGMA, _SEARCH_SIGMA) * length_px, 2)
    state = _State.at(start, search_blur_px, blur_px, sigma_px, frames)
    state.settle(grid, _SEARCH_STEPS, paint)
    searched = state.quad.corners.copy()
    lost = ~_sound(state.quad, start)
    searched[lost] = start.corners[lost]
    searched_px = frames.to_px(searched)
    # Beyond the image a lens model may fold.
    within = camera.inside(searched_px, -OPEN_SIGMA * OUTLINE_SIGMA_PX).all(axis=1)
    folded = ~within & ~open_sides.any(axis=1)
    folded |= ~(np.ptp(searched_px, axis=1).max(axis=1) < 2 * np.ptp(corners_px, axis=1).max(axis=1))
    searched[folded], searched_px[folded] = start.corners[folded], corners_px[folded]

    lattice = lay_lattice(patches, frames, searched_px)
    found = Quad(searched)
    inward_px = -_BLOOM * blur_px * np.minimum(lattice.clipped[:, 0] / _MUCH_CLIPPED, 1.0)
    begun = found.moved(np.repeat(inward_px[:, None], 8, axis=1))
    sigma_px = np.tile(np.where(open_sides, OPEN_SIGMA * length_px, OUTLINE_SIGMA_PX), 2)
    state = _State.at(begun, np.full(len(searched), blur_px), blur_px, sigma_px, frames)
    system = state.settle(lattice, _STEPS)
    covariance = np.linalg.inv(system.information)[:, :8, :8]
    last = system.by_side
    covariance = covariance + last[:, :, None] * last[:, None, :] + _MODEL_SIGMA_PX**2 * np.eye(8)
    astray = ~_sound(state.quad, found)
    corners = state.quad.corners.copy()
    corners[astray] = searched[astray]
    covariance[astray] = np.einsum("mi,ij->mij", sigma_px[astray] ** 2, np.eye(8))
    state.quad = Quad(corners)
    moved_px = np.abs(corners - start.corners).max(axis=(1, 2))
    statistics = _statistics(state, system, lattice, covariance, moved_px)
    return Fit(frames, state.quad, covariance, statistics, open_sides)


def _sound(quad: Quad, before: Quad) -> BoolArray:
    """Which quadrilaterals (M,) are convex and share about the place and size of those ``before``."""
    corners, old = quad.corners, before.corners
    moved = np.abs(corners.mean(axis=1) - old.mean(axis=1)).max(axis=1)
    area = quad.area / np.maximum(before.area, 1e-6)
    near = moved < _MOST_MOVED * np.ptp(old, axis=1).max(axis=1) + 2 * OUTLINE_SIGMA_PX
    near &= (area < _MOST_GROWTH) & (area > 1 / _MOST_GROWTH)
    return np.asarray(is_convex_px(corners) & np.isfinite(corners).all(axis=(1, 2)) & near)


@dataclass
class _System:
    """Normal equations at the last linearisation."""

    information: FloatArray  # (M, U, U)
    scatter: FloatArray  # (M, 4) of log grey by side
    inliers: FloatArray  # (M,) mean robust weight
    by_side: FloatArray  # (M, 8) last step
    decrement: FloatArray  # (M,) by how much chi-square was to fall by it (Newton's decrement)


def _put(whole: _System | _State, rows: np.ndarray, part: _System | _State) -> None:
    """Overwrite the markings ``rows`` with those of ``part``."""
    for name, value in vars(whole).items():
        if isinstance(value, np.ndarray):
            value[rows] = getattr(part, name)


@dataclass
class _State:
    """The unknowns of M markings: quadrilateral, blur, contrast, light (M, KNOTS) and its slope across."""

    quad: Quad
    blur_px: FloatArray
    expected_blur_px: float
    outline: FloatArray  # (M, 4, 2) corners that the network drew
    outline_sigma_px: FloatArray  # (M, 8) of its sides' starts and ends along their normals
    closure: FloatArray  # (M, 2, 8) from the corners to p0 - p1 + p2 - p3 on the ground, in its sigma
    gap: FloatArray  # (M, 2) that of the outline
    contrast: FloatArray
    expected_contrast: FloatArray
    light: FloatArray
    slope: FloatArray

    @classmethod
    def at(
        cls,
        quad: Quad,
        blur_px: FloatArray,
        expected_blur_px: float,
        outline_sigma_px: FloatArray,
        frames: LensFrames,
    ) -> _State:
        """The state at a start; light and contrast are not known yet (nan)."""
        count = len(blur_px)
        outline = quad.corners, outline_sigma_px, *_closure(quad.corners, frames)
        known = Quad(quad.corners.copy()), blur_px, expected_blur_px, *outline
        contrast = np.full(count, _CONTRAST)
        light = np.full((count, KNOTS), np.nan)
        return cls(*known, contrast, contrast.copy(), light, np.zeros(count))

    def settle(self, lattice: Lattice, steps: int, paint: np.ndarray | None = None) -> _System:
        """Gauss-Newton until each marking's step is small or says nothing; the system is of its last step."""
        scatter, settled_px = (_FINAL_SCATTER, _SETTLED_PX) if paint is None else (_WIDE_SCATTER, _FOUND_PX)
        count = len(self.blur_px)
        system = _System(
            *(np.zeros((count, *shape)) for shape in ((_UNKNOWNS, _UNKNOWNS), (4,), (), (8,), ()))
        )
        running = np.arange(count)
        for number in range(steps):
            now = self._take(running)
            part = now.step(lattice, paint, scatter * 0.5**number)
            _put(self, running, now)
            _put(system, running, part)
            self.quad.corners[running] = now.quad.corners
            moving = np.abs(part.by_side).max(axis=1) > settled_px
            moving = np.flatnonzero(moving & (part.decrement > _INSIGNIFICANT))
            if not len(moving):
                break
            if len(moving) < len(running):
                running = running[moving]
                lattice = lattice.take(moving)
                paint = None if paint is None else paint[moving]
        self.quad = Quad(self.quad.corners)
        return system

    def _take(self, rows: np.ndarray) -> _State:
        parts = {name: v[rows] for name, v in vars(self).items() if isinstance(v, np.ndarray)}
        return _State(Quad(self.quad.corners[rows]), expected_blur_px=self.expected_blur_px, **parts)

    def step(self, lattice: Lattice, paint: np.ndarray | None, least_scatter: float) -> _System:
        """One Gauss-Newton step, in place; the robust scale is ``least_scatter`` or more."""
        coverage, by_shape = blurred_coverage(self.quad, lattice.points, self.blur_px)
        hats = lattice.hats
        across = lattice.across
        if np.isnan(self.light).any():
            self._first_light(lattice, coverage)
        gain = np.exp(self.contrast).astype(np.float32)[:, None] - 1
        ratio = 1 + gain * np.clip(coverage, 0, 1)
        model = (self.light[:, None].astype(np.float32) @ hats)[:, 0]
        model += self.slope.astype(np.float32)[:, None] * across + np.log(ratio)
        # In units of the light on the ground: blur errs by shares of the step, not of the pixel's own value.
        residual = (lattice.values - model) * ratio
        # Where the sensor was at its limit the truth is as bright or brighter.
        use = lattice.use * ~(lattice.limited & (residual < 0))
        residual *= use
        weight, scatter, inliers = pixel_weights(residual, use, lattice, least_scatter)
        design = np.empty((len(coverage), _UNKNOWNS, coverage.shape[1]), dtype=np.float32)
        np.multiply(by_shape, gain[:, None], out=design[:, :_K])
        design[:, _K] = (gain + 1) * coverage
        np.multiply(hats, ratio[:, None], out=design[:, _LIGHT:_SLOPE])
        design[:, _SLOPE] = across * ratio
        weighted = design * weight[:, None]
        information = (weighted @ design.swapaxes(1, 2)).astype(np.float64)
        gradient = (weighted @ residual[..., None])[..., 0].astype(np.float64)
        if paint is not None:
            add_paint(information, gradient, coverage, by_shape, paint, lattice.use)
        self._add_priors(information, gradient, hold_blur=paint is not None)
        moved = np.linalg.solve(information, gradient[..., None])[..., 0]
        most_px = _MAX_STEP * self.blur_px[:, None]
        by_side = np.clip(moved[:, :_BLUR], -most_px, most_px)
        self.quad = self.quad.moved(by_side)
        if paint is None:
            self.blur_px = np.clip(self.blur_px + moved[:, _BLUR], *_BLUR_LIMITS_PX)
        self.contrast = self.contrast + np.clip(moved[:, _K], -0.5, 0.5)
        self.light = self.light + moved[:, _LIGHT:_SLOPE]
        self.slope = self.slope + moved[:, _SLOPE]
        return _System(information, scatter, inliers, by_side, (gradient * moved).sum(axis=1))

    def _first_light(self, lattice: Lattice, coverage: np.ndarray) -> None:
        """Light and contrast of least squares, the logarithm taken as linear in the coverage."""
        basis = np.concatenate([lattice.hats, coverage[:, None]], axis=1)
        weighted = basis * lattice.use[:, None]
        matrix = (weighted @ basis.swapaxes(1, 2)).astype(np.float64)
        target = (weighted @ lattice.values[..., None])[..., 0].astype(np.float64)
        prior = np.zeros_like(matrix)
        prior[:, :KNOTS, :KNOTS] = _ROUGHNESS
        prior[:, KNOTS, KNOTS] = 1 / _CONTRAST_SIGMA**2
        found = np.linalg.solve(matrix + prior + 1e-6 * np.eye(KNOTS + 1), target[..., None])[..., 0]
        contrast = found[:, KNOTS]
        # Yellow paint is darker than the ground in blue.
        self.expected_contrast = np.where(contrast < 0, -_CONTRAST, _CONTRAST)
        self.light = found[:, :KNOTS]
        self.contrast = np.clip(contrast, -_MOST_CONTRAST, _MOST_CONTRAST)

    def open_gap(self) -> FloatArray:
        """The sum p0 - p1 + p2 - p3 of the corners on the ground (M, 2), in its deviation."""
        moved = (self.quad.corners - self.outline).reshape(-1, 8, 1)
        return np.asarray((self.closure @ moved)[..., 0] + self.gap)

    def _add_priors(self, information: FloatArray, gradient: FloatArray, *, hold_blur: bool) -> None:
        """Add the outline, the typical blur and contrast, and that light changes little."""
        normal = self.quad.normal
        off = self.outline - self.quad.corners
        start = (off * normal).sum(axis=-1)
        end = (following(off) * normal).sum(axis=-1)
        stiffness = 1 / self.outline_sigma_px**2
        by_side = self.closure @ self.quad.corner_from_side
        information += _PRIOR
        information[:, :8, :8] += by_side.swapaxes(1, 2) @ by_side
        information[:, _SIDES, _SIDES] += stiffness
        gradient[:, :8] += stiffness * np.concatenate([start, end], axis=1)
        gradient[:, :8] -= (self.open_gap()[:, None] @ by_side)[:, 0]
        if hold_blur:
            information[:, _BLUR, _BLUR] += _HELD
        else:
            gradient[:, _BLUR] += (self.expected_blur_px - self.blur_px) / _BLUR_SIGMA_PX**2
        gradient[:, _K] += (self.expected_contrast - self.contrast) / _CONTRAST_SIGMA**2
        gradient[:, _LIGHT:_SLOPE] -= self.light @ _ROUGHNESS
        gradient[:, _SLOPE] -= self.slope / _LIGHT_STEP**2


def _closure(corners: FloatArray, frames: LensFrames) -> tuple[FloatArray, FloatArray]:
    """The gap p0 - p1 + p2 - p3 on the ground, in its deviation: derivative (M, 2, 8) and value (M, 2).

    It is 0 for parallelograms, as all markings are painted. 0 where a corner shows no ground.
    """
    pinhole = frames.to_pinhole(corners)
    flat = pinhole.reshape(-1, 2)
    ground = frames.camera.ground(flat).reshape(corners.shape)
    by_corner = (
        frames.camera.ground_jacobian(flat).reshape(-1, 4, 2, 2) @ np.linalg.inv(frames.scale)[:, None]
    )
    size_m = np.sqrt(Quad(ground).area)
    sigma_m = np.asarray(np.maximum(_CLOSURE_SHARE * size_m, _CLOSURE_M))[:, None, None]
    derivative = (_ALTERNATING[:, None, None] * by_corner).transpose(0, 2, 1, 3).reshape(-1, 2, 8) / sigma_m
    gap = _ALTERNATING @ ground / sigma_m[..., 0]
    known = np.isfinite(derivative).all(axis=(1, 2)) & np.isfinite(gap).all(axis=1)
    return np.where(known[:, None, None], derivative, 0.0), np.where(known[:, None], gap, 0.0)


def _statistics(
    state: _State, system: _System, lattice: Lattice, covariance: FloatArray, moved_px: FloatArray
) -> FloatArray:
    contrast = np.maximum(np.abs(state.contrast), 0.05)
    side_sigma = (
        np.sqrt(np.maximum(covariance[:, np.arange(8), np.arange(8)], 1e-8)).reshape(-1, 2, 4).mean(axis=1)
    )
    lengthwise = state.quad.lengthwise
    pairs = (side_sigma[:, :2] + side_sigma[:, 2:]) / 2
    long = np.where(lengthwise, pairs[:, 0], pairs[:, 1])
    end = np.where(lengthwise, pairs[:, 1], pairs[:, 0])
    columns = {
        "contrast": state.contrast,
        "fit_scatter": np.log(np.sqrt((system.scatter**2).mean(axis=1)) / contrast),
        "worst_scatter": np.log(system.scatter.max(axis=1) / contrast),
        "inlier_share": system.inliers,
        "clipped_share": lattice.clipped[:, 0],
        "blur_px": state.blur_px,
        "log_end_sigma": np.log(end),
        "log_side_sigma": np.log(long),
        "log_moved_px": np.log(moved_px + 0.1),
        "log_last_step": np.log(np.abs(system.by_side).max(axis=1) + 0.01),
        "log_gap": np.log(np.linalg.norm(state.open_gap(), axis=1) + 0.1),
    }
    return np.column_stack([columns[name] for name in STATISTICS])
