"""COLMAP on a real drive beside our result of it: images used, reprojection error, the camera's mounting.

``python -m tests.benchmarks.colmap_street DRIVE RESULT CAMERA`` (extra ``bench``) gives COLMAP the images,
the intrinsics, and for each image the camera's centre by the recorded pose and the stated mounting as a
prior, see :mod:`tests.benchmarks.colmap_peer`. There is no truth of the poses. What can be compared is how
the camera is turned on the vehicle, of COLMAP the mean over images and its scatter, beside what was stated.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tests.benchmarks.colmap_peer import colmap, mean_pose
from v2hdm.geometry.ipm import initial_extrinsic
from v2hdm.geometry.rigid import camera_centre
from v2hdm.io.drive import read_drive
from v2hdm.records import Drive, FloatArray
from v2hdm.report.page.facts import read_facts


def turned_deg(cam_from_vehicle: FloatArray, before: FloatArray) -> FloatArray:
    """Yaw to the left, pitch nose down and roll to the right (3,) since ``before``, by the vehicle's axes."""
    turn_vehicle = cam_from_vehicle[:3, :3].T @ before[:3, :3]
    return np.asarray(Rotation.from_matrix(turn_vehicle).as_euler("ZYX", degrees=True))


class _Model(NamedTuple):
    """COLMAP's result: poses (I, 4, 4), nan where an image is not used, and what it says of itself."""

    cam_from_map: FloatArray
    registered: int
    points: int
    error_px: float
    spent_s: float


def _kept_model(drive: Drive, rows: list[int], camera: str, model_file: Path | None) -> _Model:
    """COLMAP's model of the images ``rows``, from a file if there is one."""
    if model_file is not None and model_file.exists():
        with np.load(model_file) as content:
            return _Model(
                content["cam_from_map"],
                int(content["registered"]),
                int(content["points"]),
                float(content["error_px"]),
                float(content["spent_s"]),
            )
    with TemporaryDirectory() as scratch:
        began_s = time.process_time()
        poses, registered, points, error_px = colmap(drive, rows, camera, Path(scratch))
        model = _Model(poses, registered, points, error_px, time.process_time() - began_s)
    if model_file is not None:
        np.savez(model_file, **model._asdict())
    return model


def main() -> None:
    """Compare, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("drive", type=Path)
    parser.add_argument("result", type=Path)
    parser.add_argument("camera")
    help_text = "NPZ of what COLMAP found: read if it is there, else written after minutes of CPU"
    parser.add_argument("--kept", type=Path, metavar="FILE", help=help_text)
    parsed = parser.parse_args()
    drive = read_drive(parsed.drive)
    rows = [row for row, image in enumerate(drive.images) if image.camera == parsed.camera]
    before = initial_extrinsic(drive.cameras[parsed.camera])
    model = _kept_model(drive, rows, parsed.camera, parsed.kept)
    poses = model.cam_from_map
    print(
        f"COLMAP: {model.registered} of {len(rows)} images, {model.points} points, {model.error_px:.2f} px, "
        f"{model.spent_s:.0f} s CPU"
    )
    facts = read_facts(parsed.result, drive)
    ours = facts.cameras[parsed.camera].calibration.cam_from_vehicle
    print(f"V2HDM: {facts.best['markings']} markings, {facts.best['reprojection_rmse_px']:.2f} px")
    is_registered = np.isfinite(poses[:, 0, 0])
    recorded = np.array([drive.images[row].map_from_vehicle for row in rows])
    cam_from_vehicle = poses[is_registered] @ recorded[is_registered]
    mean = mean_pose(cam_from_vehicle)
    scatter = np.std([turned_deg(pose, mean) for pose in cam_from_vehicle], axis=0)
    for name, extrinsic in (("COLMAP", mean), ("V2HDM", ours)):
        yaw, pitch, roll = turned_deg(extrinsic, before)
        shift_cm = 100 * (camera_centre(extrinsic) - camera_centre(before))
        print(
            f"{name}: yaw {yaw:+.2f}, pitch {pitch:+.2f}, roll {roll:+.2f} deg, centre "
            f"{', '.join(f'{value:+.0f}' for value in shift_cm)} cm from what was stated"
        )
    print("COLMAP, from image to image: yaw {:.2f}, pitch {:.2f}, roll {:.2f} deg".format(*scatter))


if __name__ == "__main__":
    main()
