"""A long drive, or many of one network, mapped in sections that are adjusted together.

1. Every section, with an overlap of images of its neighbours, is solved by itself, and tests its inputs.
2. Groups of sightings that two sections have in common, image by image, are one marking.
3. The solves of all sections are joined (:mod:`v2hdm.adjust.sections`), each with the images that are its
   own: roughly, which tells outliers and noise, and then without outliers. This is the joint solve of the
   drive.
4. The candidates of all sections are classified together: shapes are learnt over all. A marking belongs to
   the section whose own images determine most of its corners.
5. Every section makes its map, and their lanes are joined.

Sections are jobs of an executor, and lie in files between these steps: no process holds more than one.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from v2hdm.adjust import PoseSigma, Problem, estimate_noise
from v2hdm.adjust.sections.parts import Link, chains_of
from v2hdm.adjust.sections.rounds import Shape
from v2hdm.adjust.sections.solve import Fitted, Joint, finish_parts, fit_parts, join_parts
from v2hdm.association.sightings import Sightings, frames_of
from v2hdm.errors import WorkerError
from v2hdm.executor import Executor
from v2hdm.executor.memory import TidyWork
from v2hdm.faults.clock_errors import second_moments
from v2hdm.faults.clock_parts import Along, evidence_of
from v2hdm.faults.sensitivity import stretches_of_way
from v2hdm.io.maps.corrections import Heard
from v2hdm.lanes.lines import join_paths, lanes_along
from v2hdm.mapping.bundle import LEAST_OBSERVATIONS, VARIANCE_FACTORS, Model, drive_problem, full_model
from v2hdm.mapping.optimise import SETTLED_MODEL, initial_rig, larger_noise
from v2hdm.mapping.options import AUTO, MappingOptions, check_sections
from v2hdm.mapping.results import MethodResult
from v2hdm.mapping.sections.common import Alone, Names, Pooled, named, pooled_noise, with_owners
from v2hdm.mapping.sections.faults import pooled_tests, refuse_contradicted
from v2hdm.mapping.sections.joint import (
    Fit,
    Gate,
    Judged,
    gates,
    open_gates,
    refuse_contradicting_drives,
    scatter_by_marking,
    variance_of,
)
from v2hdm.mapping.sections.merging import merged
from v2hdm.mapping.sections.section import part_of_frame, sections_of
from v2hdm.mapping.sections.work import (
    DetectionsOf,
    Ends,
    Finished,
    GreyOf,
    Places,
    Proposal,
    Work,
    classified_of,
)
from v2hdm.records import BoolArray, Drive, FloatArray, IntArray
from v2hdm.site.candidates import Candidates, Counts
from v2hdm.site.corrections import added_markings, with_symbols_corrected
from v2hdm.site.line_corrections import with_lines_corrected
from v2hdm.site.markings import Classified, classify
from v2hdm.site.options import AcceptanceOptions
from v2hdm.site.parallax import Parallax

_log = logging.getLogger(__name__)

_CLASSIFIED_AT_ONCE = 5000
"""Most candidates, of neighbouring sections, that are classified together: memory and time would grow with
their square, and thousands tell all of a class's shapes."""


def map_in_sections(
    drive: Drive,
    detections_of: DetectionsOf,
    cameras: Sequence[str],
    options: MappingOptions,
    most_m: float,
    executor: Executor,
    folder: Path,
    progress: Callable[[str, int, int], None] = lambda step, done, total: None,
    grey: GreyOf | None = None,
) -> MethodResult:
    """Map a drive by the joint optimisation in sections of at most ``most_m`` of way, ignoring truth.

    ``folder`` keeps them while this runs; all processes of the ``executor`` must see it. Raises MappingError
    where a section cannot be mapped or an input is contradicted, AdjustError where sections contradict each
    other, WorkerError where a process died.
    """
    check_sections(options)
    sections = sections_of(drive, most_m)
    _log.info("%d sections of at most %.0f m of way", len(sections), most_m)
    # Corrections are followed once, when all is known.
    acceptance = replace(options.acceptance, corrections=[])
    work = Work(detections_of, tuple(cameras), replace(options, acceptance=acceptance), folder, grey)
    for section in sections:
        work.write("section", section.number, section)
    run = _Run(work, executor, progress, len(sections))
    own_images = [section.images[section.is_own] for section in sections]
    part = part_of_frame(sections, frames_of(drive).frame_of_image)
    alone: list[Alone] = run.all(work.settle, "map sections")
    tests = pooled_tests([section.evidence.score_tests for section in alone])
    refuse_contradicted(
        tests, max((section.evidence.foreign for section in alone), key=lambda segment: segment.gain)
    )
    del sections
    solved = _joint_solve(run, drive, part, alone)
    proposals: list[Proposal] = run.finish(solved, solved.work.propose, "propose markings")
    heard = _classified(run, solved, proposals, options.acceptance)
    clock_root = _clock_root(run, solved, [proposal.clock_slopes for proposal in proposals], drive)
    candidate_count = sum(len(proposal.kinds) for proposal in proposals)
    del proposals
    with_clocks = replace(solved.work, clock_root=clock_root)
    finished: list[Finished] = run.finish(solved, with_clocks.finish, "finish sections")
    result = merged([section.result for section in finished], drive, own_images)
    assert result.evidence is not None
    lanes = lanes_along(join_paths([path for section in finished for path in section.lanes]), options.lanes)
    # Of what several sections see each counts once.
    counts = {"observations": float(solved.observation_count), "candidates": float(candidate_count)}
    result = replace(
        result,
        hd_map=replace(result.hd_map, lanes=lanes),
        diagnostics={**result.diagnostics, **counts},
        evidence=replace(result.evidence, score_tests=tests, held_out=solved.held_out),
        heard=heard,
    )
    return _corrected(result, options.acceptance)


@dataclass(frozen=True)
class _Run:
    """Runs the steps of ``count`` sections on an executor, with its progress."""

    work: Work
    executor: Executor
    progress: Callable[[str, int, int], None]
    count: int

    def all(self, work: Callable[..., Any], step: str, jobs: Sequence[Any] | None = None) -> list[Any]:
        """The results of all sections, or of some ``jobs``, in their order."""
        todo = range(self.count) if jobs is None else jobs
        results: dict[int, Any] = {}
        self.progress(step, 0, len(todo))
        with closing(self.executor.side_by_side(TidyWork(work), todo)) as outcomes:
            for number, outcome in outcomes:
                if isinstance(outcome, WorkerError):
                    raise WorkerError(f"{step}, section {number + 1} of {self.count}: {outcome}")
                results[number] = outcome
                self.progress(step, len(results), len(todo))
        return [results[number] for number in range(len(todo))]

    def finish(self, solved: _Solved, finish: Callable[..., Any], step: str) -> list[Any]:
        """Results of ``finish`` for all sections under their last joint solve."""
        progress = partial(self.progress, step)
        return finish_parts(self.work.folder, solved.joint, solved.shape, finish, self.executor, progress)


class _Solved(NamedTuple):
    """The joint solve of a drive."""

    work: Work  # of its sections, with the model of the solve
    names: list[Names]  # by section
    joint: Joint
    shape: Shape
    held_out: dict[str, float]  # losses by pose model

    @property
    def observation_count(self) -> int:
        """The number of observations that the solve was made from."""
        return sum(len(fit.corner) for fit in self.joint.results)


def _joint_solve(run: _Run, drive: Drive, part: IntArray, alone: Sequence[Alone]) -> _Solved:
    """Join the sections, with the observations that agree, under the drive's pose model.

    ``part`` (J,) is the section of each frame.
    """
    names = named(alone)
    for number, of_section in enumerate(names):
        run.work.write("names", number, of_section)
    judged: list[Judged] = run.all(run.work.judge, "judge observations")
    refuse_contradicting_drives(judged, drive)
    corners = [section.corner for section in judged]
    rough = _judge_together(run, drive, part, alone, corners)
    names = with_owners(
        names, [corner[gate.is_used] for corner, gate in zip(corners, rough.gates, strict=True)]
    )
    for number, of_section in enumerate(names):
        run.work.write("names", number, of_section)
    options = run.work.options
    pose_model = options.pose_model
    held_out: dict[str, float] = {}
    if pose_model == AUTO:
        busiest = int(np.argmax([section.busiest for section in alone]))
        ((pose_model, held_out),) = run.all(run.work.choose, "choose pose model", [busiest])
    noise = rough.noise
    work = replace(
        run.work,
        model=full_model(noise.pose_sigma, options, pose_model, noise.variance_factor),
        is_fitted=True,
        pose_model=pose_model,
        fullest=int(np.argmax([section.observations for section in alone])),
    )
    cut = _cut(run, work, drive, part)
    shape = cut.shape
    joint = join_parts(
        work.folder, run.count, cut.links, shape, work.tell, run.executor,
        partial(run.progress, "join sections"), are_near=True,
    )  # fmt: skip
    fits: list[Fit] = joint.results
    scatter = scatter_by_marking(fits, 1 + max(int(of_section.marking.max()) for of_section in names))
    for number, of_section in enumerate(names):
        corner = (np.arange(4) + of_section.turned[:, None]) % 4
        work.write("scatter", number, scatter[of_section.marking[:, None], corner])
    work = replace(work, chi2_per_dof=variance_of(fits, shape.problem).all)
    return _Solved(work, names, joint, shape, held_out)


class _Rough(NamedTuple):
    """Results of a rough joint solve of all observations."""

    gates: list[Gate]  # by section, also in its files
    noise: Pooled


def _judge_together(
    run: _Run, drive: Drive, part: IntArray, alone: Sequence[Alone], corners: Sequence[IntArray]
) -> _Rough:
    """Tell outliers and noise by a joint solve of all observations, of corners (K,) by section."""
    before = open_gates(corners)
    for number, gate in enumerate(before):
        run.work.write("gate", number, gate)
    options = run.work.options
    pose_model = SETTLED_MODEL if options.pose_model == AUTO else options.pose_model
    pooled = pooled_noise(alone)
    model = full_model(pooled.pose_sigma, options, pose_model, pooled.variance_factor)
    work = replace(run.work, model=model)
    cut = _cut(run, work, drive, part)
    fitted = fit_parts(
        work.folder, run.count, cut.links, cut.shape, work.fit, run.executor,
        partial(run.progress, "judge sections together"), are_near=True,
    )  # fmt: skip
    fits: list[Fit] = fitted.results
    passed = gates(fits, before, model.solver.gate_probability)
    for number, gate in enumerate(passed):
        run.work.write("gate", number, gate)
    factor = pooled.variance_factor
    if sum(len(fit.corner) for fit in fits) >= LEAST_OBSERVATIONS:
        factor = float(np.clip(factor * variance_of(fits, cut.shape.problem).observations, *VARIANCE_FACTORS))
    return _Rough(passed, Pooled(_pose_sigma(fitted, alone[0].stated_sigma, pooled), factor))


def _pose_sigma(fitted: Fitted, stated: tuple[PoseSigma, ...], pooled: Pooled) -> tuple[PoseSigma, ...]:
    """The noise of the poses, by session, that a solve of all sections at once shows, or that of each."""
    if fitted.problem is None or fitted.solution is None:
        return pooled.pose_sigma
    estimated = estimate_noise(replace(fitted.problem, pose_sigma=stated), fitted.solution)
    return tuple(map(larger_noise, stated, estimated))


class _Cut(NamedTuple):
    """The joint problem, cut into parts that are in files."""

    links: tuple[Link, ...]
    shape: Shape


def _cut(run: _Run, work: Work, drive: Drive, part: IntArray) -> _Cut:
    """Cut the joint problem of the observations that pass their gates."""
    assert work.model is not None
    whole = _without_sightings(drive, work.cameras, work.model)
    chains = chains_of(whole, part, tuple(work.model.solver.pose_states))
    session = whole.session_of_frame
    rising = np.zeros(len(session))
    for number in range(whole.session_count):
        in_session = session == number
        rising[in_session] = np.linspace(-0.5, 0.5, int(in_session.sum()))
    stretch = stretches_of_way(whole.map_from_vehicle[:, :2, 3], session)
    for number in range(run.count):
        frames = np.flatnonzero(part == number)
        is_start = chains.is_start[frames]
        is_linked = chains.in_border[frames]
        along = Along(number, stretch[frames], int(stretch.max()) + 1, rising[frames], is_start & is_linked)
        work.write("ends", number, Ends(is_start, is_linked, along))
    run.all(work.cut, "cut sections")
    return _Cut(chains.links, Shape.of(whole, work.model.solver))


def _clock_root(
    run: _Run, solved: _Solved, slopes: Sequence[FloatArray | None], drive: Drive
) -> FloatArray | None:
    """Root (n, n) of the second moments of the clocks' errors; None where they have none.

    Every section is told how its border follows them.
    """
    told = [of_section for of_section in slopes if of_section is not None]
    if not told:
        return None
    for number, steps in enumerate(solved.joint.steps(told)):
        run.work.write("clock_steps", number, steps)
    parts = run.finish(solved, solved.work.weigh_clocks, "weigh clocks")
    return second_moments(evidence_of(parts), drive.noises)


def _classified(
    run: _Run, solved: _Solved, proposals: Sequence[Proposal], acceptance: AcceptanceOptions
) -> tuple[Heard, ...]:
    """Classify the candidates of all sections together, and tell every section of its own."""
    count = np.array([len(proposal.kinds) for proposal in proposals])
    batches = max(-(-int(count.sum()) // _CLASSIFIED_AT_ONCE), 1)
    batch = (np.cumsum(count) - count) * batches // max(int(count.sum()), 1)
    heard: list[Heard] = []
    classes = []
    for number in range(batches):
        chosen = np.flatnonzero(batch == number).tolist()
        classes.append(_classified_batch(run, solved, {k: proposals[k] for k in chosen}, acceptance))
        heard += classes[-1].heard
    if not any(len(classified.accepted) for classified in classes):
        classes[0].check()
    return tuple(heard)


def _classified_batch(
    run: _Run, solved: _Solved, proposals: Mapping[int, Proposal], acceptance: AcceptanceOptions
) -> Classified:
    """Classify the candidates of some sections together."""
    work = solved.work
    names = [kind for proposal in proposals.values() for kind in proposal.kinds]
    kinds = sorted(set(names)) or [""]
    index = {name: number for number, name in enumerate(kinds)}
    ends = np.cumsum([len(proposal.kinds) for proposal in proposals.values()])
    rows = dict(zip(proposals, np.split(np.arange(len(names)), ends[:-1]), strict=True))

    def places(corners_map: FloatArray, is_end: BoolArray | None = None) -> list[Places]:
        return [
            Places(number, corners_map[at], None if is_end is None else is_end[at])
            for number, at in rows.items()
        ]

    def counted(corners_map: FloatArray) -> Counts:
        counts = run.all(work.count, "count sightings", places(corners_map))
        fields = vars(counts[0])
        return Counts(**{name: np.concatenate([vars(part)[name] for part in counts]) for name in fields})

    def standing(corners_map: FloatArray, is_end: BoolArray) -> FloatArray:
        return np.concatenate(run.all(work.look, "look at ends", places(corners_map, is_end)))

    solutions = [proposal.solved for proposal in proposals.values()]
    parallaxes = [proposal.parallax for proposal in proposals.values()]
    classified = classify(
        Candidates(
            np.concatenate([candidates.corners_map for candidates in solutions]),
            np.concatenate([candidates.covariance_m2 for candidates in solutions]),
        ),
        np.array([index[name] for name in names], dtype=np.int64),
        kinds,
        counted,
        Parallax(
            np.concatenate([parallax.slope for parallax in parallaxes]),
            np.concatenate([parallax.covariance for parallax in parallaxes]),
            np.concatenate([parallax.log_odds for parallax in parallaxes]),
        ),
        acceptance,
        None if work.grey is None else standing,
    )
    for number, at in rows.items():
        work.write("classified", number, classified_of(classified, at, solved.names[number], kinds))
    return classified


def _corrected(result: MethodResult, acceptance: AcceptanceOptions) -> MethodResult:
    """The result with what a person added, drew and rejected."""
    corrections = acceptance.corrections
    hd_map = result.hd_map
    added, heard = added_markings(corrections, hd_map.markings)
    hd_map = replace(hd_map, markings=(*hd_map.markings, *added))
    hd_map, rejected = with_symbols_corrected(hd_map, corrections)
    hd_map, heard_of_lines = with_lines_corrected(hd_map, corrections)
    return replace(
        result,
        hd_map=hd_map,
        excluded=(*result.excluded, *rejected),
        heard=(*result.heard, *heard, *heard_of_lines),
    )


def _without_sightings(drive: Drive, cameras: tuple[str, ...], model: Model) -> Problem:
    """All cameras and frames of a drive with their priors."""
    frames = frames_of(drive)
    none = np.zeros(0, dtype=np.int64)
    sightings = Sightings(
        cameras=cameras,
        stamp_s=frames.stamp_s,
        map_from_vehicle=frames.map_from_vehicle,
        image=none,
        camera=none,
        frame=none,
        kind=none,
        corners_pinhole_px=np.zeros((0, 4, 2)),
        covariance_px=np.zeros((0, 4, 2, 2)),
        valid=np.zeros((0, 4), dtype=np.bool_),
        kinds=(),
        session=frames.session,
        row_share=np.zeros((0, 4)),
        log_odds=np.zeros(0),
    )
    stated = {name: drive.cameras[name] for name in cameras}
    rig = initial_rig(stated, frames.map_from_vehicle)
    return drive_problem(sightings, rig, stated, model)
