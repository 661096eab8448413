"""All bad inputs and situations, as a table; `python -m tests.benchmarks.bad_inputs` runs it."""

import json
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import yaml

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
from tests.faults.pictures import (
    IMAGES,
    PLAYLISTS,
    SHORT_VIDEO,
    damaged_inside,
    picture,
    turned,
)
from tests.faults.settings import numbers, settings
from tests.faults.small import small
from tests.faults.texts import BAD_NAMES, JSON_TEXTS, YAML_TEXTS
from v2hdm.io.calibration.writing import write_calibration, write_camera_info
from v2hdm.io.maps.geojson import write_geojson
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


def texts() -> Iterator[Case]:
    """Broken YAML, JSON and tables."""
    for name, (text, says) in YAML_TEXTS.items():
        for file in ("drive.yaml", "front/camera_info.yaml"):
            # Of intrinsics any tool's file will do.
            either = f"{says}|no intrinsics of a known format" if file.startswith("front") else says
            yield checked(f"{file}: {name}", either, write(file, text))
        names = ("a.yaml", "a.yaml")
        yield Case(f"calibration: {name}", "v2hdm calibrate compare", names, write("a.yaml", text), says)
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
            if any(value is right_value for right_value in right.get(key, ())):
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
    """The pattern that an error about a key must name: the key, or the file of the name that it gives."""
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


def all_cases() -> list[Case]:
    """The table."""
    parts = (
        texts, points, names, images, damages, fields, outputs, owners, circles, geopackages, small,
        arguments, settings, numbers,
    )  # fmt: skip
    return [case for part in parts for case in part()]
