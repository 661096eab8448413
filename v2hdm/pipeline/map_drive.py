"""The stages of a run: read, check, detect, map, judge, write; what an earlier run has found is taken."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch  # noqa: F401  # its absence is told before that of what is built on it

from v2hdm import __version__
from v2hdm.detection.batch import Detect, detect_images
from v2hdm.detection.weights import unknown_network
from v2hdm.errors import AdjustError, ConfigError, MappingError, V2hdmError
from v2hdm.io.drive import join_drives
from v2hdm.mapping.changes.update import Base
from v2hdm.mapping.crew import ALONE, Crew
from v2hdm.mosaic.result import write_mosaic
from v2hdm.pipeline.base import changes_json, check_together, read_base
from v2hdm.pipeline.camera_sets import map_camera_sets
from v2hdm.pipeline.config import NO_DRIVE, RunConfig, admit
from v2hdm.pipeline.context import Progress, Unwatched, Viewer, log_file, logging_to, timed
from v2hdm.pipeline.detections import detect_in_pieces
from v2hdm.pipeline.evaluate import evaluate
from v2hdm.pipeline.finished import RunResult, note_finished
from v2hdm.pipeline.inspect import Inspection, inspect_each, join
from v2hdm.pipeline.keys import Contents, read_visits, result_key
from v2hdm.pipeline.result import BEST, describe_run, write_results
from v2hdm.pipeline.survey import Survey, check_survey, take_survey
from v2hdm.records import Drive, ImageDetections
from v2hdm.report.check_points import write_check_points
from v2hdm.report.outputs import result_folder, write_json
from v2hdm.report.page.write import write_page
from v2hdm.simulate import rendered_drive
from v2hdm.store.cache.pruning import make_room
from v2hdm.store.cache.room import Room
from v2hdm.store.cache.store import Store
from v2hdm.verdict import Finding, Status, Verdict
from v2hdm.verdict.results.known_sizes import check_known_sizes
from v2hdm.verdict.results.result import check_result

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Task:
    """A run while it is worked on; ``seconds`` says how long each step took."""

    config: RunConfig
    room: Room
    folder: Path
    about: Mapping[str, Any]
    seconds: dict[str, float]
    progress: Progress
    viewer: Viewer
    detect: Detect
    crew: Crew

    def result(self, metrics: Mapping[str, Any], headlines: Sequence[str], verdict: Verdict) -> RunResult:
        """What the run hands back."""
        return RunResult(Path(self.config.output) / self.about["name"], metrics, headlines, verdict)


def map_drives(
    config: RunConfig,
    store: Store,
    config_yaml: str,
    progress: Progress,
    viewer: Viewer | None = None,
    detect: Detect = detect_images,
    crew: Crew = ALONE,
) -> RunResult:
    """Do what :func:`v2hdm.pipeline.run.run` says, with what ``store`` keeps.

    ``detect`` takes the place of detection in processes of this machine, ``crew`` that of this process where
    work can be parted.
    """
    name = admit(config)
    base = None if config.map.base is None else read_base(Path(config.map.base))
    with store.in_use():
        with (
            result_folder(Path(config.output) / name) as folder,
            logging_to(log_file(folder / "run.log")),
        ):
            log.info("v2hdm %s, run %s", __version__, name)
            (folder / "config.yaml").write_text(config_yaml or f"{config!r}\n", encoding="utf-8")
            room = Room(store, config.resume)
            hands = viewer or Unwatched(), detect, crew
            result, key = _write(config, name, base, room, folder, progress, *hands)
            for line in result.verdict.lines:
                log.info("%s", line)
        note_finished(result, key, store)
        make_room(store.cache, config.cache_gb)
    return result


def _write(
    config: RunConfig,
    name: str,
    base: Base | None,
    room: Room,
    folder: Path,
    progress: Progress,
    viewer: Viewer,
    detect: Detect,
    crew: Crew,
) -> tuple[RunResult, str]:
    """Write a run's result into ``folder``; returns the key of what it was made of, too."""
    unknown = unknown_network(config.detector.model) if config.detector.model is not None else None
    if unknown is not None:
        log.warning("%s", unknown)
    seconds: dict[str, float] = {}
    paths = _drive_folders(config, seconds, progress)
    with timed(seconds, "read"):
        drives, contents = read_visits(config, paths, crew)
    for drive in drives:
        count, names = len(drive.images), ", ".join(drive.cameras)
        log.info("drive %s: %d images of cameras %s", drive.name, count, names)
    # What does not belong together is told before any long work.
    whole = join_drives(drives)
    if base is not None:
        check_together(base, whole, config.map.base or "")
    survey = take_survey(whole, config.mapping)
    key = result_key(config, drives, contents, room.key())
    about = describe_run(name, whole, paths, config.drive)
    mapped = replace(config, mapping=survey.mapping)
    task = _Task(mapped, room, folder, about, seconds, progress, viewer, detect, crew)
    with timed(seconds, "check"):
        max_gap_s, workers = config.drive.max_gap_s, _workers(config)
        inspection = join(inspect_each(drives, contents, max_gap_s, room, workers, progress, crew))
    try:
        return _map_and_judge(task, inspection, contents, survey, base), key
    except (MappingError, AdjustError) as failure:
        if not inspection.has_failed:
            raise
        return _without_map(task, inspection, failure), key


def _map_and_judge(
    task: _Task, inspection: Inspection, contents: Contents, survey: Survey, base: Base | None
) -> RunResult:
    """Detect, map, check and write."""
    config, drive, seconds, progress = task.config, inspection.drive, task.seconds, task.progress
    with closing(task.viewer):
        with timed(seconds, "detect"):
            task.viewer.begun(task.folder, drive)
            detections = _detect(task, drive, contents)
        with timed(seconds, "map"):
            hands = task.room, progress, task.viewer, task.crew
            sets = map_camera_sets(drive, contents.key(drive), detections, survey, base, *hands)
    methods = {name: one.methods for name, one in sets.items()}
    best, checked = list(methods.values())[-1][BEST], list(sets.values())[-1].checked
    with timed(seconds, "judge"):
        found = check_result(drive, methods, inspection.ground)
        surveyed = check_survey(survey, best, checked)
        unfit = check_known_sizes(config.mapping.known_sizes, best)
        verdict = Verdict.of([*inspection.findings, *found, *unfit, *surveyed])
    with timed(seconds, "evaluate"):
        described = inspection.drive_as_described
        judgement = evaluate(described, detections, methods, config.mapping, partial(progress, "evaluate"))
    changed = {} if best.changes is None else {"changes": changes_json(best.changes)}
    metrics = {**task.about, "verdict": verdict.as_json(), **judgement.metrics, **changed, "seconds": seconds}
    headlines = judgement.headlines
    if checked is not None:
        metrics["check_points"] = checked.figures()
        headlines = [*headlines, checked.headline]
        write_check_points(checked, task.folder / "check_points.csv")
    maps = (config.all_maps, config.export)
    write_results(task.folder, described, detections, methods, judgement, metrics, verdict, *maps)
    if config.mosaic:
        with timed(seconds, "mosaic"):
            tell = partial(progress, "mosaic")
            write_mosaic(task.folder, described, device=config.mapping.device, progress=tell)
    with timed(seconds, "report"):
        write_page(task.folder, described)
    return task.result(metrics, headlines, verdict)


def _without_map(task: _Task, inspection: Inspection, failure: V2hdmError) -> RunResult:
    """The result of a run whose checks failed and of which no map came."""
    failed = Finding("map", Status.FAIL, None, None, "", f"no map came of this drive: {failure}", "map")
    verdict = Verdict.of([*inspection.findings, failed])
    metrics = {**task.about, "verdict": verdict.as_json(), "results": {}}
    write_json(task.folder / "metrics.json", metrics)
    write_page(task.folder, inspection.drive_as_described)
    return task.result(metrics, (), verdict)


def _drive_folders(config: RunConfig, seconds: dict[str, float], progress: Progress) -> tuple[Path, ...]:
    if config.simulate is None:
        if not config.drive.paths:
            raise ConfigError(NO_DRIVE)
        return config.drive.paths
    if config.drive.paths:
        raise ConfigError(
            "both simulate and drive.path are set: a run renders a drive or reads one, remove one of them"
        )
    with timed(seconds, "render"):
        folder = rendered_drive(
            config.simulate, Path(config.cache), _workers(config), partial(progress, "render")
        )
    return (folder,)


def _detect(task: _Task, drive: Drive, contents: Contents) -> list[ImageDetections]:
    tell = partial(task.progress, "detect")
    workers = _workers(task.config)
    detections = detect_in_pieces(
        drive, contents, task.config.detector, task.room, workers, tell, task.detect, task.viewer.detected
    )
    markings = sum(len(found.markings) for found in detections)
    lanes = sum(len(found.lanes) for found in detections)
    log.info(
        "detected %d markings and %d pieces of lane paint in %d images", markings, lanes, len(detections)
    )
    return detections


def _workers(config: RunConfig) -> int:
    return config.workers or os.cpu_count() or 1
