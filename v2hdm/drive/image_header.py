"""The size of an image file, and whether its end is there, without decoding it."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

from v2hdm.errors import DriveError

_TAIL_BYTES = 4096
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
# Start-of-frame markers; DHT, JPG and DAC lie in their midst and are none.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_WITHOUT_LENGTH = frozenset([0x01, *range(0xD0, 0xD9)])


def image_size(path: Path) -> tuple[int, int] | None:
    """Width and height of the PNG or JPEG file at ``path``; None for any other format.

    Raises:
        DriveError: when the file is missing, empty or truncated.
    """
    try:
        with path.open("rb") as stream:
            signature = stream.read(8)
            if signature == _PNG_SIGNATURE:
                size, end = _png_size(stream), b"IEND"
            elif signature.startswith(_JPEG_START):
                size, end = _jpeg_size(stream), _JPEG_END
            elif not signature:
                raise DriveError(f"{path}: image file is empty; restore it or drop it from the list")
            else:
                return None
            tail_at = max(0, stream.seek(0, 2) - _TAIL_BYTES)
            stream.seek(tail_at)
            complete = end in stream.read()
    except FileNotFoundError:
        raise DriveError(f"{path}: image listed but missing; restore it or drop it from the list") from None
    except OSError as failure:
        raise DriveError(
            f"{path}: image cannot be read ({failure.strerror}); check its permissions"
        ) from None
    if size is None or not complete:
        raise DriveError(f"{path}: image is truncated; restore it or drop it from the list")
    return size


def _png_size(stream: BinaryIO) -> tuple[int, int] | None:
    stream.seek(16)
    field = stream.read(8)
    if len(field) < 8:
        return None
    width, height = struct.unpack(">II", field)
    return width, height


def _jpeg_size(stream: BinaryIO) -> tuple[int, int] | None:
    """Walk the segments up to the start of frame (ITU-T T.81, B.2)."""
    stream.seek(2)
    while True:
        byte = stream.read(1)
        while byte == b"\xff":
            byte = stream.read(1)
        if not byte:
            return None
        if byte[0] in _JPEG_WITHOUT_LENGTH:
            continue
        header = stream.read(2)
        if len(header) < 2:
            return None
        if byte[0] in _JPEG_FRAMES:
            frame = stream.read(5)
            if len(frame) < 5:
                return None
            height, width = struct.unpack(">xHH", frame)
            return width, height
        stream.seek(struct.unpack(">H", header)[0] - 2, 1)
