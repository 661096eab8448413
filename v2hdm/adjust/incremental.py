r"""The map while the vehicle drives: one marking at a time, at a cost that does not grow with the map.

Given the cameras (extrinsics and clock offsets) the markings are independent, so all that those in the map
say about the cameras is one quadratic in their tangents :math:`\xi`, ``cam_from_vehicle = exp(xi) @ base``. A
further marking is solved for by :func:`v2hdm.adjust.solve`, with that quadratic as the prior on the cameras;
what the solve's Hessian leaves of the cameras once frames and corners are eliminated, less the prior, is
added to the quadratic. Every corner stays an affine function of :math:`\xi`, read on demand.

Whenever the number of markings has doubled, all are solved anew together: a constant share of the cost of
each, and the batch's own optimum. Until then the errors of a frame's pose are marginalised out marking by
marking, so that markings that came since do not share them with the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch

from v2hdm.adjust.engines import make_engine
from v2hdm.adjust.layout import make_arrays
from v2hdm.adjust.problem import CameraPrior, ControlPoints, KnownLengths, Observations, Problem, SolveOptions
from v2hdm.adjust.solution import Solution, Status
from v2hdm.adjust.solve import solve
from v2hdm.errors import AdjustError
from v2hdm.geometry.rigid import exp, inverse, left_jacobian, log
from v2hdm.records import FloatArray, IntArray

# Of a marking's solve: from a cost of a few hundred it then ends within a hundredth of a sigma.
_GAP_TOLERANCE = 1e-7
# Share of an unknown's information, as correlated as it is, below which a difference is what rounding left.
_LEAST_LEFT = 1e-12


class UndeterminedError(AdjustError):
    """The markings so far leave a direction of the extrinsics free."""


@dataclass(frozen=True)
class Sighted:
    """All that is known of one marking; its corners are numbered from 0.

    ``lengths`` and ``control`` are what a standard and a survey say of them, None if nothing.
    """

    observations: Observations
    lengths: KnownLengths | None = None
    control: ControlPoints | None = None

    @property
    def corner_count(self) -> int:
        """Corners up to the last that was seen."""
        return int(self.observations.corner.max()) + 1

    def joined(self, later: Sighted) -> Sighted:
        """With what was seen of the same corners later; what is known of them is as said last."""
        return Sighted(
            _stacked([self.observations, later.observations]),
            later.lengths or self.lengths,
            later.control or self.control,
        )


@dataclass(frozen=True)
class _Own:
    """One marking's share of a :class:`_Quadratic`, in the unknowns ``rows`` of its cameras."""

    rows: IntArray
    information: FloatArray
    vector: FloatArray


@dataclass(frozen=True)
class _Settled:
    """Corners (n, 2) at the unknowns ``at`` (D,) of all cameras; ``gain`` (n, 2, D) how they follow these.

    ``own`` is what the marking says of the cameras, None where it was solved for together with others.
    """

    at: FloatArray
    corners_map: FloatArray
    gain: FloatArray
    own: _Own | None


@dataclass(frozen=True)
class _Quadratic:
    """Half xi' ``information`` xi less ``vector`` xi, in the unknowns (D,) of ``cameras`` around ``base``.

    Its least value is at ``mean`` (D,).
    """

    cameras: IntArray
    base: FloatArray
    information: FloatArray
    vector: FloatArray

    @property
    def mean(self) -> FloatArray:
        return np.asarray(np.linalg.solve(self.information, self.vector))

    def rows(self, cameras: IntArray) -> IntArray:
        """Where the unknowns of some of the cameras stand."""
        each = len(self.vector) // len(self.cameras)
        place = np.searchsorted(self.cameras, cameras)
        return np.asarray((place[:, None] * each + np.arange(each)).ravel())

    def plus(self, own: _Own, sign: float) -> _Quadratic:
        """With a marking's share added, or with ``sign`` -1 subtracted."""
        added, moved = self.information.copy(), self.vector.copy()
        added[np.ix_(own.rows, own.rows)] += sign * own.information
        moved[own.rows] += sign * own.vector
        return replace(self, information=added, vector=moved)


class IncrementalMap:
    """Extrinsics and corners, up to date after every marking."""

    def __init__(self, drive: Problem, options: SolveOptions | None = None) -> None:
        """Begin with an empty map.

        Args:
            drive: its cameras, frames and priors; its observations and what it knows of corners are not
                looked at.
            options: how to solve; the model is theirs and ``drive``'s.
        """
        self._drive = drive
        self._options = options or SolveOptions()
        self._sighted: dict[int, Sighted] = {}
        self._settled: dict[int, _Settled] = {}
        self._earlier: _Quadratic | None = None
        self._adjusted_count = 0

    @property
    def markings(self) -> Mapping[int, Sighted]:
        """The markings by their number, in the order in which they came."""
        return self._sighted

    @property
    def cam_from_vehicle(self) -> FloatArray:
        """The extrinsics (C, 4, 4) that all markings together say; where to start from, of unseen cameras."""
        out = self._drive.cam_from_vehicle.copy()
        if self._earlier is not None:
            tangents = self._earlier.mean.reshape(len(self._earlier.cameras), -1)[:, :6]
            out[self._earlier.cameras] = exp(tangents) @ self._earlier.base
        return out

    def is_solved(self, marking: int) -> bool:
        """Whether a marking is part of the map, and not but noted (:meth:`add`) or waiting."""
        return marking in self._settled and self._earlier is not None

    def preview(self, sighted: Sighted) -> FloatArray:
        """Where the corners (n, 2) lie by back-projection under the present extrinsics, nan if nowhere.

        Raises:
            AdjustError: it has two sightings of a corner in one image.
        """
        problem, _ = self._problem([sighted])
        arrays = make_arrays(problem, (), "cpu")
        engine = make_engine(self._options.engine, arrays)
        corners, fixed = engine.back_project(torch.from_numpy(problem.cam_from_vehicle))
        out = np.full(corners.shape, np.nan)
        known = fixed.numpy()
        out[arrays.corner_order.numpy()[known]] = corners.numpy()[known]
        return out

    def corners_map(self, marking: int) -> FloatArray:
        """Corners (n, 2) of a marking under the present extrinsics.

        Raises:
            AdjustError: it is not in the map, or waits for others or for :meth:`adjust`.
        """
        if not self.is_solved(marking) or self._earlier is None:
            raise AdjustError(f"marking {marking} is not in the map")
        settled = self._settled[marking]
        return np.asarray(settled.corners_map - settled.gain @ (self._earlier.mean - settled.at))

    def add(self, marking: int, sighted: Sighted) -> None:
        """Take note of a marking, or more of it, without solving; :meth:`adjust` does."""
        before = self._sighted.get(marking)
        self._sighted[marking] = sighted if before is None else before.joined(sighted)

    def observe(self, marking: int, sighted: Sighted) -> None:
        """Take a marking into the map; one that is in it already is re-estimated from all its sightings.

        The first ones of a camera wait until there are enough to fix its extrinsic.

        Raises:
            AdjustError: it cannot be solved for; the map is as it was.
        """
        before = self._sighted.get(marking)
        earlier = self._earlier if before is None else self._without(marking, before)
        joined = sighted if before is None else before.joined(sighted)
        self._sighted[marking] = joined
        try:
            due = len(self._sighted) >= 2 * self._adjusted_count
            if earlier is None or due or not np.isin(joined.observations.camera, earlier.cameras).all():
                self.adjust()
            else:
                own, settled = self._linearised(earlier, marking, joined)
                self._earlier = earlier.plus(own, 1.0)
                self._settled[marking] = settled
        except UndeterminedError:
            # The first few of a camera leave its extrinsic free; they wait for those that come.
            self._adjusted_count = 0
        except AdjustError:
            del self._sighted[marking]
            if before is not None:
                self._sighted[marking] = before
            raise

    def _without(self, marking: int, sighted: Sighted) -> _Quadratic | None:
        """The quadratic without a marking; None where that takes a solve of all others.

        So it does where little is left, for what a marking shared with others is then much of it.
        """
        if self._earlier is None or marking not in self._settled:
            return self._earlier
        own = self._settled[marking].own or self._linearised(self._earlier, marking, sighted)[0]
        less = self._earlier.plus(own, -1.0)
        least = np.linalg.eigvalsh(less.information / _scale(self._earlier.information)).min()
        return less if least > _LEAST_LEFT else None

    def adjust(self) -> Solution:
        """Solve for all markings together; happens by itself whenever the map has doubled.

        The solution's corners are those of :attr:`markings`, one after the other.

        Raises:
            AdjustError: there is no marking, or they cannot be solved for.
        """
        if not self._sighted:
            raise AdjustError("there is no marking to adjust")
        every = list(self._sighted.values())
        problem, cameras = self._problem(every)
        options = replace(self._options, coarse=self._options.coarse and self._earlier is None)
        solution = _sound(solve(problem, options), "the map")
        information = solution.covariance.camera_information()
        at = np.zeros((len(cameras), len(information) // len(cameras)))
        at[:, 6:] = solution.covariance.descent.estimate.clock_s.cpu().numpy()
        self._earlier = _Quadratic(cameras, solution.cam_from_vehicle, information, information @ at.ravel())
        self._adjusted_count = len(every)
        gain, end = solution.covariance.gain(), 0
        for marking, sighted in self._sighted.items():
            own = slice(end, end := end + sighted.corner_count)
            self._settled[marking] = _Settled(at.ravel(), solution.corners_map[own], gain[own], None)
        return solution

    def _linearised(self, earlier: _Quadratic, marking: int, sighted: Sighted) -> tuple[_Own, _Settled]:
        """A marking, and what it says of the cameras, where ``earlier`` and it agree."""
        problem, cameras = self._problem([sighted])
        rows, mean = earlier.rows(cameras), earlier.mean
        marginal = np.linalg.inv(np.linalg.inv(earlier.information)[np.ix_(rows, rows)])
        marginal = (marginal + marginal.T) / 2
        base = earlier.base[np.searchsorted(earlier.cameras, cameras)]
        problem = replace(
            problem,
            centre_vehicle=None,
            centre_sigma_m=None,
            clock_sigma_s=np.inf,
            read_out_sigma_s=np.inf,
            camera_prior=CameraPrior(base, mean[rows].reshape(len(cameras), -1), marginal),
        )
        options = replace(
            self._options, coarse=False, gap_tolerance=max(_GAP_TOLERANCE, self._options.gap_tolerance)
        )
        solution = _sound(solve(problem, options), f"marking {marking}")
        tangents = log(solution.cam_from_vehicle @ inverse(base))
        at = mean[rows].reshape(len(cameras), -1)
        chart = np.zeros((len(rows), len(rows)))
        for c, turn in enumerate(left_jacobian(tangents)):
            part = slice(c * at.shape[1], (c + 1) * at.shape[1])
            chart[part, part] = np.eye(at.shape[1])
            chart[part, part][:6, :6] = turn
        clock_s = solution.covariance.descent.estimate.clock_s.cpu().numpy()
        reached = np.column_stack([tangents, clock_s]).ravel()
        information = chart.T @ solution.covariance.camera_information() @ chart - marginal
        vector = information @ reached + marginal @ (reached - mean[rows])
        everywhere = mean.copy()
        everywhere[rows] = reached
        gain = np.zeros((len(solution.corners_map), 2, len(mean)))
        gain[:, :, rows] = solution.covariance.gain() @ chart
        own = _Own(rows, information, vector)
        return own, _Settled(everywhere, solution.corners_map, gain, own)

    def _problem(self, sighted: Sequence[Sighted]) -> tuple[Problem, IntArray]:
        """Some markings as a problem of the cameras and frames that saw them, and which these cameras are."""
        starts = np.cumsum([0, *(one.corner_count for one in sighted)])
        seen = _stacked([one.observations for one in sighted])
        corner = seen.corner + np.repeat(starts[:-1], [len(one.observations.corner) for one in sighted])
        drive = replace(self._drive, cam_from_vehicle=self.cam_from_vehicle)
        problem, cameras, _ = drive.seen_by(replace(seen, corner=corner))
        control = _known([one.control for one in sighted], starts)
        lengths = _known([one.lengths for one in sighted], starts)
        return replace(problem, control=control, lengths=lengths), cameras


def _scale(information: FloatArray) -> FloatArray:
    """Products (D, D) of the roots of an information's diagonal: entries by it have no unit."""
    root = np.sqrt(np.diagonal(information))
    return np.asarray(root[:, None] * root)


def _sound(solution: Solution, what: str) -> Solution:
    """A solution that determines ``what``."""
    said = f"{what} cannot be solved for ({solution.status.value}): {solution.status.advice}"
    if solution.status is Status.UNDETERMINED:
        raise UndeterminedError(said)
    if solution.status is Status.BEHIND_CAMERA or not np.isfinite(solution.corners_map).all():
        raise AdjustError(said)
    return solution


_Known = TypeVar("_Known", Observations, ControlPoints, KnownLengths)


def _stacked(parts: Sequence[_Known]) -> _Known:
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    stacked: list[Any] = [None if one[0] is None else np.concatenate(one) for one in columns]
    return type(parts[0])(*stacked)


def _known(parts: Sequence[_Known | None], starts: IntArray) -> _Known | None:
    """Prior knowledge of several markings' corners, which begin at ``starts`` among those of all."""
    shifted = []
    for one, start in zip(parts, starts, strict=False):
        if one is not None:
            corners = {name: value + start for name, value in vars(one).items() if name in _CORNERS}
            shifted.append(replace(one, **corners))
    return _stacked(shifted) if shifted else None


# Fields that number corners.
_CORNERS = ("corner", "first", "second")
