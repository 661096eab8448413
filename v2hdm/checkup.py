"""A drive's check from its folder to the verdict on the terminal, with pictures."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from v2hdm.detection.camera.mounting import guessed_extrinsic
from v2hdm.detection.image_file import read_bgr
from v2hdm.drive import ReadOptions, read_drive
from v2hdm.quality import Status, Verdict, check_drive
from v2hdm.records import Drive, FloatArray, Trajectory
from v2hdm.report.camera_grid import save_grid
from v2hdm.report.outputs import result_folder, write_json
from v2hdm.report.route import save_route

_PICTURES = 3
"""Sample images of each camera: near the start, the middle and the end."""


def check_up(path: Path, output: Path | None, cameras: Sequence[str], ground: bool, workers: int) -> bool:
    """Check the drive at ``path``, print findings and verdict, write pictures; whether it failed.

    Raises:
        V2hdmError: the drive cannot be read, or the pictures cannot be written.
    """
    logging.basicConfig(format="%(message)s")
    drive = read_drive(path, ReadOptions(cameras=list(cameras)))
    verdict = Verdict.of(check_drive(drive))
    for finding in (*verdict.passed,):
        print(finding.line)
    for line in verdict.lines[::-1]:
        print(line)
    folder = output or Path("outputs") / f"{drive.name}-check"
    with result_folder(folder) as unfinished:
        write_json(unfinished / "verdict.json", verdict.as_json())
        settings = {"drive": str(path), "cameras": list(cameras), "ground": ground}
        (unfinished / "config.yaml").write_text(json.dumps(settings) + "\n", encoding="utf-8")
        draw(drive, unfinished, {})
    print(f"pictures in {folder}")
    return verdict.status is Status.FAIL


def draw(drive: Drive, folder: Path, found: Mapping[str, FloatArray]) -> None:
    """The pictures of a check: the route, and sample images of every camera.

    Args:
        drive: the drive.
        folder: where they go.
        found: ``cam_from_vehicle`` of the cameras whose mounting the ground told.
    """
    trajectory = drive.recorded or drive.trajectory
    if trajectory is None:
        stamp_s, rows = np.unique([image.stamp_s for image in drive.images], return_index=True)
        trajectory = Trajectory(stamp_s, np.array([drive.images[row].map_from_vehicle for row in rows]))
    save_route(folder / "route.png", trajectory)
    for name, camera in drive.cameras.items():
        images = [image for image in drive.images if image.camera == name]
        mountings = {"guess": guessed_extrinsic(camera)}
        if name in found:
            mountings["ground"] = found[name]
        for number in range(_PICTURES):
            image = images[(2 * number + 1) * len(images) // (2 * _PICTURES)]
            caption = f"{name}, {image.stamp_s:.2f} s"
            save_grid(
                folder / f"{name}_{number + 1}.jpg",
                read_bgr(image.path, grey=True),
                camera,
                mountings,
                caption,
            )
