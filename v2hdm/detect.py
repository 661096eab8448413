"""The on-vehicle door: ``python -m v2hdm.detect SOURCE`` finds markings and lanes in images.

It needs the base install only (numpy, opencv, onnxruntime, PyYAML): no torch, no Hydra. One JSON object
a line and image; latency percentiles at the end on stderr.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np

from v2hdm.detection.batch import read_image
from v2hdm.detection.detector import Detector
from v2hdm.detection.draw import draw_detections
from v2hdm.detection.ground import apply_homography, ipm_from_extrinsic
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.view import CameraView
from v2hdm.drive import read_drive
from v2hdm.errors import DriveError, V2hdmError
from v2hdm.hdmap import read_calibration
from v2hdm.records import Calibration, Camera, FloatArray, Image, LaneDetection, MarkingDetection

EXIT_USER_ERROR = 2
_IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the door; the exit code is 0, or 2 with one line on stderr for what a user got wrong."""
    parsed = _parser().parse_args(arguments)
    try:
        _detect(parsed)
    except V2hdmError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USER_ERROR
    except BrokenPipeError:  # the reader of our lines has had enough
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, PTH123
    return 0


def camera_from_calibration(calibration: Calibration) -> Camera:
    """A camera whose IPM is the one of a finished calibration."""
    ipm = ipm_from_extrinsic(calibration.info, calibration.cam_from_vehicle)
    below = np.array([[calibration.info.intrinsic[0, 2], calibration.info.height - 1.0]])
    seen_vehicle = apply_homography(ipm, below)
    square = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
    return Camera(calibration.info, {"calibrated": ipm}, "calibrated", seen_vehicle + square)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m v2hdm.detect", description=__doc__.split("\n\n")[0])
    parser.add_argument("source", type=Path, help="a drive folder, a folder of images, or one image")
    parser.add_argument(
        "--camera", type=Path, help="calibration YAML of the camera, for images outside a drive"
    )
    parser.add_argument("--model", help="ONNX file of the detector (default: the one that is shipped)")
    parser.add_argument("--output", type=Path, help="file for the JSON lines (default: stdout)")
    parser.add_argument(
        "--draw", type=Path, metavar="DIR", help="folder for the images with detections drawn"
    )
    return parser


def _detect(parsed: argparse.Namespace) -> None:
    cv2.setNumThreads(1)
    detector = Detector.load(options=DetectorOptions(model=parsed.model))
    sources = list(_images(parsed.source, parsed.camera))
    part = parsed.output and parsed.output.with_name(parsed.output.name + ".part")
    try:
        with part.open("w") if part else nullcontext(sys.stdout) as stream:
            latency_s = [
                _detect_one(detector, image, camera, stream, parsed.draw) for image, camera in sources
            ]
        if part:
            part.replace(parsed.output)
    except OSError as error:
        if isinstance(error, BrokenPipeError):
            raise
        raise DriveError(
            f"{error.filename}: cannot write there ({error.strerror}); give another place"
        ) from error
    finally:
        if part:
            part.unlink(missing_ok=True)
    p50, p90, p99 = np.percentile(latency_s, [50, 90, 99]) * 1e3
    print(f"{len(latency_s)} images; latency p50 {p50:.1f}, p90 {p90:.1f}, p99 {p99:.1f} ms", file=sys.stderr)


def _images(source: Path, camera_file: Path | None) -> Iterator[tuple[Image, Camera]]:
    if not source.exists():
        raise DriveError(f"{source}: no such image or folder; give a drive, a folder of images or an image")
    if camera_file is None:
        if not source.is_dir():
            raise DriveError(
                f"{source}: an image alone says nothing of its camera; add --camera CALIBRATION.yaml"
            )
        drive = read_drive(source)
        yield from ((image, drive.cameras[image.camera]) for image in drive.images)
        return
    camera = camera_from_calibration(read_calibration(camera_file))
    paths = [source]
    if source.is_dir():
        paths = sorted(path for path in source.iterdir() if path.suffix.lower() in _IMAGE_SUFFIXES)
    if not paths:
        raise DriveError(f"{source}: no images ({', '.join(_IMAGE_SUFFIXES)}) in this folder; give another")
    for path in paths:
        yield Image(camera.info.name, 0.0, path, np.eye(4)), camera


def _detect_one(detector: Detector, image: Image, camera: Camera, stream: TextIO, draw: Path | None) -> float:
    """Detect in one image and write it out; the seconds that detection alone took."""
    pixels = read_image(image, camera)
    view = detector.view(camera)
    start = time.perf_counter()
    markings, lanes = detector.detect(pixels, camera)
    latency_s = time.perf_counter() - start
    print(json.dumps(_record(image, markings, lanes, view)), file=stream)
    if draw is not None:
        draw.mkdir(parents=True, exist_ok=True)
        target = draw / f"{image.camera}_{image.path.stem}.jpg"
        if not cv2.imwrite(str(target), draw_detections(pixels, markings, lanes)):
            raise DriveError(f"{target}: cannot write this picture; give another --draw folder")
    return latency_s


def _record(
    image: Image, markings: Sequence[MarkingDetection], lanes: Sequence[LaneDetection], view: CameraView
) -> dict[str, Any]:
    """What goes into one JSON line; ``_vehicle`` are metres on the ground by the camera's IPM."""
    return {
        "image": str(image.path),
        "camera": image.camera,
        "markings": [
            {
                "class": marking.kind,
                "score": round(marking.score, 4),
                "corners_px": marking.corners_px.round(3).tolist(),
                "corner_valid": marking.corner_valid.tolist(),
                "covariance_px": marking.covariance_px.round(5).tolist(),
                "corners_vehicle": _on_ground(view, marking.corners_px),
            }
            for marking in markings
        ],
        "lanes": [
            {
                "class": lane.kind,
                "score": round(lane.score, 4),
                "points_px": lane.points_px.round(2).tolist(),
                "points_vehicle": _on_ground(view, lane.points_px),
            }
            for lane in lanes
        ],
    }


def _on_ground(view: CameraView, points_px: FloatArray) -> list[list[float] | None]:
    """Points on the ground, vehicle frame, m; None for those at or above the horizon."""
    points_vehicle = view.ground(view.undistort(points_px)).round(4)
    return [point.tolist() if np.isfinite(point).all() else None for point in points_vehicle]


if __name__ == "__main__":
    sys.exit(main())
