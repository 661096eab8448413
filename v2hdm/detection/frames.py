"""Images one after another: from files, a video, a live camera or a folder that grows."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from statistics import median

import cv2
import numpy as np

from v2hdm.errors import DriveError
from v2hdm.records import Camera, FloatArray, Image
from v2hdm.safe.pixels import AS_STORED, VIDEO_OPTIONS, is_image_name, read_pixels
from v2hdm.safe.texts import number_key

_log = logging.getLogger(__name__)

_MOST_CAMERAS = 1 << 16  # OpenCV takes a larger index for something else
_POLL_S = 0.005  # a folder that grows is looked at this often
_WRITTEN_S = 1.0  # an image is written within this time
_LAST_FRAMES = 10  # number of frames that determine a camera's rate
_OVERDUE = 1.5  # intervals without a frame after which nobody knows when the next one comes
_SAME_DATE_S = (2.0, 0.05)
"""Seconds within which two changes may have one date: of dates in whole seconds (FAT), and in fractions."""


def read_bgr(path: Path) -> np.ndarray:
    """Decode an image file to (H, W, 3) uint8 BGR; raises DriveError where it is damaged or not of 8 bits."""
    pixels = read_pixels(path, AS_STORED)  # so that what does not fit is seen, not converted without a word
    if pixels.dtype != np.uint8:
        raise DriveError(
            f"{path}: the image has {8 * pixels.dtype.itemsize} bits per channel; convert it to 8 bits"
        )
    if pixels.ndim == 2:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)
    return np.asarray(pixels)


def read_image(image: Image, camera: Camera) -> np.ndarray:
    """Decode an image of a drive to (H, W, 3) uint8 BGR; raises DriveError where it is not the camera's."""
    pixels = read_bgr(image.path)
    expected = (camera.info.height, camera.info.width)
    if pixels.shape[:2] != expected:
        raise DriveError(
            f"{image.path}: the image is {pixels.shape[1]}x{pixels.shape[0]} but the camera_info of camera "
            f"'{image.camera}' says {expected[1]}x{expected[0]}; fix the camera_info or the image list"
        )
    return pixels


@dataclass(frozen=True)
class Frame:
    """One image to look at."""

    source: str  # its file, or the video or camera it comes from
    name: str
    index: int  # its number there
    stamp_s: float | None  # within a video, Unix time of a live camera, None of a file
    pixels: np.ndarray  # (H, W, 3) uint8 BGR
    dropped: int = 0  # live images before it that nobody has looked at, since newer ones came
    map_from_vehicle: FloatArray | None = None  # (4, 4) when it was taken, of a drive


def image_frames(paths: Sequence[Path]) -> Iterator[Frame]:
    """Image files, each read when its turn comes; raises DriveError where one is damaged or not of 8 bits."""
    names = [path.stem for path in paths]
    unique = len(set(names)) == len(names)
    for index, path in enumerate(paths):
        name = path.stem if unique else path.name.replace(".", "_")
        yield Frame(str(path), name, index, None, read_bgr(path))


def list_images(folder: Path, left_out: AbstractSet[str] = frozenset()) -> list[Path]:
    """The image files in a folder itself, by the numbers in their names, without those ``left_out``."""
    try:
        # Names alone: of thousands of images paths would take longer than it takes to look at one.
        names = {*os.listdir(folder)} - left_out  # noqa: PTH208
    except OSError as error:
        raise DriveError(
            f"{folder}: cannot read this folder ({error.strerror}); check its permissions"
        ) from error
    return [folder / name for name in sorted(filter(is_image_name, names), key=number_key)]


def video_frames(path: Path) -> Iterator[Frame]:
    """Every frame of a video, with a warning if it ends early; raises DriveError where there is none."""
    refused = f"{path}: neither an image nor a video that OpenCV can read; convert it to JPEG, PNG or MP4"
    with _capture(str(path), refused) as capture:
        if turned := int(capture.get(cv2.CAP_PROP_ORIENTATION_META)):
            _log.warning(
                "%s: frames are rotated by %d degrees (metadata); calibrate the rotated ones", path, turned
            )
        promised = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        count = 0
        for count, pixels in enumerate(_pixels(capture), start=1):
            stamp_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
            name = f"{path.stem}_{count - 1:06d}"
            yield Frame(str(path), name, count - 1, stamp_s, pixels)
        if not count:
            raise DriveError(f"{path}: the video has no readable frame; copy or convert it again")
        if count < promised:
            _log.warning("%s: the video ends after %d of %d frames; is it cut off?", path, count, promised)


def camera_frames(number: int, size: tuple[int, int] | None = None) -> Iterator[Frame]:
    """Frames of a live camera by its index, perhaps of ``size``; raises DriveError where it gives no more."""
    refused = f"camera {number}: cannot be opened; is it plugged in, and not in use?"
    with _capture(min(number, _MOST_CAMERAS), refused) as capture:
        if size is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        count = 0
        for count, pixels in enumerate(_pixels(capture), start=1):
            name = f"camera{number}_{count - 1:06d}"
            yield Frame(f"camera {number}", name, count - 1, time.time(), pixels)
        raise DriveError(f"camera {number}: no image after {count} frames; check its cable")


class NewestFrames(Iterator[Frame]):
    """The newest frame of a camera whenever one is asked for: a thread reads and drops those before it."""

    def __init__(self, frames: Iterator[Frame]) -> None:
        self._came_s: deque[float] = deque(maxlen=_LAST_FRAMES)  # times at which frames came
        self._newest: Frame | None = None
        self._end: BaseException | None = None
        self._changed = threading.Condition()
        threading.Thread(target=self._read, args=(frames,), name="v2hdm-camera", daemon=True).start()

    def _read(self, frames: Iterator[Frame]) -> None:
        end: BaseException = StopIteration()
        try:
            for frame in frames:
                with self._changed:
                    before = self._newest
                    dropped = frame.dropped + (0 if before is None else before.dropped + 1)
                    self._newest = replace(frame, dropped=dropped)
                    self._came_s.append(time.perf_counter())
                    self._changed.notify()
        except BaseException as error:  # for the one who asks for frames
            end = error
        with self._changed:
            self._end = end
            self._changed.notify()

    def is_idle_for(self, seconds: float) -> bool:
        """Whether no frame waits, and the next one is not expected within a time; frames come at a pace."""
        with self._changed:
            came_s = [*self._came_s]
            is_waiting = self._newest is not None or self._end is not None
        if is_waiting or len(came_s) < 2:
            return not is_waiting
        interval_s = median(later_s - earlier_s for earlier_s, later_s in pairwise(came_s))
        since_s = time.perf_counter() - came_s[-1]
        return since_s + seconds < interval_s or since_s > _OVERDUE * interval_s

    def __next__(self) -> Frame:
        """Wait for a frame that was not given yet; raises what the camera did, after its last one."""
        with self._changed:
            while self._newest is None and self._end is None:
                self._changed.wait(1.0)  # Windows takes Ctrl-C only between waits
            frame = self._newest
            self._newest = None
            if frame is not None:
                return frame
        assert self._end is not None
        raise self._end


def arriving_frames(folder: Path) -> Iterator[Frame]:
    """The newest image of a folder that somebody writes to, each time that one is asked for; never ends.

    Its time is when it was written. One that cannot be read a second after is left out with a warning. Raises
    DriveError where the folder cannot be read.
    """
    done = {path.name for path in list_images(folder)[:-1]}
    index = 0
    nothing_new_s = None  # date of the folder when it was last listed in vain
    while True:
        now_s = time.time()
        changed_s = _written_s(folder)
        listed = list_images(folder, done) if changed_s != nothing_new_s else []
        written_s = {path: _written_s(path) for path in listed}
        if not written_s:
            is_settled = now_s - changed_s > _SAME_DATE_S[changed_s % 1 > 0]
            nothing_new_s = changed_s if is_settled else None
            time.sleep(_POLL_S)
            continue
        newest = max(written_s, key=lambda path: (written_s[path], path.name))
        try:
            pixels = read_bgr(newest)
        except DriveError as error:
            if time.time() - written_s[newest] > _WRITTEN_S:
                _log.warning("%s", error)
                done.add(newest.name)
            time.sleep(_POLL_S)
            continue
        done.update(path.name for path in written_s)
        yield Frame(str(newest), newest.stem, index, written_s[newest], pixels, len(written_s) - 1)
        index += 1


def _written_s(path: Path) -> float:
    """When a file was written, Unix time; 0 if it is gone."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


@contextmanager
def _capture(source: str | int, refused: str) -> Iterator[cv2.VideoCapture]:
    """A capture that keeps OpenCV's and FFmpeg's own complaints off the terminal; the error is ours."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    options = "|".join(f"{key};{value}" for key, value in VIDEO_OPTIONS.items())
    os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", options)
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        if isinstance(source, int):
            capture = cv2.VideoCapture(source)
        else:
            capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG)
    finally:
        cv2.utils.logging.setLogLevel(level)
    try:
        if not capture.isOpened():
            raise DriveError(refused)
        yield capture
    finally:
        capture.release()


def _pixels(capture: cv2.VideoCapture) -> Iterator[np.ndarray]:
    """The images (H, W, 3) of a capture until it gives no more."""
    while True:
        is_read, pixels = capture.read()
        if not is_read:
            return
        yield np.asarray(pixels)
