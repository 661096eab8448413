"""The adjusted trajectory as files: poses in the format of TUM, and how well they are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from v2hdm.drive.trajectory import interpolate
from v2hdm.drive.tum import write_tum
from v2hdm.files import replace_text
from v2hdm.mapping.results import AdjustedPoses
from v2hdm.records import Drive, FloatArray, Trajectory

_HEADER = "stamp_s,seen,forward_m,left_m,up_m,roll_rad,pitch_rad,heading_rad"


def write_trajectory(poses: AdjustedPoses, drive: Drive, folder: Path) -> None:
    """Write ``trajectory.tum`` and ``trajectory_sigma.csv``, a line for each time of an image.

    The poses are in the frame of the recorded ones, whose road is not flat: each is the recorded pose of that
    time, moved as the solve has moved the flat one. ``seen`` says whether a marking was seen then; where none
    was, the pose is the recorded one and its sigmas those that the drive states.
    """
    moved = np.linalg.inv(poses.before) @ poses.map_from_vehicle
    recorded = _recorded(poses, drive)
    write_tum(Trajectory(poses.stamp_s, recorded @ moved), folder / "trajectory.tum")
    rows = [
        f"{stamp:.9f},{int(seen)}," + ",".join(f"{value:.6g}" for value in sigma)
        for stamp, seen, sigma in zip(poses.stamp_s, poses.seen, poses.sigma, strict=True)
    ]
    replace_text(folder / "trajectory_sigma.csv", "\n".join([_HEADER, *rows]) + "\n")


def _recorded(poses: AdjustedPoses, drive: Drive) -> FloatArray:
    """The poses (F, 4, 4) as recorded, those laid flat where the drive has no others."""
    if drive.recorded is None:
        return poses.before
    recorded, _ = interpolate(drive.recorded, poses.stamp_s, float("inf"))
    return recorded
