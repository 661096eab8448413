"""From a drive to a map, calibrations and a verdict: the stages of docs/design.md, one line each."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch  # noqa: F401  # its absence is reported before that of what is built on it

from v2hdm.adjust.ahead import compiled_meanwhile
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.weights import unknown_network
from v2hdm.doors import checked
from v2hdm.errors import AdjustError, ConfigError, MappingError
from v2hdm.executor import open_executor
from v2hdm.io.drive import ReadOptions, as_drive, join_drives
from v2hdm.io.maps.corrections import Correction, Heard, read_corrections
from v2hdm.mapping.options import AUTO, MappingOptions, check_options
from v2hdm.pipeline.answers import with_answers
from v2hdm.pipeline.base import changes_json, check_together, read_base
from v2hdm.pipeline.config import ACCURACY_GOAL_CM, Contents, check_choice
from v2hdm.pipeline.context import Context
from v2hdm.pipeline.evaluate import CameraSets, evaluate
from v2hdm.pipeline.grades import accurate_enough, graded_sets, of_all_grades, with_composed
from v2hdm.pipeline.inspect import Inspection, inspect_each, join
from v2hdm.pipeline.result import Result, describe_run
from v2hdm.pipeline.stages import MappedSet, detect_in_pieces, map_camera_sets, methods_of
from v2hdm.progress import Progress, silent
from v2hdm.records import BEST, Drive, ImageDetections
from v2hdm.settings import Processes
from v2hdm.site.living.changes import Base
from v2hdm.store.cache import StageCache
from v2hdm.survey.run import Survey, check_survey, take_survey
from v2hdm.verdict import Finding, Status, Verdict
from v2hdm.verdict.results.accuracy import check_corrections, check_goal, check_known_sizes, told_once
from v2hdm.verdict.results.solution import check_result, over_ground, told_by_poses

if TYPE_CHECKING:
    from v2hdm.detection.detector import Detector

_log = logging.getLogger(__name__)

Source = Drive | Path | str

_TOLD_CORRECTIONS = 20  # corrections that the terminal lists: a screen


@dataclass(frozen=True)
class Read:
    """Drives as they were read, as one, and the digests of their images."""

    drives: tuple[Drive, ...]
    whole: Drive
    contents: Contents


@checked
def map_drive(
    drive: Source | Iterable[Source],
    *,
    options: MappingOptions | None = None,
    detector: Detector | DetectorOptions | None = None,
    reading: ReadOptions | None = None,
    base: Path | str | None = None,
    corrections: Path | str | None = None,
    accuracy_goal_cm: float = ACCURACY_GOAL_CM,
    name: str | None = None,
    cache: Path | str | None = None,
    progress: Progress = silent,
    workers: Processes = 0,
    context: Context | None = None,
    all_maps: bool = False,
    section_m: float = 0.0,
) -> Result:
    """Map a drive, or several drives through one site together; only ``cache`` is written to.

    Args:
        drive: the drive or its folder, or several.
        options: settings of association, adjustment and lanes.
        detector: the detector, or its settings.
        reading: how folders are read.
        base: the map.geojson of an earlier result, which the drive brings up to date.
        corrections: the file of what a person says of an earlier map of the drive (``v2hdm view``).
        accuracy_goal_cm: the 95 % radius, cm, within which map and calibrations have to be known for a PASS;
            it grades the accuracy of every marking.
        name: of the result; None takes that of the drive.
        cache: folder that keeps what each stage has found for the next call; None keeps nothing.
        progress: shows how far the long steps are, ``progress(task, done, total)``.
        workers: processes; 0 takes one per core.
        context: takes the place of ``cache``, ``progress`` and ``workers``.
        all_maps: whether to map with each camera alone and by the naive methods, too, for a comparison.
        section_m: way, m, of the sections in which a long drive is mapped, so that memory does not grow with
            it; 0 maps all at once.

    Returns:
        Map (east, north, up; m), calibrations, trajectory, and the verdict as data: a FAIL raises nothing.

    Raises:
        DriveError, MapFileError, DetectorError, ConfigError: an argument cannot be used.
        MappingError: there is nothing to map, although no check of the drive has failed.

    >>> result = map_drive(port, accuracy_goal_cm=10.0, workers=1)
    >>> result.verdict.status.value, result.calibrations["front"].cam_from_vehicle.shape
    ('PASS', (4, 4))
    """
    stated = [] if corrections is None else read_corrections(Path(corrections))
    options = _options_of(options or MappingOptions(), stated)
    sources = _sources_of(drive)
    check_choice(options, len(sources), base is not None, accuracy_goal_cm, section_m)
    if section_m and all_maps:
        raise ConfigError("map.section_m and all_maps are both set: sections make the one map; drop one")
    task = _Task(name, base, detector, accuracy_goal_cm, all_maps, section_m)
    with nullcontext(context) if context else _own_context(cache, progress, workers) as context:
        return with_answers(_map(sources, options, reading or ReadOptions(), task, context), stated)


class _Task(NamedTuple):
    """The request of a call of :func:`map_drive`, besides the settings of reading and mapping."""

    name: str | None
    base: Path | str | None
    detector: Detector | DetectorOptions | None
    goal_cm: float
    all_maps: bool
    section_m: float


def _map(
    sources: Sequence[Source], options: MappingOptions, reading: ReadOptions, task: _Task, context: Context
) -> Result:
    """Read, check and map the drives."""
    read = read_all(sources, reading, context)
    earlier = _earlier(task.base, read.whole, context)
    survey = take_survey(read.whole, options)
    with context.timed("check"):
        inspection = join(inspect_each(read.drives, read.contents, reading.max_gap_s, context))
    paths = [source.root if isinstance(source, Drive) else Path(source) for source in sources]
    about = describe_run(task.name or read.whole.name, read.whole, read.contents, paths, reading)
    described = inspection.drive_as_described
    mapped_so_far = Result(about, read.drives, read.contents, described, context.seconds, options.device)
    return _mapped(mapped_so_far, inspection, survey, earlier, task, context)


@contextmanager
def _own_context(cache: Path | str | None, progress: Progress, workers: int) -> Iterator[Context]:
    """The context of a run without one."""
    if cache is not None and Path(cache).is_file():
        raise ConfigError(f"cache {cache}: is a file; give a folder")
    stages = StageCache(None if cache is None else Path(cache))
    with open_executor(workers) as executor:
        yield Context(stages, progress, executor=executor, workers=workers)


def _options_of(options: MappingOptions, stated: Sequence[Correction]) -> MappingOptions:
    """The checked options, with the corrections of paint that a person has stated, if any."""
    if stated:
        of_paint = [correction for correction in stated if not correction.is_answer]
        options = replace(options, acceptance=replace(options.acceptance, corrections=of_paint))
    check_options(options)
    return options


def _sources_of(drive: Source | Iterable[Source]) -> list[Source]:
    sources = [drive] if isinstance(drive, Source) else list(drive)
    if not sources:
        raise ConfigError("map_drive: no drive is given; give one, or a list of them")
    return sources


def _earlier(base: Path | str | None, drive: Drive, context: Context) -> Base | None:
    """The earlier map, which must be of the drive's frame; the context has looked at the drive before."""
    context.accept(drive)
    if base is None:
        return None
    earlier = read_base(Path(base))
    check_together(earlier, drive, str(base))
    return earlier


def _mapped(
    mapped_so_far: Result,
    inspection: Inspection,
    survey: Survey,
    earlier: Base | None,
    task: _Task,
    context: Context,
) -> Result:
    """The result of a drive that was read and checked."""
    from v2hdm.pipeline.paint import with_paint  # those who only check a drive do without

    detector = DetectorOptions.for_mapping() if task.detector is None else task.detector
    settings = detector if isinstance(detector, DetectorOptions) else detector.options
    try:
        with compiled_meanwhile(survey.mapping.device):
            # Where sections read them for themselves, detections of the whole drive would fill the memory.
            detections = (
                []
                if task.section_m and not inspection.drive.has_pictures
                else _detect(inspection.drive, mapped_so_far.contents, settings, context)
            )
        with context.timed("map"):
            key = mapped_so_far.contents.key(inspection.drive)
            all_grades = of_all_grades(survey)
            mapped = map_camera_sets(
                inspection.drive,
                key,
                detections,
                all_grades,
                earlier,
                context,
                compare=task.all_maps,
                section_m=task.section_m,
            )
            sets = graded_sets(mapped, task.goal_cm / 100)
        acceptance = survey.mapping.acceptance
        sets = with_paint(sets, inspection.drive, earlier, acceptance.corrections, context)
        chosen = accurate_enough(methods_of(sets), acceptance.accuracy, acceptance.corrections)
        chosen = with_composed(chosen, task.goal_cm / 100)
    except (MappingError, AdjustError) as failure:
        if all(finding.status is not Status.FAIL for finding in inspection.findings):
            raise
        failed = Finding("map", Status.FAIL, None, None, "", f"this drive gave no map: {failure}", "map")
        verdict = Verdict.of([*inspection.findings, failed])
        return replace(mapped_so_far, verdict=verdict, figures={"results": {}})
    return _judge(mapped_so_far, inspection, detections, sets, chosen, survey, task.goal_cm, context)


def read_all(sources: Sequence[Source], options: ReadOptions, context: Context) -> Read:
    """Read several drives and join them; raises DriveError."""
    with context.timed("read"):
        drives = tuple(as_drive(source, options) for source in sources)
        contents = Contents.of(drives)
    for drive in drives:
        _log.info("drive %s: %d images of %s", drive.name, len(drive.images), ", ".join(drive.cameras))
    return Read(drives, join_drives(drives), contents)


def _detect(
    drive: Drive, contents: Contents, options: DetectorOptions, context: Context
) -> list[ImageDetections]:
    unknown = unknown_network(options.model) if options.model is not None else None
    if unknown is not None:
        _log.warning("%s", unknown)
    with context.timed("detect"):
        detections = detect_in_pieces(drive, contents, options, context, context.detect)
    markings = sum(len(in_image.markings) for in_image in detections)
    lanes = sum(len(in_image.lanes) for in_image in detections)
    _log.info("detected %d markings, %d pieces of lane paint in %d images", markings, lanes, len(detections))
    return detections


def _told_of_corrections(heard: Sequence[Heard]) -> list[str]:
    """Lines on the corrections that the map follows; the log and metrics.json list all."""
    for correction in heard:
        _log.info("%s", f"correction followed: {correction.sentence}")  # "%s": not in the terminal
    lines = [f"correction followed: {correction.sentence}" for correction in heard[:_TOLD_CORRECTIONS]]
    more = len(heard) - len(lines)
    return [*lines, f"and {more} more corrections, see metrics.json"] if more else lines


def _judge(
    result: Result,
    inspection: Inspection,
    detections: Sequence[ImageDetections],
    sets: dict[str, MappedSet],
    chosen: CameraSets,
    survey: Survey,
    goal_cm: float,
    context: Context,
) -> Result:
    """The result, of the maps ``chosen``; everything that was mapped is evidence on the inputs."""
    methods = methods_of(sets)
    best = list(methods.values())[-1][BEST]
    check_points = list(sets.values())[-1].checked
    with context.timed("judge"):
        solved_findings = check_result(inspection.drive, best, inspection.ground)
        result_findings = told_by_poses(solved_findings, inspection.findings)
        unfit_findings = check_known_sizes(survey.mapping.known_sizes, best)
        unfit_findings += check_corrections(survey.mapping.acceptance.corrections, best)
        frame = "survey" if best.diagnostics["control_points"] else "poses"
        of_goal = check_goal(list(chosen.values())[-1][BEST], goal_cm / 100, frame)
        result_findings, goal_findings = told_once(result_findings, of_goal)
        survey_findings = check_survey(survey, best, check_points)
        input_findings = over_ground(inspection.findings, best, survey.mapping.ground == AUTO)
        verdict = Verdict.of(
            [*input_findings, *result_findings, *unfit_findings, *survey_findings, *goal_findings]
        )
    with context.timed("evaluate"):
        metrics, headlines = evaluate(result.drive, chosen)
    changes = {} if best.changes is None else {"changes": changes_json(best.changes)}
    figures = {**metrics, **changes, "seconds": context.seconds}
    if best.heard:
        figures["corrections"] = [asdict(heard) for heard in best.heard]
        headlines += _told_of_corrections(best.heard)
    if check_points is not None:
        figures["check_points"] = check_points.figures()
        headlines.append(check_points.headline)
    return replace(
        result,
        verdict=verdict,
        figures=figures,
        headlines=headlines,
        detections=tuple(detections),
        methods=chosen,
        check_points=check_points,
    )
