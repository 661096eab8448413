"""Quadrilaterals: from a blob's outline to four ordered corners, and the algebra of their sides.

Corners (..., 4, 2) run counter-clockwise on the screen, so their shoelace area in (u, v) is
negative. Side ``e`` runs from corner ``e`` to corner ``e + 1``.
"""

from __future__ import annotations

import cv2
import numpy as np

from v2hdm.records import FloatArray

# Faster than np.roll by far, and there are many of them in the fit of a few markings.
_NEXT, _LAST = np.array([1, 2, 3, 0]), np.array([3, 0, 1, 2])
_TURN = np.array([-1.0, 1.0])


def quad_from_hull(hull: np.ndarray) -> FloatArray | None:
    """The quadrilateral (4, 2) that encloses a convex hull (N, 1, 2) most tightly; None where there is none.

    Sides of the hull are merged until four are left (Low and Ilie, Computer Vision and Graphics, 2003, in
    OpenCV's approxPolyN).
    """
    if len(hull) < 4 or cv2.contourArea(hull) < 1.0:
        return None
    quad = np.asarray(cv2.approxPolyN(hull, 4), dtype=np.float64).reshape(-1, 2)
    if len(quad) != 4 or not np.isfinite(quad).all():
        return None
    return order_corners(quad)


def order_corners(corners: FloatArray) -> FloatArray:
    """Corners (4, 2) of a convex quadrilateral, counter-clockwise on the screen."""
    outward = corners - corners.mean(axis=0)
    return np.asarray(corners[np.argsort(np.arctan2(-outward[:, 1], outward[:, 0]))])


def signed_area(corners: FloatArray) -> FloatArray:
    """Shoelace area (...) of quadrilaterals (..., 4, 2) in (u, v): negative for our order of corners."""
    ahead = following(corners)
    cross = corners[..., 0] * ahead[..., 1] - corners[..., 1] * ahead[..., 0]
    return np.asarray(cross.sum(axis=-1) / 2)


def following(values: np.ndarray, axis: int = -2) -> np.ndarray:
    """Values of four corners or sides, each replaced by that of the next one round the quadrilateral."""
    return np.asarray(values.take(_NEXT, axis=axis))


def preceding(values: np.ndarray, axis: int = -2) -> np.ndarray:
    """Values of four corners or sides, each replaced by that of the one before."""
    return np.asarray(values.take(_LAST, axis=axis))


def side_frames(corners: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Tangent (..., 4, 2), outward normal (..., 4, 2) and length (..., 4) of each side."""
    along = following(corners) - corners
    length = np.hypot(along[..., 0], along[..., 1])
    tangent = along / np.maximum(length, 1e-9)[..., None]
    normal = tangent[..., ::-1] * _TURN
    return tangent, normal, length


def interior_angles(corners: FloatArray) -> FloatArray:
    """Interior angle (..., 4) rad at each corner of convex quadrilaterals (..., 4, 2)."""
    tangent, _, _ = side_frames(corners)
    cosine = -(tangent * preceding(tangent)).sum(axis=-1)
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


def width(corners: FloatArray) -> FloatArray:
    """Mean extent (...) of quadrilaterals (..., 4, 2) across their longest side."""
    _, _, length = side_frames(corners)
    return np.asarray(np.abs(signed_area(corners)) / length.max(axis=-1))


def is_convex(corners: FloatArray) -> np.ndarray:
    """Which quadrilaterals (..., 4, 2) are convex and in our order of corners."""
    tangent, _, _ = side_frames(corners)
    ahead = following(tangent)
    turn = tangent[..., 0] * ahead[..., 1] - tangent[..., 1] * ahead[..., 0]
    return np.asarray((turn < 0).all(axis=-1))


def intersect_sides(point: FloatArray, normal: FloatArray) -> FloatArray:
    """Corners (..., 4, 2) of quadrilaterals whose sides pass through ``point`` (..., 4, 2) with ``normal``.

    Corner ``e`` is where sides ``e - 1`` and ``e`` meet; it is inf or nan where they are parallel.
    """
    distance = (point * normal).sum(axis=-1)
    before, before_distance = preceding(normal), preceding(distance, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = before[..., 0] * normal[..., 1] - before[..., 1] * normal[..., 0]
        u = (before_distance * normal[..., 1] - before[..., 1] * distance) / determinant
        v = (before[..., 0] * distance - before_distance * normal[..., 0]) / determinant
    return np.stack([u, v], axis=-1)


def block_diagonal(blocks: FloatArray) -> FloatArray:
    """(M, 4, 2, 2) blocks to (M, 8, 8)."""
    full = np.zeros((len(blocks), 4, 2, 4, 2))
    for corner in range(4):
        full[:, corner, :, corner] = blocks[:, corner]
    return full.reshape(-1, 8, 8)
