"""The unknowns of markings, and the steps of Gauss-Newton that find them.

A marking's unknowns are the starts and ends of its four sides, its blur, its contrast, the light at knots
along it and the light's slope across it. All markings of an image take a step at once, but for those that
have settled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.quads import robust
from v2hdm.detection.quads.coverage import TABLE, blurred_coverage, owen_table
from v2hdm.detection.quads.lattice import KNOTS, Lattice
from v2hdm.detection.quads.patch import LensFrames
from v2hdm.detection.quads.robust import add_paint, pixel_weights
from v2hdm.geometry.planar import Quad, following
from v2hdm.native import kernels
from v2hdm.records import FloatArray

_BLUR_SIGMA_PX = 0.2  # how far one marking's blur is from the typical one, px: motion, focus, frayed paint
_LEAST_BLUR_PX = 0.35  # least blur of a marking, px
_MOST_BLUR_PX = 3.0  # largest blur of a marking, px

_CLOSURE_SHARE = 0.03
"""Standard deviation of the sum of opposite corners, in parts of the root of a marking's area.

A guess of the mounting that is 2 degrees off makes 3 % of a parallelogram.
"""

_CLOSURE_M = 0.005  # least standard deviation of that sum, m: stencils are true to 5 mm
_ALTERNATING = np.array(
    [1.0, -1.0, 1.0, -1.0]
)  # signs of the corners in the sum, which closes parallelograms

_CONTRAST = 0.95  # log contrast of paint over ground, as measured on asphalt
_CONTRAST_SIGMA = 1.0  # standard deviation of the log contrast, widened for worn and for fresh paint
_MOST_CONTRAST = 4.0  # log contrast of white paint on the blackest ground
_LIGHT_STEP = 0.4  # by how much the log light differs between knots: a shadow's border is a few of that

_WIDE_SCATTER = 0.4  # least scatter at the first step of a search, halved at each: the next explains more
_FINAL_SCATTER = 0.1  # least scatter at the first step of a fit, halved at each

_MAX_STEP = 2.0  # longest step of a side, in blurs
_MAX_CONTRAST_STEP = 0.5  # longest step of the log contrast
_SETTLED_PX = 0.05  # a step of a fit that is shorter than this is the last, px
_FOUND_PX = 0.3  # a step of a search that is shorter than this is the last, px
_INSIGNIFICANT = 0.01  # stop after a step whose predicted fall of chi-square is no more than this
_HELD = 1e9  # information of a blur that is held

_SIDES = np.arange(8)  # places of the sides' starts, 0 to 3, and ends, 4 to 7, among the unknowns
_BLUR = 8  # place of the blur among the unknowns
_K = 9  # place of the log contrast among the unknowns
_LIGHT = 10  # place of the first knot of light among the unknowns
_SLOPE = _LIGHT + KNOTS  # place of the light's slope across the marking among the unknowns
_UNKNOWNS = _SLOPE + 1  # number of unknowns of a marking

_DIFFERENCE = np.diff(np.eye(KNOTS), axis=0)  # matrix of the differences between neighbouring knots

_ROUGHNESS = (_DIFFERENCE.T @ _DIFFERENCE + 1e-6 * np.eye(KNOTS)) / _LIGHT_STEP**2
"""Information (KNOTS, KNOTS) that light changes little along a marking; next to none of how bright it is."""


def _prior() -> FloatArray:
    """Information (U, U) that blur and contrast are typical, and that light changes little."""
    prior = np.zeros((_UNKNOWNS, _UNKNOWNS))
    prior[_BLUR, _BLUR] = 1 / _BLUR_SIGMA_PX**2
    prior[_K, _K] = 1 / _CONTRAST_SIGMA**2
    prior[_SLOPE, _SLOPE] = 1 / _LIGHT_STEP**2
    prior[_LIGHT:_SLOPE, _LIGHT:_SLOPE] = _ROUGHNESS
    return prior


_PRIOR = _prior()

_RULES = {
    "least_blur_px": _LEAST_BLUR_PX,
    "most_blur_px": _MOST_BLUR_PX,
    "blur_sigma_px": _BLUR_SIGMA_PX,
    "contrast": _CONTRAST,
    "contrast_sigma": _CONTRAST_SIGMA,
    "most_contrast": _MOST_CONTRAST,
    "light_step": _LIGHT_STEP,
    "most_step": _MAX_STEP,
    "most_contrast_step": _MAX_CONTRAST_STEP,
    "insignificant": _INSIGNIFICANT,
    "held": _HELD,
    "roughness": _ROUGHNESS,
    **robust.RULES,
    **TABLE,
}
"""The constants of a step, for the compiled kernel."""


@dataclass
class System:
    """Normal equations at the last linearisation."""

    information: FloatArray  # (M, U, U)
    scatter: FloatArray  # (M, 4) of log grey by side
    inliers: FloatArray  # (M,) mean robust weight
    side_step: FloatArray  # (M, 8) last step of the sides' starts and ends, px
    decrement: FloatArray  # (M,) by how much chi-square was to fall by it (Newton's decrement)

    @classmethod
    def empty(cls, count: int) -> System:
        """Room for the equations of ``count`` markings."""
        return cls(
            information=np.zeros((count, _UNKNOWNS, _UNKNOWNS)),
            scatter=np.zeros((count, 4)),
            inliers=np.zeros(count),
            side_step=np.zeros((count, 8)),
            decrement=np.zeros(count),
        )


def _put(whole: System | State, rows: np.ndarray, part: System | State) -> None:
    """Overwrite the markings ``rows`` with those of ``part``."""
    for name, value in vars(whole).items():
        if isinstance(value, np.ndarray):
            value[rows] = getattr(part, name)


@dataclass
class State:
    """The unknowns of M markings, and what is expected of them."""

    quad: Quad
    blur_px: FloatArray  # (M,)
    expected_blur_px: float
    outline: FloatArray  # (M, 4, 2) corners that the network drew
    outline_sigma_px: FloatArray  # (M, 8) of its sides' starts and ends along their normals
    closure: FloatArray  # (M, 2, 8) from the corners to p0 - p1 + p2 - p3 on the ground, in its sigma
    gap: FloatArray  # (M, 2) that of the outline
    contrast: FloatArray  # (M,) log contrast of paint over ground
    expected_contrast: FloatArray  # (M,)
    light: FloatArray  # (M, KNOTS) logarithms of the light on the ground
    slope: FloatArray  # (M,) of the light across the marking

    @classmethod
    def at(
        cls,
        quad: Quad,
        blur_px: FloatArray,
        expected_blur_px: float,
        outline_sigma_px: FloatArray,
        frames: LensFrames,
    ) -> State:
        """The state at a start; light and contrast are not known yet (nan)."""
        count = len(blur_px)
        closure, gap = _closure(quad.corners, frames)
        return cls(
            quad=Quad(quad.corners.copy()),
            blur_px=blur_px.copy(),
            expected_blur_px=expected_blur_px,
            outline=np.ascontiguousarray(quad.corners),
            outline_sigma_px=outline_sigma_px,
            closure=closure,
            gap=gap,
            contrast=np.full(count, _CONTRAST),
            expected_contrast=np.full(count, _CONTRAST),
            light=np.full((count, KNOTS), np.nan),
            slope=np.zeros(count),
        )

    def settle(self, lattice: Lattice, steps: int, paint: np.ndarray | None = None) -> System:
        """Gauss-Newton until each marking's step is small or says nothing; the system is of its last step.

        With the network's probability of ``paint`` (M, N) it is a search, without it a fit.
        """
        scatter = _FINAL_SCATTER if paint is None else _WIDE_SCATTER
        settled_px = _SETTLED_PX if paint is None else _FOUND_PX
        count = len(self.blur_px)
        system = System.empty(count)
        compiled = kernels()
        if compiled is not None:
            rules = _RULES | {"settled_px": settled_px}
            compiled.settle(self, system, lattice, paint, owen_table(), rules, steps, scatter)
            self.quad = Quad(self.quad.corners)
            return system
        running = np.arange(count)
        for number in range(steps):
            running_state = self._take(running)
            running_system = running_state.step(lattice, paint, scatter * 0.5**number)
            _put(self, running, running_state)
            _put(system, running, running_system)
            self.quad.corners[running] = running_state.quad.corners
            is_long = np.abs(running_system.side_step).max(axis=1) > settled_px
            moving = np.flatnonzero(is_long & (running_system.decrement > _INSIGNIFICANT))
            if not len(moving):
                break
            if len(moving) < len(running):
                running = running[moving]
                lattice = lattice.take(moving)
                paint = None if paint is None else paint[moving]
        self.quad = Quad(self.quad.corners)
        return system

    @property
    def corners(self) -> FloatArray:
        """The corners (M, 4, 2)."""
        return self.quad.corners

    def _take(self, rows: np.ndarray) -> State:
        """Some of the markings."""
        arrays = {name: array[rows] for name, array in vars(self).items() if isinstance(array, np.ndarray)}
        return State(Quad(self.quad.corners[rows]), expected_blur_px=self.expected_blur_px, **arrays)

    def step(self, lattice: Lattice, paint: np.ndarray | None, least_scatter: float) -> System:
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
        weights = pixel_weights(residual, use, lattice, least_scatter)
        design = np.empty((len(coverage), _UNKNOWNS, coverage.shape[1]), dtype=np.float32)
        np.multiply(by_shape, gain[:, None], out=design[:, :_K])
        design[:, _K] = (gain + 1) * coverage
        np.multiply(hats, ratio[:, None], out=design[:, _LIGHT:_SLOPE])
        design[:, _SLOPE] = across * ratio
        weighted = design * weights.weight[:, None]
        information = (weighted @ design.swapaxes(1, 2)).astype(np.float64)
        gradient = (weighted @ residual[..., None])[..., 0].astype(np.float64)
        if paint is not None:
            add_paint(information, gradient, coverage, by_shape, paint, lattice.use)
        self._add_priors(information, gradient, hold_blur=paint is not None)
        step = np.linalg.solve(information, gradient[..., None])[..., 0]
        most_px = _MAX_STEP * self.blur_px[:, None]
        side_step = np.clip(step[:, :_BLUR], -most_px, most_px)
        self.quad = self.quad.moved(side_step)
        if paint is None:
            self.blur_px = np.clip(self.blur_px + step[:, _BLUR], _LEAST_BLUR_PX, _MOST_BLUR_PX)
        self.contrast = self.contrast + np.clip(step[:, _K], -_MAX_CONTRAST_STEP, _MAX_CONTRAST_STEP)
        self.light = self.light + step[:, _LIGHT:_SLOPE]
        self.slope = self.slope + step[:, _SLOPE]
        decrement = (gradient * step).sum(axis=1)
        return System(information, weights.scatter, weights.inliers, side_step, decrement)

    def _first_light(self, lattice: Lattice, coverage: np.ndarray) -> None:
        """Light and contrast of least squares, the logarithm taken as linear in the coverage."""
        basis = np.concatenate([lattice.hats, coverage[:, None]], axis=1)
        weighted = basis * lattice.use[:, None]
        matrix = (weighted @ basis.swapaxes(1, 2)).astype(np.float64)
        target = (weighted @ lattice.values[..., None])[..., 0].astype(np.float64)
        prior = np.zeros_like(matrix)
        prior[:, :KNOTS, :KNOTS] = _ROUGHNESS
        prior[:, KNOTS, KNOTS] = 1 / _CONTRAST_SIGMA**2
        solution = np.linalg.solve(matrix + prior + 1e-6 * np.eye(KNOTS + 1), target[..., None])[..., 0]
        contrast = solution[:, KNOTS]
        # Yellow paint is darker than the ground in blue.
        self.expected_contrast = np.where(contrast < 0, -_CONTRAST, _CONTRAST)
        self.light = solution[:, :KNOTS]
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
    by_pinhole = frames.camera.ground_jacobian(flat).reshape(-1, 4, 2, 2)
    by_corner = by_pinhole @ frames.from_px[:, None]
    size_m = np.sqrt(Quad(ground).area)
    sigma_m = np.asarray(np.maximum(_CLOSURE_SHARE * size_m, _CLOSURE_M))[:, None, None]
    derivative = (_ALTERNATING[:, None, None] * by_corner).transpose(0, 2, 1, 3).reshape(-1, 2, 8) / sigma_m
    gap = _ALTERNATING @ ground / sigma_m[..., 0]
    is_known = np.isfinite(derivative).all(axis=(1, 2)) & np.isfinite(gap).all(axis=1)
    return np.where(is_known[:, None, None], derivative, 0.0), np.where(is_known[:, None], gap, 0.0)
