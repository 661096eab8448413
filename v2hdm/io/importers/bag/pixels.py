"""Images of messages as bytes of image files: compressed ones as they are, raw ones as PNG."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from v2hdm.errors import DriveError
from v2hdm.io.drive.lossless import png

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
IMAGE_KINDS = (RAW, COMPRESSED)

_PNG_SIGNATURE, _JPEG_START = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"


@dataclass(frozen=True)
class _Encoding:
    channels: int
    to_bgr: int | None = None


_ENCODINGS: Mapping[str, _Encoding] = {
    "mono8": _Encoding(1),
    "8UC1": _Encoding(1),
    "bgr8": _Encoding(3),
    "8UC3": _Encoding(3),
    "rgb8": _Encoding(3, cv2.COLOR_RGB2BGR),
    "bgra8": _Encoding(4, cv2.COLOR_BGRA2BGR),
    "rgba8": _Encoding(4, cv2.COLOR_RGBA2BGR),
    # OpenCV names a Bayer pattern by its second row, ROS by its first.
    "bayer_rggb8": _Encoding(1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": _Encoding(1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": _Encoding(1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": _Encoding(1, cv2.COLOR_BayerGB2BGR),
    "yuv422": _Encoding(2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": _Encoding(2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": _Encoding(2, cv2.COLOR_YUV2BGR_YUYV),
    "yuyv": _Encoding(2, cv2.COLOR_YUV2BGR_YUYV),
}


def file_of(kind: str, fields: Any, where: str) -> tuple[str, bytes]:
    """Suffix and content of the file of an image message.

    Raises:
        DriveError: the encoding is not known or the message holds too few bytes.
    """
    return _WRITERS[kind](fields, where)


def _compressed(fields: Any, where: str) -> tuple[str, bytes]:
    data = fields.data.tobytes()
    if data.startswith(_JPEG_START):
        return ".jpg", data
    if data.startswith(_PNG_SIGNATURE):
        return ".png", data
    raise DriveError(
        f"{where}: compressed as '{fields.format}', neither JPEG nor PNG; record JPEG, PNG or raw images"
    )


def _raw(fields: Any, where: str) -> tuple[str, bytes]:
    encoding = _ENCODINGS.get(fields.encoding)
    if encoding is None:
        raise DriveError(
            f"{where}: encoding '{fields.encoding}' is not known; record one of {', '.join(_ENCODINGS)}"
        )
    height, width, step = int(fields.height), int(fields.width), int(fields.step)
    row = width * encoding.channels
    if not height or not width or step < row or len(fields.data) < step * (height - 1) + row:
        raise DriveError(
            f"{where}: {len(fields.data)} bytes are no image of {width} x {height} in {fields.encoding} with "
            f"{step} bytes a row; record it anew"
        )
    data = np.zeros(step * height, dtype=np.uint8)
    data[: len(fields.data)] = fields.data[: len(data)]
    shape = (height, width) if encoding.channels == 1 else (height, width, encoding.channels)
    pixels = data.reshape(height, step)[:, :row].reshape(shape)
    if encoding.to_bgr is not None:
        pixels = np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), encoding.to_bgr), dtype=np.uint8)
    return ".png", png(pixels)


_WRITERS: Mapping[str, Callable[[Any, str], tuple[str, bytes]]] = {RAW: _raw, COMPRESSED: _compressed}
