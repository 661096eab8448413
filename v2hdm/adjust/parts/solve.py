"""The head: it sums what the parts hand on, whitens and moves the shared unknowns, and reports."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.checks import check_model, check_options, check_problem
from v2hdm.adjust.descent import RENEWAL, RENEWAL_WITH_STATES, Descent, go_down, total
from v2hdm.adjust.layout import make_arrays, nearby_origin, shifted
from v2hdm.adjust.parts.condense import Base, HandedOn
from v2hdm.adjust.parts.shared import Shared, SharedPriors
from v2hdm.adjust.parts.split import Part, split
from v2hdm.adjust.parts.team import Team
from v2hdm.adjust.parts.worker import Step
from v2hdm.adjust.problem import Problem, SolveOptions
from v2hdm.adjust.reduced import make_plan
from v2hdm.adjust.residuals import Estimate, Loss
from v2hdm.adjust.robust import annealed_scale
from v2hdm.adjust.solution import Solution
from v2hdm.adjust.solve import report, start_at
from v2hdm.adjust.whitening import JITTER_STEPS, SINGULAR_PIVOT
from v2hdm.errors import AdjustError


def solve_in_parts(problem: Problem, options: SolveOptions, team: Team) -> Solution:
    """Adjust a problem of several visits, each visit by a worker of its own; as :func:`v2hdm.adjust.solve`.

    It starts where ``solve`` does without a coarse stage: near the optimum, as after association.

    Args:
        problem: what was seen on all visits.
        options: how to solve, by ``lbfgs`` and on the CPU.
        team: the workers.

    Raises:
        AdjustError: the problem is malformed, or of a kind that cannot be parted.
    """
    began = time.perf_counter()
    check_options(options)
    check_problem(problem)
    check_model(problem, options)
    if problem.camera_prior is not None or options.solver != "lbfgs" or options.device != "cpu":
        raise AdjustError("a problem in parts is solved by lbfgs on the CPU, without a camera_prior")
    origin_map = nearby_origin(problem)
    near = shifted(problem, -origin_map)
    arrays = make_arrays(near, tuple(options.pose_states), "cpu", options.clock_offset)
    start = start_at(near, arrays, torch.as_tensor(problem.cam_from_vehicle, dtype=torch.float64))
    parts, shared = split(near, tuple(options.pose_states), options.clock_offset)
    system = _InParts(team, parts, SharedPriors(near, shared), torch.as_tensor(shared))
    descent = _descend(system, arrays, start, options)
    return report(problem, origin_map, options, descent, 0, began)


def _descend(system: _InParts, arrays: Arrays, start: Estimate, options: SolveOptions) -> Descent:
    robust = Loss(options.loss, options.loss_scale)
    place = system.place(start, arrays)
    scale = robust.scale if robust.name == "none" else system.annealed(place, robust.scale)
    opening = [system.factorise(place, Loss(robust.name, scale), 0.0)]
    limits = (options.gap_tolerance, options.max_refreshes, options.max_evaluations)
    end = go_down(system, opening, robust, "lbfgs", *limits)
    estimate = system.whole(end.point.estimate, start, arrays)
    how = (end.gap, end.evaluations, end.progressing, end.is_singular)
    return Descent(arrays, make_plan(arrays), estimate, end.robust, end.point.terms, *how, None)


class Place(NamedTuple):
    """The shared unknowns at a point, and each part's base there, as the team knows it."""

    shared: Shared
    bases: list[Any]


class Reached(NamedTuple):
    """Whitened variables, what they stand for, and the cost there by name."""

    whitened: Tensor
    estimate: Place
    terms: dict[str, Tensor]


@dataclass(frozen=True)
class Joined:
    """The problem whitened at a place: S of all parts factorised.

    ``gradient`` is that by the whitened variables: those of each part, then the shared ones. ``bounds`` are
    where those of each begin.
    """

    place: Place
    robust: Loss
    factor: Tensor
    terms: dict[str, Tensor]
    gradient: Tensor
    bounds: list[int]
    is_singular: bool


class _InParts:
    """A :class:`~v2hdm.adjust.descent.System` whose parts are with a team."""

    def __init__(self, team: Team, parts: Sequence[Part], priors: SharedPriors, corners: Tensor) -> None:
        """``corners`` (M,) are the shared ones."""
        self.team, self.priors = team, priors
        self._parts, self._corners = parts, corners
        self._order = team.start(parts)
        cameras = torch.arange(6 * len(parts[0].problem.intrinsic))
        self.rows = []
        for part, (_, common) in zip(parts, self._order, strict=True):
            first = len(cameras) + 2 * torch.as_tensor(part.shared)[common]
            self.rows.append(torch.cat([cameras, torch.stack([first, first + 1], dim=1).flatten()]))
        self._number = 0

    @property
    def renewal(self) -> float:
        """Evaluations that a whitening takes as long as."""
        return RENEWAL_WITH_STATES if self._parts[0].pose_states else RENEWAL

    def numbers(self) -> list[int]:
        """A number of each part for a base that there has not been."""
        self._number += 1
        return len(self._parts) * [self._number]

    def factorise(self, estimate: Place, robust: Loss, damping: float) -> Joined:
        """S of all parts, summed up and factorised; L-BFGS needs no ``damping``."""
        said: list[HandedOn] = self.team.ask("hand_on", estimate.bases, self._of_each(robust))
        information = self.priors.information(estimate.shared)
        known = information.diagonal().clone()
        for rows, one in zip(self.rows, said, strict=True):
            information[rows[:, None], rows] += one.information
            known[rows] += one.known
        factor, jitter = _factor(information, known)
        pivot = float((factor.diagonal().square() / known).min())
        terms, gradient = self._summed(said, *self.priors.cost_and_gradient(estimate.shared))
        whitened = torch.cat([*(one.own for one in said), _solved(factor, gradient)])
        bounds = list(accumulate((len(one.own) for one in said), initial=0))
        singular = jitter > 0 or pivot < SINGULAR_PIVOT
        return Joined(estimate, robust, factor, terms, whitened, bounds, singular)

    def annealed(self, estimate: Place, scale: float) -> float:
        """The loss's scale by the median of all parts' residuals, exactly; few of them travel."""
        cut = self.team.ask("quantiles", estimate.bases)
        wanted = (sum(count for count, _ in cut) - 1) // 2
        marks = torch.cat([values for _, values in cut]).sort().values
        low, high = _bracket(cut, marks, wanted)
        found = self.team.ask("between", estimate.bases, self._of_each(low), self._of_each(high))
        inside = torch.cat([values for _, values in found]).sort().values
        median = inside[wanted - sum(count for count, _ in found)]
        return annealed_scale(median[None], scale)

    def objective(self, linearised: Joined) -> _Objective:
        """Cost and gradient around where it was whitened."""
        return _Objective(self, linearised)

    def place(self, start: Estimate, arrays: Arrays) -> Place:
        """An estimate of ``arrays``, the whole problem, as bases of the parts."""
        corners = torch.empty_like(start.corners_map)
        corners[arrays.corner_order] = start.corners_map
        bases = []
        for part, (own, common), number in zip(self._parts, self._order, self.numbers(), strict=True):
            its = corners[torch.as_tensor(part.corners)]
            clock = start.clock_s[:, part.visit : part.visit + 1]
            estimate = Estimate(start.cam_from_vehicle, start.frame_state[part.frames], its[own], clock)
            bases.append(Base(number, estimate, its[common]))
        return Place(Shared(start.cam_from_vehicle, corners[self._corners]), self.team.keep(bases))

    def whole(self, place: Place, start: Estimate, arrays: Arrays) -> Estimate:
        """The estimate of ``arrays`` at a place; what no part has stays as in ``start``."""
        corners = torch.empty_like(start.corners_map)
        corners[arrays.corner_order] = start.corners_map
        states, clock = start.frame_state.clone(), start.clock_s.clone()
        bases = self.team.fetch(place.bases)
        for part, (own, _), base in zip(self._parts, self._order, bases, strict=True):
            corners[torch.as_tensor(part.corners)[own]] = base.estimate.corners_map
            states[part.frames] = base.estimate.frame_state
            clock[:, part.visit : part.visit + 1] = base.estimate.clock_s
        corners[self._corners] = place.shared.corners_map
        return Estimate(place.shared.cam_from_vehicle, states, corners[arrays.corner_order], clock)

    def _summed(
        self, said: Sequence[HandedOn], terms: dict[str, Tensor], gradient: Tensor
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Cost by name and gradient of all parts, and those of the priors."""
        for rows, one in zip(self.rows, said, strict=True):
            gradient[rows] += one.gradient
            terms = {name: value + one.cost[name] for name, value in terms.items()}
        return terms, gradient

    def step_from(
        self, joined: Joined, whitened: Tensor, numbers: Sequence[int]
    ) -> tuple[Tensor, list[Step]]:
        """What whitened variables move the shared unknowns by (6 C + 2 M,), and what each part is told."""
        shared = torch.linalg.solve_triangular(
            joined.factor.mT, whitened[joined.bounds[-1] :, None], upper=True
        )[:, 0]
        steps = [
            Step(number, shared[rows], whitened[begin:end])
            for number, rows, (begin, end) in zip(numbers, self.rows, pairwise(joined.bounds), strict=True)
        ]
        return shared, steps

    def evaluate(self, joined: Joined, shared: Tensor, steps: list[Step]) -> tuple[dict[str, Tensor], Tensor]:
        """Cost by name and gradient by the whitened variables, a step away from where it was whitened."""
        said: list[HandedOn] = self.team.ask(
            "evaluate", joined.place.bases, self._of_each(joined.robust), steps
        )
        known = self.priors.cost_and_gradient(joined.place.shared.moved(shared), shared)
        terms, gradient = self._summed(said, *known)
        return terms, torch.cat([*(one.own for one in said), _solved(joined.factor, gradient)])

    def move(self, joined: Joined, shared: Tensor, steps: list[Step]) -> Place:
        """The place that a step leads to."""
        bases = self.team.move(joined.place.bases, self._of_each(joined.robust), steps)
        return Place(joined.place.shared.moved(shared), bases)

    def _of_each(self, value: Any) -> list[Any]:
        return len(self._parts) * [value]


class _Objective:
    """Cost and gradient by whitened variables; see :class:`~v2hdm.adjust.descent.Objective`."""

    def __init__(self, system: _InParts, joined: Joined) -> None:
        self._system, self._joined = system, joined
        self._last: tuple[Tensor, Tensor, list[Step], dict[str, Tensor]] | None = None
        self.evaluations = 0

    def at_base(self) -> tuple[Tensor, Tensor]:
        """Cost and gradient at 0."""
        self.evaluations += 1
        return total(self._joined.terms), self._joined.gradient

    def __call__(self, whitened: Tensor) -> tuple[Tensor, Tensor]:
        """Cost and gradient at whitened variables."""
        self.evaluations += 1
        shared, steps = self._system.step_from(self._joined, whitened, self._system.numbers())
        terms, gradient = self._system.evaluate(self._joined, shared, steps)
        self._last = whitened.clone(), shared, steps, terms
        return total(terms), gradient

    def point(self, whitened: Tensor) -> Reached:
        """What whitened variables stand for; known where they were evaluated last."""
        if not bool(whitened.any()):
            return Reached(whitened, self._joined.place, self._joined.terms)
        if self._last is None or not torch.equal(self._last[0], whitened):
            self(whitened)
        assert self._last is not None
        _, shared, steps, terms = self._last
        return Reached(whitened, self._system.move(self._joined, shared, steps), terms)


def _factor(information: Tensor, known: Tensor) -> tuple[Tensor, float]:
    """The lower factor of S, and what had to be added to its diagonal, relative to ``known``."""
    for jitter in JITTER_STEPS:
        if jitter:
            information.diagonal().add_(known, alpha=jitter)
        factor, failed = torch.linalg.cholesky_ex(information)
        if not int(failed):
            return factor, jitter
    raise AdjustError(
        "the shared unknowns cannot be solved for even when damped: look for observations or priors whose "
        "sigmas differ by many orders of magnitude"
    )


def _solved(factor: Tensor, gradient: Tensor) -> Tensor:
    solved: Tensor = torch.linalg.solve_triangular(factor, gradient[:, None], upper=False)
    return solved[:, 0]


def _bracket(cut: Sequence[tuple[int, Tensor]], marks: Tensor, wanted: int) -> tuple[float, float]:
    """Two of the ``marks`` between which the residual of rank ``wanted`` lies."""
    least, most = torch.zeros_like(marks), torch.zeros_like(marks)
    for count, values in cut:
        places = torch.linspace(0, count - 1, len(values), dtype=torch.float64).round()
        at = torch.searchsorted(values, marks, right=True)
        # Of its residuals at least so many are up to the mark, and at most so many.
        least += torch.where(at > 0, places[(at - 1).clamp(min=0)] + 1, 0)
        most += torch.where(at < len(values), places[at.clamp(max=len(values) - 1)], count)
    low = int((most <= wanted).sum()) - 1
    high = int((least <= wanted).sum())
    return float(marks[max(low, 0)]), float(marks[min(high, len(marks) - 1)])
