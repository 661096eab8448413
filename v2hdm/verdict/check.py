"""A drive's check from its folder to the verdict on the terminal, with pictures."""

from __future__ import annotations

import argparse
import json
import logging
import os
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from v2hdm.detection.frames import read_bgr
from v2hdm.geometry.ipm import extrinsic_from_ipm
from v2hdm.ground import GroundEstimate
from v2hdm.ground.rig import estimate_cameras
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.records import Drive, FloatArray, Trajectory
from v2hdm.report.camera_grid import save_grid
from v2hdm.report.outputs import result_folder, write_json
from v2hdm.report.route import save_route
from v2hdm.settings import check_workers
from v2hdm.verdict import Status, Verdict, check_drive

_PICTURES = 3
"""Sample images of each camera: near the start, in the middle and near the end."""


def check_up(parsed: argparse.Namespace) -> bool:
    """Check a drive, print findings and verdict, write pictures.

    Args:
        parsed: the arguments of :mod:`v2hdm.cli.check`.

    Returns:
        Whether the verdict is FAIL.

    Raises:
        V2hdmError: the drive cannot be read, or the pictures cannot be written.
    """
    check_workers(parsed.workers)
    logging.basicConfig(format="%(message)s")
    cv2.setNumThreads(1)
    drive = read_drive(parsed.drive, ReadOptions(cameras=parsed.camera))
    folder = parsed.output or Path("outputs") / f"{drive.name}-check"
    with result_folder(folder, "--output") as unfinished:
        ground: Mapping[str, GroundEstimate] = {}
        if parsed.ground:
            ground = estimate_cameras(drive, parsed.workers or os.cpu_count() or 1, _quietly)
        verdict = Verdict.of(check_drive(drive, ground))
        write_json(unfinished / "verdict.json", verdict.as_json())
        settings = {"drive": str(parsed.drive), "cameras": list(drive.cameras), "ground": parsed.ground}
        (unfinished / "config.yaml").write_text(json.dumps(settings) + "\n", encoding="utf-8")
        draw(drive, unfinished, _found(ground))
    for line in (*(finding.line for finding in verdict.passed if parsed.all), *verdict.lines[1:]):
        print(line)
    print(verdict.lines[0])
    print(f"pictures in {folder}")
    return verdict.status is Status.FAIL


def draw(drive: Drive, folder: Path, found: Mapping[str, FloatArray]) -> None:
    """The pictures of a check: the route, and sample images of every camera.

    Args:
        drive: the drive.
        folder: where they go.
        found: ``cam_from_vehicle`` of the cameras whose mounting the ground told.
    """
    save_route(folder / "route.png", drive.recorded or drive.trajectory or _of_images(drive))
    for name, camera in drive.cameras.items():
        images = [image for image in drive.images if image.camera == name]
        mountings = {"guess": extrinsic_from_ipm(camera.info, camera.ipm[camera.initial_ipm])}
        if name in found:
            mountings["ground"] = found[name]
        for number in range(_PICTURES):
            image = images[(2 * number + 1) * len(images) // (2 * _PICTURES)]
            pixels = read_bgr(image.path)
            caption = f"{name}, {image.stamp_s:.2f} s"
            save_grid(folder / f"{name}_{number + 1}.jpg", pixels, camera, mountings, caption)


def _found(ground: Mapping[str, GroundEstimate]) -> dict[str, FloatArray]:
    return {
        name: estimate.calibration.cam_from_vehicle
        for name, estimate in ground.items()
        if estimate.calibration is not None
    }


def _of_images(drive: Drive) -> Trajectory:
    stamp_s, rows = np.unique([image.stamp_s for image in drive.images], return_index=True)
    return Trajectory(stamp_s, np.array([drive.images[row].map_from_vehicle for row in rows]))


def _quietly(done: int, total: int) -> None:
    """Progress that a check of seconds need not show."""
