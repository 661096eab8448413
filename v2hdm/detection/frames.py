"""Images one after another: from files, a video or a live camera."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from v2hdm.errors import DriveError
from v2hdm.io.safe.pixels import VIDEO_OPTIONS, read_pixels

_log = logging.getLogger(__name__)

_MOST_CAMERAS = 1 << 16  # OpenCV takes a larger index for something else

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")
"""Suffixes of images in a folder."""

# Depth and channels as stored, so that what does not fit is seen instead of converted without a word.
_AS_STORED = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR


def read_bgr(path: Path) -> np.ndarray:
    """Decode an image file, in colour or grey, to (H, W, 3) uint8 BGR.

    Raises:
        DriveError: the file is missing, truncated, damaged or not of 8 bits.
    """
    pixels = read_pixels(path, _AS_STORED)
    if pixels.dtype != np.uint8:
        raise DriveError(
            f"{path}: the image has {8 * pixels.dtype.itemsize} bits a channel; convert it to 8 bits"
        )
    if pixels.ndim == 2:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)
    return np.asarray(pixels)


@dataclass(frozen=True)
class Frame:
    """One image (H, W, 3) uint8 BGR to look at.

    ``source`` is its file, or the video or camera it comes from, ``index`` its number there. ``stamp_s`` is
    the time within a video, Unix time for a live camera, None for a file. ``name`` is unique.
    """

    source: str
    name: str
    index: int
    stamp_s: float | None
    pixels: np.ndarray


def image_frames(paths: Sequence[Path]) -> Iterator[Frame]:
    """Image files, each read when its turn comes.

    Raises:
        DriveError: a file is missing, damaged or not of 8 bits.
    """
    names = [path.stem for path in paths]
    unique = len(set(names)) == len(names)
    for index, path in enumerate(paths):
        name = path.stem if unique else path.name.replace(".", "_")
        yield Frame(str(path), name, index, None, read_bgr(path))


def list_images(folder: Path) -> list[Path]:
    """The image files that lie in a folder itself, by name."""
    try:
        return sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    except OSError as error:
        raise DriveError(
            f"{folder}: cannot read this folder ({error.strerror}); check its permissions"
        ) from error


def video_frames(path: Path) -> Iterator[Frame]:
    """Every frame of a video file; a warning reports one that ends early.

    Raises:
        DriveError: OpenCV cannot read it, or it has no frame.
    """
    refused = f"{path}: neither an image nor a video that OpenCV can read; convert it to JPEG, PNG or MP4"
    with _capture(str(path), refused) as capture:
        if turned := int(capture.get(cv2.CAP_PROP_ORIENTATION_META)):
            _log.warning("%s: its frames are turned by %d degrees, as it says; calibrate those", path, turned)
        promised = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        count = 0
        for count, pixels in enumerate(_pixels(capture), start=1):
            stamp_s, name = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3, f"{path.stem}_{count - 1:06d}"
            yield Frame(str(path), name, count - 1, stamp_s, pixels)
        if not count:
            raise DriveError(f"{path}: the video has no frame that can be read; copy or convert it again")
        if count < promised:
            _log.warning("%s: the video ends after %d of %d frames; is it cut off?", path, count, promised)


def camera_frames(number: int, size: tuple[int, int] | None = None) -> Iterator[Frame]:
    """Frames of a live camera, by the operating system's index, until it fails.

    ``size`` is the width and height to ask the camera for; it may give others.

    Raises:
        DriveError: it does not open, or gives no more frames.
    """
    refused = f"camera {number}: does not open; is it plugged in and used by no one else?"
    with _capture(min(number, _MOST_CAMERAS), refused) as capture:
        if size is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        count = 0
        for count, pixels in enumerate(_pixels(capture), start=1):
            name = f"camera{number}_{count - 1:06d}"
            yield Frame(f"camera {number}", name, count - 1, time.time(), pixels)
        raise DriveError(f"camera {number}: gives no image after {count} frames; check its cable")


@contextmanager
def _capture(source: str | int, refused: str) -> Iterator[cv2.VideoCapture]:
    """A capture that keeps OpenCV's and FFmpeg's own complaints off the terminal; the error is ours."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    options = "|".join(f"{key};{value}" for key, value in VIDEO_OPTIONS.items())
    os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", options)
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        backend = () if isinstance(source, int) else (cv2.CAP_FFMPEG,)
        capture = cv2.VideoCapture(source, *backend)
    finally:
        cv2.utils.logging.setLogLevel(level)
    try:
        if not capture.isOpened():
            raise DriveError(refused)
        yield capture
    finally:
        capture.release()


def _pixels(capture: cv2.VideoCapture) -> Iterator[np.ndarray]:
    while (read := capture.read())[0]:
        yield np.asarray(read[1])
