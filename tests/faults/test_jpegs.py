"""JPEG files through the strict decoder: OpenCV's pixels, and no damage that libjpeg would only warn of."""

import cv2
import numpy as np
import pytest

from v2hdm.errors import DriveError
from v2hdm.safe.pixels import AS_STORED, read_pixels

RNG = np.random.default_rng(0)
PICTURE = cv2.resize(RNG.integers(0, 255, (30, 40, 3)).astype(np.uint8), (643, 481))
FLAGS = {
    "as stored": AS_STORED,
    "colour": cv2.IMREAD_COLOR,
    "grey": cv2.IMREAD_GRAYSCALE,
    "a quarter": cv2.IMREAD_REDUCED_GRAYSCALE_4,
    "unchanged": cv2.IMREAD_UNCHANGED,
}
KINDS = {
    "baseline": (),
    "progressive": (cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "restarts": (cv2.IMWRITE_JPEG_RST_INTERVAL, 7),
    "4:4:4": (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
    "4:2:2": (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422),
}


def jpeg(pixels, *options):
    return cv2.imencode(".jpg", pixels, options)[1].tobytes()


def turned(data, orientation):
    """With an EXIF block of nothing but the orientation."""
    tags = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0" + bytes([orientation, 0, 0, 0]) + bytes(4)
    block = b"Exif\0\0" + tags
    return data[:2] + b"\xff\xe1" + (len(block) + 2).to_bytes(2, "big") + block + data[2:]


@pytest.mark.parametrize("flags", FLAGS.values(), ids=FLAGS)
@pytest.mark.parametrize("kind", [*KINDS, "grey", "turned", "an unknown revision of JFIF"])
def test_a_jpeg_has_the_pixels_that_opencv_decodes(kind, flags, tmp_path):
    data = jpeg(PICTURE[..., 0] if kind == "grey" else PICTURE, *KINDS.get(kind, ()))
    data = turned(data, 6) if kind == "turned" else data
    data = data[:11] + b"\x02" + data[12:] if kind == "an unknown revision of JFIF" else data
    (tmp_path / "a.jpg").write_bytes(data)
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.jpg", flags), expected)


@pytest.mark.parametrize("flags", FLAGS.values(), ids=FLAGS)
def test_a_jpeg_with_random_bytes_in_its_middle_is_damaged_and_nothing_is_printed(flags, tmp_path, capfd):
    rng = np.random.default_rng(2)
    whole = jpeg(rng.integers(0, 255, (240, 320, 3), dtype=np.uint8))
    for begin in rng.integers(len(whole) // 4, 3 * len(whole) // 4, 40):
        data = bytearray(whole)
        data[begin : begin + 400] = rng.integers(0, 255, 400, dtype=np.uint8).tobytes()
        (tmp_path / "a.jpg").write_bytes(data)
        with pytest.raises(DriveError, match="the image is damaged"):
            read_pixels(tmp_path / "a.jpg", flags)
    assert capfd.readouterr().err == ""
