"""Poses over time: their text files, the order and unit of their stamps, and the pose at any time.

Trajectories are files in the format of the TUM RGB-D benchmark, ``timestamp tx ty tz qx qy qz qw`` per line;
``timestamp filename`` lines list the images of a camera. ``#`` begins a comment.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePath
from typing import NamedTuple

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.rigid import make_transform, quaternion_from_rotation, rotation_from_quaternion
from v2hdm.io.stamps import seconds_of
from v2hdm.records import BoolArray, FloatArray, GeodeticOrigin, IntArray, Trajectory
from v2hdm.store.files import read_text, replace_text

_log = logging.getLogger(__name__)

UNITS: Mapping[str, float] = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}  # and how many of each make a second

_APPLE_DOUBLE = "._"  # begins the names of files that macOS writes beside others
_TIMECODES = ("# timecode format v2", "# timestamp format v2")
_COLUMNS = "timestamp tx ty tz qx qy qz qw"
_FARTHEST_M = 1e8  # coordinates on the earth end at ten thousand kilometres
_FARTHEST_FROM_ORIGIN_M = 1e5  # a map is flat, and there the ground is 800 m below it
_MOST_DOUBLED = 0.25  # share of images whose time repeats, chosen: more are of two cameras
_LATE_S = 1.0  # a reading that comes later than this after its successor is of another clock or recording

_UNITS: Mapping[str, float] = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
"""How many of each unit, in which stamps may be by mistake, make a second."""

_LONGEST_S = 5.0  # longest time between two poses, or images, of a drive; chosen
_QUICKEST_S = 5e-4  # shortest time between two poses, or images, of a drive; chosen
_ALIKE = 5.0  # poses and images of one drive last equally long to within this factor
_LATEST_S = 1e11  # stamps in s since 1970 stay below this for three thousand years


def checked_rotations(
    quaternion: FloatArray, place: Callable[[int], str], advice: str = "normalise it", tolerance: float = 1e-3
) -> FloatArray:
    """Rotations (N, 3, 3) of quaternions (N, 4), xyzw; DriveError, at its ``place``, for a wrong norm."""
    norm = np.linalg.norm(quaternion, axis=1, keepdims=True)
    wrong = np.flatnonzero(np.abs(norm - 1) > tolerance)
    if len(wrong):
        k = int(wrong[0])
        raise DriveError(f"{place(k)}: quaternion of norm {norm[k, 0]:.6g} instead of 1; {advice}")
    return rotation_from_quaternion(quaternion / norm)


def check_trajectory(trajectory: Trajectory, origin: GeodeticOrigin | None, where: str) -> None:
    """Refuse poses off the earth, or far from the map's ``origin`` on it."""
    farthest_m = float(np.abs(trajectory.map_from_vehicle[:, :3, 3]).max())
    if not farthest_m <= _FARTHEST_M:
        raise DriveError(f"{where}: a position is {farthest_m:.3g} m from zero, off the earth; fix it")
    if origin is not None and farthest_m > _FARTHEST_FROM_ORIGIN_M:
        raise DriveError(
            f"{where}: the poses lie {farthest_m / 1e3:.0f} km from the map's origin, which is at latitude "
            f"{origin.latitude_deg:.4f}, longitude {origin.longitude_deg:.4f}: are they coordinates of a "
            "grid such as UTM? Then say so under poses with crs, or give the origin that they count from"
        )


def check_geodetic(geodetic: FloatArray, where: str) -> None:
    """Refuse latitudes, longitudes (degrees) and heights (m) (N, 3) that are not near the ground."""
    off = (np.abs(geodetic) > [90.0, 180.0, 1e5]).any(axis=1)
    if off.any():
        row = int(np.argmax(off))
        latitude, longitude, height_m = geodetic[row]
        raise DriveError(
            f"{where}: position {row + 1}: latitude {latitude:g}, longitude {longitude:g}, height "
            f"{height_m:g} m: latitude must lie within +-90 and longitude within +-180 degrees; fix them"
        )


def read_tum(path: Path) -> Trajectory:
    """Read the trajectory at ``path``: stamps in s, strictly rising, and poses ``map_from_vehicle`` in m."""
    rows: dict[int, list[float]] = {}
    for number, line in _content_lines(path, "holds no pose", _COLUMNS):
        where = f"{path}: line {number}"
        parts = line.replace(",", " ").split()
        if len(parts) != 8:
            raise DriveError(f"{where}: expected 8 columns '{_COLUMNS}', got {len(parts)}; fix that line")
        rows[number] = [parse_number(part, where) for part in parts]
    numbers = list(rows)
    table = np.array(list(rows.values()))
    _check_rising(table[:, 0], numbers, path)
    advice = "normalise it, order qx qy qz qw"
    rotation = checked_rotations(table[:, 4:], lambda k: f"{path}: line {numbers[k]}", advice)
    return Trajectory(table[:, 0], make_transform(rotation, table[:, 1:4]))


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write ``trajectory`` to ``path`` with nanoseconds and nanometres, atomically."""
    poses = trajectory.map_from_vehicle
    quaternion = quaternion_from_rotation(poses[:, :3, :3])
    rows = np.column_stack([trajectory.stamp_s, poses[:, :3, 3], quaternion])
    form = " ".join(["{:.9f}"] * 4 + ["{:.12f}"] * 4)
    replace_text(path, "\n".join([f"# {_COLUMNS}", *(form.format(*row) for row in rows.tolist())]) + "\n")


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
    for number, line in _content_lines(path, "lists no image", "timestamp filename"):
        parts = line.split(maxsplit=1)
        if len(parts) != 2:
            raise DriveError(
                f"{path}: line {number}: expected 'timestamp filename', got '{line}'; fix that line"
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


def _content_lines(path: Path, problem: str, expected: str) -> list[tuple[int, str]]:
    """The lines that are neither empty nor comments, with their numbers; none of them is a ``problem``."""
    lines = ((k, line.strip()) for k, line in enumerate(read_text(path, DriveError).splitlines(), start=1))
    content = [(number, line) for number, line in lines if line and not line.startswith("#")]
    if not content:
        raise DriveError(f"{path}: {problem}; expected lines '{expected}'")
    return content


def parse_number(text: str, where: str) -> float:
    """The finite number that a cell of a text file holds; raises DriveError, which names ``where``."""
    try:
        value = float("" if "_" in text else text)  # in which Python allows it
    except ValueError:
        comma = "; write a decimal point" if "," in text else ""
        raise DriveError(f"{where}: '{text}' is not a number{comma}; fix that line") from None
    if not np.isfinite(value):
        raise DriveError(f"{where}: '{text}' is not a finite number; drop or fix that line")
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


def in_order(stamp_s: FloatArray, where: str, what: str = "line") -> IntArray:
    """Rows (K,) by time, the first of equal times; refuses stamps a second or more behind an earlier one."""
    if not len(stamp_s):
        raise DriveError(f"{where}: holds no pose; record some, or check what it is")
    if not np.isfinite(stamp_s).all():
        row = int(np.argmin(np.isfinite(stamp_s))) + 1
        raise DriveError(f"{where}: {what} {row}: its time is not finite")
    late_s = np.maximum.accumulate(stamp_s) - stamp_s
    if late_s.max() >= _LATE_S:
        k = int(np.argmax(late_s >= _LATE_S))
        raise DriveError(
            f"{where}: {what} {k + 1}: its time {stamp_s[k]:.3f} s is {late_s[k]:.3f} s before that of an "
            "earlier one: two clocks or two recordings in one; keep one of them"
        )
    return np.unique(stamp_s, return_index=True)[1]


def has_time(stamp_s: FloatArray, where: str, what: str) -> BoolArray:
    """Which stamps (N,) are times: 0 is none but of a clock that begins there; refuses if most are none."""
    is_zero = stamp_s == 0
    others = stamp_s[~is_zero]
    begins = is_zero.sum() == 1 and (not len(others) or np.abs(others).min() <= _LONGEST_S)
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
    wrong = np.flatnonzero(latest_s - kept_s >= _LATE_S)
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


def why_no_pose(
    image_stamp_s: FloatArray,
    pose_stamp_s: FloatArray,
    max_gap_s: float,
    asking: str = "images",
    asked: str = "poses",
) -> str:
    """Why no image (N,) finds a pose (P,), or what is called so, and what to do: units, epochs or gaps."""
    images = unit_of(image_stamp_s)
    poses = unit_of(pose_stamp_s)
    if unit := images or poses:
        whose = "all stamps" if images == poses else f"the {asking if images else asked}' stamps"
        return f"{whose} are in {unit}: divide them by {_UNITS[unit]:g} to give seconds"
    for unit, scale in _UNITS.items():
        ratio = np.ptp(image_stamp_s) / max(np.ptp(pose_stamp_s), 1e-9)
        for longer, size in ((asking, ratio), (asked, 1 / max(ratio, 1e-12))):
            if scale / _ALIKE < size < scale * _ALIKE:
                return f"the {longer}' stamps are in {unit}: divide them by {scale:g} to give seconds"
    if image_stamp_s[-1] < pose_stamp_s[0] or image_stamp_s[0] > pose_stamp_s[-1]:
        offset_s = float(pose_stamp_s[0] - image_stamp_s[0])
        when = "later" if offset_s > 0 else "earlier"
        return (
            f"the {asked} begin {abs(offset_s):.0f} s {when} than the {asking}: one of them is of another "
            "drive, or counts from another epoch (GPS time, time since start); put both on one clock"
        )
    apart_s = float(np.median(np.diff(pose_stamp_s))) if len(pose_stamp_s) > 1 else np.inf
    return (
        f"the {asked} are {apart_s:.3g} s apart, more than max_gap_s {max_gap_s:g}: record more of them, "
        "or set drive.max_gap_s where the vehicle drives that evenly"
    )


def unit_of(stamp_s: FloatArray) -> str | None:
    """The unit of stamps (N,) that cannot be seconds, None where they can."""
    step_s = float(np.median(np.diff(stamp_s))) if len(stamp_s) > 1 else 0.0
    if step_s <= _LONGEST_S and stamp_s[-1] < _LATEST_S:
        return None
    for unit, scale in _UNITS.items():
        if _QUICKEST_S <= step_s / scale <= 1.0 and stamp_s[-1] / scale < _LATEST_S:
            return unit
    return None


def span(stamp_s: FloatArray) -> str:
    """The first and the last of some stamps, s, in words."""
    return f"{stamp_s[0]:.3f} to {stamp_s[-1]:.3f} s"
