"""The drive of a result, found again."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from v2hdm.drive import ReadOptions, join_drives, read_drive
from v2hdm.errors import DriveError
from v2hdm.records import Drive


def drive_of(metrics: Mapping[str, Any], path: Path | None) -> Drive | None:
    """The drive at ``path``, else where ``metrics.json`` says it was; None where nothing is there any more.

    Raises:
        DriveError: it cannot be read, or is not the drive of this result.
    """
    told = metrics.get("drive")
    told = told if isinstance(told, dict) else {}
    paths = [Path(str(one)) for one in told.get("paths") or []] if path is None else [path]
    if not paths or not all(one.exists() for one in paths):
        return None
    options = ReadOptions(
        format=str(told.get("format", "auto")),
        cameras=[str(name) for name in told.get("cameras") or []],
        max_gap_s=float(told.get("max_gap_s", ReadOptions.max_gap_s)),
        limit=None if told.get("limit") is None else int(told["limit"]),
        start_s=float(told.get("start_s") or 0.0),
        end_s=None if told.get("end_s") is None else float(told["end_s"]),
    )
    drive = join_drives([read_drive(one, options) for one in paths])
    expected = (told.get("name", drive.name), told.get("images", len(drive.images)))
    if expected != (drive.name, len(drive.images)):
        raise DriveError(
            f"{paths[0]}: drive {drive.name} of {len(drive.images)} images, but the result is of drive "
            f"{expected[0]} of {expected[1]}; give that one with --drive"
        )
    return drive
