"""Part of a drive, for trying things: some of its images, with all of its poses."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from v2hdm.errors import DriveError
from v2hdm.io.drive.options import ReadOptions
from v2hdm.records import Drive


def part_of(drive: Drive, options: ReadOptions) -> Drive:
    """The images of a drive between two times, and of each camera so many at most.

    Args:
        drive: as it was recorded.
        options: ``start_s`` and ``end_s``, seconds after the drive's first image, and ``limit``.

    Raises:
        DriveError: no image of some camera is left.
    """
    if options.limit is None and options.end_s is None and options.start_s <= 0:
        return drive
    if options.limit is not None and options.limit < 1:
        raise DriveError(f"drive.limit is {options.limit}: give 1 or more images of each camera")
    first_s = min(image.stamp_s for image in drive.images)
    end_s = float("inf") if options.end_s is None else options.end_s
    taken: Counter[str] = Counter()
    images = []
    for image in drive.images:
        if not options.start_s <= image.stamp_s - first_s <= end_s:
            continue
        taken[image.camera] += 1
        if options.limit is None or taken[image.camera] <= options.limit:
            images.append(image)
    for name in drive.cameras:
        if not taken[name]:
            lasts_s = max(image.stamp_s for image in drive.images) - first_s
            raise DriveError(
                f"{drive.root}: no image of camera '{name}' is left from {options.start_s:g} to {end_s:g} s; "
                f"the drive has images for {lasts_s:.1f} s: change drive.start_s or drive.end_s"
            )
    return replace(drive, images=tuple(images))
