"""Users' own labelled images, to train from beside the renders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from train.augment import random_crop, random_photometry
from train.config import DataConfig
from train.labels_coco import read_coco
from train.labels_image import LabelledImage, Shape
from train.labels_raster import coverage
from train.labels_tusimple import read_tusimple
from train.scenes.scenes import TrainingSample
from train.targets import IGNORE, Targets, targets
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.detection.frames import read_bgr
from v2hdm.errors import ConfigError, DriveError, LabelError
from v2hdm.io.safe.pixels import read_header

_NEAR_A_LABEL = 0.75
"""How often a view is taken around something that is labelled; the rest is taken anywhere."""


def read_labels(config: DataConfig, classes: Sequence[str] = PAINT_CLASSES) -> LabelledImages | None:
    """The labelled images that a configuration names, checked; None if it names none.

    An image that is in both files has both kinds of labels. Markings are of the ``classes`` of the network.

    Raises:
        LabelError: a label file or an image is missing, damaged or does not fit.
        ConfigError: the share is no share.
    """
    if config.coco is None and config.tusimple is None:
        return None
    if not 0 < config.labelled_share <= 1:
        raise ConfigError(
            f"data.labelled_share is {config.labelled_share}: set more than 0 and at most 1, "
            "or name no data.coco and no data.tusimple"
        )
    images: dict[Path, LabelledImage] = {}
    found: list[LabelledImage] = []
    if config.coco is not None:
        folder = _folder(config.coco, config.coco_images)
        found += read_coco(Path(config.coco), folder, config.coco_classes, classes)
    if config.tusimple is not None:
        found += read_tusimple(Path(config.tusimple), _folder(config.tusimple, config.tusimple_images))
    for image in found:
        key = image.path.resolve()
        images[key] = images[key].merged(image) if key in images else image
    for image in images.values():
        _check(image, config)
    return LabelledImages(list(images.values()), config, classes)


@dataclass(frozen=True)
class LabelledImages:
    """Labelled images (at least one), shown as crops like those of the renders, in other light each time."""

    images: Sequence[LabelledImage]
    config: DataConfig
    classes: Sequence[str] = PAINT_CLASSES

    def view(self, rng: np.random.Generator) -> tuple[torch.Tensor, Targets]:
        """A crop (height, width, 3) uint8 of some image, and the answers; the unknown carries no loss.

        Raises:
            DriveError: the image cannot be read.
        """
        image = self.images[int(rng.integers(len(self.images)))]
        sample = random_crop(rng, self._window(rng, image), self.config.width, self.config.height)
        answers = targets(sample)
        if image.shapes is None:
            answers = answers._replace(
                paint=torch.full_like(answers.paint, IGNORE), kinds=torch.full_like(answers.kinds, IGNORE)
            )
        if image.lanes_px is None:
            answers = answers._replace(lane_there=torch.full_like(answers.lane_there, IGNORE))
        return torch.from_numpy(random_photometry(rng, sample.image)), answers

    def _window(self, rng: np.random.Generator, image: LabelledImage) -> TrainingSample:
        """A part of the image of a render's size or, where it is smaller, all of it."""
        pixels = read_bgr(image.path)
        rows, columns = pixels.shape[:2]
        width, height = min(columns, self.config.render_width), min(rows, self.config.render_height)
        corner = rng.integers(0, (columns - width + 1, rows - height + 1))
        points_px = image.points_px()
        if len(points_px) and rng.random() < _NEAR_A_LABEL:
            centre = points_px[int(rng.integers(len(points_px)))] + rng.normal(0, 0.15, 2) * (width, height)
            corner = np.clip(centre - (width / 2, height / 2), 0, (columns - width, rows - height))
        left, top = (int(c) for c in corner)
        part = np.ascontiguousarray(pixels[top : top + height, left : left + width])
        labels = paint_labels(image.shapes or (), left, top, width, height, self.classes)
        hidden = np.zeros((height, width), dtype=np.bool_)
        lanes_px = tuple(lane - (left, top) for lane in image.lanes_px or ())
        return TrainingSample(part, labels, hidden, lanes_px)


def paint_labels(
    shapes: Sequence[Shape],
    left: int,
    top: int,
    width: int,
    height: int,
    classes: Sequence[str] = PAINT_CLASSES,
) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    """Labels (height, width) of a window as the renderer makes them: 1 + class if half covered, or 0."""
    labels = np.zeros((height, width), dtype=np.uint8)
    for shape in shapes:
        value = 1 + classes.index(shape.kind)
        for ring_px in shape.rings_px:
            labels[coverage(ring_px, left, top, width, height) > 0.5] = value
    return labels


def _folder(labels: str, images: str | None) -> Path:
    return Path(labels).parent if images is None else Path(images)


def _check(image: LabelledImage, config: DataConfig) -> None:
    """Refuse what would stop a training in its midst."""
    try:
        header = read_header(image.path)
    except DriveError as error:
        raise LabelError(f"{image.where}: {error}") from error
    turned = header.orientation >= 5  # by a quarter: decoded as it is shown, which is how it was labelled
    size = (header.height, header.width) if turned else (header.width, header.height)
    if image.size is not None and image.size != size:
        raise LabelError(
            f"{image.where}: {image.path} is {size[0]}x{size[1]} but its labels are for "
            f"{image.size[0]}x{image.size[1]}; give the images that were labelled"
        )
    if size[0] < config.width or size[1] < config.height:
        raise LabelError(
            f"{image.where}: {image.path} is {size[0]}x{size[1]}, smaller than a view of "
            f"{config.width}x{config.height}; leave it out or set a smaller data.width and data.height"
        )
