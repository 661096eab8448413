"""``join_parts``: a problem too large for one solve, part by part, to the same optimum and covariances.

Parts that fit in memory together are solved at once, in a third of the time; others, roughly, by themselves.
Then rounds follow: every part summarises what it says of its border (:mod:`v2hdm.adjust.sections.summary`),
the summaries are joined (:mod:`v2hdm.adjust.sections.join`), and each part follows the border
(:mod:`v2hdm.adjust.sections.rounds`). This is a
Gauss-Newton descent of the whole in which no process holds more than one part; parts are jobs of an executor,
and their estimates lie in files between rounds. So do their whitenings, which cost ten rounds: they are made
at the start, after long steps, and at the end, for the covariances. After a solve at once one round states
these.
``fit_parts`` does the same roughly and without covariances, for what tells outliers and noise.
``finish_parts`` makes of each part what needs covariances.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from v2hdm.adjust.covariance import Covariance
from v2hdm.adjust.model import Estimate, rigid
from v2hdm.adjust.problem import Problem
from v2hdm.adjust.sections.blocks import BlockCholesky
from v2hdm.adjust.sections.join import Joined, Labels, Net, Shared
from v2hdm.adjust.sections.parts import Link, Part, whole_of
from v2hdm.adjust.sections.rounds import (
    GAP,
    Finish,
    Job,
    PartStates,
    Shape,
    Work,
    covariance_file,
    load_part,
    load_told,
)
from v2hdm.adjust.sections.summary import Summary, Values
from v2hdm.adjust.solution import Solution
from v2hdm.adjust.solve import solve
from v2hdm.errors import AdjustError, WorkerError
from v2hdm.executor import HERE, Executor
from v2hdm.executor.memory import TidyWork
from v2hdm.records import FloatArray

ROUGH_GAP = 1e-6  # as GAP, where only residuals are asked for: a thousandth of a sigma in most of them

AT_ONCE = 400_000
"""Most observations that are solved at once: they take 2.8 kB each, factors included, of 2 km of yards."""

_FAR_GAP = 1e-3  # gap of a round, a fraction of the cost, above which the next whitens anew: chosen
_SLOW = 0.6  # gap of a round, a fraction of that before, above which the next whitens anew: chosen
_SETTLED_SHARE = 0.1  # gap of a part with its border held, as a fraction of that of all: chosen
_MOST_ROUNDS = 15  # rounds of joining and following, after which the solve has not converged; chosen
_CONTRADICTION = 9.0
"""Chi-square per shared coordinate from which parts contradict each other: 1 is usual, this is 3 sigmas."""


class Joint(NamedTuple):
    """The end of the rounds: what was made of each part; the covariances of borders lie in files."""

    results: list[Any]
    net: Net
    factor: BlockCholesky
    gap: float
    rounds: int

    def steps(self, slopes: Sequence[FloatArray]) -> list[FloatArray]:
        """Steps (b, n) of each part's border under n errors, of which each part tells ``slopes`` (b, n)."""
        return self.net.steps(self.factor, slopes)


class Fitted(NamedTuple):
    """The results of the parts under a rough solve; the problem and solution of all if solved at once."""

    results: list[Any]
    problem: Problem | None
    solution: Solution | None


def join_parts(
    folder: Path,
    count: int,
    links: Sequence[Link],
    shape: Shape,
    finish: Finish,
    executor: Executor = HERE,
    progress: Callable[[int, int], None] | None = None,
    at_once: int = AT_ONCE,
    are_near: bool = False,
) -> Joint:
    """Solve the ``count`` parts in ``folder`` together, and ``finish`` each without covariances.

    Those of their borders are left in files for :func:`finish_parts`, and the parts' whitenings, of some
    150 MB for a kilometre. ``progress`` is called with the number of the round and the most that there may
    be; up to ``at_once`` observations are solved at once. Parts that ``are_near`` start near the joint
    optimum, by what :func:`fit_parts` has told: else each looks for its own first. Raises AdjustError where
    parts leave a direction free or contradict each other, WorkerError where a process died.
    """
    whole = _solved_at_once(folder, count, shape, at_once)
    jobs = [Job(number, is_near=are_near) for number in range(count)]
    if whole is not None:
        jobs = [Job(number, start) for number, start in enumerate(whole.starts)]
    joint = _in_rounds(folder, jobs, links, shape, finish, executor, progress, GAP)
    for part, covariance in enumerate(joint.net.covariances(joint.factor)):
        np.save(covariance_file(folder, part), covariance)
    return joint


def fit_parts(
    folder: Path,
    count: int,
    links: Sequence[Link],
    shape: Shape,
    finish: Finish,
    executor: Executor = HERE,
    progress: Callable[[int, int], None] | None = None,
    at_once: int = AT_ONCE,
    are_near: bool = False,
) -> Fitted:
    """``finish`` each part under a rough solve of all; otherwise as :func:`join_parts`.

    Parts that ``are_near`` start near their own optimum.
    """
    whole = _solved_at_once(folder, count, shape, at_once)
    if whole is None:
        from_afar = [Job(number, is_near=are_near) for number in range(count)]
        joint = _in_rounds(
            folder, from_afar, links, shape, finish, executor, progress, ROUGH_GAP, is_rough=True
        )
        return Fitted(joint.results, None, None)
    jobs = [Job(number, start, is_last=True) for number, start in enumerate(whole.starts)]
    results = _side_by_side(executor, Work(folder, shape, finish), jobs)
    return Fitted(results, whole.problem, whole.solution)


def _in_rounds(
    folder: Path,
    jobs: Sequence[Job],
    links: Sequence[Link],
    shape: Shape,
    finish: Finish,
    executor: Executor,
    progress: Callable[[int, int], None] | None,
    least_gap: float,
    is_rough: bool = False,
) -> Joint:
    """The rounds of parts, the first by ``jobs``, until the gap is small.

    They end where all are whitened, unless the solve ``is_rough``.
    """
    report = progress or (lambda done, total: None)
    work = Work(folder, shape)
    are_joined = jobs[0].start is not None
    is_from_afar = not are_joined and not jobs[0].is_near
    before = np.inf
    joined: Joined | None = None
    for number in range(_MOST_ROUNDS):
        report(number, _MOST_ROUNDS)
        states: list[PartStates] = _side_by_side(executor, work, jobs)
        costs = [_cost(state.told) for state in states]
        if number == 0:
            net = _net_of(states, links, shape)
            least = [state.told.least_cost for state in states]
        elif number == 1 and (is_rough or is_from_afar):
            _check_agreement(net, states, least, costs, folder)
        shared = _shared(net, states)
        joined = None  # the factor of the round before is as large as the one that is made now
        joined = net.join(_all_told(folder, states, shared, net), shared)
        gap = (joined.decrease + sum(state.told.slack for state in states)) / max(sum(costs), 1.0)
        is_slow = gap > _SLOW * before
        before = gap
        is_small = (number > 0 or are_joined) and gap <= least_gap
        if is_small and (is_rough or jobs[0].is_renewed):
            break
        moved = _moved(net, shared, joined)
        jobs = [
            Job(
                part,
                target=_values(net, moved, state.labels, state.values),
                is_renewed=is_small or is_slow or gap > _FAR_GAP or number == _MOST_ROUNDS - 2,
                settled=_SETTLED_SHARE * least_gap,
            )
            for part, state in enumerate(states)
        ]
    last = [Job(part, is_last=True, gap=gap, rounds=number + 1) for part in range(len(states))]
    results = _side_by_side(executor, replace(work, finish=finish), last)
    assert joined is not None
    return Joint(results, net, joined.factor, gap, number + 1)


class _AtOnce(NamedTuple):
    """One solve of all parts; each starts there."""

    problem: Problem
    solution: Solution
    starts: list[Estimate]


def _solved_at_once(folder: Path, count: int, shape: Shape, most: int) -> _AtOnce | None:
    """The parts in one solve of all; None where they are too large for it, or not plain."""
    parts: list[Part] = []
    size = 0
    for number in range(count):
        part = load_part(folder, number)
        size += len(part.problem.observations.corner)
        if size > most or part.problem.control is not None or part.problem.lengths is not None:
            return None
        parts.append(part)
    corners = np.unique(np.concatenate([part.corners for part in parts]))
    problem = whole_of(parts, shape.problem, corners)
    solution = solve(problem, shape.options)
    assert isinstance(solution.covariance, Covariance)
    estimate = solution.covariance.descent.estimate
    shift = torch.as_tensor(shape.origin_map).to(estimate.corners_map)
    corners_map = torch.as_tensor(solution.corners_map).to(shift) - shift
    starts = [
        Estimate(
            estimate.cam_from_vehicle[part.cameras],
            estimate.frame_state[part.frames],
            corners_map[np.searchsorted(corners, part.corners)],
            estimate.clock_s[part.cameras],
        )
        for part in parts
    ]
    return _AtOnce(problem, solution, starts)


def finish_parts(
    folder: Path,
    joint: Joint,
    shape: Shape,
    finish: Finish,
    executor: Executor = HERE,
    progress: Callable[[int, int], None] | None = None,
) -> list[Any]:
    """Results of ``finish`` for each joined part, whose solution has its joint covariances.

    ``progress`` is called with how many are done, and of how many. Raises WorkerError where a process died.
    """
    jobs = [
        Job(part, is_finish=True, gap=joint.gap, rounds=joint.rounds) for part in range(len(joint.net.labels))
    ]
    return _side_by_side(executor, TidyWork(Work(folder, shape, finish)), jobs, progress)


def _side_by_side(
    executor: Executor,
    work: Work | TidyWork,
    jobs: Sequence[Job],
    progress: Callable[[int, int], None] | None = None,
) -> list[Any]:
    report = progress or (lambda done, total: None)
    report(0, len(jobs))
    results: dict[int, Any] = {}
    with closing(executor.side_by_side(work, jobs)) as outcomes:
        for number, outcome in outcomes:
            if isinstance(outcome, WorkerError):
                raise outcome
            results[number] = outcome
            report(len(results), len(jobs))
    return [results[number] for number in range(len(jobs))]


def _net_of(states: Sequence[PartStates], links: Sequence[Link], shape: Shape) -> Net:
    first = states[0].values
    unknowns = 6 + first.clock_s.shape[1]
    return Net.of(
        shape.problem,
        shape.options,
        [state.labels for state in states],
        links,
        unknowns,
        first.frame_state.shape[1],
    )


def _shared(net: Net, states: Sequence[PartStates]) -> Shared:
    """The value of all borders: each item's is that of the last part that has it."""
    cameras = np.tile(np.eye(4), (len(net.problem.intrinsic), 1, 1))
    clocks = np.zeros((len(cameras), net.unknowns - 6))
    frame_state = np.zeros((len(net.frames), net.states))
    corners_map = np.zeros((len(net.corners), 2))
    for state in states:
        cameras[state.labels.cameras] = state.values.cam_from_vehicle.cpu().numpy()
        clocks[state.labels.cameras] = state.values.clock_s.cpu().numpy()
        frame_state[np.searchsorted(net.frames, state.labels.frames)] = state.values.frame_state.cpu().numpy()
        corners_map[np.searchsorted(net.corners, state.labels.corners)] = (
            state.values.corners_map.cpu().numpy()
        )
    return Shared(cameras, clocks, frame_state, corners_map)


def _values(net: Net, shared: Shared, labels: Labels, like: Values) -> Values:
    """A part's border as it is shared."""

    def tensor(values: FloatArray) -> torch.Tensor:
        return torch.as_tensor(values, dtype=torch.float64, device=like.cam_from_vehicle.device)

    return Values(
        tensor(shared.cam_from_vehicle[labels.cameras]),
        tensor(shared.clock_s[labels.cameras]),
        tensor(shared.frame_state[np.searchsorted(net.frames, labels.frames)]),
        tensor(shared.corners_map[np.searchsorted(net.corners, labels.corners)]),
    )


def _all_told(folder: Path, states: Sequence[PartStates], shared: Shared, net: Net) -> Iterator[Summary]:
    """Evidence of all parts on the shared value, read part by part."""
    for number, state in enumerate(states):
        yield _about(load_told(folder, number, state), state, shared, net)


def _about(told: Summary, state: PartStates, shared: Shared, net: Net) -> Summary:
    """Evidence of a part on the shared value, which is not its own yet."""
    away = _values(net, shared, state.labels, state.values).step_from(state.values).cpu().numpy()
    return replace(told, slope=told.slope + told.information @ away)


def _moved(net: Net, shared: Shared, joined: Joined) -> Shared:
    """The shared value after the step of a join."""
    by_camera = joined.step[0].reshape(len(shared.cam_from_vehicle), net.unknowns)
    turn = rigid(torch.as_tensor(by_camera[:, :6])).detach().numpy()

    def items(place: tuple[np.ndarray, np.ndarray], width: int) -> FloatArray:
        out = np.zeros((len(place[0]), width))
        for item, (block, row) in enumerate(zip(*place, strict=True)):
            out[item] = joined.step[block][row : row + width]
        return out

    return Shared(
        turn @ shared.cam_from_vehicle,
        shared.clock_s + by_camera[:, 6:],
        shared.frame_state + items(net.frame_place, net.states),
        shared.corners_map + items(net.corner_place, 2),
    )


def _cost(told: Summary) -> float:
    return sum(told.terms.values())


def _check_agreement(
    net: Net, states: Sequence[PartStates], alone: Sequence[float], together: Sequence[float], folder: Path
) -> None:
    """Raise AdjustError where parts fit what they share much worse than their noise explains."""
    rises = [after - before for before, after in zip(alone, together, strict=True)]
    size = np.array([len(state.told.slope) for state in states])
    coordinates = int(size.sum()) - sum(net.pattern.sizes)
    ratio = 2 * sum(rises) / max(coordinates, 1)
    if ratio <= _CONTRADICTION:
        return
    worst = int(np.argmax(rises / np.maximum(size, 1)))
    x, y = load_part(folder, worst).problem.map_from_vehicle[:, :2, 3].mean(axis=0)
    raise AdjustError(
        f"the drives contradict each other, most about x {x:.0f} m, y {y:.0f} m (section {worst + 1}): "
        f"chi-square {ratio:.0f} for each coordinate that sections share; map the drives one by one to find "
        "the one whose poses or clock are wrong"
    )
