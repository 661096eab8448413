"""Validation of images from outside: every image file that others wrote is checked and decoded here.

The size is read from the header before anything is decoded, so that a small file cannot ask for all of the
memory. Damage that decoders only warn of, such as half an image or grey blocks, is an error.
"""

from __future__ import annotations

import logging
import re
import stat
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import takewhile
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
import simplejpeg

from v2hdm.errors import DriveError, V2hdmError
from v2hdm.safe.placeholders import placeholder_words
from v2hdm.store.inputs import note_input

_log = logging.getLogger(__name__)

MOST_PX = 200_000_000  # the largest sensors of mapping cameras have 150 million
LEAST_SIDE_PX = 16  # narrower images show no marking, and not one cell of the network
_MOST_BYTES = 1 << 30  # of an image file; chosen
_TIMES = 4000  # what a raster's byte may unpack to, beyond the largest image: ours hold up to 320 where empty
_TAIL_BYTES = 4096  # at a file's end, in which its format's last marker must lie; cameras append to it
_STRIP_ROWS = 32  # rows that turn grey at a time: all rows as float32 would leave the processor's cache
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_TIFF = (b"II*\0", b"MM\0*")
# Start-of-frame markers; DHT, JPG and DAC lie in their midst and are none.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_WITHOUT_LENGTH = frozenset([0x01, *range(0xD0, 0xD9)])  # markers that no length follows (T.81, B.1.1.3)
_SEGMENT = re.compile(rb"\xff([^\0\1\xd0-\xd8\xff])")  # of a JPEG, or its end
_APP1 = 0xE1  # a JPEG's marker of EXIF data
_START_OF_SCAN = 0xDA  # a JPEG's marker of compressed pixels
_MOST_SCANS = 64  # of a JPEG; progressive ones have about ten
_WIDTH_TAG = 0x100  # a TIFF's, as the next two
_HEIGHT_TAG = 0x101  # a TIFF's
_ORIENTATION_TAG = 0x112  # a TIFF's, and EXIF's
_UPRIGHT = 1  # the orientation of an image that is shown as it is stored

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp")  # suffixes of images in a folder
AS_STORED = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR  # OpenCV's flags for the depth and channels of the file
_GREY_FLAGS = (cv2.IMREAD_GRAYSCALE, cv2.IMREAD_REDUCED_GRAYSCALE_4)
_PRINTERS_SPACES = ("CMYK", "YCCK")  # which TurboJPEG turns into no other
_ODD = re.compile("JFIF revision|Adobe color|progression sequence|subsampling")
"""Complaints of a strict decoder about a JPEG that may be whole: others make these files, too."""
VIDEO_OPTIONS = {
    "protocol_whitelist": "file",
    "format_whitelist": "mov,matroska,avi,mpegts,mpeg,mpegvideo,m4v,h264,hevc,ivf,obu,asf,flv,ogg,mjpeg,mxf",
}
"""FFmpeg's, without which a file of another format, such as a playlist, makes it open other files."""
DECODER_OPTIONS = {"err_detect": "crccheck"}
"""FFmpeg's, without which hashes of pictures that a video of H.265 carries are not looked at."""
_QUICK = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # OpenCV's options of a PNG: zlib's fastest level


@dataclass(frozen=True)
class Header:
    """Size of an image as it is stored, px, and its EXIF orientation (1 is upright; TIFF 6.0, section 8)."""

    width: int
    height: int
    orientation: int = _UPRIGHT


def is_image_name(name: str) -> bool:
    """Whether a file is an image by its name; hidden ones, such as macOS's ``._NAME.jpg``, are none."""
    return not name.startswith(".") and name.lower().endswith(IMAGE_SUFFIXES)


def read_header(path: Path) -> Header:
    """The header of a PNG, JPEG, TIFF, BMP or WebP file; refuses truncated, tiny and huge ones."""
    with _opened(path) as data:
        return _checked(data, path)


def read_pixels(path: Path, flags: int) -> np.ndarray:
    """The decoded pixels of an image, with OpenCV's ``flags``; errors as :func:`read_header`, or damage."""
    with _opened(path) as stored:
        data = stored[:]
    return pixels_of(data, path, flags)


def pixels_of(data: bytes, path: Path, flags: int) -> np.ndarray:
    """The pixels of the image file ``data``, which errors call ``path``; as :func:`read_pixels`."""
    header = _checked(data, path)
    if not (_is_whole_png(data) if data.startswith(_PNG) else _scans(data) <= _MOST_SCANS):
        raise DriveError(f"{path}: the image is damaged; copy it again or drop it from the list")
    if header.orientation != _UPRIGHT and not flags & cv2.IMREAD_IGNORE_ORIENTATION:
        _warn_turned(path.parent, header.orientation)
    try:
        pixels = _strict_jpeg(data, header, flags) if data.startswith(_JPEG) else None
        if pixels is None:
            pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
    except (ValueError, cv2.error):
        pixels = None
    if pixels is None:
        raise DriveError(f"{path}: the image is damaged; copy it again or drop it from the list")
    return np.asarray(pixels)


def _strict_jpeg(data: bytes, header: Header, flags: int) -> np.ndarray | None:
    """The pixels that OpenCV decodes with ``flags``, None where only it can; ValueError on damage."""
    try:
        *_, colour_space, _ = simplejpeg.decode_jpeg_header(data)
        if colour_space in _PRINTERS_SPACES:
            simplejpeg.decode_jpeg(data, "CMYK")
            return None
        is_grey = flags in _GREY_FLAGS or (flags == AS_STORED and colour_space == "Gray")
        shrink = 4 if flags == cv2.IMREAD_REDUCED_GRAYSCALE_4 else 1
        pixels = simplejpeg.decode_jpeg(
            data, "GRAY" if is_grey else "BGR",
            min_height=-(-header.height // shrink), min_width=-(-header.width // shrink), min_factor=shrink,
        )  # fmt: skip
    except ValueError as complaint:
        if not _ODD.search(str(complaint)):
            raise
        return None
    if header.orientation != _UPRIGHT or flags not in (*_GREY_FLAGS, AS_STORED, cv2.IMREAD_COLOR):
        return None
    return np.asarray(pixels[..., 0] if is_grey else pixels)


def grey_of(pixels: np.ndarray) -> np.ndarray:
    """Grey values (H, W) float32: the mean of colours (H, W, 3), or pixels (H, W) that are grey already."""
    if pixels.ndim == 2:
        return pixels.astype(np.float32, copy=False)
    grey = np.empty(pixels.shape[:2], dtype=np.float32)
    for row in range(0, len(pixels), _STRIP_ROWS):
        strip = slice(row, row + _STRIP_ROWS)
        # Numpy takes five times as long for a mean over three channels.
        cv2.transform(pixels[strip].astype(np.float32), np.ones((1, 3), dtype=np.float32), grey[strip])
    return np.divide(grey, np.float32(3), out=grey)


def check_raster(raster: Any, path: Path, error: type[V2hdmError]) -> None:
    """Raise ``error`` where a raster, open in rasterio, would unpack to more than its file could hold."""
    (rows, columns), *_ = raster.block_shapes
    largest = 4 * MOST_PX + _TIMES * path.stat().st_size
    if raster.count * (raster.height + rows) * (raster.width + columns) > largest:
        raise error(f"{path}: has more pixels than its bytes could hold; save it without empty ones")


def png(pixels: np.ndarray) -> bytes:
    """The PNG file of an image, (H, W) or (H, W, 3) BGR uint8, quick rather than small."""
    is_encoded, data = cv2.imencode(".png", pixels, _QUICK)
    assert is_encoded
    return data.tobytes()


@lru_cache
def _warn_turned(folder: Path, orientation: int) -> None:
    _log.warning(
        "%s: images are rotated according to their EXIF orientation %d; calibrate the rotated ones",
        folder, orientation,
    )  # fmt: skip


class _Stored:
    """The bytes of an open file, read where they are asked for: a header may lie at its end (TIFF)."""

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream = stream
        self._size = size

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, part: slice) -> bytes:
        begin, end, _ = part.indices(self._size)
        self._stream.seek(begin)
        return self._stream.read(max(end - begin, 0))


_Data = bytes | _Stored


@contextmanager
def _opened(path: Path) -> Iterator[_Stored]:
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):
            raise DriveError(f"{path}: is a folder or a device, not an image file; check the list")
        if about.st_size > _MOST_BYTES:
            raise DriveError(f"{path}: image of {about.st_size / 1e6:.0f} MB; check its content")
        note_input(path)
        with path.open("rb") as stream:
            yield _Stored(stream, about.st_size)
    except (FileNotFoundError, NotADirectoryError):
        raise DriveError(f"{path}: image listed but missing; restore it or drop it from the list") from None
    except (OSError, ValueError) as failure:
        reason = getattr(failure, "strerror", None) or failure
        raise DriveError(f"{path}: cannot read this image ({reason}); check its permissions") from None


def _checked(data: _Data, path: Path) -> Header:
    if not len(data):
        raise DriveError(f"{path}: image file is empty; restore it or drop it from the list")
    begin = data[:12]
    is_webp = begin[:4] == b"RIFF" and begin[8:] == b"WEBP"
    if not (is_webp or begin.startswith((_PNG, _JPEG, b"BM", *_TIFF))):
        if words := placeholder_words(path):
            raise DriveError(f"{path}: {words}")
        raise DriveError(f"{path}: not a PNG, JPEG, TIFF, BMP or WebP image; convert it, or drop it")
    try:
        header = _header(data)
    except (struct.error, LookupError, ValueError):
        header = None
    end = {_JPEG: b"\xff\xd9", _PNG[:2]: b"IEND"}.get(begin[:2], b"")
    if header is None or end not in data[-_TAIL_BYTES:]:
        raise DriveError(f"{path}: image is truncated or damaged; restore it or drop it from the list")
    size = f"{path}: image is {header.width} x {header.height} px"
    if min(header.width, header.height) < LEAST_SIDE_PX:
        raise DriveError(f"{size}; give images of at least {LEAST_SIDE_PX} px per side")
    if header.width * header.height > MOST_PX:
        raise DriveError(f"{size}, more than {MOST_PX // 10**6} million in total; scale it down or drop it")
    return header


def _header(data: _Data) -> Header | None:
    begin = data[:8]
    if begin == _PNG:
        width, height = _unpack(">II", data, 16)
        before = takewhile(lambda chunk: chunk[0] != b"IDAT", _png_chunks(data))
        exif = next((data[at : at + length] for kind, at, length in before if kind == b"eXIf"), b"")
        return Header(width, height, _orientation(exif))
    if begin.startswith(_JPEG):
        return _jpeg_header(data)
    if begin.startswith(_TIFF):
        tags = _tiff_tags(data)
        return Header(tags[_WIDTH_TAG], tags[_HEIGHT_TAG], tags.get(_ORIENTATION_TAG, _UPRIGHT))
    if begin.startswith(b"BM"):
        if _unpack("<I", data, 14)[0] < 40:  # OS/2's header
            width, height = _unpack("<HH", data, 18)
            return Header(width, height)
        width, height = _unpack("<ii", data, 18)
        return Header(width, abs(height))
    return _webp_header(data)


def _unpack(form: str, data: _Data, at: int) -> tuple[int, ...]:
    return struct.unpack(form, data[at : at + struct.calcsize(form)])


def _jpeg_header(data: _Data) -> Header | None:
    """Walk the segments up to the start of frame (ITU-T T.81, B.2)."""
    orientation = _UPRIGHT
    at = 2
    while at < len(data):
        marker = data[at : at + 1][0]
        at += 1
        if marker == 0xFF or marker in _JPEG_WITHOUT_LENGTH:
            continue
        if marker == _START_OF_SCAN:
            return None
        (length,) = _unpack(">H", data, at)
        if marker in _JPEG_FRAMES:
            height, width = _unpack(">HH", data, at + 3)
            return Header(width, height, orientation)
        if marker == _APP1 and data[at + 2 : at + 8] == b"Exif\0\0":
            orientation = _orientation(data[at + 8 : at + length])
        at += length
    return None


def _scans(data: bytes) -> int:
    """How often a JPEG goes over all of its pixels, each time in a few bytes if it wants; 0 for others."""
    at = count = 0
    while data.startswith(_JPEG) and (segment := _SEGMENT.search(data, at)) and segment[1] != b"\xd9":
        count += segment[1][0] == _START_OF_SCAN
        at = segment.end() + int.from_bytes(data[segment.end() : segment.end() + 2], "big")
    return count


def _png_chunks(data: _Data) -> Iterator[tuple[bytes, int, int]]:
    """Kind, begin and length of the body of each whole chunk (PNG, third edition, section 5.3)."""
    at = len(_PNG)
    kind = b""
    while kind != b"IEND" and at + 12 <= len(data):
        (length,) = _unpack(">I", data, at)
        if at + 12 + length > len(data):
            break
        yield (kind := data[at + 4 : at + 8]), at + 8, length
        at += 12 + length


def _is_whole_png(data: bytes) -> bool:
    """Whether its chunks have their checksums and none ends beyond the file: decoders only warn, too late."""
    chunks = [*_png_chunks(data)]
    return any(kind == b"IEND" for kind, _, _ in chunks[-1:]) and all(
        zlib.crc32(data[at - 4 : at + length]) == _unpack(">I", data, at + length)[0]
        for _, at, length in chunks
    )


def _webp_header(data: _Data) -> Header:
    """The size in the first chunk (RFC 9649, section 2)."""
    kind = data[12:16]
    if kind == b"VP8X":
        at = 12
        exif = b""
        while not exif and at + 8 <= len(data):
            end = at + 8 + _unpack("<I", data, at + 4)[0]
            exif = data[at + 8 : end].removeprefix(b"Exif\0\0") if data[at : at + 4] == b"EXIF" else b""
            at = end + end % 2
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
        return Header(width, height, _orientation(exif))
    if kind == b"VP8L":
        bits = int.from_bytes(data[21:25], "little")
        return Header((bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1)
    width, height = _unpack("<HH", data, 26)
    return Header(width & 0x3FFF, height & 0x3FFF)


def _orientation(exif: bytes) -> int:
    """The orientation in an EXIF block, upright where that is damaged."""
    with suppress(struct.error):
        tag = _tiff_tags(exif).get(_ORIENTATION_TAG, 0) if exif.startswith(_TIFF) else 0
        return tag if 1 <= tag <= 8 else _UPRIGHT
    return _UPRIGHT


def _tiff_tags(data: _Data) -> dict[int, int]:
    """The whole numbers in the first directory of a TIFF, by tag."""
    order = "<" if data[:2] == b"II" else ">"
    (at,) = _unpack(f"{order}I", data, 4)
    (count,) = _unpack(f"{order}H", data, at)
    tags = {}
    for number in range(count):
        tag, kind, length = _unpack(f"{order}HHI", data, at + 2 + 12 * number)
        if length == 1 and kind in (3, 4):
            tags[tag] = _unpack(f"{order}{'H' if kind == 3 else 'I'}", data, at + 10 + 12 * number)[0]
    if _WIDTH_TAG in tags and _HEIGHT_TAG not in tags:
        raise ValueError("no height")
    return tags
