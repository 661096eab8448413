"""The stated noise of the poses: its units, and against what the poses themselves show."""

from __future__ import annotations

import numpy as np

from v2hdm.records import FloatArray, PoseNoise
from v2hdm.verdict.inputs.motion import Motion, angle_between
from v2hdm.verdict.judgement import judge
from v2hdm.verdict.verdict import Finding, Status

_RTK_M = 0.3
"""A position that is worse than this is no RTK, not even with a float solution."""

_HEADING_RAD = 0.035
"""Two degrees: worse than any heading from two antennas a metre apart, or from a gyro compass."""

_ROLL_PITCH_RAD = 0.05
"""Three degrees: a vehicle that sways more than this on its suspension overturns."""

_UNDERSTATED = 3.0
"""Poses that scatter this many times more than stated make every sigma of the map wrong by as much."""

_USELESS = 10.0
"""Poses that scatter this many times more than stated make a map that is wrong, not only overconfident."""

_DIFFERENCES = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
"""The fourth difference: driving at 10 Hz leaves millimetres in it, white noise sqrt(70) sigmas."""

_REGULAR = 0.2
"""Poses whose intervals vary less than this share are evenly spaced, as a fourth difference needs."""

_SLOWEST_HZ = 8.0
"""Below this rate driving itself shows in a fourth difference."""


def check_noise(motion: Motion, noise: PoseNoise) -> list[Finding]:
    """Whether the stated noise has the right units and the poses' own scatter."""
    return [
        *_units(motion, noise),
        *_scatter(motion, noise),
    ]


def _units(motion: Motion, noise: PoseNoise) -> list[Finding]:
    scatter = _white_position_m(motion)
    measured = "" if scatter is None else f"; from pose to pose they scatter by {scatter:.3f} m"
    if noise.position_m > 1:
        measured += f"; if millimetres were meant, it is {noise.position_m / 1e3:g} m"
    return [
        _unit("position_m", noise.position_m, _RTK_M, "m", f"no RTK position{measured}", "metres"),
        _unit(
            "heading_rad", noise.heading_rad, _HEADING_RAD, "rad", _in_degrees(noise.heading_rad), "radians"
        ),
        _unit(
            "roll_pitch_rad", noise.roll_pitch_rad, _ROLL_PITCH_RAD, "rad",
            _in_degrees(noise.roll_pitch_rad), "radians",
        ),
    ]  # fmt: skip


def _unit(key: str, value: float, limit: float, unit: str, means: str, wanted: str) -> Finding:
    if value == 0:
        says = f"{key} is 0, which no receiver reaches; state its standard deviation in {wanted}"
        return Finding("pose noise", Status.WARN, value, limit, unit, says, f"pose_noise.{key}")
    return judge(
        "pose noise", f"pose_noise.{key}", value, limit, unit,
        fine=f"{key} is that of a good receiver",
        wrong=f"{key} {value:g} is {means}; state it in {wanted}, as a standard deviation",
        status=Status.WARN,
    )  # fmt: skip


def _in_degrees(value: float) -> str:
    return f"{np.rad2deg(value):.1f} deg; if degrees were meant, it is {np.deg2rad(value):.4f} rad"


def _scatter(motion: Motion, noise: PoseNoise) -> list[Finding]:
    findings = []
    position = _white_position_m(motion)
    if position is not None and noise.position_m > 0:
        findings.append(_against("position_m", position, noise.position_m, "m"))
    heading = _white_heading_rad(motion)
    if heading is not None and noise.heading_rad > 0:
        findings.append(_against("heading_rad", heading, noise.heading_rad, "rad"))
    return findings


def _against(key: str, measured: float, stated: float, unit: str) -> Finding:
    ratio = measured / stated
    degrees = " (degrees taken for radians would do that)" if unit == "rad" and ratio > _USELESS else ""
    return judge(
        "pose scatter", "poses", ratio, _UNDERSTATED, "",
        fine="the poses scatter no more than stated",
        wrong=f"from pose to pose they scatter by {measured:.2g} {unit}, {ratio:.0f} times pose_noise.{key} "
        f"{stated:.2g}{degrees}; state {key} as it is, or find out why the receiver is worse than it says",
        status=Status.FAIL if ratio > _USELESS else Status.WARN,
    )  # fmt: skip


def _white_position_m(motion: Motion) -> float | None:
    """Standard deviation per axis of what changes from pose to pose; None where driving would hide it."""
    if not _is_regular(motion):
        return None
    return _robust_sigma(np.column_stack([_fourth(axis) for axis in motion.position[:, :2].T]).ravel())


def _white_heading_rad(motion: Motion) -> float | None:
    if not _is_regular(motion):
        return None
    forward = motion.rotation[:, :2, 0]
    heading = np.concatenate([[0.0], np.cumsum(angle_between(forward[:-1], forward[1:]))])
    return _robust_sigma(_fourth(heading))


def _fourth(values: FloatArray) -> FloatArray:
    return np.convolve(values, _DIFFERENCES, mode="valid") / float(np.linalg.norm(_DIFFERENCES))


def _robust_sigma(values: FloatArray) -> float:
    return float(1.4826 * np.median(np.abs(values)))


def _is_regular(motion: Motion) -> bool:
    if len(motion.stamp_s) < 50:
        return False
    interval_s = float(np.median(motion.interval_s))
    uneven = np.abs(motion.interval_s / interval_s - 1) > _REGULAR
    return bool(interval_s <= 1 / _SLOWEST_HZ and uneven.mean() < _REGULAR)
