"""The detector over a whole drive, in worker processes, and which part of each image is the vehicle.

Bonnets, mirrors and reflections on the windscreen are bright, straight-edged and at one place in every image.
A marking on the ground passes through the image as the vehicle drives; only a line along the way stays, and
lines are left alone.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np

from v2hdm.detection.detector import Detector
from v2hdm.detection.frames import read_bgr, read_image
from v2hdm.detection.options import DetectorOptions
from v2hdm.executor import HERE, Executor
from v2hdm.records import BoolArray, Camera, Drive, Image, ImageDetections

_log = logging.getLogger(__name__)
_worker: tuple[Detector, Drive] | None = None
_WORKERS_A_GPU = 8  # processes that share a GPU: each takes memory of its own there

Detect = Callable[[Drive, DetectorOptions, Sequence[int], Executor, Callable[[ImageDetections], None]], None]
"""A function that does what :func:`detect_images` does."""

_FEW_IMAGES = 8  # fewer images than this are looked at before a process has started
_IMAGES_TOGETHER = 4  # most images that a process looks at before it reports; chosen

_IMAGES = 24  # images in which a camera's own vehicle is looked for: a second and a half of work
_LEAST_IMAGES = 10  # images that a mask of the vehicle needs at least
_APART_M = 2.0  # least way of the vehicle between two of these images, m, so that markings have moved on
_SHARE = 0.7  # paint at one place in this share of images is the vehicle: diamonds cover it in a third
_MARGIN_PX = 6  # distance, px, at most at which the network sees an edge from where it is


def _learn(detector: Detector, images: Sequence[Image], camera: Camera) -> BoolArray | None:
    """Where (height, width) a camera's images, in driving order, show its vehicle; None for nowhere."""
    spread: list[Image] = []
    for image in images:
        place = image.map_from_vehicle[:2, 3]
        if not spread or np.linalg.norm(place - spread[-1].map_from_vehicle[:2, 3]) >= _APART_M:
            spread.append(image)
    chosen = np.unique(np.linspace(0, len(spread) - 1, min(_IMAGES, len(spread))).round().astype(np.intp))
    if len(chosen) < _LEAST_IMAGES:
        return None
    shape = (camera.info.height, camera.info.width)
    paint = []
    for k in chosen.tolist():
        pixels = read_bgr(spread[k].path)
        if pixels.shape[:2] != shape:
            return None
        paint.append(detector.markings_paint(pixels, camera))
    always = np.sum(paint, axis=0) >= _SHARE * len(chosen)
    if not always.any():
        return None
    top = detector.road_camera(camera).far_row
    stride = detector.network.info.paint_stride
    mask = np.zeros(shape, dtype=np.uint8)
    in_pixels = np.kron(always.astype(np.uint8), np.ones((stride, stride), dtype=np.uint8))
    rows = min(len(in_pixels), len(mask) - top)
    columns = min(in_pixels.shape[1], mask.shape[1])
    mask[top : top + rows, :columns] = in_pixels[:rows, :columns]
    size = 2 * _MARGIN_PX + 1
    return np.asarray(cv2.dilate(mask, np.ones((size, size), np.uint8)) > 0)


def detect_all(
    drive: Drive,
    options: DetectorOptions | None = None,
    executor: Executor = HERE,
    progress: Callable[[int, int], None] | None = None,
) -> list[ImageDetections]:
    """Detect in every image of a drive, in the drive's order, whatever the ``executor``.

    Raises DriveError where an image is missing, damaged or of the wrong size, DetectorError where the model
    cannot be used, WorkerError where a process died.
    """
    options = replace(options) if options else DetectorOptions()
    drive = with_own_vehicle(drive, Detector.load(options=options))  # a bad model is refused here, once
    results: list[ImageDetections] = []

    def collect(detections: ImageDetections) -> None:
        results.append(detections)
        if progress:
            progress(len(results), len(drive.images))

    detect_images(drive, options, range(len(drive.images)), executor, collect)
    return results


def detect_images(
    drive: Drive,
    options: DetectorOptions,
    images: Sequence[int],
    executor: Executor,
    take: Callable[[ImageDetections], None],
) -> None:
    """Detect in the images of these indices; ``take`` is called with each in order. Raises as detect_all."""
    if executor.workers <= 1 or len(images) < _FEW_IMAGES:
        detector = Detector.load(options=options)
        for index in images:
            take(detect_image(detector, drive, index))
        return
    processes = 0 if options.device == "cpu" else _WORKERS_A_GPU
    executor.share_out(_work, images, _start_worker, (drive, options), take, processes, _IMAGES_TOGETHER)


def own_vehicles(drive: Drive, detector: Detector) -> dict[str, BoolArray]:
    """Masks (height, width) of the vehicle itself, learnt for those cameras that have none and show it."""
    masks = {}
    for name, camera in drive.cameras.items():
        images = [image for image in drive.images if image.camera == name]
        if camera.own_vehicle is None and (mask := _learn(detector, images, camera)) is not None:
            masks[name] = mask
            _log.info("camera %s: %.1f %% of the image is the vehicle itself", name, 100 * mask.mean())
    return masks


def with_own_vehicle(drive: Drive, detector: Detector) -> Drive:
    """The drive with masks of the vehicle itself, learnt for the cameras that have none."""
    return with_masks(drive, own_vehicles(drive, detector))


def with_masks(drive: Drive, masks: Mapping[str, BoolArray]) -> Drive:
    """The drive with these masks of the vehicle itself, by camera, beside those that it has."""
    learnt = {name: replace(drive.cameras[name], own_vehicle=mask) for name, mask in masks.items()}
    return replace(drive, cameras={**drive.cameras, **learnt})


def _start_worker(drive: Drive, options: DetectorOptions) -> None:
    global _worker
    cv2.setNumThreads(1)
    _worker = (Detector.load(options=options), drive)


def _work(index: int) -> ImageDetections:
    if _worker is None:
        raise RuntimeError("worker was not started")
    detector, drive = _worker
    return detect_image(detector, drive, index)


def detect_image(detector: Detector, drive: Drive, index: int) -> ImageDetections:
    """The detections of image ``index`` of a drive, whose cameras know their vehicle; raises DriveError."""
    image = drive.images[index]
    camera = drive.cameras[image.camera]
    markings, lanes = detector.detect(read_image(image, camera), camera)
    return ImageDetections(index, markings, lanes)
