"""A calibration file as its text and, where it is YAML, JSON or XML, as entries.

What the readers of intrinsics share: the lens by its coefficients, the matrix by its four numbers.

COLMAP: ``cameras.txt``, a line a camera: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[].

COLMAP counts pixels from the corner of the image: the centre of the first is at (0.5, 0.5).

Kalibr: ``camchain.yaml``, a camera under each of cam0, cam1, ...

OpenCV: what its calibration programs write through ``cv2.FileStorage``, as YAML, JSON or XML.

Our own ``calibration_<camera>.yaml``, for its intrinsics.

ROS: ``camera_info`` files, and messages as ``ros2 topic echo`` writes them.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from v2hdm.errors import DriveError, MapFileError
from v2hdm.io.calibration.camera_info import take_camera_info, take_matrix
from v2hdm.io.calibration.document import read_calibration
from v2hdm.io.importers.bag.streams import info_of
from v2hdm.io.safe.fields import check_camera, take_size_px
from v2hdm.io.safe.texts import parse_json, parse_yaml, read_text
from v2hdm.records import DISTORTION_COEFFICIENTS, CameraInfo, FloatArray
from v2hdm.store.files import take_array, take_text


@dataclass(frozen=True)
class Document:
    """One calibration file: its ``text``, and the ``entries`` at its top, none where it is plain text."""

    path: Path
    text: str
    entries: dict[str, Any]


_XML = re.compile(r"<[?!\w]")
"""How XML begins; YAML may begin with ``<<``."""

_END_OF_MESSAGE = re.compile(r"\n---\s*$")
"""What ``ros2 topic echo`` writes ends with a second, empty document."""


def read_document(path: Path) -> Document:
    """Read the file at ``path``.

    Raises:
        DriveError: it is missing, no text, or damaged.
    """
    if path.is_dir():
        raise DriveError(f"{path}: is a folder; name the calibration file in it")
    text = read_text(path, DriveError)
    start = text.lstrip("\ufeff \t\r\n")
    if _XML.match(start):
        return Document(path, text, _of_xml(path, start))
    if start.startswith("{"):
        return Document(path, text, _of_json(path, start))
    if path.suffix.lower() == ".txt" or not start:
        return Document(path, text, {})
    return Document(path, text, _of_yaml(path, start))


def _of_yaml(path: Path, text: str) -> dict[str, Any]:
    # OpenCV 4 begins its files with a directive that YAML 1.1 refuses; its tag says no more than the keys.
    plain = text.removeprefix("%YAML:1.0").replace("!!opencv-matrix", "")
    content = parse_yaml(_END_OF_MESSAGE.sub("\n", plain), str(path), DriveError)
    return content if isinstance(content, dict) else {}


def _of_json(path: Path, text: str) -> dict[str, Any]:
    content = parse_json(text, str(path), DriveError)
    return content if isinstance(content, dict) else {}


def _of_xml(path: Path, text: str) -> dict[str, Any]:
    if "<!" in text.replace("<!--", ""):
        raise DriveError(f"{path}: holds XML declarations, which no calibration has; restore the file")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as failure:
        raise DriveError(f"{path}: line {failure.position[0]}: XML syntax error; restore the file") from None
    if root.tag != "opencv_storage":
        raise DriveError(f"{path}: expected OpenCV's <opencv_storage>, got <{root.tag}>; name another file")
    return {node.tag: _xml_value(node) for node in root}


def _xml_value(node: ET.Element) -> object:
    if node.get("type_id") == "opencv-matrix":
        entry: dict[str, object] = {child.tag: _scalar(child.text) for child in node}
        entry["data"] = [_scalar(word) for word in (node.findtext("data") or "").split()]
        return entry
    return _scalar(node.text)


def _scalar(text: str | None) -> object:
    """A number where it is one, else the text without the quotes that OpenCV puts around it."""
    words = (text or "").strip()
    try:
        return float(words)
    except ValueError:
        return words.strip('"')


BROWN_CONRADY = {4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}
"""OpenCV's lens models by their number of coefficients."""


def brown_conrady(coefficients: Sequence[float], where: str) -> tuple[str, tuple[float, ...]]:
    """Our model for OpenCV's coefficients k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]].

    Raises:
        DriveError: a thin prism or a tilted sensor, or another number of coefficients.
    """
    values = list(coefficients)
    for count, lens in ((14, "tilted sensor"), (12, "thin prism")):
        first = {14: 12, 12: 8}[count]
        if len(values) != count:
            continue
        if any(values[first:]):
            raise DriveError(
                f"{where}: a {lens} ({count} coefficients) is beyond our lens models; calibrate again with "
                "5 or 8 coefficients"
            )
        values = values[:first]
    if not values:
        values = [0.0] * 5
    if len(values) not in BROWN_CONRADY:
        raise DriveError(f"{where}: {len(values)} distortion coefficients; expected 4, 5 or 8")
    model = BROWN_CONRADY[len(values)]
    return model, complete(model, values)


def complete(model: str, coefficients: Sequence[float]) -> tuple[float, ...]:
    """All coefficients of ``model``; those that are not given are zero."""
    missing = DISTORTION_COEFFICIENTS[model] - len(coefficients)
    return (*map(float, coefficients), *(0.0,) * missing)


def matrix(fx: float, fy: float, cx: float, cy: float) -> FloatArray:
    """K (3, 3) of focal lengths and principal point, px."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def checked(info: CameraInfo, where: str) -> CameraInfo:
    """``info`` itself.

    Raises:
        DriveError: its matrix is none, or its lens cannot be undone within the image.
    """
    check_camera(info, where, DriveError)
    return info


_CORNER_PX = 0.5
"""COLMAP's coordinate of the first pixel's centre, which is 0 with us."""

_LINE = re.compile(r"^\d+\s+[A-Z][A-Z0-9_]+\s+\d+\s+\d+(\s|$)")


@dataclass(frozen=True)
class _Model:
    """A lens model of COLMAP's.

    Attributes:
        focals: number of focal lengths, before the principal point.
        coefficients: number of coefficients, after it.
        lens: our model and its coefficients.
    """

    focals: int
    coefficients: int
    lens: Callable[[Sequence[float]], tuple[str, tuple[float, ...]]]


def _polynomial(coefficients: Sequence[float]) -> tuple[str, tuple[float, ...]]:
    """Radial coefficients, of which the first two come before the tangential ones of OpenCV."""
    return "plumb_bob", complete("plumb_bob", coefficients)


def _opencv(coefficients: Sequence[float]) -> tuple[str, tuple[float, ...]]:
    return brown_conrady(coefficients, "COLMAP")


def _equidistant(coefficients: Sequence[float]) -> tuple[str, tuple[float, ...]]:
    return "equidistant", complete("equidistant", coefficients)


COLMAP_MODELS: Mapping[str, _Model] = {
    "SIMPLE_PINHOLE": _Model(1, 0, _polynomial),
    "PINHOLE": _Model(2, 0, _polynomial),
    "SIMPLE_RADIAL": _Model(1, 1, _polynomial),
    "RADIAL": _Model(1, 2, _polynomial),
    "OPENCV": _Model(2, 4, _opencv),
    "FULL_OPENCV": _Model(2, 8, _opencv),
    "OPENCV_FISHEYE": _Model(2, 4, _equidistant),
    "SIMPLE_RADIAL_FISHEYE": _Model(1, 1, _equidistant),
    "RADIAL_FISHEYE": _Model(1, 2, _equidistant),
}
"""COLMAP's models that are lenses of ours."""


def is_colmap(document: Document) -> bool:
    """Whether the first line with data is that of a camera."""
    lines = _lines(document)
    return bool(lines) and bool(_LINE.match(lines[0][1]))


def colmap_names(document: Document) -> list[str]:
    """The cameras by their numbers."""
    return [line.split()[0] for _, line in _lines(document)]


def read_colmap(document: Document, name: str) -> CameraInfo:
    """The intrinsics of the camera of the number ``name``.

    Raises:
        DriveError: its line is damaged, or its lens none of ours.
    """
    number, line = next(one for one in _lines(document) if one[1].split()[0] == name)
    where = f"{document.path}: line {number}"
    if not _LINE.match(line):
        raise DriveError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS; restore the file")
    _, kind, width, height, *words = line.split()
    model = COLMAP_MODELS.get(kind)
    if model is None:
        raise DriveError(
            f"{where}: COLMAP's {kind} is beyond our lens models; calibrate with one of: "
            f"{', '.join(COLMAP_MODELS)}"
        )
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.array([np.nan])
    expected = model.focals + 2 + model.coefficients
    if len(values) != expected or not np.isfinite(values).all():
        raise DriveError(f"{where}: {kind} has {expected} parameters; restore the file")
    fx, fy = values[0], values[model.focals - 1]
    cx, cy = values[model.focals : model.focals + 2] - _CORNER_PX
    return checked(
        CameraInfo(
            name,
            take_size_px(int(width), f"{where}: WIDTH", DriveError),
            take_size_px(int(height), f"{where}: HEIGHT", DriveError),
            matrix(fx, fy, cx, cy),
            *model.lens(values[model.focals + 2 :].tolist()),
        ),
        where,
    )


def _lines(document: Document) -> list[tuple[int, str]]:
    """The lines with data, by their numbers."""
    lines = ((number, line.strip()) for number, line in enumerate(document.text.splitlines(), 1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


_MODELS = {"omni": "omnidirectional (omni)", "ds": "double sphere (ds)", "eucm": "extended unified (eucm)"}
"""Projections of Kalibr's that are none of ours."""

_EQUIDISTANT = ("equidistant", "equi")
_NEEDED = ("camera_model", "intrinsics", "distortion_model", "resolution")


def is_kalibr(document: Document) -> bool:
    """Whether some entry at the top of the file is a camera of Kalibr's."""
    return bool(kalibr_names(document))


def kalibr_names(document: Document) -> list[str]:
    """The cameras of the chain."""
    return [
        str(name)
        for name, entry in document.entries.items()
        if isinstance(entry, dict) and {"camera_model", "intrinsics"} & set(entry)
    ]


def read_kalibr(document: Document, name: str) -> CameraInfo:
    """The intrinsics of one camera of the chain.

    Raises:
        DriveError: an entry is missing or damaged, or the lens is none of ours.
    """
    where, entry = f"{document.path}: {name}", document.entries[name]
    for key in _NEEDED:
        if key not in entry:
            raise DriveError(f"{where}: missing key '{key}'; take the camchain that Kalibr wrote")
    projection = take_text(entry["camera_model"], f"{where}, camera_model", DriveError)
    if projection != "pinhole":
        raise DriveError(
            f"{where}: its lens is {_MODELS.get(projection, repr(projection))}, which is beyond our models; "
            "calibrate with pinhole-radtan or pinhole-equi"
        )
    model = take_text(entry["distortion_model"], f"{where}, distortion_model", DriveError)
    given = entry.get("distortion_coeffs")
    values: list[float] = []
    if given not in (None, []):
        values = take_array(given, (-1,), f"{where}, distortion_coeffs", DriveError).tolist()
    if model in _EQUIDISTANT:
        if len(values) != 4:
            raise DriveError(f"{where}, distortion_coeffs: {model} has 4 coefficients, got {len(values)}")
        lens = ("equidistant", complete("equidistant", values))
    elif model in ("radtan", "none"):
        lens = brown_conrady([] if model == "none" else values, f"{where}, distortion_coeffs")
    else:
        raise DriveError(
            f"{where}: its lens is '{model}', which is beyond our models; calibrate with pinhole-radtan or "
            "pinhole-equi"
        )
    size = take_array(entry["resolution"], (2,), f"{where}, resolution", DriveError)
    width, height = (take_size_px(value, f"{where}, resolution", DriveError) for value in size.tolist())
    numbers = take_array(entry["intrinsics"], (4,), f"{where}, intrinsics", DriveError)
    return checked(CameraInfo(name, width, height, matrix(*numbers.tolist()), *lens), where)


def is_opencv(document: Document) -> bool:
    """Whether the camera matrix in the file is one of OpenCV's."""
    entry = _lower(document).get("camera_matrix")
    return isinstance(entry, dict) and "dt" in entry


def opencv_names(document: Document) -> list[str]:
    """Its only camera; OpenCV names none, so that the file's name is taken."""
    return [str(document.entries.get("camera_name", document.path.stem))]


def read_opencv(document: Document, name: str) -> CameraInfo:
    """The intrinsics in the file.

    Raises:
        DriveError: an entry is missing or damaged, or the lens is none of ours.
    """
    where, entries = str(document.path), _lower(document)
    if "xi" in entries:
        raise DriveError(
            f"{where}: its lens is omnidirectional (xi), which is beyond our models; calibrate with "
            "cv2.calibrateCamera or cv2.fisheye.calibrate"
        )
    if "distortion_coefficients" not in entries:
        raise DriveError(
            f"{where}: missing key 'distortion_coefficients'; add it, zeros for a pinhole camera"
        )
    for key in ("image_width", "image_height"):
        if key not in entries:
            raise DriveError(f"{where}: missing key '{key}'; add the size of the images it was made from")
    intrinsic = take_matrix(entries["camera_matrix"], f"{where}: camera_matrix")
    if intrinsic.shape != (3, 3):
        raise DriveError(f"{where}: camera_matrix: expected 3 x 3; restore the file")
    at = f"{where}: distortion_coefficients"
    values = take_matrix(entries["distortion_coefficients"], at).ravel().tolist()
    if entries.get("fisheye_model") or entries.get("distortion_model") == "equidistant":
        if len(values) != 4:
            raise DriveError(
                f"{at}: OpenCV's fisheye has 4 coefficients, got {len(values)}; restore the file"
            )
        lens = ("equidistant", complete("equidistant", values))
    else:
        lens = brown_conrady(values, at)
    width, height = (
        take_size_px(entries[key], f"{where}: {key}", DriveError) for key in ("image_width", "image_height")
    )
    return checked(CameraInfo(name, width, height, intrinsic, *lens), where)


def _lower(document: Document) -> dict[str, Any]:
    """The entries by their names in small letters: OpenCV 2 wrote Camera_Matrix and image_Width."""
    return {str(key).lower(): value for key, value in document.entries.items()}


def is_own(document: Document) -> bool:
    """Whether the file is one that :func:`v2hdm.io.maps.write_calibration` wrote."""
    return isinstance(document.entries.get("camera_matrix"), list)


def names_of_own(document: Document) -> list[str]:
    """Its only camera."""
    return [str(document.entries.get("camera_name", document.path.stem))]


def read_own(document: Document, name: str) -> CameraInfo:
    """The intrinsics of our calibration."""
    try:
        info = read_calibration(document.path).info
    except MapFileError as error:
        raise DriveError(str(error)) from None
    if len(info.distortion) != DISTORTION_COEFFICIENTS.get(info.distortion_model):
        raise DriveError(
            f"{document.path}: {info.distortion_model} with {len(info.distortion)} coefficients is no lens "
            f"of ours; known are {', '.join(DISTORTION_COEFFICIENTS)}"
        )
    return info


def is_message(document: Document) -> bool:
    """Whether the file holds a ``CameraInfo`` message."""
    return {"height", "width", "distortion_model"} <= set(document.entries)


def names_of_message(document: Document) -> list[str]:
    """Its only camera, by the frame of its header."""
    header = document.entries.get("header")
    frame = header.get("frame_id") if isinstance(header, dict) else None
    return [str(frame or document.path.stem)]


def read_message(document: Document, name: str) -> CameraInfo:
    """The intrinsics of a ``CameraInfo`` message."""
    where, content = str(document.path), document.entries
    lower = {key.lower(): value for key, value in content.items() if isinstance(key, str)}
    for key in ("k", "d"):
        if key not in lower:
            raise DriveError(f"{where}: missing key '{key}'; write the message to the file again")
    region = lower.get("roi")
    fields = SimpleNamespace(
        k=take_array(lower["k"], (9,), f"{where}: k", DriveError),
        d=take_array(lower["d"], (-1,), f"{where}: d", DriveError) if lower["d"] else np.empty(0),
        distortion_model=take_text(lower["distortion_model"], f"{where}: distortion_model", DriveError),
        width=take_size_px(lower["width"], f"{where}: width", DriveError),
        height=take_size_px(lower["height"], f"{where}: height", DriveError),
        binning_x=lower.get("binning_x") or 0,
        binning_y=lower.get("binning_y") or 0,
        roi=SimpleNamespace(
            **{key: region.get(key, 0) if isinstance(region, dict) else 0 for key in ("width", "height")}
        ),
    )
    return info_of(fields, name, where)


def is_camera_info(document: Document) -> bool:
    """Whether the file is one of ``camera_calibration_parsers``."""
    return bool({"camera_name", "distortion_model", "camera_matrix"} & set(document.entries))


def names_of_camera_info(document: Document) -> list[str]:
    """Its only camera."""
    return [str(document.entries.get("camera_name", document.path.stem))]


def read_camera_info_file(document: Document, name: str) -> CameraInfo:
    """The intrinsics of a ``camera_info`` file."""
    return take_camera_info(document.entries, str(document.path))


@dataclass(frozen=True)
class IntrinsicsFormat:
    """One format: ``accepts`` a file by a look at it, ``names`` its cameras, ``read`` one of them."""

    accepts: Callable[[Document], bool]
    names: Callable[[Document], list[str]]
    read: Callable[[Document, str], CameraInfo]


INTRINSICS: Mapping[str, IntrinsicsFormat] = {
    "COLMAP cameras.txt": IntrinsicsFormat(is_colmap, colmap_names, read_colmap),
    "Kalibr camchain": IntrinsicsFormat(is_kalibr, kalibr_names, read_kalibr),
    "V2HDM calibration": IntrinsicsFormat(is_own, names_of_own, read_own),
    "OpenCV": IntrinsicsFormat(is_opencv, opencv_names, read_opencv),
    "ROS CameraInfo message": IntrinsicsFormat(is_message, names_of_message, read_message),
    "ROS camera_info": IntrinsicsFormat(is_camera_info, names_of_camera_info, read_camera_info_file),
}
"""The formats, by name; the first that accepts a file reads it."""


def read_intrinsics(path: Path, camera: str | None = None, name_by: str = "its name") -> CameraInfo:
    """The intrinsics of one camera, from a file of any format of :data:`INTRINSICS`.

    Args:
        path: the file.
        camera: which of its cameras; needed where it holds several.
        name_by: how the user names it, for errors.

    Raises:
        DriveError: the file is missing, damaged or of no known format, the camera is not in it or is not
            named among several, or its lens is beyond ours.
    """
    if path.suffix.lower() == ".bin":
        raise DriveError(
            f"{path}: is binary; write COLMAP's model as text (model_converter --output_type TXT)"
        )
    document = read_document(path)
    chosen = next((one for one in INTRINSICS.values() if one.accepts(document)), None)
    if chosen is None:
        raise DriveError(f"{path}: no intrinsics of a known format ({', '.join(INTRINSICS)}) in this file")
    names = chosen.names(document)
    if camera is None and len(names) > 1:
        raise DriveError(f"{path}: holds the cameras {', '.join(names)}; name one by {name_by}")
    if camera is not None and camera not in names:
        raise DriveError(f"{path}: no camera '{camera}' in this file; it holds: {', '.join(names)}")
    return chosen.read(document, names[0] if camera is None else camera)


def is_calibration(path: Path) -> bool:
    """Whether the file is a calibration of ours, which says where the camera sits, too.

    Raises:
        DriveError: the file is missing or damaged.
    """
    return is_own(read_document(path))
