"""Poses over time: their text files, the order and unit of their stamps, and the pose at any time.

Trajectories are files in the format of the TUM RGB-D benchmark, ``timestamp tx ty tz qx qy qz qw`` per line;
``timestamp filename`` lines list the images of a camera. ``#`` begins a comment.
"""

from __future__ import annotations

import logging
import re
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v2hdm.errors import DriveError, shown
from v2hdm.geometry.rigid import make_transform, quaternion_from_rotation, rotation_from_quaternion
from v2hdm.records import FloatArray, GeodeticOrigin, IntArray, Trajectory
from v2hdm.store.files import read_text, replace_text

_log = logging.getLogger(__name__)

UNITS: Mapping[str, float] = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}  # and how many of each make a second

NO_NUMBER = ("", "nan", "inf", "infinity", "null", "none", "na", "nan(ind)", "1.#ind", "1.#qnan")
_UNIT = re.compile(r"[\[(](s|ms|us|ns)[\])]")
_OLDEST_S = 9.5e8  # times since 1970 of recordings are later than this, February 2000
_NEWEST_S = 4.1e9  # and earlier than this, December 2099
_COLUMNS = "timestamp tx ty tz qx qy qz qw"
_FARTHEST_M = 1e8  # coordinates on the earth end at ten thousand kilometres
_FARTHEST_FROM_ORIGIN_M = 1e5  # a map is flat, and there the ground is 800 m below it
_LEAP_M = 1e4  # least step, m, between poses that another grid's coordinates make: a zone's are 400 km off
_FASTEST_MPS = 300.0  # no vehicle is faster, m/s
_STRAYS = 0.05  # largest share of times out of order that is left out; more mean two recordings
LATE_S = 1.0  # a reading this late after its successor comes from another clock or recording

_UNITS: Mapping[str, float] = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
"""How many of each unit, in which stamps may be by mistake, make a second."""

LONGEST_S = 5.0  # longest time between two poses, or images, of a drive; chosen
_QUICKEST_S = 5e-4  # shortest time between two poses, or images, of a drive; chosen
_ALIKE = 5.0  # poses and images of one drive last equally long to within this factor
_SAME_SPAN_S = 1.5  # images and poses that one start and stop recorded begin and end so closely; chosen
_SAME_START_S = 60.0  # and those on clocks of two time zones, where a minute more is no other cause
_HALF_HOUR_S = 1800.0  # clocks that differ by this or more may be of two time zones, s
_ZONES_H = (*range(1, 15), 3.5, 4.5, 5.5, 5.75, 6.5, 8.75, 9.5, 10.5, 12.75)  # off UTC (IANA's tz database)
_CLOCKS: Mapping[float, str] = {
    18.0: "one is GPS time, the other UTC (18 s since 2017)",
    19.0: "one is TAI, the other GPS time (19 s)",
    37.0: "one is TAI (PTP), the other UTC (37 s since 2017)",
    315964800.0: "one counts from 1970, the other from 1980, as GPS does",
    315964782.0: "one is UTC since 1970, the other GPS time since 1980",
    619315200.0: "the receiver's date is 1024 weeks early: its week number has rolled over",
}
"""Differences of clocks that are mixed up, s (IERS Bulletin C; IS-GPS-200)."""

_LATEST_S = 1e11  # stamps in s since 1970 stay below this for three thousand years


def checked_rotations(
    quaternion: FloatArray, place: Callable[[int], str], advice: str = "normalise it", tolerance: float = 1e-3
) -> FloatArray:
    """Rotations (N, 3, 3) of quaternions (N, 4), xyzw; DriveError, at its ``place``, for a wrong norm."""
    with np.errstate(over="ignore"):  # an infinite norm is a wrong one
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
    _check_one_grid(trajectory, where)
    if origin is not None and farthest_m > _FARTHEST_FROM_ORIGIN_M:
        raise DriveError(
            f"{where}: the poses lie {farthest_m / 1e3:.0f} km from the map's origin, which is at latitude "
            f"{origin.latitude_deg:.4f}, longitude {origin.longitude_deg:.4f}: are they coordinates of a "
            "grid such as UTM? Then say so under poses with crs, or give the origin that they count from"
        )


def _check_one_grid(trajectory: Trajectory, where: str) -> None:
    """Refuse poses whose coordinates change their grid on the way, as drivers do at the edge of a zone."""
    steps_m = np.linalg.norm(np.diff(trajectory.map_from_vehicle[:, :2, 3], axis=0), axis=1)
    is_leap = (steps_m > _LEAP_M) & (steps_m > _FASTEST_MPS * np.diff(trajectory.stamp_s))
    if is_leap.any():
        k = int(np.argmax(is_leap))
        raise DriveError(
            f"{where}: the poses leap by {steps_m[k] / 1e3:.0f} km at {trajectory.stamp_s[k + 1]:.3f} s, as "
            "where coordinates change their UTM zone or MGRS square; give all in one, or latitude, longitude"
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
    """Read the trajectory at ``path``: stamps in s, strictly rising, and poses ``map_from_vehicle`` in m.

    Columns may be separated by commas or semicolons; a line of their names may put the quaternion's w first
    or the times in nanoseconds, as EuRoC's do. Lines of no numbers, or of an equal time, are left out and
    counted.
    """
    layout = _layout_of(path)
    rows: dict[int, list[float]] = {}
    lost = 0
    for number, line in layout.lines:
        where = f"{path}: line {number}"
        parts = _cells(line)
        if len(parts) != 8 and not (layout.is_named and len(parts) > 8):
            kitti = " (poses of KITTI have no times: add them)" if len(parts) == 12 else ""
            expected = f"expected 8 columns '{_COLUMNS}', got {len(parts)}{kitti}; fix that line"
            raise DriveError(f"{where}: {expected}")
        if any(part.lower().lstrip("+-") in NO_NUMBER for part in parts[:8]):
            lost += 1
            if lost == len(layout.lines):
                raise DriveError(f"{where}: it and all others hold no finite number; record the poses again")
            continue
        rows[number] = [parse_number(part, where) for part in parts[:8]]
    numbers = np.array(list(rows))
    table = np.array(list(rows.values()))
    if len(table) > 1 and np.ptp(table[:, 0]) == 0:
        raise DriveError(
            f"{path}: all times are {table[0, 0]:.10g}: they were written with too few digits; write seconds "
            "with six decimals"
        )
    stamp_s = table[:, 0] / (layout.per_s or units_per_second(table[:, 0]))
    order = in_order(stamp_s, str(path), "pose")
    if lost:
        _log.warning("%s: left out %d of %d poses that are not numbers", path, lost, lost + len(table))
    if len(order) < len(table):
        left_out = len(table) - len(order)
        _log.warning("%s: left out %d of %d poses of equal or stray times", path, left_out, len(table))
    if late := int((np.diff(order) < 0).sum()):
        _log.warning("%s: sorted its poses by time: %d came late", path, late)
    table = table[order]
    numbers = numbers[order]
    if layout.w_first:
        table = table[:, [0, 1, 2, 3, 5, 6, 7, 4]]
    advice = "normalise it, order qx qy qz qw"
    rotation = checked_rotations(table[:, 4:], lambda k: f"{path}: line {numbers[k]}", advice)
    return Trajectory(stamp_s[order], make_transform(rotation, table[:, 1:4]))


class _Layout(NamedTuple):
    """The lines of poses in a file, and what its line of names, if any, says of them."""

    lines: list[tuple[int, str]]
    is_named: bool
    w_first: bool
    per_s: float | None  # units of time in a second, None where that is not said


def _layout_of(path: Path) -> _Layout:
    lines = content_lines(path, "holds no pose", _COLUMNS)
    title = None
    if not any(part[:1].isdigit() for part in _cells(lines[0][1])) and len(_cells(lines[0][1])) >= 8:
        title = lines[0][1]
        lines = lines[1:]
        if not lines:
            raise DriveError(f"{path}: holds no pose; expected lines '{_COLUMNS}'")
    else:
        comments = (line.strip() for line in read_text(path, DriveError).splitlines()[: lines[0][0] - 1])
        title = next((text for text in comments if _names_of(text.lstrip("\ufeff# "))), None)
    names = _names_of(title.lstrip("\ufeff# ")) if title else []
    if title is None or not names:
        return _Layout(lines, False, False, None)
    ends = [name[-1] for name in names[4:8]]
    unit = _UNIT.search(title.split(",")[0])
    return _Layout(lines, True, ends[0] == "w", UNITS[unit[1]] if unit else None)


def _names_of(title: str) -> list[str]:
    """The names in a line of a time, a position and a quaternion; none in another line."""
    names = [re.sub(r"\s*[\[(].*", "", name).strip().lower() for name in re.split(r"[,;]", title)]
    names = names if len(names) >= 8 else re.sub(r"[\[(].*?[\])]", "", title).lower().split()
    ends = "".join(name[-1:] for name in names[1:8])
    return names if len(names) >= 8 and ends in ("xyzxyzw", "xyzwxyz") else []


def _cells(line: str) -> list[str]:
    """The cells of a line, separated by semicolons, commas or blanks, with decimal points."""
    if ";" in line:
        return [cell.strip().replace(",", ".") for cell in line.rstrip("; ").split(";")]
    cells = [cell.strip(",") for cell in line.split()]
    if len(cells) >= 8 and "." not in line and all(cell.count(",") <= 1 for cell in cells):
        return [cell.replace(",", ".") for cell in cells]
    return line.replace(",", " ").split()


def units_per_second(stamps: FloatArray) -> float:
    """Units in a second of stamps (N,) that count since 1970, which their size shows; 1 for others."""
    latest = float(stamps.max())
    scales = (scale for scale in UNITS.values() if _OLDEST_S < latest / scale < _NEWEST_S)
    return next(scales, 1.0)


def write_tum(trajectory: Trajectory, path: Path) -> None:
    """Write ``trajectory`` to ``path`` with nanoseconds and nanometres, atomically."""
    poses = trajectory.map_from_vehicle
    quaternion = quaternion_from_rotation(poses[:, :3, :3])
    rows = np.column_stack([trajectory.stamp_s, poses[:, :3, 3], quaternion])
    form = " ".join(["{:.9f}"] * 4 + ["{:.12f}"] * 4)
    replace_text(path, "\n".join([f"# {_COLUMNS}", *(form.format(*row) for row in rows.tolist())]) + "\n")


def content_lines(path: Path, problem: str, expected: str) -> list[tuple[int, str]]:
    """The lines that are neither empty nor comments, with their numbers; none of them is a ``problem``."""
    lines = ((k, line.strip()) for k, line in enumerate(read_text(path, DriveError).splitlines(), start=1))
    lines = ((k, line.lstrip("\ufeff")) for k, line in lines)
    content = [(number, line) for number, line in lines if line and not line.startswith(("#", "//", "%"))]
    if not content:
        raise DriveError(f"{path}: {problem}; expected lines '{expected}'")
    return content


def parse_number(text: str, where: str) -> float:
    """The finite number that a cell of a text file holds; raises DriveError, which names ``where``."""
    try:
        value = float("" if "_" in text else text)  # in which Python allows it
    except ValueError:
        comma = "; write a decimal point" if "," in text else ""
        raise DriveError(f"{where}: {shown(text)} is not a number{comma}; fix that line") from None
    if not np.isfinite(value):
        raise DriveError(f"{where}: {shown(text)} is not a finite number; drop or fix that line")
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
    """Rows (K,) by time, the first of equal times; refuses stamps a second or more behind an earlier one.

    A few such stamps among many are left out instead, and counted.
    """
    if not len(stamp_s):
        raise DriveError(f"{where}: holds no pose; record some, or check what it is")
    if not np.isfinite(stamp_s).all():
        row = int(np.argmin(np.isfinite(stamp_s))) + 1
        raise DriveError(f"{where}: {what} {row}: its time is not finite")
    late_s = np.maximum.accumulate(stamp_s) - stamp_s
    if late_s.max() < LATE_S:
        return np.unique(stamp_s, return_index=True)[1]
    rows = _longest_rising(stamp_s)
    strays = len(stamp_s) - len(rows)
    late_among_s = np.maximum.accumulate(stamp_s[rows]) - stamp_s[rows]
    if strays > _STRAYS * len(stamp_s) or late_among_s.max() >= LATE_S:
        k = int(np.argmax(late_s >= LATE_S))
        raise DriveError(
            f"{where}: {what} {k + 1}: its time {stamp_s[k]:.3f} s is {late_s[k]:.3f} s before that of an "
            "earlier one: two clocks or two recordings in one; keep one of them"
        )
    _log.warning("%s: left out %d of %d times that are out of order", where, strays, len(stamp_s))
    return np.asarray(rows[np.unique(stamp_s[rows], return_index=True)[1]])


def _longest_rising(stamp_s: FloatArray) -> IntArray:
    """Rows (K,) of the longest series of stamps that never falls."""
    ends: list[float] = []  # the least end of a series of each length
    row_of_end: list[int] = []
    before: list[int] = []
    for row, stamp in enumerate(stamp_s.tolist()):
        length = bisect_right(ends, stamp)
        before.append(row_of_end[length - 1] if length else -1)
        ends[length : length + 1] = [stamp]
        row_of_end[length : length + 1] = [row]
    rows = []
    row = row_of_end[-1]
    while row >= 0:
        rows.append(row)
        row = before[row]
    return np.array(rows[::-1])


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
        if (clocks := known_offset(image_stamp_s, pose_stamp_s, asking, asked)) is not None:
            return clocks
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


def known_offset(
    image_span_s: Sequence[float] | FloatArray,
    pose_span_s: Sequence[float] | FloatArray,
    asking: str = "images",
    asked: str = "poses",
) -> str | None:
    """The names of two clocks whose times begin and end as much apart as such clocks differ."""
    begins_s = float(image_span_s[0] - pose_span_s[0])
    ends_s = float(image_span_s[-1] - pose_span_s[-1])
    # Zones only shift times of a calendar.
    dated = min(image_span_s[0], pose_span_s[0]) > _OLDEST_S
    causes = dict(_CLOCKS) | {3600.0 * hours: "time zones apart" for hours in _ZONES_H if dated}

    def off_s(apart_s: float) -> float:
        return float(max(abs(abs(begins_s) - apart_s), abs(abs(ends_s) - apart_s)))

    apart_s = min(causes, key=off_s)
    tolerance_s = _SAME_SPAN_S if apart_s < _HALF_HOUR_S else _SAME_START_S
    if off_s(apart_s) > tolerance_s or begins_s * ends_s < 0:
        return None
    sign = 1 if begins_s > 0 else -1
    return (
        f"the {asking}' times are {apart_s:.0f} s {'ahead of' if sign > 0 else 'behind'} the {asked}': "
        f"{causes[apart_s]}; put both on one clock, as with offset_s: {sign * apart_s:.0f} under poses"
    )


def unit_of(stamp_s: FloatArray) -> str | None:
    """The unit of stamps (N,) that cannot be seconds, None where they can."""
    step_s = float(np.median(np.diff(stamp_s))) if len(stamp_s) > 1 else 0.0
    if step_s <= LONGEST_S and stamp_s[-1] < _LATEST_S:
        return None
    for unit, scale in _UNITS.items():
        if _QUICKEST_S <= step_s / scale <= 1.0 and stamp_s[-1] / scale < _LATEST_S:
            return unit
    return None


def span(stamp_s: FloatArray) -> str:
    """The first and the last of some stamps, s, in words."""
    return f"{stamp_s[0]:.3f} to {stamp_s[-1]:.3f} s"
