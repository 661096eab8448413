"""The settings of a run, what of them is refused before any long work, and the keys of what it makes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import ConfigError, DriveError, need
from v2hdm.executor import check_cluster
from v2hdm.io.drive import ReadOptions, drive_name
from v2hdm.mapping.options import (
    BATCH,
    INCREMENTAL,
    SHORTEST_SECTION_M,
    MappingOptions,
    check_options,
    check_sections,
)
from v2hdm.records import Drive, Image
from v2hdm.report.job import Job, check_job
from v2hdm.safe.texts import shown, take_camera_name, take_name
from v2hdm.settings import MOST_PROCESSES, NOT_NEGATIVE, POSITIVE, Within, check_settings
from v2hdm.simulate.port.config import PortConfig
from v2hdm.store import names
from v2hdm.store.cache import key_of
from v2hdm.store.files import file_digest, refuse_url

ACCURACY_GOAL_CM = 5.0  # the 95 % radius, cm, that is asked of a map where nobody states another

NO_DRIVE = (
    "drive.path is not set: name the folder of the drive, e.g. drive.path=my_drive, "
    "or choose a run (+run=port1, +run=port2, +run=kitti drive.path=...)"
)


@dataclass(kw_only=True)
class DriveConfig(ReadOptions):
    """The drive and how to read it; ``path`` is None if the drive is rendered."""

    path: Annotated[
        Any,
        "the drive's folder or bag, or a list of drives through one site, which are mapped together "
        "(docs/living-map.md).",
    ] = None

    @property
    def paths(self) -> tuple[Path, ...]:
        """The paths, none if the drive is rendered; raises ConfigError for anything that is not a path."""
        if not self.path:
            return ()
        listed = self.path if isinstance(self.path, list) else [self.path]
        wrong = [path for path in listed if not isinstance(path, str | Path) or not str(path)]
        if wrong:
            raise ConfigError(f"drive.path: {wrong[0]!r} is not a path; give one, or a list: [monday,friday]")
        for path in listed:
            refuse_url(Path(path))
        return tuple(Path(path) for path in listed)


@dataclass(kw_only=True)
class MapConfig:
    """The map to update or correct; None for none."""

    base: Annotated[str | None, "the map.geojson that the drive brings up to date."] = None
    corrections: Annotated[
        str | None, "a file of corrections to an earlier map of the same drive (v2hdm view)."
    ] = None
    section_m: Annotated[
        float,
        NOT_NEGATIVE,
        "way, m, of the sections in which a long drive, or a network, is mapped and then adjusted together; "
        "0 maps all at once (docs/fleet.md#a-whole-network).",
    ] = 0.0


@dataclass(kw_only=True)
class ReportConfig(Job):
    """Settings of the report; its coordinates are in ``crs``."""

    background: Annotated[str | None, "a GeoTIFF or a folder of XYZ tiles under its map, null for none."] = (
        None
    )
    pdf: Annotated[bool, "whether to write it as report.pdf, too (extra pdf)."] = False


@dataclass(kw_only=True)
class RunConfig:
    """Everything about one run; its ``device`` and ``mode`` take the place of the mapping's."""

    name: Annotated[
        str | None, "name of the results folder, <output>/<name>/; null takes the drive's own name."
    ] = None
    drive: DriveConfig = field(default_factory=DriveConfig)
    map: MapConfig = field(default_factory=MapConfig)
    report: ReportConfig = field(default_factory=ReportConfig)
    simulate: Annotated[
        PortConfig | None, "a port to render into the cache and map, instead of reading drive.path."
    ] = None
    detector: DetectorOptions = field(default_factory=DetectorOptions.for_mapping)
    mapping: MappingOptions = field(default_factory=MappingOptions)
    output: Annotated[
        str, "folder for the results, or the URL of one in an object store (docs/fleet.md)."
    ] = "outputs"
    cache: Annotated[
        str,
        "folder for rendered drives, imports from bags and videos, and the results of each stage, which "
        "later runs reuse (docs/cache.md).",
    ] = "cache"
    cache_gb: Annotated[
        float, NOT_NEGATIVE, "size limit of the cache, GB (10^9 bytes); least recently used entries go first."
    ] = 50.0
    resume: Annotated[
        bool,
        "whether to reuse results of earlier runs whose inputs have not changed; false recomputes "
        "everything.",
    ] = True
    workers: Annotated[
        int,
        Within(0, MOST_PROCESSES),
        "number of processes for rendering, checks, detection and maps; 0 for one per core.",
    ] = 0
    cluster: Annotated[
        str,
        "machines to work on: the address of a Dask scheduler (tcp://host:8786), or a batch system (slurm); "
        "empty for this one (docs/fleet.md).",
    ] = ""
    worker_gb: Annotated[
        float, NOT_NEGATIVE, "most memory of a process of this machine, GB; 0 for an even share of it."
    ] = 0.0
    device: Annotated[str, "where the adjustment runs, cpu or cuda."] = "cpu"
    mode: Annotated[
        str, "batch; or incremental, marking by marking as on the vehicle, then solved like batch."
    ] = BATCH
    accuracy_goal_cm: Annotated[
        float,
        POSITIVE,
        "95 % of the corners, and the calibrations, must be known to this radius, cm, at 95 %, else the "
        "verdict is WARN (docs/verdict.md).",
    ] = ACCURACY_GOAL_CM
    all_maps: Annotated[
        bool,
        "whether to map with each camera alone and by the naive methods, too, and to write every map, into "
        "maps/; a rendered port is compared so in any case.",
    ] = False
    mosaic: Annotated[bool, "whether to show the ground of a single drive from above (docs/report.md)."] = (
        True
    )
    export: Annotated[
        list[str],
        "formats of the map (geojson, gpkg, lanelet2, ...) and of the ground (geotiff, opencrg; "
        "docs/exports.md).",
    ] = field(default_factory=lambda: ["geojson"])
    crs: Annotated[
        str | None,
        "coordinate system of exports, such as EPSG:25832, or local; map.geojson keeps its longitude and "
        "latitude.",
    ] = None

    def __post_init__(self) -> None:
        self.mapping = replace(self.mapping, device=self.device, mode=self.mode)


def run_name(config: RunConfig) -> str:
    """The name of the run: as configured, else that of the drive to be rendered or read."""
    if config.name is not None:
        return config.name
    if config.simulate is not None:
        return config.simulate.name
    if not config.drive.paths:
        raise ConfigError(NO_DRIVE)
    return "+".join(drive_name(path) for path in config.drive.paths)


def admit(config: RunConfig) -> str:
    """Raise ConfigError, which names the key, for settings that cannot work; returns the run's name."""
    from v2hdm.detection.detector import Detector
    from v2hdm.io.maps.formats import check_formats
    from v2hdm.survey.run import table_of

    name = run_name(config)
    take_name(name, "name", ConfigError)
    if config.simulate is not None:
        _check_names(config.simulate)
    check_settings(config)
    check_cluster(config.cluster)
    # Wherever the detector will run, it can be looked at here.
    detector = Detector.load(options=replace(config.detector, device="cpu"))
    check_options(config.mapping, detector.catalogue.cornered)
    table_of(config.mapping.survey)
    if config.map.corrections is not None:
        from v2hdm.io.maps.corrections import read_corrections  # few runs have any

        read_corrections(Path(config.map.corrections))
    check_formats(config.export, "export")
    check_job(config.report)
    if config.report.pdf:
        from v2hdm.report.paper import check_paper

        check_paper("report.pdf")
    if config.report.background is not None:
        need("rasterio", "gis", "report.background", ConfigError)
        if not Path(config.report.background).exists():
            raise ConfigError(f"report.background: no file or folder {config.report.background}")
        from v2hdm.safe.backgrounds import check_background  # reads rasters, which few runs need

        check_background(Path(config.report.background))  # before minutes of mapping
    has_base = config.map.base is not None
    check_choice(
        config.mapping, len(config.drive.paths), has_base, config.accuracy_goal_cm, config.map.section_m
    )
    return name


def admit_port(config: RunConfig) -> PortConfig:
    """The port to render; raises ConfigError, which names the key, where there is none or it cannot work."""
    if config.simulate is None:
        raise ConfigError("simulate is not set: choose a port to render (+run=port1, +run=port2)")
    _check_names(config.simulate)
    check_settings(config)
    return config.simulate


def _check_names(port: PortConfig) -> None:
    """Raise ConfigError for names of a port that cannot be those of files."""
    take_name(port.name, "simulate.name", ConfigError)
    for camera in port.cameras:
        take_camera_name(camera, "simulate.cameras", ConfigError)


def check_choice(
    options: MappingOptions, drives: int, has_base: bool, goal_cm: float, section_m: float = 0.0
) -> None:
    """Raise ConfigError where settings do not go with so many drives, with an earlier map, or here."""
    if not 0 < goal_cm < math.inf:
        raise ConfigError(f"accuracy_goal_cm is {goal_cm}: set {POSITIVE}")
    if has_base and options.mode == INCREMENTAL:
        raise ConfigError("mode=incremental makes a map of one drive alone; update map.base with mode=batch")
    if drives > 1 and options.mode == INCREMENTAL:
        raise ConfigError("mode=incremental maps one drive, as on the vehicle; map several with batch")
    if section_m:
        if not SHORTEST_SECTION_M <= section_m < math.inf:
            raise ConfigError(
                f"map.section_m is {section_m:g}: set {SHORTEST_SECTION_M:g} m or more, or 0 for no sections"
            )
        if has_base:
            raise ConfigError("map.section_m and map.base are both set: sections update no map; drop one")
        check_sections(options)
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
    settings = replace(
        config, name=run_name(config), output="", cache="", cache_gb=0.0, resume=True,
        workers=0, cluster="", worker_gb=0.0, drive=replace(config.drive, path=None, cache=""),
    )  # fmt: skip
    files: list[Path] = []
    if config.map.base is not None:
        hd_map, trajectories, excluded = base_files(Path(config.map.base))
        files += [hd_map, *trajectories, excluded]
    named_files = (config.mapping.survey.file, config.map.corrections, config.report.background)
    files += [Path(file) for file in named_files if file is not None]
    truths = [drive.truth_dir for drive in drives if drive.truth_dir is not None]
    files += [path for truth in truths for path in sorted(truth.rglob("*"))]
    digests = [(str(path), file_digest(path)) for path in files if path.is_file()]
    of_drives = [contents.key(drive) for drive in drives]
    roots = [drive.root.resolve() for drive in drives]
    return key_of(code, settings, model_key(config.detector), roots, of_drives, digests)
