r"""Which single wrong input would explain the residuals best: score tests at a solution.

A fault is one number p more in the model, zero in what was solved: a clock offset, a focal length, a shift
of a survey. At the optimum the gradient of all that was estimated vanishes, so with whitened residuals r
and their derivatives J_p the fault's value and what it would take off the cost follow from one step,

.. math:: p = -\frac{J_p' r}{s}, \quad s = J_p' J_p - \|N_{yp}\|^2, \quad \text{gain} = \frac{(J_p' r)^2}{s},

where N_yp is the coupling of p to the whitened variables (:mod:`v2hdm.adjust.whitening`): everything else
is estimated anew along with p (Rao's score test; Rao, Linear Statistical Inference and Its Applications,
2nd ed., section 6e). The gain is chi-square with one degree of freedom where the model is right. A fault
costs about as much as one evaluation of the gradient, and no solve.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.model import (
    Gradient,
    centre_residual,
    control_residual,
    length_residual,
    rigid,
    robustified,
)
from v2hdm.adjust.problem import Problem
from v2hdm.adjust.solution import Solution
from v2hdm.adjust.whitening import Whitening
from v2hdm.geometry.tensors import exp, inverse

_STEP = 1e-3
"""Step of central differences, in the unit of the fault (s or rad): millimetres of motion."""

_LEAST_OBSERVABLE = 1e-9
"""Share of a fault's own information, left by all else, below which rounding alone is left of it."""


class Fault(Enum):
    """An input that may be wrong, and the unit of its value."""

    CLOCK = "clock"  # images were taken later than they say
    FOCAL = "focal"  # share by which the focal length is longer than stated
    DISTORTION = "distortion"  # first radial coefficient
    PRINCIPAL = "principal"  # point of the image on the optical axis
    SLOPE = "slope"  # of the ground, which the poses do not know of
    SURVEY = "survey"  # of one camera's centre
    LEVER = "lever"  # all centres alike: from the point that the poses are of
    SIZE = "size"  # known lengths of one value
    CONTROL = "control"  # one surveyed point
    DATUM = "datum"  # all surveyed points alike

    @property
    def unit(self) -> str:
        """Of the value and its sigma."""
        return _UNITS[self]


_UNITS = {
    Fault.CLOCK: "s",
    Fault.FOCAL: "",
    Fault.DISTORTION: "",
    Fault.PRINCIPAL: "px",
    Fault.SLOPE: "rad",
    Fault.SURVEY: "m",
    Fault.LEVER: "m",
    Fault.SIZE: "m",
    Fault.CONTROL: "m",
    Fault.DATUM: "m",
}


@dataclass(frozen=True)
class ScoreTest:
    """One fault, as the residuals see it.

    Attributes:
        fault: what would be wrong.
        camera: of which camera of the problem; -1 for all together.
        axis: along which axis, 0 to 2: of the vehicle (survey, lever), of the map (slope, datum), of the
            image (principal).
        item: which of the problem's control points, known lengths or (clock) visits; -1 for none or all.
        value: by how much, true minus stated.
        sigma: how well the drive observes it, inf where it cannot.
        gain: by how much twice the cost would fall: chi-square with one degree of freedom.
    """

    fault: Fault
    camera: int
    axis: int
    item: int
    value: float
    sigma: float
    gain: float

    @property
    def sigmas(self) -> float:
        """The value in its standard deviations."""
        return float(np.sqrt(self.gain))


@dataclass(frozen=True)
class _Column:
    """J_p of one fault: how the whitened residuals change with it; None for blocks that do not.

    ``observations`` (2, K), ``centre`` (C, 3), ``control`` (N, 2), ``length`` (M,).
    """

    observations: Tensor | None = None
    centre: Tensor | None = None
    control: Tensor | None = None
    length: Tensor | None = None

    def dot(self, other: _Column) -> float:
        """The product with another column."""
        pairs = (
            (self.observations, other.observations),
            (self.centre, other.centre),
            (self.control, other.control),
            (self.length, other.length),
        )
        return sum(float((a * b).sum()) for a, b in pairs if a is not None and b is not None)


@dataclass(frozen=True)
class _Hypothesis:
    """One fault, and how to get its column."""

    fault: Fault
    column: Callable[[_Bench], _Column]
    camera: int = -1
    axis: int = 0
    item: int = -1


@dataclass(frozen=True)
class _Bench:
    """A solution made ready for tests: with the roots of weights, least squares remain.

    Attributes:
        whitening: the solution's Hessian.
        root: (K,) of the weights.
        residuals: of everything.
        whitened_px: (2, K) residuals of the observations without weights.
    """

    whitening: Whitening
    root: Tensor
    residuals: _Column
    whitened_px: Tensor

    @classmethod
    def at(cls, whitening: Whitening) -> _Bench:
        """The bench of a solution's Hessian."""
        engine, estimate = whitening.engine, whitening.estimate
        whitened_px = engine.residuals(engine.poses(estimate), estimate.corners_map)
        _, weight = robustified(whitening.robust, whitened_px.square().sum(0))
        root = weight.sqrt()  # no floor: it keeps corners factorable, and is no evidence
        priors = _prior_residuals(engine.arrays, estimate.cam_from_vehicle, estimate.corners_map)
        return cls(whitening, root, _Column(whitened_px * root, *priors), whitened_px)

    @property
    def arrays(self) -> Arrays:
        """The problem."""
        return self.whitening.engine.arrays

    @property
    def camera(self) -> Tensor:
        """The camera (K,) of each observation."""
        return (self.arrays.pair // self.arrays.frame_count).long()

    def whiten(self, off: Tensor) -> Tensor:
        """Weighted residuals (2, K) of points that are off (2, K) at depth 1."""
        a, b, c = self.arrays.root_information
        return torch.stack([a * off[0], b * off[0] + c * off[1]]) * self.root

    @property
    def projected(self) -> Tensor:
        """Where the corners are projected (2, K), at depth 1."""
        a, b, c = self.arrays.root_information
        first = self.whitened_px[0] / a
        return self.arrays.measured + torch.stack([first, (self.whitened_px[1] - b * first) / c])

    def coupling(self, column: _Column) -> Tensor:
        """N_yp: what the column has in common with all that is estimated, whitened."""
        engine, estimate = self.whitening.engine, self.whitening.estimate
        zero = [torch.zeros_like(one) for one in (estimate.frame_state, estimate.clock_s)]
        tangent = estimate.cam_from_vehicle.new_zeros(len(estimate.cam_from_vehicle), 6)
        leaves = tangent.requires_grad_(), estimate.corners_map.clone().requires_grad_()
        parts = [column.centre, column.control, column.length]
        chosen = [n for n, part in enumerate(parts) if part is not None]
        extrinsic, corners = torch.zeros_like(tangent), torch.zeros_like(estimate.corners_map)
        if chosen:
            moved = rigid(leaves[0]) @ estimate.cam_from_vehicle
            residuals = _prior_residuals(engine.arrays, moved, leaves[1])
            ends = [residuals[n] for n in chosen]
            by = [parts[n] for n in chosen]
            extrinsic, corners = torch.autograd.grad(ends, leaves, by, materialize_grads=True)
        gradient = Gradient(extrinsic, zero[0], corners, zero[1])
        if column.observations is not None:
            seen = engine.pull(estimate, column.observations * self.root)
            pairs = zip(vars(gradient).values(), vars(seen).values(), strict=True)
            gradient = Gradient(*(one + other for one, other in pairs))
        return self.whitening.whiten(gradient)


def _prior_residuals(
    arrays: Arrays, cam_from_vehicle: Tensor, corners_map: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Residuals of the camera centres, the survey and the known lengths, in the order of :class:`_Column`."""
    known = arrays.lengths
    return (
        centre_residual(arrays, cam_from_vehicle),
        control_residual(arrays, corners_map),
        length_residual(arrays, corners_map[known.first], corners_map[known.second]),
    )


def score_faults(problem: Problem, solution: Solution) -> tuple[ScoreTest, ...]:
    """Every fault that ``problem`` can have, each tested by itself at its ``solution``; largest gain first.

    Where residuals are larger than the model says, sigmas are larger, and gains smaller, by as much.
    """
    bench = _Bench.at(solution.covariance.whitening)
    found = [_test(hypothesis, bench) for hypothesis in _hypotheses(problem, bench.arrays)]
    found += _control_points(problem, solution)
    factor = max(1.0, solution.chi2_per_dof)
    inflated = [replace(one, sigma=one.sigma * factor**0.5, gain=one.gain / factor) for one in found]
    return tuple(sorted(inflated, key=lambda test: -test.gain))


def _test(hypothesis: _Hypothesis, bench: _Bench) -> ScoreTest:
    column = hypothesis.column(bench)
    coupling, own = bench.coupling(column), column.dot(column)
    left = own - float(coupling.square().sum())
    # What the descent has left of the gradient counts where a fault is nearly what something else can be.
    slope = column.dot(bench.residuals) - float(coupling @ bench.whitening.gradient)
    observable = own > 0 and left > _LEAST_OBSERVABLE * own
    return ScoreTest(
        hypothesis.fault,
        hypothesis.camera,
        hypothesis.axis,
        hypothesis.item,
        value=-slope / left if observable else 0.0,
        sigma=float(left**-0.5) if observable else float("inf"),
        gain=slope**2 / left if observable else 0.0,
    )


def _hypotheses(problem: Problem, arrays: Arrays) -> Iterator[_Hypothesis]:
    cameras = range(arrays.camera_count)
    groups = [*([-1] if arrays.camera_count > 1 else []), *cameras]
    for camera in groups:
        if problem.twist_vehicle is not None:
            visits = range(problem.visit_count) if problem.visit_count > 1 else [-1]
            for visit in visits:
                column = _moving(_clock_motion(problem, camera, visit))
                yield _Hypothesis(Fault.CLOCK, column, camera, item=visit)
        yield _Hypothesis(Fault.FOCAL, _lens(camera, 0), camera)
        yield _Hypothesis(Fault.DISTORTION, _lens(camera, 1), camera)
        for axis in (0, 1):
            yield _Hypothesis(Fault.PRINCIPAL, _principal(problem, camera, axis), camera, axis)
    for axis in (0, 1):
        yield _Hypothesis(Fault.SLOPE, _moving(_slope_motion(axis)), axis=axis)
    if bool((arrays.centre_information_root > 0).any()):
        for axis in range(3):
            for camera in cameras:
                yield _Hypothesis(Fault.SURVEY, _survey(camera, axis), camera, axis)
            if arrays.camera_count > 1:
                yield _Hypothesis(Fault.LEVER, _survey(-1, axis), -1, axis)
    if bool((arrays.control_information > 0).any()):
        for axis in (0, 1):
            yield _Hypothesis(Fault.DATUM, _datum(axis), axis=axis)
    for item, length_m in enumerate(torch.unique(arrays.lengths.length_m)):
        yield _Hypothesis(Fault.SIZE, _size(arrays.lengths.length_m == length_m), item=item)


def _control_points(problem: Problem, solution: Solution) -> Iterator[ScoreTest]:
    """Each surveyed point against what everything else says of its corner.

    What the adjustment leaves between a point and its corner has the covariance of the point less that of
    the corner; the two axes are tested together, so the gain has two degrees of freedom.
    """
    control = problem.control
    if control is None or not len(control.corner):
        return
    covariance = solution.corner_covariance(control.corner[:, None])
    for m, (point, sigma_m) in enumerate(zip(control.points_map, control.sigma_m, strict=True)):
        off = solution.corners_map[control.corner[m]] - point
        expected = np.diag(sigma_m**2) - covariance[m]
        if np.linalg.eigvalsh(expected).min() <= _LEAST_OBSERVABLE * np.max(sigma_m) ** 2:
            continue
        gain = float(off @ np.linalg.solve(expected, off))
        # Without the point its corner would lie farther from it, by the share that it had of the information.
        apart = float(np.linalg.norm(sigma_m**2 * np.linalg.solve(expected, off)))
        yield ScoreTest(Fault.CONTROL, -1, -1, m, apart, apart / max(gain, 1e-12) ** 0.5, gain)


def _lens(camera: int, power: int) -> Callable[[_Bench], _Column]:
    """Points seen farther out by the share p, times the squared radius to the ``power``, than they are.

    A focal length longer than stated by the share p, or a first radial coefficient larger by p.
    """

    def column(bench: _Bench) -> _Column:
        # The projected points, not the measured ones: pixels, whose noise is stated, do not scale.
        projected = bench.projected
        mine = (bench.camera == camera) | (camera < 0)
        return _Column(bench.whiten(projected * projected.square().sum(0) ** power * mine))

    return column


def _principal(problem: Problem, camera: int, axis: int) -> Callable[[_Bench], _Column]:
    """A principal point that lies farther right, or down, by one pixel."""
    focal_px = torch.as_tensor(problem.intrinsic[:, axis])

    def column(bench: _Bench) -> _Column:
        seen_by = bench.camera
        off = ((seen_by == camera) | (camera < 0)) / focal_px.to(seen_by.device)[seen_by]
        none = torch.zeros_like(off)
        return _Column(bench.whiten(torch.stack([off, none] if axis == 0 else [none, off])))

    return column


def _moving(motion: Callable[[Arrays], Tensor]) -> Callable[[_Bench], _Column]:
    """The column of a motion of the vehicle (C, J, 6) in its own frame, by central differences."""

    def column(bench: _Bench) -> _Column:
        engine, estimate = bench.whitening.engine, bench.whitening.estimate
        extrinsic, tangent = estimate.cam_from_vehicle[:, None], motion(bench.arrays) * _STEP
        poses = engine.poses(estimate)
        high, low = (
            engine.residuals(
                extrinsic @ exp(-sign * tangent) @ inverse(extrinsic) @ poses, estimate.corners_map
            )
            for sign in (1.0, -1.0)
        )
        return _Column((high - low) / (2 * _STEP) * bench.root)

    return column


def _clock_motion(problem: Problem, camera: int, visit: int) -> Callable[[Arrays], Tensor]:
    own = (problem.visit_of_frame == visit) | (visit < 0)
    twist = torch.as_tensor(np.asarray(problem.twist_vehicle) * own[:, None])

    def motion(arrays: Arrays) -> Tensor:
        out = arrays.centre.new_zeros(arrays.camera_count, arrays.frame_count, 6)
        out[slice(None) if camera < 0 else camera] = twist.to(out.device)
        return out

    return motion


def _slope_motion(axis: int) -> Callable[[Arrays], Tensor]:
    """Ground that rises along an axis of the map, under poses that do not know of it."""

    def motion(arrays: Arrays) -> Tensor:
        turn = arrays.centre.new_tensor([0.0, -1.0, 0.0] if axis == 0 else [1.0, 0.0, 0.0])
        out = arrays.centre.new_zeros(arrays.camera_count, arrays.frame_count, 6)
        out[..., 3:] = arrays.vehicle_from_map[:, :3, :3] @ turn
        return out

    return motion


def _survey(camera: int, axis: int) -> Callable[[_Bench], _Column]:
    def column(bench: _Bench) -> _Column:
        out, which = torch.zeros_like(bench.arrays.centre), slice(None) if camera < 0 else camera
        out[which, axis] = -bench.arrays.centre_information_root[which, axis]
        return _Column(centre=out)

    return column


def _datum(axis: int) -> Callable[[_Bench], _Column]:
    def column(bench: _Bench) -> _Column:
        out = torch.zeros_like(bench.arrays.control)
        out[:, axis] = -bench.arrays.control_information[:, axis].sqrt()
        return _Column(control=out)

    return column


def _size(which: Tensor) -> Callable[[_Bench], _Column]:
    return lambda bench: _Column(length=-bench.arrays.lengths.information_root * which)
