"""Images of a camera whose clock is off, posed anew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.io.drive.trajectory import interpolate
from v2hdm.records import Drive, Image


def in_order(image: Image) -> tuple[int, float, str]:
    """Key by which a drive's images are sorted."""
    return image.visit, image.taken_s, image.camera


def with_clock_offsets(
    drive: Drive, offset_s: Mapping[str, float], max_gap_s: float, visit: int = 0
) -> Drive:
    """The drive with the images of some cameras posed for when they were taken.

    Args:
        drive: a drive that holds its trajectory.
        offset_s: by camera, how much later than stamped its images were taken, s.
        max_gap_s: longest gap between two poses that is interpolated across, s.
        visit: of which visit; images of others stay as they are.

    Returns:
        The drive; images whose time the trajectory does not cover are left out.

    Raises:
        DriveError: the drive holds no trajectory, or no image of some camera is left.
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
