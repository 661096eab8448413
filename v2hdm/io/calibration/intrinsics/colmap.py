"""COLMAP: ``cameras.txt``, a line a camera: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[].

COLMAP counts pixels from the corner of the image: the centre of the first is at (0.5, 0.5).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.io.calibration.intrinsics.document import Document
from v2hdm.io.calibration.intrinsics.lenses import brown_conrady, checked, complete, matrix
from v2hdm.io.fields import take_size_px
from v2hdm.records import CameraInfo

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
