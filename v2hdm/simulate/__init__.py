"""Rendered drives with ground truth: a scene, the cameras that look at it, the ports built from both."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec

from v2hdm.errors import ConfigError
from v2hdm.io.drive import read_drive
from v2hdm.records import Drive
from v2hdm.simulate.port.build import surveyed_cameras
from v2hdm.simulate.port.config import PortConfig
from v2hdm.simulate.port.drive import render_drive, rendered_drive
from v2hdm.store.files import load_yaml

__all__ = ["PortConfig", "render_drive", "rendered_drive", "simulate_port", "surveyed_cameras"]

_PACKAGE = Path(__file__).parents[1]


def simulate_port(
    port: PortConfig | str,
    folder: Path | str,
    seed: int | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Drive:
    """Render a drive through a port, with ground truth, and read it.

    Args:
        port: its settings, or the name of a shipped one: ``port1`` or ``port2``.
        folder: takes rendered drives, each in a folder of its own; one that is there already is only read.
        seed: of everything that is drawn at random, instead of the port's own.
        workers: processes to render with; 1 renders in this one.
        progress: called with the number of finished images and of all.

    Raises:
        ConfigError: no port has this name, or the settings make none.
        DriveError: the folder cannot be written.
    """
    if isinstance(port, str):
        # In the package when installed, else the checkout's.
        conf = next(one for one in (_PACKAGE / "conf", _PACKAGE.parent / "conf") if one.is_dir())
        files = {path.stem: path for path in sorted(conf.glob("run/port*.yaml"))}
        if port not in files:
            raise ConfigError(
                f"there is no port {port!r}; choose from {', '.join(files)}, or give a PortConfig"
            )
        port = msgspec.convert(load_yaml(files[port], ConfigError)["simulate"], PortConfig)
    config = port if seed is None else replace(port, seed=seed)
    return read_drive(rendered_drive(config, Path(folder), workers, progress or (lambda done, total: None)))
