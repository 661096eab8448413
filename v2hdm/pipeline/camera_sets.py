"""The stage of mapping: every method on every set of cameras, each set kept by itself."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import parent_process

from v2hdm.errors import WorkerError
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.results import MethodResult
from v2hdm.pipeline.base import grey_reader
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.survey import Survey, compare_survey
from v2hdm.progress import Progress, silent
from v2hdm.records import Drive, ImageDetections
from v2hdm.report.check_points import CheckTable
from v2hdm.site.changes import Base
from v2hdm.store.cache import Line, log_again, recorded
from v2hdm.workers import side_by_side

_log = logging.getLogger(__name__)

BEST = "Opt"  # the method whose map and calibration are the result
STAGE = "map"


@dataclass(frozen=True)
class MappedSet:
    """One set of cameras: results by method, and of the last set the check points of a survey, if any."""

    methods: dict[str, MethodResult]
    checked: CheckTable | None = None


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
) -> dict[str, MappedSet]:
    """Map a drive with each set of cameras, where that is not known yet.

    ``drive_key`` is that of the drive and of what its images show. The check points of the survey are held
    against the finished map of all cameras, which alone brings ``base`` up to date. Raises MappingError where
    no map can be made, AdjustError where the adjustment fails.
    """
    cache, sets = context.cache, camera_sets(drive)
    begun = cache.key(drive_key, list(detections), survey.mapping)
    *single, last = sets
    keys = {name: cache.key(begun, name, sets[name], None) for name in single}
    keys[last] = cache.key(begun, last, sets[last], (base, survey.check))
    known = {name: cache.get(STAGE, key, MappedSet) for name, key in keys.items()}
    found = {name: mapped for name, mapped in known.items() if mapped is not None}
    context.progress("map", len(found), len(sets))

    def take(made: tuple[str, MappedSet, list[Line]]) -> None:
        name, mapped, lines = made
        found[name] = cache.put(STAGE, keys[name], MappedSet, mapped, lines)
        context.progress("map", len(found), len(sets))

    work = _Work(drive, detections, survey, base, last)
    # The largest first, so that processes end together.
    todo = [
        (name, sets[name]) for name in sorted(sets, key=lambda name: -len(sets[name])) if name not in found
    ]
    if len(todo) > 1 and context.processes > 1 and survey.mapping.device == "cpu" and work.is_large:
        for _, made in side_by_side(work, todo, context.processes, lambda *_: None):
            if isinstance(made, WorkerError):
                raise made
            log_again(made[2])
            take(made)
    else:
        for job in todo:
            take(work(job))
    return {name: found[name] for name in sets}


_Job = tuple[str, Sequence[str]]  # the name of a set, and its cameras
_WORTH_PROCESSES = 4000  # detected markings whose mapping takes as long as processes take to start


@dataclass(frozen=True)
class _Work:
    """Everything that the sets of cameras of a drive are mapped from; ``last`` is the one of all cameras."""

    drive: Drive
    detections: Sequence[ImageDetections]
    survey: Survey
    base: Base | None
    last: str

    @property
    def is_large(self) -> bool:
        """Whether processes are worth their start."""
        return sum(len(found.markings) for found in self.detections) > _WORTH_PROCESSES

    def __call__(self, job: _Job, _: Progress = silent) -> tuple[str, MappedSet, list[Line]]:
        """Map one set of cameras; returns its name, the result and what was logged."""
        if parent_process() is not None:
            logging.getLogger("v2hdm").setLevel(logging.DEBUG)
        with recorded() as lines:
            return job[0], self._map(*job), lines

    def _map(self, name: str, cameras: Sequence[str]) -> MappedSet:
        begin_s, drive, survey = time.perf_counter(), self.drive, self.survey
        log, base = partial(_log.debug, "%s: %s", name), self.base if name == self.last else None
        methods = run_methods(drive, self.detections, cameras, survey.mapping, log, base, grey_reader(drive))
        best = methods[BEST]
        checked = compare_survey(survey, drive, best) if name == self.last else None
        # The factors of the adjustment are large; whoever needs more of them asks while they are here.
        methods[BEST] = replace(best, joint_covariance=None)
        took_s = time.perf_counter() - begin_s
        _log.info("mapped with %s: %d markings, %.1f s", name, len(best.hd_map.markings), took_s)
        for exclusion in best.excluded:
            where = ", ".join(f"{value:.2f}" for value in exclusion.position_map)
            _log.debug("%s: left out a %s at (%s): %s", name, exclusion.kind, where, exclusion.reason)
        return MappedSet(methods, checked)
