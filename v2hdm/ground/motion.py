"""Poses and motion of the vehicle at each image, and the choice of image pairs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.geometry.planar import length_along
from v2hdm.geometry.rigid import heading_rad, interpolate, rotation_from_euler
from v2hdm.ground.results import Reading
from v2hdm.records import Drive, FloatArray, IntArray, Trajectory

_SMOOTHING_S = 0.5  # half width of the parabola fitted to poses: steering and pedals act no faster
_STANDING_MPS = 0.3  # below this a path has no direction: GNSS positions wander by centimetres
_PATH_STEP_M = 0.5  # distance between the points of a driven path, m
_BEYOND_M = 30.0  # straight extension of the path beyond the drive's ends, the reach of a region
ARM_M = 10.0  # distance of the visible ground, m, by which a turn by 1 rad moves it


@dataclass(frozen=True)
class Motion:
    """The vehicle at the images of one camera.

    ``image`` (I,) indexes ``Drive.images``, ``stamp_s`` (I,) are their stamps. The ``trajectory`` has all
    recorded poses, under the reading, ``path_m`` (P,) the distance driven and ``velocity`` (P, 3) the
    smoothed forward and left speed, m/s, and yaw rate, rad/s, at each.
    """

    image: IntArray
    stamp_s: FloatArray
    trajectory: Trajectory
    path_m: FloatArray
    velocity: FloatArray

    def poses(self, clock_s: float = 0.0) -> FloatArray:
        """``map_from_vehicle`` (I, 4, 4) at the images, taken ``clock_s`` after their stamps."""
        return interpolate(self.trajectory, self.stamp_s + clock_s, np.inf)[0]

    def course_map(self) -> FloatArray:
        """Points (N, 2) of the driven path, half a metre apart, extended straight at both ends."""
        poses = self.trajectory.map_from_vehicle
        at = np.arange(0.0, self.path_m[-1] + _PATH_STEP_M, _PATH_STEP_M)
        keep = np.concatenate([[True], np.diff(self.path_m) > 1e-9])
        path = np.column_stack([np.interp(at, self.path_m[keep], poses[keep, axis, 3]) for axis in (0, 1)])
        beyond = np.arange(_PATH_STEP_M, _BEYOND_M, _PATH_STEP_M)[:, None]
        return np.vstack([path, path[:1] - beyond * poses[0, :2, 0], path[-1:] + beyond * poses[-1, :2, 0]])

    def path_at_images(self, clock_s: float = 0.0) -> FloatArray:
        """Distance driven (I,) at the images."""
        return np.interp(self.stamp_s + clock_s, self.trajectory.stamp_s, self.path_m)

    def velocity_at_images(self, clock_s: float = 0.0) -> FloatArray:
        """Smoothed velocity (I, 3) at the images."""
        at = self.stamp_s + clock_s
        return np.column_stack([np.interp(at, self.trajectory.stamp_s, v) for v in self.velocity.T])


def motion_of(drive: Drive, camera: str, reading: Reading) -> Motion:
    """The motion of ``drive`` at the images of ``camera``, its poses read as ``reading``."""
    image = np.array([k for k, entry in enumerate(drive.images) if entry.camera == camera], dtype=np.int64)
    stamp_s = np.array([drive.images[k].stamp_s for k in image])
    trajectory = _read_as(drive.trajectory or trajectory_of_images(drive), reading)
    path_m = length_along(trajectory.map_from_vehicle[:, :2, 3])
    return Motion(image, stamp_s, trajectory, path_m, _velocity(trajectory))


def trajectory_of_images(drive: Drive) -> Trajectory:
    """The poses of a drive's images, for drives without any others."""
    stamp_s, first = np.unique([image.stamp_s for image in drive.images], return_index=True)
    return Trajectory(stamp_s, np.array([drive.images[k].map_from_vehicle for k in first]))


def _read_as(trajectory: Trajectory, reading: Reading) -> Trajectory:
    if reading in (Reading.AS_GIVEN, Reading.BACKWARDS):
        return trajectory
    poses = trajectory.map_from_vehicle.copy()
    if reading is Reading.MIRRORED:
        poses[:, 1, 3] *= -1
    rate = _slopes(trajectory.stamp_s, poses[:, :2, 3])
    yaw = np.unwrap(np.arctan2(rate[:, 1], rate[:, 0]))
    moving = np.linalg.norm(rate, axis=1) > _STANDING_MPS
    if moving.any():
        yaw = np.interp(trajectory.stamp_s, trajectory.stamp_s[moving], np.unwrap(yaw[moving]))
    zero = np.zeros(len(yaw))
    poses[:, :3, :3] = rotation_from_euler(zero, zero, yaw)
    return Trajectory(trajectory.stamp_s, poses)


def _velocity(trajectory: Trajectory) -> FloatArray:
    poses = trajectory.map_from_vehicle
    yaw = np.unwrap(heading_rad(poses))
    rate = _slopes(trajectory.stamp_s, np.column_stack([poses[:, :2, 3], yaw]))
    c = np.cos(yaw)
    s = np.sin(yaw)
    return np.column_stack([c * rate[:, 0] + s * rate[:, 1], c * rate[:, 1] - s * rate[:, 0], rate[:, 2]])


def _slopes(at: FloatArray, values: FloatArray) -> FloatArray:
    """Derivatives (P, K) of values (P, K) from parabolas fitted within :data:`_SMOOTHING_S`."""
    out = np.zeros_like(values)
    first = np.searchsorted(at, at - _SMOOTHING_S - 1e-9)
    last = np.searchsorted(at, at + _SMOOTHING_S + 1e-9)
    for k in range(len(at)):
        # Three poses at least, however far apart.
        low = max(min(first[k], k - 1), 0)
        high = min(max(last[k], k + 2), len(at))
        if high - low < 2:
            continue
        terms = np.vander(at[low:high] - at[k], 3 if high - low >= 4 else 2, increasing=True)
        out[k] = np.linalg.lstsq(terms, values[low:high] - values[k], rcond=None)[0][1]
    return out


def spread_pairs(path_m: FloatArray, count: int, baseline_m: tuple[float, float]) -> IntArray:
    """Pairs (P, 2) of images, spread evenly along ``path_m`` (I,), using no image twice if possible.

    ``count`` pairs are wanted; ``baseline_m`` is the shortest and the longest of theirs.
    """
    shortest_m, longest_m = baseline_m
    chosen: list[tuple[int, int]] = []
    used: set[int] = set()
    middle = (shortest_m + longest_m) / 2
    for start_m in np.linspace(path_m[0], max(path_m[-1] - longest_m, path_m[0]), count):
        start = min(int(np.searchsorted(path_m, start_m)), len(path_m) - 1)
        first = next((k for k in range(start, len(path_m)) if k not in used), None)
        if first is None:
            continue
        away = path_m - path_m[first]
        fitting = np.flatnonzero((away >= shortest_m) & (away <= longest_m)).tolist()
        if fitting:
            free = [k for k in fitting if k not in used] or fitting
            pair = (first, free[int(np.argmin(np.abs(away[free] - middle)))])
            chosen.append(pair)
            used.update(pair)
    return np.array(chosen, dtype=np.int64).reshape(-1, 2)


def changing_pairs(
    path_m: FloatArray, values: FloatArray, count: int, baseline_m: tuple[float, float]
) -> IntArray:
    """Pairs (P, 2) of images with the largest change of ``values`` (I, K), using no image twice.

    ``baseline_m`` is the shortest and the longest baseline of a pair.
    """
    shortest_m, longest_m = baseline_m
    candidates: list[tuple[float, int, int]] = []
    for first in range(len(path_m)):
        away = path_m - path_m[first]
        fitting = np.flatnonzero((away >= shortest_m) & (away <= longest_m))
        change = np.hypot.reduce(values[fitting] - values[first], axis=1)
        candidates += zip(change.tolist(), [first] * len(fitting), fitting.tolist(), strict=True)
    used: set[int] = set()
    chosen: list[tuple[int, int]] = []
    for _, first, second in sorted(candidates, reverse=True):
        if first not in used and second not in used and len(chosen) < count:
            chosen.append((first, second))
            used.update((first, second))
    return np.array(chosen, dtype=np.int64).reshape(-1, 2)
