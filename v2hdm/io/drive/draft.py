"""A recording's first ``drive.yaml``: what the recording tells, what its user adds, and what is missing."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from v2hdm.errors import DriveError
from v2hdm.io.description import DRIVE_FILE
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.images import ReadOptions
from v2hdm.io.drive.sources import list_folder
from v2hdm.io.importers.bag.describe import BagDescription, log_notes
from v2hdm.io.importers.bag.entries import LENS, MOUNTING, ORIGIN
from v2hdm.io.importers.bag.reading import is_bag
from v2hdm.io.stamps import ZONES, times_of_names
from v2hdm.safe.fields import take_frame
from v2hdm.safe.texts import ALL_CAMERAS, MOST_NAME_LETTERS, parse_yaml
from v2hdm.store.files import dump_yaml, replace_text

_POSES = (
    "a log of poses, with the antenna's place, m forward, left, up of the ground under the rear axle: "
    "{nmea: route.nmea, lever_arm_m: [1.2, 0, 1.8]}"
)
_EITHER = ("stamps", "start_s", "unit")  # keys of images of which one tells their times
_RAW_SUFFIXES = (".h264", ".264", ".avc", ".h265", ".265", ".hevc", ".mjpeg", ".mjpg", ".obu")
"""Suffixes of streams of frames without times."""


def draft_drive(
    source: Path, folder: Path, settings: Sequence[str], cameras: Sequence[str] = ()
) -> dict[str, str]:
    """Write the ``drive.yaml`` of a bag, a video or a folder of images, or say what is missing.

    ``settings`` are ``KEY=VALUE`` with dotted keys and values in YAML, in which names of files count from the
    working directory; null takes a key, or a camera, out. ``cameras`` are those wanted of a bag, all where
    none is named. What is missing is returned by its key, with what to give; nothing is written into
    ``folder`` then, nor where the drive cannot be read. Raises DriveError for a source of no kind, a setting
    that is none, a ``drive.yaml`` that exists.
    """
    where = folder / DRIVE_FILE
    if os.path.lexists(where):  # a link to a file that is gone is the user's, too
        raise DriveError(f"{where}: exists; edit it, or choose another folder for --write")
    values = _values_of(settings)
    draft = _draft_of(source, folder, values, cameras)
    content = draft.content
    missing = draft.missing
    _refuse_unused(content, settings)
    for key, value in values.items():
        is_name = key.endswith(("topic", "frame"))
        _put(content, key.split("."), value if is_name else _beside(value, folder))
        for asked_key in list(missing):
            entry, _, last = asked_key.rpartition(".")
            is_same = f"{key}.".startswith(f"{asked_key}.") or asked_key.startswith(f"{key}.")
            is_alternative = last in _EITHER and key in [f"{entry}.{name}" for name in _EITHER]
            if is_same or is_alternative:
                del missing[asked_key]
    if missing:
        return missing
    folder.mkdir(parents=True, exist_ok=True)
    replace_text(where, dump_yaml(content))
    try:
        read_drive(folder)
    except BaseException:
        where.unlink()
        raise
    return {}


def _values_of(settings: Sequence[str]) -> dict[str, object]:
    """The values of ``KEY=VALUE`` by their dotted keys."""
    values: dict[str, object] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not (key and equals):
            raise DriveError(f"--set {setting}: give KEY=VALUE, such as cameras.front.camera_info=front.yaml")
        values[key] = parse_yaml(text, f"--set {key}", DriveError)
    return values


class _Draft(NamedTuple):
    """The drive as far as a recording tells."""

    content: dict[str, Any]  # of its drive.yaml
    missing: dict[str, str]  # dotted keys, with what to give for each


def _draft_of(source: Path, folder: Path, values: Mapping[str, object], cameras: Sequence[str]) -> _Draft:
    """The draft of a ``drive.yaml`` in ``folder`` for a recording, of which its user states ``values``."""
    if is_bag(source):
        answers: dict[str, Any] = {}
        for key, value in values.items():
            if key.endswith("frame") and value is not None:
                take_frame(value, f"--set {key}", DriveError)
            _put(answers, key.split("."), value, keep_null=True)
        bag = BagDescription(source, Path(ReadOptions().cache), answers, cameras)
        log_notes(source, bag.notes)
        about = {"name": folder.resolve().name, "bag": _relative(source, folder)}
        return _Draft(bag.content | about, bag.missing)
    if not source.exists():
        raise DriveError(f"{source}: no such bag, video or folder of images; check the path")
    name = _camera_of(source)
    missing = {"poses": _POSES}
    missing |= {f"cameras.{name}.camera_info": LENS}
    missing |= {f"cameras.{name}.mounting": MOUNTING.format(origin=ORIGIN)}
    if source.is_dir():
        images = {"folder": _relative(source, folder)}
        paths = list_folder(source)
        if not paths:
            raise DriveError(
                f"{source}: not a bag, a video or a folder of images; --write needs one of these"
            )
        if not _tell_times(paths, None):
            if _tell_times(paths, "utc"):
                missing[f"cameras.{name}.images.unit"] = (
                    f"the clock of the dates in the images' names: {ZONES}"
                )
            else:
                missing[f"cameras.{name}.images.stamps"] = (
                    "a file with a time in s per image: times.txt, or unit: s, ms, us or ns of times as names"
                )
    else:
        images = {"video": _relative(source, folder)}
        if source.suffix.lower() in _RAW_SUFFIXES:
            missing[f"cameras.{name}.images.stamps"] = "a file with a time in s per frame: times.txt"
        else:
            missing[f"cameras.{name}.images.start_s"] = (
                "the first frame's time on the poses' clock, s: 1715934630.25"
            )
    return _Draft({"name": folder.resolve().name, "cameras": {name: {"images": images}}}, missing)


def _tell_times(paths: Sequence[Path], unit: str | None) -> bool:
    try:
        times_of_names([path.stem for path in paths], unit, "")
    except DriveError:
        return False
    return True


def _refuse_unused(content: Mapping[str, Any], settings: Sequence[str]) -> None:
    """Raise DriveError for settings of a camera that has no images, neither in the recording nor by them."""
    paths = [setting.partition("=")[0].split(".") for setting in settings if "=" in setting]
    of_cameras = [keys for keys in paths if len(keys) > 2 and keys[0] == "cameras"]
    with_images = {keys[1] for keys in of_cameras if keys[2] == "images"} | set(content.get("cameras", {}))
    unused = [".".join(keys) for keys in of_cameras if keys[1] not in with_images]
    if unused:
        raise DriveError(
            f"--set {', '.join(unused)}: not used: no camera has that name; name "
            f"{' or '.join(content.get('cameras', {})) or 'its images, too'}"
        )


def _camera_of(source: Path) -> str:
    """A name for the camera of a recording: its own, of letters that a key of ``--set`` may have."""
    name = re.sub(r"[^\w-]+", "_", source.stem)[:MOST_NAME_LETTERS].strip("_")
    return "camera" if not name or name.lower() in ALL_CAMERAS else name


def _put(content: dict[str, Any], keys: Sequence[str], value: object, *, keep_null: bool = False) -> None:
    """Put ``value`` under dotted ``keys`` of ``content``; None takes what is there out, unless it is kept."""
    for key in keys[:-1]:
        if not isinstance(content.get(key), dict):
            content[key] = {}
        content = content[key]
    if value is None and not keep_null:
        content.pop(keys[-1], None)
    else:
        content[keys[-1]] = value


def _beside(value: object, folder: Path) -> object:
    """``value`` with all names of files that exist relative to ``folder``."""
    if isinstance(value, dict):
        topics = {key: entry for key, entry in value.items() if key.endswith("topic")}
        return {key: _beside(entry, folder) for key, entry in value.items()} | topics
    exists = isinstance(value, str) and len(value) < 4096 and Path(value).exists()
    return _relative(Path(value), folder) if exists and isinstance(value, str) else value


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
