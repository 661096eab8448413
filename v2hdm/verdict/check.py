"""A drive's check: findings and verdict, and the pictures that show a person the rest."""

from __future__ import annotations

import argparse
import json
import logging
import os
from collections.abc import Mapping
from pathlib import Path

import cv2

from v2hdm.detection.frames import read_bgr
from v2hdm.geometry.ipm import extrinsic_from_ipm
from v2hdm.ground.estimate import estimate_cameras
from v2hdm.ground.motion import trajectory_of_images
from v2hdm.ground.results import GroundEstimate
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.records import Drive
from v2hdm.report.figures import save_route
from v2hdm.report.outputs import write_json
from v2hdm.report.photos import save_grid
from v2hdm.settings import check_workers
from v2hdm.store.results import result_folder
from v2hdm.verdict.inputs.drive import check_drive
from v2hdm.verdict.verdict import Status

_PICTURES = 3  # sample images of each camera: near the start, in the middle and near the end


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
        workers = parsed.workers or os.cpu_count() or 1
        ground = estimate_cameras(drive, workers) if parsed.ground else {}
        verdict = check_drive(drive, ground=ground)
        write_json(unfinished / "verdict.json", verdict.as_json())
        settings = {"drive": str(parsed.drive), "cameras": list(drive.cameras), "ground": parsed.ground}
        (unfinished / "config.yaml").write_text(json.dumps(settings) + "\n", encoding="utf-8")
        draw(drive, unfinished, ground)
    for line in (*(finding.line for finding in verdict.passed if parsed.all), *verdict.lines[1:]):
        print(line)
    print(verdict.lines[0])
    print(f"pictures in {folder}")
    return verdict.status is Status.FAIL


def draw(drive: Drive, folder: Path, ground: Mapping[str, GroundEstimate]) -> None:
    """Draw the route, and the metric grid of guess and ground estimate in sample images of every camera."""
    save_route(folder / "route.png", drive.recorded or drive.trajectory or trajectory_of_images(drive))
    for name, camera in drive.cameras.items():
        images = [image for image in drive.images if image.camera == name]
        mountings = {"guess": extrinsic_from_ipm(camera.info, camera.ipm[camera.initial_ipm])}
        calibration = ground[name].calibration if name in ground else None
        if calibration is not None:
            mountings["ground"] = calibration.cam_from_vehicle
        for number in range(_PICTURES):
            image = images[(2 * number + 1) * len(images) // (2 * _PICTURES)]
            caption = f"{name}, {image.stamp_s:.2f} s"
            path = folder / f"{name}_{number + 1}.jpg"
            save_grid(path, read_bgr(image.path), camera, mountings, caption)
