"""Rectified ground shows what its cells cover in the image, however many pixels that is."""

import cv2
import numpy as np

from tests.cameras import mounted
from v2hdm.ground.model import Mount
from v2hdm.ground.patches import Sheet, View, box_means
from v2hdm.records import CameraInfo

GREY = np.random.default_rng(3).integers(0, 256, (540, 960), dtype=np.uint8)
SHARP = CameraInfo(
    "front", 960, 540, np.array([[900.0, 0, 479.5], [0, 900.0, 269.5], [0, 0, 1]]), "plumb_bob", (0.0,) * 5
)


def test_a_box_of_one_pixel_interpolates_linearly():
    centres = np.random.default_rng(5).integers(32 * 5, 32 * 500, (20, 30, 2)) / 32
    u, v = np.moveaxis(centres.astype(np.float32), 2, 0)
    between = cv2.remap(GREY.astype(np.float32), u, v, cv2.INTER_LINEAR)
    np.testing.assert_allclose(box_means(GREY, centres, np.ones_like(centres)), between, atol=1e-3)


def test_a_box_is_the_mean_of_the_pixels_that_it_covers():
    middle = np.array([[[30.0, 40.0]]])
    extent = np.array([[[5.0, 3.0]]])
    np.testing.assert_allclose(box_means(GREY, middle, extent), GREY[39:42, 28:33].mean(), rtol=1e-6)


def test_a_box_over_the_border_is_the_mean_of_what_lies_inside():
    corner = np.zeros((1, 1, 2))
    extent = np.full((1, 1, 2), 3.0)
    np.testing.assert_allclose(box_means(GREY, corner, extent), GREY[:2, :2].mean(), rtol=1e-6)


def test_texture_finer_than_a_cell_averages_out_instead_of_becoming_another_texture():
    mount = Mount.at(SHARP, mounted(np.array([0.0, 0.0, 2.0]), 2.0))
    points_map = np.column_stack([np.linspace(6.0, 8.0, 20), np.linspace(-0.5, 0.5, 20)])
    sheet, _ = Sheet.around(points_map, np.eye(4), 2, 0.04)
    grey, in_view = sheet.resample(View(GREY, mount, np.eye(4)))
    assert in_view.all()
    pixels = (900 * 0.04 / 7) * max(900 * 2.0 * 0.04 / 7**2, 1.0)  # that a cell covers, 7 m away
    assert grey.std() < 1.4 * GREY.std() / np.sqrt(pixels)
