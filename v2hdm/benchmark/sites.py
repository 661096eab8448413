"""The sites of the benchmark: drives made from seeds and layouts, what a mapper gets, and the truth.

A mapper gets a drive folder without truth. The truth is made anew from the same seed when a map is scored, so
that it lies beside no drive. Both have hashes that are published here: equal hashes mean an equal benchmark.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from v2hdm.benchmark.layouts import Layout, network_of
from v2hdm.cli.compose import conf_dir
from v2hdm.errors import ConfigError, shown
from v2hdm.executor import Executor
from v2hdm.io.description import DRIVE_FILE, TRUTH_FOLDER
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.progress import Progress, Steps
from v2hdm.records import BoolArray, Drive, Truth
from v2hdm.report.metrics import driven_past
from v2hdm.simulate.port.config import PortConfig, SurveyConfig
from v2hdm.simulate.port.drive import folder_of_port, true_drive
from v2hdm.simulate.render.renderer import RENDERER_VERSION
from v2hdm.simulate.survey.drive import simulated_drives, write_simulated
from v2hdm.store.cache import StageCache
from v2hdm.store.files import dump_yaml, file_digest, load_yaml
from v2hdm.store.folders import note_use

_DESIGNS = conf_dir() / "benchmark"  # layouts that ship
_DIGITS_M = 4  # decimals of a coordinate of the truth, m, that its hash counts


@dataclass(frozen=True)
class Site:
    """A site with one drive through it.

    Attributes:
        name: as it is typed.
        says: what it is, for a reader.
        config: all that its drive follows from.
        input_sha256: of the drive that a mapper gets, see :func:`input_hash`.
        truth_sha256: of its true map, see :func:`truth_hash`.
        layout: files that its paint and its way are from, None where they follow from the seed.
    """

    name: str
    says: str
    config: PortConfig
    input_sha256: str
    truth_sha256: str
    layout: Layout | None = None


@dataclass(frozen=True)
class Reference:
    """The reference of a site's maps: the truth, and which true markings (J,) the drive went past."""

    truth: Truth
    expected: BoolArray


def site_of(name: str, way: Path | None = None) -> Site:
    """The site of that name, or that of an OpenDRIVE file with the ``way`` along it.

    ConfigError names all sites where there is none, or says that a way is missing or too much.
    """
    sites = all_sites()
    design = Path(name)
    if design.suffix.lower() == ".xodr":
        if way is None:
            raise ConfigError(f"{name}: is a layout without a way; give --way FILE, a trajectory along it")
        config = PortConfig(name=design.stem, seed=1)
        return Site(design.stem, f"detections along {way}", config, "", "", Layout(design, way))
    if way is not None:
        raise ConfigError(
            f"--way: is for a layout of your own; give SITE as an OpenDRIVE file (.xodr), not {name}"
        )
    if name not in sites:
        raise ConfigError(f"{shown(name)}: is not a site of the benchmark; choose from {', '.join(sites)}")
    return sites[name]


def all_sites() -> Mapping[str, Site]:
    """All sites by name."""
    # Published when the errors of made detections did not correlate, and to stay as they are.
    streets = SurveyConfig(length_km=0.5, drives=1, correlation=0.0)
    quay = SurveyConfig(correlation=0.0)
    sites = (
        Site(
            "port1", "pictures of diamonds on concrete, by a calibrated vehicle", _shipped("port1"), *_PORT1
        ),
        Site(
            "port2", "pictures of worn paint on asphalt, by an uncalibrated one", _shipped("port2"), *_PORT2
        ),
        Site(
            "streets", "500 m of streets and yards, detections in place of pictures",
            PortConfig(name="streets", seed=1, survey=streets), *_STREETS,
        ),
        Site(
            "quay", "500 m of road by an OpenDRIVE design, detections in place of pictures",
            PortConfig(name="quay", seed=1, survey=quay), *_QUAY,
            layout=Layout(_DESIGNS / "quay.xodr", _DESIGNS / "quay.tum"),
        ),
    )  # fmt: skip
    return {site.name: site for site in sites}


def _shipped(name: str) -> PortConfig:
    """A port as its shipped run file has it, whatever a user's own configuration says."""
    run = OmegaConf.load(conf_dir() / "run" / f"{name}.yaml")
    config = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(PortConfig), run.simulate))
    assert isinstance(config, PortConfig)
    return config


def write_input(site: Site, folder: Path, cache: Path, executor: Executor, progress: Steps) -> None:
    """Write the drive that a mapper gets into ``folder``: all of the made drive but its truth.

    The drive is made in a ``cache``, where a later call finds it. Raises as
    :func:`v2hdm.simulate.port.drive.rendered_drive`.
    """
    drive_folder = _simulated(site, cache, executor, progress)
    description = load_yaml(drive_folder / DRIVE_FILE, ConfigError)
    description.pop("truth", None)
    of_truth = shutil.ignore_patterns(TRUTH_FOLDER, ".*")
    shutil.copytree(drive_folder, folder, ignore=of_truth, dirs_exist_ok=True)
    (folder / DRIVE_FILE).write_text(dump_yaml(description), encoding="utf-8")


def _simulated(site: Site, cache: Path, executor: Executor, progress: Steps) -> Path:
    """The drive of a site with its truth, in a cache."""
    if site.layout is None:
        (drive_folder,) = simulated_drives(site.config, cache, executor, progress)
        return drive_folder
    network = network_of(site.layout, site.config.route.speed_mps)
    digest = hashlib.sha256("".join(site.layout.digests).encode()).hexdigest()
    folder = folder_of_port(site.config, cache)
    folder = folder.with_name(f"{folder.name}-{digest[:10]}")
    if not (folder / DRIVE_FILE).is_file():
        write_simulated(site.config, network, folder, progress)
    note_use(folder)
    return folder


def input_hash(folder: Path) -> str:
    """SHA-256 of a drive folder: of the name and the content of each of its files but its description.

    Versions describe the same drive in more or less words.
    """
    files = (path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    paths = sorted(path for path in files if path.name != DRIVE_FILE)
    lines = [f"{path.relative_to(folder).as_posix()} {file_digest(path)}\n" for path in paths]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def reference_of(site: Site, cache: Path | None, executor: Executor, progress: Progress) -> Reference:
    """The truth of a site, from its seed; a ``cache`` keeps it."""
    stages = StageCache(cache)
    layout = site.layout
    key = stages.key(RENDERER_VERSION, site.config, *(() if layout is None else layout.digests))
    make = partial(_make_reference, site, executor, progress)
    return stages.get_or_make("benchmark", key, Reference, make)


def _make_reference(site: Site, executor: Executor, progress: Progress) -> Reference:
    is_rendered = site.layout is None and not site.config.survey.length_km
    drive, truth = true_drive(site.config) if is_rendered else _survey(site, executor, progress)
    return Reference(truth, driven_past(drive, truth, tuple(drive.cameras)))


def _survey(site: Site, executor: Executor, progress: Progress) -> tuple[Drive, Truth]:
    """A drive of detections with its truth, made in a folder that does not stay."""
    with tempfile.TemporaryDirectory(prefix="v2hdm-benchmark-") as folder:
        drive_folder = _simulated(site, Path(folder), executor, partial(progress, "truth"))
        drive = read_drive(drive_folder)
        return drive, read_truth(drive)


def truth_hash(reference: Reference) -> str:
    """SHA-256 of the true markings: class, corners to 0.1 mm, and whether a drive must find them."""
    lines = []
    for marking, is_expected in zip(reference.truth.map.markings, reference.expected, strict=True):
        corners = np.round(marking.corners_map, _DIGITS_M) + 0.0  # no minus zero
        coordinates = " ".join(f"{value:.{_DIGITS_M}f}" for value in corners.ravel())
        lines.append(f"{marking.kind} {coordinates} {int(is_expected)}\n")
    return hashlib.sha256("".join(lines).encode()).hexdigest()


# SHA-256 of input and truth, as v2hdm benchmark make and score print them; numpy 2.4, OpenCV 5.0, x86_64:
_PORT1 = (
    "7b860a05471d63963550e2652e5311617709697e1ec2be3a594751f319168e79",
    "a7cb5a5970e22f4daa626151f4c9bf0356e6e548e42a483232a7aaa4e2b4c4a3",
)
_PORT2 = (
    "3a5bcd818823f0803d88c655acc1a83901485dd6dbcbe3ed87951a17cc0801e3",
    "57436fb23b7cf59e636c0aa7a20d6d69bc02263bf94d2a5ef43a1a33c9462073",
)
_STREETS = (
    "3d79b1851d91da66429cd708dc3f4608654d6c61345a5919884f19d31a6277c3",
    "aa098bd15cdb950b6920fbd067c4e29d5f795aec4a7b2a536db71cfe512869f3",
)
_QUAY = (
    "118ad5809091c9a59c61542d4e6be2fb371856e5a0a32edaa820de3e7cfc2e4e",
    "12bf4f0efe2012dec5a966e327f5d20d057821887a8cbf5291124ae55946370a",
)
