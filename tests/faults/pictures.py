"""Pictures and videos that are damaged, cut off, or something else than they say."""

import io
import struct
import zlib

import av
import cv2
import numpy as np
from PIL import Image


def _png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_header(width: int, height: int) -> bytes:
    """A PNG of few bytes that says it is large."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = _png_chunk(b"IDAT", zlib.compress(b"\0" * 64))
    return b"\x89PNG\r\n\x1a\n" + _png_chunk(b"IHDR", header) + data + _png_chunk(b"IEND", b"")


def picture(suffix: str = ".jpg", height: int = 48, width: int = 64, depth: type = np.uint8) -> bytes:
    """A picture of noise."""
    rng = np.random.default_rng(4)
    pixels = rng.integers(0, 255, (height, width, 3)).astype(depth)
    return cv2.imencode(suffix, pixels)[1].tobytes()


def damaged_inside() -> bytes:
    """A JPEG with its end, whose middle is zeros."""
    data = bytearray(picture(height=480, width=640))
    data[len(data) // 3 : len(data) // 2] = bytes(len(data) // 2 - len(data) // 3)
    return bytes(data)


def again_and_again() -> bytes:
    """A progressive JPEG that repeats its last scan, of a few bytes, 100 times: each is over all pixels."""
    plain = np.zeros((48, 64, 3), np.uint8)
    data = cv2.imencode(".jpg", plain, (cv2.IMWRITE_JPEG_PROGRESSIVE, 1))[1].tobytes()
    return data[:-2] + 100 * data[data.rindex(b"\xff\xda") : -2] + data[-2:]


def flipped_png() -> bytes:
    """A PNG with one bit changed."""
    data = bytearray(picture(".png"))
    data[len(data) // 2] ^= 4
    return bytes(data)


def chunk_of_4_gb(kind: bytes = b"IDAT") -> bytes:
    """A PNG with a chunk that says it is longer than the file: one before the end, or the end itself."""
    data = picture(".png")
    begin = data.index(kind) - 4
    return data[:begin] + struct.pack(">I", 0xF3002000) + data[begin + 4 :]


def turned(kind: str, orientation: int) -> bytes:
    """A picture of the example's size with an EXIF orientation."""
    exif, stream = Image.Exif(), io.BytesIO()
    exif[0x112] = orientation
    pixels = cv2.imdecode(np.frombuffer(picture(), np.uint8), cv2.IMREAD_COLOR)
    Image.fromarray(pixels).save(stream, kind, exif=exif)
    return stream.getvalue()


PLAYLISTS: dict[str, str] = {
    "a list of files": "ffconcat version 1.0\nfile a.mp4\n",
    "a playlist": "#EXTM3U\n#EXT-X-TARGETDURATION:4\n#EXTINF:4,\na.mp4\n#EXT-X-ENDLIST\n",
    "a playlist of a host": "#EXTM3U\n#EXT-X-TARGETDURATION:4\n#EXTINF:4,\nhttp://127.0.0.1:9/a.ts\n",
    "a session of a host": "v=0\no=- 0 0 IN IP4 127.0.0.1\nm=video 9 RTP/AVP 96\na=rtpmap:96 H264/90000\n",
    "a manifest": '<MPD xmlns="urn:mpeg:dash:schema:mpd:2011"><BaseURL>a.mp4</BaseURL></MPD>',
    "an edit list of FFmpeg's": ";FFMETADATA1\ntitle=x\n",
    "subtitles": "1\n00:00:00,000 --> 00:00:01,000\na\n",
}


def _video() -> bytes:
    """Four frames of an MP4, made once a process."""
    stream = io.BytesIO()
    with av.open(stream, "w", "mp4") as container:
        track = container.add_stream("mpeg4", rate=10)
        track.width, track.height = 320, 240
        frames = [av.VideoFrame.from_ndarray(np.zeros((240, 320, 3), np.uint8), format="bgr24")] * 4
        for frame in (*frames, None):
            container.mux(track.encode(frame))
    return stream.getvalue()


SHORT_VIDEO = _video()


IMAGES: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "empty"),
    "text": (b"no image", "not a PNG"),
    "zeros": (bytes(4096), "not a PNG"),
    "one byte": (b"\xff", "not a PNG"),
    "start of a jpeg": (b"\xff\xd8", "truncated"),
    "end of a jpeg": (b"\xff\xd8\xff\xd9", "truncated"),
    "start of a png": (b"\x89PNG\r\n\x1a\n", "truncated"),
    "half a jpeg": (picture()[:700], "truncated"),
    "half a png": (picture(".png")[:700], "truncated"),
    "png with a chunk of 4 GB": (chunk_of_4_gb(), "damaged"),
    "png with an end of 4 GB": (chunk_of_4_gb(b"IEND"), "damaged"),
    "png with a flipped bit": (flipped_png(), "damaged"),
    "jpeg that goes over its pixels 100 times": (again_and_again(), "damaged"),
    "1 x 1 px": (picture(height=1, width=1), "1 x 1 px"),
    "1 x 1 px png": (picture(".png", height=1, width=1), "1 x 1 px"),
    "3 x 2000 px": (picture(height=3, width=2000), "at least 16 px"),
    "header of 60000 x 60000": (png_header(60000, 60000), "60000 x 60000 px, more than"),
    "header of 2**31 x 1": (png_header(2**31 - 1, 1), "px"),
    "header of 0 x 0": (png_header(0, 0), "0 x 0 px"),
    "jpeg header of 65535 x 65535": (
        b"\xff\xd8\xff\xc0" + struct.pack(">HBHHB", 11, 8, 65535, 65535, 1) + b"\1\x11\0" + b"\xff\xd9",
        "65535 x 65535 px, more than",
    ),
    "gif": (b"GIF89a" + bytes(40), "not a PNG"),
    "svg": (b"<svg xmlns='http://www.w3.org/2000/svg'/>", "not a PNG"),
    "tiff with a loop": (b"II*\0" + struct.pack("<IH", 8, 65535) + bytes(12), "truncated"),
    "bmp header only": (b"BM" + bytes(30), "px|truncated"),
    "webp header only": (b"RIFF\x10\0\0\0WEBPVP8 ", "truncated"),
}
