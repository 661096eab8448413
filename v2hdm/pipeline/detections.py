"""The stage of detection, kept piece by piece, so that a run that was stopped goes on in the middle.

A piece rests on the pixels of its images and on what is known of their cameras, not on where or of which
drive they are.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from v2hdm.detection.batch import Detect, detect_images, own_vehicles, with_masks
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.pipeline.config import Contents, model_key
from v2hdm.pipeline.context import Context
from v2hdm.records import Drive, ImageDetections
from v2hdm.store.cache import key_of

_log = logging.getLogger(__name__)

STAGE = "detect"
PIECE = 16  # images of a piece: a second or two of work
_Masks = dict[str, NDArray[np.bool_]]
_Piece = list[ImageDetections]


def detect_in_pieces(
    drive: Drive,
    contents: Contents,
    options: DetectorOptions,
    context: Context,
    detect: Detect = detect_images,
) -> list[ImageDetections]:
    """Detect in every image of a drive, in its order, where that is not known yet, by ``detect``."""
    cache, progress = context.cache, context.steps("detect")
    detector_key = cache.key(options, model_key(options))
    masks = cache.get_or_make(
        "own_vehicle",
        key_of(detector_key, contents.key(drive)),
        _Masks,
        # On the CPU wherever the rest runs, so that it is the same and needs no GPU here.
        lambda: own_vehicles(drive, Detector.load(options=replace(options, device="cpu"))),
    )
    drive = with_masks(drive, masks)
    keys = _keys(drive, contents, detector_key)
    pieces = {start: cache.get(STAGE, key, _Piece) for start, key in keys.items()}
    missing = [start for start, piece in pieces.items() if piece is None]
    total = len(drive.images)
    todo = [i for start in missing for i in range(start, min(start + PIECE, total))]
    if len(todo) < total:
        _log.info("detections in %d of %d images were kept by an earlier run", total - len(todo), total)
    progress(total - len(todo), total)
    begun: _Piece = []
    done = 0

    def take(found: ImageDetections) -> None:
        nonlocal done
        done += 1
        start = found.image - found.image % PIECE
        begun.append(replace(found, image=found.image - start))
        if len(begun) == min(PIECE, total - start):
            pieces[start] = cache.put(STAGE, keys[start], _Piece, begun)
            begun.clear()
        progress(total - len(todo) + done, total)

    if todo:
        detect(drive, options, todo, context.processes, take)
    return [replace(one, image=start + one.image) for start, piece in pieces.items() for one in piece or ()]


def _keys(drive: Drive, contents: Contents, detector_key: str) -> dict[int, str]:
    """The key of each piece, by its first image."""
    cameras = {name: key_of(camera) for name, camera in drive.cameras.items()}
    keys = {}
    for start in range(0, len(drive.images), PIECE):
        images = drive.images[start : start + PIECE]
        known = [cameras[image.camera] for image in images]
        keys[start] = key_of(detector_key, known, contents.of_images(images))
    return keys
