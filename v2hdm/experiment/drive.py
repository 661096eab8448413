"""One drive of an experiment: read or rendered, detected, mapped by every recipe, measured by the truth.

Every stage is kept in the cache, as those of ``v2hdm map`` are: a drive that was stopped goes on, and all
that tables, figures and text need of a finished one is there in seconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import AdjustError, MappingError
from v2hdm.executor import HERE, Executor
from v2hdm.experiment.plan import OURS, RECIPES, Job
from v2hdm.io.drive.truth import read_truth
from v2hdm.mapping.naive import NAIVE_IPMS
from v2hdm.mapping.results import MethodResult
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.inspect import inspect_each
from v2hdm.pipeline.map_drive import read_all
from v2hdm.pipeline.stages import camera_sets, detect_in_pieces, map_camera_sets
from v2hdm.progress import Progress
from v2hdm.records import BEST, DIAMOND, Drive, FloatArray, HDMap, IntArray, Marking, Truth
from v2hdm.report.metrics import corner_errors, driven_past, marking_metrics, match_markings, rms
from v2hdm.report.terminal import METHODS
from v2hdm.simulate.port.drive import rendered_drive
from v2hdm.store.cache import StageCache
from v2hdm.survey.run import take_survey


def drive_record(job: Job, progress: Progress, executor: Executor = HERE) -> dict[str, Any]:
    """The record of a drive and its maps by recipe, for :func:`measure`. V2hdmError without a truth."""
    folder = Path(job.site.drive.path or "")
    if job.site.simulate is not None:
        folder = rendered_drive(job.site.simulate, job.cache, executor, partial(progress, "render"))
    context = Context(StageCache(job.cache), progress, executor=executor, workers=executor.workers)
    with context.cache.in_use():
        read = read_all([folder], job.site.drive, context)
        truth = read_truth(read.whole)
        (inspection,) = inspect_each(read.drives, read.contents, job.site.drive.max_gap_s, context)
        drive = inspection.drive
        detections = detect_in_pieces(drive, read.contents, job.detector, context)
        record = _setting(job, read.whole, truth)
        for recipe, options in job.options.items():
            survey = take_survey(drive, options)
            key = read.contents.key(drive)
            try:
                mapped_sets = map_camera_sets(drive, key, detections, survey, None, context, compare=True)
            except (MappingError, AdjustError) as failure:
                record["failures"].append([recipe, "all cameras", str(failure)])
            else:
                _add(record, recipe, {name: mapped.methods for name, mapped in mapped_sets.items()})
    progress("finished", 1, 1)
    return record


def _setting(job: Job, drive: Drive, truth: Truth) -> dict[str, Any]:
    """The record of a drive before it is mapped."""
    sets = camera_sets(drive)
    return {
        "title": job.title,
        "port": job.port,
        "seed": job.seed,
        "started_from": " and ".join(sorted({camera.initial_ipm for camera in drive.cameras.values()})),
        "truth": truth,
        "route": drive.route_map,
        "expected": {name: driven_past(drive, truth, members) for name, members in sets.items()},
        "maps": {name: {} for name in sets},
        "failures": [],
    }


def _add(record: dict[str, Any], recipe: str, sets: Mapping[str, Mapping[str, MethodResult]]) -> None:
    """Add maps under a recipe; others than ours give the naive maps again."""
    for name, methods in sets.items():
        for method, result in methods.items():
            if recipe == OURS or method not in NAIVE_IPMS:
                record["maps"][name][method if recipe == OURS else f"{method}, {recipe}"] = result.hd_map


ROWS: tuple[str, ...] = (
    *METHODS,
    *(f"{method}, {recipe}" for recipe in RECIPES if recipe != OURS for method in (BEST, "ONI")),
)
"""Rows of the tables: the paper's four methods, then ours under other recipes."""


@dataclass(frozen=True)
class Row:
    """One method on one set of cameras of one drive; nan where nothing matched."""

    markings: int
    recall: float  # of the diamonds driven past, of all markings where there are none
    false_markings: int
    rmse_m: float
    bias_m: float
    spread_m: float  # root mean square distance of the error vectors from their mean
    shared: int  # markings that every method of this camera set has mapped
    shared_rmse_m: float  # of those alone


@dataclass(frozen=True)
class Matched:
    """Markings with a true counterpart ``true`` (M,), in route order, and their errors (M, 4, 2)."""

    true: IntArray
    errors_m: FloatArray


@dataclass(frozen=True)
class Measured:
    """The figures of one drive: by camera set, then by row."""

    title: str
    port: str
    seed: int | None
    started_from: str
    rows: Mapping[str, Mapping[str, Row]]
    matched: Mapping[str, Mapping[str, Matched]]
    failures: tuple[tuple[str, str, str], ...]


def measure(record: Mapping[str, Any]) -> Measured:
    """The figures of a drive's record."""
    truth: Truth = record["truth"]
    true = truth.map.markings
    passed = _passed(true, np.array(record["route"], dtype=np.float64))
    rows: dict[str, Mapping[str, Row]] = {}
    matched: dict[str, Mapping[str, Matched]] = {}
    for cameras, by_row in record["maps"].items():
        maps = {row: by_row[row] for row in ROWS if row in by_row}
        matched_rows = {row: _matched(hd_map, true, passed) for row, hd_map in maps.items()}
        shared = set(range(len(true))).intersection(
            *(in_row.true.tolist() for in_row in matched_rows.values())
        )
        expected = np.array(record["expected"][cameras], dtype=np.bool_)
        rows[cameras] = {row: _row(maps[row], truth, expected, matched_rows[row], shared) for row in maps}
        matched[cameras] = matched_rows
    failures = tuple((recipe, cameras, text) for recipe, cameras, text in record["failures"])
    title, port, seed, started_from = (record[name] for name in ("title", "port", "seed", "started_from"))
    return Measured(title, port, seed, started_from, rows, matched, failures)


def _passed(true: tuple[Marking, ...], route_map: FloatArray) -> IntArray:
    """For every true marking the point of the route nearest to it, the first where there are several."""
    if not true:
        return np.empty(0, dtype=np.int64)
    centres = np.array([marking.corners_map.mean(axis=0) for marking in true])
    away_m = np.linalg.norm(centres[:, None] - route_map[None], axis=2)
    return np.asarray(away_m.argmin(axis=1))


def _matched(hd_map: HDMap, true: tuple[Marking, ...], passed: IntArray) -> Matched:
    mapped, other = (np.array(i, dtype=np.int64) for i in match_markings(hd_map.markings, true))
    order = np.argsort(passed[other], kind="stable")
    mapped = mapped[order]
    other = other[order]
    errors = corner_errors([hd_map.markings[m] for m in mapped], [true[t] for t in other])
    return Matched(other, errors.reshape(-1, 4, 2))


def _row(hd_map: HDMap, truth: Truth, expected: np.ndarray, matched: Matched, shared: set[int]) -> Row:
    overall = marking_metrics(hd_map, truth, expected)
    diamonds = marking_metrics(hd_map, truth, expected, DIAMOND)
    errors = matched.errors_m.reshape(-1, 2)
    of_shared = matched.errors_m[np.isin(matched.true, list(shared))].reshape(-1, 2)
    return Row(
        markings=overall.markings,
        recall=diamonds.recall if diamonds.expected else overall.recall,
        false_markings=overall.false_markings,
        rmse_m=overall.corner_rmse_m,
        bias_m=overall.corner_bias_m,
        spread_m=rms(errors - errors.mean(axis=0)) if len(errors) else float("nan"),
        shared=len(shared),
        shared_rmse_m=rms(of_shared),
    )
