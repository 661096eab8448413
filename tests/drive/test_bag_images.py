"""Images, mosaics and video in bags keep their pictures, and others are named."""

import logging
from fractions import Fraction
from typing import Any

import av
import cv2
import numpy as np
import pytest

from tests.drive.bags import (
    FFMPEG,
    FRONT,
    VIDEO,
    Messages,
    assert_same_drive,
    front_times,
    make_pictured_drive,
    messages_of,
    read,
    topics_for,
    write_ros2,
)
from v2hdm.errors import DriveError
from v2hdm.io.drive import read_drive
from v2hdm.io.importers.bag.messages import file_of


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A drive with a picture in its images."""
    return make_pictured_drive(tmp_path_factory.mktemp("folder"))


@pytest.mark.parametrize(
    ("encoding", "channels"), [("mono8", 1), ("bgr8", 3), ("rgb8", 3), ("bgra8", 4), ("rgba8", 4)]
)
def test_raw_images_keep_every_bit(encoding, channels):
    messages = Messages()
    pixels = np.random.default_rng(1).integers(0, 255, (6, 7, channels), np.uint8)
    suffix, data = file_of(
        "sensor_msgs/msg/Image", messages.raw_image(1.0, pixels, encoding, "cam", pad=3), "here"
    )
    got = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    colour = pixels[..., :3] if channels > 1 else np.repeat(pixels, 3, axis=2)
    assert suffix == ".png"
    np.testing.assert_array_equal(got, colour[..., ::-1] if encoding.startswith("rgb") else colour)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_pattern_is_read_as_ros_names_it(pattern):
    """A plane of one colour: behind every filter its own channel's value."""
    value = {"r": 200, "g": 120, "b": 30}
    tile = np.array([value[letter] for letter in pattern], np.uint8).reshape(2, 2)
    image = Messages().raw_image(1.0, np.tile(tile, (4, 4))[..., None], f"bayer_{pattern}8", "cam")
    got = cv2.imdecode(np.frombuffer(file_of("sensor_msgs/msg/Image", image, "here")[1], np.uint8), 1)
    np.testing.assert_array_equal(got, np.broadcast_to([30, 120, 200], got.shape))


COMPRESSED = "sensor_msgs/msg/CompressedImage"
TILE = np.array([[200, 120], [120, 30]], np.uint8)  # red, green; green, blue


def _unpacked(form, data):
    suffix, content = file_of(COMPRESSED, Messages().compressed(1.0, data, form, "cam"), "here")
    return suffix, cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize(
    "form",
    ["bayer_rggb8; jpeg compressed ", "bayer_rggb8; jpeg compressed", "bayer_rggb8;png", "bayer_rggb8"],
)
@pytest.mark.parametrize("ending", [".jpg", ".png"])
def test_a_mosaic_that_was_compressed_as_it_is_gets_its_colours(form, ending):
    mosaic = np.tile(TILE, (16, 16))
    suffix, got = _unpacked(form, cv2.imencode(ending, mosaic, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes())
    assert suffix == ".png"
    np.testing.assert_allclose(got, np.broadcast_to([30, 120, 200], got.shape), atol=3)


@pytest.mark.parametrize(
    ("form", "shape"),
    [
        ("bayer_rggb8; jpeg compressed bgr8", (32, 32, 3)),
        ("bayer_rggb8; jpeg compressed mono8", (32, 32)),
        ("mono8; jpeg compressed ", (32, 32)),
        ("bayer_rggb8; jpeg compressed ", (32, 32, 3)),  # whatever it says, it has colours
        ("jpeg", (32, 32, 3)),
        ("", (32, 32)),
    ],
)
@pytest.mark.parametrize("ending", [".jpg", ".png", ".webp", ".tif", ".bmp"])
def test_other_compressed_images_are_kept_as_they_are(form, shape, ending):
    pixels = np.random.default_rng(2).integers(0, 255, shape, np.uint8)
    data = cv2.imencode(ending, pixels)[1].tobytes()
    suffix, content = file_of(COMPRESSED, Messages().compressed(1.0, data, form, "cam"), "here")
    assert (suffix, content) == (ending, data)


@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
def test_colours_of_half_a_size_stand_below_the_brightness(encoding):
    planes = np.full((12, 8, 1), 128, np.uint8)
    planes[:8, :, 0] = 90
    planes[8:, 1::2, 0] = 180  # V of NV12, U of NV21: much red, or much blue
    message = Messages().raw_image(1.0, planes, encoding, "cam")
    message.height = 8
    got = cv2.imdecode(np.frombuffer(file_of("sensor_msgs/msg/Image", message, "here")[1], np.uint8), 1)
    assert got.shape == (8, 8, 3)
    strongest = got[0, 0].argmax()
    assert strongest == (2 if encoding == "nv12" else 0)


@pytest.mark.parametrize(("encoding", "width"), [("yuv422", 5), ("nv12", 5)])
def test_sizes_that_an_encoding_cannot_have_are_named(encoding, width):
    channels = 2 if encoding == "yuv422" else 1
    message = Messages().raw_image(1.0, np.zeros((9, width, channels), np.uint8), encoding, "cam")
    message.height = 6
    with pytest.raises(DriveError, match="here: "):
        file_of("sensor_msgs/msg/Image", message, "here")


def test_compressed_images_of_16_bits_or_of_depth_are_named():
    sixteen = cv2.imencode(".png", np.zeros((20, 20), np.uint16))[1].tobytes()
    with pytest.raises(DriveError, match="here: its PNG has 16 bits per channel"):
        _unpacked("mono16; png compressed ", sixteen)
    with pytest.raises(DriveError, match=r"compressed as '16UC1; compressedDepth png'; record JPEG"):
        _unpacked("16UC1; compressedDepth png", bytes(12) + sixteen)


def test_messages_without_an_image_are_left_out_and_counted(folder, tmp_path, caplog):
    messages = messages_of(folder)
    empty = next(row[2] for row in messages.rows if row[1] == FRONT)
    empty.data, empty.width, empty.height, empty.step = empty.data[:0], 0, 0, 0
    got = read(tmp_path / "drive", topics_for(folder, write_ros2(tmp_path / "site", messages)))
    assert front_times(got) == front_times(read_drive(folder))[1:]
    assert "left out 1 of 3 images, which are empty" in caplog.text


def test_images_of_an_unknown_encoding_are_named(folder, tmp_path):
    messages = messages_of(folder)
    for _, name, message in messages.rows:
        if name == "/sensing/front/image_raw":
            message.encoding = "16UC1"
    with pytest.raises(DriveError, match="image 1: encoding '16UC1' is not known; record one of mono8"):
        read(tmp_path / "drive", topics_for(folder, write_ros2(tmp_path / "site", messages)))


H265 = "lossless=1:bframes=0:keyint=2:min-keyint=2:repeat-headers=1:log-level=0"
LOSSLESS: dict[str, Any] = {
    "libx264rgb": ("rgb24", {"crf": "0", "bf": "0", "preset": "ultrafast", "g": "2"}),
    "libx265": ("gbrp", {"x265-params": H265}),
}


@pytest.mark.parametrize(
    ("codec", "kind", "stated"),
    [
        ("libx264rgb", VIDEO, "h264"),
        ("libx265", VIDEO, "h265"),
        ("libx264rgb", COMPRESSED, "h264"),
        ("libx265", COMPRESSED, "hevc"),
        ("libx264rgb", FFMPEG, "h264_nvenc"),
        ("libx265", FFMPEG, "hevc;yuv420p;bgr8;bgr8"),
    ],
)
def test_video_in_a_bag_is_decoded_from_its_first_key_frame_on(codec, kind, stated, folder, tmp_path, caplog):
    """A packet a message without loss; the recording began two packets too late."""
    expected = read_drive(folder)
    pictures = [cv2.imread(str(image.path)) for image in expected.images if image.camera == "front"]
    pictures = [pictures[0], pictures[1], *pictures]
    encoder = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height, encoder.time_base = 64, 48, Fraction(1, 10)
    encoder.pix_fmt, encoder.options = LOSSLESS[codec]
    packets: list[bytes] = []
    for number, pixels in enumerate([*pictures, None]):
        frame = None if pixels is None else av.VideoFrame.from_ndarray(pixels, format="bgr24")
        if frame is not None:
            frame = frame.reformat(format=encoder.pix_fmt)
            frame.pts = number
        packets += [bytes(packet) for packet in encoder.encode(frame)]
    messages = messages_of(folder)
    rows = [row for row in messages.rows if row[1] == "/sensing/front/image_raw"]
    messages.rows = [row for row in messages.rows if row[1] != "/sensing/front/image_raw"]
    # The first packet of all is a key frame: leave it out, and the one after it has none.
    begin_s = rows[0][0] - 0.04
    for stamp_s, packet in zip([begin_s, *(row[0] for row in rows)], packets[1:], strict=True):
        message = messages.packet(kind, stamp_s, packet, stated, "front_optical")
        messages.add(stamp_s, "/sensing/front/image_raw", message)
    messages.rows.sort(key=lambda row: row[0])
    bag = write_ros2(tmp_path / "site", messages)
    with caplog.at_level(logging.WARNING):
        assert_same_drive(read(tmp_path / "drive", topics_for(folder, bag)), expected)
    assert "left out 1 of 4 packets of video: no key frame before them" in caplog.text
