"""The adjusted trajectory as files: poses in the format of TUM, and how well they are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from v2hdm.geometry.trajectory import interpolate
from v2hdm.io.trajectory import write_tum
from v2hdm.mapping.results import AdjustedPoses
from v2hdm.records import Drive, FloatArray, Trajectory, Visit
from v2hdm.store.files import replace_text

_HEADER = "stamp_s,seen,forward_m,left_m,up_m,roll_rad,pitch_rad,heading_rad"


def write_trajectories(poses: AdjustedPoses, drive: Drive, folder: Path) -> None:
    """Write ``trajectory.tum`` and ``trajectory_sigma.csv``, a line for each time of an image.

    Of joined drives each has its own, such as ``trajectory_monday.tum``.

    The poses are in the frame of the recorded ones, whose road is not flat: each is the recorded pose of that
    time, moved as the solve has moved the flat one. ``seen`` says whether a marking was seen then; where none
    was, the pose is the recorded one and its sigmas those that the drive states.
    """
    for number, visit in enumerate(drive.visits):
        own = poses.visit == number
        stem = f"trajectory_{visit.name}" if drive.joined else "trajectory"
        stamp_s, before = poses.stamp_s[own], poses.before[own]
        moved = np.linalg.inv(before) @ poses.map_from_vehicle[own]
        write_tum(Trajectory(stamp_s, _recorded(visit, stamp_s, before) @ moved), folder / f"{stem}.tum")
        rows = [
            f"{stamp:.9f},{int(seen)}," + ",".join(f"{value:.6g}" for value in sigma)
            for stamp, seen, sigma in zip(stamp_s, poses.seen[own], poses.sigma[own], strict=True)
        ]
        replace_text(folder / f"{stem}_sigma.csv", "\n".join([_HEADER, *rows]) + "\n")


def _recorded(visit: Visit, stamp_s: FloatArray, before: FloatArray) -> FloatArray:
    """The poses (F, 4, 4) as recorded, those laid flat where the visit has no others."""
    if visit.recorded is None:
        return before
    recorded, _ = interpolate(visit.recorded, stamp_s, float("inf"))
    return recorded
