"""Trajectories in the format of the TUM RGB-D benchmark: ``timestamp tx ty tz qx qy qz qw`` a line.

Its sibling, ``timestamp filename`` a line, lists the images of a camera. ``#`` begins a comment.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.rigid import quaternion_from_rotation, rotation_from_quaternion
from v2hdm.records import FloatArray, Trajectory
from v2hdm.store.files import read_text, replace_text

_COLUMNS = "timestamp tx ty tz qx qy qz qw"
_NORM_TOLERANCE = 1e-3  # files with four decimals pass, a forgotten component does not


def read_tum(path: Path) -> Trajectory:
    """Read the trajectory at ``path``: stamps in s, poses ``map_from_vehicle`` in m.

    Raises:
        DriveError: when the file is missing or empty, a line is not eight finite numbers, a
            quaternion is not of unit norm, or the times are not strictly rising; with the line.
    """
    numbers: list[int] = []
    rows: list[list[float]] = []
    for number, line in _content_lines(path):
        numbers.append(number)
        rows.append(_parse_row(line, f"{path}: line {number}"))
    if not rows:
        raise DriveError(f"{path}: holds no pose; expected lines '{_COLUMNS}'")
    table = np.array(rows)
    _check_rising(table[:, 0], numbers, path)
    norm = np.linalg.norm(table[:, 4:], axis=1)
    wrong = np.flatnonzero(np.abs(norm - 1.0) > _NORM_TOLERANCE)
    if len(wrong):
        raise DriveError(
            f"{path}: line {numbers[wrong[0]]}: quaternion of norm {norm[wrong[0]]:.6g} instead of 1; "
            f"normalise it, order qx qy qz qw"
        )
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = rotation_from_quaternion(table[:, 4:] / norm[:, None])
    poses[:, :3, 3] = table[:, 1:4]
    return Trajectory(stamp_s=table[:, 0], map_from_vehicle=poses)


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write ``trajectory`` to ``path`` with nanoseconds and nanometres, atomically."""
    quaternion = quaternion_from_rotation(trajectory.map_from_vehicle[:, :3, :3])
    lines = [f"# {_COLUMNS}"]
    for stamp_s, position, xyzw in zip(
        trajectory.stamp_s, trajectory.map_from_vehicle[:, :3, 3], quaternion, strict=True
    ):
        values = " ".join([*(f"{value:.9f}" for value in position), *(f"{value:.12f}" for value in xyzw)])
        lines.append(f"{stamp_s:.9f} {values}")
    replace_text(path, "\n".join(lines) + "\n")


def read_image_list(path: Path) -> tuple[FloatArray, list[str]]:
    """Read ``timestamp filename`` lines: stamps (N,) in s, strictly rising, and the file names.

    Raises:
        DriveError: when the file is missing or empty, a line does not parse, or the times are not
            strictly rising; with the line.
    """
    numbers: list[int] = []
    stamps: list[float] = []
    names: list[str] = []
    for number, line in _content_lines(path):
        parts = line.split(maxsplit=1)
        if len(parts) != 2:
            raise DriveError(
                f"{path}: line {number}: expected 'timestamp filename', got '{line}'; mend that line"
            )
        numbers.append(number)
        stamps.append(_parse_float(parts[0], f"{path}: line {number}"))
        names.append(parts[1])
    if not names:
        raise DriveError(f"{path}: lists no image; expected lines 'timestamp filename'")
    stamp_s = np.array(stamps)
    _check_rising(stamp_s, numbers, path)
    return stamp_s, names


def write_image_list(stamp_s: FloatArray, names: Sequence[str], path: Path) -> None:
    """Write ``timestamp filename`` lines with nanoseconds, atomically."""
    lines = [f"{stamp:.9f} {name}" for stamp, name in zip(stamp_s, names, strict=True)]
    replace_text(path, "\n".join(["# timestamp filename", *lines]) + "\n")


def _content_lines(path: Path) -> Iterator[tuple[int, str]]:
    for number, raw in enumerate(read_text(path, DriveError).splitlines(), start=1):
        line = raw.strip()
        if line and not line.startswith("#"):
            yield number, line


def _parse_row(line: str, where: str) -> list[float]:
    parts = line.replace(",", " ").split()
    if len(parts) != 8:
        raise DriveError(f"{where}: expected 8 columns '{_COLUMNS}', got {len(parts)}; mend that line")
    return [_parse_float(part, where) for part in parts]


def _parse_float(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise DriveError(f"{where}: '{text}' is not a number; mend that line") from None
    if not np.isfinite(value):
        raise DriveError(f"{where}: '{text}' is not a finite number; drop or mend that line")
    return value


def _check_rising(stamp_s: FloatArray, numbers: Sequence[int], path: Path) -> None:
    wrong = np.flatnonzero(np.diff(stamp_s) <= 0)
    if len(wrong):
        k = int(wrong[0])
        problem = "repeats" if stamp_s[k + 1] == stamp_s[k] else "is earlier than"
        raise DriveError(
            f"{path}: line {numbers[k + 1]}: time {stamp_s[k + 1]:.9f} {problem} that of line {numbers[k]}; "
            "sort the lines by time and drop repeats"
        )
