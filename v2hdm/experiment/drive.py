"""One drive of an experiment: read or rendered, detected, mapped by every recipe, held against the truth.

Every stage is kept in the cache, as those of ``v2hdm map`` are: a drive that was stopped goes on, and all
that tables, figures and text need of a finished one is there in seconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from v2hdm.errors import AdjustError, MappingError
from v2hdm.experiment.plan import OURS, Job
from v2hdm.io.drive.truth import read_truth
from v2hdm.mapping.methods import NAIVE_IPMS
from v2hdm.mapping.results import MethodResult
from v2hdm.pipeline.camera_sets import camera_sets, map_camera_sets
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.detections import detect_in_pieces
from v2hdm.pipeline.inspect import inspect_each
from v2hdm.pipeline.map_drive import read_all
from v2hdm.pipeline.survey import take_survey
from v2hdm.progress import Progress
from v2hdm.records import Drive, Marking, Truth
from v2hdm.report.metrics import driven_past
from v2hdm.simulate import rendered_drive
from v2hdm.store.cache import StageCache


def drive_record(job: Job, progress: Progress, workers: int = 1) -> dict[str, Any]:
    """The record of a drive and of its maps by every recipe.

    ``workers`` are processes to render and detect in; 1 stays in this one. Raises V2hdmError where the drive
    cannot be rendered, read or looked at, or has no truth.
    """
    folder = Path(job.site.drive.path or "")
    if job.site.simulate is not None:
        folder = rendered_drive(job.site.simulate, job.cache, workers, partial(progress, "render"))
    context = Context(StageCache(job.cache), progress, workers=workers)
    with context.cache.in_use():
        read = read_all([folder], job.site.drive, context)
        truth = read_truth(read.whole)
        (inspection,) = inspect_each(read.drives, read.contents, job.site.drive.max_gap_s, context)
        drive = inspection.drive
        detections = detect_in_pieces(drive, read.contents, job.detector, context)
        record = _setting(job, read.whole, truth)
        for recipe, options in job.options.items():
            survey, key = take_survey(drive, options), read.contents.key(drive)
            try:
                found = map_camera_sets(drive, key, detections, survey, None, context)
            except (MappingError, AdjustError) as failure:
                record["failures"].append([recipe, "all cameras", str(failure)])
            else:
                _add(record, recipe, {name: one.methods for name, one in found.items()})
    progress("finished", 1, 1)
    return record


def _setting(job: Job, drive: Drive, truth: Truth) -> dict[str, Any]:
    """The record of a drive before it is mapped."""
    sets = camera_sets(drive)
    return {
        "port": job.port,
        "seed": job.seed,
        "started_from": " and ".join(sorted({camera.initial_ipm for camera in drive.cameras.values()})),
        "truth": _plain_map(truth.map.markings),
        "true_lanes": [lane.points_map for lane in truth.map.lanes],
        "route": drive.route_map,
        "expected": {name: driven_past(drive, truth, members) for name, members in sets.items()},
        "maps": {name: {} for name in sets},
        "lanes": {}, "failures": [],
    }  # fmt: skip


def _add(record: dict[str, Any], recipe: str, sets: Mapping[str, Mapping[str, MethodResult]]) -> None:
    """Add maps under a recipe; others than ours give the naive maps again."""
    for name, methods in sets.items():
        for method, result in methods.items():
            if recipe == OURS or method not in NAIVE_IPMS:
                row = method if recipe == OURS else f"{method}, {recipe}"
                record["maps"][name][row] = _plain_map(result.hd_map.markings)
    if recipe == OURS:
        record["lanes"] = {"Opt": [lane.points_map for lane in list(sets.values())[-1]["Opt"].hd_map.lanes]}


def _plain_map(markings: Sequence[Marking]) -> dict[str, Any]:
    return {
        "kinds": [marking.kind for marking in markings],
        "corners": [marking.corners_map for marking in markings],
        "sightings": [marking.sightings for marking in markings],
    }
