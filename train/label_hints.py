"""The shipped network fills in where the labels of photographs leave something unsaid.

A label set may leave far or worn paint out, may call all lines alike, and may draw one outline about a whole
crosswalk. There the shipped network is asked: paint that it sees and that nobody labelled is unknown rather
than bare, a line is of the class that network, size and direction on the ground agree on, and only what it
takes for paint is a bar of a crosswalk. Brightness says that better, where it is asked
(:mod:`train.labels_tone`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from train.config import DataConfig
from train.labels_image import ANY, LabelledImage, Shape, Silence
from train.labels_raster import coverage
from train.labels_tone import log_light, tone_of
from v2hdm.catalogue import LINE, NOT_PAINT, SHIPPED, STRIPE
from v2hdm.detection.camera import RoadCamera, camera_from_calibration, rough_calibration
from v2hdm.detection.network import Network, as_probability
from v2hdm.records import STOP_LINE, BoolArray, FloatArray

CELL_PX = 4
"""Planes of hints have a cell for so many px, as the network's classes do."""

_HINT = 0.3
"""Paint is hinted at from this probability on: lower than a decision, for what it hints at is only left open.
Chosen, not measured."""

_SURE = 0.8
"""A class is taken from this posterior probability on, otherwise it stays unknown."""

_ASKEW = -6.0
"""Log odds of a lane's line that lies wholly across the vehicle's way, or of a stop line along it. Chosen:
the network can say little of stop lines before it has learnt them."""

_LABELLED_M = 30.0
"""Beyond this range nobody labels completely; a diamond of 2 m is 2 px tall there."""

Tell = Callable[[float], None]


def with_hints(images: Sequence[LabelledImage], config: DataConfig, tell: Tell) -> list[LabelledImage]:
    """Images with their open classes resolved and their silence stated; ``tell`` hears the share done.

    Raises:
        DriveError: an image cannot be read.
    """
    hints = _Hints.of(config)
    hinted = []
    for number, image in enumerate(images):
        hinted.append(hints.of_image(image) if image.shapes is not None else image)
        tell((number + 1) / len(images))
    return hinted


@dataclass(frozen=True)
class _Hints:
    """The shipped network, over the camera of a label set."""

    network: Network
    config: DataConfig

    @classmethod
    def of(cls, config: DataConfig) -> _Hints:
        return cls(Network(), config)

    def of_image(self, image: LabelledImage) -> LabelledImage:
        pixels = image.pixels()
        raw = self.network.run(pixels)
        paint = as_probability(cv2.resize(raw.paint, raw.kinds.shape[:0:-1], interpolation=cv2.INTER_AREA))
        kinds = raw.kinds - raw.kinds.max(axis=0)
        kinds -= np.log(np.exp(kinds).sum(axis=0))
        camera = self._camera(pixels.shape[1], pixels.shape[0])
        shapes = tuple(self._resolved(shape, kinds, camera) for shape in image.shapes or ())
        if self.config.coco_tone:
            light = log_light(pixels)
            shapes = tuple(_toned(shape, light) for shape in shapes)
        is_paint = paint > _HINT
        silence = Silence(
            np.packbits(is_paint, axis=1),
            np.packbits(is_paint & self._unsaid(kinds, camera), axis=1),
            (is_paint.shape[0], is_paint.shape[1]),
        )
        return replace(image, shapes=shapes, silence=silence)

    def _camera(self, width: int, height: int) -> RoadCamera | None:
        if self.config.coco_camera is None:
            return None
        up_m, pitch_deg, fov_deg = self.config.coco_camera
        return RoadCamera(
            camera_from_calibration(rough_calibration("labels", width, height, up_m, pitch_deg, fov_deg))
        )

    def _unsaid(self, kinds: np.ndarray, camera: RoadCamera | None) -> BoolArray:
        """Cells (h, w) where paint may be that nobody labelled, by log shares (K, h, w)."""
        names = self.network.info.classes
        complete = self.config.coco_complete
        silent = np.array([complete is not None and name not in complete for name in names])
        unsaid = silent[kinds.argmax(axis=0)]
        if camera is None:
            return np.asarray(unsaid)
        rows, columns = unsaid.shape
        middle_px = (np.mgrid[:rows, :columns].reshape(2, -1).T[:, ::-1] + 0.5) * CELL_PX - 0.5
        ground = camera.ground(camera.undistort(middle_px)).reshape(rows, columns, 2)
        range_m = np.linalg.norm(ground - camera.foot_vehicle, axis=2)
        on_ground = np.isfinite(range_m)
        return np.asarray(on_ground & (unsaid | (np.nan_to_num(range_m, nan=0.0) > _LABELLED_M)))

    def _resolved(self, shape: Shape, kinds: np.ndarray, camera: RoadCamera | None) -> Shape:
        """The shape with one class, :data:`~train.labels_image.ANY` where several may be true."""
        if len(shape.kinds) == 1 or NOT_PAINT in shape.kinds:
            return shape
        names = self.network.info.classes
        rows, columns = kinds.shape[1:]
        inside = sum(coverage((r + 0.5) / CELL_PX - 0.5, 0, 0, columns, rows) for r in shape.rings_px) > 0.5
        odds = np.zeros(len(shape.kinds))
        across = 0.5 if camera is None else _across(shape.rings_px, camera)
        for k, name in enumerate(shape.kinds):
            if name in names and np.any(inside):
                odds[k] += kinds[names.index(name)][inside].mean()
            if camera is not None:
                odds[k] += _size_odds(name, shape.rings_px, camera) + _way_odds(name, across)
        share = np.exp(odds - odds.max())
        share /= share.sum()
        best = int(share.argmax())
        return replace(shape, kinds=(shape.kinds[best],) if share[best] >= _SURE else (ANY,))


def _toned(shape: Shape, light: np.ndarray) -> Shape:
    """The shape with what of it is bright, if it is a stripe or a line or holds many pieces.

    Other markings are labelled along their edges, and as if they were whole.
    """
    of_pieces = len(shape.kinds) > 1
    drawn_wide = (*SHIPPED.of_family(STRIPE, LINE), ANY)
    if not of_pieces and shape.kinds[0] not in drawn_wide:
        return shape
    return replace(shape, tone=tone_of(light, shape.rings_px, of_pieces))


def _across(rings_px: Sequence[FloatArray], camera: RoadCamera) -> float:
    """How far (0 to 1) a piece runs across the vehicle's way; 1/2 where that cannot be told."""
    ground = camera.ground(camera.undistort(np.concatenate(rings_px)))
    if not np.isfinite(ground).all():
        return 0.5
    _, axes = np.linalg.eigh(np.cov((ground - ground.mean(axis=0)).T))
    return float(axes[1, 1] ** 2)


def _way_odds(name: str, across: float) -> float:
    """Log likelihood of a class by how far a piece runs across the way: lanes along it, stop lines across."""
    if name in SHIPPED.lane_paint:
        return _ASKEW * across
    return _ASKEW * (1 - across) if name == STOP_LINE else 0.0


def _size_odds(name: str, rings_px: Sequence[FloatArray], camera: RoadCamera) -> float:
    """Log likelihood of a class by the size of the piece on the ground; 0 where it reaches the horizon."""
    entry = SHIPPED.classes.get(name)
    ground = camera.ground(camera.undistort(np.concatenate(rings_px)))
    if entry is None or not np.isfinite(ground).all():
        return 0.0
    _, sides, _ = cv2.minAreaRect(ground.astype(np.float32))
    info = camera.info
    points = np.concatenate(rings_px)
    edge = (points < 1.0).any() or (points > (info.width - 2.0, info.height - 2.0)).any()
    return float(entry.size_log_likelihood(max(sides), min(sides), whole=not edge))
