"""The corners that were found of an image's markings, and what their shape on the ground says of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.records import BoolArray, FloatArray

_CLOSURE_TOLERANCE = 0.02
_MAX_CLOSURE_CHI2 = 9.0
_U = np.arange(0, 8, 2)
"""Places of the corners' u in their covariance."""

_CLOSURE = np.array([1.0, -1.0, 1.0, -1.0])


@dataclass
class Corners:
    """Refined corners of M markings: ``px`` (M, 4, 2), ``covariance`` (M, 8, 8), ``valid`` (M, 4).

    ``occluded`` (M,) are those of which a side was found to be the edge of something before the ground.
    """

    px: FloatArray
    covariance: FloatArray
    valid: BoolArray
    occluded: BoolArray

    @classmethod
    def at(cls, px: FloatArray) -> Corners:
        """Those of (M, 4, 2) of which nothing is known yet."""
        count = len(px)
        nowhere, none = np.zeros((count, 4), dtype=np.bool_), np.zeros(count, dtype=np.bool_)
        return cls(px, np.tile(np.eye(8), (count, 1, 1)), nowhere, none)


def is_cut(found: Corners, view: CameraView) -> BoolArray:
    """Markings (M,) whose four valid corners are no parallelogram on the ground, as all are painted.

    An occluder's straight edge or a lost piece of paint gives corners as clean as the true ones; which of
    the four they are cannot be told, so none is used. The tolerance, in parts of the marking's size,
    covers an initial IPM that is some degrees off.
    """
    cut = np.zeros(len(found.px), dtype=np.bool_)
    whole = np.flatnonzero(found.valid.all(axis=1))
    pinhole = view.undistort(found.px[whole].reshape(-1, 2))
    ground = view.ground(pinhole).reshape(-1, 4, 2)
    size_m = np.linalg.norm(ground[:, :2] - ground[:, 2:], axis=-1).mean(axis=1)
    by_corner = _CLOSURE[:, None, None] * view.ground_jacobian(pinhole).reshape(-1, 4, 2, 2)
    jacobian = by_corner.transpose(0, 2, 1, 3).reshape(-1, 2, 8)
    covariance = jacobian @ found.covariance[whole] @ np.swapaxes(jacobian, 1, 2)
    covariance += ((_CLOSURE_TOLERANCE * size_m) ** 2)[:, None, None] * np.eye(2)
    usable = np.asarray(np.isfinite(covariance).all(axis=(1, 2)))
    gap = np.where(usable[:, None], _CLOSURE @ ground, 0.0)[..., None]
    solved = np.linalg.solve(np.where(usable[:, None, None], covariance, np.eye(2)), gap)
    cut[whole] = (gap * solved).sum(axis=(1, 2)) > _MAX_CLOSURE_CHI2
    return cut


def largest_sigma(covariance: FloatArray) -> FloatArray:
    """Standard deviation (M, 4) of each corner in its least certain direction, from (M, 8, 8)."""
    u, v, uv = (covariance[:, _U + row, _U + column] for row, column in ((0, 0), (1, 1), (0, 1)))
    largest = (u + v) / 2 + np.hypot((u - v) / 2, uv)
    return np.asarray(np.sqrt(np.maximum(np.nan_to_num(largest, nan=1e6, posinf=1e6), 0)))


def block_diagonal(blocks: FloatArray) -> FloatArray:
    """(M, 4, 2, 2) blocks to (M, 8, 8)."""
    full = np.zeros((len(blocks), 4, 2, 4, 2))
    for corner in range(4):
        full[:, corner, :, corner] = blocks[:, corner]
    return full.reshape(-1, 8, 8)
