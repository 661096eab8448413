"""What the image shows along a line: paint, and whether the ground is the same on both sides of it.

A line is painted on ground that goes on beside it. A kerb, the edge of a pavement and the foot of a wall have
ground of another colour on their other side; joints and cracks run through one ground, but show no paint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.lanes.curves import Horizon, basis
from v2hdm.detection.lanes.points import Line, LinePoints
from v2hdm.detection.markings.foreground import Foreground
from v2hdm.records import BoolArray, FloatArray

LOOKS = ("paint_along", "colour_change")
"""Names of the columns of :meth:`Looks.along`, in order.

Mean log odds of paint along the line; by how much the colour of the ground
differs between its sides, as a log ratio of colours of one brightness.
"""

_UNKNOWN = (2.3, 0.002)
"""Of a line of which nothing is known: the median of true lines. Nothing speaks against it."""

_PLACES = 24
"""Along a line."""

_ON_M = np.linspace(-0.25, 0.25, 7)
"""Paint of a line, be it a double one, is within such a distance of where it is drawn."""

_BESIDE_M = np.linspace(0.25, 0.6, 5)
"""The ground beside its paint: nearer than what else is on the road."""

_LEAST_PX_PER_M = 6.0
"""Farther away its sides are not seen apart from it."""

_LEAST_PLACES = 3
_MOST_CHANGE = 0.05
"""Kerbs and verges differ by this and more; the verge beside the line of a road's edge does, too."""

_DARK = 8.0
"""Grey levels below this differ by noise."""


@dataclass(frozen=True)
class Looks:
    """An image at half its size (h, w, 3) uint8 BGR and what the network says of paint, each if known."""

    half_bgr: np.ndarray | None = None
    foreground: Foreground | None = None

    @classmethod
    def of(cls, image_bgr: np.ndarray, foreground: Foreground) -> Looks:
        """Those of an image (H, W, 3) uint8 BGR."""
        height, width = image_bgr.shape[:2]
        return cls(cv2.resize(image_bgr, (width // 2, height // 2), interpolation=cv2.INTER_AREA), foreground)

    def along(
        self, lines: Sequence[Line], points: LinePoints, view: CameraView, horizon: Horizon
    ) -> FloatArray:
        """The :data:`LOOKS` (N, 2) of N lines, where each is seen."""
        out = np.tile(_UNKNOWN, (len(lines), 1))
        if not lines or (self.half_bgr is None and self.foreground is None):
            return out
        ends = np.array(
            [[points.below[line.certain].min(), points.below[line.certain].max()] for line in lines]
        )
        below = ends[:, :1] + np.diff(ends) * np.linspace(0, 1, _PLACES)
        phi = basis(below.ravel()).reshape(len(lines), _PLACES, 3)
        along = np.einsum("npk,nk->np", phi, np.array([line.curve.parameters for line in lines]))
        offsets_m = np.concatenate([_ON_M, -_BESIDE_M, _BESIDE_M])
        px_per_m = horizon.px_per_m * below
        across = along[..., None] + px_per_m[..., None] * offsets_m
        pinhole = horizon.pinhole_px(across.ravel(), np.repeat(below.ravel(), len(offsets_m)))
        places_px = view.distort(pinhole).reshape(*across.shape, 2)
        if self.foreground is not None:
            out[:, 0] = self.foreground.odds_at(places_px[:, :, : len(_ON_M)]).max(axis=2).mean(axis=1)
        if self.half_bgr is not None:
            inside = np.asarray(view.inside(places_px, 0).all(axis=2), dtype=np.bool_)
            out[:, 1] = self._colour_change(places_px[:, :, len(_ON_M) :], inside, px_per_m)
        return out

    def _colour_change(self, places_px: FloatArray, inside: BoolArray, px_per_m: FloatArray) -> FloatArray:
        """How much (N,) the colours beside N lines differ, seen at places (N, P, 2 S, 2) left, then right."""
        assert self.half_bgr is not None
        u, v = np.moveaxis(places_px.reshape(len(places_px), -1, 2) / 2 - 0.25, -1, 0).astype(np.float32)
        bgr = cv2.remap(self.half_bgr, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        level = np.log(bgr.reshape(*places_px.shape[:-1], 3) + _DARK)
        left, right = np.split(level, 2, axis=2)
        change = right.mean(axis=2) - left.mean(axis=2)
        change -= change.mean(axis=2, keepdims=True)
        out = np.empty(len(change))
        for k, (each, seen, wide) in enumerate(zip(change, inside, px_per_m > _LEAST_PX_PER_M, strict=True)):
            use = seen & wide if (seen & wide).sum() >= _LEAST_PLACES else seen
            use = use if use.sum() >= _LEAST_PLACES else np.ones_like(use)
            out[k] = min(float(np.linalg.norm(np.median(each[use], axis=0))), _MOST_CHANGE)
        return out


UNKNOWN_LOOKS = Looks()
"""Those of lines of which no image is at hand."""
