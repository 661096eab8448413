"""The network's inputs on renders, from which an int8 network is calibrated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from models.marking_net import KIND_STRIDE, LANE_STRIDE, MULTIPLE, PAINT_STRIDE
from train.config import DataConfig
from train.scenes.hardships import Hardships
from train.scenes.scenes import random_scene
from train.scenes.views import TrainingView, random_view
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.network import Network, NetworkInfo, RawOutput, run_on_road
from v2hdm.geometry.ipm import apply_homography, ipm_from_extrinsic
from v2hdm.records import Camera
from v2hdm.simulate.render.renderer import Renderer

FRAME_SIZES = ((1280, 720), (1248, 384), (1920, 1088))
"""Widths and heights of the cameras that take turns; multiples of 32 px, so that none of them is padded."""

_PATCH_M = 0.1  # half the side, m, of a camera's region of interest


def looks(
    seed: int, frames: int, sizes: tuple[tuple[int, int], ...] = FRAME_SIZES
) -> Iterator[list[NDArray[np.uint8]]]:
    """The network's input for each of ``frames`` renders of full difficulty.

    Every render is of another scene and camera, with the hardships of a training; it is cropped, and its
    near ground halved, by :func:`v2hdm.detection.network.run_on_road` itself.

    Yields:
        The one or two images (H, W, 3) uint8 BGR of a render, H and W multiples of the network's.
    """
    hardships = Hardships(**{field.name: getattr(DataConfig(), field.name) for field in fields(Hardships)})
    for index in range(frames):
        width, height = sizes[index % len(sizes)]
        rng = np.random.default_rng([seed, index])
        scene, _ = random_scene(rng, hardships=hardships)
        view = random_view(rng, width, height)
        rendered = Renderer(scene).render(view.info, view.cam_from_map, rng, view.optics, view.motion)
        onlooker = _Onlooker()
        run_on_road(onlooker, rendered.image, RoadCamera(_camera(view), MULTIPLE))
        yield onlooker.seen


def _camera(view: TrainingView) -> Camera:
    """The camera of a view as a drive would describe it, its mounting known."""
    ipm = ipm_from_extrinsic(view.info, view.cam_from_map)
    foremost = apply_homography(ipm, np.array([[view.info.width / 2, view.info.height - 1.0]]))
    patch = _PATCH_M * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return Camera(view.info, {"true": ipm}, "true", foremost + patch)


class _Onlooker(Network):
    """Stands in for the network: sees nothing anywhere, and keeps what it was shown."""

    def __init__(self) -> None:
        self.info = NetworkInfo(PAINT_CLASSES, MULTIPLE, PAINT_STRIDE, KIND_STRIDE, LANE_STRIDE)
        self.seen: list[NDArray[np.uint8]] = []

    def run(self, image_bgr: np.ndarray) -> RawOutput:
        self.seen.append(np.ascontiguousarray(image_bgr))
        height, width = image_bgr.shape[:2]
        shapes = (
            (height // PAINT_STRIDE, width // PAINT_STRIDE),
            (len(PAINT_CLASSES), height // KIND_STRIDE, width // KIND_STRIDE),
            (2, height // LANE_STRIDE, width // LANE_STRIDE),
        )
        return RawOutput(*(np.full(shape, -9.0, dtype=np.float32) for shape in shapes))
