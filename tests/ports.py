"""The rendered ports that tests share: each is rendered once a run, whichever process asks for it first."""

import fcntl
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from tests.drive.example import description
from v2hdm import library
from v2hdm.executor import HERE
from v2hdm.pipeline.config import DriveConfig, RunConfig
from v2hdm.simulate.port.config import PortConfig, RouteConfig, SurveyConfig, YardConfig
from v2hdm.simulate.port.drive import rendered_drive
from v2hdm.simulate.survey.drive import simulated_drives

ROUTE = [[20.0, 0.0], [16.0, 70.0], [10.0, 0.0]]
"""A straight, a bend and a straight, as [metres, degrees to the left]."""

TINY_ROUTE = [[12.0, 0.0], [12.0, 55.0], [4.0, 0.0]]
"""The same, barely longer than the shortest route that a port may have: runs over it take 5 s."""


def short_port() -> PortConfig:
    """A straight and a bend of the default port, fewer obstacles, another vehicle's IPM to start from."""
    route = RouteConfig(pieces=ROUTE, image_spacing_m=1.5)
    yard = YardConfig(parked_trucks=1, barriers=2, lamp_posts=2, moving_trucks=1, shadow_strips=2)
    return PortConfig(name="short", seed=11, initial_ipm="estimated", route=route, yard=yard)


def small_port(**changes: object) -> PortConfig:
    """The port of the library's examples: one camera of half the pixels, an image every two metres."""
    return replace(library._short_port(), **changes)  # type: ignore[arg-type]


def run_config(drive: Path, output: Path, **changes: object) -> RunConfig:
    """A run over a drive in one process, with a cache of its own beside the output."""
    drive_config = DriveConfig(path=str(drive))
    settings = {"name": "short", "drive": drive_config, "output": str(output), "workers": 1}
    return RunConfig(**{"mosaic": False, **settings, "cache": f"{output}.cache", **changes})


def blind_copy(drive: Path, target: Path) -> Path:
    """The drive, whose truth nobody knows."""
    shutil.copytree(drive, target, ignore=shutil.ignore_patterns("truth"))
    with description(target) as content:
        content.pop("truth")
    return target


@pytest.fixture(scope="module")
def coarse_mosaics() -> Iterator[None]:
    """Mosaics of runs have pixels of 20 cm: at 2 cm they take longer than all else that a run writes."""
    from v2hdm.pipeline import saving

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(saving, "write_mosaic", partial(saving.write_mosaic, resolution_m=0.2))
        yield


@pytest.fixture(scope="session")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Callable[[PortConfig], Path]:
    """Renders a port, or finds what this run has rendered of it: a drive's folder, to be read only."""
    base = tmp_path_factory.getbasetemp()
    shared = (base.parent if base.name.startswith("popen-") else base) / "ports"
    shared.mkdir(exist_ok=True)

    def drive_of(port: PortConfig) -> Path:
        with (shared / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            return rendered_drive(port, shared, HERE, lambda done, total: None)

    return drive_of


@pytest.fixture(scope="session")
def short_drive(rendered: Callable[[PortConfig], Path]) -> Path:
    """The drive through :func:`short_port`."""
    return rendered(short_port())


@pytest.fixture(scope="session")
def small_drive(rendered: Callable[[PortConfig], Path]) -> Path:
    """The drive through :func:`small_port`."""
    return rendered(small_port())


@pytest.fixture(scope="session")
def tiny_drive(rendered: Callable[[PortConfig], Path]) -> Path:
    """A drive like that through :func:`small_port`, of 13 images: for tests of all but the map's quality."""
    return rendered(small_port(route=RouteConfig(pieces=TINY_ROUTE, image_spacing_m=2.0)))


@pytest.fixture(scope="session")
def survey(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """Two drives along 80 m of street, there and back, as detections: folders to be read only."""
    port = PortConfig(name="street", seed=5, survey=SurveyConfig(length_km=0.12))
    return simulated_drives(port, tmp_path_factory.mktemp("survey"), HERE, lambda done, total: None)


@pytest.fixture(scope="session")
def small_mapped(small_drive: Path) -> tuple[Path, Path]:
    """The result of a run over :func:`small_port`'s drive, to be read only, and the cache of that run."""
    from v2hdm.pipeline.run import run

    cache = small_drive.parent / "cache"
    with (small_drive.parent / "mapped").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return run(run_config(small_drive, small_drive.parent / "out", cache=str(cache))).folder, cache
