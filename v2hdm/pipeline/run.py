"""From a drive to a map and a calibration: read, detect, associate, adjust, judge, write.

:func:`run` is the whole product as one call; it needs no terminal and knows nothing of Hydra.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import torch

from v2hdm import __version__
from v2hdm.detection.batch import detect_all
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.weights import unknown_network
from v2hdm.drive import ReadOptions, drive_name, join_drives, read_drive
from v2hdm.drive.truth import has_truth
from v2hdm.errors import AdjustError, ConfigError, MappingError, V2hdmError
from v2hdm.hdmap.formats import check_formats
from v2hdm.mapping.changes.update import Base
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import INCREMENTAL, MappingOptions, check_options
from v2hdm.orthophoto.result import write_mosaic
from v2hdm.pipeline.about import describe_run
from v2hdm.pipeline.base import changes_json, check_together, grey_reader, read_base
from v2hdm.pipeline.evaluate import CameraSets, evaluate
from v2hdm.pipeline.inspect import Inspection, inspect, join
from v2hdm.pipeline.survey import Survey, check_survey, table_of, take_survey
from v2hdm.pipeline.write import BEST, write_results
from v2hdm.quality import Finding, Status, Verdict
from v2hdm.quality.results.known_sizes import check_known_sizes
from v2hdm.quality.results.result import check_result
from v2hdm.records import Drive, ImageDetections
from v2hdm.report.check_points import write_check_points
from v2hdm.report.outputs import result_folder, write_json
from v2hdm.report.page.write import write_page
from v2hdm.settings import MOST_PROCESSES, NOT_NEGATIVE, POSITIVE, SEED, SHARE, Within, check_settings
from v2hdm.simulate import PortConfig, rendered_drive
from v2hdm.texts import shown, take_camera_name, take_name

log = logging.getLogger(__name__)

_NO_DRIVE = (
    "drive.path is not set: name the folder of the drive, e.g. drive.path=my_drive, "
    "or choose a run (+run=port1, +run=port2, +run=kitti drive.path=...)"
)

GROWTH_STEPS = 8
"""Sizes of the growing map at which its error is drawn."""


_RANGES = {
    "workers": Within(0, MOST_PROCESSES),
    "drive.max_gap_s": POSITIVE,
    **{f"drive.kitti.{name}": POSITIVE for name in ("camera_height_m", "centre_sigma_m", "roi_half_width_m")},
    "simulate.seed": SEED,
    "simulate.visit": NOT_NEGATIVE,
    "simulate.cameras.*.width": Within(64, 2**13),
    "simulate.cameras.*.height": Within(64, 2**13),
    "simulate.cameras.*.focal_px": Within(10, 1e5),
    "simulate.cameras.*.psf_sigma_px": NOT_NEGATIVE,
    "simulate.cameras.*.vignetting": SHARE,
    "simulate.cameras.*.distortion": Within(-2, 2),
    **{f"simulate.cameras.*.{mount}.z_m": Within(0.2, 20) for mount in ("mount", "borrowed_mount")},
    "simulate.route.pieces": Within(-1e5, 1e5),
    "simulate.route.image_spacing_m": Within(0.01, 1e3),
    "simulate.route.pose_rate_hz": Within(0.1, 1e4),
    "simulate.exposure.exposure_s": Within(0, 1),
    "simulate.exposure.level": Within(0, 1, open=True),
    "simulate.exposure.full_well_electrons": POSITIVE,
    **{
        f"simulate.disturbance.{name}": NOT_NEGATIVE
        for name in ("roll_pitch_deg", "heave_m", "rtk_white_m", "rtk_correlated_m", "heading_deg")
    },
    **{
        f"simulate.disturbance.{name}": POSITIVE
        for name in ("jitter_correlation_s", "rtk_correlation_m", "heading_correlation_s")
    },
    **{f"simulate.surface.{name}": SHARE for name in ("albedo", "wet_fraction")},
    **{f"simulate.surface.{name}": Within(0, 1e5) for name in ("patches", "oil_stains")},
    **{
        f"simulate.yard.{name}": Within(0, 1e4)
        for name in ("parked_trucks", "barriers", "lamp_posts", "moving_trucks", "shadow_strips")
    },
    "simulate.yard.haze_m": POSITIVE,
    "mapping.rounds": Within(1, 100),
}  # fmt: skip


class Progress(Protocol):
    """Told how far a named piece of long work is."""

    def __call__(self, task: str, done: int, total: int) -> None:
        """``done`` of ``total`` steps of ``task`` are finished."""


def silent(task: str, done: int, total: int) -> None:
    """A :class:`Progress` that shows nothing."""


@dataclass(kw_only=True)
class DriveConfig(ReadOptions):
    """Where the drive is, and how to read it: ``path`` is its folder or bag, None where it is rendered.

    A list of paths are drives through one site, which are mapped together (docs/living-map.md).
    """

    path: Any = None

    @property
    def paths(self) -> tuple[Path, ...]:
        """The paths, none where the drive is rendered.

        Raises:
            ConfigError: ``path`` is neither a path nor a list of them.
        """
        if not self.path:
            return ()
        listed = self.path if isinstance(self.path, list) else [self.path]
        wrong = [one for one in listed if not isinstance(one, str | Path) or not str(one)]
        if wrong:
            raise ConfigError(
                f"drive.path: {wrong[0]!r} is no path; give one, or a list as in [monday,friday]"
            )
        return tuple(Path(one) for one in listed)


@dataclass(kw_only=True)
class MapConfig:
    """The map that comes out: ``base`` is the map.geojson that the drive brings up to date, None for none."""

    base: str | None = None


@dataclass(kw_only=True)
class RunConfig:
    """Everything about one run.

    Attributes:
        name: names the results, ``<output>/<name>/``; None takes the drive's own name.
        drive: the drive to map, or several that are mapped together.
        map: an earlier map that the drive brings up to date, if there is one.
        simulate: renders the drive into the cache first, instead of reading ``drive.path``.
        detector: settings of the detector.
        mapping: settings of association, optimisation and lanes.
        output: folder that takes the results.
        cache: folder that keeps rendered drives and what is imported from bags and videos.
        workers: processes for rendering and detection; 0 takes one per core.
        device: what ``conf/map.yaml`` hands on as ``mapping.device``, ``cpu`` or ``cuda``.
        all_maps: whether the map of every method and camera set is written, into ``maps/``.
        mode: what it hands on as ``mapping.mode``, ``batch`` or ``incremental``.
        mosaic: whether the ground is shown from above, too (docs/mosaic.md).
        export: formats of the map: ``geojson``, ``csv``, ``gpkg``, ``lanelet2``, ``dxf`` (docs/exports.md).
    """

    name: str | None = None
    drive: DriveConfig = field(default_factory=DriveConfig)
    map: MapConfig = field(default_factory=MapConfig)
    simulate: PortConfig | None = None
    detector: DetectorOptions = field(default_factory=DetectorOptions.for_mapping)
    mapping: MappingOptions = field(default_factory=MappingOptions)
    output: str = "outputs"
    cache: str = "cache"
    workers: int = 0
    device: str = "cpu"
    mode: str = "batch"
    all_maps: bool = False
    mosaic: bool = False
    export: list[str] = field(default_factory=lambda: ["geojson"])


@dataclass(frozen=True)
class RunResult:
    """The folder of a run, ``metrics.json``'s content, sentences for a reader, and the verdict."""

    folder: Path
    metrics: Mapping[str, Any]
    headlines: Sequence[str]
    verdict: Verdict


class Detect(Protocol):
    """Finds what is in the images of a drive, as :func:`~v2hdm.detection.batch.detect_all` does."""

    def __call__(
        self,
        drive: Drive,
        options: DetectorOptions,
        workers: int,
        progress: Callable[[int, int], None],
    ) -> list[ImageDetections]:
        """``progress`` is told how many images are done, and of how many."""


def run(
    config: RunConfig, config_yaml: str = "", progress: Progress = silent, detect: Detect = detect_all
) -> RunResult:
    """Map one drive, or several together, and write the results to ``<output>/<name>/``, whole or not at all.

    Args:
        config: what to do.
        config_yaml: the configuration as text, kept beside the results.
        progress: told how far the long steps are.
        detect: takes the place of detection in processes of this machine.

    Raises:
        V2hdmError: The configuration, the drive or the detector is at fault, or no map can be made.
    """
    name = _check(config)
    seconds: dict[str, float] = {}
    base = None if config.map.base is None else read_base(Path(config.map.base))
    with (
        result_folder(Path(config.output) / name) as folder,
        logging_to(_log_file(folder / "run.log")),
    ):
        log.info("v2hdm %s, run %s", __version__, name)
        unknown = unknown_network(config.detector.model) if config.detector.model is not None else None
        if unknown is not None:
            log.warning("%s", unknown)
        (folder / "config.yaml").write_text(config_yaml or f"{config!r}\n", encoding="utf-8")
        paths = _drive_folders(config, seconds, progress)
        drives = [read_drive(path, config.drive) for path in paths]
        for drive in drives:
            count, names = len(drive.images), ", ".join(drive.cameras)
            log.info("drive %s: %d images of cameras %s", drive.name, count, names)
        # What does not belong together is told before any long work.
        whole = join_drives(drives)
        if base is not None:
            check_together(base, whole, config.map.base or "")
        survey = take_survey(whole, config.mapping)
        config = replace(config, mapping=survey.mapping)
        with _timed(seconds, "check"):
            inspection = join([_inspect(config, drive, len(drives), progress) for drive in drives])
        about = describe_run(name, whole, paths, config.drive)
        try:
            result = _map_and_judge(
                config, inspection, survey, base, folder, about, seconds, progress, detect
            )
        except (MappingError, AdjustError) as failure:
            if not inspection.has_failed:
                raise
            result = _without_map(config, inspection, failure, folder, about)
        for line in result.verdict.lines:
            log.info("%s", line)
    return result


def _inspect(config: RunConfig, drive: Drive, drives: int, progress: Progress) -> Inspection:
    task = "check" if drives == 1 else f"check {drive.name}"
    return inspect(drive, config.drive.max_gap_s, _workers(config), partial(progress, task))


def _map_and_judge(
    config: RunConfig,
    inspection: Inspection,
    survey: Survey,
    base: Base | None,
    folder: Path,
    about: Mapping[str, Any],
    seconds: dict[str, float],
    progress: Progress,
    detect: Detect,
) -> RunResult:
    """Detect, map, check and write."""
    drive = inspection.drive
    with _timed(seconds, "detect"):
        detections = _detect(config, drive, progress, detect)
    with _timed(seconds, "map"):
        methods = _map_camera_sets(config, drive, detections, base, progress)
    with _timed(seconds, "judge"):
        found = check_result(drive, methods, inspection.ground)
        checked, surveyed = check_survey(survey, drive, list(methods.values())[-1][BEST])
        unfit = check_known_sizes(config.mapping.known_sizes, list(methods.values())[-1][BEST])
        verdict = Verdict.of([*inspection.findings, *found, *unfit, *surveyed])
    with _timed(seconds, "evaluate"):
        described = inspection.drive_as_described
        judgement = evaluate(described, detections, methods, config.mapping, partial(progress, "evaluate"))
    changes = list(methods.values())[-1][BEST].changes
    changed = {} if changes is None else {"changes": changes_json(changes)}
    metrics = {**about, "verdict": verdict.as_json(), **judgement.metrics, **changed, "seconds": seconds}
    headlines = judgement.headlines
    if checked is not None:
        metrics["check_points"] = checked.figures()
        headlines = [*headlines, checked.headline]
        write_check_points(checked, folder / "check_points.csv")
    write_results(
        folder, described, detections, methods, judgement, metrics, verdict, config.all_maps, config.export
    )
    if config.mosaic:
        with _timed(seconds, "mosaic"):
            tell = partial(progress, "mosaic")
            write_mosaic(folder, described, device=config.mapping.device, progress=tell)
    with _timed(seconds, "report"):
        write_page(folder, described)
    return RunResult(Path(config.output) / about["name"], metrics, headlines, verdict)


def _without_map(
    config: RunConfig, inspection: Inspection, failure: V2hdmError, folder: Path, about: Mapping[str, Any]
) -> RunResult:
    """The result of a run whose checks failed and of which no map came."""
    failed = Finding("map", Status.FAIL, None, None, "", f"no map came of this drive: {failure}", "map")
    verdict = Verdict.of([*inspection.findings, failed])
    metrics = {**about, "verdict": verdict.as_json(), "results": {}}
    write_json(folder / "metrics.json", metrics)
    write_page(folder, inspection.drive_as_described)
    return RunResult(Path(config.output) / about["name"], metrics, (), verdict)


def camera_sets(drive: Drive) -> dict[str, tuple[str, ...]]:
    """Each camera alone and all together: named ``both`` for two cameras, ``all`` for more."""
    names = tuple(drive.cameras)
    sets: dict[str, tuple[str, ...]] = {name: (name,) for name in names}
    if len(names) > 1:
        sets["both" if len(names) == 2 else "all"] = names
    return sets


def _drive_folders(config: RunConfig, seconds: dict[str, float], progress: Progress) -> tuple[Path, ...]:
    if config.simulate is None:
        if not config.drive.paths:
            raise ConfigError(_NO_DRIVE)
        return config.drive.paths
    if config.drive.paths:
        raise ConfigError(
            "both simulate and drive.path are set: a run renders a drive or reads one, remove one of them"
        )
    with _timed(seconds, "render"):
        folder = rendered_drive(
            config.simulate, Path(config.cache), _workers(config), partial(progress, "render")
        )
    return (folder,)


def _detect(config: RunConfig, drive: Drive, progress: Progress, detect: Detect) -> list[ImageDetections]:
    detections = detect(drive, config.detector, _workers(config), partial(progress, "detect"))
    markings = sum(len(found.markings) for found in detections)
    lanes = sum(len(found.lanes) for found in detections)
    log.info(
        "detected %d markings and %d pieces of lane paint in %d images", markings, lanes, len(detections)
    )
    return detections


def _map_camera_sets(
    config: RunConfig,
    drive: Drive,
    detections: Sequence[ImageDetections],
    base: Base | None,
    progress: Progress,
) -> CameraSets:
    sets = camera_sets(drive)
    found = {}
    for done, (name, cameras) in enumerate(sets.items()):
        progress("map", done, len(sets))
        # The picture of the growing map is drawn for the whole rig, which comes last, and needs truth.
        last = done == len(sets) - 1
        growth_steps = GROWTH_STEPS if last and has_truth(drive) else 0
        tell, begin_s = partial(log.debug, "%s: %s", name), time.perf_counter()
        found[name] = run_methods(
            drive,
            detections,
            cameras,
            config.mapping,
            tell,
            growth_steps,
            base if last else None,
            grey_reader(drive),
        )
        if not last:
            # The factors of the adjustment are large, and only the whole rig's map is checked.
            found[name]["Opt"] = replace(found[name]["Opt"], corners=None)
        took_s = time.perf_counter() - begin_s
        log.info("mapped with %s: %d markings, %.1f s", name, len(found[name]["Opt"].hd_map.markings), took_s)
        for exclusion in found[name]["Opt"].excluded:
            where = ", ".join(f"{value:.2f}" for value in exclusion.position_map)
            log.debug("%s: left out a %s at (%s): %s", name, exclusion.kind, where, exclusion.reason)
    progress("map", len(sets), len(sets))
    return found


def _check(config: RunConfig) -> str:
    """Refuse what cannot work before any long work; returns the run's name.

    Raises:
        ConfigError: The message names the key.
        DetectorError: ``detector.model`` cannot be used.
    """
    name = run_name(config)
    take_name(name, "name", ConfigError)
    if config.simulate is not None:
        take_name(config.simulate.name, "simulate.name", ConfigError)
        for camera in config.simulate.cameras:
            take_camera_name(camera, "simulate.cameras", ConfigError)
    check_settings(config, _RANGES)
    detector = Detector.load(options=config.detector)
    check_options(config.mapping, detector.catalogue.cornered)
    table_of(config.mapping.survey)
    check_formats(config.export, "export")
    if config.mosaic and len(config.drive.paths) > 1:
        raise ConfigError(
            "mosaic=true puts the images of one drive on the ground; map the drives one by one for it"
        )
    if config.map.base is not None and config.mapping.mode == INCREMENTAL:
        raise ConfigError("mode=incremental makes a map of one drive alone; update map.base with mode=batch")
    if len(config.drive.paths) > 1 and config.mapping.mode == INCREMENTAL:
        raise ConfigError(
            "mode=incremental maps one drive as the vehicle would; map several with mode=batch, or one by "
            "one with map.base"
        )
    check_device(config.mapping.device)
    return name


def run_name(config: RunConfig) -> str:
    """The name of the run: as configured, else that of the drive which is to be rendered or read."""
    if config.name is not None:
        return config.name
    if config.simulate is not None:
        return config.simulate.name
    if not config.drive.paths:
        raise ConfigError(_NO_DRIVE)
    return "+".join(drive_name(path) for path in config.drive.paths)


def check_device(device: str) -> None:
    """Refuse a device of torch that is not ``cpu`` or ``cuda``, or not there.

    Raises:
        ConfigError: says which.
    """
    if device not in ("cpu", "cuda"):
        raise ConfigError(f"device is {shown(device)}: choose cpu or cuda")
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            "device is 'cuda' but torch sees no GPU: check the driver and torch build, or set device=cpu"
        )


def _workers(config: RunConfig) -> int:
    return config.workers or os.cpu_count() or 1


@contextmanager
def _timed(seconds: dict[str, float], step: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[step] = round(time.perf_counter() - start, 2)
    log.info("%s: %.1f s", step, seconds[step])


@contextmanager
def logging_to(handler: logging.Handler) -> Iterator[None]:
    """Send this library's log to ``handler`` as well, for as long as the block runs."""
    logger = logging.getLogger("v2hdm")
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        handler.close()


class _LogFile(logging.FileHandler):
    """A log that is part of a result: where it cannot be written, the result cannot."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        """Raise what went wrong; logging itself would print a traceback and go on."""
        raise


def _log_file(path: Path) -> logging.Handler:
    handler = _LogFile(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    return handler
