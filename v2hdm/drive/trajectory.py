"""The vehicle's pose at any time within a recorded trajectory."""

from __future__ import annotations

import numpy as np

from v2hdm.geometry.rigid import quaternion_from_rotation, rotation_from_quaternion, slerp
from v2hdm.records import BoolArray, FloatArray, Trajectory


def interpolate(
    trajectory: Trajectory, stamp_s: FloatArray, max_gap_s: float
) -> tuple[FloatArray, BoolArray]:
    """The poses at ``stamp_s`` (N,): position linear, rotation by slerp, never extrapolated.

    Returns:
        ``map_from_vehicle`` (N, 4, 4) and a flag per time. The flag is False, and the pose that of
        the nearest recorded one, before the first pose, after the last and between two poses that
        are more than ``max_gap_s`` apart; the time of a recorded pose itself is never in a gap.
    """
    recorded = trajectory.stamp_s
    stamp_s = np.asarray(stamp_s, dtype=np.float64)
    after = np.clip(np.searchsorted(recorded, stamp_s, side="left"), 0, len(recorded) - 1)
    before = np.where(recorded[after] == stamp_s, after, np.maximum(after - 1, 0))
    span_s = recorded[after] - recorded[before]
    inside = (stamp_s >= recorded[0]) & (stamp_s <= recorded[-1]) & (span_s <= max_gap_s)
    with np.errstate(divide="ignore", invalid="ignore"):
        linear = np.where(span_s > 0, (stamp_s - recorded[before]) / span_s, 0.0)
    fraction = np.clip(np.where(inside, linear, np.round(linear)), 0.0, 1.0)

    first, second = trajectory.map_from_vehicle[before], trajectory.map_from_vehicle[after]
    poses = np.tile(np.eye(4), (len(stamp_s), 1, 1))
    poses[:, :3, 3] = first[:, :3, 3] + fraction[:, None] * (second[:, :3, 3] - first[:, :3, 3])
    poses[:, :3, :3] = rotation_from_quaternion(
        slerp(
            quaternion_from_rotation(first[:, :3, :3]), quaternion_from_rotation(second[:, :3, :3]), fraction
        )
    )
    return poses, inside
