"""The detector over a whole drive, in worker processes."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np

from v2hdm.detection.detector import Detector
from v2hdm.detection.image_file import read_bgr
from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import DriveError
from v2hdm.records import Camera, Drive, Image, ImageDetections

_worker: tuple[Detector, Drive] | None = None
_CHUNK = 4
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def read_image(image: Image, camera: Camera) -> np.ndarray:
    """Decode an image file of a drive to (H, W, 3) uint8 BGR; grey cameras are taken, too.

    Raises:
        DriveError: the file is missing, truncated, not 8-bit or not of the camera's size.
    """
    pixels = read_bgr(image.path, grey=True)
    expected = (camera.info.height, camera.info.width)
    if pixels.shape[:2] != expected:
        raise DriveError(
            f"{image.path}: the image is {pixels.shape[1]}x{pixels.shape[0]} but the camera_info of camera "
            f"{image.camera!r} says {expected[1]}x{expected[0]}; mend the camera_info or the image list"
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
    """
    options = replace(options) if options else DetectorOptions()
    total = len(drive.images)
    results: list[ImageDetections] = []

    def collect(detections: ImageDetections) -> None:
        results.append(detections)
        if progress:
            progress(len(results), total)

    if workers <= 1 or total < 2 * _CHUNK:
        detector = Detector.load(options=options)
        for index in range(total):
            collect(_detect_image(detector, drive, index))
        return results
    Detector.load(options=options)  # a bad model is refused here, once, not in every worker
    context = multiprocessing.get_context("spawn")
    with (
        _single_threaded_children(),
        context.Pool(min(workers, total), _start_worker, (drive, options)) as pool,
    ):
        for detections in pool.imap(_work, range(total), chunksize=_CHUNK):
            collect(detections)
    return results


@contextmanager
def _single_threaded_children() -> Iterator[None]:
    """Keep numpy's linear algebra in child processes from starting a thread a core each."""
    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _start_worker(drive: Drive, options: DetectorOptions) -> None:
    global _worker
    cv2.setNumThreads(1)
    _worker = Detector.load(options=options), drive


def _work(index: int) -> ImageDetections:
    if _worker is None:
        raise RuntimeError("worker was not started")
    return _detect_image(*_worker, index)


def _detect_image(detector: Detector, drive: Drive, index: int) -> ImageDetections:
    image = drive.images[index]
    camera = drive.cameras[image.camera]
    return ImageDetections(index, *detector.detect(read_image(image, camera), camera))
