"""The detector over a whole drive, in worker processes."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from v2hdm.detection.detector import Detector
from v2hdm.detection.image_file import read_bgr
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.own_vehicle import learn_own_vehicle
from v2hdm.errors import DriveError
from v2hdm.records import Camera, Drive, Image, ImageDetections
from v2hdm.workers import share_out

_log = logging.getLogger(__name__)
_worker: tuple[Detector, Drive] | None = None
_FEW_IMAGES = 8
"""Fewer are looked at before a process has started."""


def read_image(image: Image, camera: Camera) -> np.ndarray:
    """Decode an image file of a drive to (H, W, 3) uint8 BGR; grey cameras are taken, too.

    Raises:
        DriveError: the file is missing, truncated, not 8-bit or not of the camera's size.
    """
    pixels = read_bgr(image.path)
    expected = (camera.info.height, camera.info.width)
    if pixels.shape[:2] != expected:
        raise DriveError(
            f"{image.path}: the image is {pixels.shape[1]}x{pixels.shape[0]} but the camera_info of camera "
            f"'{image.camera}' says {expected[1]}x{expected[0]}; mend the camera_info or the image list"
        )
    return pixels


def detect_all(
    drive: Drive,
    options: DetectorOptions | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> list[ImageDetections]:
    """Detect in every image of a drive, in the drive's order.

    The result does not depend on ``workers``.

    Args:
        drive: what to look at.
        options: detector settings.
        workers: processes, one thread each; 1 stays in this process.
        progress: called as ``progress(done, total)`` after each image.

    Raises:
        DriveError: an image is missing, damaged or of the wrong size.
        DetectorError: the model cannot be used.
        WorkerError: a process died.
    """
    options = replace(options) if options else DetectorOptions()
    detector = Detector.load(options=options)  # a bad model is refused here, once, not in every worker
    drive = with_own_vehicle(drive, detector)
    total = len(drive.images)
    results: list[ImageDetections] = []

    def collect(detections: ImageDetections) -> None:
        results.append(detections)
        if progress:
            progress(len(results), total)

    if workers <= 1 or total < _FEW_IMAGES:
        for index in range(total):
            collect(detect_image(detector, drive, index))
        return results
    share_out(_work, range(total), workers, _start_worker, (drive, options), collect)
    return results


def with_own_vehicle(drive: Drive, detector: Detector) -> Drive:
    """The drive with masks of the vehicle itself, learnt for the cameras that have none."""
    cameras = dict(drive.cameras)
    for name, camera in drive.cameras.items():
        if camera.own_vehicle is not None:
            continue
        mask = learn_own_vehicle(detector, [image for image in drive.images if image.camera == name], camera)
        if mask is not None:
            cameras[name] = replace(camera, own_vehicle=mask)
            _log.info("camera %s: %.1f %% of the image is the vehicle itself", name, 100 * mask.mean())
    return replace(drive, cameras=cameras)


def _start_worker(drive: Drive, options: DetectorOptions) -> None:
    global _worker
    cv2.setNumThreads(1)
    _worker = Detector.load(options=options), drive


def _work(index: int) -> ImageDetections:
    if _worker is None:
        raise RuntimeError("worker was not started")
    return detect_image(*_worker, index)


def detect_image(detector: Detector, drive: Drive, index: int) -> ImageDetections:
    """What a detector finds in image ``index`` of a drive, see :func:`with_own_vehicle`.

    Raises:
        DriveError: the image is missing, damaged or of the wrong size.
    """
    image = drive.images[index]
    camera = drive.cameras[image.camera]
    return ImageDetections(index, *detector.detect(read_image(image, camera), camera))
