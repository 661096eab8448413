"""Images and a trajectory to a drive of posed images, the same for every format; and parts of a drive."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from v2hdm.errors import DriveError, shown
from v2hdm.geometry.rigid import in_order, interpolate
from v2hdm.io.drive.road import lay_flat, log_road
from v2hdm.io.trajectory import check_trajectory, span, why_no_pose
from v2hdm.records import DETECTIONS_SUFFIX, Camera, Drive, FloatArray, Image, Trajectory
from v2hdm.settings import COUNT, NOT_NEGATIVE, POSITIVE

_log = logging.getLogger(__name__)


@dataclass(kw_only=True)
class KittiOptions:
    """Facts about a drive that the KITTI raw format does not state."""

    camera_height_m: Annotated[
        float, POSITIVE, "height of the camera above the road (KITTI's nominal 1.65 m)."
    ] = 1.65
    centre_sigma_m: Annotated[
        float, POSITIVE, "standard deviation of the camera centre in the published calibration, per axis."
    ] = 0.05


@dataclass(kw_only=True)
class ReadOptions:
    """How to read a drive."""

    format: Annotated[
        str, "name of a reader (see v2hdm.io.drive.READERS), or auto to look at the folder."
    ] = "auto"
    cameras: Annotated[list[str], "names of the cameras to read; empty for all."] = field(
        default_factory=list
    )
    max_gap_s: Annotated[
        float,
        POSITIVE,
        "longest gap between poses to interpolate across; images in a longer one are dropped.",
    ] = 0.5
    limit: Annotated[
        int | None,
        COUNT,
        "maximum number of images per camera, the first ones, for quick tries; null for all.",
    ] = None
    start_s: Annotated[
        float, NOT_NEGATIVE, "seconds to skip at the beginning of the drive, from its first image."
    ] = 0.0
    end_s: Annotated[
        float | None, POSITIVE, "seconds after its first image at which the drive ends; null for its own end."
    ] = None
    cache: Annotated[str, "folder for imports from bags and videos."] = "cache"
    kitti: KittiOptions = field(default_factory=KittiOptions)


@dataclass(frozen=True)
class ImageFiles:
    """The images of one camera: ``stamp_s`` (N,) and as many ``paths``."""

    camera: str
    stamp_s: FloatArray
    paths: Sequence[Path]


def select_cameras(available: Sequence[str], chosen: Sequence[str], where: Path) -> list[str]:
    """The ``available`` cameras that are ``wanted``, all where none is named; refuses unknown ones."""
    for name in chosen:
        if name not in available:
            raise DriveError(f"{where}: no camera {shown(name)}; choose from: {', '.join(available)}")
    return [name for name in available if not chosen or name in chosen]


def assemble_drive(
    drive: Drive,
    files: Sequence[ImageFiles],
    max_gap_s: float,
    where: str,
    mount_rad: FloatArray | None = None,
) -> Drive:
    """The drive of ``recorded`` poses, the road laid flat, images posed; ``mount_rad`` is a lost turn."""
    assert drive.recorded is not None
    check_trajectory(drive.recorded, drive.origin, where)
    laid = lay_flat(drive.recorded, drive.pose_noise.position_m)
    log_road(laid if mount_rad is None else replace(laid, mount_rad=mount_rad), drive.root)
    images = _pose_images(files, laid.trajectory, max_gap_s, drive.root)
    _check_image_files(images, drive.cameras)
    posed = Counter(image.camera for image in images)
    unposed = {entry.camera: len(entry.paths) - posed[entry.camera] for entry in files}
    listed_s = {entry.camera: (float(entry.stamp_s[0]), float(entry.stamp_s[-1])) for entry in files}
    counted = replace(drive, images=images, unposed=unposed, listed_s=listed_s)
    return replace(counted, trajectory=laid.trajectory, road=laid.road)


def _pose_images(
    files: Sequence[ImageFiles], trajectory: Trajectory, max_gap_s: float, where: Path
) -> tuple[Image, ...]:
    """Images by time, then camera, each with the pose at its time; those without one are dropped."""
    images: list[Image] = []
    for entry in files:
        poses, inside = interpolate(trajectory, entry.stamp_s, max_gap_s)
        if not inside.any():
            raise DriveError(
                f"{where}: no image of camera '{entry.camera}' ({span(entry.stamp_s)}) has a pose "
                f"(poses: {span(trajectory.stamp_s)}); "
                f"{why_no_pose(entry.stamp_s, trajectory.stamp_s, max_gap_s)}"
            )
        if not inside.all():
            _log.warning(
                "%s: dropped %d of %d images of camera '%s': no pose at their time",
                where, int((~inside).sum()), len(inside), entry.camera,
            )  # fmt: skip
        images += [
            Image(entry.camera, float(entry.stamp_s[n]), entry.paths[n], map_from_vehicle=poses[n])
            for n in np.flatnonzero(inside).tolist()
        ]
    return tuple(sorted(images, key=in_order))


def _check_image_files(images: Sequence[Image], cameras: Mapping[str, Camera]) -> None:
    """Refuse missing, truncated and wrongly sized images before any long work begins."""
    from v2hdm.safe.pixels import read_header  # OpenCV, which reading settings does without

    if _are_detections(images):
        return
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
                f"{image.path}: its EXIF orientation {header.orientation} asks for a rotation, but a "
                "calibration is of pixels as they are stored: take the orientation out of the images"
            )


def _are_detections(images: Sequence[Image]) -> bool:
    """Whether all images are files of detections; DriveError where one is missing, or only some are."""
    detected = [image.path for image in images if image.path.suffix == DETECTIONS_SUFFIX]
    if 0 < len(detected) < len(images):
        picture = next(image.path for image in images if image.path.suffix != DETECTIONS_SUFFIX)
        raise DriveError(
            f"{picture}: a picture, but {len(detected)} of {len(images)} images are detections, such as "
            f"{detected[0]}; list pictures or detections, for all cameras"
        )
    for path in detected:
        if not path.is_file():
            raise DriveError(f"{path}: no such file of detections; restore it or drop its line")
    return bool(detected)


def part_of(drive: Drive, options: ReadOptions) -> Drive:
    """The images between ``start_s`` and ``end_s`` after the first, at most ``limit`` of each camera."""
    if options.limit is None and options.end_s is None and options.start_s <= 0:
        return drive
    if options.limit is not None and options.limit < 1:
        raise DriveError(f"drive.limit is {options.limit}: give 1 or more images of each camera")
    first_s = min(image.stamp_s for image in drive.images)
    end_s = float("inf") if options.end_s is None else options.end_s
    images: list[Image] = []
    for name in drive.cameras:
        chosen = [
            image
            for image in drive.images
            if image.camera == name and options.start_s <= image.stamp_s - first_s <= end_s
        ]
        images += chosen[: options.limit]
        if not chosen:
            lasts_s = max(image.stamp_s for image in drive.images) - first_s
            raise DriveError(
                f"{drive.root}: no image of camera {shown(name)} is left from {options.start_s:g} to "
                f"{end_s:g} s; the drive has images for {lasts_s:.1f} s: change drive.start_s or drive.end_s"
            )
    return replace(drive, images=tuple(sorted(images, key=in_order)))
