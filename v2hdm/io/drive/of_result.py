"""The drive of a finished result, read again as ``metrics.json`` says that it was read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import msgspec

from v2hdm.errors import DriveError, MapFileError
from v2hdm.io.drive import join_drives, read_drive
from v2hdm.io.drive.images import ReadOptions
from v2hdm.records import Drive
from v2hdm.store.files import load_json

METRICS = "metrics.json"  # in a result folder


def told_of(drive: Drive, paths: Sequence[Path], options: ReadOptions) -> dict[str, Any]:
    """The plain values that :func:`drive_of` needs."""
    return {
        "name": drive.name,
        "paths": [str(path.resolve()) for path in paths],
        **{key: getattr(options, key) for key in ("format", "max_gap_s", "limit", "start_s", "end_s")},
        "cache": str(Path(options.cache).absolute()),
        **({"kitti": asdict(options.kitti)} if options.format == "kitti" else {}),
        "cameras": list(drive.cameras),
        "images": len(drive.images),
    }


def drive_of(folder: Path, path: Path | None) -> Drive | None:
    """The drive of the result in ``folder``: at ``path``, else where it was; None where it is gone.

    Raises MapFileError when the folder is no result of a run, DriveError when the drive is no longer that.
    """
    if not (folder / METRICS).is_file():
        raise MapFileError(f"{folder}: no {METRICS} in it; give the result folder of v2hdm map")
    stated = load_json(folder / METRICS, MapFileError).get("drive")
    stated = stated if isinstance(stated, dict) else {}
    try:
        paths = [Path(str(one)) for one in stated.get("paths") or []] if path is None else [path]
        options = _options(stated)
    except (TypeError, ValueError) as failure:
        raise MapFileError(f"{folder / METRICS}: what it says of the drive is damaged ({failure})") from None
    if not paths or not all(one.exists() for one in paths):
        return None
    drive = join_drives([read_drive(one, options) for one in paths])
    expected = (stated.get("name", drive.name), stated.get("images", len(drive.images)))
    if expected != (drive.name, len(drive.images)):
        raise DriveError(
            f"{paths[0]}: drive {drive.name} of {len(drive.images)} images, but the result is of drive "
            f"{expected[0]} of {expected[1]}; give that one with --drive"
        )
    return drive


def single_drive_of(folder: Path, path: Path | None, what: str) -> Drive:
    """The drive of a result, as :func:`drive_of`; refused if gone or several, ``what`` being of one."""
    drive = drive_of(folder, path)
    if drive is None:
        raise DriveError(f"{folder}: its drive is not where it was; give its folder with --drive")
    if drive.joined:
        raise MapFileError(f"{folder} is of several drives; {what} of one: map them one by one")
    return drive


def _options(stated: Mapping[str, Any]) -> ReadOptions:
    known = {one.name: stated[one.name] for one in fields(ReadOptions) if one.name in stated}
    try:
        return msgspec.convert(known, ReadOptions)
    except msgspec.ValidationError as failure:
        raise ValueError(str(failure)) from None
