"""What the readers of intrinsics share: the lens by its coefficients, the matrix by its four numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.io.fields import check_camera
from v2hdm.records import DISTORTION_COEFFICIENTS, CameraInfo, FloatArray

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
