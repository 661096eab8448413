"""Times of images: lists of images, files of times, and the order of images by them."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import NamedTuple

import numpy as np

from v2hdm.errors import DriveError, shown
from v2hdm.io.stamps import seconds_of
from v2hdm.io.trajectory import LATE_S, LONGEST_S, UNITS, content_lines, parse_number, units_per_second
from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.store.files import read_text, replace_text

_log = logging.getLogger(__name__)

_APPLE_DOUBLE = "._"  # begins the names of files that macOS writes beside others
_TIMECODES = ("# timecode format v2", "# timestamp format v2")  # first lines of Matroska's, in ms
_SEPARATED = re.compile(r"([^\s,;]+)\s*[,;]\s*(?!\d+\s)(.+)")  # but 12,5 FILE is a decimal comma
_TITLE = re.compile(r"[^\W\d_][^\d.]*$")  # a line of words alone
_MOST_DOUBLED = 0.25  # largest share of images with a repeated time, chosen: more mean two cameras


class ImageList(NamedTuple):
    """The images of a list: stamps (N,) in s, strictly rising, and as many names."""

    stamp_s: FloatArray
    names: list[str]


def read_image_list(path: Path) -> ImageList:
    """Read ``timestamp filename`` lines by time; what is late, repeated or without a time is counted.

    A comma or semicolon may separate both, quotes enclose the name, and a first line may name the columns.
    """
    texts: list[str] = []
    names: list[str] = []
    numbers: list[int] = []
    hidden = 0
    content = content_lines(path, "lists no image", "timestamp filename")
    for number, line in content:
        if number == content[0][0] and len(content) > 1 and _TITLE.match(line):
            continue
        separated = _SEPARATED.match(line)
        parts = line.split(maxsplit=1) if separated is None else separated.groups()
        if len(parts) != 2:
            raise DriveError(
                f"{path}: line {number}: expected 'timestamp filename', got {shown(line)}; fix that line"
            )
        name = _on_this_system(_unquoted(parts[1]), path.parent)
        if PurePath(name).name.startswith(_APPLE_DOUBLE):
            hidden += 1
            continue
        texts.append(_unquoted(parts[0]))
        names.append(name)
        numbers.append(number)
    if hidden:
        _log.warning("%s: left out %d files of macOS (%sNAME)", path, hidden, _APPLE_DOUBLE)
    if not names:
        raise DriveError(f"{path}: lists files of macOS alone ({_APPLE_DOUBLE}NAME); list the images")
    stamp_s = _times_of(texts, numbers, path)
    rows = image_order(stamp_s, str(path), "line", numbers, together=False)
    return ImageList(stamp_s[rows], [names[row] for row in rows])


def _unquoted(text: str) -> str:
    return text[1:-1] if len(text) > 2 and text[0] == text[-1] == '"' else text


def _on_this_system(name: str, folder: Path) -> str:
    """A file's name, with the backslashes of a list from Windows turned into slashes."""
    return name.replace("\\", "/") if "\\" in name and not (folder / name).exists() else name


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
    # Matroska's timecodes, which rpicam-apps and mkvextract write, are in ms.
    per_s = UNITS["ms"] if any(line.startswith(_TIMECODES) for line in lines) else None
    return _times_of([line for _, line in rows], [number for number, _ in rows], path, per_s)


def _times_of(
    texts: Sequence[str], numbers: Sequence[int], path: Path, per_s: float | None = None
) -> FloatArray:
    """The times (N,), s, of which ``per_s`` make one: ms, us or ns since 1970 are told by their size."""
    stamps = np.array(
        [parse_number(text, f"{path}: line {number}") for text, number in zip(texts, numbers, strict=True)]
    )
    return seconds_of(texts, stamps, str(path)) / (per_s or units_per_second(stamps))


def write_image_list(stamp_s: FloatArray, names: Sequence[str], path: Path) -> None:
    """Write ``timestamp filename`` lines with nanoseconds, atomically."""
    lines = [f"{stamp:.9f} {name}" for stamp, name in zip(stamp_s, names, strict=True)]
    replace_text(path, "\n".join(["# timestamp filename", *lines]) + "\n")


def has_time(stamp_s: FloatArray, where: str, what: str) -> BoolArray:
    """Flags (N,) of stamps that are times; 0 is one only of a clock that begins there. Refuses few times."""
    is_zero = stamp_s == 0
    others = stamp_s[~is_zero]
    begins = is_zero.sum() == 1 and (not len(others) or np.abs(others).min() <= LONGEST_S)
    if begins or not is_zero.any():
        return np.ones(len(stamp_s), dtype=bool)
    if 2 * is_zero.sum() > len(stamp_s):
        raise DriveError(
            f"{where}: {is_zero.sum()} of {len(stamp_s)} {what}s have no time (0); record them with times, "
            "or set stamps: received for a topic: its recorder's, late by the computer's delay"
        )
    return np.asarray(~is_zero)


def image_order(
    stamp_s: FloatArray,
    where: str,
    what: str = "image",
    numbers: Sequence[int] | None = None,
    together: bool = True,
) -> IntArray:
    """Rows (K,) of images by time, the first of equal times, without those without a time; logs how many.

    ``numbers`` are those of the rows in messages. Where images come ``together``, as they are taken, a second
    or more too late is of another clock or recording. Raises DriveError for that, or if too many repeat.
    """
    numbers = range(1, len(stamp_s) + 1) if numbers is None else numbers
    rows = np.flatnonzero(has_time(stamp_s, where, what))
    kept_s = stamp_s[rows]
    latest_s = np.maximum.accumulate(kept_s)
    late = kept_s < latest_s
    wrong = np.flatnonzero(latest_s - kept_s >= LATE_S)
    if together and len(wrong):
        k = int(wrong[0])
        before = int(np.flatnonzero(kept_s == latest_s[k])[0])
        raise DriveError(
            f"{where}: {what} {numbers[rows[k]]}: its time {kept_s[k]:.6f} s is "
            f"{latest_s[k] - kept_s[k]:.3f} s before that of {what} {numbers[rows[before]]} "
            f"({latest_s[k]:.6f} s): two clocks or two recordings in one; keep one of them"
        )
    order = rows[np.unique(kept_s, return_index=True)[1]]
    counts = {
        f"sorted {what}s that were late": int(late.sum()),
        f"dropped {what}s whose time repeats": len(rows) - len(order),
        f"dropped {what}s without a time": len(stamp_s) - len(rows),
    }
    if len(rows) - len(order) > max(1, _MOST_DOUBLED * len(rows)):
        raise DriveError(
            f"{where}: the times of {len(rows) - len(order)} of {len(rows)} {what}s repeat; are they of two "
            "cameras? Give each its own, with its times"
        )
    told = [f"{words}: {count}" for words, count in counts.items() if count]
    if told:
        _log.warning("%s: %s, of %d", where, ", ".join(told), len(stamp_s))
    return order
