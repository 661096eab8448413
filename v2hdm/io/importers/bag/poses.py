"""Messages that say where the vehicle was, as readings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import UTC, date, datetime
from typing import Any

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.rigid import rotation_from_quaternion
from v2hdm.io.importers.poses.nmea import nmea_readings
from v2hdm.io.importers.poses.readings import Attitudes, Readings
from v2hdm.io.importers.poses.rising import in_order
from v2hdm.records import FloatArray

ODOMETRY = "nav_msgs/msg/Odometry"
FIX = "sensor_msgs/msg/NavSatFix"
TF, OLD_TF = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"
NMEA = "nmea_msgs/msg/Sentence"
_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_POSE = "geometry_msgs/msg/PoseStamped"
IMU = "sensor_msgs/msg/Imu"
QUATERNION = "geometry_msgs/msg/QuaternionStamped"

POSE_KINDS = (ODOMETRY, _WITH_COVARIANCE, _POSE, FIX, NMEA, TF)
HEADING_KINDS = (IMU, QUATERNION, ODOMETRY, _WITH_COVARIANCE, _POSE)

_NO_FIX = -1
_NORM_TOLERANCE = 1e-2
_YAW = 35
"""Place of the variance of yaw among the 36 numbers of a pose's covariance (REP-103)."""

Row = tuple[float, ...]


def position_row(kind: str, fields: Any) -> Row:
    """Position (3), standard deviation (1, nan if not stated), quaternion (4, nan if none), its sigma (1)."""
    return _POSITIONS[kind](fields)


def heading_row(kind: str, fields: Any) -> Row:
    """Quaternion (4) and the standard deviation of its heading (1), nan if not stated."""
    if kind == IMU:
        if fields.orientation_covariance[0] < 0:  # sensor_msgs: this Imu measures no orientation
            return (np.nan,) * 5
        return (*_quaternion(fields.orientation), _sigma(fields.orientation_covariance[8]))
    if kind == QUATERNION:
        return (*_quaternion(fields.quaternion), np.nan)
    return position_row(kind, fields)[4:]


def readings_of(
    kind: str,
    positions: tuple[FloatArray, FloatArray],
    headings: tuple[FloatArray, FloatArray] | None,
    where: str,
) -> Readings:
    """Readings of the rows (P, 9) of a topic at its stamps (P,), and of rows (A, 5) of a topic of headings.

    Raises:
        DriveError: times do not rise, or something is not finite.
    """
    stamp_s, rows = positions
    order = in_order(stamp_s, where, "message")
    stamp_s, rows = stamp_s[order], rows[order]
    if not np.isfinite(rows[:, :3][~np.isinf(rows[:, 3])]).all():
        raise DriveError(f"{where}: holds a position that is not finite; record it anew")
    if headings is not None:
        heading_s, turned = headings
        by_time = in_order(heading_s, where, "message of the heading")
        heading_s, turned = heading_s[by_time], turned[by_time]
    else:
        heading_s, turned = stamp_s, rows[:, 4:]
    # A dual antenna writes nan where it has none.
    known = np.isfinite(turned[:, :4]).all(axis=1)
    attitudes = None
    if known.any():
        norm = np.linalg.norm(turned[known, :4], axis=1, keepdims=True)
        if (np.abs(norm - 1) > _NORM_TOLERANCE).any():
            raise DriveError(
                f"{where}: holds a quaternion of norm {norm[np.argmax(np.abs(norm - 1)), 0]:.3g}: no "
                "orientation was measured there; choose another topic for the heading"
            )
        rotation = rotation_from_quaternion(turned[known, :4] / norm)
        attitudes = Attitudes(heading_s[known], rotation, turned[known, 4])
    geodetic = kind == FIX
    return Readings(stamp_s, rows[:, :3], geodetic, rows[:, 3], attitudes, antenna=geodetic)


def readings_of_sentences(stamp_s: FloatArray, lines: list[str], where: str) -> Readings:
    """Readings of NMEA sentences in messages; these also tell the day."""
    day: date = datetime.fromtimestamp(float(stamp_s[0]), tz=UTC).date()
    return nmea_readings(lines, where, day)


def _pose(pose: Any, covariance: Any) -> Row:
    place = pose.position
    sigma_m, sigma_rad = np.nan, np.nan
    if covariance is not None:
        sigma_m, sigma_rad = _sigma((covariance[0] + covariance[7]) / 2), _sigma(covariance[_YAW])
    return (place.x, place.y, place.z, sigma_m, *_quaternion(pose.orientation), sigma_rad)


def _fix(fields: Any) -> Row:
    sigma_m = np.nan
    if fields.position_covariance_type:
        sigma_m = _sigma((fields.position_covariance[0] + fields.position_covariance[4]) / 2)
    if fields.status.status <= _NO_FIX:
        sigma_m = np.inf
    return (fields.latitude, fields.longitude, fields.altitude, sigma_m, *([np.nan] * 5))


def _quaternion(orientation: Any) -> Row:
    return (orientation.x, orientation.y, orientation.z, orientation.w)


def _sigma(variance: float) -> float:
    """Standard deviation, nan of a variance that stands for "not known"."""
    return float(np.sqrt(variance)) if variance > 0 else np.nan


_POSITIONS: Mapping[str, Callable[[Any], Row]] = {
    ODOMETRY: lambda fields: _pose(fields.pose.pose, fields.pose.covariance),
    _WITH_COVARIANCE: lambda fields: _pose(fields.pose.pose, fields.pose.covariance),
    _POSE: lambda fields: _pose(fields.pose, None),
    FIX: _fix,
}
