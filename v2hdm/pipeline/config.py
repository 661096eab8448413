"""Everything that a run is told: where the drive is, how to work, where the results go."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import ConfigError
from v2hdm.io.drive import ReadOptions, drive_name
from v2hdm.mapping.options import MappingOptions
from v2hdm.simulate import PortConfig

NO_DRIVE = (
    "drive.path is not set: name the folder of the drive, e.g. drive.path=my_drive, "
    "or choose a run (+run=port1, +run=port2, +run=kitti drive.path=...)"
)


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
        output: folder that takes the results, or the URL of one at an object store (docs/stores.md).
        cache: folder that keeps rendered drives, what is imported from bags and videos, and what each stage
            of a run has found, for the next one (docs/cache.md).
        local_cache: folder of this machine that takes the place of ``cache`` where that is the URL of an
            object store, which then keeps what stages have found (docs/stores.md).
        cache_gb: what the cache may hold, GB (10^9 bytes); what was not used for longest goes first.
        resume: whether what an earlier run has found is taken from the cache where nothing has changed
            that it was made from; false makes all anew.
        workers: processes for rendering and detection; 0 takes one per core.
        device: what ``conf/map.yaml`` hands on as ``mapping.device``, ``cpu`` or ``cuda``.
        all_maps: whether the map of every method and camera set is written, into ``maps/``.
        mode: what it hands on as ``mapping.mode``, ``batch`` or ``incremental``.
        mosaic: whether the ground is shown from above, too (docs/mosaic.md).
        viewer: ``rerun`` shows and records the run while it goes on (docs/live-view.md), ``none`` does not.
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
    local_cache: str = "cache"
    cache_gb: float = 50.0
    resume: bool = True
    workers: int = 0
    device: str = "cpu"
    mode: str = "batch"
    all_maps: bool = False
    mosaic: bool = False
    viewer: str = "none"
    export: list[str] = field(default_factory=lambda: ["geojson"])


def run_name(config: RunConfig) -> str:
    """The name of the run: as configured, else that of the drive which is to be rendered or read."""
    if config.name is not None:
        return config.name
    if config.simulate is not None:
        return config.simulate.name
    if not config.drive.paths:
        raise ConfigError(NO_DRIVE)
    return "+".join(drive_name(path) for path in config.drive.paths)
