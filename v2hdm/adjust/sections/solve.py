"""``join_parts``: a problem too large for one solve, part by part, to the same optimum and covariances.

Parts that fit in memory together are solved at once, in a third of the time; others, roughly, by themselves.
Then rounds follow: every part summarises what it says of its border (:mod:`v2hdm.adjust.sections.summary`),
the summaries are joined (:mod:`v2hdm.adjust.sections.join`), and each part follows the border. This is a
Gauss-Newton descent of the whole in which no process holds more than one part; parts are jobs of an executor,
and their estimates lie in files between rounds. So do their whitenings, which cost ten rounds: they are made
at the start, after long steps, and at the end, for the covariances. After a solve at once one round states
these.
``fit_parts`` does the same roughly and without covariances, for what tells outliers and noise.
``finish_parts`` makes of each part what needs covariances.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from v2hdm.adjust.covariance import Covariance
from v2hdm.adjust.descent import Descent, descend
from v2hdm.adjust.engine import TorchEngine
from v2hdm.adjust.engines import make_engine
from v2hdm.adjust.layout import nearby_origin
from v2hdm.adjust.model import Estimate, Loss, rigid
from v2hdm.adjust.problem import Problem, SolveOptions
from v2hdm.adjust.sections.blocks import BlockCholesky
from v2hdm.adjust.sections.join import Joined, Labels, Net, Shared, labels_of
from v2hdm.adjust.sections.parts import Link, Part, whole_of
from v2hdm.adjust.sections.summary import (
    Border,
    Footing,
    JoinedCovariance,
    Place,
    Summary,
    Values,
    summarise,
)
from v2hdm.adjust.solution import Solution
from v2hdm.adjust.solve import Start, report_of, solve, start_of
from v2hdm.adjust.threads import one_thread_in_torch
from v2hdm.adjust.whitening import factorise
from v2hdm.errors import AdjustError, WorkerError
from v2hdm.executor import HERE, Executor
from v2hdm.progress import Progress, silent
from v2hdm.records import FloatArray

GAP = 1e-8
"""Twice the predicted decrease of the cost, as a fraction of it, at which the rounds end."""

ROUGH_GAP = 1e-6  # as GAP, where only residuals are asked for: a thousandth of a sigma in most of them

AT_ONCE = 400_000
"""Most observations that are solved at once: they take 2.8 kB each, factors included, of 2 km of yards."""

_ALONE_GAP = 1e-5  # gap, a fraction of the cost, of a part's own optimum: the rounds move it by more; chosen
_FAR_GAP = 1e-3  # gap of a round, a fraction of the cost, above which the next whitens anew: chosen
_SLOW = 0.6  # gap of a round, a fraction of that before, above which the next whitens anew: chosen
_SETTLED_SHARE = 0.1  # gap of a part with its border held, as a fraction of that of all: chosen
_PROTOCOL = 5  # of pickles: the first that keeps arrays as they are
_MOST_ROUNDS = 15  # rounds of joining and following, after which the solve has not converged; chosen
_HELD_SIGMA_M = 1.0  # standard deviation, m, of what holds border corners in a part: any ray tells more
_CONTRADICTION = 9.0
"""Chi-square per shared coordinate from which parts contradict each other: 1 is usual, this is 3 sigmas."""


class Shape(NamedTuple):
    """The inputs that all parts share: cameras and priors of the whole, the arrays' origin (2,), options."""

    problem: Problem  # without observations: the cameras and priors of the whole
    origin_map: FloatArray
    options: SolveOptions

    @classmethod
    def of(cls, problem: Problem, options: SolveOptions) -> Shape:
        """The shape of a problem."""
        empty = problem.observations.take(np.zeros(0, dtype=np.int64))
        bare = replace(
            problem, observations=empty, corner_count=0, corners_start=None, control=None, lengths=None
        )
        return cls(bare, nearby_origin(problem), options)


class PartStates(NamedTuple):
    """A part's border in a round: where it is, its value and what it tells."""

    labels: Labels
    values: Values
    told: Summary


Finish = Callable[[int, Part, Solution], Any]
"""Makes the result of a part of its number, itself and its solution, in the process that solved it."""


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


class _Open(NamedTuple):
    """A part laid out: ``held`` (m,), 1 / m^2, holds corners of its border at ``held_map`` (m, 2)."""

    plain: TorchEngine  # without what holds them
    engine: TorchEngine
    border: Border
    held: torch.Tensor
    held_map: torch.Tensor


class _Stand(NamedTuple):
    """A part laid out, and its last whitening."""

    opened: _Open
    footing: Footing

    def bare(self) -> _Stand:
        """The same without what a factor knows twice."""
        whitening = self.footing.whitening
        factor = replace(whitening.reduced_factor)
        return self._replace(
            footing=replace(self.footing, whitening=replace(whitening, reduced_factor=factor))
        )


@dataclass(frozen=True)
class _Job:
    """One round of one part; ``target`` is the value that its border moves to, None for the first round.

    That begins at ``start``, if there is one; its corners are in the order of the part's problem. A round
    that ``is_renewed`` whitens anew where it ends; another settles to a gap of ``settled``, its border held.
    """

    number: int
    start: Estimate | None = None
    target: Values | None = None
    is_near: bool = False  # the part's problem starts near an optimum
    is_renewed: bool = True
    settled: float = 0.0
    is_last: bool = False
    is_finish: bool = False
    gap: float = 0.0
    rounds: int = 0


@dataclass(frozen=True)
class _Work:
    """Rounds of parts whose files ``part_N``, ``stand_N`` and ``place_N`` are in ``folder``."""

    folder: Path
    shape: Shape
    finish: Finish | None = None

    def __call__(self, job: _Job, _: Progress = silent) -> Any:
        """Do one round of one part, or finish it."""
        part = load_part(self.folder, job.number)
        options = self.shape.options
        compiled = options.on_cpu and options.engine != "torch"
        with one_thread_in_torch(len(part.problem.observations.corner), compiled):
            if job.is_finish or job.is_last:
                return self._finished(job, part)
            return self._round(job, part)

    def _open(self, part: Part) -> _Open:
        """The part's engine, with the corners of its border held near their start.

        Where a part saw a corner along one line alone, the part alone could not tell where it is; what holds
        it is taken out of the summary again.
        """
        options = self.shape.options
        arrays = part.arrays(options, self.shape.origin_map)
        plain = make_engine(options.engine, arrays)
        border = border_of(part, plain)
        cameras = arrays.centre.new_tensor(part.problem.cam_from_vehicle)
        start_map, _ = plain.back_project(cameras)
        is_free = (arrays.control_root[border.corners] == 0).all(dim=1)
        held = is_free.to(arrays.centre.dtype) / _HELD_SIGMA_M**2
        control = arrays.control.clone()
        root = arrays.control_root.clone()
        control[border.corners[is_free]] = start_map[border.corners[is_free]]
        root[border.corners[is_free]] = root.new_tensor([1.0, 0.0, 1.0]) / _HELD_SIGMA_M
        engine = plain.over(replace(arrays, control=control, control_root=root))
        engine = engine.keeping(border.frames, border.corners)
        return _Open(plain, engine, border, held, control[border.corners])

    def _round(self, job: _Job, part: Part) -> PartStates:
        """The part's own optimum, or what follows the target, and what the part tells there."""
        if job.target is None:
            opened = self._open(part)
            stand = self._new_stand(job.number, opened, self._first(job, part, opened))
            place = Place.base(stand.footing.whitening)
        else:
            stand = self._stand(job.number)
            place = stand.footing.follow(self._place(job.number), job.target)
            if job.is_renewed:
                stand = self._new_stand(job.number, stand.opened, place.estimate)
                place = Place.base(stand.footing.whitening)
            else:
                place = stand.footing.settle(place, job.settled)
        self._keep("place", job.number, place)
        opened = stand.opened
        border = opened.border
        told = summarise(stand.footing, place, opened.held, opened.held_map)
        order = opened.engine.arrays.corner_order.cpu().numpy()
        labels = labels_of(part, order, border.corners.cpu().numpy())
        return PartStates(labels, Values.of(place.estimate, border), told)

    def _first(self, job: _Job, part: Part, opened: _Open) -> Estimate:
        """Where a part's rounds begin."""
        if job.start is not None:
            return _in_order(job.start, opened)
        if job.is_near:
            return self._start(part, opened.engine).estimate
        return self._own_optimum(job.number, part, opened.engine, self._robust)

    def _new_stand(self, number: int, opened: _Open, estimate: Estimate) -> _Stand:
        """Whiten a part at an estimate, and keep that for later rounds."""
        whitening = factorise(opened.engine, opened.engine.plan(), estimate, self._robust)
        stand = _Stand(opened, Footing.of(whitening, opened.border))
        self._keep("stand", number, stand.bare())
        return stand

    @property
    def _robust(self) -> Loss:
        return Loss(self.shape.options.loss, self.shape.options.loss_scale)

    def _start(self, part: Part, engine: TorchEngine) -> Start:
        return start_of(part.problem, self.shape.origin_map, engine, self._robust, self.shape.options)

    def _own_optimum(self, number: int, part: Part, engine: TorchEngine, robust: Loss) -> Estimate:
        options = self.shape.options
        start = self._start(part, engine)
        descent = descend(
            engine, start.estimate, robust, _ALONE_GAP, options.max_refreshes,
            options.max_evaluations, start.opening,
        )  # fmt: skip
        if descent.is_singular:
            x, y = part.problem.map_from_vehicle[:, :2, 3].mean(axis=0)
            raise AdjustError(
                f"section {number + 1}, about x {x:.0f} m, y {y:.0f} m: its {part.problem.corner_count} "
                "corners leave a direction of a camera free; make sections longer"
            )
        return descent.estimate

    def _keep(self, name: str, number: int, content: _Stand | Place) -> None:
        # A pickle would hold the memory of a factor once for each of its tiles.
        torch.save(content, self.folder / f"{name}_{number}", pickle_protocol=_PROTOCOL)

    def _stand(self, number: int) -> _Stand:
        stand = torch.load(self.folder / f"stand_{number}", weights_only=False)
        assert isinstance(stand, _Stand)
        return stand

    def _place(self, number: int) -> Place:
        place = torch.load(self.folder / f"place_{number}", weights_only=False)
        assert isinstance(place, Place)
        return place

    def _finished(self, job: _Job, part: Part) -> Any:
        """The result of ``finish`` for the solution where the part is."""
        assert self.finish is not None
        robust = self._robust
        whitening = None
        if job.is_finish:
            stand = self._stand(job.number)
            opened = stand.opened
            whitening = stand.footing.whitening
            estimate = whitening.estimate
        else:
            opened = self._open(part)
            estimate = self._place(job.number).estimate if job.start is None else _in_order(job.start, opened)
        descent = Descent(
            engine=opened.plain,
            plan=opened.engine.plan(),
            estimate=estimate,
            robust=robust,
            terms=opened.plain.terms(estimate, robust),
            gap=job.gap,
            evaluations=job.rounds,
            progressing=job.gap > GAP,
            is_singular=False,
            last_whitening=None,
        )
        options = replace(self.shape.options, gap_tolerance=GAP)
        solution = report_of(part.problem, self.shape.origin_map, options, descent, 0)
        if job.is_finish:
            held = replace(descent, engine=opened.engine, last_whitening=whitening)
            joint = np.load(_covariance_file(self.folder, job.number))
            solution = replace(solution, covariance=JoinedCovariance(held, None, opened.border, joint))
        return self.finish(job.number, part, solution)


def _in_order(start: Estimate, opened: _Open) -> Estimate:
    """An estimate whose corners are in the order of the part's problem, in that of its arrays."""
    return replace(start, corners_map=start.corners_map[opened.engine.arrays.corner_order])


def border_of(part: Part, engine: TorchEngine) -> Border:
    """The border of a part in the order of its arrays."""
    rank = torch.argsort(engine.arrays.corner_order)
    corners = rank[torch.as_tensor(part.border_corners, device=rank.device)].sort().values
    return Border(torch.as_tensor(part.border_frames, device=rank.device), corners)


def save_part(folder: Path, number: int, part: Part) -> None:
    """Write a part for :func:`solve_parts`."""
    with (folder / f"part_{number}").open("wb") as stream:
        pickle.dump(part, stream)


def load_part(folder: Path, number: int) -> Part:
    """Read a part that :func:`save_part` has written."""
    with (folder / f"part_{number}").open("rb") as stream:
        part = pickle.load(stream)
    assert isinstance(part, Part)
    return part


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
    jobs = [_Job(number, is_near=are_near) for number in range(count)]
    if whole is not None:
        jobs = [_Job(number, start) for number, start in enumerate(whole.starts)]
    joint = _in_rounds(folder, jobs, links, shape, finish, executor, progress, GAP)
    for part, covariance in enumerate(joint.net.covariances(joint.factor)):
        np.save(_covariance_file(folder, part), covariance)
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
        from_afar = [_Job(number, is_near=are_near) for number in range(count)]
        joint = _in_rounds(
            folder, from_afar, links, shape, finish, executor, progress, ROUGH_GAP, is_rough=True
        )
        return Fitted(joint.results, None, None)
    jobs = [_Job(number, start, is_last=True) for number, start in enumerate(whole.starts)]
    results = _side_by_side(executor, _Work(folder, shape, finish), jobs)
    return Fitted(results, whole.problem, whole.solution)


def _in_rounds(
    folder: Path,
    jobs: Sequence[_Job],
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
    work = _Work(folder, shape)
    are_joined = jobs[0].start is not None
    is_from_afar = not are_joined and not jobs[0].is_near
    before = np.inf
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
        joined = net.join(_taken(states, shared, net), shared)
        gap = (joined.decrease + sum(state.told.slack for state in states)) / max(sum(costs), 1.0)
        is_slow = gap > _SLOW * before
        before = gap
        is_small = (number > 0 or are_joined) and gap <= least_gap
        if is_small and (is_rough or jobs[0].is_renewed):
            break
        moved = _moved(net, shared, joined)
        jobs = [
            _Job(
                part,
                target=_values(net, moved, state.labels, state.values),
                is_renewed=is_small or is_slow or gap > _FAR_GAP or number == _MOST_ROUNDS - 2,
                settled=_SETTLED_SHARE * least_gap,
            )
            for part, state in enumerate(states)
        ]
    last = [_Job(part, is_last=True, gap=gap, rounds=number + 1) for part in range(len(states))]
    results = _side_by_side(executor, replace(work, finish=finish), last)
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


def _covariance_file(folder: Path, number: int) -> Path:
    return folder / f"covariance_{number}.npy"


def finish_parts(
    folder: Path, joint: Joint, shape: Shape, finish: Finish, executor: Executor = HERE
) -> list[Any]:
    """Results of ``finish`` for each joined part, whose solution has its joint covariances.

    Raises WorkerError where a process died.
    """
    jobs = [
        _Job(part, is_finish=True, gap=joint.gap, rounds=joint.rounds)
        for part in range(len(joint.net.labels))
    ]
    return _side_by_side(executor, _Work(folder, shape, finish), jobs)


def _side_by_side(executor: Executor, work: _Work, jobs: Sequence[_Job]) -> list[Any]:
    results: dict[int, Any] = {}
    with closing(executor.side_by_side(work, jobs)) as outcomes:
        for number, outcome in outcomes:
            if isinstance(outcome, WorkerError):
                raise outcome
            results[number] = outcome
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


def _taken(states: list[PartStates], shared: Shared, net: Net) -> Iterator[Summary]:
    """Evidence of all parts on the shared value; their information, which is large, leaves ``states``."""
    nothing = np.zeros((0, 0))
    for number, state in enumerate(states):
        yield _about(state, shared, net)
        states[number] = state._replace(told=replace(state.told, information=nothing))


def _about(state: PartStates, shared: Shared, net: Net) -> Summary:
    """Evidence of a part on the shared value, which is not its own yet."""
    away = _values(net, shared, state.labels, state.values).step_from(state.values).cpu().numpy()
    return replace(state.told, slope=state.told.slope + state.told.information @ away)


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
