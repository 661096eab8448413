"""The stage of mapping: every method on every set of cameras, each set kept by itself."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.results import MethodResult
from v2hdm.pipeline.base import grey_reader
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.survey import Survey, compare_survey
from v2hdm.records import Drive, ImageDetections
from v2hdm.report.check_points import CheckTable
from v2hdm.site.changes import Base

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
    sets, cache = camera_sets(drive), context.cache
    begun = cache.key(drive_key, list(detections), survey.mapping)
    context.progress("map", 0, len(sets))
    found: dict[str, MappedSet] = {}
    for name, cameras in sets.items():
        last = name == list(sets)[-1]
        now = base if last else None
        work = partial(_map_set, drive, detections, name, cameras, survey, now, last)
        key = cache.key(begun, name, cameras, (base, survey.check) if last else None)
        found[name] = mapped = cache.get_or_make(STAGE, key, MappedSet, work)
        context.viewer.mapped(name, mapped.methods)
        context.progress("map", len(found), len(sets))
    return found


def _map_set(
    drive: Drive,
    detections: Sequence[ImageDetections],
    name: str,
    cameras: Sequence[str],
    survey: Survey,
    base: Base | None,
    last: bool,
) -> MappedSet:
    log, begin_s = partial(_log.debug, "%s: %s", name), time.perf_counter()
    methods = run_methods(drive, detections, cameras, survey.mapping, log, base, grey_reader(drive))
    best = methods[BEST]
    checked = compare_survey(survey, drive, best) if last else None
    # The factors of the adjustment are large; whoever needs more of them than this asks while they are here.
    methods[BEST] = replace(best, corners=None)
    took_s = time.perf_counter() - begin_s
    _log.info("mapped with %s: %d markings, %.1f s", name, len(best.hd_map.markings), took_s)
    for exclusion in best.excluded:
        where = ", ".join(f"{value:.2f}" for value in exclusion.position_map)
        _log.debug("%s: left out a %s at (%s): %s", name, exclusion.kind, where, exclusion.reason)
    return MappedSet(methods, checked)
