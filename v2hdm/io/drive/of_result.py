"""The drive of a finished result: what ``metrics.json`` says of how it was read, and reading it so again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from v2hdm.errors import DriveError, MapFileError
from v2hdm.io.drive import join_drives, read_drive
from v2hdm.io.drive.options import KittiOptions, ReadOptions
from v2hdm.records import Drive
from v2hdm.store.files import load_json

METRICS = "metrics.json"
"""Name of the file in a result folder that says it."""


def told_of(drive: Drive, paths: Sequence[Path], options: ReadOptions) -> dict[str, Any]:
    """What :func:`drive_of` needs, as plain values."""
    return {
        "name": drive.name,
        "paths": [str(path.resolve()) for path in paths],
        "format": options.format,
        "max_gap_s": options.max_gap_s,
        "limit": options.limit,
        "start_s": options.start_s,
        "end_s": options.end_s,
        "cache": str(Path(options.cache).resolve()),
        **({"kitti": asdict(options.kitti)} if options.format == "kitti" else {}),
        "cameras": list(drive.cameras),
        "images": len(drive.images),
    }


def drive_of(folder: Path, path: Path | None) -> Drive | None:
    """The drive of the result in ``folder``: at ``path``, else where it was; None where it is there no more.

    Raises:
        MapFileError: the folder is no result of a run.
        DriveError: the drive cannot be read, or is not that of this result.
    """
    if not (folder / METRICS).is_file():
        raise MapFileError(f"{folder}: no {METRICS} in it; give the result folder of v2hdm map")
    told = load_json(folder / METRICS, MapFileError).get("drive")
    told = told if isinstance(told, dict) else {}
    try:
        paths = [Path(str(one)) for one in told.get("paths") or []] if path is None else [path]
        options = _options(told)
    except (TypeError, ValueError) as failure:
        raise MapFileError(f"{folder / METRICS}: what it says of the drive is damaged ({failure})") from None
    if not paths or not all(one.exists() for one in paths):
        return None
    drive = join_drives([read_drive(one, options) for one in paths])
    expected = (told.get("name", drive.name), told.get("images", len(drive.images)))
    if expected != (drive.name, len(drive.images)):
        raise DriveError(
            f"{paths[0]}: drive {drive.name} of {len(drive.images)} images, but the result is of drive "
            f"{expected[0]} of {expected[1]}; give that one with --drive"
        )
    return drive


def _options(told: Mapping[str, Any]) -> ReadOptions:
    limit, end_s = told.get("limit"), told.get("end_s")
    kitti = dict(told.get("kitti") or {})
    return ReadOptions(
        format=str(told.get("format", "auto")),
        cameras=[str(name) for name in told.get("cameras") or []],
        max_gap_s=float(told.get("max_gap_s", ReadOptions.max_gap_s)),
        limit=None if limit is None else int(limit),
        start_s=float(told.get("start_s") or 0.0),
        end_s=None if end_s is None else float(end_s),
        cache=str(told.get("cache", ReadOptions.cache)),
        kitti=KittiOptions(**{str(key): float(value) for key, value in kitti.items()}),
    )
