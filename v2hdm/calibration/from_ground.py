"""From a drive to its cameras' mountings by bare ground: estimate, judge, write."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

import cv2

from v2hdm.ground import GroundEstimate, estimate_cameras
from v2hdm.ground.picture import draw_matched_ground
from v2hdm.ground.say import lines
from v2hdm.io.calibration.document import Provenance, write_calibration
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.io.drive.lossless import png
from v2hdm.records import Drive
from v2hdm.report.outputs import result_folder, write_json
from v2hdm.settings import check_workers
from v2hdm.verdict import Status, Verdict, check_drive


def estimate_mountings(parsed: argparse.Namespace) -> bool:
    """Estimate every camera's mounting, print it with the verdict on the drive, and write it.

    Args:
        parsed: the arguments of :mod:`v2hdm.cli.calibrate_ground`.

    Returns:
        Whether the verdict is FAIL.

    Raises:
        V2hdmError: the drive cannot be read, or the results cannot be written.
    """
    check_workers(parsed.workers)
    cv2.setNumThreads(1)
    drive = read_drive(parsed.drive, ReadOptions(format=parsed.format, cameras=parsed.camera))
    folder = parsed.output or Path("outputs") / f"{drive.name}-extrinsic"
    with result_folder(folder, "--output") as unfinished:
        ground = estimate_cameras(drive, parsed.workers or os.cpu_count() or 1, _tell)
        verdict = Verdict.of(check_drive(drive, ground))
        settings = {"drive": str(parsed.drive), "cameras": list(drive.cameras)}
        (unfinished / "config.yaml").write_text(json.dumps(settings) + "\n", encoding="utf-8")
        write_json(unfinished / "verdict.json", verdict.as_json())
        for estimate in ground.values():
            _write(drive, estimate, unfinished, verdict)
    for estimate in ground.values():
        for line in lines(estimate):
            print(line)
    for line in (verdict.lines[0], *(finding.line for finding in verdict.raised)):
        print(line)
    print(f"results in {folder}")
    return verdict.status is Status.FAIL


def _tell(done: int, total: int) -> None:
    print(f"matched the ground of {done} of {total} cameras", file=sys.stderr, flush=True)


def _write(drive: Drive, estimate: GroundEstimate, folder: Path, verdict: Verdict) -> None:
    """One camera's calibration, and the picture of its matched ground; nothing where none was found."""
    picture = draw_matched_ground(drive, estimate)
    if estimate.calibration is None or picture is None:
        return
    path = folder / f"calibration_{estimate.camera}.yaml"
    told = verdict.as_json()
    write_calibration(estimate.calibration, path, verdict=told, about=Provenance.today(drive.name, told))
    (folder / f"ground_{estimate.camera}.png").write_bytes(png(picture))
