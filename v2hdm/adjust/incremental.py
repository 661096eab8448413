r"""The map while the vehicle drives: one marking at a time, at a cost independent of the map's size.

Given the cameras (extrinsics and clock offsets) the markings are independent, so that all information of the
mapped ones on the cameras is one quadratic in their tangents :math:`\xi`,
``cam_from_vehicle = exp(xi) @ base``. A new marking is solved for by :func:`v2hdm.adjust.solve` with that
quadratic as the prior on the cameras; the solve's marginal information on the cameras, less the prior, is
added to the quadratic. Every corner stays an affine function of :math:`\xi`, read on demand.

Whenever the number of markings has doubled, all are solved together: a constant factor in cost per marking,
and the batch optimum. In between, a frame's pose error is marginalised out marking by marking, so that later
markings do not share it with earlier ones.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust.checks import check_observations
from v2hdm.adjust.covariance import corner_gain
from v2hdm.adjust.descent import narrowed
from v2hdm.adjust.engines import make_engine
from v2hdm.adjust.kernels.tables import move
from v2hdm.adjust.layout import make_arrays
from v2hdm.adjust.model import Estimate, Loss
from v2hdm.adjust.problem import ControlPoints, KnownLengths, Observations, Problem, SolveOptions
from v2hdm.adjust.solution import Solution, Status
from v2hdm.adjust.solve import solve
from v2hdm.adjust.whitening import Whitening, factorise
from v2hdm.errors import AdjustError
from v2hdm.records import FloatArray, IntArray

_GAP_TOLERANCE = 1e-9  # gap of a marking's solve: at a cost of a few hundred, within a thousandth of a sigma
_LEAST_LEFT = 1e-12  # fraction of an unknown's information, correlations included, below which it is rounding


class UndeterminedError(AdjustError):
    """The markings so far leave a direction of the extrinsics undetermined."""


@dataclass(frozen=True)
class Sighted:
    """All data on one marking, its corners numbered from 0; lengths and control None if unknown."""

    observations: Observations
    lengths: KnownLengths | None = None
    control: ControlPoints | None = None

    @property
    def corner_count(self) -> int:
        """Number of corners up to the last one observed."""
        return int(self.observations.corner.max()) + 1

    def joined(self, later: Sighted) -> Sighted:
        """With later observations of the same corners; later control and lengths replace earlier ones."""
        return Sighted(
            _stacked([self.observations, later.observations]),
            later.lengths or self.lengths,
            later.control or self.control,
        )


@dataclass(frozen=True)
class _Contribution:
    """One marking's contribution to a :class:`_Quadratic`, in the unknowns ``rows`` of its cameras."""

    rows: IntArray
    information: FloatArray
    vector: FloatArray


@dataclass(frozen=True)
class _Settled:
    """Corners (n, 2) at the unknowns ``at`` (D,) of all cameras; ``gain`` (n, 2, D) is their derivative.

    ``contribution`` is theirs to the quadratic, None if others were solved together with it.
    """

    at: FloatArray
    corners_map: FloatArray
    gain: FloatArray
    contribution: _Contribution | None


@dataclass(frozen=True)
class _Quadratic:
    """Half xi' ``information`` xi minus ``vector`` xi, around ``base``; minimal at ``mean`` (D,)."""

    cameras: IntArray
    base: FloatArray
    information: FloatArray
    vector: FloatArray

    @cached_property
    def mean(self) -> FloatArray:
        return np.asarray(np.linalg.solve(self.information, self.vector))

    def rows(self, cameras: IntArray) -> IntArray:
        """Indices of the unknowns of some cameras."""
        unknown_count = len(self.vector) // len(self.cameras)
        first = np.searchsorted(self.cameras, cameras) * unknown_count
        return np.asarray((first[:, None] + np.arange(unknown_count)).ravel())

    def plus(self, contribution: _Contribution, sign: float) -> _Quadratic:
        """With a marking's contribution added, or subtracted with ``sign`` -1."""
        added = self.information.copy()
        moved = self.vector.copy()
        added[contribution.rows[:, None], contribution.rows] += sign * contribution.information
        moved[contribution.rows] += sign * contribution.vector
        return replace(self, information=added, vector=moved)


class _Linearised(NamedTuple):
    """The map's quadratic with one more marking."""

    joint: _Quadratic
    contribution: _Contribution  # the marking's
    settled: _Settled  # its corners


@dataclass(frozen=True)
class _Sum:
    """A quadratic and a marking's information on the unknowns ``rows``; its vector depends on where it is."""

    earlier: _Quadratic
    rows: IntArray
    chart: FloatArray  # that of :func:`_moved`
    information: FloatArray  # the marking's, by the unknowns
    joint: FloatArray  # the sum's

    @classmethod
    def of(cls, earlier: _Quadratic, rows: IntArray, held: FloatArray, chart: FloatArray) -> _Sum:
        """The sum with information ``held`` by the cameras' tangents."""
        information = chart.T @ held @ chart
        joint = earlier.information.copy()
        joint[rows[:, None], rows] += information
        return cls(earlier, rows, chart, information, joint)

    def minimised(self, at: FloatArray, by: Tensor, size: int) -> _Joined:
        """Its minimum, from the marking's whitened gradient ``by`` at the unknowns ``at``.

        The first ``size`` of the whitened variables are the reduced ones, whose last are the cameras.
        """
        rows = self.rows
        step = -by
        cameras = step[size - len(rows) : size]
        vector = self.information @ at[rows] + self.chart.T @ cameras.cpu().numpy()
        contribution = _Contribution(rows, self.information, vector)
        moved = self.earlier.vector.copy()
        moved[rows] += vector
        quadratic = _Quadratic(self.earlier.cameras, self.earlier.base, self.joint, moved)
        change = quadratic.mean - at
        cameras.zero_()
        gained = float(step @ step) + float(change @ self.joint @ change)
        cameras.copy_(torch.from_numpy(self.chart @ change[rows]))
        return _Joined(contribution, quadratic, step, gained)


class _Joined(NamedTuple):
    """A marking joined to a quadratic, and the step to the minimum of the sum."""

    contribution: _Contribution  # the marking's
    joint: _Quadratic
    whitened_step: Tensor
    gained: float  # twice the decrease of the cost by that step


class _Moved(NamedTuple):
    """Cameras at given unknowns: six of its pose and Q of its clock for each camera."""

    cam_from_vehicle: Tensor  # (C, 4, 4)
    clock_s: Tensor  # (C, Q)
    chart: FloatArray  # (C (6 + Q), C (6 + Q)) left tangents and clock offsets by the unknowns


class IncrementalMap:
    """Extrinsics and corners, up to date after every marking."""

    def __init__(self, drive: Problem, options: SolveOptions | None = None) -> None:
        """An empty map for the cameras, frames and priors of the problem ``drive``."""
        self._drive = drive
        self._options = options or SolveOptions()
        self._sighted: dict[int, Sighted] = {}
        self._settled: dict[int, _Settled] = {}
        self._earlier: _Quadratic | None = None
        self._adjusted_count = 0

    @property
    def markings(self) -> Mapping[int, Sighted]:
        """The markings by number, in order of arrival."""
        return self._sighted

    @property
    def cam_from_vehicle(self) -> FloatArray:
        """Extrinsics (C, 4, 4) from all markings; the start for cameras without any."""
        out = self._drive.cam_from_vehicle.copy()
        if self._earlier is not None:
            out[self._earlier.cameras] = _moved(
                self._earlier.base, self._earlier.mean, "cpu"
            ).cam_from_vehicle.numpy()
        return out

    def is_solved(self, marking: int) -> bool:
        """Whether a marking is part of the map, rather than noted (:meth:`add`) or waiting."""
        return marking in self._settled and self._earlier is not None

    def preview(self, sighted: Sighted) -> FloatArray:
        """Back-projected corners (n, 2), nan above the horizon; AdjustError for a duplicate in an image."""
        problem, _ = self._problem([sighted], cam_from_vehicle=self.cam_from_vehicle)
        arrays = make_arrays(problem, (), "cpu")
        engine = make_engine(self._options.engine, arrays)
        corners, fixed = engine.back_project(torch.from_numpy(problem.cam_from_vehicle))
        out = np.full(corners.shape, np.nan)
        is_fixed = fixed.numpy()
        out[arrays.corner_order.numpy()[is_fixed]] = corners.numpy()[is_fixed]
        return out

    def corners_map(self, marking: int) -> FloatArray:
        """Corners (n, 2) of a marking under the present extrinsics; AdjustError if not solved yet."""
        if not self.is_solved(marking) or self._earlier is None:
            raise AdjustError(f"marking {marking} is not in the map")
        settled = self._settled[marking]
        return np.asarray(settled.corners_map - settled.gain @ (self._earlier.mean - settled.at))

    def add(self, marking: int, sighted: Sighted) -> None:
        """Note a marking, or further observations of it, for the next :meth:`adjust`."""
        before = self._sighted.get(marking)
        self._sighted[marking] = sighted if before is None else before.joined(sighted)

    def observe(self, marking: int, sighted: Sighted) -> None:
        """Add a marking to the map, or re-estimate a mapped one from all its observations.

        A camera's first markings wait until its extrinsic is determined. If unsolvable, raises AdjustError
        and leaves the map unchanged.
        """
        before = self._sighted.get(marking)
        earlier = self._earlier if before is None else self._without(marking, before)
        joined = sighted if before is None else before.joined(sighted)
        self._sighted[marking] = joined
        try:
            due = len(self._sighted) >= 2 * self._adjusted_count
            cameras = set(joined.observations.camera.tolist())
            if earlier is None or due or not cameras.issubset(earlier.cameras.tolist()):
                self.adjust()
            else:
                linearised = self._linearised(earlier, marking, joined)
                self._earlier = linearised.joint
                self._settled[marking] = linearised.settled
        except UndeterminedError:
            # The first few of a camera leave its extrinsic undetermined; they wait for more.
            self._adjusted_count = 0
        except AdjustError:
            del self._sighted[marking]
            if before is not None:
                self._sighted[marking] = before
            raise

    def _without(self, marking: int, sighted: Sighted) -> _Quadratic | None:
        """The quadratic without a marking; None if so little remains that all others must be solved again."""
        if self._earlier is None or marking not in self._settled:
            return self._earlier
        contribution = (
            self._settled[marking].contribution
            or self._linearised(self._earlier, marking, sighted).contribution
        )
        less = self._earlier.plus(contribution, -1.0)
        least = np.linalg.eigvalsh(less.information / _scale(self._earlier.information)).min()
        return less if least > _LEAST_LEFT else None

    def adjust(self) -> Solution:
        """Solve for all markings together; called whenever the map has doubled.

        The solution's corners are those of :attr:`markings`, concatenated. Raises AdjustError if there is
        none, or they are unsolvable.
        """
        if not self._sighted:
            raise AdjustError("there is no marking to adjust")
        every = list(self._sighted.values())
        problem, cameras = self._problem(every, cam_from_vehicle=self.cam_from_vehicle)
        options = replace(self._options, coarse=self._options.coarse and self._earlier is None)
        solution = solve(problem, options)
        bad = solution.status in (Status.BEHIND_CAMERA, Status.UNDETERMINED)
        if bad or not np.isfinite(solution.corners_map).all():
            raise _unsolved("the map", solution.status)
        information = solution.covariance.camera_information()
        at = np.zeros((len(cameras), len(information) // len(cameras)))
        at[:, 6:] = solution.covariance.descent.estimate.clock_s.cpu().numpy()
        self._earlier = _Quadratic(cameras, solution.cam_from_vehicle, information, information @ at.ravel())
        self._adjusted_count = len(every)
        gain = corner_gain(solution.covariance.whitening)
        end = 0
        for marking, sighted in self._sighted.items():
            corners = slice(end, end := end + sighted.corner_count)
            self._settled[marking] = _Settled(at.ravel(), solution.corners_map[corners], gain[corners], None)
        return solution

    def _linearised(self, earlier: _Quadratic, marking: int, sighted: Sighted) -> _Linearised:
        """The quadratic ``earlier`` plus a marking."""
        # The quadratic contains the cameras' priors.
        infinite = {"clock_sigma_s": np.inf, "read_out_sigma_s": np.inf}
        without = {"centre_vehicle": None, "ground": None, **infinite}
        problem, cameras = self._problem([sighted], **without)
        check_observations(problem)
        options = self._options
        rows = earlier.rows(cameras)
        at = earlier.mean
        base = earlier.base[np.searchsorted(earlier.cameras, cameras)]
        estimated = options.clock_offset, options.read_out
        arrays = make_arrays(problem, tuple(options.pose_states), options.device, *estimated)
        engine = make_engine(options.engine, arrays)
        robust = Loss(options.loss, options.loss_scale)
        plan = engine.plan()
        loss = None
        gap = np.inf
        moved = _moved(base, at[rows], options.device)
        corners, fixed = engine.back_project(moved.cam_from_vehicle)
        if not bool(fixed.all()):
            raise AdjustError(f"marking {marking} cannot be solved for: no ray of a corner meets the ground")
        no_state = torch.zeros_like(arrays.state_information_root)
        estimate = Estimate(moved.cam_from_vehicle, no_state, corners, moved.clock_s)
        for _ in range(options.max_refreshes):
            loss = narrowed(engine, estimate, robust, loss)
            held = factorise(engine, plan, estimate, loss, hold_cameras=True)
            assert held.reduced_factor.held is not None
            joining = _Sum.of(earlier, rows, held.reduced_factor.held.cpu().numpy(), moved.chart)
            size = held.reduced_factor.size
            before = joining.minimised(at, held.gradient, size)
            if not _largest_turn_rad(held, before.whitened_step) <= math.pi:  # outside the chart
                raise _unsolved(f"marking {marking}", Status.STALLED)
            done = held.reach(before.whitened_step)
            at = before.joint.mean
            joined = joining.minimised(at, done.gradient, size)
            gap = joined.gained / max(sum(done.terms.values()), 1.0)
            if not gap > _GAP_TOLERANCE and loss.scale <= robust.scale:
                break
            moved = _moved(base, at[rows], options.device)
            estimate = replace(done.estimate, cam_from_vehicle=moved.cam_from_vehicle, clock_s=moved.clock_s)
        behind = engine.report(done.estimate, problem.intrinsic[:, :2])[2].any()
        if behind or not gap <= _GAP_TOLERANCE:
            raise _unsolved(
                f"marking {marking}", Status.BEHIND_CAMERA if behind else Status.EVALUATIONS_EXHAUSTED
            )
        out = np.empty((problem.corner_count, 2))
        out[arrays.corner_order.cpu().numpy()] = done.estimate.corners_map.cpu().numpy()
        gain = np.zeros((len(out), 2, len(at)))
        gain[:, :, rows] = corner_gain(held) @ moved.chart
        settled = _Settled(at, out, gain, joined.contribution)
        return _Linearised(joined.joint, joined.contribution, settled)

    def _problem(self, sighted: Sequence[Sighted], **changes: Any) -> tuple[Problem, IntArray]:
        """Some markings as a problem of their cameras and frames, and the indices of these cameras.

        Cameras are where the drive has them, unless ``changes`` say otherwise.
        """
        starts = np.cumsum([0, *(marking.corner_count for marking in sighted)])
        observations = _stacked([marking.observations for marking in sighted])
        counts = [len(marking.observations.corner) for marking in sighted]
        corner = observations.corner + np.repeat(starts[:-1], counts)
        changes["control"] = _known([marking.control for marking in sighted], starts)
        changes["lengths"] = _known([marking.lengths for marking in sighted], starts)
        part = self._drive.seen_by(replace(observations, corner=corner), **changes)
        return part.problem, part.cameras


def _largest_turn_rad(held: Whitening, whitened: Tensor) -> float:
    """The largest rotation of a camera in a frame by the step of whitened variables."""
    if held.engine.arrays.states:
        turns = held.step(whitened).tangents[..., 3:]
    else:
        turns = held.camera_step(whitened)[:, 3:6]
    # By numpy: torch's norm takes a tenth of the time of a marking.
    return math.sqrt(np.square(turns.numpy(force=True)).sum(axis=-1).max())


def _moved(base: FloatArray, unknowns: FloatArray, device: str) -> _Moved:
    """The cameras at the unknowns (C (6 + Q),) around ``base`` (C, 4, 4)."""
    by_camera = unknowns.reshape(len(base), -1)
    moved, turns = move(np.ascontiguousarray(by_camera[:, :6]), np.ascontiguousarray(base))
    chart = np.eye(len(unknowns))
    unknown_count = by_camera.shape[1]
    for begin, turn in zip(range(0, len(unknowns), unknown_count), turns, strict=True):
        chart[begin : begin + 6, begin : begin + 6] = turn
    clock_s = torch.as_tensor(by_camera[:, 6:], device=device)
    return _Moved(torch.as_tensor(moved, device=device), clock_s, chart)


def _scale(information: FloatArray) -> FloatArray:
    """Products (D, D) of the roots of an information matrix' diagonal, which make entries dimensionless."""
    root = np.sqrt(np.diagonal(information))
    return np.asarray(root[:, None] * root)


def _unsolved(what: str, status: Status) -> AdjustError:
    kind = UndeterminedError if status is Status.UNDETERMINED else AdjustError
    return kind(f"{what} cannot be solved for ({status.value}): {status.advice}")


_Known = TypeVar("_Known", Observations, ControlPoints, KnownLengths)


def _stacked(parts: Sequence[_Known]) -> _Known:
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    stacked: list[Any] = [None if column[0] is None else np.concatenate(column) for column in columns]
    return type(parts[0])(*stacked)


def _known(parts: Sequence[_Known | None], starts: IntArray) -> _Known | None:
    """Control and lengths of several markings, whose corners begin at ``starts`` in the concatenation."""
    shifted = []
    for values, start in zip(parts, starts, strict=False):
        if values is not None:
            corners = {name: value + start for name, value in vars(values).items() if name in _CORNERS}
            shifted.append(replace(values, **corners))
    return _stacked(shifted) if shifted else None


# Fields that number corners.
_CORNERS = ("corner", "first", "second")
