"""Light and weather that photographs have: rain, low sun, dusk, shade of leaves; and photographed grounds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from train.scenes.windscreen import LOW_SUN_SINE, RAINED_FRACTION, is_dusk
from v2hdm.records import FloatArray
from v2hdm.simulate.render.ground import GroundField, inward_lines, on_ground_px, texture_shift
from v2hdm.simulate.render.renderer import Optics
from v2hdm.simulate.render.scene import Float32, Ground, Light, Tile, noise_tile, sample, smoothstep
from v2hdm.simulate.render.view import View, bands_of, outlines

_TILE_PX = 512  # side of a tile of a photographed ground, elements
_GROUNDS = Path(__file__).parent / "grounds"
GROUNDS = tuple(sorted(path.stem for path in _GROUNDS.glob("*.jpg")))
"""Photographs of asphalt and concrete that come with the training; see their README."""

_FLECK_SIZES_M = tuple(float(s) for s in np.geomspace(0.12, 2.5, 10)[:6])
"""Sizes, m, of gaps in near leaves, from the sizes that the renderer keeps tiles for."""


@dataclass(frozen=True, kw_only=True)
class Dapple:
    """The broken shade of foliage: ``shaded`` fraction of the ground, flecks of about ``scale_m``.

    ``region_map`` (N, 2) bounds it to a convex polygon; None means everywhere. It is a shade of a scene.
    """

    shaded: float = 0.6
    scale_m: float = 1.0
    transmission: float = 0.1
    region_map: FloatArray | None = None
    seed: int = 0

    def __call__(self, view: View, field: GroundField, out: Float32) -> None:
        """Lower the sun's visibility ``out`` (H, W)."""
        tile = noise_tile(15, 40.0 * self.scale_m, 1.1, finest_px=3.0)
        level = float(np.quantile(tile.values[::8, ::8], self.shaded))
        parts = [(slice(None), slice(None))]
        if self.region_map is not None:
            shape = outlines(view, [on_ground_px(view, self.region_map)])
            windows = [] if shape is None else bands_of(view, shape, field.first_row).windows.tolist()
            first = field.first_row
            parts = [
                (slice(top - first, end - first), slice(left, right)) for top, end, left, right in windows
            ]
        for part in parts:
            x = field.x_m[part]
            y = field.y_m[part]
            footprint = field.footprint_m[part]
            lit = smoothstep(sample(tile, x, y, texture_shift(self.seed)), level - 0.12, level + 0.12)
            amplitude = _fade(tile, footprint, 8.0)
            lit = lit * amplitude + (np.float32(1.0) - amplitude) * np.float32(1.0 - self.shaded)
            dark = (np.float32(1.0) - lit) * np.float32(1.0 - self.transmission)
            if self.region_map is not None:
                lines = inward_lines(np.asarray(self.region_map, dtype=np.float64))
                least = np.min([x * a + y * b - d for a, b, d in lines], axis=0)
                dark *= np.clip(least * np.float32(2.0) + np.float32(0.5), 0, 1)
            out[part] *= np.float32(1.0) - dark


def _fade(tile: Tile, footprint_m: Float32, finest_px: float) -> Float32:
    """Amplitude (H, W) left to a tile whose finest wavelength is ``finest_px`` tile pixels."""
    finest_m = finest_px * tile.side_m / tile.values.shape[0]
    return np.asarray(np.float32(1.0) / (np.float32(1.0) + (footprint_m * np.float32(1.0 / finest_m)) ** 2))


@cache
def photo_tile(name: str, side_m: float = 3.0) -> Tile:
    """A photographed surface, mirrored to be seamless: of :data:`GROUNDS`, or scikit-image's.

    The latter are ``gravel``, ``grass`` and ``brick``.
    """
    if name in GROUNDS:
        whole = np.asarray(cv2.imread(str(_GROUNDS / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    else:
        import skimage.data

        whole = getattr(skimage.data, name)()
    photo = cv2.resize(whole, (_TILE_PX // 2, _TILE_PX // 2), interpolation=cv2.INTER_AREA)
    values = photo.astype(np.float32)
    values = (values - values.mean()) / values.std()
    mirrored = np.vstack([np.hstack([values, values[:, ::-1]]), np.hstack([values, values[:, ::-1]])[::-1]])
    return Tile(np.ascontiguousarray(mirrored), side_m)


def rain(rng: np.random.Generator, ground: Ground, light: Light, share: float) -> tuple[Ground, Light]:
    """These, or in a ``share`` of cases a dark ground, wet all over, under an overcast, bright sky."""
    if rng.random() >= share:
        return ground, light
    dark = rng.uniform(0.5, 1.0)
    blue, green, red = (float(dark * c) for c in ground.albedo_bgr)
    wet = replace(
        ground, albedo_bgr=(blue, green, red), wet_fraction=float(rng.uniform(RAINED_FRACTION, 0.99))
    )
    grey = rng.uniform(0.25, 0.6)
    bright = rng.uniform(0.7, 1.8)
    tint = np.exp(rng.normal(0, 0.06, 3))
    sky = _bgr(grey * tint)
    return wet, replace(
        light, sun_bgr=_bgr(rng.uniform(0.01, 0.15) * tint), sky_bgr=sky, horizon_bgr=_bgr(bright * tint),
        zenith_bgr=_bgr(0.7 * bright * tint),
    )  # fmt: skip


def low_sun(rng: np.random.Generator, light: Light, share: float) -> Light:
    """This light, or in a ``share`` of cases a warm sun at 3 to 11 degrees, half of the time ahead."""
    if rng.random() >= share:
        return light
    sine = rng.uniform(0.05, 0.95 * LOW_SUN_SINE)
    azimuth = rng.normal(0, 0.35) if rng.random() < 0.5 else rng.uniform(0, 2 * np.pi)
    level = np.sqrt(1 - sine**2)
    warm = rng.uniform(0.05, 0.35)
    sun = rng.uniform(0.8, 2.5) * np.array([1 - warm, 1.0, 1 + warm])
    direction = float(level * np.cos(azimuth)), float(level * np.sin(azimuth)), float(sine)
    return replace(
        light, sun_direction_map=direction,
        sun_bgr=_bgr(sun), sky_bgr=_bgr(np.array(light.sky_bgr) * rng.uniform(0.3, 0.9)),
    )  # fmt: skip


def dusk(rng: np.random.Generator, light: Light, share: float) -> Light:
    """This light, or in a ``share`` of cases none but that of a bluish or reddish sky after sunset."""
    if rng.random() >= share:
        return light
    sky = rng.uniform(0.05, 0.3)
    red = rng.uniform(-0.2, 0.5)
    return replace(
        light, sun_bgr=(0.0, 0.0, 0.0), sky_bgr=_bgr(sky * np.array([1.3, 1.0, 0.85])),
        zenith_bgr=_bgr(sky * rng.uniform(0.3, 1.0) * np.array([1.5, 0.9, 0.7])),
        horizon_bgr=_bgr(sky * rng.uniform(0.5, 3.0) * np.array([1 - red, 1.0, 1 + red])),
    )  # fmt: skip


def in_the_dark(rng: np.random.Generator, optics: Optics, light: Light) -> Optics:
    """These optics, or at dusk those of a sensor at a high gain: darker, blurred and noisy."""
    if not is_dusk(light):
        return optics
    return replace(
        optics, mean_level=float(optics.mean_level * rng.uniform(0.3, 1.0)),
        full_well_electrons=float(optics.full_well_electrons * rng.uniform(0.15, 0.8)),
        read_noise=float(optics.read_noise * rng.uniform(1, 3)),
    )  # fmt: skip


def sun_flecks(rng: np.random.Generator, share: float) -> tuple[Dapple, ...]:
    """In a ``share`` of cases a deep shade over all the ground that few spots of sun break."""
    if rng.random() >= share:
        return ()
    return (
        Dapple(
            shaded=float(rng.uniform(0.85, 0.99)),
            scale_m=float(rng.choice(_FLECK_SIZES_M)),
            transmission=float(rng.uniform(0.0, 0.1)),
            seed=int(rng.integers(1 << 20)),
        ),
    )


def photographed(rng: np.random.Generator, ground: Ground, share: float) -> Ground:
    """This ground, or in a ``share`` of cases, if it is asphalt or concrete, with a photographed grain."""
    if rng.random() >= share or ground.texture not in ("asphalt", "concrete"):
        return ground
    return replace(
        ground, texture=photo_tile(str(rng.choice(GROUNDS))), contrast=float(rng.uniform(0.03, 0.2))
    )


def _bgr(colour: np.ndarray) -> tuple[float, float, float]:
    blue, green, red = (float(c) for c in colour)
    return blue, green, red
