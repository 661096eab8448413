"""Lines of an odometry, of detections and of poses: what ``v2hdm localize --live`` reads and writes."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from v2hdm.errors import ConfigError, shown
from v2hdm.geometry.geodetic import enu_from_geodetic
from v2hdm.geometry.rigid import euler_from_rotation
from v2hdm.localization.antenna import Fix
from v2hdm.localization.motion import Motion
from v2hdm.localization.pose import Pose
from v2hdm.localization.seeing import Look
from v2hdm.records import FloatArray, GeodeticOrigin, LaneDetection, MarkingDetection

_MOTION = ("stamp_s", "speed_m_s", "yaw_rate_rad_s")
_LOCAL = ("stamp_s", "east_m", "north_m", "sigma_m")
_GEODETIC = ("stamp_s", "latitude_deg", "longitude_deg", "sigma_m")
_GIVE = f"give {', '.join(_MOTION)}, or a position: {', '.join(_LOCAL)}, or {', '.join(_GEODETIC)}"
_MARKS = 3  # decimals of m in a line, and more of rad

_Item = Motion | Fix


class MotionLines:
    """The lines of an odometry: JSON objects, or CSV under a header; positions by RTK may be among them.

    ``origin`` is the map's, for positions in degrees.
    """

    def __init__(self, where: str, origin: GeodeticOrigin | None) -> None:
        self._where = where
        self._origin = origin
        self._columns: list[str] | None = None
        self._number = 0

    def read(self, line: str) -> _Item | None:
        """The content of a line; None for an empty one and the header. ConfigError where it is unreadable."""
        self._number += 1
        line = line.strip()
        if not line:
            return None
        at = f"{self._where}, line {self._number}"
        if line.startswith("{"):
            try:
                content = json.loads(line)
            except ValueError as error:
                raise ConfigError(f"{at}: is not a JSON object ({error}); {_GIVE}") from None
        elif self._columns is None:
            self._columns = [name.strip() for name in line.split(",")]
            if not any(set(need) <= set(self._columns) for need in (_MOTION, _LOCAL, _GEODETIC)):
                raise ConfigError(f"{at}: the header {shown(line)} names no motion; {_GIVE}")
            return None
        else:
            content = dict(zip(self._columns, line.split(","), strict=False))
        return self._item(content, at)

    def _item(self, content: Mapping[str, Any], at: str) -> _Item:
        if set(_MOTION) <= content.keys():
            return Motion(*(_number(content[key], f"{at}, {key}") for key in _MOTION))
        if set(_LOCAL) <= content.keys():
            stamp_s, east_m, north_m, sigma_m = (_number(content[key], f"{at}, {key}") for key in _LOCAL)
            return Fix(stamp_s, np.array([east_m, north_m]), _positive(sigma_m, f"{at}, sigma_m"))
        if set(_GEODETIC) <= content.keys():
            stamp_s, latitude, longitude, sigma_m = (
                _number(content[key], f"{at}, {key}") for key in _GEODETIC
            )
            if self._origin is None:
                raise ConfigError(f"{at}: the map has no origin on the earth; give east_m and north_m")
            place = np.array([[latitude, longitude, self._origin.altitude_m]])
            east_north_m = enu_from_geodetic(self._origin, place)[0, :2]
            return Fix(stamp_s, east_north_m, _positive(sigma_m, f"{at}, sigma_m"))
        raise ConfigError(f"{at}: has {shown(', '.join(map(str, content)))}; {_GIVE}")


def _number(value: object, at: str) -> float:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ConfigError(f"{at} is {shown(value)}; give a number")
    return number


def _positive(value: float, at: str) -> float:
    if value <= 0:
        raise ConfigError(f"{at} is {value:g}; give a standard deviation above 0")
    return value


def look_of(record: Mapping[str, Any], camera: str) -> Look:
    """The detections of one line of ``v2hdm detect``."""
    markings = tuple(map(_marking, record["markings"]))
    lanes = tuple(map(_lane, record["lanes"]))
    is_whole = record.get("whole", True)
    is_second = record.get("second", False)
    return Look(camera, float(record["stamp_s"]), markings, lanes, is_whole, is_second)


def _lane(record: Mapping[str, Any]) -> LaneDetection:
    points_px = np.array(record["points_px"], dtype=np.float64).reshape(-1, 2)
    return LaneDetection(record["class"], record["score"], points_px, record.get("identity"))


def _marking(record: Mapping[str, Any]) -> MarkingDetection:
    outline = np.array(record.get("outline_px", []), dtype=np.float64).reshape(-1, 2)
    if "corners_px" not in record:
        nothing = np.full((4, 2), np.nan)
        silent = np.full((8, 8), np.nan)
        is_seen = np.array(record.get("outline_seen", []), dtype=bool)
        return MarkingDetection(
            record["class"], record["score"], nothing, silent, np.zeros(4, bool), outline, is_seen
        )
    return MarkingDetection(
        record["class"],
        record["score"],
        np.array(record["corners_px"], dtype=np.float64),
        np.array(record["covariance_px"], dtype=np.float64),
        np.array(record["corner_valid"], dtype=bool),
    )


class PoseLine(NamedTuple):
    """A pose's line, and how old it was, s."""

    line: str
    age_s: float


def pose_record(pose: Pose) -> dict[str, Any]:
    """The content of one JSON line (docs/live.md); what is unknown is null."""
    record: dict[str, Any] = {"stamp_s": round(pose.stamp_s, 6), "status": pose.status.value}
    at = pose.map_from_vehicle
    if at is None:
        record |= {"east_m": None, "north_m": None, "up_m": None, "heading_rad": None, "roll_rad": None}
        record["pitch_rad"] = None
    else:
        roll, pitch, heading = euler_from_rotation(at[:3, :3]).tolist()
        east, north, up = at[:3, 3].tolist()
        record |= {"east_m": round(east, 4), "north_m": round(north, 4), "up_m": round(up, 4)}
        record |= {"heading_rad": round(heading, 6), "roll_rad": round(roll, 6), "pitch_rad": round(pitch, 6)}
    record["covariance"] = _finite(pose.covariance)
    ahead, left = pose.protection_m
    record["protection"] = {
        "ahead_m": _or_none(ahead), "left_m": _or_none(left), "heading_rad": _or_none(pose.protection_rad)
    }  # fmt: skip
    motion = ("speed_scale", "yaw_bias_rad_s", "odometry_late_s")
    record |= {name: round(value, 6) for name, value in zip(motion, pose.motion, strict=True)}
    record["images_s"] = {camera: round(stamp_s, 6) for camera, stamp_s in pose.images_s.items()}
    record["matched"] = pose.matched
    record["matched_lines"] = pose.matched_lines
    record["matched_areas"] = pose.matched_areas
    record["reasons"] = list(pose.reasons)
    record["turned"] = [
        {
            "camera": camera_turn.camera,
            "since_s": camera_turn.since_s,
            "angle": camera_turn.angle,
            "slow": camera_turn.is_slow,
            "deg": camera_turn.turn_deg,
            "sigma_deg": camera_turn.sigma_deg,
        }
        for camera_turn in pose.turned
    ]
    return record


def _or_none(value: float) -> float | None:
    return round(value, 5) if math.isfinite(value) else None


def _finite(matrix: FloatArray) -> Sequence[Sequence[float]] | None:
    if not np.isfinite(matrix).all():
        return None
    rows: list[list[float]] = [[float(f"{value:.4g}") for value in row] for row in matrix.tolist()]
    return rows
