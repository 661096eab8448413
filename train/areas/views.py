"""Labelled photographs and renders, as views whose cells are marked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from models.marking_net import KIND_STRIDE, MULTIPLE, PAINT_STRIDE
from train.areas.cells import BARE, OPEN, OTHER, Marks, View
from train.augment import random_photometry
from train.labels import Place
from train.labels_coco import UNKNOWN
from train.labels_image import ANY, LabelledImage, Shape
from train.labels_raster import coverage
from train.targets import IGNORE, Targets
from v2hdm.catalogue import NOT_PAINT
from v2hdm.records import BoolArray

# Scales at which a photograph is shown, chosen: as far as other cameras see the same paint.
_SMALLER = (0.6, 0.85)  # least and largest scale of a smaller view
_LARGER = (1.15, 1.6)  # least and largest scale of a larger view
_ABOUT_AS_LARGE = (0.7, 1.3)  # least and largest scale of a view of about the same size

_SHOWN_TWICE = 0.3
"""Share of the photographs without any of the classes that are shown a second time. Chosen, for time."""

# Neighbourhoods of cells beside an outline that may hold its paint, chosen: outlines are drawn by hand.
_OPEN_BORDER = np.ones((5, 5), np.uint8)  # for outlines of the fitted classes, and open ones
_OTHER_BORDER = np.ones((3, 3), np.uint8)  # for outlines of other classes


class Change(NamedTuple):
    """How a photograph is shown: ``zoom`` times as large, mirrored, in other light."""

    zoom: float
    is_mirrored: bool
    is_relit: bool


def changes(rng: np.random.Generator, shows_class: bool) -> Iterator[Change]:
    """The ways in which one photograph is shown: four if it shows a class that is fitted, else one or two."""
    yield Change(1.0, is_mirrored=False, is_relit=False)
    if shows_class:
        yield Change(1.0, is_mirrored=True, is_relit=True)
        for zooms in (_SMALLER, _LARGER):
            yield Change(rng.uniform(*zooms), is_mirrored=rng.random() < 0.5, is_relit=True)
    elif rng.random() < _SHOWN_TWICE:
        yield Change(rng.uniform(*_ABOUT_AS_LARGE), is_mirrored=True, is_relit=True)


def views_of_photograph(
    image: LabelledImage, classes: Sequence[str], sky: float, rng: np.random.Generator
) -> Iterator[View]:
    """Views of a labelled photograph below its ``sky``, a share of its height.

    Raises:
        DriveError: The image cannot be read.
    """
    pixels = image.pixels()
    top = min(round(sky * len(pixels)), len(pixels) - MULTIPLE)
    ground = pixels[top:]
    shows_class = any(name in classes for shape in image.shapes or () for name in shape.kinds)
    for change in changes(rng, shows_class):
        height, width = (max(round(side * change.zoom / MULTIPLE), 1) * MULTIPLE for side in ground.shape[:2])
        way = cv2.INTER_AREA if change.zoom < 1 else cv2.INTER_LINEAR
        resized = np.asarray(cv2.resize(ground, (width, height), interpolation=way), dtype=np.uint8)
        scale = np.array([width, height]) / ground.shape[1::-1] / KIND_STRIDE
        place = Place(np.array([0, top]), scale, width // KIND_STRIDE, height // KIND_STRIDE)
        view = View(resized, marks_of_shapes(image.shapes or (), place, classes))
        yield _changed(view, change, rng)


def _changed(view: View, change: Change, rng: np.random.Generator) -> View:
    image, marks = view
    if change.is_mirrored:
        image = np.ascontiguousarray(image[:, ::-1])
        marks = np.ascontiguousarray(marks[:, ::-1])
    if change.is_relit:
        image = random_photometry(rng, image)
    return View(image, marks)


def marks_of_shapes(shapes: Sequence[Shape], place: Place, classes: Sequence[str]) -> Marks:
    """The marks (height, width) of a place's cells by labelled shapes; fitted classes lie over others."""
    marks = np.full((place.height, place.width), BARE, dtype=np.int8)
    meanings = [(_meaning(shape, classes), shape) for shape in shapes]
    for meaning, shape in sorted(meanings, key=lambda pair: pair[0] >= 0):
        for ring_px in shape.rings_px:
            inside = coverage(place.moved(ring_px), 0, 0, place.width, place.height) > 0.5
            _draw(marks, inside, meaning)
    return marks


def _meaning(shape: Shape, classes: Sequence[str]) -> int:
    """The mark of paint within a shape."""
    names = set(shape.kinds) - {NOT_PAINT}
    if len(names) == 1 and names <= set(classes):
        return classes.index(names.pop())
    return OPEN if not names or names & {*classes, UNKNOWN, ANY} else OTHER


def _draw(marks: Marks, inside: BoolArray, meaning: int) -> None:
    """Mark the cells inside of an outline, and those beside it as far as they have no mark."""
    border = _OTHER_BORDER if meaning == OTHER else _OPEN_BORDER
    is_near = cv2.dilate(inside.astype(np.uint8), border) > 0
    marks[is_near & (marks == BARE)] = OTHER if meaning == OTHER else OPEN
    if meaning != OTHER:
        marks[inside] = meaning


def marks_of_targets(answers: Targets, places: Sequence[int]) -> Marks:
    """The marks (H/4, W/4) of a render's cells by its answers; ``places`` are those of the fitted classes."""
    kinds: NDArray[np.uint8] = answers.kinds.numpy()
    rows, columns = kinds.shape
    span = KIND_STRIDE // PAINT_STRIDE
    has_paint = answers.paint.numpy().reshape(rows, span, columns, span).any(axis=(1, 3))
    marks = np.where(kinds == IGNORE, np.where(has_paint, OPEN, BARE), OTHER).astype(np.int8)
    for number, place in enumerate(places):
        marks[kinds == place] = number
    return marks
