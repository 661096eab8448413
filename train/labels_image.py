"""The labels of one image, independent of their file format."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from v2hdm.records import FloatArray

_T = TypeVar("_T")


@dataclass(frozen=True)
class Shape:
    """One marking: its class and the polygons (N, 2) that make it up, recorded px."""

    kind: str
    rings_px: tuple[FloatArray, ...]


@dataclass(frozen=True)
class LabelledImage:
    """An image file and its labels; ``where`` names the entry of the label file, for errors.

    ``size`` is the width and height that the labels are for, where they say. ``shapes`` are all markings of
    the image, None where markings were not labelled; ``lanes_px`` are the lines (N, 2) of its lanes, near to
    far, None where lanes were not.
    """

    where: str
    path: Path
    size: tuple[int, int] | None = None
    shapes: tuple[Shape, ...] | None = None
    lanes_px: tuple[FloatArray, ...] | None = None

    def merged(self, other: LabelledImage) -> LabelledImage:
        """This image with the labels of another entry for it, too."""
        return replace(
            self,
            size=self.size or other.size,
            shapes=_joined(self.shapes, other.shapes),
            lanes_px=_joined(self.lanes_px, other.lanes_px),
        )

    def points_px(self) -> FloatArray:
        """Points (N, 2) of what is labelled: middles of the markings, points of the lanes."""
        middles = [ring.mean(axis=0)[None] for shape in self.shapes or () for ring in shape.rings_px]
        return np.concatenate([np.empty((0, 2)), *middles, *(self.lanes_px or ())])


def _joined(one: tuple[_T, ...] | None, other: tuple[_T, ...] | None) -> tuple[_T, ...] | None:
    if one is None or other is None:
        return one if other is None else other
    return one + other
