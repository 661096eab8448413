"""The mosaic of a finished result, for its door."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

from v2hdm.errors import DriveError, MapFileError
from v2hdm.io.drive.of_result import drive_of
from v2hdm.mosaic.result import RESOLUTION_M, write_mosaic
from v2hdm.pipeline.config import check_device
from v2hdm.records import Drive
from v2hdm.store.outputs import added_to


def drive_of_result(folder: Path, path: Path | None = None) -> Drive:
    """The drive that a result is of, read as it was for that run.

    Args:
        folder: of the result.
        path: of the drive, where it has moved; None for where it was.

    Raises:
        MapFileError: the folder is no result of a run, or of one of several drives.
        DriveError: the drive is not there any more, cannot be read, or is another one.
    """
    drive = drive_of(folder, path)
    if drive is None:
        raise DriveError(
            f"{folder}: its drive is not where it was; give its folder with --drive, or map it anew"
        )
    if drive.joined:
        raise MapFileError(f"{folder} is of several drives; a mosaic shows one: map them one by one for it")
    return drive


def mosaic_of_result(parsed: argparse.Namespace) -> list[str]:
    """Write the mosaic of a result; returns the lines that tell of it.

    Args:
        parsed: the arguments of :mod:`v2hdm.cli.mosaic`.

    Raises:
        V2hdmError: result or drive cannot be read or do not belong together.
    """
    logging.basicConfig(format="%(message)s")
    check_device(parsed.device)
    if not parsed.result.is_dir():
        raise MapFileError(f"{parsed.result}: no such folder; give the result folder of v2hdm map")
    drive = drive_of_result(parsed.result, parsed.drive)
    resolution_m = RESOLUTION_M if parsed.resolution is None else parsed.resolution
    with added_to(parsed.result, "RESULT") as folder:
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
