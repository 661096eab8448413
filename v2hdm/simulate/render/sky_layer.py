"""What lies beyond the ground: a sky gradient and a skyline of blocks, looked up by direction."""

from __future__ import annotations

from functools import cache

import numpy as np

from v2hdm.simulate.render.scene import Backdrop, Light
from v2hdm.simulate.render.textures import Float32, noise_tile, sample
from v2hdm.simulate.render.view import View

_CLOUD_TILE = noise_tile(18, 3.0, 1.5)


@cache
def _skyline(seed: int, blocks: int) -> Float32:
    """Heights relative to the tallest, and tones, (2, blocks) of the blocks around the horizon."""
    rng = np.random.default_rng([seed, 41])
    heights = rng.choice([0.15, 0.3, 0.5, 0.7, 1.0], blocks) * rng.uniform(0.85, 1.0, blocks)
    return np.stack([heights, rng.uniform(0.5, 1.6, blocks)]).astype(np.float32)


def draw_background(view: View, light: Light, backdrop: Backdrop, last_row: int) -> Float32:
    """Radiance (last_row, W, 3) of sky and skyline for the image rows above ``last_row``."""
    rotation = (view.cam_from_map[:3, :3].T @ np.linalg.inv(view.rays.info.intrinsic)).astype(np.float32)
    u, v = view.rays.u_pinhole_px[:last_row], view.rays.v_pinhole_px[:last_row]
    x, y, z = (row[0] * u + row[1] * v + row[2] for row in rotation)
    level = np.hypot(x, y)
    elevation = np.arctan2(z, level)
    azimuth = np.arctan2(y, x)
    height = np.clip(elevation * np.float32(2.2), 0, 1)[..., None]
    clouds = sample(_CLOUD_TILE, azimuth, elevation * 2)[..., None]
    horizon, zenith = (np.array(c, dtype=np.float32) for c in (light.horizon_bgr, light.zenith_bgr))
    out = horizon + (zenith - horizon) * np.sqrt(height)
    out *= np.float32(1.0) + np.float32(0.05) * clouds
    blocks = max(int(2 * np.pi / backdrop.block_rad), 8)
    skyline = _skyline(backdrop.seed, blocks)
    index = (
        np.floor((azimuth + np.float32(np.pi)) * np.float32(blocks / (2 * np.pi))).astype(np.int32) % blocks
    )
    pixel_rad = 1.0 / view.rays.info.intrinsic[0, 0]
    covered = np.clip(
        (skyline[0][index] * np.float32(backdrop.height_rad) - elevation) / np.float32(pixel_rad) + 0.5, 0, 1
    )
    wall = np.array(backdrop.albedo_bgr, dtype=np.float32) * skyline[1][index][..., None]
    return np.asarray(out + covered[..., None] * (wall - out), dtype=np.float32)
