"""The stages of detection and mapping, kept part by part: a run that was stopped goes on in the middle.

A piece of detection rests on the pixels of its images and on what is known of their cameras, not on where or
of which drive they are. Mapping is kept by sets of cameras, what needs an adjustment apart from the rest.
"""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import WorkerError
from v2hdm.executor import Executor
from v2hdm.io.detections import detections_of, read_detections
from v2hdm.mapping.methods import map_as_stated, run_methods
from v2hdm.mapping.results import MethodResult
from v2hdm.pipeline.base import grey_reader
from v2hdm.pipeline.config import Contents, model_key
from v2hdm.pipeline.context import Context
from v2hdm.progress import Progress, silent
from v2hdm.records import BEST, Drive, Image, ImageDetections, IntArray
from v2hdm.site.living.changes import Base
from v2hdm.store.cache import Line, key_of, log_again, recorded
from v2hdm.survey.check_points import CheckTable
from v2hdm.survey.run import Survey, compare_survey

if TYPE_CHECKING:
    from v2hdm.detection.batch import Detect

_DETECT = "detect"
PIECE = 16  # images of a piece: a second or two of work
_Masks = dict[str, NDArray[np.bool_]]
_Piece = list[ImageDetections]


def detect_in_pieces(
    drive: Drive,
    contents: Contents,
    options: DetectorOptions,
    context: Context,
    detect: Detect | None = None,
) -> list[ImageDetections]:
    """Detect in every image of a drive, in its order, where that is not known yet.

    ``detect`` does so in place of processes of this machine. A drive without pictures brings its detections.
    """
    if not drive.has_pictures:
        return detections_of(drive)
    from v2hdm.detection.batch import detect_images, own_vehicles, with_masks
    from v2hdm.detection.detector import Detector

    cache = context.cache
    progress = context.steps("detect")
    detector_key = cache.key(options, model_key(options))
    masks = cache.get_or_make(
        "own_vehicle",
        key_of(detector_key, contents.key(drive)),
        _Masks,
        # On the CPU wherever the rest runs, so that it is the same and needs no GPU here.
        lambda: own_vehicles(drive, Detector.load(options=replace(options, device="cpu"))),
    )
    drive = with_masks(drive, masks)
    keys = _keys(drive, contents, detector_key)
    pieces = {start: cache.get(_DETECT, key, _Piece) for start, key in keys.items()}
    missing = [start for start, piece in pieces.items() if piece is None]
    total = len(drive.images)
    todo = [i for start in missing for i in range(start, min(start + PIECE, total))]
    if len(todo) < total:
        _log.info("detections in %d of %d images reused from an earlier run", total - len(todo), total)
    progress(total - len(todo), total)
    piece_so_far: _Piece = []
    finished = 0

    def take(detections: ImageDetections) -> None:
        nonlocal finished
        finished += 1
        start = detections.image - detections.image % PIECE
        piece_so_far.append(replace(detections, image=detections.image - start))
        if len(piece_so_far) == min(PIECE, total - start):
            pieces[start] = cache.put(_DETECT, keys[start], _Piece, piece_so_far)
            piece_so_far.clear()
        progress(total - len(todo) + finished, total)

    if todo:
        (detect or detect_images)(drive, options, todo, context.executor, take)
    return [
        replace(detections, image=start + detections.image)
        for start, piece in pieces.items()
        for detections in piece or ()
    ]


def _keys(drive: Drive, contents: Contents, detector_key: str) -> dict[int, str]:
    """The key of each piece, by its first image."""
    cameras = {name: key_of(camera) for name, camera in drive.cameras.items()}
    keys = {}
    for start in range(0, len(drive.images), PIECE):
        images = drive.images[start : start + PIECE]
        camera_keys = [cameras[image.camera] for image in images]
        keys[start] = key_of(detector_key, camera_keys, contents.of_images(images))
    return keys


_log = logging.getLogger(__name__)

_MAP = "map"


@dataclass(frozen=True)
class MappedSet:
    """One set of cameras: results by method, and of the last set the check points of a survey, if any."""

    methods: dict[str, MethodResult]
    checked: CheckTable | None = None


def methods_of(sets: Mapping[str, MappedSet]) -> dict[str, dict[str, MethodResult]]:
    """Results by camera set, then by method."""
    return {name: mapped.methods for name, mapped in sets.items()}


def camera_sets(drive: Drive) -> dict[str, tuple[str, ...]]:
    """Each camera alone and all together: named ``both`` for two cameras, ``all`` for more."""
    names = tuple(drive.cameras)
    sets: dict[str, tuple[str, ...]] = {name: (name,) for name in names}
    if len(names) > 1:
        sets["both" if len(names) == 2 else "all"] = names
    return sets


def map_camera_sets(
    drive: Drive,
    drive_key: str,
    detections: Sequence[ImageDetections],
    survey: Survey,
    base: Base | None,
    context: Context,
    *,
    compare: bool = False,
    section_m: float = 0.0,
) -> dict[str, MappedSet]:
    """Map a drive with all cameras by the joint optimisation, where that is not known yet.

    ``compare`` maps it with each camera alone and by the naive methods as well; with ``section_m`` above 0 it
    is mapped in sections of so much way. ``drive_key`` is that of the
    drive and of what its images show. The check points of the survey are held against the finished map of all
    cameras, which alone brings ``base`` up to date. Raises MappingError where no map can be made, AdjustError
    where the adjustment fails.
    """
    cache = context.cache
    sets = camera_sets(drive)
    if not compare:
        sets = dict([list(sets.items())[-1]])
    common_key = cache.key(drive_key, list(detections), survey.mapping, compare, section_m)
    last = list(sets)[-1]
    # The longest first, so that processes end together.
    jobs = [_Job(name, sets[name]) for name in sorted(sets, key=lambda name: -len(sets[name]))]
    if compare:
        jobs += [job._replace(stated=True) for job in jobs if not (section_m and job.name == last)]
    keys = {
        job: cache.key(common_key, *job, None if job.stated or job.name != last else (base, survey.check))
        for job in jobs
    }
    cached = {job: cache.get(_MAP, key, MappedSet) for job, key in keys.items()}
    mapped_by_job = {job: mapped for job, mapped in cached.items() if mapped is not None}

    def report() -> None:
        waiting = {job.name for job in jobs if job not in mapped_by_job}
        context.progress("map", len(sets) - len(waiting), len(sets))

    def take(outcome: _Outcome) -> None:
        job = outcome.job
        mapped_by_job[job] = cache.put(_MAP, keys[job], MappedSet, outcome.mapped, outcome.lines)
        report()

    report()
    whole = _Job(last, sets[last])
    if section_m and whole not in mapped_by_job:
        take(_in_sections(drive, detections, survey, whole, section_m, context))
    work = _Work(drive, detections, survey, base, last, compare)
    _do(work, [job for job in jobs if job not in mapped_by_job], context.executor, take)
    return {
        name: _together([mapped_by_job[job] for job in reversed(jobs) if job.name == name]) for name in sets
    }


def _together(parts: Sequence[MappedSet]) -> MappedSet:
    """The methods of one set of cameras from several jobs, the last of which was the adjustment's."""
    return MappedSet(
        {name: result for part in parts for name, result in part.methods.items()}, parts[-1].checked
    )


def _in_sections(
    drive: Drive,
    detections: Sequence[ImageDetections],
    survey: Survey,
    job: _Job,
    section_m: float,
    context: Context,
) -> _Outcome:
    """Map a set of cameras in sections, which lie in the cache, where all workers see them, for so long."""
    from v2hdm.mapping.sections.run import map_in_sections  # only long drives need it

    begin_s = time.perf_counter()
    where = context.cache.folder
    if where is not None:
        where.mkdir(parents=True, exist_ok=True)
    with recorded() as lines, tempfile.TemporaryDirectory(prefix="sections-", dir=where) as folder:
        source = _Detections() if not drive.has_pictures else _Detections(tuple(detections))
        best = map_in_sections(
            drive,
            source,
            job.cameras,
            survey.mapping,
            section_m,
            context.executor,
            Path(folder),
            context.progress,
            grey_reader(drive),
        )
        _log.info(
            "mapped with %s in sections: %d markings, %.1f s",
            job.name, len(best.hd_map.markings), time.perf_counter() - begin_s,
        )  # fmt: skip
    return _Outcome(job, MappedSet({BEST: best}), lines)


@dataclass(frozen=True)
class _Detections:
    """Detections in some images of a drive: of those ``listed`` for all, or from their files."""

    listed: tuple[ImageDetections, ...] | None = None

    def __call__(self, images: Sequence[Image], numbers: IntArray) -> list[ImageDetections]:
        """The detections in images of such numbers in the drive, numbered in their order."""
        if self.listed is None:
            return [read_detections(image.path, at) for at, image in enumerate(images)]
        place = {number: at for at, number in enumerate(numbers.tolist())}
        return [
            replace(detections, image=place[detections.image])
            for detections in self.listed
            if detections.image in place
        ]


class _Job(NamedTuple):
    """A set of cameras to map: by the IPMs that were ``stated``, or all else, which takes ten times as long.

    Apart, the short ones keep a process busy that has finished its long ones.
    """

    name: str
    cameras: tuple[str, ...]
    stated: bool = False


class _Outcome(NamedTuple):
    """A set of cameras that was mapped, and what was logged."""

    job: _Job
    mapped: MappedSet
    lines: list[Line]


_WORTH_PROCESSES = 4000  # detected markings whose mapping takes as long as processes take to start


def _do(work: _Work, jobs: Sequence[_Job], executor: Executor, take: Callable[[_Outcome], None]) -> None:
    """Map sets of cameras, side by side where that is worth the start of processes."""
    is_large = sum(len(in_image.markings) for in_image in work.detections) > _WORTH_PROCESSES
    if len(jobs) > 1 and executor.workers > 1 and work.survey.mapping.device == "cpu" and is_large:
        for _, outcome in executor.side_by_side(work, jobs):
            if isinstance(outcome, WorkerError):
                raise outcome
            log_again(outcome.lines)
            take(outcome)
    else:
        for job in jobs:
            take(work(job))


@dataclass(frozen=True)
class _Work:
    """Everything that the sets of cameras of a drive are mapped from; ``last`` is the one of all cameras.

    ``compare`` says whether by the naive methods, too.
    """

    drive: Drive
    detections: Sequence[ImageDetections]
    survey: Survey
    base: Base | None
    last: str
    compare: bool

    def __call__(self, job: _Job, _: Progress = silent) -> _Outcome:
        """Map one set of cameras."""
        with recorded() as lines:
            mapped = self._map(job)
        return _Outcome(job, mapped, lines)

    def _map(self, job: _Job) -> MappedSet:
        begin_s = time.perf_counter()
        drive = self.drive
        survey = self.survey
        name = job.name
        log = partial(_log.debug, "%s: %s", name)
        if job.stated:
            return MappedSet(map_as_stated(drive, self.detections, job.cameras, survey.mapping, log))
        base = self.base if name == self.last else None
        grey = grey_reader(drive)
        methods = run_methods(
            drive, self.detections, job.cameras, survey.mapping, log, base, grey,
            naive=self.compare, stated=False,
        )  # fmt: skip
        best = methods[BEST]
        checked = compare_survey(survey, drive, best) if name == self.last else None
        # The factors of the adjustment are large; whoever needs more of them asks while they are here.
        methods[BEST] = replace(best, joint_covariance=None)
        took_s = time.perf_counter() - begin_s
        _log.info("mapped with %s: %d markings, %.1f s", name, len(best.hd_map.markings), took_s)
        for exclusion in best.excluded:
            where = ", ".join(f"{value:.2f}" for value in exclusion.position_map)
            _log.debug("%s: left out %s at (%s): %s", name, exclusion.kind, where, exclusion.reason)
        return MappedSet(methods, checked)
