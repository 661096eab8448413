"""Endless textures: seamless tiles of noise, sampled in metres and faded out where they would alias.

A tile is band-limited, so a pixel that covers more ground than the tile's finest wavelength would
turn it into shimmer; its amplitude therefore fades with the pixel's footprint (frequency clamping,
Norton, Rockwood and Skolmoski 1982).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]

_TILE_PX = 512
_GROUNDS = Path(__file__).parent / "grounds"
GROUNDS = tuple(sorted(path.stem for path in _GROUNDS.glob("*.jpg")))
"""Photographs of asphalt and concrete that come with the renderer; see their README."""


@dataclass(frozen=True)
class Tile:
    """A seamless square texture of mean 0 and standard deviation 1, ``side_m`` wide on the ground."""

    values: Float32
    side_m: float

    @cached_property
    def padded(self) -> Float32:
        """The values with their first rows and columns repeated behind the last, for interpolation."""
        return np.pad(self.values, ((0, 2), (0, 2)), mode="wrap")


@cache
def noise_tile(seed: int, side_m: float, slope: float, finest_px: float = 2.0, skew: float = 0.0) -> Tile:
    """Noise of spectral amplitude 1 / frequency^slope, wavelengths from ``finest_px`` tile pixels upwards.

    ``skew`` > 0 gives bright specks on a dark ground, as of aggregate in asphalt.
    """
    rng = np.random.default_rng([seed, 77])
    frequency = np.hypot(np.fft.fftfreq(_TILE_PX)[:, None], np.fft.rfftfreq(_TILE_PX)[None])
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((_TILE_PX, _TILE_PX)))
    spectrum *= frequency**-slope * np.exp(-0.5 * (frequency * finest_px) ** 2)
    values = np.fft.irfft2(spectrum, s=(_TILE_PX, _TILE_PX))
    values /= values.std()
    if skew:
        values = np.exp(skew * values)
        values = (values - values.mean()) / values.std()
    return Tile(np.ascontiguousarray(values, dtype=np.float32), side_m)


@cache
def photo_tile(name: str, side_m: float) -> Tile:
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


def sample(tile: Tile, x_m: Float32, y_m: Float32, offset_m: tuple[float, float] = (0.0, 0.0)) -> Float32:
    """The tile's values at ground points (H, W), bilinear, repeated endlessly.

    Coordinates are wrapped here: OpenCV's own wrapping border is four times slower and saturates at 32767.
    """
    columns = _wrapped(x_m, tile.side_m, offset_m[0])
    rows = _wrapped(y_m, tile.side_m, offset_m[1])
    return np.asarray(cv2.remap(tile.padded, columns, rows, cv2.INTER_LINEAR), dtype=np.float32)


def _wrapped(metres: Float32, side_m: float, offset_m: float) -> Float32:
    turns = metres * np.float32(1.0 / side_m)
    turns += np.float32(offset_m / side_m)
    turns -= np.floor(turns)
    turns *= np.float32(_TILE_PX)
    return turns


def scale_of(tile: Tile, shift_m: tuple[float, float], finest_px: float = 4.0) -> list[float]:
    """A tile's turns a metre, turns at 0 across and along, and its finest waves a metre, for kernels."""
    per_wave = 1.0 / (finest_px * tile.side_m / tile.values.shape[0])
    return [1.0 / tile.side_m, shift_m[0] / tile.side_m, shift_m[1] / tile.side_m, per_wave]


def fade(tile: Tile, footprint_m: Float32, finest_px: float = 4.0) -> Float32:
    """Amplitude (H, W) left to a tile whose finest wavelength is ``finest_px`` tile pixels."""
    finest_m = finest_px * tile.side_m / tile.values.shape[0]
    return np.asarray(np.float32(1.0) / (np.float32(1.0) + (footprint_m * np.float32(1.0 / finest_m)) ** 2))


def smoothstep(values: Float32, low: float, high: float) -> Float32:
    """Cubic step from 0 at ``low`` to 1 at ``high``."""
    t = np.clip((values - np.float32(low)) * np.float32(1.0 / (high - low)), 0, 1)
    return np.asarray(t * t * (np.float32(3.0) - np.float32(2.0) * t))
