"""The plan of an experiment: its ports, its seeds, and how each drive is mapped."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import ConfigError
from v2hdm.executor import check_cluster
from v2hdm.mapping.options import INCREMENTAL, MappingOptions, check_options
from v2hdm.pipeline.config import DriveConfig
from v2hdm.simulate.port.config import PortConfig
from v2hdm.store.files import refuse_url

OURS = "ours"
PAPER = "paper"
RECIPES: Mapping[str, str] = {
    OURS: "the settings as configured",
    PAPER: "mapping.pose_model=paper mapping.loss=none: recorded poses taken as exact, plain least squares",
    INCREMENTAL: "mode=incremental: marking by marking, as on the vehicle",
}
"""Ways to map a drive, by name; the first is always run."""


@dataclass(kw_only=True)
class Site:
    """One port of the experiment, as ``conf/run/port1.yaml`` describes it.

    ``simulate`` is rendered once per seed. Without it ``drive`` is read, and mapped once. ``mosaic`` has no
    effect: only ``v2hdm map`` makes one.
    """

    name: str | None = None
    mosaic: Annotated[bool, "mosaic has no effect: only v2hdm map makes one."] = False
    simulate: Annotated[PortConfig | None, "rendered once per seed."] = None
    drive: DriveConfig = field(default_factory=DriveConfig)


@dataclass(kw_only=True)
class ExperimentConfig:
    """Everything about one experiment."""

    ports: Annotated[dict[str, Site], "the ports and drives to map, by name."] = field(default_factory=dict)
    seeds: Annotated[
        list[int], "seeds of the rendered ports; each gives a different port, drive and calibration."
    ] = field(default_factory=lambda: [1, 2, 3, 4, 5])
    recipes: Annotated[list[str], "recipes to run, besides ours: paper and incremental (RECIPES)."] = field(
        default_factory=lambda: [OURS, PAPER, INCREMENTAL]
    )
    detector: DetectorOptions = field(default_factory=DetectorOptions.for_mapping)
    mapping: MappingOptions = field(default_factory=MappingOptions)
    name: Annotated[str, "name of the results folder, <output>/<name>/."] = "experiment"
    output: Annotated[str, "folder for the results."] = "outputs"
    cache: Annotated[str, "folder for rendered drives and the results of each stage."] = "cache"
    device: Annotated[str, "where the adjustment runs, cpu or cuda."] = "cpu"
    workers: Annotated[
        int, "number of processes, each of which maps one drive at a time; 0 for one per core."
    ] = 0
    cluster: Annotated[
        str,
        "machines to work on: the address of a Dask scheduler (tcp://host:8786), or a batch system (slurm); "
        "empty for this one (docs/fleet.md).",
    ] = ""


@dataclass(frozen=True)
class Job:
    """One drive of the experiment: a port under one seed (None if it is read), and ``options`` by recipe."""

    port: str
    seed: int | None
    site: Site
    detector: DetectorOptions
    options: Mapping[str, MappingOptions]
    cache: Path

    @property
    def title(self) -> str:
        """The drive's name and seed, for messages."""
        return self.port if self.seed is None else f"{self.port} seed {self.seed}"


def jobs(config: ExperimentConfig) -> list[Job]:
    """The drives of an experiment, seed by seed, so that the first results compare all ports."""
    _check(config)
    changed: dict[str, dict[str, Any]] = {
        OURS: {}, PAPER: {"pose_model": "paper", "loss": "none"}, INCREMENTAL: {"mode": INCREMENTAL}
    }  # fmt: skip
    recipes = dict.fromkeys([OURS, *config.recipes])
    options = {
        name: replace(deepcopy(config.mapping), device=config.device, **changed[name]) for name in recipes
    }
    drives: list[tuple[str, int | None, Site]] = []
    for seed in config.seeds:
        for port, site in config.ports.items():
            if site.simulate is not None:
                drives.append((port, seed, replace(site, simulate=replace(site.simulate, seed=seed))))
            elif seed == config.seeds[0]:
                drives.append((port, None, site))
    return [
        Job(port, seed, site, config.detector, options, Path(config.cache)) for port, seed, site in drives
    ]


def _check(config: ExperimentConfig) -> None:
    for place in (config.output, config.cache):
        refuse_url(Path(place))
    for key in (config.name, *config.ports):
        if not key.strip(".") or "/" in key:
            raise ConfigError(f"name is {key!r}: give a folder name without '/'")
    if not config.ports:
        raise ConfigError("ports is empty: name one, as in +run@ports.port1=port1")
    if not config.seeds or len(set(config.seeds)) < len(config.seeds) or min(config.seeds) < 0:
        raise ConfigError(f"seeds is {config.seeds}: give different whole numbers, 0 or more")
    check_cluster(config.cluster)
    if config.workers < 0:
        raise ConfigError(f"workers is {config.workers}: set 0 for one per core, or a positive number")
    for recipe in config.recipes:
        if recipe not in RECIPES:
            raise ConfigError(f"recipes: there is no {recipe!r}; choose from {', '.join(RECIPES)}")
    for port, site in config.ports.items():
        if (site.simulate is None) == (site.drive.path is None):
            raise ConfigError(f"ports.{port}: set either simulate or drive.path")
        if site.simulate is not None and site.simulate.survey.length_km:
            raise ConfigError(
                f"ports.{port}.simulate.survey.length_km: an experiment compares methods on pictures; set 0"
            )
    check_options(config.mapping, Detector.load(options=config.detector).catalogue.cornered)
