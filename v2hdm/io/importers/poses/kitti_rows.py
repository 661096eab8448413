"""Poses as KITTI's odometry benchmark writes them: twelve numbers a row, and a file of times beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.io.importers.poses.readings import Attitudes, Readings
from v2hdm.io.importers.poses.rising import in_order
from v2hdm.records import FloatArray
from v2hdm.store.files import read_text, take_choice, take_text

KEYS = ("stamps", "axes")

_VEHICLE_FROM_CAMERA_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""x right, y down, z forward to x forward, y left, z up."""

_UPRIGHT = 0.5
"""Least cosine between the poses' z axis and up for poses of a ground vehicle."""

_ROTATION_TOLERANCE = 1e-3


def read_kitti_rows(path: Path, entry: dict[str, Any], root: Path, where: str) -> Readings:
    """Read rows of 3 x 4 matrices.

    ``axes: camera`` are those of the benchmark, x right, y down, z forward, in the map as on the vehicle;
    ``axes: vehicle`` x forward, y left, z up.

    Raises:
        DriveError: a row is no pose, the times do not fit, or the axes are the other ones.
    """
    if "stamps" not in entry:
        raise DriveError(f"{where}: KITTI's rows have no times: add stamps, a file with one time in s a line")
    axes = take_choice(entry.get("axes", "vehicle"), ("vehicle", "camera"), f"{where}, axes", DriveError)
    poses = _numbers(path, 12).reshape(-1, 3, 4)
    stamp_s = read_stamps(root / take_text(entry["stamps"], f"{where}, stamps", DriveError))
    if len(stamp_s) != len(poses):
        raise DriveError(f"{path}: {len(poses)} poses, but {len(stamp_s)} times; give one time a pose")
    rotation, points = poses[:, :, :3], poses[:, :, 3]
    wrong = np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max(axis=(1, 2)) > _ROTATION_TOLERANCE
    if wrong.any():
        raise DriveError(f"{path}: line {int(np.argmax(wrong)) + 1}: its 3 x 3 part is no rotation; mend it")
    if axes == "camera":
        turn = _VEHICLE_FROM_CAMERA_AXES
        rotation, points = turn @ rotation @ turn.T, points @ turn.T
    elif np.median(rotation[:, 2, 2]) < _UPRIGHT:
        raise DriveError(
            f"{path}: the poses' z axis does not point up; say axes: camera if they are KITTI's own"
        )
    rows = in_order(stamp_s, str(path))
    unknown = np.full(len(rows), np.nan)
    stamps = stamp_s[rows]
    return Readings(stamps, points[rows], False, unknown, Attitudes(stamps, rotation[rows], unknown))


def read_stamps(path: Path) -> FloatArray:
    """One time in s a line (N,).

    Raises:
        DriveError: a line is not one finite number.
    """
    return _numbers(path, 1)[:, 0]


def _numbers(path: Path, columns: int) -> FloatArray:
    rows = []
    for number, line in enumerate(read_text(path, DriveError).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            row = [float(part) for part in line.replace(",", " ").split()]
        except ValueError:
            row = []
        if len(row) != columns or not np.isfinite(row).all():
            raise DriveError(
                f"{path}: line {number}: expected {columns} finite numbers, got '{line[:60]}'; mend it"
            )
        rows.append(row)
    if not rows:
        raise DriveError(f"{path}: holds no numbers; expected {columns} a line")
    return np.array(rows)
