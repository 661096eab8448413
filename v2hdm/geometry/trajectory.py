"""The vehicle's pose at any time within a trajectory, and images whose camera's clock is off posed anew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.rigid import exp, inverse, log, make_transform
from v2hdm.records import BoolArray, Drive, FloatArray, Image, Trajectory


def interpolate(
    trajectory: Trajectory, stamp_s: FloatArray, max_gap_s: float
) -> tuple[FloatArray, BoolArray]:
    """The poses (N, 4, 4) at ``stamp_s`` (N,): position linear, rotation by slerp; and a flag per time.

    Nothing is extrapolated. The flag is False, and the pose that of the nearest recorded one, before the
    first pose, after the last and between two poses that are more than ``max_gap_s`` apart; the time of a
    recorded pose itself is never in a gap.
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
    turn = log(inverse(first) @ second)
    turn[:, :3] = 0.0
    points = first[:, :3, 3] + fraction[:, None] * (second[:, :3, 3] - first[:, :3, 3])
    return make_transform((first @ exp(fraction[:, None] * turn))[:, :3, :3], points), inside


def in_order(image: Image) -> tuple[int, float, str]:
    """Key by which a drive's images are sorted."""
    return image.visit, image.taken_s, image.camera


def with_clock_offsets(
    drive: Drive, offset_s: Mapping[str, float], max_gap_s: float, visit: int = 0
) -> Drive:
    """The drive with the images of some cameras of a visit posed for when they were taken.

    ``offset_s`` says, by camera, how much later than stamped its images were taken, s. Images whose time the
    trajectory does not cover, up to gaps of ``max_gap_s`` between two poses, are left out. Raises DriveError
    when the drive holds no trajectory, or no image of some camera is left.
    """
    root, trajectory = drive.visits[visit].root, drive.visits[visit].trajectory
    if trajectory is None:
        raise DriveError(f"{root}: holds no trajectory to pose its images anew from")
    images: list[Image] = [image for image in drive.images if image.visit != visit]
    for name in dict.fromkeys(image.camera for image in drive.images if image.visit == visit):
        own = [image for image in drive.images if (image.visit, image.camera) == (visit, name)]
        if offset_s.get(name):
            taken_s = np.array([image.stamp_s + offset_s[name] for image in own])
            poses, inside = interpolate(trajectory, taken_s, max_gap_s)
            own = [
                replace(own[n], map_from_vehicle=poses[n], clock_offset_s=offset_s[name])
                for n in np.flatnonzero(inside).tolist()
            ]
        if not own:
            raise DriveError(
                f"{root}: {1e3 * offset_s[name]:.0f} ms after their stamps, no image of '{name}' "
                "has a pose; record poses for as long as images"
            )
        images += own
    return replace(drive, images=tuple(sorted(images, key=in_order)))
