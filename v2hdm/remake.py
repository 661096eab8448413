"""From a finished result back to its drive, for doors that work on results."""

from __future__ import annotations

import argparse
import logging
import os
import sys
from pathlib import Path

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from v2hdm.drive import read_drive
from v2hdm.errors import ConfigError, MapFileError
from v2hdm.files import load_yaml
from v2hdm.orthophoto.result import MOSAIC_FILES, RESOLUTION_M, write_mosaic
from v2hdm.outputs import added_to
from v2hdm.pipeline.admit import check_device
from v2hdm.pipeline.config import RunConfig
from v2hdm.records import Drive
from v2hdm.simulate import rendered_drive


def drive_of_result(folder: Path, path: Path | None = None) -> Drive:
    """The drive that a result is of, read as it was for that run.

    Args:
        folder: of the result.
        path: of the drive, where it has moved; None for the one that ``config.yaml`` names.

    Raises:
        MapFileError: the folder is no result of a run.
        ConfigError: its configuration names no drive.
        DriveError: the drive cannot be read.
    """
    content = load_yaml(folder / "config.yaml", MapFileError)
    try:
        merged = OmegaConf.merge(OmegaConf.structured(RunConfig), content)
        if merged.simulate is not None and content["simulate"].get("cameras"):
            # The schema brings its own cameras: those that the run had left out would come back.
            for name in set(merged.simulate.cameras) - set(content["simulate"]["cameras"]):
                del merged.simulate.cameras[name]
        config = OmegaConf.to_object(merged)
    except OmegaConfBaseException:
        config = None
    if not isinstance(config, RunConfig):
        raise MapFileError(
            f"{folder / 'config.yaml'} is no configuration of v2hdm.map; give its result folder"
        )
    if len(config.drive.paths) > 1:
        raise MapFileError(f"{folder} is of several drives; a mosaic shows one: map them one by one for it")
    if path is None and config.simulate is not None:
        workers = config.workers or os.cpu_count() or 1
        path = rendered_drive(config.simulate, Path(config.cache), workers, lambda done, total: None)
    elif path is None and config.drive.paths:
        path = config.drive.paths[0]
    if path is None:
        raise ConfigError(f"{folder / 'config.yaml'} names no drive; give its folder with --drive")
    return read_drive(path, config.drive)


def mosaic_of_result(parsed: argparse.Namespace) -> list[str]:
    """Write the mosaic of a result; returns the lines that tell of it.

    Args:
        parsed: the arguments of :mod:`v2hdm.mosaic`.

    Raises:
        V2hdmError: result or drive cannot be read or do not belong together.
    """
    logging.basicConfig(format="%(message)s")
    check_device(parsed.device)
    if not parsed.result.is_dir():
        raise MapFileError(f"{parsed.result}: no such folder; give the result folder of v2hdm.map")
    drive = drive_of_result(parsed.result, parsed.drive)
    resolution_m = RESOLUTION_M if parsed.resolution is None else parsed.resolution
    with added_to(parsed.result, MOSAIC_FILES, "RESULT") as folder:
        found = write_mosaic(folder, drive, resolution_m, parsed.device, _tell)
    sharpness = found["sharpness"]
    lines = []
    if sharpness["edges"]:
        lines.append(
            f"paint edges {100 * sharpness['edge_width_before_m']:.1f} cm wide before, "
            f"{100 * sharpness['edge_width_after_m']:.1f} cm after the optimisation: "
            f"{sharpness['after_over_before']:.1f} times as sharp (median of {sharpness['edges']} sides)"
        )
    return [*lines, f"mosaic in {parsed.result}"]


def _tell(done: int, total: int) -> None:
    if done == total or done % 200 == 0:
        print(f"put {done} of {total} images on the ground", file=sys.stderr, flush=True)
