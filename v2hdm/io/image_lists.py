"""Lists of images and files of times: what a folder drive says of the times of its images."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import NamedTuple

import numpy as np

from v2hdm.errors import DriveError, shown
from v2hdm.io.stamps import seconds_of
from v2hdm.io.trajectory import UNITS, content_lines, image_order, parse_number
from v2hdm.records import FloatArray
from v2hdm.store.files import read_text, replace_text

_log = logging.getLogger(__name__)

_APPLE_DOUBLE = "._"  # begins the names of files that macOS writes beside others
_TIMECODES = ("# timecode format v2", "# timestamp format v2")  # first lines of Matroska's, in ms


class ImageList(NamedTuple):
    """The images of a list: stamps (N,) in s, strictly rising, and as many names."""

    stamp_s: FloatArray
    names: list[str]


def read_image_list(path: Path) -> ImageList:
    """Read ``timestamp filename`` lines by time; what is late, repeated or without a time is counted."""
    texts: list[str] = []
    names: list[str] = []
    numbers: list[int] = []
    hidden = 0
    for number, line in content_lines(path, "lists no image", "timestamp filename"):
        parts = line.split(maxsplit=1)
        if len(parts) != 2:
            raise DriveError(
                f"{path}: line {number}: expected 'timestamp filename', got {shown(line)}; fix that line"
            )
        if PurePath(parts[1]).name.startswith(_APPLE_DOUBLE):
            hidden += 1
            continue
        texts.append(parts[0])
        names.append(parts[1])
        numbers.append(number)
    if hidden:
        _log.warning("%s: left out %d files of macOS (%sNAME)", path, hidden, _APPLE_DOUBLE)
    if not names:
        raise DriveError(f"{path}: lists files of macOS alone ({_APPLE_DOUBLE}NAME); list the images")
    stamp_s = _times_of(texts, numbers, path)
    rows = image_order(stamp_s, str(path), "line", numbers, together=False)
    return ImageList(stamp_s[rows], [names[row] for row in rows])


def read_stamps(path: Path, count: int, things: str) -> FloatArray:
    """Times (``count``,) in s, one per line; raises DriveError where there are not as many as ``things``."""
    lines = read_text(path, DriveError).splitlines()
    rows = [
        (number, line.strip())
        for number, line in enumerate(lines, start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if len(rows) != count:
        raise DriveError(f"{path}: {len(rows)} times for {count} {things}; give one of each")
    stamp_s = _times_of([line for _, line in rows], [number for number, _ in rows], path)
    # Matroska's timecodes, which rpicam-apps and mkvextract write, are in ms.
    is_timecodes = any(line.startswith(_TIMECODES) for line in lines)
    return stamp_s / UNITS["ms"] if is_timecodes else stamp_s


def _times_of(texts: Sequence[str], numbers: Sequence[int], path: Path) -> FloatArray:
    stamp_s = np.array(
        [parse_number(text, f"{path}: line {number}") for text, number in zip(texts, numbers, strict=True)]
    )
    return seconds_of(texts, stamp_s, str(path))


def write_image_list(stamp_s: FloatArray, names: Sequence[str], path: Path) -> None:
    """Write ``timestamp filename`` lines with nanoseconds, atomically."""
    lines = [f"{stamp:.9f} {name}" for stamp, name in zip(stamp_s, names, strict=True)]
    replace_text(path, "\n".join(["# timestamp filename", *lines]) + "\n")
