"""The settings of a run, what of them is refused before any long work, and the keys of what it makes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import ConfigError, DriveError, need
from v2hdm.io.drive import ReadOptions, drive_name
from v2hdm.io.maps.corrections import read_corrections
from v2hdm.io.maps.formats import check_formats
from v2hdm.mapping.options import INCREMENTAL, MappingOptions, check_options
from v2hdm.records import Drive, Image
from v2hdm.safe.texts import shown, take_camera_name, take_name
from v2hdm.settings import COUNT, MOST_PROCESSES, NOT_NEGATIVE, POSITIVE, SEED, SHARE, Within, check_settings
from v2hdm.simulate import PortConfig
from v2hdm.store import names
from v2hdm.store.cache import key_of
from v2hdm.store.files import file_digest

ACCURACY_GOAL_CM = 5.0  # the 95 % radius, cm, that is asked of a map where nobody states another

NO_DRIVE = (
    "drive.path is not set: name the folder of the drive, e.g. drive.path=my_drive, "
    "or choose a run (+run=port1, +run=port2, +run=kitti drive.path=...)"
)


@dataclass(kw_only=True)
class DriveConfig(ReadOptions):
    """The drive and how to read it.

    ``path`` is the drive's folder or bag, or a list of drives through one site, which are mapped together
    (docs/living-map.md). None if the drive is rendered.
    """

    path: Any = None

    @property
    def paths(self) -> tuple[Path, ...]:
        """The paths, none if the drive is rendered; raises ConfigError for anything that is not a path."""
        if not self.path:
            return ()
        listed = self.path if isinstance(self.path, list) else [self.path]
        wrong = [one for one in listed if not isinstance(one, str | Path) or not str(one)]
        if wrong:
            raise ConfigError(f"drive.path: {wrong[0]!r} is not a path; give one, or a list: [monday,friday]")
        return tuple(Path(one) for one in listed)


@dataclass(kw_only=True)
class MapConfig:
    """The map to update or correct; None for none.

    ``base`` is the map.geojson that the drive brings up to date.
    ``corrections`` is a file of corrections to an earlier map of the same drive (``v2hdm view``).
    """

    base: str | None = None
    corrections: str | None = None


@dataclass(kw_only=True)
class ReportConfig:
    """The report; ``background`` is a GeoTIFF or a folder of XYZ tiles under its map, None for none."""

    background: str | None = None


@dataclass(kw_only=True)
class RunConfig:
    """Everything about one run.

    Attributes:
        name: name of the results folder, ``<output>/<name>/``; None takes the drive's own name.
        drive: the drive to map, or several that are mapped together.
        map: an earlier map to bring up to date, if there is one.
        report: contents of the report (docs/report.md).
        simulate: a port to render into the cache and map, instead of reading ``drive.path``.
        detector: settings of the detector.
        mapping: settings of association, optimisation and lanes.
        output: folder for the results, or the URL of one in an object store (docs/fleet.md).
        cache: folder for rendered drives, imports from bags and videos, and the results of each stage,
            which later runs reuse (docs/cache.md).
        cache_gb: size limit of the cache, GB (10^9 bytes); least recently used entries go first.
        resume: whether to reuse results of earlier runs whose inputs have not changed; false recomputes
            everything.
        workers: number of processes for rendering and detection; 0 for one per core.
        device: where the adjustment runs, ``cpu`` or ``cuda``; the same as ``mapping.device``.
        all_maps: whether to write the map of every method and camera set, into ``maps/``.
        mode: ``batch`` or ``incremental``; the same as ``mapping.mode``.
        accuracy_goal_cm: 95 % of the corners, and the calibrations, must be known to this radius, cm, at
            95 %, else the verdict is WARN (docs/verdict.md).
        mosaic: whether to show the ground of a single drive from above (docs/report.md).
        export: formats of the map (``geojson``, ``gpkg``, ``lanelet2``, ...) and of the ground (``geotiff``,
            ``opencrg``; docs/exports.md).
        crs: coordinate system of exports, such as ``EPSG:25832``, or ``local``; ``map.geojson`` keeps its
            longitude and latitude.
    """

    name: str | None = None
    drive: DriveConfig = field(default_factory=DriveConfig)
    map: MapConfig = field(default_factory=MapConfig)
    report: ReportConfig = field(default_factory=ReportConfig)
    simulate: PortConfig | None = None
    detector: DetectorOptions = field(default_factory=DetectorOptions.for_mapping)
    mapping: MappingOptions = field(default_factory=MappingOptions)
    output: str = "outputs"
    cache: str = "cache"
    cache_gb: float = 50.0
    resume: bool = True
    workers: int = 0
    device: str = "cpu"
    mode: str = "batch"
    accuracy_goal_cm: float = ACCURACY_GOAL_CM
    all_maps: bool = False
    mosaic: bool = True
    export: list[str] = field(default_factory=lambda: ["geojson"])
    crs: str | None = None


def run_name(config: RunConfig) -> str:
    """The name of the run: as configured, else that of the drive to be rendered or read."""
    if config.name is not None:
        return config.name
    if config.simulate is not None:
        return config.simulate.name
    if not config.drive.paths:
        raise ConfigError(NO_DRIVE)
    return "+".join(drive_name(path) for path in config.drive.paths)


_KEYS_WITHIN: tuple[tuple[Within, str, str], ...] = (
    (Within(0, MOST_PROCESSES), "", "workers"),
    (NOT_NEGATIVE, "", "cache_gb drive.start_s simulate.session"),
    (POSITIVE, "drive.", "max_gap_s end_s kitti.camera_height_m kitti.centre_sigma_m"),
    (COUNT, "drive.", "limit"),
    (SEED, "simulate.", "seed"),
    (Within(64, 2**13), "simulate.cameras.*.", "width height"),
    (Within(10, 1e5), "simulate.cameras.*.", "focal_px"),
    (NOT_NEGATIVE, "simulate.cameras.*.", "psf_sigma_px"),
    (SHARE, "simulate.cameras.*.", "vignetting"),
    (Within(-2, 2), "simulate.cameras.*.", "distortion"),
    (Within(0.2, 20), "simulate.cameras.*.", "mount.z_m borrowed_mount.z_m"),
    (Within(-1e5, 1e5), "simulate.route.", "pieces"),
    (Within(0.01, 1e3), "simulate.route.", "image_spacing_m speed_mps"),
    (Within(0.1, 1e4), "simulate.route.", "pose_rate_hz"),
    (Within(0, 1), "simulate.exposure.", "exposure_s"),
    (Within(0, 1, open=True), "simulate.exposure.", "level"),
    (POSITIVE, "simulate.exposure.", "full_well_electrons"),
    (NOT_NEGATIVE, "simulate.disturbance.", "roll_pitch_deg heave_m heading_deg rtk_white_m"),
    (NOT_NEGATIVE, "simulate.disturbance.", "rtk_correlated_m"),
    (NOT_NEGATIVE, "simulate.calibration.", "survey_sigma_m click_sigma_px centre_sigma_m"),
    (POSITIVE, "simulate.disturbance.", "jitter_correlation_s rtk_correlation_m heading_correlation_s"),
    (SHARE, "simulate.paint.", "wear dirt"),
    (NOT_NEGATIVE, "simulate.paint.", "placing_sigma_m placing_sigma_deg dash_gap_m"),
    (POSITIVE, "simulate.paint.", "diamond_length_m diamond_width_m line_width_m"),
    # Closer, a port's paint would never be finished.
    (Within(0.1), "simulate.paint.", "dash_length_m diamond_spacing_m arrow_spacing_m lettering_spacing_m"),
    (Within(0.1), "simulate.paint.", "stop_line_spacing_m"),
    (SHARE, "simulate.surface.", "albedo wet_fraction"),
    (NOT_NEGATIVE, "simulate.surface.", "contrast stains joint_width_m tyre_marks"),
    # Steeper, a vehicle would slide; a higher kerb is a wall.
    (Within(0, 0.15), "simulate.relief.", "grade crown ramp bank"),
    (Within(0, 0.3), "simulate.relief.", "gully_m kerb_m"),
    (NOT_NEGATIVE, "simulate.relief.", "ramp_at_m"),
    (Within(1), "simulate.relief.", "ramp_length_m"),
    (Within(1, 15), "simulate.relief.", "gully_offset_m kerb_offset_m"),
    (NOT_NEGATIVE, "simulate.yard.", "stack_fill stack_clearance_m sun_strength"),
    (NOT_NEGATIVE, "simulate.exposure.", "level_sigma read_noise"),
    (Within(0, 1e5), "simulate.surface.", "patches oil_stains"),
    (Within(0, 1e4), "simulate.yard.", "parked_trucks barriers lamp_posts moving_trucks shadow_strips"),
    (POSITIVE, "simulate.yard.", "haze_m"),
    (Within(1, 100), "mapping.", "rounds"),
)
_RANGES = {f"{below}{key}": allowed for allowed, below, keys in _KEYS_WITHIN for key in keys.split()}


def admit(config: RunConfig) -> str:
    """Raise ConfigError, which names the key, for settings that cannot work; returns the run's name."""
    from v2hdm.detection.detector import Detector
    from v2hdm.survey.run import table_of

    name = run_name(config)
    take_name(name, "name", ConfigError)
    if config.simulate is not None:
        take_name(config.simulate.name, "simulate.name", ConfigError)
        for camera in config.simulate.cameras:
            take_camera_name(camera, "simulate.cameras", ConfigError)
    check_settings(config, _RANGES)
    # Wherever the detector will run, it can be looked at here.
    detector = Detector.load(options=replace(config.detector, device="cpu"))
    check_options(config.mapping, detector.catalogue.cornered)
    table_of(config.mapping.survey)
    if config.map.corrections is not None:
        read_corrections(Path(config.map.corrections))
    check_formats(config.export, "export")
    if config.report.background is not None:
        need("rasterio", "gis", "report.background", ConfigError)
        if not Path(config.report.background).exists():
            raise ConfigError(f"report.background: no file or folder {config.report.background}")
        from v2hdm.report.page.layers import open_background

        with open_background(Path(config.report.background)):
            pass  # an unreadable one is refused here, not after minutes of mapping
    has_base = config.map.base is not None
    check_choice(config.mapping, len(config.drive.paths), has_base, config.accuracy_goal_cm)
    return name


def check_choice(options: MappingOptions, drives: int, has_base: bool, goal_cm: float) -> None:
    """Raise ConfigError where settings do not go with so many drives, with an earlier map, or here."""
    if not 0 < goal_cm < math.inf:
        raise ConfigError(f"accuracy_goal_cm is {goal_cm}: set {POSITIVE}")
    if has_base and options.mode == INCREMENTAL:
        raise ConfigError("mode=incremental makes a map of one drive alone; update map.base with mode=batch")
    if drives > 1 and options.mode == INCREMENTAL:
        raise ConfigError("mode=incremental maps one drive, as on the vehicle; map several with batch")
    check_device(options.device)


def check_device(device: str) -> None:
    """Raise ConfigError for a device of torch that is not ``cpu`` or ``cuda``, or not there."""
    import torch

    if device not in ("cpu", "cuda"):
        raise ConfigError(f"device is {shown(device)}: choose cpu or cuda")
    if device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device is 'cuda' but torch sees no GPU: check driver and torch, or set device=cpu")


@dataclass(frozen=True)
class Contents:
    """SHA-256 of image files, by path."""

    digests: Mapping[Path, str]

    @classmethod
    def of(cls, drives: Iterable[Drive]) -> Contents:
        """Digests of all images of some drives; raises DriveError where one cannot be read."""
        try:
            return cls({image.path: file_digest(image.path) for drive in drives for image in drive.images})
        except OSError as failure:
            raise DriveError(f"{failure.filename}: cannot be read ({failure.strerror})") from None

    def of_images(self, images: Iterable[Image]) -> list[str]:
        """Digests of some images, in their order."""
        return [self.digests[image.path] for image in images]

    def key(self, drive: Drive) -> str:
        """The key of a drive: its records and the content of its images."""
        return key_of(drive, self.of_images(drive.images))


def model_key(options: DetectorOptions) -> str | None:
    """SHA-256 of the network that a detector uses, None for the shipped one, which is code."""
    return None if options.model is None else file_digest(Path(options.model))


def base_files(path: Path) -> tuple[Path, tuple[Path, ...], Path]:
    """The map, trajectories and exclusions of an earlier map, given as a folder or its ``map.geojson``."""
    hd_map = names.map_file(path)
    trajectories = sorted(hd_map.parent.glob(names.TRAJECTORIES))
    return hd_map, tuple(trajectories), hd_map.parent / names.EXCLUDED


def made_of_drives(paths: Sequence[str]) -> str:
    """Name the maker of a result of the drives at these paths."""
    return f"v2hdm map of {', '.join(paths)}"


def result_key(config: RunConfig, drives: Sequence[Drive], contents: Contents, code: str) -> str:
    """The key of a run's whole result: all that it depends on, and nothing else; ``code`` is the code's."""
    asked = replace(
        config, name=run_name(config), output="", cache="", cache_gb=0.0, resume=True,
        workers=0, drive=replace(config.drive, path=None, cache=""),
    )  # fmt: skip
    files: list[Path] = []
    if config.map.base is not None:
        hd_map, trajectories, excluded = base_files(Path(config.map.base))
        files += [hd_map, *trajectories, excluded]
    named = (config.mapping.survey.file, config.map.corrections, config.report.background)
    files += [Path(one) for one in named if one is not None]
    truths = [drive.truth_dir for drive in drives if drive.truth_dir is not None]
    files += [path for truth in truths for path in sorted(truth.rglob("*"))]
    read = [(str(path), file_digest(path)) for path in files if path.is_file()]
    of_drives = [contents.key(drive) for drive in drives]
    roots = [drive.root.resolve() for drive in drives]
    return key_of(code, asked, model_key(config.detector), roots, of_drives, read)
