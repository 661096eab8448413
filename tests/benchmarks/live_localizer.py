"""How well a vehicle finds itself live on both ports, and whether it says so where it cannot.

    python -m tests.benchmarks.live_localizer --seeds 3 --seconds 30 --starts 40

Maps with errors as the mapping states them, drives of another day, detections with the errors of detectors on
renders, drawn anew (:mod:`tests.benchmarks.made.live`). An odometry is off by 1 % and .01 deg/s (one sigma).
For each drive: errors of the tracked poses, shares inside the 95 % ellipse and inside the bounds, CPU time of
the localiser alone. Then starts from random places known to 5 m and 20 deg, and from nothing; a map of the
other port; half of the markings repainted 30 cm off, from the start of drives on and from the middle of one
on; a camera that was pushed by half a degree about each axis, and one that turns by half a degree within a
minute. That a map was repainted is timed from the start of the drive, or from its middle, and there also from
when the first marking that was moved lies within 10 m of the vehicle. And ways of 50 m without a marking, on
which solid lines of lanes are shown or not.

All poses of a drive share the errors of one map and of one calibration: whether the stated covariance holds
is seen over many drives. Of every drive the false alarms are counted; ``--only none`` runs nothing else.
``--short N`` takes N short ones of each port, and of each the last pose alone.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from tests.benchmarks.made.live import (
    RATE_HZ,
    LiveDrive,
    bumped,
    drive,
    looks_of,
    moved,
    port_recipe,
    turning,
)
from v2hdm.geometry.planar import wrapped
from v2hdm.geometry.rigid import heading_rad
from v2hdm.localization.antenna import Fix
from v2hdm.localization.localizer import Localizer
from v2hdm.localization.places import Prior, rough_position
from v2hdm.localization.pose import Pose, Status
from v2hdm.localization.seeing import Look
from v2hdm.records import FloatArray, HDMap, IntArray, Marking

PORTS = ("port1", "port2")
_PARTS = ("starts", "wrong", "moved", "pushed", "antenna", "slow", "gaps")  # of --only; all by default
_ROUGH_M, _ROUGH_RAD = 5.0, np.deg2rad(20.0)
_SQUARE_95 = 5.991  # chi-square quantile of two coordinates
_WRONG_M = 0.3  # a tracked pose so far off is confidently wrong
_START_FRAMES = 30
_PUSHED_RAD = np.deg2rad(0.5)
_TURNS_S = 60.0  # time in which a camera turns slowly by that
_NEAR_M = 10.0  # way in which a repainted map is to be said
_SHORT_S = 5.5  # time of a short drive, s
_SHORT_BEGINS_M = (3.0, 250.0)  # least and largest station, m, from which it begins
_GAP_M, _BEFORE_GAP_M = 50.0, 20.0  # way without a marking, and that before it
_ANTENNA_M = (1.2, 0.3)  # ahead of the rear axle and to the left, m
_RTK_M = 0.015  # standard deviation of a fixed position, m
_FIX_EVERY = 2  # moments from one position to the next: 5 Hz
_DUAL_RAD = np.deg2rad(0.2)  # standard deviation of the heading by two antennas
_LATER = 2  # moments after which a whole search that follows a look at parts is done
_REPAINTED_STARTS, _REPAINTED_FRAMES = 4, 40  # drives on a repainted map, and moments of each


class Run(NamedTuple):
    """The poses of a drive (F), and the CPU time of an image, s."""

    poses: list[Pose]
    frames: range
    cpu_s: float


class Errors(NamedTuple):
    """Errors and bounds of K tracked poses."""

    errors: FloatArray  # (K, 3) ahead, left, m, and heading, rad
    bounds: FloatArray  # (K, 3)
    squared: FloatArray  # (K,) of the place, in sigmas
    sigma_rad: FloatArray  # (K,)


def rough(driven: LiveDrive, frame: int, rng: np.random.Generator) -> Prior:
    """Where a vehicle is at a moment, within 5 m and 20 deg."""
    true = driven.map_from_vehicle[frame]
    angle, radius = rng.uniform(0, 2 * np.pi), _ROUGH_M * np.sqrt(rng.random())
    x, y = true[:2, 3] + radius * np.array([np.cos(angle), np.sin(angle)])
    heading = float(heading_rad(true)) + rng.uniform(-_ROUGH_RAD, _ROUGH_RAD)
    return rough_position(float(x), float(y), float(np.degrees(heading)))


def follow(
    driven: LiveDrive,
    prior: Prior | None,
    frames: range,
    maps: Mapping[int, HDMap] | HDMap | None = None,
    looks: Sequence[list[Look]] | None = None,
    every_full: int = 1,
) -> Run:
    """Localise through some moments of a drive; of ``every_full`` images one is searched as a whole."""
    hd_map = maps if isinstance(maps, HDMap) else driven.hd_map
    localizer = Localizer(hd_map, driven.calibrations, prior, every_full=every_full)
    begin_s = time.process_time()
    shown = driven.looks if looks is None else looks
    poses = []
    later: list[tuple[int, Look]] = []
    for frame in frames:
        if every_full > 1:
            localizer.update([look for due, look in later if due == frame], driven.motion[frame])
            at_once = [_looked_at(localizer, look) for look in shown[frame]]
            pairs = zip(at_once, shown[frame], strict=True)
            later += [
                (frame + _LATER, replace(look, is_second=True)) for part, look in pairs if part.is_all_later
            ]
            poses.append(localizer.update([part.look for part in at_once]))
        else:
            poses.append(localizer.update(shown[frame], driven.motion[frame]))
    images = sum(len(shown[frame]) for frame in frames)
    return Run(poses, frames, (time.process_time() - begin_s) / max(images, 1))


class _Part(NamedTuple):
    """A look at parts of an image, or all of it, and whether all is to be searched later."""

    look: Look
    is_all_later: bool


def _looked_at(localizer: Localizer, look: Look) -> _Part:
    """The part of an image's look that the localiser asks for."""
    _, regions_px, is_all_later = localizer.glance(look.camera, look.stamp_s)
    if regions_px is None:
        return _Part(look, is_all_later)
    quads = [marking for marking in look.markings if not len(marking.outline_px)]
    corners_px = [marking.corners_px[marking.corner_valid] for marking in quads]
    is_in = [
        len(corners) > 0
        and ((corners > regions_px[:, None, :2]) & (corners < regions_px[:, None, 2:])).all(axis=(1, 2)).any()
        for corners in corners_px
    ]
    markings = tuple(marking for marking, is_kept in zip(quads, is_in, strict=True) if is_kept)
    return _Part(replace(look, markings=markings, lanes=(), is_whole=False), is_all_later)


def errors_of(driven: LiveDrive, run: Run) -> Errors:
    """The errors of the tracked poses."""
    rows = []
    for frame, pose in zip(run.frames, run.poses, strict=True):
        if pose.status != Status.TRACKING or pose.map_from_vehicle is None:
            continue
        true = driven.map_from_vehicle[frame]
        off = pose.map_from_vehicle[:2, 3] - true[:2, 3]
        heading = float(heading_rad(true))
        c, s = np.cos(heading), np.sin(heading)
        turn = float(wrapped(heading_rad(pose.map_from_vehicle) - heading))
        squared = float(off @ np.linalg.solve(pose.covariance[:2, :2], off))
        sigma_rad = float(np.sqrt(pose.covariance[2, 2]))
        place = [c * off[0] + s * off[1], c * off[1] - s * off[0], turn]
        rows.append([*place, *pose.protection_m, pose.protection_rad, squared, sigma_rad])
    table = np.array(rows).reshape(-1, 8)
    return Errors(table[:, :3], table[:, 3:6], table[:, 6], table[:, 7])


def tracking_line(parts: Sequence[Errors], count: int, cpu_s: float) -> str:
    """The figures of drives as one line."""
    errors, bounds, squared, sigma = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    rmse = np.sqrt((errors**2).mean(axis=0)) * [100, 100, np.degrees(1)]
    inside = (squared < _SQUARE_95).mean()
    heading = (np.abs(errors[:, 2]) < 1.96 * sigma).mean()
    held = (np.abs(errors) < bounds).all(axis=1).mean()
    return (
        f"tracked {len(errors) / count:.3f}, along {rmse[0]:.2f} cm, lateral {rmse[1]:.2f} cm, "
        f"heading {rmse[2]:.3f} deg, inside 95 %: {inside:.3f}, heading {heading:.3f}, "
        f"inside the bounds {held:.4f} of {len(errors)}, CPU {1e3 * cpu_s:.1f} ms an image"
    )


def starts(driven: LiveDrive, count: int, rng: np.random.Generator, is_rough_known: bool) -> IntArray:
    """Right, wrong and no starts from random places, and how many said of the right map that it is wrong."""
    totals = np.zeros(4, dtype=np.int64)
    for begin in rng.integers(0, len(driven.stamp_s) - _START_FRAMES, count).tolist():
        frames = range(begin, begin + (_START_FRAMES if is_rough_known else 75))
        frames = range(begin, min(frames.stop, len(driven.stamp_s)))
        run = follow(driven, rough(driven, begin, rng) if is_rough_known else None, frames)
        totals[3] += any(pose.reasons for pose in run.poses)
        errors = errors_of(driven, run).errors
        if not len(errors):
            totals[2] += 1
            continue
        is_wrong = np.hypot(*errors[:, :2].T).max() > _WRONG_M
        totals[1 if is_wrong else 0] += 1
    return totals


def said(run: Run, since: int) -> float:
    """How long after a moment a reason, a camera or the loss was said, s; infinite if never."""
    for frame, pose in zip(run.frames, run.poses, strict=True):
        if frame >= since and (pose.reasons or pose.turned or pose.status == Status.LOST):
            return (frame - since) / 10.0
    return float("inf")


def way_m(driven: LiveDrive, begin: int, time_s: float) -> float:
    """The way driven from a moment until so long after; infinite after never."""
    if not np.isfinite(time_s):
        return np.inf
    places = driven.map_from_vehicle[begin : begin + round(10 * time_s) + 1, :2, 3]
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def said_line(times_s: Sequence[float], ways_m: Sequence[float]) -> str:
    """When something was said: after seconds and metres."""
    pairs = list(zip(times_s, ways_m, strict=True))
    return (
        f"said after {np.median(times_s):.1f} s (median), {max(times_s):.1f} s and {max(ways_m):.1f} m "
        f"(most); within 1 s {sum(time_s <= 1 for time_s in times_s)} of {len(pairs)}, within 10 m "
        f"{sum(way <= _NEAR_M for way in ways_m)}"
    )


def wrong_map_line(driven: LiveDrive, other: HDMap, rng: np.random.Generator, every_full: int) -> str:
    """Drives in the map of another port."""
    times_s, ways_m, confident = [], [], 0
    for begin in range(0, len(driven.stamp_s) - 40, 40):
        frames = range(begin, begin + 40)
        run = follow(driven, rough(driven, begin, rng), frames, other, every_full=every_full)
        confident += any(pose.status == Status.TRACKING for pose in run.poses)
        times_s.append(said(run, begin))
        ways_m.append(way_m(driven, begin, times_s[-1]))
    return f"wrong map: {said_line(times_s, ways_m)}; confident {confident}"


def repainted_line(driven: LiveDrive, rng: np.random.Generator, seed: int, every_full: int) -> str:
    """Half of the markings 30 cm off, from the start of drives on, and from the middle of one on."""
    count = len(driven.stamp_s)
    hd_map = moved(driven.hd_map, 0.5, 0.3, seed)
    begins = range(0, count - _REPAINTED_FRAMES, max((count - _REPAINTED_FRAMES) // _REPAINTED_STARTS, 1))
    runs = [
        follow(
            driven,
            rough(driven, begin, rng),
            range(begin, begin + _REPAINTED_FRAMES),
            hd_map,
            every_full=every_full,
        )
        for begin in begins
    ]
    times_s = [said(run, begin) for run, begin in zip(runs, begins, strict=True)]
    ways_m = [way_m(driven, begin, time_s) for begin, time_s in zip(begins, times_s, strict=True)]
    middle = count // 2
    place = driven.map_from_vehicle[middle, :2, 3]
    ahead = driven.map_from_vehicle[middle, :2, 0]
    later = tuple(
        new if (new.corners_map.mean(axis=0) - place) @ ahead > 0 and _is_moved(new, old) else old
        for new, old in zip(hd_map.markings, driven.hd_map.markings, strict=True)
    )
    later_map = replace(hd_map, markings=later)
    on = follow(driven, rough(driven, 0, rng), range(count), later_map, every_full=every_full)
    first_near = _first_near(driven, later)
    errors = [errors_of(driven, run) for run in (*runs, on)]
    outside = sum(int((np.abs(part.errors) > part.bounds).any(axis=1).sum()) for part in errors)
    return (
        f"half repainted: from the start {said_line(times_s, ways_m)}; "
        f"from the middle on after {said(on, middle):.1f} s, since a moved marking was near "
        f"{said(on, first_near):.1f} s and {way_m(driven, first_near, said(on, first_near)):.1f} m; "
        f"poses outside their bounds {outside} of {sum(len(part.errors) for part in errors)}"
    )


def _is_moved(new: Marking, old: Marking) -> bool:
    return not np.array_equal(new.corners_map, old.corners_map)


def _first_near(driven: LiveDrive, markings: Sequence[Marking]) -> int:
    """The first moment at which a marking that was moved lies near the vehicle."""
    pairs = zip(markings, driven.hd_map.markings, strict=True)
    places = np.array([new.corners_map.mean(axis=0) for new, old in pairs if new is not old])
    offsets = driven.map_from_vehicle[:, None, :2, 3] - places[None]
    return int((np.linalg.norm(offsets, axis=2) < _NEAR_M).any(axis=1).argmax())


def pushed_line(driven: LiveDrive, rng: np.random.Generator, seed: int, every_full: int) -> str:
    """A camera turned by half a degree."""
    middle = len(driven.stamp_s) // 2
    parts = []
    for axis in range(3):
        turn = _PUSHED_RAD * np.eye(3)[axis]
        world = bumped(driven.world, "front", middle, turn)
        frames = range(middle, len(driven.stamp_s))
        looks = [*driven.looks[:middle], *looks_of(world, seed, frames)]
        run = follow(
            driven, rough(driven, 0, rng), range(len(driven.stamp_s)), looks=looks, every_full=every_full
        )
        errors = errors_of(driven, run)
        outside = int((np.abs(errors.errors) > errors.bounds).any(axis=1).sum())
        named = [camera_turn.camera for camera_turn in run.poses[-1].turned]
        time_s = said(run, middle)
        when = f"said after {time_s:.1f} s and {way_m(driven, middle, time_s):.1f} m"
        parts.append(f"{'xyz'[axis]}: {when}, {named}, outside {outside}")
    return f"pushed by .5 deg about {'; '.join(parts)}"


def slow_line(driven: LiveDrive, rng: np.random.Generator, seed: int) -> str:
    """A camera that turns slowly, and how far it has turned when it is named; each axis."""
    begin = len(driven.stamp_s) // 4
    count = len(driven.stamp_s)
    parts = []
    for axis in range(3):
        world = turning(driven.world, "front", begin, _PUSHED_RAD * np.eye(3)[axis], _TURNS_S)
        looks = [*driven.looks[:begin], *looks_of(world, seed, range(begin, count))]
        run = follow(driven, rough(driven, 0, rng), range(count), looks=looks)
        errors = errors_of(driven, run)
        outside = int((np.abs(errors.errors) > errors.bounds).any(axis=1).sum())
        named = [frame for frame in run.frames if frame >= begin and run.poses[frame].turned]
        text = f"{'xyz'[axis]}: not named"
        if named:
            turned = run.poses[named[0]].turned[0]
            after_s = driven.stamp_s[named[0]] - driven.stamp_s[begin]
            by_deg = np.degrees(_PUSHED_RAD) * after_s / _TURNS_S
            since_s = turned.since_s - driven.stamp_s[begin]
            what = f"{turned.camera} in {turned.angle}"
            text = f"{'xyz'[axis]}: {what} at {by_deg:.2f} deg, began at {since_s:+.1f} s"
        parts.append(f"{text}, outside {outside}")
    return "slowly turning camera, " + "; ".join(parts)


class Alarms(NamedTuple):
    """False alarms on a right drive from when it was first tracked."""

    lost: int  # times that it was lost
    turned: int  # cameras that were named
    other: tuple[str, ...]  # reasons beside

    @classmethod
    def of(cls, run: Run) -> Alarms:
        """The alarms of a run."""
        tracked = [number for number, pose in enumerate(run.poses) if pose.status == Status.TRACKING]
        poses = run.poses[tracked[0] :] if tracked else run.poses
        is_lost = [pose.status == Status.LOST for pose in poses]
        begins = sum(now and not before for before, now in zip([False, *is_lost], is_lost, strict=False))
        cameras = {turned.camera for pose in poses for turned in pose.turned}
        reasons = {reason for pose in poses for reason in pose.reasons if not pose.turned}
        return cls(begins, len(cameras), tuple(sorted(reasons)))


def alarm_line(alarms: Sequence[Alarms], seconds: float) -> str:
    """The false alarms of right drives as one line."""
    others = sorted({reason for alarm in alarms for reason in alarm.other})
    return (
        f"false alarms in {seconds / 3600:.2f} h of {len(alarms)} right drives: lost "
        f"{sum(alarm.lost for alarm in alarms)}, cameras named {sum(alarm.turned for alarm in alarms)}, "
        f"drives with other reasons {sum(bool(alarm.other) for alarm in alarms)} {others[:3]}"
    )


def antenna_line(driven: LiveDrive, rng: np.random.Generator) -> str:
    """A vehicle with one RTK antenna, which must drive to know its heading, beside one with two."""
    count = len(driven.stamp_s)
    places = driven.map_from_vehicle[:, :2, :2] @ np.array(_ANTENNA_M) + driven.map_from_vehicle[:, :2, 3]
    places = places + rng.normal(0, _RTK_M, places.shape)
    fixes = [
        [Fix(float(driven.stamp_s[frame]), places[frame], _RTK_M)] if frame % _FIX_EVERY == 0 else []
        for frame in range(count)
    ]
    begin = driven.map_from_vehicle[0]
    heading = float(heading_rad(begin)) + rng.normal(0, _DUAL_RAD)
    dual = Prior(np.array([*places[0], heading]), 3.0 * _RTK_M + float(np.hypot(*_ANTENNA_M)), _DUAL_RAD)
    texts = []
    for name, prior in (("one antenna", None), ("two", dual)):
        localizer = Localizer(driven.hd_map, driven.calibrations, prior, antenna_m=_ANTENNA_M)
        moments = zip(driven.looks, driven.motion, fixes, strict=True)
        poses = [localizer.update(*moment) for moment in moments]
        run = Run(poses, range(count), 0.0)
        errors = errors_of(driven, run)
        first = next((frame for frame, pose in enumerate(poses) if pose.status == Status.TRACKING), None)
        begin_text = "never" if first is None else f"after {way_m(driven, 0, first / RATE_HZ):.1f} m"
        texts.append(f"{name}: tracked {begin_text}, {tracking_line([errors], count, 0.0)}")
    return "; ".join(texts)


class Gap(NamedTuple):
    """The pose at the end of a way without a marking."""

    lateral_m: float  # its error
    bound_m: float  # of that
    is_tracked: bool


def gaps(driven: LiveDrive, rng: np.random.Generator, has_lines: bool) -> list[Gap]:
    """The ends of ways without a marking, on which a drive shows the lines of lanes or not even these."""
    steps_m = np.linalg.norm(np.diff(driven.map_from_vehicle[:, :2, 3], axis=0), axis=1)
    way_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    ends = []
    for begin_m in np.arange(_BEFORE_GAP_M, way_m[-1] - _GAP_M, _GAP_M / 2).tolist():
        first, begin, end = np.searchsorted(way_m, begin_m + np.array([-_BEFORE_GAP_M, 0.0, _GAP_M]))
        looks = [
            [_blinded(look, begin <= frame, has_lines) for look in moment]
            for frame, moment in enumerate(driven.looks[:end])
        ]
        run = follow(driven, rough(driven, int(first), rng), range(first, end), looks=looks)
        errors = errors_of(driven, run)
        is_tracked = run.poses[-1].status == Status.TRACKING
        if is_tracked:
            ends.append(Gap(float(errors.errors[-1, 1]), float(errors.bounds[-1, 1]), True))
        else:
            ends.append(Gap(np.nan, np.inf, False))
    return ends


def _blinded(look: Look, is_in_gap: bool, has_lines: bool) -> Look:
    markings = () if is_in_gap else look.markings
    return replace(look, markings=markings, lanes=look.lanes if has_lines else ())


def gap_line(ends: Sequence[Gap], what: str) -> str:
    """The figures of ways without a marking as one line."""
    lateral_m = np.array([end.lateral_m for end in ends if end.is_tracked])
    bound_m = np.array([end.bound_m for end in ends if end.is_tracked])
    return (
        f"after {_GAP_M:.0f} m without a marking, {what}: {len(lateral_m)} of {len(ends)} tracked, lateral "
        f"RMSE {100 * np.sqrt((lateral_m**2).mean()):.1f} cm, at most "
        f"{100 * np.abs(lateral_m).max():.1f} cm, bound {100 * np.median(bound_m):.0f} cm (median), "
        f"outside it {(np.abs(lateral_m) > bound_m).sum()}"
    )


def short_drive(name: str, seed: int) -> Errors:
    """The error at the end of a short drive from anywhere on a port, with its own map and calibrations."""
    begin_m = float(np.random.default_rng([seed, 5]).uniform(*_SHORT_BEGINS_M))
    driven = drive(port_recipe(name, seed), seed, _SHORT_S, begin_m)
    run = follow(driven, rough(driven, 0, np.random.default_rng([seed, 99])), range(len(driven.stamp_s)))
    return errors_of(driven, Run(run.poses[-1:], run.frames[-1:], run.cpu_s))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--starts", type=int, default=40, help="of each drive")
    parser.add_argument("--only", nargs="*", default=[], metavar="PART", help=", ".join(_PARTS))
    full = "of so many images one is searched as a whole, the others where the map expects markings"
    parser.add_argument("--every-full", type=int, default=1, help=full)
    parser.add_argument("--short", type=int, default=0, help="short drives of each port, and nothing else")
    return parser.parse_args()


@dataclass
class _Totals:
    """Results of all drives together; starts are counted as :func:`starts` counts them."""

    errors: list[Errors] = field(default_factory=list)
    alarms: list[Alarms] = field(default_factory=list)
    images: int = 0
    cpu_s: list[float] = field(default_factory=list)
    known_starts: IntArray = field(default_factory=lambda: np.zeros(4, dtype=np.int64))
    unknown_starts: IntArray = field(default_factory=lambda: np.zeros(4, dtype=np.int64))
    gaps: dict[bool, list[Gap]] = field(default_factory=lambda: {True: [], False: []})

    def add(self, driven: LiveDrive, run: Run) -> None:
        """Count a drive that was followed from its start to its end."""
        self.errors.append(errors_of(driven, run))
        self.alarms.append(Alarms.of(run))
        self.images += len(run.poses)
        self.cpu_s.append(run.cpu_s)

    def lines(self) -> list[str]:
        """The summary."""
        counts = self.known_starts
        unknown = self.unknown_starts
        of_gaps = {"with lines": self.gaps[True], "without lines": self.gaps[False]}
        return [
            f"all: {tracking_line(self.errors, self.images, float(np.mean(self.cpu_s)))}",
            alarm_line(self.alarms, self.images / RATE_HZ),
            *(gap_line(of_drives, name) for name, of_drives in of_gaps.items() if of_drives),
            f"starts from 5 m and 20 deg: {counts[0]} right, {counts[1]} wrong, {counts[2]} none in 3 s, "
            f"{counts[3]} called the map wrong",
            f"starts from nothing: {unknown[0]} right, {unknown[1]} wrong, {unknown[2]} none within 30 m, "
            f"{unknown[3]} called the map wrong",
        ]


def _try_parts(
    driven: LiveDrive,
    other: HDMap,
    rng: np.random.Generator,
    seed: int,
    parsed: argparse.Namespace,
    totals: _Totals,
) -> None:
    """Try the chosen parts on one drive; ``other`` is the map of the other port."""
    parts = parsed.only or _PARTS
    if "starts" in parts:
        totals.known_starts += starts(driven, parsed.starts, rng, is_rough_known=True)
        totals.unknown_starts += starts(driven, max(parsed.starts // 4, 1), rng, is_rough_known=False)
    if "wrong" in parts:
        print(f"  {wrong_map_line(driven, other, rng, parsed.every_full)}", flush=True)
    if "moved" in parts:
        print(f"  {repainted_line(driven, rng, seed, parsed.every_full)}", flush=True)
    if "pushed" in parts:
        print(f"  {pushed_line(driven, rng, seed, parsed.every_full)}", flush=True)
    if "antenna" in parts:
        print(f"  {antenna_line(driven, rng)}", flush=True)
    if "slow" in parts:
        print(f"  {slow_line(driven, rng, seed)}", flush=True)
    if "gaps" in parts:
        for has_lines, of_drives in totals.gaps.items():
            of_drives += gaps(driven, rng, has_lines)


def main() -> None:
    """Run the benchmark and print its lines."""
    parsed = _arguments()
    if parsed.short:
        seeds = range(parsed.first, parsed.first + parsed.short)
        ends = [short_drive(name, seed) for seed in seeds for name in PORTS]
        print(f"ends of short drives: {tracking_line(ends, len(ends), 0.0)}")
        return
    totals = _Totals()
    for seed in range(parsed.first, parsed.first + parsed.seeds):
        drives = {name: drive(port_recipe(name, seed), seed, parsed.seconds) for name in PORTS}
        for name, driven in drives.items():
            rng = np.random.default_rng([seed, 99])
            start = rough(driven, 0, rng)
            run = follow(driven, start, range(len(driven.stamp_s)), every_full=parsed.every_full)
            totals.add(driven, run)
            line = tracking_line(totals.errors[-1:], len(run.poses), run.cpu_s)
            print(f"{name}, seed {seed}: {line}", flush=True)
            other = drives[PORTS[1 - PORTS.index(name)]].hd_map
            _try_parts(driven, other, rng, seed, parsed, totals)
    print("\n".join(totals.lines()))


if __name__ == "__main__":
    main()
