"""Intrinsics of a camera from the files of the tools that calibrate: one registry of formats.

COLMAP counts pixels from the corner of the image: the centre of the first one is at (0.5, 0.5).
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from v2hdm.errors import DriveError, MapFileError, shown
from v2hdm.io.calibration.reading import (
    Intrinsics,
    Lens,
    info_of,
    read_calibration,
    rectified_matrix,
    rectifying_turn,
    take_camera_info,
    take_matrix,
)
from v2hdm.records import DISTORTION_COEFFICIENTS, CameraInfo, FloatArray
from v2hdm.safe.fields import check_camera, take_size_px
from v2hdm.safe.texts import parse_json, parse_yaml, read_text
from v2hdm.store.files import take_array, take_text

_XML = re.compile(r"<[?!\w]")  # YAML may begin with ``<<``
_END_OF_MESSAGE = re.compile(r"\n---\s*$")  # ``ros2 topic echo`` ends with a second, empty document

_BROWN_CONRADY = {4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}
"""Our lens for each number of OpenCV's coefficients."""

_BEYOND = {14: (12, "tilted sensor"), 12: (8, "thin prism")}
"""Lenses of OpenCV beyond ours, by their number of coefficients: how many the next simpler lens has, which
it is if the others are zero, and the name of what the others describe."""

_COLMAP_LINE = re.compile(r"^\d+\s+[A-Z][A-Z0-9_]+\s+\d+\s+\d+(\s|$)")
_COLMAP_CENTRE_PX = 0.5  # COLMAP's coordinate of the centre of the first pixel, px
_KALIBR_PROJECTIONS = {
    "omni": "omnidirectional (omni)", "ds": "double sphere (ds)", "eucm": "extended unified (eucm)",
}  # fmt: skip


@dataclass(frozen=True)
class Document:
    """One calibration file."""

    path: Path
    text: str
    entries: dict[str, Any]  # at the top of the file, none where it is plain text

    @property
    def lower(self) -> dict[str, Any]:
        """The entries by their names in small letters: OpenCV 2 wrote Camera_Matrix and image_Width."""
        return {str(key).lower(): value for key, value in self.entries.items()}

    def only_camera(self) -> list[str]:
        """The name of its camera, or that of the file where it names none."""
        return [str(self.entries.get("camera_name", self.path.stem))]


@dataclass(frozen=True)
class IntrinsicsFormat:
    """One format of files with intrinsics."""

    accepts: Callable[[Document], bool]  # whether a file looks like one of this format
    read: Callable[[Document, str], CameraInfo]  # the camera of that name
    names: Callable[[Document], list[str]] = Document.only_camera  # of the cameras in a file
    read_rectified: Callable[[Document, str], Intrinsics] | None = None  # where files may state P


def read_intrinsics(path: Path, camera: str | None = None, name_by: str = "its name") -> CameraInfo:
    """The intrinsics of one camera, from a file of any format of :data:`INTRINSICS`.

    ``camera`` is needed where there are several; ``name_by`` says how the user names it. Raises DriveError
    when the file is damaged or of no known format, the camera not in it, or its lens beyond ours.
    """
    chosen, document, name = _chosen(path, camera, name_by)
    return chosen.read(document, name)


def read_rectified_intrinsics(path: Path, camera: str | None = None, name_by: str = "its name") -> Intrinsics:
    """Intrinsics of images that a camera's calibration rectified: P without a distortion, turned by R.

    A file of a format without P is of the rectified images themselves, whose lens has no distortion.
    Arguments and errors are those of :func:`read_intrinsics`.
    """
    chosen, document, name = _chosen(path, camera, name_by)
    if chosen.read_rectified is not None:
        return chosen.read_rectified(document, name)
    info = chosen.read(document, name)
    unstated = np.zeros((3, 4))
    rectified_matrix(info.intrinsic, np.array(info.distortion), unstated, str(path))
    return Intrinsics(info, np.eye(3))


class _Chosen(NamedTuple):
    """A file, its format, and the name of a camera in it."""

    format: IntrinsicsFormat
    document: Document
    name: str


def _chosen(path: Path, camera: str | None, name_by: str) -> _Chosen:
    if path.suffix.lower() == ".bin":
        raise DriveError(f"{path}: is binary; export the model as text (model_converter --output_type TXT)")
    document = _read_document(path)
    chosen = next((candidate for candidate in INTRINSICS.values() if candidate.accepts(document)), None)
    if chosen is None:
        raise DriveError(f"{path}: no intrinsics of a known format ({', '.join(INTRINSICS)}) in this file")
    names = chosen.names(document)
    if camera is None and len(names) > 1:
        raise DriveError(f"{path}: holds the cameras {', '.join(names)}; choose one with {name_by}")
    if camera is not None and camera not in names:
        raise DriveError(f"{path}: no camera {shown(camera)} in this file; it holds: {', '.join(names)}")
    return _Chosen(chosen, document, names[0] if camera is None else camera)


def is_calibration(path: Path) -> bool:
    """Whether the file is a calibration of ours, which says where the camera sits, too."""
    return INTRINSICS["V2HDM calibration"].accepts(_read_document(path))


def _read_document(path: Path) -> Document:
    if path.is_dir():
        raise DriveError(f"{path}: is a folder; give the calibration file in it")
    text = read_text(path, DriveError)
    start = text.lstrip("\ufeff \t\r\n")
    content: object = {}
    if _XML.match(start):
        content = _of_xml(path, start)
    elif start.startswith("{"):
        content = parse_json(start, str(path), DriveError)
    elif path.suffix.lower() != ".txt" and start:
        # OpenCV 4 begins its files with a directive that YAML 1.1 refuses; its tag adds nothing to the keys.
        plain = start.removeprefix("%YAML:1.0").replace("!!opencv-matrix", "")
        content = parse_yaml(_END_OF_MESSAGE.sub("\n", plain), str(path), DriveError)
    return Document(path, text, _mapping(content))


def _of_xml(path: Path, text: str) -> dict[str, Any]:
    if "<!" in text.replace("<!--", ""):
        raise DriveError(f"{path}: has XML declarations, which no calibration file has; restore it")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as failure:
        raise DriveError(f"{path}: line {failure.position[0]}: XML syntax error; restore the file") from None
    if root.tag != "opencv_storage":
        raise DriveError(f"{path}: expected OpenCV's <opencv_storage>, got <{root.tag}>; name another file")
    entries: dict[str, Any] = {}
    for node in root:
        entries[node.tag] = _scalar(node.text)
        if node.get("type_id") == "opencv-matrix":
            entries[node.tag] = {child.tag: _scalar(child.text) for child in node}
            entries[node.tag]["data"] = [_scalar(word) for word in (node.findtext("data") or "").split()]
    return entries


def _scalar(text: str | None) -> object:
    """A number if the text is one, else the text without OpenCV's quotes."""
    words = (text or "").strip()
    try:
        return float(words)
    except ValueError:
        return words.strip('"')


def _brown_conrady(coefficients: Sequence[float], where: str) -> Lens:
    """Our model for OpenCV's coefficients k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]."""
    values = list(coefficients) or [0.0] * 5
    while (count := len(values)) in _BEYOND:
        first, lens = _BEYOND[count]
        if any(values[first:]):
            raise DriveError(
                f"{where}: a {lens} ({count} coefficients) is not supported; calibrate with 5 or 8"
            )
        values = values[:first]
    if count not in _BROWN_CONRADY:
        raise DriveError(f"{where}: {count} distortion coefficients; expected 4, 5 or 8")
    return _complete(_BROWN_CONRADY[count], values)


def _equidistant(coefficients: Sequence[float], where: str) -> Lens:
    if len(coefficients) != 4:
        raise DriveError(f"{where}: a fisheye has 4 coefficients, got {len(coefficients)}; restore the file")
    return _complete("equidistant", coefficients)


def _complete(model: str, coefficients: Sequence[float]) -> Lens:
    """The lens with zeros for the coefficients that are missing."""
    missing = DISTORTION_COEFFICIENTS[model] - len(coefficients)
    return Lens(model, (*map(float, coefficients), *(0.0,) * missing))


def _mapping(content: object) -> dict[str, Any]:
    return content if isinstance(content, dict) else {}


def _beyond(where: str, lens: str, instead: str) -> DriveError:
    return DriveError(f"{where}: its lens model {lens} is not supported; calibrate with {instead}")


def _need(entries: Mapping[str, Any], keys: Sequence[str], where: str, advice: str) -> None:
    for key in keys:
        if key not in entries:
            raise DriveError(f"{where}: missing key '{key}'; {advice}")


def _camera(
    name: str, size: Sequence[object], size_at: Sequence[str], matrix: FloatArray, lens: Lens, where: str
) -> CameraInfo:
    """The checked camera; ``size_at`` names width and height in errors."""
    width, height = (take_size_px(side, at, DriveError) for side, at in zip(size, size_at, strict=True))
    info = CameraInfo(name, width, height, matrix, lens.model, lens.coefficients)
    return check_camera(info, where, DriveError)


def _matrix(fx: float, fy: float, cx: float, cy: float) -> FloatArray:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


class ColmapModel(NamedTuple):
    """One of COLMAP's camera models, by the order of its parameters: focal lengths, centre, coefficients."""

    focals: int  # number of focal lengths: one for both axes, or two
    coefficients: int  # number of distortion coefficients
    lens: str  # our distortion model that it is


COLMAP_MODELS: Mapping[str, ColmapModel] = {
    "SIMPLE_PINHOLE": ColmapModel(1, 0, "plumb_bob"),
    "PINHOLE": ColmapModel(2, 0, "plumb_bob"),
    "SIMPLE_RADIAL": ColmapModel(1, 1, "plumb_bob"),
    "RADIAL": ColmapModel(1, 2, "plumb_bob"),
    "OPENCV": ColmapModel(2, 4, "plumb_bob"),
    "FULL_OPENCV": ColmapModel(2, 8, "rational_polynomial"),
    "OPENCV_FISHEYE": ColmapModel(2, 4, "equidistant"),
    "SIMPLE_RADIAL_FISHEYE": ColmapModel(1, 1, "equidistant"),
    "RADIAL_FISHEYE": ColmapModel(1, 2, "equidistant"),
}
"""COLMAP's models by name."""


def _colmap_lines(document: Document) -> list[tuple[int, str]]:
    """The lines of a cameras.txt that are no comments, each with its number."""
    lines = ((number, line.strip()) for number, line in enumerate(document.text.splitlines(), 1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def _read_colmap(document: Document, name: str) -> CameraInfo:
    lines = _colmap_lines(document)
    number, line = next((number, line) for number, line in lines if line.split()[0] == name)
    where = f"{document.path}: line {number}"
    if not _COLMAP_LINE.match(line):
        raise DriveError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS; restore the file")
    _, kind, width, height, *words = line.split()
    if kind not in COLMAP_MODELS:
        models = ", ".join(COLMAP_MODELS)
        raise DriveError(f"{where}: COLMAP's {kind} is not supported; choose one of: {models}")
    model = COLMAP_MODELS[kind]
    centre_at = model.focals
    lens_at = centre_at + 2
    count = lens_at + model.coefficients
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.array([np.nan])
    if len(values) != count or not np.isfinite(values).all():
        raise DriveError(f"{where}: {kind} has {count} parameters; restore the file")
    cx, cy = values[centre_at:lens_at] - _COLMAP_CENTRE_PX
    matrix = _matrix(values[0], values[model.focals - 1], cx, cy)
    lens = _complete(model.lens, values[lens_at:].tolist())
    size = (int(width), int(height))
    size_at = [f"{where}: WIDTH", f"{where}: HEIGHT"]
    return _camera(name, size, size_at, matrix, lens, where)


def _kalibr_names(document: Document) -> list[str]:
    return [
        str(name)
        for name, entry in document.entries.items()
        if isinstance(entry, dict) and {"camera_model", "intrinsics"} & set(entry)
    ]


def _read_kalibr(document: Document, name: str) -> CameraInfo:
    where = f"{document.path}: {name}"
    entry = document.entries[name]
    needed = ("camera_model", "intrinsics", "distortion_model", "resolution")
    _need(entry, needed, where, "take the camchain that Kalibr wrote")
    projection = take_text(entry["camera_model"], f"{where}, camera_model", DriveError)
    if projection != "pinhole":
        lens_name = _KALIBR_PROJECTIONS.get(projection, repr(projection))
        raise _beyond(where, lens_name, "pinhole-radtan or pinhole-equi")
    model = take_text(entry["distortion_model"], f"{where}, distortion_model", DriveError)
    stated = entry.get("distortion_coeffs")
    at = f"{where}, distortion_coeffs"
    values = [] if stated in (None, []) else take_array(stated, (-1,), at, DriveError).tolist()
    if model in ("equidistant", "equi"):
        lens = _equidistant(values, at)
    elif model in ("radtan", "none"):
        lens = _brown_conrady([] if model == "none" else values, at)
    else:
        raise _beyond(where, repr(model), "pinhole-radtan or pinhole-equi")
    size = take_array(entry["resolution"], (2,), f"{where}, resolution", DriveError).tolist()
    fx, fy, cx, cy = take_array(entry["intrinsics"], (4,), f"{where}, intrinsics", DriveError).tolist()
    return _camera(name, size, [f"{where}, resolution"] * 2, _matrix(fx, fy, cx, cy), lens, where)


def _read_opencv(document: Document, name: str) -> CameraInfo:
    where = str(document.path)
    entries = document.lower
    sides = ("image_width", "image_height")
    if "xi" in entries:
        raise _beyond(where, "omnidirectional (xi)", "cv2.calibrateCamera or cv2.fisheye.calibrate")
    _need(entries, ["distortion_coefficients"], where, "add it, with zeros for a pinhole camera")
    _need(entries, sides, where, "add the size of the images it was made from")
    intrinsic = take_matrix(entries["camera_matrix"], f"{where}: camera_matrix")
    if intrinsic.shape != (3, 3):
        raise DriveError(f"{where}: camera_matrix: expected 3 x 3; restore the file")
    at = f"{where}: distortion_coefficients"
    values = take_matrix(entries["distortion_coefficients"], at).ravel().tolist()
    is_fisheye = entries.get("fisheye_model") or entries.get("distortion_model") == "equidistant"
    lens = _equidistant(values, at) if is_fisheye else _brown_conrady(values, at)
    size = [entries[key] for key in sides]
    return _camera(name, size, [f"{where}: {key}" for key in sides], intrinsic, lens, where)


def _read_own(document: Document, name: str) -> CameraInfo:
    try:
        info = read_calibration(document.path).info
    except MapFileError as error:
        raise DriveError(str(error)) from None
    if len(info.distortion) != DISTORTION_COEFFICIENTS.get(info.distortion_model):
        raise DriveError(
            f"{document.path}: {info.distortion_model} with {len(info.distortion)} coefficients is not a "
            f"supported lens; choose from {', '.join(DISTORTION_COEFFICIENTS)}"
        )
    return info


def _message_names(document: Document) -> list[str]:
    """Its only camera, by the frame of its header."""
    return [str(_mapping(document.entries.get("header")).get("frame_id") or document.path.stem)]


def _read_message(document: Document, name: str) -> CameraInfo:
    return info_of(_fields_of_message(document), name, str(document.path)).info


def _read_rectified_message(document: Document, name: str) -> Intrinsics:
    return info_of(_fields_of_message(document), name, str(document.path), rectified=True)


def _fields_of_message(document: Document) -> SimpleNamespace:
    where = str(document.path)
    entries = document.lower
    _need(entries, ("k", "d"), where, "write the message to the file again")
    region = _mapping(entries.get("roi"))
    turn = entries.get("r") or [0.0] * 9
    projection = entries.get("p") or [0.0] * 12
    return SimpleNamespace(
        k=take_array(entries["k"], (9,), f"{where}: k", DriveError),
        d=take_array(entries["d"], (-1,), f"{where}: d", DriveError) if entries["d"] else np.empty(0),
        r=take_array(turn, (9,), f"{where}: r", DriveError),
        p=take_array(projection, (12,), f"{where}: p", DriveError),
        distortion_model=take_text(entries["distortion_model"], f"{where}: distortion_model", DriveError),
        width=take_size_px(entries["width"], f"{where}: width", DriveError),
        height=take_size_px(entries["height"], f"{where}: height", DriveError),
        binning_x=entries.get("binning_x") or 0,
        binning_y=entries.get("binning_y") or 0,
        roi=SimpleNamespace(width=region.get("width", 0), height=region.get("height", 0)),
    )


def _read_rectified_file(document: Document, name: str) -> Intrinsics:
    """The intrinsics of rectified images, of a file as ROS' ``camera_calibration`` writes it."""
    where = str(document.path)
    info = take_camera_info(document.entries, where)
    stated = {"projection_matrix": np.zeros((3, 4)), "rectification_matrix": np.zeros((3, 3))}
    for key, unstated in stated.items():
        if document.entries.get(key) is not None:
            stated[key] = take_matrix(document.entries[key], f"{where}: {key}")
            if stated[key].shape != unstated.shape:
                rows, columns = unstated.shape
                raise DriveError(f"{where}: {key}: expected {rows} x {columns}; restore the file")
    projection, rectification = stated.values()
    intrinsic = rectified_matrix(info.intrinsic, np.array(info.distortion), projection, where)
    lens = _brown_conrady([], where)
    rectified = replace(info, intrinsic=intrinsic, distortion_model=lens.model, distortion=lens.coefficients)
    turn = rectifying_turn(rectification, f"{where}: rectification_matrix")
    return Intrinsics(check_camera(rectified, where, DriveError), turn)


def _read_rectified_own(document: Document, name: str) -> Intrinsics:
    """Intrinsics in our own calibration, which is of the rectified images themselves."""
    info = _read_own(document, name)
    rectified_matrix(info.intrinsic, np.array(info.distortion), np.zeros((3, 4)), str(document.path))
    turn = read_calibration(document.path).frames.rectified_from_camera
    return Intrinsics(info, np.eye(3) if turn is None else turn)


INTRINSICS: Mapping[str, IntrinsicsFormat] = {
    "COLMAP cameras.txt": IntrinsicsFormat(
        lambda document: any(_COLMAP_LINE.match(line) for _, line in _colmap_lines(document)[:1]),
        _read_colmap,
        lambda document: [line.split()[0] for _, line in _colmap_lines(document)],
    ),
    "Kalibr camchain": IntrinsicsFormat(
        lambda document: bool(_kalibr_names(document)), _read_kalibr, _kalibr_names
    ),
    "V2HDM calibration": IntrinsicsFormat(
        lambda document: isinstance(document.entries.get("camera_matrix"), list),
        _read_own,
        read_rectified=_read_rectified_own,
    ),
    "OpenCV": IntrinsicsFormat(
        lambda document: "dt" in _mapping(document.lower.get("camera_matrix")), _read_opencv
    ),
    "ROS CameraInfo message": IntrinsicsFormat(
        lambda document: {"height", "width", "distortion_model"} <= set(document.entries),
        _read_message,
        _message_names,
        _read_rectified_message,
    ),
    "ROS camera_info": IntrinsicsFormat(
        lambda document: bool({"camera_name", "distortion_model", "camera_matrix"} & set(document.entries)),
        lambda document, name: take_camera_info(document.entries, str(document.path)),
        read_rectified=_read_rectified_file,
    ),
}
"""The formats, by name; the first that accepts a file reads it."""
