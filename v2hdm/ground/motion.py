"""Where the vehicle was at each image and how it moved, under each reading of its poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.geometry.rigid import heading_rad, rotation_from_euler
from v2hdm.geometry.trajectory import interpolate
from v2hdm.ground.results import Reading
from v2hdm.records import Drive, FloatArray, IntArray, Trajectory

SMOOTHING_S = 0.5
"""Half width of the parabola fitted to the poses: steering and pedals change the motion no faster."""

_STANDING_MPS = 0.3
"""Below this a path has no direction: receivers wander by centimetres."""


@dataclass(frozen=True)
class Motion:
    """The vehicle at the images of one camera.

    Attributes:
        image: (I,) indices into ``Drive.images``.
        stamp_s: (I,) their stamps.
        trajectory: all recorded poses, under the reading.
        path_m: (P,) distance driven at each pose of ``trajectory``.
        velocity: (P, 3) forward and left in m/s and yaw rate in rad/s, smoothed, at each pose.
    """

    image: IntArray
    stamp_s: FloatArray
    trajectory: Trajectory
    path_m: FloatArray
    velocity: FloatArray

    def poses(self, clock_s: float = 0.0) -> FloatArray:
        """``map_from_vehicle`` (I, 4, 4), the images being taken ``clock_s`` after their stamps."""
        return interpolate(self.trajectory, self.stamp_s + clock_s, np.inf)[0]

    def path_at_images(self, clock_s: float = 0.0) -> FloatArray:
        """Distance driven (I,) at the images."""
        return np.interp(self.stamp_s + clock_s, self.trajectory.stamp_s, self.path_m)

    def velocity_at_images(self, clock_s: float = 0.0) -> FloatArray:
        """Smoothed velocity (I, 3) at the images."""
        at = self.stamp_s + clock_s
        return np.column_stack([np.interp(at, self.trajectory.stamp_s, v) for v in self.velocity.T])


def motion_of(drive: Drive, camera: str, reading: Reading) -> Motion:
    """The motion of ``drive`` at the images of ``camera``, its poses read as ``reading`` says."""
    image = np.array([k for k, entry in enumerate(drive.images) if entry.camera == camera], dtype=np.int64)
    stamp_s = np.array([drive.images[k].stamp_s for k in image])
    trajectory = _read_as(drive.trajectory or _of_images(drive), reading)
    position = trajectory.map_from_vehicle[:, :2, 3]
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=1))])
    return Motion(image, stamp_s, trajectory, path_m, _velocity(trajectory))


def _of_images(drive: Drive) -> Trajectory:
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
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([c * rate[:, 0] + s * rate[:, 1], c * rate[:, 1] - s * rate[:, 0], rate[:, 2]])


def _slopes(at: FloatArray, values: FloatArray) -> FloatArray:
    """Derivatives (P, K) of values (P, K): of parabolas fitted within :data:`SMOOTHING_S` of each time."""
    out = np.zeros_like(values)
    first = np.searchsorted(at, at - SMOOTHING_S - 1e-9)
    last = np.searchsorted(at, at + SMOOTHING_S + 1e-9)
    for k in range(len(at)):
        # Three poses at least, even where they are further apart.
        low, high = max(min(first[k], k - 1), 0), min(max(last[k], k + 2), len(at))
        if high - low < 2:
            continue
        lag = at[low:high] - at[k]
        terms = np.vander(lag, 3 if high - low >= 4 else 2, increasing=True)
        out[k] = np.linalg.lstsq(terms, values[low:high] - values[k], rcond=None)[0][1]
    return out
