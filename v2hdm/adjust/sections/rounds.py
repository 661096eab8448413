"""One round of one part of a large problem: its whitening, what it says of its border, and its end.

Parts are jobs of an executor. Between rounds their estimates, their whitenings and the information of their
borders lie in files.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from v2hdm.adjust.descent import Descent, descend
from v2hdm.adjust.engine import TorchEngine
from v2hdm.adjust.engines import make_engine
from v2hdm.adjust.layout import nearby_origin
from v2hdm.adjust.model import Estimate, Loss
from v2hdm.adjust.problem import Problem, SolveOptions
from v2hdm.adjust.sections.join import Labels, labels_of
from v2hdm.adjust.sections.joined import JoinedCovariance
from v2hdm.adjust.sections.parts import Part
from v2hdm.adjust.sections.summary import (
    Border,
    Footing,
    Place,
    Summary,
    Values,
    summarise,
)
from v2hdm.adjust.solution import Solution
from v2hdm.adjust.solve import Start, report_of, start_of
from v2hdm.adjust.threads import one_thread_in_torch
from v2hdm.adjust.whitening import factorise
from v2hdm.errors import AdjustError
from v2hdm.progress import Progress, silent
from v2hdm.records import FloatArray

GAP = 1e-8
"""Twice the predicted decrease of the cost, as a fraction of it, at which the rounds end."""

_ALONE_GAP = 1e-5  # gap, a fraction of the cost, of a part's own optimum: the rounds move it by more; chosen
_PROTOCOL = 5  # version of pickle's format, the first that keeps arrays as they are
_HELD_SIGMA_M = 1.0  # standard deviation, m, of what holds border corners in a part: any ray tells more


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
    """A part's border in a round: where it is, its value and what it tells.

    The information of ``told`` is in a file: :func:`load_told`.
    """

    labels: Labels
    values: Values
    told: Summary


Finish = Callable[[int, Part, Solution], Any]
"""Makes the result of a part of its number, itself and its solution, in the process that solved it."""


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
class Job:
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
class Work:
    """Rounds of parts whose files, ``part_N`` and what rounds leave, are in ``folder``."""

    folder: Path
    shape: Shape
    finish: Finish | None = None

    def __call__(self, job: Job, _: Progress = silent) -> Any:
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

    def _round(self, job: Job, part: Part) -> PartStates:
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
        told = self._without_information(
            job.number, summarise(stand.footing, place, opened.held, opened.held_map)
        )
        order = opened.engine.arrays.corner_order.cpu().numpy()
        labels = labels_of(part, order, border.corners.cpu().numpy())
        return PartStates(labels, Values.of(place.estimate, border), told)

    def _without_information(self, number: int, told: Summary) -> Summary:
        """A summary whose information is left in a file: some 15 MB for a kilometre."""
        np.save(_information_file(self.folder, number), told.information)
        return replace(told, information=np.zeros((0, 0)))

    def _first(self, job: Job, part: Part, opened: _Open) -> Estimate:
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

    def _finished(self, job: Job, part: Part) -> Any:
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
            joint = np.load(covariance_file(self.folder, job.number))
            solution = replace(solution, covariance=JoinedCovariance(held, border=opened.border, joint=joint))
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
    """Write a part for :class:`Work`."""
    with (folder / f"part_{number}").open("wb") as stream:
        pickle.dump(part, stream)


def load_part(folder: Path, number: int) -> Part:
    """Read a part that :func:`save_part` has written."""
    with (folder / f"part_{number}").open("rb") as stream:
        part = pickle.load(stream)
    assert isinstance(part, Part)
    return part


def covariance_file(folder: Path, number: int) -> Path:
    """Where the joint covariance of a part's border is written."""
    return folder / f"covariance_{number}.npy"


def load_told(folder: Path, number: int, state: PartStates) -> Summary:
    """The whole of what a part has told in the last round."""
    return replace(state.told, information=np.load(_information_file(folder, number)))


def _information_file(folder: Path, number: int) -> Path:
    return folder / f"information_{number}.npy"
