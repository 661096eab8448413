"""The detector over a source of images: files, a drive, a video or a live camera."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v2hdm.detection.camera import camera_from_calibration, rough_calibration
from v2hdm.detection.detector import Detector
from v2hdm.detection.frames import (
    IMAGE_SUFFIXES,
    Frame,
    camera_frames,
    image_frames,
    list_images,
    video_frames,
)
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.pitch import PitchVote
from v2hdm.detection.road import Road, RoadDetector
from v2hdm.detection.stopwatch import Stopwatch, lap
from v2hdm.errors import ConfigError, DriveError
from v2hdm.io.calibration.intrinsics import is_calibration, read_intrinsics
from v2hdm.io.drive import READERS, read_drive
from v2hdm.records import CameraInfo
from v2hdm.store.inputs import note_input

ROUGH_MOUNTING = (1.6, 5.0, 60.0)
"""Height (m), pitch (deg) and horizontal field of view (deg) of a camera of which nothing is known."""

_ROUGH_RANGE_M = 40.0
"""Without a calibration distances may be wrong by a factor of two: nothing may be dropped for being far."""

_Frames = Iterator[tuple[Frame, RoadDetector | None]]
"""Frames to look at, and the detector for each as far as it is known before the first."""


class Detected(NamedTuple):
    """One image and what it shows: the frame, the camera's name, and markings and lanes on the road."""

    frame: Frame
    camera: str
    road: Road


def detect_images(
    source: str | Path | int,
    *,
    camera: str | Path | None = None,
    camera_name: str | None = None,
    mounting: Sequence[float] | None = None,
    linear: bool = False,
    detector: Detector | DetectorOptions | None = None,
    limit: int | None = None,
    stopwatch: Stopwatch | None = None,
) -> Iterator[Detected]:
    """Find markings and lanes in images one after another; the base install is enough.

    Args:
        source: an image, a folder of images, a drive, a video, or the index of a live camera.
        camera: file of the camera's calibration, which gives metres, or of its intrinsics alone.
        camera_name: which camera of intrinsics that hold several.
        mounting: without a calibration, height (m), pitch (deg, down) and horizontal field of view (deg).
        linear: grey values are proportional to light, not sRGB.
        detector: the detector, or its settings.
        limit: stop after so many images.
        stopwatch: takes the time of each stage.

    Returns:
        An iterator over the images; corners are (4, 2) px in the image as recorded, the top-left pixel's
        centre at (0, 0), and (4, 2) m in the frame ``vehicle`` where the camera is calibrated.

    Raises:
        DriveError: the source cannot be read; while iterating, an image.
        ConfigError: the arguments do not go together.
        DetectorError: the model cannot be used.

    >>> found = next(detect_images(port.root, limit=1))
    >>> found.camera, found.frame.pixels.shape
    ('front', (360, 640, 3))
    """
    path = None if camera is None else Path(camera)
    lens = _lens(path, camera_name, mounting)
    if limit is not None and limit < 1:
        raise ConfigError(f"--limit {limit}: give the number of images to stop after, 1 or more")
    if not isinstance(detector, Detector):
        options = replace(detector) if detector is not None else DetectorOptions()
        if path is None or lens is not None:
            options.max_range_m = _ROUGH_RANGE_M
        detector = Detector.load(options=options)
    road = None if path is None or lens is not None else RoadDetector.calibrated(detector, path, linear)
    rough = _Rough(detector, lens, path, mounting, linear)
    frames = islice(_frames(str(source), road, rough), limit)
    return _found(frames, rough, stopwatch or Stopwatch())


def _lens(
    camera: Path | None, camera_name: str | None, mounting: Sequence[float] | None
) -> CameraInfo | None:
    """The intrinsics of ``--camera`` where they are all that the file holds, as other tools write it."""
    if camera is None:
        if camera_name is not None:
            raise ConfigError("--camera-name: names a camera in the file of --camera; add that")
        return None
    if not is_calibration(camera):
        return read_intrinsics(camera, camera_name, "--camera-name")
    if camera_name is not None:
        raise ConfigError(f"--camera-name: {camera} is the calibration of one camera; drop it")
    if mounting is not None:
        raise ConfigError(
            "--camera and --mounting exclude each other: a calibration holds the mounting; drop one"
        )
    return None


class _Rough(NamedTuple):
    """The detector, and what is known of a camera without a calibration."""

    detector: Detector
    lens: CameraInfo | None
    file: Path | None
    mounting: Sequence[float] | None
    linear: bool

    def road(self, frame: Frame, seen_pitch_deg: float | None = None) -> RoadDetector:
        """A detector for the camera of ``frame``; it says what it takes the mounting to be."""
        height_m, pitch_deg, fov_deg = self.mounting or ROUGH_MOUNTING
        if not (0 < height_m < np.inf and -45 < pitch_deg < 85 and 10 <= fov_deg <= 150):
            raise ConfigError(
                f"--mounting {height_m:g} {pitch_deg:g} {fov_deg:g}: give a height above 0 m, a pitch "
                "of -45 to 85 deg (down is positive) and a field of view of 10 to 150 deg"
            )
        lens = self.lens
        if lens is not None:
            fov_deg = float(2 * np.degrees(np.arctan(lens.width / 2 / lens.intrinsic[0, 0])))
        if seen_pitch_deg is not None:
            print(
                f"the lines of {frame.name} and images before it meet on a horizon: taking the camera to "
                f"look {seen_pitch_deg:.1f} deg down, not {pitch_deg:g}, from here on",
                file=sys.stderr,
            )
            pitch_deg = seen_pitch_deg
        elif self.mounting is None:
            known = "no --camera" if lens is None else f"no mounting in {self.file}"
            print(
                f"{known}: taking it to be {height_m:g} m up, {pitch_deg:g} deg down, {fov_deg:.3g} deg wide "
                "(--mounting says otherwise); positions in px only",
                file=sys.stderr,
            )
        rows, columns = frame.pixels.shape[:2]
        name = "camera" if lens is None else lens.name
        calibration = rough_calibration(name, columns, rows, height_m, pitch_deg, fov_deg)
        if lens is not None:
            calibration = replace(calibration, info=lens)
        return RoadDetector(self.detector, camera_from_calibration(calibration, self.linear))


def _frames(source: str, road: RoadDetector | None, rough: _Rough) -> _Frames:
    """The frames of whatever the source is."""
    path = Path(source)
    if source.isdecimal():
        if path.exists():
            raise ConfigError(
                f"{path}: a camera's index, and a file or folder here, too; write ./{path} for that, "
                "or start from another folder for the camera"
            )
        info = rough.lens or (road and road.camera.info)
        frames = camera_frames(int(source), (info.width, info.height) if info else None)
        return ((frame, road) for frame in frames)
    if not path.exists():
        raise DriveError(f"{path}: no such image, video or folder; a camera is named by its index, such as 0")
    paths = list_images(path) if path.is_dir() else [path]
    is_drive = any(READERS[name][0](path) for name in (READERS if path.is_dir() else ("bag",)))
    if is_drive and paths in ([], [path]):
        note_input(path)
        return _drive_frames(path, road, rough)
    if not paths:
        raise DriveError(f"{path}: no images ({', '.join(IMAGE_SUFFIXES)}) and no drive in this folder")
    for image in paths:
        note_input(image)
    is_video = not path.is_dir() and path.suffix.lower() not in IMAGE_SUFFIXES
    return ((frame, road) for frame in (video_frames(path) if is_video else image_frames(paths)))


def _drive_frames(path: Path, road: RoadDetector | None, rough: _Rough) -> _Frames:
    """The images of a drive, each read when its turn comes; if a calibration was given, of its camera."""
    if rough.lens is not None:
        raise ConfigError(
            "--camera: this file holds intrinsics alone, and a drive has its own; drop --camera, or name the "
            "file as camera_info in drive.yaml"
        )
    drive = read_drive(path)
    for image in drive.images:
        note_input(image.path)
    roads = {name: RoadDetector(rough.detector, camera) for name, camera in drive.cameras.items()}
    if road is not None:
        name = road.camera.info.name
        if name not in drive.cameras:
            raise DriveError(
                f"{path}: no camera '{name}', as the calibration calls it; this drive has {', '.join(roads)}"
            )
        roads = {name: road}
    return (
        (replace(frame, name=f"{image.camera}_{frame.name}", stamp_s=image.stamp_s), roads[image.camera])
        for image in drive.images
        if image.camera in roads
        for frame in image_frames([image.path])
    )


def _found(frames: _Frames, rough: _Rough, stopwatch: Stopwatch) -> Iterator[Detected]:
    """Every frame with what it shows."""
    guessed: RoadDetector | None = None
    vote = PitchVote()
    while True:
        with stopwatch.image():
            with lap("read"):
                frame, road = next(frames, (None, None))
            if frame is None:
                stopwatch.discard()
                return
            if road is None:
                road = guessed = guessed or rough.road(frame)
            _check_size(frame, road)
            found = road.detect(frame.pixels)
        yield Detected(frame, road.camera.info.name, found)
        if road is not guessed:
            continue
        pitch_rad = vote.add([lane.image for lane in found.lanes], rough.detector.road_camera(road.camera))
        if pitch_rad is not None:
            guessed = rough.road(frame, float(np.rad2deg(pitch_rad)))


def _check_size(frame: Frame, road: RoadDetector) -> None:
    info = road.camera.info
    height, width = frame.pixels.shape[:2]
    if (width, height) != (info.width, info.height):
        where = "the calibration" if road.calibration else "what is known"
        raise DriveError(
            f"{frame.source}: the image is {width}x{height}, but {where} of camera '{info.name}' is for "
            f"{info.width}x{info.height}; give images of that size, or the calibration of these"
        )
