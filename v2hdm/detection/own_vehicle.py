"""Which part of a camera's image is the vehicle itself: paint that never moves is none.

Bonnets, mirrors and reflections on the windscreen are bright, straight-edged and at one place in every image.
A marking on the ground passes through the image as the vehicle drives; only a line along the way stays, and
lines are left alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from v2hdm.detection.detector import Detector
from v2hdm.detection.image_file import read_bgr
from v2hdm.records import BoolArray, Camera, Image

_IMAGES = 24
"""Images that are looked at: a second and a half of work."""

_LEAST_IMAGES = 10
_APART_M = 2.0
"""They are at least this far apart, m, so that markings have moved on."""

_SHARE = 0.7
"""Paint at one place in this share of images is the vehicle: fields of diamonds cover it in a third."""

_MARGIN_PX = 6
"""The network sees an edge this far from where it is."""


def learn_own_vehicle(detector: Detector, images: Sequence[Image], camera: Camera) -> BoolArray | None:
    """Where (height, width) images of a camera show its vehicle; None where they show or tell none.

    Args:
        detector: its network is asked.
        images: those of the camera, in driving order.
        camera: the camera.
    """
    chosen = _spread_out(images)
    if len(chosen) < _LEAST_IMAGES:
        return None
    total: np.ndarray | None = None
    for image in chosen:
        pixels = read_bgr(image.path)
        if pixels.shape[:2] != (camera.info.height, camera.info.width):
            return None
        paint = detector.markings_paint(pixels, camera)
        total = paint.astype(np.int32) if total is None else total + paint
    assert total is not None
    always = total >= _SHARE * len(chosen)
    if not always.any():
        return None
    view, stride = detector.view(camera), detector.network.info.paint_stride
    mask = np.zeros((camera.info.height, camera.info.width), dtype=np.uint8)
    grown = np.kron(always.astype(np.uint8), np.ones((stride, stride), dtype=np.uint8))
    rows, columns = min(len(grown), len(mask) - view.far_row), min(grown.shape[1], mask.shape[1])
    mask[view.far_row : view.far_row + rows, :columns] = grown[:rows, :columns]
    size = 2 * _MARGIN_PX + 1
    return np.asarray(cv2.dilate(mask, np.ones((size, size), np.uint8)) > 0)


def _spread_out(images: Sequence[Image]) -> list[Image]:
    """Up to :data:`_IMAGES` images, evenly spread over those taken far enough apart."""
    apart: list[Image] = []
    for image in images:
        place = image.map_from_vehicle[:2, 3]
        if not apart or np.linalg.norm(place - apart[-1].map_from_vehicle[:2, 3]) >= _APART_M:
            apart.append(image)
    at = np.unique(np.linspace(0, len(apart) - 1, min(_IMAGES, len(apart))).round().astype(np.intp))
    return [apart[k] for k in at.tolist()]
