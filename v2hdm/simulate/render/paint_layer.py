"""Paint on the ground: exact anti-aliased shapes, worn and dirty, and their class labels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from v2hdm.simulate.render.ground_layer import MEDIUM_TILE, GroundField, fine_tile
from v2hdm.simulate.render.scene import Paint
from v2hdm.simulate.render.textures import Float32, Tile, fade, noise_tile, sample
from v2hdm.simulate.render.view import View, coverage, in_view, outline, windows

Labels = NDArray[np.uint8]

_WEAR_TILE = noise_tile(16, 5.0, 0.8, finest_px=0.8)
_FARTHEST_M = 60.0


class PaintLayer:
    """All paint of a scene, with its vertices in one array so that what is out of view is cheaply skipped."""

    def __init__(self, paints: tuple[Paint, ...], classes: tuple[str, ...]) -> None:
        self._paints = paints
        self._label = {kind: label for label, kind in enumerate(classes, start=1)}
        most = max((len(p.polygon_map) for p in paints), default=3)
        self._vertices = np.zeros((len(paints), most, 3))
        for row, paint in zip(self._vertices, paints, strict=True):
            polygon = np.asarray(paint.polygon_map, dtype=np.float64)
            row[: len(polygon), :2] = polygon
            row[len(polygon) :, :2] = polygon[-1]

    def draw(self, view: View, field: GroundField, albedo: list[Float32], labels: Labels) -> None:
        """Paint onto the ground field's three planes of ``albedo`` (H', W) and into ``labels`` (H, W)."""
        homogeneous = view.homogeneous_px(self._vertices)
        for index in in_view(view, homogeneous, _FARTHEST_M):
            paint = self._paints[index]
            shape = outline(view, homogeneous[index, : len(paint.polygon_map)])
            if shape is None:
                continue
            label = self._label[paint.kind]
            for window in windows(view, shape, field.first_row):
                part = field.rows(window)
                covered = coverage(view, shape, window)
                if not covered.any():
                    continue
                labels[window][covered > 0.5] = label
                opacity, tone = _opacity(paint, covered, field, part)
                for plane, reflectance in zip(albedo, paint.albedo_bgr, strict=True):
                    below = plane[part]
                    below += opacity * (tone * np.float32(reflectance) - below)


def _opacity(
    paint: Paint, covered: Float32, field: GroundField, part: tuple[slice, slice]
) -> tuple[Float32, Float32]:
    """How much (h, w) of every pixel shows paint, and that paint's relative tone (h, w)."""
    x, y, footprint = field.x_m[part], field.y_m[part], field.footprint_m[part]
    shift = (float(paint.seed % 97) * 0.53, float(paint.seed % 89) * 0.71)
    flaking = _faded(_WEAR_TILE, x, y, footprint, shift)
    flaking += np.float32(0.7) * _faded(MEDIUM_TILE, x, y, footprint, shift)
    threshold = np.float32(_normal_quantile(paint.wear) * 1.22)
    softness = np.float32(0.35) + footprint * np.float32(12.0)
    kept = np.clip((flaking - threshold) / softness + np.float32(0.5), 0, 1)
    grain = fine_tile("asphalt")
    tone = np.float32(1.0) + np.float32(0.06) * _faded(grain, x, y, footprint, shift)
    dirt = np.float32(paint.dirt) * np.clip(np.float32(0.8) - np.float32(0.4) * flaking, 0, 1.6)
    return covered * kept * (np.float32(1.0) - np.float32(0.6) * dirt), tone * (
        np.float32(1.0) - np.float32(0.4) * dirt
    )


def _faded(tile: Tile, x: Float32, y: Float32, footprint: Float32, shift: tuple[float, float]) -> Float32:
    return np.asarray(sample(tile, x, y, shift) * fade(tile, footprint))


def _normal_quantile(fraction: float) -> float:
    """The standard normal quantile by Tukey's lambda approximation (0.14), good to 0.01 within +-2.5."""
    p = min(max(fraction, 1e-3), 1 - 1e-3)
    return float((p**0.14 - (1 - p) ** 0.14) * 4.91)
