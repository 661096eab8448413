"""The recorded path: its unit, its jumps, its attitude."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from v2hdm.records import FloatArray, PoseNoise
from v2hdm.verdict.inputs.motion import CHORD_M, SLOWEST_MPS, Motion
from v2hdm.verdict.judgement import judge
from v2hdm.verdict.verdict import Finding, Status

_FASTEST_MPS = 40.0
"""No vehicle maps markings faster (144 km/h): its images would be metres apart."""

_HARDEST_MPS2 = 9.0
"""No tyre turns or brakes a road vehicle harder."""

_EXTREME = 12.0
"""A second difference of noisy positions has sqrt(6) sigmas; five of those are never seen by chance."""

_HEIGHT_NOISE = 2.0
"""RTK heights are about twice as noisy as positions in the plane."""

_STEEPEST_DEG = 15.0
"""No road that is mapped is steeper, nor rolls a vehicle farther."""

_TOO_LARGE: Mapping[str, float] = {"centimetres": 1e2, "millimetres": 1e3}
_TOO_SMALL: Mapping[str, float] = {"kilometres": 1e3, "degrees": 1.113e5, "radians": 6.378e6}
"""Metres in a unit that positions may be in by mistake; of an angle on the earth at the equator."""

_GRADE_CHANGE_RAD = 0.02
"""Grades must spread over this (2 %) before the sign of the pitch can be told."""


def check_path(motion: Motion) -> list[Finding]:
    """Whether the path is one that a road vehicle drives in metres and seconds."""
    if not len(motion.chords):
        return [_hardly_moves(motion)]
    speed = float(np.percentile(motion.speed_mps, 95))
    units = [name for name, scale in _TOO_LARGE.items() if SLOWEST_MPS < speed / scale < _FASTEST_MPS / 2]
    cause = f"positions in {' or '.join(units)}" if units else "positions that are not in metres"
    return [
        judge(
            "speed", "poses", speed, _FASTEST_MPS, "m/s",
            fine="the vehicle's speed is one of a road vehicle",
            wrong=f"the vehicle drives at {speed:.0f} m/s: {cause}, or stamps that are not seconds; convert "
            "them",
        )
    ]  # fmt: skip


def check_jumps(motion: Motion, noise: PoseNoise) -> list[Finding]:
    """Whether positions and heights jump by more than noise and tyres allow."""
    if len(motion.stamp_s) < 3 or not len(motion.chords):
        return []
    plane, height = _off_line(motion, motion.position[:, :2]), _off_line(motion, motion.position[:, 2:])
    longest_s = np.maximum(motion.interval_s[:-1], motion.interval_s[1:])
    spare = 0.5 * _HARDEST_MPS2 * longest_s**2
    return [
        _jump("position jumps", motion, plane, _EXTREME * noise.position_m / 2 + spare),
        _jump("height jumps", motion, height, _EXTREME * _HEIGHT_NOISE * noise.position_m / 2 + spare),
    ]


def check_attitude(motion: Motion) -> list[Finding]:
    """Whether roll and pitch are those of a road vehicle, and pitch has the sign of the grade."""
    pitch_rad = -np.arcsin(np.clip(motion.rotation[:, 2, 0], -1, 1))
    roll_rad = np.arctan2(motion.rotation[:, 2, 1], motion.rotation[:, 2, 2])
    largest_deg = float(
        np.rad2deg(max(np.percentile(np.abs(roll_rad), 95), np.percentile(np.abs(pitch_rad), 95)))
    )
    findings = [
        judge(
            "attitude", "poses", largest_deg, _STEEPEST_DEG, "deg",
            fine="roll and pitch are those of a vehicle on a road",
            wrong=f"roll or pitch reach {largest_deg:.0f} deg, no vehicle's on a road: were degrees taken "
            f"for radians (then it is {np.deg2rad(largest_deg):.1f} deg), or the quaternions not in the "
            "order qx qy qz qw?",
        )
    ]  # fmt: skip
    return findings + _pitch_sign(motion, pitch_rad)


def _hardly_moves(motion: Motion) -> Finding:
    lag_s = CHORD_M / SLOWEST_MPS
    moved_m = float(np.linalg.norm(np.ptp(motion.position[:, :2], axis=0)))
    for unit, scale in _TOO_SMALL.items():
        scaled = Motion(motion.stamp_s, motion.position * scale, motion.rotation)
        if len(scaled.chords) < 0.2 * len(motion.stamp_s) or not _is_smooth(scaled):
            continue
        return Finding(
            "path length", Status.FAIL, moved_m, CHORD_M, "m",
            f"positions are in {unit}: the path is {moved_m:.2g} m long and smooth; convert them to metres "
            "east and north of the site",
            "poses",
        )  # fmt: skip
    return Finding(
        "path length", Status.FAIL, moved_m, CHORD_M, "m",
        f"the vehicle nowhere moves {CHORD_M:g} m in {lag_s:g} s: a drive that stands maps nothing; check "
        "that positions are in metres and stamps in seconds",
        "poses",
    )  # fmt: skip


def _is_smooth(motion: Motion) -> bool:
    """Whether most chords are driven at a vehicle's speed and about as long as the way between their ends."""
    way = np.concatenate([[0.0], np.cumsum(motion.step_m)])
    chords = motion.chords
    straight = motion.speed_mps * (motion.stamp_s[chords.last] - motion.stamp_s[chords.first])
    directed = straight > 0.8 * (way[chords.last] - way[chords.first])
    return bool((directed & (motion.speed_mps < _FASTEST_MPS)).mean() > 0.8)


def _off_line(motion: Motion, values: FloatArray) -> FloatArray:
    """How far (P - 2, D) each value is from the line between its neighbours."""
    part = (motion.interval_s[:-1] / (motion.interval_s[:-1] + motion.interval_s[1:]))[:, None]
    return np.asarray(values[1:-1] - (values[:-2] + part * (values[2:] - values[:-2])))


def _jump(check: str, motion: Motion, off: FloatArray, limit: FloatArray) -> Finding:
    """The worst of all offsets ``off`` (P - 2, D), m, from the line between the neighbours, by its limit."""
    size = np.linalg.norm(off, axis=1)
    worst = int(np.argmax(size / limit))
    count = int((size > limit).sum())
    # A step shows as half of it before and minus half of it behind.
    beside = off[max(worst - 1, 0) : worst + 2]
    step_m = float(np.linalg.norm(beside - off[worst], axis=1).max())
    kind = "the position" if check.startswith("position") else "the height"
    return judge(
        check, "poses", float(size[worst]), float(limit[worst]), "m",
        fine=f"{kind} never jumps",
        wrong=f"{kind} jumps by {step_m:.2f} m at {motion.stamp_s[worst + 1]:.2f} s ({count} such records): "
        "the receiver lost its RTK fix; leave that stretch out, or state its noise in pose_noise",
    )  # fmt: skip


def _pitch_sign(motion: Motion, pitch_rad: FloatArray) -> list[Finding]:
    """Compare the pitch (positive nose down) with the recorded grade, where both change enough."""
    chords = motion.chords
    if not len(chords):
        return []
    offset = motion.position[chords.last] - motion.position[chords.first]
    forward = motion.rotation[chords.first, :2, 0]
    along = (offset[:, :2] * forward).sum(axis=1)
    grade_rad = np.arctan2(offset[:, 2] * np.sign(along), np.abs(along))
    middle = (pitch_rad[chords.first] + pitch_rad[chords.last]) / 2
    spread = np.subtract(*np.percentile(grade_rad, [95, 5]))
    if spread < _GRADE_CHANGE_RAD or np.std(middle) < 0.3 * np.std(grade_rad):
        return []
    slope = float(np.cov(middle, -grade_rad)[0, 1] / np.var(grade_rad))
    return [
        judge(
            "pitch sign", "poses", 1 - slope, 1.0, "",
            fine="the pitch follows the grade",
            wrong="the recorded pitch goes against the grade: it counts nose up; write pitch positive nose "
            "down (a rotation about y, which points left)",
        )
    ]  # fmt: skip
