"""From radiance to a recorded image: blur of lens and motion, exposure, noise, sRGB coding."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from v2hdm.simulate.render.textures import Float32
from v2hdm.simulate.render.view import View

_CODE_STEPS = 16384
_FLOW_STEP_PX = 16
_NOISE_SHIFT_PX = 256


@dataclass(frozen=True, kw_only=True)
class Optics:
    """Lens and sensor. Levels are fractions of the sensor's saturation.

    ``psf_sigma_px`` is the lens blur, ``vignetting`` the loss of light at the image corners, ``mean_level``
    what the automatic exposure aims at for the mean of the ground, ``full_well_electrons`` sets the shot
    noise, ``read_noise`` the noise in the dark. ``white_balance_bgr`` multiplies the channels.
    """

    psf_sigma_px: float = 0.65
    vignetting: float = 0.2
    mean_level: float = 0.24
    full_well_electrons: float = 9000.0
    read_noise: float = 0.0015
    white_balance_bgr: tuple[float, float, float] = (1.0, 1.0, 1.0)
    grey: bool = False


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The camera's motion during the exposure, in its own frame: m/s, rad/s, s.

    The image's time stamp and pose belong to the middle of the exposure.
    """

    velocity_cam: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angular_velocity_cam: tuple[float, float, float] = (0.0, 0.0, 0.0)
    exposure_s: float = 0.0


def expose(
    radiance: Float32, view: View, optics: Optics, motion: Motion, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The recorded image (H, W, 3) uint8 of a scene's radiance (H, W, 3)."""
    image = _motion_blur(radiance, view, motion)
    if optics.psf_sigma_px > 0:
        image = _float32(cv2.GaussianBlur(image, (0, 0), optics.psf_sigma_px))
    height, width = image.shape[:2]
    gain = optics.mean_level / max(float(image[height // 3 :: 4, ::4].mean()), 1e-6)
    balance = np.diag(gain * np.array(optics.white_balance_bgr)).astype(np.float32)
    image = _float32(cv2.multiply(cv2.transform(image, balance), _vignette(height, width, optics.vignetting)))
    if optics.grey:
        image = np.repeat(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)[..., None], 3, axis=2)
    image += _noise(image, optics, rng)
    image *= np.float32(_CODE_STEPS - 1)
    np.clip(image, 0, _CODE_STEPS - 1, out=image)
    return np.asarray(np.take(_srgb_codes(), image.astype(np.uint16)))


def _float32(array: NDArray[Any]) -> Float32:
    """OpenCV's result under the type it has."""
    return np.asarray(array, dtype=np.float32)


def _motion_blur(radiance: Float32, view: View, motion: Motion) -> Float32:
    """Mean of three images displaced along the image flow over the exposure, symmetric about its middle."""
    if motion.exposure_s <= 0:
        return radiance.copy()
    height, width = radiance.shape[:2]
    flow = _flow(view, motion) * np.float32(motion.exposure_s / 3.0)
    if float(np.abs(flow).max()) < 0.02:
        return radiance.copy()
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    out = radiance.copy()
    for sign in (-1.0, 1.0):
        out += cv2.remap(
            radiance, u + np.float32(sign) * flow[..., 0], v + np.float32(sign) * flow[..., 1],
            cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
    return np.asarray(out * np.float32(1.0 / 3.0))


def _flow(view: View, motion: Motion) -> Float32:
    """Image flow (H, W, 2) in px/s of ground and sky (Longuet-Higgins and Prazdny 1980), by coarse grid.

    Distortion is taken as locally constant; blur lengths of a few pixels do not see the difference.
    """
    rays = view.rays
    k = rays.info.intrinsic
    step = _FLOW_STEP_PX
    x = (rays.u_pinhole_px[::step, ::step] - k[0, 2]) / k[0, 0]
    y = (rays.v_pinhole_px[::step, ::step] - k[1, 2]) / k[1, 1]
    up_cam = view.cam_from_map[:3, 2]
    inverse_depth = np.maximum(-(up_cam[0] * x + up_cam[1] * y + up_cam[2]) / view.centre_map[2], 0.0)
    vx, vy, vz = motion.velocity_cam
    wx, wy, wz = motion.angular_velocity_cam
    flow_x = (x * vz - vx) * inverse_depth + x * y * wx - (1 + x * x) * wy + y * wz
    flow_y = (y * vz - vy) * inverse_depth + (1 + y * y) * wx - x * y * wy - x * wz
    coarse = np.stack([flow_x * k[0, 0], flow_y * k[1, 1]], axis=-1).astype(np.float32)
    height, width = rays.u_pinhole_px.shape
    rows, columns = coarse.shape[:2]
    full = cv2.resize(coarse, (columns * step, rows * step), interpolation=cv2.INTER_LINEAR)
    return np.asarray(full[:height, :width])


def _noise(image: Float32, optics: Optics, rng: np.random.Generator) -> Float32:
    """Shot and read noise of an image: a window of a fixed field of normal numbers, placed at random."""
    height, width = image.shape[:2]
    row, column = (int(n) for n in rng.integers(0, _NOISE_SHIFT_PX, 2))
    field = _normal_field(height + _NOISE_SHIFT_PX, width + _NOISE_SHIFT_PX)
    variance = np.maximum(image, 0)
    variance *= np.float32(1.0 / optics.full_well_electrons)
    variance += np.float32(optics.read_noise**2)
    return np.asarray(cv2.multiply(cv2.sqrt(variance), field[row : row + height, column : column + width]))


@lru_cache(maxsize=4)
def _normal_field(height: int, width: int) -> Float32:
    return np.random.default_rng(20).standard_normal((height, width, 3), dtype=np.float32)


@lru_cache(maxsize=4)
def _vignette(height: int, width: int, loss: float) -> Float32:
    v, u = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    falloff = (1.0 - loss * 0.5 * (u * u + v * v)).astype(np.float32)
    return np.ascontiguousarray(np.repeat(falloff[..., None], 3, axis=2))


@cache
def _srgb_codes() -> NDArray[np.uint8]:
    """The 8-bit sRGB code (IEC 61966-2-1) of each step of linear level."""
    level = np.linspace(0.0, 1.0, _CODE_STEPS)
    coded = np.where(level <= 0.0031308, 12.92 * level, 1.055 * level ** (1 / 2.4) - 0.055)
    return np.asarray(np.round(coded * 255), dtype=np.uint8)
