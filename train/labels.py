"""Users' own labelled images, to train from beside the renders."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from models.marking_net import MULTIPLE
from train.augment import random_crop, random_photometry
from train.config import DataConfig, LabelError
from train.label_hints import CELL_PX, with_hints
from train.labels_coco import UNKNOWN, read_coco
from train.labels_image import PAINT_ONLY, LabelledImage
from train.labels_raster import coverage
from train.labels_tone import Tone
from train.labels_tusimple import read_tusimple
from train.scenes.scenes import TrainingSample
from train.targets import IGNORE, Targets, targets
from v2hdm.catalogue import NOT_PAINT, PAINT_CLASSES
from v2hdm.errors import ConfigError, DriveError
from v2hdm.records import BoolArray, FloatArray
from v2hdm.safe.pixels import read_header
from v2hdm.safe.texts import shown

LEARNT = "learnt"
VALIDATION = "validation"
JUDGING = "judging"
"""The roles of labelled images."""

_BLOCK_PLACES = 10  # neighbouring photographs that have one role
_ROLES = (LEARNT, LEARNT, LEARNT, VALIDATION, LEARNT, JUDGING, LEARNT, LEARNT, JUDGING, LEARNT)

_ZOOM = (0.6, 1.5)
"""Labelled images are shown this much smaller to larger: one camera took them all, others are to be met."""

_LEAST_CORE = 0.35
"""Largest share of a piece's half width that is edge: thin pieces are paint in their middle all the same."""

_MOST_FAVOUR = 8.0  # times that an image with the rarest class is shown for one with the commonest, at most

_NEAR_A_LABEL = 0.75
"""How often a view is taken around something that is labelled; the rest is taken anywhere."""


Tell = Callable[[float, str], None]
"""Told the share of a piece of work that is done, and what is being done."""


def read_labels(
    config: DataConfig,
    classes: Sequence[str] = PAINT_CLASSES,
    tell: Tell = lambda share, doing: None,
    role: str = LEARNT,
) -> LabelledImages | None:
    """The labelled images of a ``role`` that a configuration names, checked; None if it names none.

    An image that is in both files has both kinds of labels. Markings are of the ``classes`` of the network.

    Raises:
        LabelError: a label file or an image is missing, damaged or does not fit.
        ConfigError: the share is no share.
    """
    chosen = labelled_images(config, classes, role)
    if config.coco_complete is not None or any(_is_open(image) for image in chosen):
        chosen = with_hints(
            chosen, config, lambda share: tell(share, "asking the shipped network about labels")
        )
    return LabelledImages(chosen, config, classes) if chosen else None


def labelled_images(
    config: DataConfig, classes: Sequence[str] = PAINT_CLASSES, role: str = LEARNT
) -> list[LabelledImage]:
    """The labelled images of a ``role`` as their files describe them, checked; what these leave open is open.

    Raises:
        LabelError: a label file or an image is missing, damaged or does not fit.
        ConfigError: the share is no share.
    """
    if config.coco is None and config.tusimple is None:
        return []
    if not 0 < config.labelled_share <= 1:
        raise ConfigError(
            f"data.labelled_share is {config.labelled_share}: set more than 0 and at most 1, "
            "or name no data.coco and no data.tusimple"
        )
    for name in config.coco_complete or ():
        if name not in classes:
            raise LabelError(f"data.coco_complete: no class {shown(name)}; choose from: {', '.join(classes)}")
    images: dict[Path, LabelledImage] = {}
    labelled: list[LabelledImage] = []
    if config.coco is not None:
        folder = _folder(config.coco, config.coco_images)
        labelled += read_coco(Path(config.coco), folder, config, classes)
    if config.tusimple is not None:
        labelled += read_tusimple(Path(config.tusimple), _folder(config.tusimple, config.tusimple_images))
    for image in labelled:
        key = image.path.resolve()
        images[key] = images[key].merged(image) if key in images else image
    for image in images.values():
        _check(image, config)
    chosen = list(images.values())
    if not config.coco_held_out:
        return chosen if role == LEARNT else []
    roles = held_out([image.path.stem for image in chosen])
    return [image for image, its in zip(chosen, roles, strict=True) if its == role]


def held_out(stems: Sequence[str]) -> list[str]:
    """The role of each image by its file name: learnt from, for validation, or kept for judging.

    Names that differ in trailing letters show the same place, neighbouring numbers the same road; so names
    are taken in order, in blocks of ten places, of each ten of which one is for validation and two are kept.
    """
    places = [stem.rstrip("abcdefghijklmnopqrstuvwxyz") or stem for stem in stems]
    order = {place: number for number, place in enumerate(sorted(set(places)))}
    return [_ROLES[order[place] // _BLOCK_PLACES % len(_ROLES)] for place in places]


def _is_open(image: LabelledImage) -> bool:
    """Whether some shape of an image may be of several classes."""
    return any(len(shape.kinds) > 1 for shape in image.shapes or ())


@dataclass(frozen=True)
class Favour:
    """How much oftener than others what is rare is shown: ``of_class``, and the share ``of_images`` (N,)."""

    of_class: Mapping[tuple[str, ...], float]
    of_images: FloatArray

    @classmethod
    def of(cls, images: Sequence[LabelledImage], balance: float) -> Favour:
        """The favour of images whose classes are balanced so much, 0 to 1."""
        classes = [{shape.kinds for shape in image.shapes or ()} for image in images]
        count = Counter(kinds for of_image in classes for kinds in of_image)
        most = max(count.values(), default=1)
        of_class = {kinds: min((most / number) ** balance, _MOST_FAVOUR) for kinds, number in count.items()}
        weight = np.array([max((of_class[kinds] for kinds in of_image), default=1.0) for of_image in classes])
        return cls(of_class, weight / weight.sum())

    def of_points(self, image: LabelledImage) -> FloatArray:
        """The share (N,) of each of the image's labelled points."""
        weight = [self.of_class[shape.kinds] for shape in image.shapes or () for _ in shape.rings_px]
        weight += [1.0] * (len(image.points_px) - len(weight))
        return np.array(weight) / sum(weight)


@dataclass(frozen=True)
class LabelledImages:
    """Labelled images (at least one), shown as crops like those of the renders, in other light each time."""

    images: Sequence[LabelledImage]
    config: DataConfig
    classes: Sequence[str] = PAINT_CLASSES

    @cached_property
    def favour(self) -> Favour:
        """How often each image is shown."""
        return Favour.of(self.images, self.config.coco_balance)

    def view(self, rng: np.random.Generator) -> tuple[torch.Tensor, Targets]:
        """A crop (height, width, 3) uint8 of some image, and the answers; the unknown carries no loss.

        Raises:
            DriveError: the image cannot be read.
        """
        image = self.images[int(rng.choice(len(self.images), p=self.favour.of_images))]
        sample = random_crop(rng, self._window(rng, image), self.config.width, self.config.height)
        answers = self._answers(image, sample)
        return torch.from_numpy(random_photometry(rng, sample.image)), answers

    def whole(self) -> Iterator[tuple[torch.Tensor, Targets]]:
        """Every image in full, cut to a multiple of the network's, and its answers.

        Raises:
            DriveError: an image cannot be read.
        """
        for image in self.images:
            pixels = image.pixels()
            height, width = (side // MULTIPLE * MULTIPLE for side in pixels.shape[:2])
            sample = self._part(image, pixels, (0, 0, width, height), 1.0)
            yield torch.from_numpy(sample.image), self._answers(image, sample)

    def _answers(self, image: LabelledImage, sample: TrainingSample) -> Targets:
        answers = targets(sample)
        if image.shapes is None:
            answers = answers._replace(
                paint=torch.full_like(answers.paint, IGNORE), kinds=torch.full_like(answers.kinds, IGNORE)
            )
        if image.lanes_px is None:
            answers = answers._replace(lane_there=torch.full_like(answers.lane_there, IGNORE))
        return answers

    def _window(self, rng: np.random.Generator, image: LabelledImage) -> TrainingSample:
        """A part of the image of a render's size, smaller or larger than it is, or all of it."""
        pixels = image.pixels()
        rows, columns = pixels.shape[:2]
        config = self.config
        least = max(config.width / columns, config.height / rows)
        zoom = max(float(np.exp(rng.uniform(*np.log(_ZOOM)))), least) if image.shown_size else 1.0
        width = min(columns, round(config.render_width / zoom))
        height = min(rows, round(config.render_height / zoom))
        corner = rng.integers(0, (columns - width + 1, rows - height + 1))
        points_px = image.points_px
        if len(points_px) and rng.random() < _NEAR_A_LABEL:
            centre = points_px[int(rng.choice(len(points_px), p=self.favour.of_points(image)))] + rng.normal(
                0, 0.15, 2
            ) * (width, height)
            corner = np.clip(centre - (width / 2, height / 2), 0, (columns - width, rows - height))
        left, top = (int(c) for c in corner)
        return self._part(image, pixels, (left, top, width, height), zoom)

    def _part(
        self, image: LabelledImage, pixels: np.ndarray, window: tuple[int, int, int, int], zoom: float
    ) -> TrainingSample:
        """A window (left, top, width, height) of an image, ``zoom`` times as large."""
        left, top, width, height = window
        part = np.ascontiguousarray(pixels[top : top + height, left : left + width])
        if zoom != 1.0:
            size = max(round(width * zoom), self.config.width), max(round(height * zoom), self.config.height)
            way = cv2.INTER_AREA if zoom < 1 else cv2.INTER_LINEAR
            part = np.asarray(cv2.resize(part, size, interpolation=way), dtype=np.uint8)
        rows, columns = part.shape[:2]
        scale = np.array([columns / width, rows / height])
        place = Place(np.array([left, top]), scale, columns, rows)
        labels, unknown = paint_labels(image, place, self.classes)
        hidden = np.zeros((rows, columns), dtype=np.bool_)
        lanes_px = tuple(place.moved(lane) for lane in image.lanes_px or ())
        return TrainingSample(part, labels, hidden, lanes_px, unknown)


@dataclass(frozen=True)
class Place:
    """A window of an image: its first pixel ``corner_px`` (2,), its ``scale`` (2,) and its size, px."""

    corner_px: NDArray[np.int_]
    scale: FloatArray
    width: int
    height: int

    @classmethod
    def whole(cls, width: int, height: int) -> Place:
        """All of an image."""
        return cls(np.zeros(2, dtype=np.int_), np.ones(2), width, height)

    def moved(self, points_px: FloatArray) -> FloatArray:
        """Points (N, 2) of the image in the window."""
        return (points_px + 0.5 - self.corner_px) * self.scale - 0.5

    def sampled(self, cells: np.ndarray) -> BoolArray:
        """The values of a plane of cells of 4 px of the image at the window's pixels (height, width)."""
        u = (np.arange(self.width) + 0.5) / self.scale[0] + self.corner_px[0]
        v = (np.arange(self.height) + 0.5) / self.scale[1] + self.corner_px[1]
        column = np.minimum((u / CELL_PX).astype(np.intp), cells.shape[1] - 1)
        row = np.minimum((v / CELL_PX).astype(np.intp), cells.shape[0] - 1)
        return np.asarray(cells[row[:, None], column] > 0)

    def toned(self, tone: Tone) -> tuple[BoolArray, BoolArray]:
        """Masks (height, width) of the window's paint and of its ground, by the brightness of the image."""
        u = (
            np.floor((np.arange(self.width) + 0.5) / self.scale[0]).astype(np.intp)
            + self.corner_px[0]
            - tone.left
        )
        v = (
            np.floor((np.arange(self.height) + 0.5) / self.scale[1]).astype(np.intp)
            + self.corner_px[1]
            - tone.top
        )
        planes = tone.planes()
        rows, columns = planes[0].shape
        here = ((v >= 0) & (v < rows))[:, None] & ((u >= 0) & (u < columns))
        place = np.clip(v, 0, rows - 1)[:, None], np.clip(u, 0, columns - 1)
        bright, ground = (np.asarray(plane[place] & here) for plane in planes)
        return bright, ground


def paint_labels(
    image: LabelledImage, place: Place, classes: Sequence[str] = PAINT_CLASSES
) -> tuple[NDArray[np.uint8], BoolArray]:
    """Labels (height, width) of a window as the renderer makes them, and where they are unknown.

    A label is 1 + class where half of the pixel is covered, :data:`~train.labels_image.PAINT_ONLY` for paint
    of an unknown class, or 0.
    """
    size = place.height, place.width
    labels = np.zeros(size, dtype=np.uint8)
    unknown = np.zeros(size, dtype=np.bool_)
    paint = None
    if image.silence is not None:
        unknown |= place.sampled(image.silence.plane(image.silence.unknown))
        paint = place.sampled(image.silence.plane(image.silence.paint))
    band = image.edge_px * float(place.scale.mean())
    for shape in image.shapes or ():
        kinds = [kind for kind in shape.kinds if kind != NOT_PAINT]
        in_part = len(kinds) < len(shape.kinds)
        is_one_class = len(kinds) == 1 and kinds[0] in classes
        value = 1 + classes.index(kinds[0]) if is_one_class else PAINT_ONLY
        for ring_px in shape.rings_px:
            inside = coverage(place.moved(ring_px), 0, 0, place.width, place.height) > 0.5
            if not inside.any():
                continue
            if shape.tone is not None and kinds != [UNKNOWN]:
                bright, ground = place.toned(shape.tone)
                is_known = inside & (bright | (ground & (labels == 0)))
                unknown[inside & (labels == 0)] = True
                labels[inside & bright] = value
                unknown[is_known] = False
                continue
            if in_part or kinds == [UNKNOWN]:
                unknown |= inside
                labels[inside if paint is None else inside & paint] = 0 if kinds == [UNKNOWN] else value
                continue
            labels[inside] = value
            unknown[inside] = False
            if band > 0:
                unknown |= _edge(inside, band)
    return labels, unknown


def _edge(inside: BoolArray, band_px: float) -> BoolArray:
    """Pixels nearer than a band to the outline of a piece, of which at least its middle is left."""
    within = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 3)
    beyond = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 3)
    inner = min(band_px, _LEAST_CORE * float(within.max()))
    return np.asarray(np.where(inside, within <= inner, beyond <= band_px))


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
    size = image.shown_size or size
    if size[0] < config.width or size[1] < config.height:
        raise LabelError(
            f"{image.where}: {image.path} is {size[0]}x{size[1]}, smaller than a view of "
            f"{config.width}x{config.height}; leave it out or set a smaller data.width and data.height"
        )
