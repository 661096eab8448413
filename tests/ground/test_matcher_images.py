"""The ground is matched in what images show, whatever file they come in."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from v2hdm.ground.patches import read_grey


def test_the_grey_of_an_image_is_the_same_from_a_jpeg_and_from_its_pixels_as_png(tmp_path: Path) -> None:
    colours = np.random.default_rng(2).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    jpeg, png = tmp_path / "a.jpg", tmp_path / "a.png"
    cv2.imwrite(str(jpeg), cv2.resize(colours, (320, 240)))
    cv2.imwrite(str(png), cv2.imread(str(jpeg)))
    np.testing.assert_array_equal(read_grey(str(jpeg)), read_grey(str(png)))
