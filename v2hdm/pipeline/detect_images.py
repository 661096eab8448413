"""The detector over a source of images: JSON lines and drawings out, latencies at the end."""

from __future__ import annotations

import argparse
import errno
import json
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple, TextIO

import cv2
import numpy as np

from v2hdm.detection.camera.mounting import camera_from_calibration, rough_calibration
from v2hdm.detection.detector import Detector
from v2hdm.detection.draw import draw_detections
from v2hdm.detection.frames import Frame, camera_frames, image_frames, list_images, video_frames
from v2hdm.detection.horizon import PitchVote
from v2hdm.detection.image_file import IMAGE_SUFFIXES
from v2hdm.detection.json_line import as_record
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.road import Road, RoadDetector
from v2hdm.detection.stopwatch import Stopwatch, lap
from v2hdm.detection.weights import unknown_network
from v2hdm.errors import ConfigError, DriveError
from v2hdm.io.calibration.intrinsics import is_calibration, read_intrinsics
from v2hdm.io.drive import READERS, read_drive
from v2hdm.records import CameraInfo, Drive
from v2hdm.store.files import forget_stdout, whole_file
from v2hdm.store.inputs import note_input, refuse_input
from v2hdm.store.outputs import GrowingFolder, growing_folder

_ROUGH_RANGE_M = 40.0
"""Without a calibration distances may be wrong by a factor of two: nothing may be dropped for being far."""

_FIRST = b'{"source": '
"""What every line of detections begins with."""

_STAGES = ("read", "net", "propose", "lanes", "fit", "judge")


class _Job(NamedTuple):
    """Frames to look at, and the detector for each as far as it is known before the first."""

    frames: Iterator[tuple[Frame, RoadDetector | None]]
    live: bool = False


def watch(parsed: argparse.Namespace) -> None:
    """Detect in every image of a source.

    A live camera is watched until Ctrl-C; for any other source that is raised on, and no file is written.

    Args:
        parsed: the arguments of :mod:`v2hdm.cli.detect`.

    Raises:
        V2hdmError: what a user got wrong.
    """
    cv2.setNumThreads(1)
    options = DetectorOptions(model=parsed.model, threads=parsed.threads)
    lens = _lens(parsed)
    if parsed.camera is None or lens is not None:
        options.max_range_m = _ROUGH_RANGE_M
    detector = Detector.load(options=options)
    unknown = unknown_network(parsed.model) if parsed.model is not None else None
    job = _job(parsed, detector, lens)
    stopwatch = Stopwatch()
    failure = None
    with _drawings(parsed.draw) as drawings, _lines(parsed.output) as stream:
        try:
            for frame, road, found in _found(job, parsed, detector, lens, stopwatch):
                print(json.dumps(as_record(frame, road.camera.info.name, found)), file=stream)
                if job.live:
                    stream.flush()
                if drawings is not None:
                    _draw(drawings, frame, found)
        except KeyboardInterrupt:
            if not job.live:
                raise
        except DriveError as error:
            if not (job.live and stopwatch.images):
                raise
            failure = error  # hours of a camera that was unplugged are kept
    _report(stopwatch)
    if unknown is not None:
        print(unknown, file=sys.stderr)
    if failure:
        raise failure


def _lens(parsed: argparse.Namespace) -> CameraInfo | None:
    """The intrinsics of ``--camera`` where they are all that the file holds, as other tools write it."""
    if parsed.camera is None:
        if parsed.camera_name is not None:
            raise ConfigError("--camera-name: names a camera in the file of --camera; add that")
        return None
    if not is_calibration(parsed.camera):
        return read_intrinsics(parsed.camera, parsed.camera_name, "--camera-name")
    if parsed.camera_name is not None:
        raise ConfigError(f"--camera-name: {parsed.camera} is the calibration of one camera; drop it")
    if parsed.mounting is not None:
        raise ConfigError(
            "--camera and --mounting exclude each other: a calibration holds the mounting; drop one"
        )
    return None


def _job(parsed: argparse.Namespace, detector: Detector, lens: CameraInfo | None) -> _Job:
    """What the source is, and which detector its frames want."""
    if parsed.limit is not None and parsed.limit < 1:
        raise ConfigError(f"--limit {parsed.limit}: give the number of images to stop after, 1 or more")
    road = None
    if parsed.camera is not None and lens is None:
        road = RoadDetector.calibrated(detector, parsed.camera, parsed.linear)
    path = Path(parsed.source)
    if parsed.source.isdecimal():
        if path.exists():
            raise ConfigError(
                f"{path}: a camera's index, and a file or folder here, too; write ./{path} for that, "
                "or start from another folder for the camera"
            )
        info = lens or (road and road.camera.info)
        frames = camera_frames(int(parsed.source), (info.width, info.height) if info else None)
        return _Job(((frame, road) for frame in frames), live=True)
    if not path.exists():
        raise DriveError(f"{path}: no such image, video or folder; a camera is named by its index, such as 0")
    if path.is_dir():
        paths = list_images(path)
        if paths:
            for image in paths:
                note_input(image)
            return _Job((frame, road) for frame in image_frames(paths))
        if any(reader.accepts(path) for reader in READERS.values()):
            return _Job(_drive_frames(path, detector, road, lens))
        raise DriveError(f"{path}: no images ({', '.join(IMAGE_SUFFIXES)}) and no drive in this folder")
    note_input(path)
    if READERS["bag"].accepts(path):
        return _Job(_drive_frames(path, detector, road, lens))
    frames = image_frames([path]) if path.suffix.lower() in IMAGE_SUFFIXES else video_frames(path)
    return _Job((frame, road) for frame in frames)


def _drive_frames(
    path: Path, detector: Detector, road: RoadDetector | None, lens: CameraInfo | None
) -> Iterator[tuple[Frame, RoadDetector]]:
    """The images of a drive; if a calibration was given, those of its camera."""
    if lens is not None:
        raise ConfigError(
            "--camera: this file holds intrinsics alone, and a drive has its own; drop --camera, or name the "
            "file as camera_info in drive.yaml"
        )
    drive = read_drive(path)
    for image in drive.images:
        note_input(image.path)
    roads = {name: RoadDetector(detector, camera) for name, camera in drive.cameras.items()}
    if road is not None:
        name = road.camera.info.name
        if name not in drive.cameras:
            raise DriveError(
                f"{path}: no camera '{name}', as the calibration calls it; this drive has {', '.join(roads)}"
            )
        roads = {name: road}
    return _frames_of(drive, roads)


def _frames_of(drive: Drive, roads: Mapping[str, RoadDetector]) -> Iterator[tuple[Frame, RoadDetector]]:
    """Each of the images, read when its turn comes, with the detector of its camera."""
    for image in drive.images:
        if image.camera in roads:
            (frame,) = image_frames([image.path])
            name = f"{image.camera}_{frame.name}"
            yield replace(frame, name=name, stamp_s=image.stamp_s), roads[image.camera]


def _found(
    job: _Job,
    parsed: argparse.Namespace,
    detector: Detector,
    lens: CameraInfo | None,
    stopwatch: Stopwatch,
) -> Iterator[tuple[Frame, RoadDetector, Road]]:
    """Every frame with what it shows."""
    frames = iter(job.frames if parsed.limit is None else islice(job.frames, parsed.limit))
    rough: RoadDetector | None = None
    vote = PitchVote()
    while True:
        with stopwatch.image():
            with lap("read"):
                frame, road = next(frames, (None, None))
            if frame is None:
                stopwatch.discard()
                return
            if road is None:
                road = rough = rough or _rough_road(frame, parsed, detector, lens)
            _check_size(frame, road)
            found = road.detect(frame.pixels)
        yield frame, road, found
        if road is not rough:
            continue
        pitch_rad = vote.add([lane.image for lane in found.lanes], detector.view(road.camera))
        if pitch_rad is not None:
            rough = _rough_road(frame, parsed, detector, lens, float(np.rad2deg(pitch_rad)))


def _rough_road(
    frame: Frame,
    parsed: argparse.Namespace,
    detector: Detector,
    lens: CameraInfo | None,
    seen_pitch_deg: float | None = None,
) -> RoadDetector:
    """A detector for a camera of unknown mounting; it says what it takes that to be."""
    height_m, pitch_deg, fov_deg = parsed.mounting or parsed.rough_mounting
    if not (0 < height_m < np.inf and -45 < pitch_deg < 85 and 10 <= fov_deg <= 150):
        raise ConfigError(
            f"--mounting {height_m:g} {pitch_deg:g} {fov_deg:g}: give a height above 0 m, a pitch "
            "of -45 to 85 deg (down is positive) and a field of view of 10 to 150 deg"
        )
    if lens is not None:
        fov_deg = float(2 * np.degrees(np.arctan(lens.width / 2 / lens.intrinsic[0, 0])))
    if seen_pitch_deg is not None:
        print(
            f"the lines of {frame.name} and images before it meet on a horizon: taking the camera to look "
            f"{seen_pitch_deg:.1f} deg down, not {pitch_deg:g}, from here on",
            file=sys.stderr,
        )
        pitch_deg = seen_pitch_deg
    elif parsed.mounting is None:
        known = "no --camera" if lens is None else f"no mounting in {parsed.camera}"
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
    return RoadDetector(detector, camera_from_calibration(calibration, parsed.linear))


def _check_size(frame: Frame, road: RoadDetector) -> None:
    info = road.camera.info
    height, width = frame.pixels.shape[:2]
    if (width, height) != (info.width, info.height):
        where = "the calibration" if road.footprint else "what is known"
        raise DriveError(
            f"{frame.source}: the image is {width}x{height}, but {where} of camera '{info.name}' is for "
            f"{info.width}x{info.height}; give images of that size, or the calibration of these"
        )


@contextmanager
def _lines(output: Path | None) -> Iterator[TextIO]:
    """Where the JSON lines go; a file appears when it is complete."""
    if output is None:
        try:
            yield sys.stdout
            sys.stdout.flush()
        except BrokenPipeError:
            raise
        except OSError as error:
            forget_stdout()
            raise DriveError(
                f"standard output: cannot be written ({error.strerror}); give an --output with room for it"
            ) from error
        return
    try:
        if output.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        refuse_input(output)
        if output.is_file() and not _is_ours(output):
            raise ConfigError(f"{output}: is there already and holds no detections; give another --output")
        if output.exists() and not output.is_file():  # a pipe, or /dev/null
            with output.open("w", encoding="utf-8") as stream:
                yield stream
            return
        with whole_file(output) as partial, partial.open("w", encoding="utf-8") as stream:
            yield stream
    except OSError as error:
        raise DriveError(f"{output}: cannot write there ({error.strerror}); give another --output") from error


def _is_ours(output: Path) -> bool:
    """Whether a file holds JSON lines of ours, or nothing."""
    with output.open("rb") as stream:
        begin = stream.read(len(_FIRST))
    return begin in (b"", _FIRST)


@contextmanager
def _drawings(folder: Path | None) -> Iterator[GrowingFolder | None]:
    """The folder of the drawings, if any are wanted."""
    if folder is None:
        yield None
        return
    with growing_folder(folder, "--draw") as drawings:
        yield drawings


def _draw(drawings: GrowingFolder, frame: Frame, found: Road) -> None:
    """Write the frame with its detections drawn, at once or not at all."""
    drawn = draw_detections(
        frame.pixels, [marking.image for marking in found.markings], [lane.image for lane in found.lanes]
    )
    _, packed = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, 92])
    drawings.write(f"{frame.name}.jpg", packed.tobytes())


def _report(stopwatch: Stopwatch) -> None:
    """How long it took, on stderr."""
    if not stopwatch.images:
        print("no images", file=sys.stderr)
        return
    print(f"{stopwatch.images} images{_peak_memory()}", file=sys.stderr)
    print(f"{'latency, ms':12s} {'p50':>7s} {'p90':>7s} {'p99':>7s}", file=sys.stderr)
    stages = [stage for stage in _STAGES if stage in stopwatch.stages]
    stages += [stage for stage in stopwatch.stages if stage not in _STAGES]
    times_s = {stage: stopwatch.times_s(stage) for stage in stages}
    times_s["other"] = stopwatch.total_s() - sum(times_s.values())
    times_s["all"] = stopwatch.total_s()
    for stage, seconds in times_s.items():
        p50, p90, p99 = np.percentile(seconds, [50, 90, 99]) * 1e3
        print(f"{stage:12s} {p50:7.1f} {p90:7.1f} {p99:7.1f}", file=sys.stderr)


def _peak_memory() -> str:
    """The most memory that this process ever held, where the operating system counts it."""
    status = Path("/proc/self/status")
    if status.is_file():  # getrusage would count what the parent held when it started us
        peak = next((line for line in status.read_text().splitlines() if line.startswith("VmHWM")), "")
        return f", peak memory {int(peak.split()[1]) * 1024 / 1e6:.0f} MB" if peak else ""
    if sys.platform != "darwin":
        return ""
    import resource

    return f", peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.0f} MB"
