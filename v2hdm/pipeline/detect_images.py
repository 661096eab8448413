"""The detector over a source of images: files, a drive, a video or a live camera."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, compress, count, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v2hdm.detection.batch import with_own_vehicle
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
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.persistence import STATED_SIGMA_RAD, View, settled
from v2hdm.detection.pointing import Pointed
from v2hdm.detection.road import Road, RoadDetector
from v2hdm.detection.second import SecondLooks
from v2hdm.detection.stopwatch import Stopwatch, lap
from v2hdm.doors import checked
from v2hdm.errors import ConfigError, DriveError, shown
from v2hdm.io.calibration.intrinsics import is_calibration, read_intrinsics
from v2hdm.io.drive import READERS, need_pictures, read_drive
from v2hdm.pipeline.rough_camera import ROUGH_NAME, RoughCamera, check_size
from v2hdm.records import Calibration, CameraInfo
from v2hdm.safe.pixels import IMAGE_SUFFIXES
from v2hdm.store.inputs import note_input

_ROUGH_RANGE_M = 40.0  # distances may be wrong by two without a calibration: none is too far

_Frames = Iterator[tuple[Frame, RoadDetector | None]]
"""Frames to look at, and the detector for each as far as it is known before the first."""


Regions = Callable[[Frame], Pointed | None]
"""Where to look in a frame, None for everywhere."""


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
    regions: Regions | None = None,
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
        regions: says for a frame of a calibrated camera where markings with corners are looked for, boxes
            (R, 4) of left, top, right and bottom, px; None for everything everywhere. With it, there are no
            metres, and of lanes only their paint: what a localiser takes. All of a live image may be searched
            later, once no newer one waits: it then comes a second time (``road.is_second``).

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
    _check_numbers(mounting, limit)
    if not isinstance(detector, Detector):
        detector = _loaded(detector, is_rough=path is None or lens is not None)
    calibration = None if lens is not None else path
    road = _calibrated(detector, calibration, linear, is_for_localizer=regions is not None)
    rough = RoughCamera(detector, lens, path, mounting, linear)
    most = limit and min(limit, sys.maxsize)
    newest = _newest_frames(str(source), road, rough, regions is not None) if live else None
    frames = _frames(str(source), road, rough) if newest is None else ((frame, road) for frame in newest)
    later = SecondLooks(newest) if isinstance(newest, NewestFrames) else None
    return _on_ground(_glances(islice(frames, most), rough, stopwatch or Stopwatch(), regions, later))


def _check_numbers(mounting: Sequence[float] | None, limit: int | None) -> None:
    """Raise ConfigError unless a mounting has three numbers and a limit is positive."""
    if mounting is not None and len(mounting) != 3:
        raise ConfigError(
            f"--mounting: {len(mounting)} numbers; give height (m), pitch (deg) and field of view (deg)"
        )
    if limit is not None and limit < 1:
        raise ConfigError(f"--limit {limit}: give a number of images, 1 or more")


def _loaded(options: DetectorOptions | None, is_rough: bool) -> Detector:
    """The detector of these settings; a roughly known camera looks no farther than its metres hold."""
    options = replace(options) if options is not None else DetectorOptions()
    if is_rough:
        options.max_range_m = _ROUGH_RANGE_M
    return Detector.load(options=options)


def _calibrated(
    detector: Detector, calibration: Path | None, linear: bool, is_for_localizer: bool
) -> RoadDetector | None:
    """The detector on the road of a camera with a calibration, if one is stated."""
    if calibration is None:
        return None
    road = RoadDetector.calibrated(detector, calibration, linear)
    if not is_for_localizer:
        return road
    return RoadDetector(detector, road.camera, road.calibration, is_for_localizer=True)


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


def _frames(source: str, road: RoadDetector | None, rough: RoughCamera) -> _Frames:
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


def _of_camera(number: int, road: RoadDetector | None, rough: RoughCamera) -> Iterator[Frame]:
    info = rough.lens or (road and road.camera.info)
    return camera_frames(number, (info.width, info.height) if info else None)


def _newest_frames(
    source: str, road: RoadDetector | None, rough: RoughCamera, are_read_ahead: bool
) -> Iterator[Frame]:
    """The newest frame of a camera or a folder each time; the next is read while the last is processed."""
    path = Path(source)
    if source.isdecimal() and not path.exists():
        return NewestFrames(_of_camera(int(source), road, rough))
    if path.is_dir():
        return NewestFrames(arriving_frames(path)) if are_read_ahead else arriving_frames(path)
    raise ConfigError(f"--live: {path} is not a camera's index or a folder; only these get new images")


def _drive_frames(path: Path, road: RoadDetector | None, rough: RoughCamera) -> _Frames:
    """The images of a drive, each read when its turn comes; if a calibration was given, of its camera."""
    if rough.lens is not None:
        raise ConfigError(
            "--camera: this file holds only intrinsics, and a drive has its own; drop --camera, or name the "
            "file as camera_info in drive.yaml"
        )
    drive = read_drive(path)
    need_pictures(drive, "detection")
    calibration = None
    if road is not None:
        name = road.camera.info.name
        if name not in drive.cameras:
            raise DriveError(
                f"{path}: no camera {shown(name)} in the calibration; it has {', '.join(drive.cameras)}"
            )
        drive = replace(drive, cameras={name: road.camera})
        calibration = road.calibration
    drive = with_own_vehicle(drive, rough.detector)
    roads = {
        name: RoadDetector(rough.detector, camera, calibration) for name, camera in drive.cameras.items()
    }
    numbers = {name: count() for name in roads}
    return (
        (
            replace(
                frame,
                name=f"{name}_{frame.name}",
                index=next(numbers[name]),
                stamp_s=image.stamp_s,
                map_from_vehicle=image.map_from_vehicle,
            ),
            roads[name],
        )
        for image in drive.images
        if (name := image.camera) in roads
        for frame in image_frames([image.path])
    )


class _Glance(NamedTuple):
    """The road of an image, and the view of it if its pose is known."""

    detected: Detected
    view: View | None


def _on_ground(glances: Iterator[_Glance]) -> Iterator[Detected]:
    """The roads of images; where poses are known, of the markings only those that stay on the ground."""
    first = next(glances, None)
    if first is None:
        return
    if first.view is None:
        yield from (glance.detected for glance in chain([first], glances))
        return
    for glance, stays in settled(chain([first], glances), _camera_and_view):
        road = glance.detected.road
        paint = tuple(compress(road.markings, stays.tolist()))
        yield glance.detected._replace(road=replace(road, markings=paint))


def _pitch_sigma_rad(calibration: Calibration | None) -> float:
    """How far a camera's pitch may be off."""
    if calibration is None or calibration.covariance is None:
        return STATED_SIGMA_RAD
    rotation = np.asarray(calibration.covariance)[3:, 3:]
    return float(np.sqrt(np.trace(rotation)))


def _camera_and_view(glance: _Glance) -> tuple[str, View]:
    assert glance.view is not None
    return glance.detected.camera, glance.view


def _glances(
    frames: _Frames,
    rough: RoughCamera,
    stopwatch: Stopwatch,
    regions: Regions | None,
    later: SecondLooks | None,
) -> Iterator[_Glance]:
    """The road of every frame; some frames yield a second one after a search of the whole image."""
    while True:
        if later is not None and (second := later.look()) is not None:
            yield _Glance(Detected(second.frame, second.camera, second.road), None)
            continue
        with stopwatch.image():
            with lap("read"):
                frame, road = next(frames, (None, None))
            if frame is None:
                stopwatch.discard()
                return
            if road is None:
                on_road = rough.detect(frame)
                name = ROUGH_NAME if rough.lens is None else rough.lens.name
            else:
                check_size(frame, road.camera.info, "the calibration" if road.calibration else "the drive")
                pointed = None if regions is None else regions(frame)
                regions_px = None if pointed is None else pointed.regions_px
                on_road = road.detect(frame.pixels, regions_px=regions_px)
                name = road.camera.info.name
                if later is not None and pointed is not None and pointed.is_all_later:
                    later.add(frame, road)
        view = None
        if road is not None and frame.map_from_vehicle is not None:
            markings = [marking.image for marking in on_road.markings]
            view = View(
                frame.map_from_vehicle,
                road.detector.road_camera(road.camera),
                markings,
                _pitch_sigma_rad(road.calibration),
                road.detector.options.max_range_m,
            )
        yield _Glance(Detected(frame, name, on_road), view)
