"""All bad inputs and situations, as a table; `python -m tests.benchmarks.bad_inputs` runs it."""

import io
import json
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import fields as fields_of
from dataclasses import is_dataclass
from pathlib import Path

import av
import cv2
import numpy as np
import yaml
from PIL import Image

from tests.calibration.site import INFO
from tests.drive.example import camera_info, looking_forward, make_map
from tests.faults.damages import damages
from tests.faults.judge import Case, Prepare
from tests.faults.making import (
    CHECK,
    CHECKED,
    Change,
    both,
    checked,
    described,
    drive,
    edit,
    write,
    write_example,
)
from tests.faults.owners import circles, geopackages, owners
from tests.faults.small import small
from v2hdm.io.calibration.writing import write_calibration, write_camera_info
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.pipeline.config import PortConfig, RunConfig
from v2hdm.records import Calibration, CameraFrames


def detects(name: str, line: str, prepare: Prepare, says: str, **more: object) -> Case:
    return Case(name, "v2hdm detect", tuple(line.split()), prepare, says, **more)


def exported(name: str, prepare: Prepare, says: str) -> Case:
    line = "map.geojson --format csv --output there"
    return Case(name, "v2hdm export", tuple(line.split()), prepare, says)


def renamed(name: object) -> Change:
    """Give the front camera another name."""

    def change(content: dict) -> None:
        content["cameras"][name] = content["cameras"].pop("front")

    return described(change)


def pipe(name: str) -> Change:
    """A pipe that nobody writes to in the place of a file."""

    def change(root: Path) -> None:
        (root / name).unlink(missing_ok=True)
        os.mkfifo(root / name)

    return change


def folder_instead(name: str) -> Change:
    """A folder in the place of a file."""

    def change(root: Path) -> None:
        (root / name).unlink(missing_ok=True)
        (root / name).mkdir()

    return change


ALIAS_BOMB = "a: &a [0,0,0,0,0,0,0,0,0]\n" + "".join(
    f"{'bcdefghij'[n]}: &{'bcdefghij'[n]} [{','.join(['*' + 'abcdefghi'[n]] * 9)}]\n" for n in range(9)
)

YAML_TEXTS: dict[str, tuple[str | bytes, str]] = {
    "empty": ("", "expected 'key: value' entries"),
    "only a comment": ("# nothing\n", "expected 'key: value' entries"),
    "a list": ("- a\n", "expected 'key: value' entries"),
    "a text": ("words\n", "expected 'key: value' entries"),
    "a number": ("3\n", "expected 'key: value' entries"),
    "unclosed list": ("name: [a\n", "line \\d+ YAML syntax error"),
    "unclosed quote": ('name: "a\n', "line \\d+ YAML syntax error"),
    "tab": ("name:\n\tx: 1\n", "line 2 YAML syntax error: a tab"),
    "two documents": ("name: a\n---\nname: b\n", "YAML syntax error"),
    "utf-16": ("name: a\n".encode("utf-16"), "UTF-16"),
    "latin-1": ("name: M\u00fcll\n".encode("latin-1"), "not a UTF-8"),
    "zero bytes": (b"\0" * 64, "zero byte"),
    "binary": (bytes(range(1, 256)), "not a UTF-8|special characters"),
    "control letters": ("name: a\x07b\n", "special characters"),
    "a key twice": ("name: a\nname: b\n", "line 2.*'name' appears twice"),
    "nested 70 deep": ("name: " + "[" * 70 + "]" * 70, "nested deeper"),
    "nested 3000 deep": ("name: " + "[" * 3000 + "]" * 3000, "nested deeper"),
    "mappings nested 3000 deep": ("name: " + "{a: " * 3000 + "}" * 3000, "nested deeper"),
    "alias bomb": (ALIAS_BOMB, "including aliases|no intrinsics of a known format"),
    "alias of itself": ("name: &a [*a]\n", "alias of something that contains it"),
    "unknown alias": ("name: *a\n", "YAML syntax error"),
    "5000 digits": ("name: " + "9" * 5000 + "\n", "5000 digits"),
    "5000 hex digits": ("name: 0x" + "f" * 5000 + "\n", "5002 digits"),
    "int of letters": ("name: !!int abc\n", "'abc' does not match its tag"),
    "float of letters": ("name: !!float abc\n", "'abc' does not match its tag"),
    "bool of letters": ("name: !!bool abc\n", "'abc' does not match its tag"),
    "python object": ("name: !!python/object/apply:os.system [true]\n", "the tag"),
    "python name": ("name: !!python/name:os.system\n", "the tag"),
    "own tag": ("name: !secret x\n", "the tag"),
    "binary tag": ("name: !!binary aGk=\n", "the tag"),
    "half a letter": ('name: "\\ud800"\n', "line 1 .*half a character"),
    "half a letter in a key": ('"\\udc00": 1\n', "line 1 .*half a character"),
    "set": ("name: !!set {a}\n", "the tag"),
    "key that is a list": ("? [a, b]\n: 1\n", "a key that is a list"),
    "mapping that is a list": ("name: !!map [1]\n", "YAML syntax error"),
    "merge of a text": ("<<: words\n", "YAML syntax error"),
}

JSON_TEXTS: dict[str, tuple[str | bytes, str]] = {
    "empty": ("", "JSON syntax error"),
    "cut off": ('{"v2hdm": {', "JSON syntax error"),
    "list": ("[]", "expected a JSON object"),
    "number": ("7", "expected a JSON object"),
    "utf-16": ("{}".encode("utf-16"), "UTF-16"),
    "binary": (bytes(range(256)), "not a UTF-8"),
    "nested 70 deep": ('{"features": ' + "[" * 70 + "]" * 70 + "}", "nested deeper"),
    "nested 3000 deep": ('{"features": ' + "[" * 3000 + "]" * 3000 + "}", "nested deeper"),
    "nested 100000 deep": ("[" * 100000, "nested deeper"),
    "depth hidden in a text": ('{"a": "]]]]]]]", "b": ' + "[" * 3000 + "]" * 3000 + "}", "nested deeper"),
    "a key twice": ('{"v2hdm": {}, "v2hdm": {}}', "'v2hdm' appears twice"),
    "5000 digits": ('{"v2hdm": {"origin": ' + "9" * 5000 + '}, "features": []}', "origin"),
    "half a letter": ('{"v2hdm": {"crs": "\\ud800"}, "features": []}', "half a character"),
    "half a letter in a key": ('{"\\uDC00": {}}', "half a character"),
    "not a number": ('{"v2hdm": {}, "features": [{"properties": {"corners_map": NaN}}]}', "feature 0"),
    "no map": ('{"type": "FeatureCollection", "features": []}', "not a map written by v2hdm"),
    "features that are a text": ('{"v2hdm": {}, "features": "x"}', "not a map written by v2hdm"),
    "feature that is a list": ('{"v2hdm": {}, "features": [[]]}', "feature 0"),
    "feature that is nothing": ('{"v2hdm": {}, "features": [null]}', "feature 0"),
    "properties that are a list": ('{"v2hdm": {}, "features": [{"properties": [1]}]}', "feature 0"),
    "origin that is a list": ('{"v2hdm": {"origin": [1]}, "features": []}', "origin"),
    "byte order mark in the midst": ('{"v2hdm": \ufeff{}}', "JSON syntax error"),
}

BAD_NAMES: dict[str, tuple[object, str]] = {
    "empty": ("", "name is empty"),
    "parent": ("..", "begins with a dot"),
    "hidden": (".front", "begins with a dot"),
    "escape": ("../../x", "path separator"),
    "absolute": ("/tmp/x", "path separator"),
    "folder": ("a/b", "path separator"),
    "backslash": ("a\\b", "path separator"),
    "newline": ("a\nb", "does not show"),
    "zero byte": ("a\0b", "does not show|special characters|zero byte"),
    "escape sequence": ("a\x1b[31mb", "does not show|special characters"),
    "turned around": ("a\u202eb", "does not show"),
    "line separator": ("a\u2028b", "does not show"),
    "blank at the end": ("front ", "a space"),
    "too long": ("x" * 65, "longer than 64"),
    "too many bytes": ("\U0001f697" * 64, "longer than 64"),
}


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


def texts() -> Iterator[Case]:
    """Broken YAML, JSON and tables."""
    for name, (text, says) in YAML_TEXTS.items():
        for file in ("drive.yaml", "front/camera_info.yaml"):
            # Of intrinsics any tool's file will do.
            either = f"{says}|no intrinsics of a known format" if file.startswith("front") else says
            yield checked(f"{file}: {name}", either, write(file, text))
        both = ("a.yaml", "a.yaml")
        yield Case(f"calibration: {name}", "v2hdm calibrate compare", both, write("a.yaml", text), says)
    for name, (text, says) in JSON_TEXTS.items():
        yield exported(f"map: {name}", write("map.geojson", text), says)
    for file in ("drive.yaml", "poses.tum", "front/camera_info.yaml", "front/images.txt"):
        yield checked(f"{file}: a pipe", "pipe|not a drive", pipe(file))
        yield checked(f"{file}: a folder", "folder|not a drive|no image", folder_instead(file))
        yield checked(f"{file}: all of utf-16", "UTF-16", write(file, "a: b\n".encode("utf-16")))
        yield checked(f"{file}: zeros", "zero byte", write(file, bytes(99)))
    poses = "front/images.txt", "poses.tum"
    lines = {
        "words": "one two\n",
        "infinite": "100.0 inf 0 0 0 0 0 1\n",
        "not a number": "nan 0 0 0 0 0 0 1\n",
    }
    for name, text in lines.items():
        yield checked(f"poses: {name}", "poses.tum: line", write(poses[1], text))
    far = "\n".join(f"{100 + 0.1 * n:.1f} 1e300 0 0 0 0 0 1" for n in range(30))
    yield checked("poses: 1e300", "off the earth", write(poses[1], far))
    utm = "\n".join(f"{100 + 0.1 * n:.1f} {560000 + n} 5930000 0 0 0 0 1" for n in range(30))
    yield checked("poses: UTM and an origin elsewhere", "such as UTM", write(poses[1], utm))
    slow = "\n".join(f"{100 + n:.1f} {n} 0 0 0 0 0 1" for n in range(5))
    yield checked("poses: 1 Hz", "drive.max_gap_s", write(poses[1], slow))
    ns = "\n".join(f"{(100 + 0.1 * n) * 1e9:.0f} {n} 0 0 0 0 0 1" for n in range(30))
    yield checked("poses: ns", "nanoseconds", write(poses[1], ns))
    late = "\n".join(f"{9100 + 0.1 * n:.1f} {n} 0 0 0 0 0 1" for n in range(30))
    yield checked("poses: of another day", "begin 9000 s later", write(poses[1], late))


POINTS = {
    "a cell of 200000 letters": (f"name,u,v,x,y\n{'P' * 200_000},1,2,3,4\n", "is not a table"),
    "an open quote of 200000 letters": ('name,u,v,x,y\n"' + "P" * 200_000, "is not a table"),
    "one point 3000 times": ("name,u,v,x,y\n" + "P,100,100,8,0\n" * 3000, "have the same pixel"),
    "a name that moves the cursor": ("name,u,v,x,y\n\x1b[2J,-9,2,3,4\n" + "a,1,1,9,1\n" * 5, r"\?\[2J"),
    "no number": ("u,v,x,y\n1,2,3,nan\n", "y"),
    "too few cells": ("u,v,x,y\n1,2,3\n", "3 cells under 4 columns"),
}


def points() -> Iterator[Case]:
    """Tables of surveyed points."""
    line = ("points.csv", "--intrinsics", "camera_info.yaml", "--output", "out")
    for name, (text, says) in POINTS.items():
        prepare = both(
            lambda root: write_camera_info(INFO, root / "camera_info.yaml"), write("points.csv", text)
        )
        yield Case(f"points: {name}", "v2hdm calibrate points", line, prepare, says)


def names() -> Iterator[Case]:
    """Names that are no names."""
    for name, (text, says) in BAD_NAMES.items():
        yield checked(f"camera's name: {name}", says, renamed(text))
        if text:
            change = described(lambda content, text=text: content.update(name=text))
            yield Case(f"drive's name: {name}", CHECK, CHECKED[:-2], drive(change), says)
        words = ("c.yaml", "--format", "urdf", "--output", "there")
        yield Case(
            f"calibration's camera: {name}",
            "v2hdm export",
            words,
            _calibrated(text),
            f"{says}|expected a text",
        )
        if isinstance(text, str):
            yield exported(f"class in a map: {name}", _map_of_class(text), says)
        words = ("points.csv", "--intrinsics", "camera_info.yaml", "--output", "out")
        prepare, either = _camera_called(text), f"{says}|expected a text"
        yield Case(f"intrinsics' camera: {name}", "v2hdm calibrate points", words, prepare, either)
    for word in ("both", "all", "Both"):
        yield checked(f"camera called {word}", "results of all", renamed(word))
    for number in (7, 1.5):
        more = {"code": 0, "leaves": "^work/here/out(/|$)", "tells": True}
        yield checked(f"camera called {number}", "verdict", renamed(number), **more)


def _camera_called(name: object) -> Prepare:
    def prepare(root: Path) -> None:
        write_camera_info(INFO, root / "camera_info.yaml")
        content = yaml.safe_load((root / "camera_info.yaml").read_text()) | {"camera_name": name}
        (root / "camera_info.yaml").write_text(yaml.safe_dump(content))

    return prepare


def _map_of_class(kind: str) -> Prepare:
    def prepare(root: Path) -> None:
        write_geojson(make_map(), root / "map.geojson")
        content = json.loads((root / "map.geojson").read_text())
        content["features"][0]["properties"]["class"] = kind
        (root / "map.geojson").write_text(json.dumps(content))

    return prepare


def images() -> Iterator[Case]:
    """Broken images, one by one and in a drive."""
    for name, (data, says) in IMAGES.items():
        yield detects(f"image: {name}", "a.jpg", write("a.jpg", data), says)
        yield checked(f"image in a drive: {name}", says, write("front/images/000001.jpg", data))
    yield detects("image: damaged inside", "a.jpg", write("a.jpg", damaged_inside()), "damaged")
    deep = picture(".png", depth=np.uint16)
    yield detects(
        "image: 16 bits", "a.png", write("a.png", deep), "16 bits per channel; convert it to 8 bits"
    )
    yield detects("image: a pipe", "imgs", _imgs(pipe("imgs/b.jpg")), "device")
    yield detects("video: a pipe", "precious.txt", pipe("precious.txt"), "a pipe or a device")
    yield detects("image: a folder", "imgs", _imgs(folder_instead("imgs/b.jpg")), "folder")
    for orientation in range(2, 9):
        for kind in ("JPEG", "PNG", "TIFF", "WEBP"):
            data = turned(kind, orientation)
            name = f"image in a drive: {kind} of orientation {orientation}"
            yield checked(name, f"EXIF orientation {orientation}", write("front/images/000001.jpg", data))
    for name, text in PLAYLISTS.items():
        for ending in (".mp4", ".avi", ".mkv"):
            files = both(write("a.mp4", SHORT_VIDEO), write(f"v{ending}", text))
            yield detects(f"video: {name}, {ending}", f"v{ending}", files, "nor a video|holds no")
    named = both(write("a.mp4", SHORT_VIDEO), write("concat:a.mp4", "x"))
    yield detects("video: a name that FFmpeg takes for a protocol", "concat:a.mp4", named, "nor a video")


def _imgs(change: Change) -> Prepare:
    def prepare(root: Path) -> None:
        (root / "imgs").mkdir()
        change(root)

    return prepare


def fields() -> Iterator[Case]:
    """Values of ``drive.yaml`` and ``camera_info.yaml`` that cannot be."""
    wrong: list[object] = [None, [], {}, "x", True, -1, 10**30, [[1]], float("nan"), float("inf")]
    front = ("roi_vehicle", "initial_ipm", "ipm", "images", "camera_info", "centre_prior", "linear_response")
    right = {"linear_response": (True,), "initial_ipm": (None,), "centre_prior": (None,)}
    for key in front:
        for value in wrong:
            if any(value is one for one in right.get(key, ())):
                continue

            def change(content: dict, key: str = key, value: object = value) -> None:
                content["cameras"]["front"][key] = value

            yield checked(f"front, {key}: {value!r:.20}", _names(key, value), described(change))
    for key in ("poses", "pose_noise", "origin", "truth", "bag", "cameras"):
        for value in wrong:
            if value is None and key in ("pose_noise", "origin", "truth"):
                continue
            if (key, value) == ("pose_noise", {}):
                continue

            def put(content: dict, key: str = key, value: object = value) -> None:
                content[key] = value

            yield checked(f"{key}: {value!r:.20}", _names(key, value), described(put))
    info = "front/camera_info.yaml"
    numbers = {
        "width 0": ("image_width: 64", "image_width: 0", "image_width"),
        "width -1": ("image_width: 64", "image_width: -1", "image_width"),
        "width 1e9": ("image_width: 64", "image_width: 1000000000", "image_width"),
        "width 64.5": ("image_width: 64", "image_width: 64.5", "image_width"),
        "width a text": ("image_width: 64", "image_width: wide", "image_width"),
        "tangential 5": (r"0\.001, -0\.001", "5.0, 5.0", "p1 and p2"),
        "radial -50": (r"-0\.1, 0\.02", "-50.0, 0.02", "folds over"),
        "focal length 1e300": (r"60\.0", "1.0e+300", "camera_matrix"),
        "focal length nan": (r"60\.0", ".nan", "camera_matrix"),
        "lens": ("plumb_bob", "fisheye62", "unknown distortion_model"),
        "lens that is a list": ("plumb_bob", "[a]", "distortion_model"),
    }
    for name, (old, new, says) in numbers.items():
        yield checked(f"camera_info: {name}", says, edit(info, old, new))


def _names(key: str, value: object) -> str:
    """What an error about a key must name: the key, or the file of the name that it gives."""
    return f"{key}|drive/x: no such file" if value == "x" else key


def outputs() -> Iterator[Case]:
    """Outputs that are inputs, the user's, somebody else's or nowhere."""
    imgs = _imgs(write("imgs/a.jpg", picture(height=240, width=320)))
    linked = both(imgs, lambda root: (root / "link").symlink_to("imgs/a.jpg"))
    twin = both(imgs, lambda root: os.link(root / "imgs/a.jpg", root / "twin"))
    for name, line, prepare, says in (
        ("draw into the source", "imgs --draw imgs", imgs, "that V2HDM did not write"),
        ("output is the source", "imgs/a.jpg --output imgs/a.jpg", imgs, "inputs"),
        ("output is a link to the source", "imgs/a.jpg --output link", linked, "inputs"),
        ("output is the source by another name", "imgs/a.jpg --output twin", twin, "inputs"),
        ("output is an image of the source", "imgs --output imgs/a.jpg", imgs, "inputs"),
        (
            "output is the calibration",
            "imgs/a.jpg --camera c.yaml --output c.yaml",
            both(imgs, _calibration),
            "inputs",
        ),
        ("output is a file of the user's", "imgs --output precious.txt", imgs, "holds no det"),
        ("output is a folder", "imgs --output imgs", imgs, "give another --output"),
        ("output in a file", "imgs --output precious.txt/x", imgs, "give another --output"),
        ("drawings in a file", "imgs --draw precious.txt/x", imgs, "give another --draw"),
        (
            "a drawing is a folder",
            "imgs --draw d",
            both(imgs, _folder_with("d/a.jpg", "x")),
            "give another --draw",
        ),
    ):
        yield detects(name, line, prepare, says)
    yield detects("output on a full disk", "imgs --output x.jsonl", imgs, "cannot write", disk_bytes=1)
    yield detects("drawing on a full disk", "imgs --draw d", imgs, "cannot be written", disk_bytes=200)
    for name, make in {
        "somebody's folder": _folder_with("out", "thesis.tex"),
        "a drive": lambda root: write_example(root / "out"),
        "a folder with a config.yaml": _folder_with("out", "config.yaml"),
        "a folder with a metrics.json": _folder_with("out", "metrics.json"),
        "a folder with a folder": _folder_with("out/deep", "x"),
    }.items():
        yield Case(f"result into {name}", CHECK, CHECKED, both(drive(), make), "that V2HDM did not write")
    yield Case("result onto a file", CHECK, CHECKED, both(drive(), write("out", "x")), "is a file")
    within = (*CHECKED[:-1], "precious.txt/x")
    yield Case("result within a file", CHECK, within, drive(), "cannot be written|is a file")
    yield Case("result into the drive", CHECK, (*CHECKED[:-1], "drive"), drive(), "that V2HDM did not write")
    through = both(imgs, lambda root: (root / "link").symlink_to("found.jsonl"))
    more = {"code": 0, "leaves": "found.jsonl", "tells": True}
    yield detects("output is a link to what is to be", "imgs/a.jpg --output link", through, "", **more)
    circle = both(drive(), lambda root: (root / "out").symlink_to("out"))
    yield Case("result onto a link in a circle", CHECK, CHECKED, circle, "broken link|cannot")
    for most in (0, 10, 1000, 5000):
        name = f"result on a disk with room for {most} bytes"
        yield checked(name, "cannot be written", disk_bytes=most)
    yield Case(
        "export onto the map", "v2hdm export", ("map.geojson", "--format", "geojson"),
        lambda root: write_geojson(make_map(), root / "map.geojson"), "would be overwritten",
    )  # fmt: skip
    yield exported("export onto a link to the map", _linked_map, "would be overwritten")


def _folder_with(folder: str, name: str) -> Prepare:
    def prepare(root: Path) -> None:
        (root / folder).mkdir(parents=True)
        (root / folder / name).write_text("mine")

    return prepare


def _calibration(root: Path) -> None:
    info = camera_info("front", 320, 240)
    frames = CameraFrames("base_link", "front_optical_frame")
    write_calibration(Calibration(info, looking_forward(), frames=frames), root / "c.yaml")


def _calibrated(name: object) -> Prepare:
    def prepare(root: Path) -> None:
        _calibration(root)
        content = yaml.safe_load((root / "c.yaml").read_text()) | {"camera_name": name}
        (root / "c.yaml").write_text(yaml.safe_dump(content))

    return prepare


def _linked_map(root: Path) -> None:
    write_geojson(make_map(), root / "map.geojson")
    (root / "there").mkdir()
    (root / "there" / "map.csv").symlink_to("../map.geojson")


def arguments() -> Iterator[Case]:
    """Command lines that cannot be meant."""
    for line, says in {
        "nowhere --no-ground": "nowhere: no such drive",
        "drive --workers -1": "--workers -1",
        "drive --workers 99999999": "--workers 99999999",
        "drive --camera left": "no camera 'left'; choose from: front, rear",
        "precious.txt": "not a drive",
        ". --no-ground": "not a drive",
    }.items():
        yield Case(f"check {line}", CHECK, line.split(), drive(), says)
    for line, says in {
        "nowhere.jpg": "nowhere.jpg: no such image, video or folder",
        "precious.txt": "neither an image nor a video",
        "imgs --limit 0": "--limit 0",
        "nowhere\udcff": r"nowhere\?: no such image",
        "imgs --threads 0": "threads is 0",
        "imgs --threads 99999": "threads is 99999: set 1 to 256",
        "imgs --model nowhere.onnx": "nowhere.onnx: no such detector model",
        "imgs --model precious.txt": "precious.txt: not a usable ONNX model",
        "imgs --camera nowhere.yaml": "nowhere.yaml: no such file",
        "imgs --camera precious.txt": "precious.txt",
        "imgs --mounting 0 5 60": "give a height above 0 m",
        "imgs --mounting -1 5 60": "give a height above 0 m",
        "imgs --mounting inf 5 60": "give a height above 0 m",
        "imgs --mounting nan 5 60": "--mounting nan",
        "imgs --mounting 1.6 5 600": "--mounting",
    }.items():
        imgs = _imgs(write("imgs/a.jpg", picture(height=240, width=320)))
        yield Case(f"detect {line}", "v2hdm detect", line.split(), imgs, says)
    imgs, more = _imgs(write("imgs/a.jpg", picture(height=240, width=320))), {"code": 0, "tells": True}
    yield detects("detect --limit of 30 digits", f"imgs --limit {'9' * 30}", imgs, "", **more)
    words = ("map.geojson", "--format", "gpkg", "--output", "\udcff")
    yield Case(
        "export into a name that is no UTF-8", "v2hdm export", words,
        lambda root: write_geojson(make_map(), root / "map.geojson"), "a name that is not UTF-8",
        leaves="here/\udcff$",
    )  # fmt: skip
    for line, says in {
        "nowhere nowhere": "nowhere",
        "precious.txt precious.txt": "precious.txt",
        ". .": "no calibration_",
    }.items():
        yield Case(f"calibration {line}", "v2hdm calibrate compare", line.split(), both(), says)
    for line, says in {
        "nowhere.geojson --format csv": "nowhere.geojson",
        "precious.txt --format csv": "precious",
        "map.geojson --format pdf": "pdf",
        ". --format csv": "",
    }.items():
        yield Case(f"export {line}", "v2hdm export", line.split(), both(), says)


def _plainly(lines: str) -> dict[str, str]:
    """Settings that an error repeats: of ``data.width=7`` it says ``width is 7``, of words in quotes."""
    pairs = [(line, *line.split("=")) for line in lines.split()]
    return {line: f"{key.rpartition('.')[2]} is '?{value}" for line, key, value in pairs}


SETTINGS = _plainly(
    "workers=-1 device=tpu mode=x mapping.max_range_m=nan mapping.max_range_m=inf mapping.max_range_m=0 "
    "mapping.rounds=0 mapping.loss=x mapping.pose_model=x mapping.lanes.min_images=-1 detector.threads=0 "
    "detector.blur_px=99 detector.max_range_m=-1 detector.min_score=nan detector.border_px=-3 "
    "detector.lane_step_m=-1 drive.max_gap_s=-1 drive.max_gap_s=nan"
) | {
    "workers=99999999999999999999": "workers is",
    "workers=many": "workers=many",
    "name=../x": "path separator",
    "name=..": "begins with a dot",
    "'name=\"a/b\"'": "path separator",
    "+mapping.known_sizes.by_class_m={squid: [1.0, 0.7]}": "there is no such class",
    "+mapping.known_sizes.by_class_m={diamond: [1.0]}": "by_class_m",
    "+mapping.known_sizes.by_class_m={diamond: [.nan, 1.0]}": "by_class_m",
    "detector.model=nowhere.onnx": "nowhere.onnx",
    "export=[pdf]": "pdf",
    "maping.max_range_m=1": "did you mean mapping",
    "drive": "is not key=value",
    "+run=port9": "port9",
    "drive.path=straße": "needs quotes",
    "mapping=null": "mapping",
    "drive.cameras=front": "drive.cameras",
    "--config-name=x": "no option --config-name=x",
}
SIMULATED = _plainly(
    "simulate.seed=-1 simulate.cameras.front.width=0 simulate.cameras.front.width=100000 "
    "simulate.route.image_spacing_m=0 simulate.route.speed_mps=nan "
    "simulate.exposure.full_well_electrons=0 simulate.yard.barriers=-5"
) | {
    "simulate.name=../x": "path separator",
    "+simulate.cameras.both=${simulate.cameras.front}": "results of all",
}
TRAINING = _plainly(
    "batch=0 batch=-4 data.width=7 data.width=0 data.height=100 data.reservoir=0 data.views_per_render=0 "
    "data.workers=-1 data.kerbs=nan data.labelled_share=2 learning_rate=nan learning_rate=-1 learning_rate=0 "
    "weight_decay=inf minutes=-1 minutes=nan minutes=inf steps=0 warmup=1 ema_updates=0 threads=0 seed=-1 "
    "checkpoint_minutes=0 net.head_width=0 loss.dice=-1 validation.images=-1"
) | {
    "data.width=1024": "data.width x data.height",
    "net.widths=[8]": "net.widths",
    "net.widths=[]": "net.widths",
    "device=abacus": "device=abacus",
    "start=nowhere.pt": "nowhere.pt",
    "catalogue=nowhere.yaml": "nowhere.yaml",
    "data.coco=nowhere.json": "nowhere.json",
}
AREAS = _plainly("steps=0 sky=2 threads=0 render_share=nan render_views=-1 seed=-1") | {
    "classes=[]": "name one class or more",
    "start=nowhere.pt": "nowhere.pt",
    "data.coco=nowhere.json": "nowhere.json",
}
SCORES = {
    "seed=1": "start",
    "start=nowhere.pt": "nowhere.pt",
}
EXPORTS = _plainly("opset=3 opset=99 tolerance=nan int8.frames=0 int8.bounds.kinds_agree=7") | {
    "checkpoint=nowhere.pt": "nowhere.pt",
    "precision=int4": "precision",
    "output=a.pt": "inputs",
}


def measures(options: object, below: str = "") -> Iterator[str]:
    """The keys of all settings that are numbers with a fraction, also of those that are added later."""
    for one in fields_of(options):
        value = getattr(options, one.name)
        if is_dataclass(value):
            yield from measures(value, f"{below}{one.name}.")
        elif isinstance(value, float):
            yield below + one.name


SIGNED = ("start_s", "sun_azimuth_deg", "sun_elevation_deg", "moving_offset_m")


def numbers() -> Iterator[Case]:
    """No measure is NaN, and none but an angle or a time is negative."""
    for options, below, run in (
        (RunConfig(), "", ("drive.path=drive",)),
        (PortConfig(), "simulate.", ("+run=port2",)),
    ):
        for key in measures(options, below):
            last = key.rpartition(".")[2]
            for value in ("nan",) if last in SIGNED else ("nan", "-1e-3"):
                words = (*run, "workers=1", f"{key}={value}")
                yield Case(f"number: {key}={value}", "v2hdm map", words, drive(), last)


def settings() -> Iterator[Case]:
    """Settings of the doors that Hydra configures."""
    for line, says in SETTINGS.items():
        words = (line.strip("'"), "workers=1") if "workers" not in line else (line,)
        yield Case(f"map {line}", "v2hdm map", ("drive.path=drive", *words), drive(), says)
    for line, says in SIMULATED.items():
        yield Case(f"map {line}", "v2hdm map", ("+run=port2", "workers=1", line), both(), says)
    for line, says in TRAINING.items():
        end = () if line.startswith(("minutes", "steps")) else ("steps=1",)
        words = (line, *end) if line.startswith("validation") else (line, *end, "validation.images=0")
        yield Case(f"train {line}", "train.__main__", words, both(), says)
    for line, says in AREAS.items():
        yield Case(f"areas {line}", "train.areas.__main__", (line,), both(), says)
    for line, says in SCORES.items():
        yield Case(f"score {line}", "train.score", (line,), both(), says)
    for line, says in EXPORTS.items():
        words = [
            one for one in ("checkpoint=a.pt", "output=b.onnx") if one.split("=")[0] != line.split("=")[0]
        ]
        yield Case(f"export {line}", "export.__main__", (*words, line), write("a.pt", "x"), says)
    run = ("drive.path=drive", "--config-dir", "conf", "+run=mine", "workers=1")
    for name, (text, says) in YAML_TEXTS.items():
        if name in ("empty", "only a comment"):
            continue
        header = b"# @package _global_\n" if name not in ("utf-16",) else b""
        data = text.encode() if isinstance(text, str) else text
        says = says if "expected" not in says else "mine|list|dict|config"
        yield Case(
            f"run file: {name}", "v2hdm map", run, _run_file(header + data), f"{says}|mine.yaml|configuration"
        )
    yield Case("run file without its header", "v2hdm map", run, _run_file(b"name: x\n"), "@package _global_")


def _run_file(data: bytes) -> Prepare:
    def prepare(root: Path) -> None:
        drive()(root)
        (root / "conf" / "run").mkdir(parents=True)
        (root / "conf" / "run" / "mine.yaml").write_bytes(data)

    return prepare


def all_cases() -> list[Case]:
    """The table."""
    parts = (
        texts, points, names, images, damages, fields, outputs, owners, circles, geopackages, small,
        arguments, settings, numbers,
    )  # fmt: skip
    return [case for part in parts for case in part()]
