"""The kernels of the renderer against numpy, on planes whose sides are no multiple of a processor's step."""

import numpy as np
import pytest
from numba.core.errors import TypingError
from scipy.ndimage import map_coordinates

from v2hdm.simulate.render import kernels
from v2hdm.simulate.render.scene import noise_tile, sample, scale_of

FINE = noise_tile(11, 4.0, 0.6)
COARSE = noise_tile(13, 19.0, 1.0)


@pytest.fixture
def planes():
    """x and y, m, footprint, m, and a plane of noise, each (37, 61)."""
    rng = np.random.default_rng(8)
    return [rng.uniform(*bounds, (37, 61)).astype(np.float32) for bounds in ((-90, 90),) * 2 + ((0, 1),) * 2]


def test_the_tone_of_the_ground_is_the_faded_sum_of_its_textures(planes):
    x, y, footprint, large = planes
    scales = np.array([scale_of(FINE, (3.0, 5.0)), scale_of(COARSE, (3.0, 5.0))], dtype=np.float32)
    amplitudes = np.array([0.2, 0.1, 0.15], dtype=np.float32)
    tone = np.empty_like(x)
    kernels.ground_tone((FINE.padded, COARSE.padded), scales, amplitudes, large, (x, y, footprint), tone)

    expected = 1 + large * amplitudes[2]
    for tile, scale, amplitude in zip((FINE, COARSE), scales, amplitudes, strict=False):
        fade = 1 / (1 + (footprint * scale[3]) ** 2)
        expected += sample(tile, x, y, (3.0, 5.0)) * fade * amplitude
    assert np.allclose(tone, np.clip(expected, 0.25, 2.5), atol=1e-5)
    assert tone.std() > 0.05


def test_the_sky_fades_upwards_and_ends_at_the_skyline(planes):
    azimuth = planes[0] * np.float32(np.pi / 90)
    elevation = planes[3] - np.float32(0.4)
    horizon, zenith, wall = np.array([[0.9, 0.8, 0.7], [0.7, 0.5, 0.3], [0.2, 0.2, 0.2]], dtype=np.float32)
    skyline = np.array([[0.3, 1.0, 0.5], [0.6, 1.0, 1.4]], dtype=np.float32)
    scale = np.array(scale_of(COARSE, (0.0, 0.0)), dtype=np.float32)
    picture = np.empty((*azimuth.shape, 3), dtype=np.float32)
    numbers = [np.float32(value) for value in (3 / (2 * np.pi), 0.06, 0.001)]
    sky = np.stack([horizon, zenith - horizon, wall])
    kernels.draw_sky(azimuth, elevation, COARSE.padded, scale, sky, skyline, *numbers, picture)

    height = np.sqrt(np.clip(elevation * 2.2, 0, 1))[..., None]
    clouds = sample(COARSE, azimuth, elevation * np.float32(2))[..., None]
    above = (horizon + (zenith - horizon) * height) * (1 + 0.05 * clouds)
    block = np.floor((azimuth + np.pi) * 3 / (2 * np.pi)).astype(int) % 3
    covered = np.clip((skyline[0][block] * 0.06 - elevation) / 0.001 + 0.5, 0, 1)[..., None]
    expected = above + covered * (wall * skyline[1][block][..., None] - above)
    assert np.allclose(picture, expected, atol=1e-4)
    assert 0.1 < covered.mean() < 0.9


@pytest.mark.parametrize("reach_px", [0.4, 3.0, 90.0])
def test_a_moved_image_is_interpolated_within_itself_and_at_its_borders(reach_px):
    rng = np.random.default_rng(9)
    image = rng.uniform(0, 1, (37, 61, 3)).astype(np.float32)
    rows, columns = np.mgrid[:37, :61]
    flow = (reach_px * np.stack([np.sin(columns / 20), rows / 36], axis=-1)).astype(np.float32)
    mean = np.empty_like(image)
    moved = np.empty((4, 61), dtype=np.int32)
    kernels.blur_along(
        image.reshape(37, -1), flow.reshape(37, -1), np.float32(1), moved, mean.reshape(37, -1)
    )

    for channel in range(3):
        plane = image[..., channel]
        ahead, back = (
            map_coordinates(plane, [rows + step[..., 1], columns + step[..., 0]], order=1, mode="nearest")
            for step in (flow, -flow)
        )
        assert np.allclose(mean[..., channel], (plane + ahead + back) / 3, atol=1e-4)


def test_a_plane_that_is_no_block_of_memory_is_refused(planes):
    x, y, footprint, _ = planes
    tiles = (FINE.padded, COARSE.padded)
    scales = np.array([scale_of(FINE, (0.0, 0.0)), scale_of(COARSE, (0.0, 0.0))], dtype=np.float32)
    amplitudes = np.ones(3, dtype=np.float32)
    wider = np.ones((37, 70), dtype=np.float32)
    with pytest.raises(TypingError):
        kernels.ground_tone(tiles, scales, amplitudes, wider[:, :61], (x, y, footprint), np.empty_like(x))
