"""Headings of a drive with one antenna, their noise, and what is wrong with gyro, antenna or direction."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.planar import length_along
from v2hdm.io.importers.course.directions import Directions, directions_of
from v2hdm.io.importers.course.recording import Course
from v2hdm.io.importers.course.smoother import Smoothed, smooth
from v2hdm.io.importers.course.terms import SHARED_SIGMAS, SLIP, Shared
from v2hdm.records import FloatArray

_log = logging.getLogger(__name__)

STARTS = ("forward", "backward")
"""The direction of a drive's beginning, as ``starts`` states it."""

_SURE = 9.0  # twice the log of a likelihood ratio of 90 to 1, as for poses in slip.py
_TURNED_RAD = float(np.radians(25))  # a turn that shows a gyro's unit and sign: ten sigmas of a course
_COURSE_RAD = 0.05  # standard deviation of the course of a short chord, rad
_WINDOW_S = 3.0  # time over which turns of the gyro and of the course are compared; chosen
_GYRO_SCALES = (0.8, 1.25)  # a gyro's turns over the course's: more is no error of scale; chosen
_DEGREES = (40.0, 80.0)  # the same of a gyro in degrees per second, 57
_RADIANS = (0.012, 0.025)  # and of one in radians that is taken for degrees, 1 / 57
_OFF_SIGMAS = 4.0  # misfit, sigmas, at which the antenna is elsewhere than stated: by chance once in 16,000
_MISFIT = 3.0  # root mean square of residuals, in sigmas, beyond which a recording is not as it should be
_DRIFTING = 0.9  # share of the variance of such headings that drifts: neighbours share all positions


class CourseHeadings(NamedTuple):
    """Headings (P,) to the left of x, rad, the antenna's place, and the fields of PoseNoise for them."""

    heading_rad: FloatArray
    lever_ahead_m: float
    noise: dict[str, float]


def course_headings(course: Course, starts: str | None, where: str) -> CourseHeadings:
    """The headings of a drive that begins as ``starts`` says, one of STARTS; None leaves that open.

    Raises DriveError where the drive does not tell, or its gyro or its positions are not those of a vehicle.
    """
    directions = directions_of(course, where)
    _check_gyro(course, directions, where)
    smoothed = _likelier(course, directions, starts, where)
    _tell(course, smoothed, where)
    # Residuals that are larger than they should be make the headings less sure by as much.
    misfit = max(1.0, *smoothed.misfit.values())
    sigma_rad = misfit * float(np.sqrt(np.mean(smoothed.sigma_rad**2)))
    noise = {
        "heading_rad": sigma_rad,
        "heading_drift_rad": float(np.sqrt(_DRIFTING)) * sigma_rad,
        "heading_drift_over_m": max(1.0, smoothed.faded_m),
        "heading_slip": float(smoothed.shared_sigma[Shared.SLIP]),
    }
    lever_ahead_m = float(course.lever_arm_m[0] + smoothed.shared[Shared.LEVER])
    return CourseHeadings(smoothed.heading_rad, lever_ahead_m, noise)


def _check_gyro(course: Course, directions: Directions, where: str) -> None:
    """Refuse a gyro whose turns are not those of the course: of a wrong unit, sign or time."""
    if not course.has_gyro:
        return
    stride = max(1, round(_WINDOW_S / float(np.median(course.interval_s))))
    total = np.concatenate([[0.0], np.cumsum(course.turn_rad)])  # nan behind a gap of the gyro
    begins = np.arange(0, len(total) - stride, stride)
    turn_rad = directions.heading_rad[begins + stride] - directions.heading_rad[begins]
    of_gyro = total[begins + stride] - total[begins]
    is_turn = np.isfinite(of_gyro) & (np.abs(turn_rad) > _TURNED_RAD)
    if not is_turn.any():
        return
    lasts_s = course.stamp_s[begins + stride] - course.stamp_s[begins]
    # Turns to one side alone leave the bias to what is known of it.
    columns = np.vstack([np.column_stack([turn_rad, lasts_s])[is_turn], [0.0, 1.0]])
    weight = np.append(np.ones(int(is_turn.sum())), _COURSE_RAD / SHARED_SIGMAS[Shared.GYRO_BIAS])
    target = np.append(of_gyro[is_turn], 0.0)
    scale = float(np.linalg.lstsq(columns * weight[:, None], target * weight, rcond=None)[0][0])
    if _GYRO_SCALES[0] <= scale <= _GYRO_SCALES[1]:
        return
    size = abs(scale)
    if _DEGREES[0] <= size <= _DEGREES[1]:
        says = "57 times as fast as the course: it is in deg/s; name it yaw_rate_deg_s or convert it to rad/s"
    elif _RADIANS[0] <= size <= _RADIANS[1]:
        says = "57 times too slowly: it is in rad/s; name it yaw_rate_rad_s"
    elif -_GYRO_SCALES[1] <= scale <= -_GYRO_SCALES[0]:
        says = "the other way: its z axis points down; add mounting_rpy_deg: [180, 0, 0], or change its sign"
    else:
        says = f"{scale:.2f} times as fast as the course: check its axis, unit and clock"
    raise DriveError(f"{where}: the gyro turns {says}")


def _likelier(course: Course, directions: Directions, starts: str | None, where: str) -> Smoothed:
    """The drive as ``starts`` says, else as the antenna swings in turns, else forward for the most part."""
    if starts is not None:
        return smooth(course, directions if starts == STARTS[0] else directions.turned, where)
    if course.speed_is_signed:
        return smooth(course, _by_wheels(course, directions), where)
    way_m = np.diff(length_along(course.antenna_map))
    is_mostly_forward = bool(way_m[directions.forward[1:] > 0].sum() >= 0.5 * way_m.sum())
    forward = smooth(course, directions, where)
    # Without a gyro only the smoothness of the path would tell, by millimetres.
    gain = forward.cost - smooth(course, directions.turned, where).cost if course.has_gyro else 0.0
    begins_forward = is_mostly_forward if abs(gain) < _SURE else gain < 0
    if begins_forward and is_mostly_forward:
        return forward
    if begins_forward == is_mostly_forward:  # it backs out first, and so the antenna swings or may swing
        return smooth(course, directions.turned, where)
    raise DriveError(
        f"{where}: in turns the antenna swings as if the vehicle drove backward most of the way: if it does, "
        f"add starts: {STARTS[0 if begins_forward else 1]}; if not, add "
        f"starts: {STARTS[1 if begins_forward else 0]} and check the sign of lever_arm_m"
    )


def _by_wheels(course: Course, directions: Directions) -> Directions:
    """The directions that wheels with a sign agree with."""
    forward = directions.forward[1:]
    agreement = float(np.nansum(forward * course.speed_m_s))
    return directions if agreement >= 0 else directions.turned


def _tell(course: Course, smoothed: Smoothed, where: str) -> None:
    """Say how sure the headings are, and what does not fit."""
    _log.info(
        "%s: headings from the course%s: sigma %.2f deg, gyro's bias %.3f deg/s",
        where, " and the gyro" if course.has_gyro else "",
        np.degrees(np.sqrt(np.mean(smoothed.sigma_rad**2))), np.degrees(smoothed.shared[Shared.GYRO_BIAS]),
    )  # fmt: skip
    off_m = float(smoothed.shared[Shared.LEVER])
    if abs(off_m) > _OFF_SIGMAS * SHARED_SIGMAS[Shared.LEVER]:
        _log.warning(
            "%s: in turns the antenna moves as one %.2f m %s than lever_arm_m says (+-%.2f m), and is taken "
            "there: measure it again, from the rear axle",
            where, abs(off_m), "farther ahead" if off_m > 0 else "farther back",
            smoothed.shared_sigma[Shared.LEVER],
        )  # fmt: skip
    slip_sigmas = (float(smoothed.shared[Shared.SLIP]) - SLIP) / SHARED_SIGMAS[Shared.SLIP]
    if course.has_gyro and abs(slip_sigmas) > _OFF_SIGMAS:
        _log.warning(
            "%s: in turns the vehicle drives beside its heading as no tyre slips: measure lever_arm_m again, "
            "from the rear axle, and check the gyro's clock", where,
        )  # fmt: skip
    for name, misfit in smoothed.misfit.items():
        if misfit > _MISFIT:
            _log.warning(
                "%s: its %s fit a vehicle's path %.1f times worse than stated; the headings count as "
                "that much less sure", where, name, misfit,
            )  # fmt: skip
