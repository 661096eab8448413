"""What a fit has found: its sides, how sure it is of them, and the corners that follow.

Sides are what an image shows. A corner is where two of them meet, so that its covariance follows from theirs:
where the end of a side is vague, the corner may lie far along it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.markings.frames import StraightFrames
from v2hdm.geometry.quadrilateral import preceding, side_frames
from v2hdm.records import BoolArray, FloatArray

_LEAST_SINE = 1e-3
"""Of the angle of two sides that meet; parallel ones meet nowhere."""

_TILT_SHARE = 0.5
"""A side that is off as a whole is askew by this share of that."""

_CORNER = np.arange(4)
_END = 4 + (_CORNER - 1) % 4
"""Each corner is the start of its own side and the end of the one before, in this place among the moves."""


@dataclass(frozen=True)
class Fit:
    """M quadrilaterals ``corners`` (M, 4, 2) in their ``frames``.

    ``side_covariance`` (M, 8, 8), px^2, is that of the moves of the sides' starts and ends along their
    outward normals. ``statistics`` (M, len(STATISTICS)) say how well the model explains the pixels.
    ``open_sides`` (M, 4) are those cut by the image's border.
    """

    frames: StraightFrames
    corners: FloatArray
    side_covariance: FloatArray
    statistics: FloatArray
    open_sides: BoolArray

    def in_image(self, side_sigma_px: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Corners (M, 4, 2), recorded px, and their covariance (M, 8, 8), px^2.

        Args:
            side_sigma_px: (M, 4) how far each side as a whole may be off besides, for reasons that residuals
                do not show, px.
        """
        by_side = self.side_covariance
        if side_sigma_px is not None:
            by_side = by_side + _whole_sides(side_sigma_px)
        jacobian = corner_from_side(self.corners)
        covariance = jacobian @ by_side @ jacobian.swapaxes(1, 2) + _second_order(self.corners, by_side)
        return self.frames.to_image(self.corners, covariance)

    def side_variance(self) -> FloatArray:
        """Variance (M, 4), px^2, of the place of each side's middle along its normal."""
        start, end = self.side_covariance[:, _CORNER], self.side_covariance[:, _CORNER + 4]
        own = start[:, _CORNER, _CORNER] + end[:, _CORNER, _CORNER + 4] + 2 * start[:, _CORNER, _CORNER + 4]
        return np.asarray(own / 4)


def corner_from_side(corners: FloatArray) -> FloatArray:
    """Moves (M, 8) of the sides' starts and ends along their normals to moves (M, 8) of the corners."""
    tangent, _, _ = side_frames(corners)
    before = preceding(tangent)
    determinant = before[..., 0] * tangent[..., 1] - before[..., 1] * tangent[..., 0]
    determinant = np.where(np.abs(determinant) < _LEAST_SINE, -_LEAST_SINE, determinant)[..., None]
    jacobian = np.zeros((len(corners), 4, 2, 8))
    # Each lies along the other's line.
    jacobian[:, _CORNER, :, _CORNER] = (-before / determinant).swapaxes(0, 1)
    jacobian[:, _CORNER, :, _END] = (tangent / determinant).swapaxes(0, 1)
    return jacobian.reshape(-1, 8, 8)


def _second_order(corners: FloatArray, by_side: FloatArray) -> FloatArray:
    """What the error of a side's direction adds where its end is vague: (M, 8, 8), px^2.

    A corner that may lie far along a side is off across it by its way times the error of the side's
    direction.
    """
    _, normal, length = side_frames(corners)
    start, end = by_side[:, _CORNER, _CORNER], by_side[:, _CORNER + 4, _CORNER + 4]
    both = by_side[:, _CORNER, _CORNER + 4]
    tilt = np.maximum(start + end - 2 * both, 0) / np.maximum(length, 1.0) ** 2
    out = np.zeros((len(corners), 4, 2, 4, 2))
    # Corner c runs along side c if the end of side c - 1 is vague, and along side c - 1 if the start of c is.
    for of, slack in ((_CORNER, np.roll(end, 1, axis=1)), (_CORNER - 1, start)):
        variance = tilt[:, of] * slack
        outer = normal[:, of, :, None] * normal[:, of, None, :]
        out[:, _CORNER, :, _CORNER] += (variance[..., None, None] * outer).swapaxes(0, 1)
    return out.reshape(-1, 8, 8)


def _whole_sides(sigma_px: FloatArray) -> FloatArray:
    """Covariance (M, 8, 8) of starts and ends of sides that are off as a whole by ``sigma_px`` (M, 4)."""
    pattern = np.kron([[1.0, 1.0], [1.0, 1.0]], np.eye(4)) + _TILT_SHARE**2 * np.kron(
        [[1.0, -1.0], [-1.0, 1.0]], np.eye(4)
    )
    sigma = np.tile(sigma_px, 2)
    return np.asarray(sigma[:, :, None] * pattern * sigma[:, None, :])
