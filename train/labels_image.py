"""The labels of one image, independent of their file format."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from train.labels_tone import Tone
from v2hdm.detection.frames import read_bgr
from v2hdm.records import FloatArray

_T = TypeVar("_T")

PAINT_ONLY = 254
"""The label of a pixel that is paint of a class that nobody knows."""

ANY = ""
"""The class of a shape that is paint of a class that nobody knows."""


@dataclass(frozen=True)
class Shape:
    """One labelled piece: the classes that it may be of, and the polygons (N, 2) that make it up, px.

    Several classes are candidates of which one is true. With :data:`~v2hdm.catalogue.NOT_PAINT` among them,
    what lies within is in part paint of the other, such as the bars of a crosswalk; alone it is ground of
    which nothing is known. ``tone`` says which of it is brighter than the ground beside it.
    """

    kinds: tuple[str, ...]
    rings_px: tuple[FloatArray, ...]
    tone: Tone | None = None


@dataclass(frozen=True)
class Silence:
    """The gaps of a label set, as 1-bit planes of cells of 4 px: see :mod:`train.label_hints`.

    ``paint`` are the cells that the shipped network takes for paint, ``unknown`` those of them that may be
    paint that nobody labelled; both are packed rows of ``shape`` (h, w).
    """

    paint: np.ndarray
    unknown: np.ndarray
    shape: tuple[int, int]

    def plane(self, packed: np.ndarray) -> np.ndarray:
        """A packed plane as (h, w) uint8 of 0 and 1."""
        return np.unpackbits(packed, axis=1, count=self.shape[1])


@dataclass(frozen=True)
class LabelledImage:
    """An image file and its labels; ``where`` names the entry of the label file, for errors.

    ``size`` is the width and height that the labels are for, where they say, ``shown_size`` that at which the
    image is to be read where the file is squeezed. Shapes and lanes are of the image as it is shown.
    ``shapes`` are all markings of the image, None where markings were not labelled; ``lanes_px`` are the
    lines (N, 2) of its lanes, near to far, None where lanes were not. Within ``edge_px`` of an outline
    nothing is known. ``silence`` is given where not all paint is labelled.
    """

    where: str
    path: Path
    size: tuple[int, int] | None = None
    shapes: tuple[Shape, ...] | None = None
    lanes_px: tuple[FloatArray, ...] | None = None
    shown_size: tuple[int, int] | None = None
    edge_px: float = 0.0
    silence: Silence | None = None

    def merged(self, other: LabelledImage) -> LabelledImage:
        """This image with the labels of another entry for it, too."""
        return replace(
            self,
            size=self.size or other.size,
            shapes=_joined(self.shapes, other.shapes),
            lanes_px=_joined(self.lanes_px, other.lanes_px),
            shown_size=self.shown_size or other.shown_size,
            edge_px=max(self.edge_px, other.edge_px),
        )

    def pixels(self) -> np.ndarray:
        """The image (H, W, 3) uint8 BGR at the size at which it is shown; raises DriveError if unreadable."""
        image = read_bgr(self.path)
        if self.shown_size is None or image.shape[1::-1] == self.shown_size:
            return image
        return np.asarray(cv2.resize(image, self.shown_size, interpolation=cv2.INTER_CUBIC))

    @cached_property
    def points_px(self) -> FloatArray:
        """Points (N, 2) of what is labelled: middles of the markings, points of the lanes."""
        middles = [ring.mean(axis=0)[None] for shape in self.shapes or () for ring in shape.rings_px]
        return np.concatenate([np.empty((0, 2)), *middles, *(self.lanes_px or ())])


def _joined(first: tuple[_T, ...] | None, second: tuple[_T, ...] | None) -> tuple[_T, ...] | None:
    if first is None or second is None:
        return first if second is None else second
    return first + second
