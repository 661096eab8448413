"""The detector over a source of images: files, a drive, a video or a live camera."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import count, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v2hdm.detection.camera import camera_from_calibration, rough_calibration
from v2hdm.detection.detector import Detector
from v2hdm.detection.frames import (
    Frame,
    NewestFrames,
    arriving_frames,
    camera_frames,
    image_frames,
    list_images,
    video_frames,
)
from v2hdm.detection.mounting import BODY_SIGMA_RAD, Mounting, MountingEstimate, image_lines
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.road import Road, RoadDetector
from v2hdm.detection.stopwatch import Stopwatch, lap
from v2hdm.doors import checked
from v2hdm.errors import ConfigError, DriveError, shown
from v2hdm.io.calibration.intrinsics import is_calibration, read_intrinsics
from v2hdm.io.drive import READERS, read_drive
from v2hdm.records import CameraInfo
from v2hdm.safe.pixels import IMAGE_SUFFIXES
from v2hdm.store.inputs import note_input

ROUGH_MOUNTING = (1.6, 5.0, 60.0)  # height (m), pitch, horizontal field of view (deg) where nothing is known
_UNKNOWN_PITCH_DEG = 8.0  # standard deviation of a pitch that nobody states, deg
_STATED_PITCH_DEG = 4.0  # standard deviation of a pitch that the user states, deg
_ROLL_DEG = 1.5  # standard deviation of a camera's roll about zero, deg
_LOG_FOCAL = (
    0.3  # standard deviation of the log of an assumed focal length: lenses of 46 to 76 deg are within
)

_LOOKS = 6
"""Images of a folder that are looked at for its horizon: four photographs gave it to within 17 px, eight to
within 6 px."""

_KNOWN_RAD = np.deg2rad(0.5)  # a stream's horizon is said when its standard deviation is this
_ROUGH_RANGE_M = 40.0  # distances may be wrong by two without a calibration: none is too far

_Frames = Iterator[tuple[Frame, RoadDetector | None]]
"""Frames to look at, and the detector for each as far as it is known before the first."""


class Detected(NamedTuple):
    """One image and what it shows: the frame, the camera's name, and markings and lanes on the road."""

    frame: Frame
    camera: str
    road: Road


@checked
def detect_images(
    source: str | Path | int,
    *,
    camera: str | Path | None = None,
    camera_name: str | None = None,
    mounting: Sequence[float] | None = None,
    linear: bool = False,
    detector: Detector | DetectorOptions | None = None,
    limit: int | None = None,
    live: bool = False,
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
        live: of a camera, or a folder that somebody writes images to, take the newest image each time; those
            that came before it are dropped and counted (``frame.dropped``).
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
    if mounting is not None and len(mounting) != 3:
        raise ConfigError(
            f"--mounting: {len(mounting)} numbers; give height (m), pitch (deg) and field of view (deg)"
        )
    if limit is not None and limit < 1:
        raise ConfigError(f"--limit {limit}: give a number of images, 1 or more")
    if not isinstance(detector, Detector):
        options = replace(detector) if detector is not None else DetectorOptions()
        if path is None or lens is not None:
            options.max_range_m = _ROUGH_RANGE_M
        detector = Detector.load(options=options)
    road = None if path is None or lens is not None else RoadDetector.calibrated(detector, path, linear)
    rough = _Rough(detector, lens, path, mounting, linear)
    most = limit and min(limit, sys.maxsize)
    frames = islice((_live_frames if live else _frames)(str(source), road, rough), most)
    return _found(frames, rough, stopwatch or Stopwatch())


def _lens(camera: Path | None, name: str | None, mounting: Sequence[float] | None) -> CameraInfo | None:
    """The intrinsics of ``--camera`` where they are all that the file holds, as other tools write it."""
    if camera is None:
        if name is not None:
            raise ConfigError("--camera-name: names a camera in the file of --camera; add --camera")
        return None
    if not is_calibration(camera):
        return read_intrinsics(camera, name, "--camera-name")
    if name is not None:
        raise ConfigError(f"--camera-name: {camera} is the calibration of one camera; drop --camera-name")
    if mounting is not None:
        raise ConfigError("--camera and --mounting exclude each other: a calibration has a mounting")
    return None


@dataclass
class _Rough:
    """The detector for the images of a camera without a calibration, whose mounting they show."""

    detector: Detector
    lens: CameraInfo | None
    file: Path | None
    mounting: Sequence[float] | None
    linear: bool
    folder: Sequence[Path] = ()
    _estimate: MountingEstimate | None = None
    _road: RoadDetector | None = None
    _shown: int = 0
    _is_said: bool = False

    def road(self, frame: Frame) -> RoadDetector:
        """The detector for the next image; it says what the mounting is taken to be.

        Of a ``folder``, some images all over it show the horizon before the first; else the 1st, 2nd, 4th,
        8th, ... do.
        """
        self._shown += 1
        if self._estimate is None:
            rows, columns = frame.pixels.shape[:2]
            info, prior = self._prior(columns, rows)
            self._estimate = MountingEstimate(info, prior)
        if self._road is None or not (self.folder or self._shown & (self._shown - 1)):
            with lap("horizon"):
                self._road = self._look(self._estimate, [frame, *self._ahead(frame)])
            self._say(frame, self._estimate.mounting)
        return self._road

    def _ahead(self, first: Frame) -> Iterator[Frame]:
        """Further images of the folder; one that cannot be read is refused when its turn comes."""
        places = np.linspace(0, len(self.folder) - 1, min(_LOOKS, len(self.folder))).round().astype(int)
        for place in places[1:].tolist():
            with suppress(DriveError):
                yield from image_frames([self.folder[place]])

    def _look(self, estimate: MountingEstimate, frames: Sequence[Frame]) -> RoadDetector:
        info = estimate.info
        for frame in frames:
            if frame.pixels.shape[:2] == (info.height, info.width):
                estimate.add(image_lines(self.detector.network, frame.pixels, info))
        mounting = estimate.mounting
        rough = rough_calibration(
            info.name,
            info.width,
            info.height,
            mounting.height_m,
            float(np.rad2deg(mounting.pitch_rad)),
            float(np.rad2deg(mounting.fov_rad)),
            float(np.rad2deg(mounting.roll_rad)),
        )
        sigma = float(np.hypot(mounting.sigma_rad[0], BODY_SIGMA_RAD)), mounting.log_focal_sigma
        camera = camera_from_calibration(replace(rough, info=info), self.linear, sigma)
        return RoadDetector(self.detector, camera)

    def _prior(self, columns: int, rows: int) -> tuple[CameraInfo, Mounting]:
        """The camera's lens, and what its mounting is taken to be before its first image."""
        height_m, pitch_deg, fov_deg = self.mounting or ROUGH_MOUNTING
        if not (0 < height_m < np.inf and -45 < pitch_deg < 85 and 10 <= fov_deg <= 150):
            raise ConfigError(
                f"--mounting {height_m:g} {pitch_deg:g} {fov_deg:g}: give a height above 0 m, a pitch "
                "of -45 to 85 deg (down is positive) and a field of view of 10 to 150 deg"
            )
        lens = self.lens
        if lens is not None:
            fov_deg = float(2 * np.degrees(np.arctan(lens.width / 2 / lens.intrinsic[0, 0])))
        sigma_deg = _UNKNOWN_PITCH_DEG if self.mounting is None else _STATED_PITCH_DEG
        if self.mounting is None:
            knowledge = "no --camera" if lens is None else f"no mounting in {self.file}"
            print(
                f"{knowledge}: taking it to be {height_m:g} m up, {pitch_deg:g} deg down, "
                f"{fov_deg:.3g} deg wide, unless the images show another horizon (set --mounting); "
                "positions in px only",
                file=sys.stderr,
            )
        pitch_rad, fov_rad, sigma_rad, roll_rad = np.deg2rad([pitch_deg, fov_deg, sigma_deg, _ROLL_DEG])
        log_focal = _LOG_FOCAL if self.mounting is None and lens is None else 0.0
        prior = Mounting(height_m, pitch_rad, 0.0, fov_rad, (sigma_rad, roll_rad), log_focal)
        rough = rough_calibration("camera", columns, rows, height_m, pitch_deg, fov_deg)
        return lens or rough.info, prior

    def _say(self, frame: Frame, mounting: Mounting) -> None:
        """Say once where the horizon is: of a folder at once, of a stream when that is known."""
        if self._is_said or (mounting.sigma_rad[0] > _KNOWN_RAD and not self.folder):
            return
        self._is_said = True
        angles = np.rad2deg(
            [mounting.pitch_rad, mounting.sigma_rad[0], mounting.roll_rad, mounting.sigma_rad[1]]
        )
        pitch, pitch_sigma, roll, roll_sigma = angles.tolist()
        where = "the folder's images" if self.folder else f"{frame.name} and earlier images"
        print(
            f"from the lines of {where} the camera looks {pitch:.1f} +- {pitch_sigma:.1f} deg down, roll "
            f"{roll:.1f} +- {roll_sigma:.1f} deg",
            file=sys.stderr,
        )


def _frames(source: str, road: RoadDetector | None, rough: _Rough) -> _Frames:
    """The frames of whatever the source is."""
    path = Path(source)
    if source.isdecimal():
        if path.exists():
            raise ConfigError(
                f"{path}: both a camera's index and a file or folder here; write ./{path} for the file, "
                "or run from another folder for the camera"
            )
        return ((frame, road) for frame in _of_camera(int(source), road, rough))
    if not (path.is_dir() or path.is_file()):
        kind = "is a pipe or a device" if path.exists() else "no such image, video or folder"
        raise DriveError(f"{path}: {kind}; give a camera by its index, such as 0")
    paths = list_images(path) if path.is_dir() else [path]
    is_drive = any(READERS[name][0](path) for name in (READERS if path.is_dir() else ("bag",)))
    if is_drive and paths in ([], [path]):
        return _drive_frames(path, road, rough)
    if not paths:
        raise DriveError(f"{path}: no images ({', '.join(IMAGE_SUFFIXES)}) and no drive in this folder")
    for image in paths:
        note_input(image)
    if path.is_dir():
        rough.folder = paths
    is_video = not path.is_dir() and path.suffix.lower() not in IMAGE_SUFFIXES
    return ((frame, road) for frame in (video_frames(path) if is_video else image_frames(paths)))


def _of_camera(number: int, road: RoadDetector | None, rough: _Rough) -> Iterator[Frame]:
    info = rough.lens or (road and road.camera.info)
    return camera_frames(number, (info.width, info.height) if info else None)


def _live_frames(source: str, road: RoadDetector | None, rough: _Rough) -> _Frames:
    """The newest frame each time, of a camera or a folder."""
    path = Path(source)
    if source.isdecimal() and not path.exists():
        frames: Iterator[Frame] = NewestFrames(_of_camera(int(source), road, rough))
    elif path.is_dir():
        frames = arriving_frames(path)
    else:
        raise ConfigError(f"--live: {path} is not a camera's index or a folder; only these get new images")
    return ((frame, road) for frame in frames)


def _drive_frames(path: Path, road: RoadDetector | None, rough: _Rough) -> _Frames:
    """The images of a drive, each read when its turn comes; if a calibration was given, of its camera."""
    if rough.lens is not None:
        raise ConfigError(
            "--camera: this file holds only intrinsics, and a drive has its own; drop --camera, or name the "
            "file as camera_info in drive.yaml"
        )
    drive = read_drive(path)
    roads = {name: RoadDetector(rough.detector, camera) for name, camera in drive.cameras.items()}
    if road is not None:
        name = road.camera.info.name
        if name not in drive.cameras:
            raise DriveError(f"{path}: no camera {shown(name)} in the calibration; it has {', '.join(roads)}")
        roads = {name: road}
    numbers = {name: count() for name in roads}
    return (
        (
            replace(frame, name=f"{name}_{frame.name}", index=next(numbers[name]), stamp_s=image.stamp_s),
            roads[name],
        )
        for image in drive.images
        if (name := image.camera) in roads
        for frame in image_frames([image.path])
    )


def _found(frames: _Frames, rough: _Rough, stopwatch: Stopwatch) -> Iterator[Detected]:
    """Every frame with what it shows."""
    while True:
        with stopwatch.image():
            with lap("read"):
                frame, road = next(frames, (None, None))
            if frame is None:
                stopwatch.discard()
                return
            road = road or rough.road(frame)
            _check_size(frame, road)
            on_road = road.detect(frame.pixels)
        yield Detected(frame, road.camera.info.name, on_road)


def _check_size(frame: Frame, road: RoadDetector) -> None:
    info = road.camera.info
    height, width = frame.pixels.shape[:2]
    if (width, height) != (info.width, info.height):
        where = "the calibration" if road.calibration else "what is known"
        raise DriveError(
            f"{frame.source}: the image is {width}x{height}, but {where} of camera '{info.name}' is for "
            f"{info.width}x{info.height}; give images of that size, or a calibration for these"
        )
