"""Images of a camera whose clock is off, posed anew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from v2hdm.drive.trajectory import interpolate
from v2hdm.errors import DriveError
from v2hdm.records import Drive, Image


def with_clock_offsets(drive: Drive, offset_s: Mapping[str, float], max_gap_s: float) -> Drive:
    """The drive with the images of some cameras posed for when they were taken.

    Args:
        drive: a drive that holds its trajectory.
        offset_s: by camera, how much later than stamped its images were taken, s.
        max_gap_s: longest gap between two poses that is interpolated across, s.

    Returns:
        The drive; images whose time the trajectory does not cover are left out.

    Raises:
        DriveError: the drive holds no trajectory, or no image of some camera is left.
    """
    if drive.trajectory is None:
        raise DriveError(f"{drive.root}: holds no trajectory to pose its images anew from")
    images: list[Image] = []
    for name in drive.cameras:
        own = [image for image in drive.images if image.camera == name]
        if offset_s.get(name):
            taken_s = np.array([image.stamp_s + offset_s[name] for image in own])
            poses, inside = interpolate(drive.trajectory, taken_s, max_gap_s)
            own = [
                replace(own[n], map_from_vehicle=poses[n], clock_offset_s=offset_s[name])
                for n in np.flatnonzero(inside).tolist()
            ]
        if not own:
            raise DriveError(
                f"{drive.root}: {1e3 * offset_s[name]:.0f} ms after their stamps, no image of '{name}' "
                "has a pose; record poses for as long as images"
            )
        images += own
    return replace(drive, images=tuple(sorted(images, key=lambda image: (image.taken_s, image.camera))))
