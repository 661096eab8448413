"""The recorded poses: how the vehicle moved, units and jumps of the path, attitude, and stated noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import angle_between, cross, length_along
from v2hdm.ground.motion import trajectory_of_images
from v2hdm.records import HEIGHT_NOISE, SIGMA_OF_MAD, BoolArray, Drive, FloatArray, IntArray, PoseNoise
from v2hdm.verdict.verdict import Finding, Status, judge

# Length of the chords whose direction is the course: RTK noise of 2 cm turns one by less than a degree.
_CHORD_M = 2.0
# A vehicle that takes longer for a chord counts as standing: its path is then mostly noise.
_SLOWEST_MPS = 0.5

STEEPEST_DEG = 15.0  # no road that is mapped is steeper, nor rolls a vehicle farther

# Chords per drive: enough for medians to a hundredth of a degree, and a tenth of a second of work.
_MOST_STARTS = 4000
_FASTEST_MPS = 40.0  # no vehicle maps markings faster (144 km/h): its images would be metres apart
_HARDEST_MPS2 = 9.0  # no tyre turns or brakes a road vehicle harder
# A second difference of noisy positions has sqrt(6) sigmas; five of those are never reached by chance.
_EXTREME = 12.0
_LEAST_JITTER_MS = 5.0  # stamps that scatter less are as good as a drive needs them
# Four standard errors of the logarithm of a ratio of two robust sigmas of one offset: half the offsets count,
# as neighbours share poses, and a median absolute deviation is worth 0.37 of a standard deviation.
_SURE_JITTER = 4 / (0.5 * 0.37) ** 0.5
_TOO_LARGE: Mapping[str, float] = {"centimetres": 1e2, "millimetres": 1e3}
"""How many times too large positions are in a unit that they may be in by mistake."""

_TOO_SMALL: Mapping[str, float] = {"kilometres": 1e3, "degrees": 1.113e5, "radians": 6.378e6}
"""How many times too small positions are in a unit that they may be in by mistake; angles at the equator."""

_GRADE_CHANGE_RAD = 0.02  # grades must spread over this (2 %) before the sign of the pitch is observable
_PITCH_SIGMAS = 4.0  # that the pitch must go against the grade by: heights err, and grades with them
_RTK_M = 0.3  # a position that is worse than this is no RTK, not even with a float solution
# Two degrees: worse than any heading from two antennas a metre apart, or from a gyro compass.
_HEADING_RAD = 0.035
_ROLL_PITCH_RAD = 0.05  # three degrees: a vehicle that sways more than this on its suspension overturns
_UNDERSTATED = 3.0  # scatter of the poses over their stated noise beyond which the map's sigmas are wrong
_USELESS = 10.0  # scatter of the poses over their stated noise beyond which the map itself is wrong
# The fourth difference: driving at 10 Hz leaves millimetres in it, white noise sqrt(70) sigmas.
_DIFFERENCES = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
# Poses whose intervals vary less than this share are evenly spaced, as a fourth difference needs.
_REGULAR = 0.2
_LEAST_DIFFERENCES = 20  # fewer fourth differences show no scatter; chosen
_SLOWEST_HZ = 8.0  # below this rate driving itself shows in a fourth difference


@dataclass(frozen=True)
class Chords:
    """Chords of :data:`_CHORD_M` of the driven path: indices (N,) of their first and last pose."""

    first: IntArray
    last: IntArray

    def __len__(self) -> int:
        """The number of chords."""
        return len(self.first)


@dataclass(frozen=True)
class Motion:
    """The recorded trajectory: ``stamp_s`` (P,), ``position`` (P, 3), ``rotation`` (P, 3, 3)."""

    stamp_s: FloatArray
    position: FloatArray
    rotation: FloatArray

    @classmethod
    def of(cls, drive: Drive) -> Motion:
        """The poses of a drive as recorded, or those of its images without a recording."""
        poses = drive.recorded or drive.trajectory or trajectory_of_images(drive)
        return cls(poses.stamp_s, poses.map_from_vehicle[:, :3, 3], poses.map_from_vehicle[:, :3, :3])

    @cached_property
    def chords(self) -> Chords:
        """The chords from evenly spaced poses, where the vehicle moves."""
        stride = -(-len(self.stamp_s) // _MOST_STARTS)
        starts = range(0, len(self.stamp_s), stride)
        pairs = [(start, end) for start in starts if (end := self._reached(start)) is not None]
        first, last = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
        return Chords(first, last)

    @cached_property
    def interval_s(self) -> FloatArray:
        """Time (P - 1,) from each pose to the next."""
        return np.diff(self.stamp_s)

    @cached_property
    def step_m(self) -> FloatArray:
        """Distance (P - 1,) in the plane from each pose to the next."""
        return np.asarray(np.linalg.norm(np.diff(self.position[:, :2], axis=0), axis=1))

    @cached_property
    def moving(self) -> BoolArray:
        """Flags (P - 1,) of the steps from pose to pose that lie on a chord."""
        covered = np.zeros(len(self.stamp_s))
        np.add.at(covered, self.chords.first, 1)
        np.add.at(covered, self.chords.last, -1)
        return np.asarray(np.cumsum(covered)[:-1] > 0)

    @cached_property
    def course(self) -> FloatArray:
        """The vector (N, 2) in the plane from the first to the last pose of each chord, m."""
        return np.asarray(self.position[self.chords.last, :2] - self.position[self.chords.first, :2])

    @cached_property
    def speed_mps(self) -> FloatArray:
        """Speed (N,) on each chord."""
        length = np.linalg.norm(self.course, axis=1)
        return np.asarray(length / (self.stamp_s[self.chords.last] - self.stamp_s[self.chords.first]))

    @cached_property
    def turn_rad(self) -> FloatArray:
        """Turn (N,) of the recorded heading on each chord."""
        first = self.rotation[self.chords.first, :2, 0]
        last = self.rotation[self.chords.last, :2, 0]
        return angle_between(first, last)

    def _reached(self, start: int) -> int | None:
        """The first pose a chord away from ``start``, if the vehicle is fast enough to be moving."""
        end = np.searchsorted(self.stamp_s, self.stamp_s[start] + _CHORD_M / _SLOWEST_MPS, side="right")
        offset = self.position[start + 1 : end, :2] - self.position[start, :2]
        reached = np.flatnonzero((offset**2).sum(axis=1) >= _CHORD_M**2)
        return start + 1 + int(reached[0]) if len(reached) else None


def check_path(motion: Motion) -> list[Finding]:
    """Whether a road vehicle can drive the path, in metres and seconds."""
    if not len(motion.chords):
        return [_hardly_moves(motion)]
    speed = float(np.percentile(motion.speed_mps, 95))
    units = [name for name, scale in _TOO_LARGE.items() if _SLOWEST_MPS < speed / scale < _FASTEST_MPS / 2]
    cause = f"positions in {' or '.join(units)}" if units else "positions that are not in metres"
    return [
        judge(
            "speed", "poses", speed, _FASTEST_MPS, "m/s",
            fine="the speed is plausible for a road vehicle",
            wrong=f"the vehicle drives at {speed:.0f} m/s: {cause}, or stamps that are not seconds; fix it",
        )
    ]  # fmt: skip


def _hardly_moves(motion: Motion) -> Finding:
    moved_m = float(np.linalg.norm(np.ptp(motion.position[:, :2], axis=0)))
    says = (
        f"the vehicle nowhere moves {_CHORD_M:g} m in {_CHORD_M / _SLOWEST_MPS:g} s: a standing vehicle "
        "maps nothing; check that positions are in metres and stamps in seconds"
    )
    for unit, scale in _TOO_SMALL.items():
        scaled = Motion(motion.stamp_s, motion.position * scale, motion.rotation)
        if len(scaled.chords) >= 0.2 * len(motion.stamp_s) and _is_smooth(scaled):
            says = (
                f"positions are in {unit}: the path is {moved_m:.2g} m long and smooth; convert them to "
                "metres east and north of the site"
            )
            break
    return Finding("path length", Status.FAIL, moved_m, _CHORD_M, "m", says, "poses")


def _is_smooth(motion: Motion) -> bool:
    """Whether most chords have a vehicle's speed and are about as long as the path between their ends."""
    way = length_along(motion.position[:, :2])
    chords = motion.chords
    straight = motion.speed_mps * (motion.stamp_s[chords.last] - motion.stamp_s[chords.first])
    directed = straight > 0.8 * (way[chords.last] - way[chords.first])
    return bool((directed & (motion.speed_mps < _FASTEST_MPS)).mean() > 0.8)


def check_jumps(motion: Motion, noise: PoseNoise) -> list[Finding]:
    """Whether positions and heights jump by more than noise and tyres allow."""
    if len(motion.stamp_s) < 3 or not len(motion.chords):
        return []
    longest_s = np.maximum(motion.interval_s[:-1], motion.interval_s[1:])
    spare = 0.5 * _HARDEST_MPS2 * longest_s**2
    # Poses that all scatter by more than stated do not jump: their scatter has a check of its own.
    off = _off_neighbours(motion, motion.position[:, :2])
    scatter_m = max(map(_robust_sigma, off.T)) / np.sqrt(1.5)
    usual = _EXTREME / 2 * float(np.clip(scatter_m, noise.position_m, _UNDERSTATED * noise.position_m))
    heights = _off_neighbours(motion, motion.position[:, 2:])
    return [
        _jitter(motion, off) or _jump("position", motion, off, usual + spare),
        _jump("height", motion, heights, HEIGHT_NOISE * usual + spare),
    ]


def _jump(which: str, motion: Motion, off: FloatArray, limit: FloatArray) -> Finding:
    """Judge the worst of offsets (P - 2, D), m, from the line between neighbours, relative to its limit."""
    size = np.linalg.norm(off, axis=1)
    worst = int(np.argmax(size / limit))
    count = int((size > limit).sum())
    # A step appears as half of it before and minus half of it behind.
    beside = off[max(worst - 1, 0) : worst + 2]
    step_m = float(np.linalg.norm(beside - off[worst], axis=1).max())
    return judge(
        f"{which} jumps", "poses", float(size[worst]), float(limit[worst]), "m",
        fine=f"the {which} never jumps",
        wrong=f"the {which} jumps by {step_m:.2f} m at {motion.stamp_s[worst + 1]:.2f} s ({count} such "
        "records): the receiver lost its RTK fix; leave that stretch out, or state its noise in pose_noise",
    )  # fmt: skip


def _off_neighbours(motion: Motion, values: FloatArray) -> FloatArray:
    """Offsets (P - 2, D) of values (P, D) from the line between their neighbours."""
    part = (motion.interval_s[:-1] / (motion.interval_s[:-1] + motion.interval_s[1:]))[:, None]
    return np.asarray(values[1:-1] - (values[:-2] + part * (values[2:] - values[:-2])))


def _jitter(motion: Motion, off: FloatArray) -> Finding | None:
    """A finding if stamps jitter: all positions are ``off`` (P - 2, D) the line, along the path alone."""
    ahead = motion.rotation[1:-1, :2, 0]
    driven = motion.moving[:-2] & motion.moving[1:-1] & motion.moving[2:]
    if not driven.any():
        return None
    # From one offset to the next: steady braking cancels.
    along = np.diff((off * ahead).sum(axis=1))[driven]
    across = np.diff(cross(ahead, off))[driven]
    along_m = _robust_sigma(along)
    across_m = _robust_sigma(across)
    surely = float(np.exp(_SURE_JITTER / np.sqrt(len(along))))
    if not 0 < surely * across_m < along_m or np.abs(along).max() > _EXTREME / 2 * along_m:
        return None
    # A difference of offsets weights four poses by -1/2, 3/2, -3/2 and 1/2.
    jitter_ms = 1e3 * float(np.sqrt((along_m**2 - across_m**2) / 5.0) / np.median(motion.speed_mps))
    if jitter_ms < _LEAST_JITTER_MS:
        return None
    says = (
        f"the stamps of the poses jitter by {jitter_ms:.0f} ms: positions scatter {along_m / across_m:.0f} "
        "times as much along the path as across it; stamp poses when they are measured, not when they arrive"
    )
    return Finding("pose stamps", Status.FAIL, jitter_ms, None, "ms", says, "poses")


def check_attitude(motion: Motion) -> Iterator[Finding]:
    """Whether roll and pitch are those of a road vehicle, and pitch has the sign of the grade."""
    pitch_rad = -np.arcsin(np.clip(motion.rotation[:, 2, 0], -1, 1))
    roll_rad = np.arctan2(motion.rotation[:, 2, 1], motion.rotation[:, 2, 2])
    largest_rad = max(np.percentile(np.abs(angle), 95) for angle in (roll_rad, pitch_rad))
    largest_deg = float(np.rad2deg(largest_rad))
    yield judge(
        "attitude", "poses", largest_deg, STEEPEST_DEG, "deg",
        fine="roll and pitch are plausible for a vehicle on a road",
        wrong=f"roll or pitch reach {largest_deg:.0f} deg, impossible on a road: were degrees taken "
        f"for radians (then it is {np.deg2rad(largest_deg):.1f} deg), or the quaternions not in the "
        "order qx qy qz qw?",
    )  # fmt: skip
    yield from _pitch_sign(motion, pitch_rad)


def _pitch_sign(motion: Motion, pitch_rad: FloatArray) -> Iterator[Finding]:
    """Compare the pitch (positive nose down) with the recorded grade, where both change enough."""
    chords = motion.chords
    if not len(chords):
        return
    along = (motion.course * motion.rotation[chords.first, :2, 0]).sum(axis=1)
    rise_m = motion.position[chords.last, 2] - motion.position[chords.first, 2]
    grade_rad = np.arctan2(rise_m * np.sign(along), np.abs(along))
    middle = (pitch_rad[chords.first] + pitch_rad[chords.last]) / 2
    spread = np.ptp(np.percentile(grade_rad, [95, 5]))
    if spread < _GRADE_CHANGE_RAD or np.std(middle) < 0.3 * np.std(grade_rad):
        return
    slope = float(np.cov(middle, -grade_rad)[0, 1] / np.var(grade_rad))
    # Chords overlap: this is the number of independent ones.
    independent = max(float(motion.step_m[motion.moving].sum()) / _CHORD_M, 1.0)
    sigma = float(np.std(middle + slope * grade_rad) / np.std(grade_rad) / np.sqrt(independent))
    yield judge(
        "pitch sign", "poses", 1 - slope - _PITCH_SIGMAS * sigma, 1.0, "",
        fine="the pitch follows the grade",
        wrong="the recorded pitch goes against the grade: it counts nose up; write pitch positive nose "
        "down (a rotation about y, which points left)",
    )  # fmt: skip


def check_noise(motion: Motion, noise: PoseNoise) -> list[Finding]:
    """Whether the stated noise has the right units and the poses' own scatter."""
    scatter = _white_noise(motion)
    measured = "" if scatter is None else f"; from pose to pose they scatter by {scatter.position_m:.3f} m"
    if noise.position_m > 1:
        measured += f"; if millimetres were meant, it is {noise.position_m / 1e3:g} m"
    findings = [_unit("position_m", noise.position_m, _RTK_M, "m", f"no RTK position{measured}", "metres")]
    for key, limit in (("heading_rad", _HEADING_RAD), ("roll_pitch_rad", _ROLL_PITCH_RAD)):
        value = getattr(noise, key)
        means = f"{np.rad2deg(value):.1f} deg; if degrees were meant, it is {np.deg2rad(value):.4f} rad"
        findings.append(_unit(key, value, limit, "rad", means, "radians"))
    if scatter is not None and noise.position_m > 0:
        findings.append(_against("position_m", scatter.position_m, noise.position_m, "m"))
    if scatter is not None and noise.heading_rad > 0:
        finding = _against("heading_rad", scatter.heading_rad, noise.heading_rad, "rad")
        by_course = finding.status is not Status.PASS and _is_course(motion, scatter.heading_rad)
        findings.append(_course(scatter.heading_rad) if by_course else finding)
    return findings


def _is_course(motion: Motion, scatter_rad: float) -> bool:
    """Whether the heading's scatter is mostly that of the course, and so of the positions."""
    ahead = motion.rotation[1:-1, :2, 0]
    at = motion.position[:, :2]
    courses = (at[1:-1] - at[:-2], at[2:] - at[1:-1], at[2:] - at[:-2])
    return min(_robust_sigma(_fourth(angle_between(ahead, course))) for course in courses) < scatter_rad / 2


def _course(scatter_rad: float) -> Finding:
    says = (
        f"the heading is the course between positions, with their scatter of {scatter_rad:.2g} rad,"
        " and not the vehicle's; record the vehicle's heading from two antennas or an INS"
    )
    return Finding("heading", Status.FAIL, scatter_rad, None, "rad", says, "poses")


def _unit(key: str, value: float, limit: float, unit: str, means: str, expected: str) -> Finding:
    if value == 0:
        says = f"{key} is 0, which no receiver reaches; state its standard deviation in {expected}"
        return Finding("pose noise", Status.WARN, value, limit, unit, says, f"pose_noise.{key}")
    return judge(
        "pose noise", f"pose_noise.{key}", value, limit, unit,
        fine=f"{key} is plausible for a good receiver",
        wrong=f"{key} {value:g} is {means}; state it in {expected}, as a standard deviation",
        status=Status.WARN,
    )  # fmt: skip


def _against(key: str, measured: float, stated: float, unit: str) -> Finding:
    ratio = measured / stated
    degrees = " (were degrees taken for radians?)" if unit == "rad" and ratio > _USELESS else ""
    return judge(
        "pose scatter", "poses", ratio, _UNDERSTATED, "",
        fine="the poses scatter no more than stated",
        wrong=f"from pose to pose they scatter by {measured:.2g} {unit}, {ratio:.0f} times pose_noise.{key} "
        f"{stated:.2g}{degrees}; state {key} as it is, or find out why the receiver is worse than stated",
        status=Status.FAIL if ratio > _USELESS else Status.WARN,
    )  # fmt: skip


class _Scatter(NamedTuple):
    """Standard deviations of poses from pose to pose."""

    position_m: float  # of a coordinate
    heading_rad: float


def _white_noise(motion: Motion) -> _Scatter | None:
    """The scatter of poses at a high and even rate; None if it cannot be told from driving."""
    if len(motion.stamp_s) < 50:
        return None
    interval_s = float(np.median(motion.interval_s))
    uneven = np.abs(motion.interval_s / interval_s - 1) > _REGULAR
    if interval_s > 1 / _SLOWEST_HZ or uneven.mean() >= _REGULAR:
        return None
    # A difference over a gap is no noise.
    even = np.convolve(uneven, np.ones(len(_DIFFERENCES) - 1), mode="valid") == 0
    if even.sum() < _LEAST_DIFFERENCES:
        return None
    forward = motion.rotation[:, :2, 0]
    heading = np.concatenate([[0.0], np.cumsum(angle_between(forward[:-1], forward[1:]))])
    position = np.column_stack([_fourth(axis) for axis in motion.position[:, :2].T])
    return _Scatter(_robust_sigma(position[even].ravel()), _robust_sigma(_fourth(heading)[even]))


def _fourth(values: FloatArray) -> FloatArray:
    """Fourth differences (P - 4,), scaled to the deviation of white noise."""
    return np.convolve(values, _DIFFERENCES, mode="valid") / float(np.linalg.norm(_DIFFERENCES))


def _robust_sigma(values: FloatArray) -> float:
    return float(SIGMA_OF_MAD * np.median(np.abs(values)))
