"""Images and a trajectory to posed images; the same for every format of drive."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.trajectory import interpolate
from v2hdm.io.importers.stamp_units import why_no_pose
from v2hdm.io.pixels import read_header
from v2hdm.records import Camera, FloatArray, Image, Trajectory

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
