"""What a user may choose about reading a drive.

Images and a trajectory to posed images; the same for every format of drive.

Part of a drive, for trying things: some of its images, with all of its poses.

Images of a camera whose clock is off, posed anew.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.io.safe.pixels import read_header
from v2hdm.io.trajectory import interpolate, why_no_pose
from v2hdm.records import Camera, Drive, FloatArray, Image, Trajectory


@dataclass(kw_only=True)
class KittiOptions:
    """What the KITTI raw format does not say about a drive.

    Attributes:
        camera_height_m: height of the camera above the road (KITTI's nominal 1.65 m).
        centre_sigma_m: how well the published calibration places the camera, per axis.
        roi_near_m: where the trusted ground begins, ahead of the camera.
        roi_far_m: where it ends.
        roi_half_width_m: how far it extends to either side of the camera.
    """

    camera_height_m: float = 1.65
    centre_sigma_m: float = 0.05
    roi_near_m: float = 5.0
    roi_far_m: float = 20.0
    roi_half_width_m: float = 6.0


@dataclass(kw_only=True)
class ReadOptions:
    """How to read a drive.

    Attributes:
        format: name of a reader (see ``v2hdm.io.drive.READERS``), or ``auto`` to look at the folder.
        cameras: names of the cameras to read; empty for all.
        max_gap_s: poses further apart than this are not interpolated across; images that fall into
            such a gap are dropped.
        limit: images of each camera to take at most, the first ones, for trying things; None takes all.
        start_s: seconds of the drive to leave out at its beginning, by the stamps of its images.
        end_s: seconds after its first image at which the drive ends; None for its own end.
        cache: folder that keeps what is imported from bags and videos.
        kitti: only used by the ``kitti`` reader.
    """

    format: str = "auto"
    cameras: list[str] = field(default_factory=list)
    max_gap_s: float = 0.5
    limit: int | None = None
    start_s: float = 0.0
    end_s: float | None = None
    cache: str = "cache"
    kitti: KittiOptions = field(default_factory=KittiOptions)


_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ImageFiles:
    """The images of one camera: ``stamp_s`` (N,) and as many ``paths``."""

    camera: str
    stamp_s: FloatArray
    paths: Sequence[Path]


def pose_images(
    files: Sequence[ImageFiles], trajectory: Trajectory, max_gap_s: float, where: Path
) -> tuple[Image, ...]:
    """Give every image the vehicle's pose at its time; images without one are dropped with a warning.

    Returns:
        The images by time, then camera.

    Raises:
        DriveError: when no image of some camera has a pose.
    """
    images: list[Image] = []
    for entry in files:
        poses, inside = interpolate(trajectory, entry.stamp_s, max_gap_s)
        if not inside.any():
            raise DriveError(
                f"{where}: no image of camera '{entry.camera}' ({_span(entry.stamp_s)}) has a pose "
                f"(poses: {_span(trajectory.stamp_s)}); "
                f"{why_no_pose(entry.stamp_s, trajectory.stamp_s, max_gap_s)}"
            )
        if not inside.all():
            _log.warning(
                "%s: dropped %d of %d images of camera '%s': no pose at their time",
                where, int((~inside).sum()), len(inside), entry.camera,
            )  # fmt: skip
        images += [
            Image(
                camera=entry.camera,
                stamp_s=float(entry.stamp_s[n]),
                path=entry.paths[n],
                map_from_vehicle=poses[n],
            )
            for n in np.flatnonzero(inside).tolist()
        ]
    return tuple(sorted(images, key=lambda image: (image.stamp_s, image.camera)))


def count_unposed(files: Sequence[ImageFiles], images: Sequence[Image]) -> dict[str, int]:
    """How many images of each camera are not among the posed ``images``."""
    posed = Counter(image.camera for image in images)
    return {entry.camera: len(entry.paths) - posed[entry.camera] for entry in files}


def check_image_files(images: Sequence[Image], cameras: Mapping[str, Camera]) -> None:
    """Refuse missing, truncated and wrongly sized images before any long work begins.

    Raises:
        DriveError: naming the first such image.
    """
    for image in images:
        header = read_header(image.path)
        info = cameras[image.camera].info
        if (header.width, header.height) != (info.width, info.height):
            raise DriveError(
                f"{image.path}: image is {header.width} x {header.height}, but camera_info of "
                f"'{image.camera}' says {info.width} x {info.height}; give the calibration of this resolution"
            )
        if header.orientation != 1:
            raise DriveError(
                f"{image.path}: its EXIF orientation {header.orientation} says to turn it, and a "
                "calibration is of pixels as they are stored: take the orientation out of the images"
            )


def select_cameras(available: Sequence[str], wanted: Sequence[str], where: Path) -> list[str]:
    """The ``available`` cameras that are ``wanted``, all when nothing in particular is.

    Raises:
        DriveError: when a wanted camera is not available.
    """
    for name in wanted:
        if name not in available:
            raise DriveError(f"{where}: no camera '{name}'; choose from: {', '.join(available)}")
    return [name for name in available if not wanted or name in wanted]


def _span(stamp_s: FloatArray) -> str:
    return f"{stamp_s[0]:.3f} to {stamp_s[-1]:.3f} s"


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
