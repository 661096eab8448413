"""Headers and pixels of images as cameras write them: megabytes, with what matters anywhere in the file."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from v2hdm.errors import DriveError
from v2hdm.io.safe.pixels import read_header, read_pixels

FORMS = [".png", ".tiff", ".bmp", ".webp", ".jpg"]


@pytest.fixture(scope="module")
def noise() -> np.ndarray:
    """Pixels that no coder makes small."""
    return np.random.default_rng(1).integers(0, 256, (480, 640, 3), dtype=np.uint8)


@pytest.mark.parametrize("form", FORMS)
def test_a_large_image_has_the_size_that_its_header_says(
    form: str, noise: np.ndarray, tmp_path: Path
) -> None:
    path = tmp_path / f"image{form}"
    cv2.imwrite(str(path), noise)
    assert path.stat().st_size > 1 << 18
    header = read_header(path)
    assert (header.height, header.width) == noise.shape[:2] == read_pixels(path, cv2.IMREAD_COLOR).shape[:2]


def test_a_jpeg_whose_frame_stands_after_much_else_is_read(noise: np.ndarray, tmp_path: Path) -> None:
    data = cv2.imencode(".jpg", noise)[1].tobytes()
    colours = b"\xff\xe2" + (60_002).to_bytes(2, "big") + bytes(60_000)
    path = tmp_path / "image.jpg"
    path.write_bytes(data[:2] + 8 * colours + data[2:])
    assert read_header(path).width == 640


def test_a_large_png_with_a_flipped_bit_is_refused_before_it_is_worked_on(
    noise: np.ndarray, tmp_path: Path
) -> None:
    data = bytearray(cv2.imencode(".png", noise)[1].tobytes())
    data[len(data) // 2] ^= 1
    path = tmp_path / "image.png"
    path.write_bytes(data)
    with pytest.raises(DriveError, match="damaged"):
        read_pixels(path, cv2.IMREAD_COLOR)
