"""What the other quadrilaterals of an image say of one.

A site's markings are painted from few stencils: the diamonds of a field are of one size and lie one way, the
dashes of a line are as long as each other and follow one another in a row. Where the way bends, directions
turn with it, by an angle that grows with the distance, and a row is an arc. Flecks of sun do nothing of the
kind.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v2hdm.geometry.quadrilateral import side_frames
from v2hdm.records import DIAMOND, LANE_DASH, FloatArray

COMPANY = ("alike", "most_alike", "unlike", "surest_other", "in_line")
"""Names of the columns of :func:`company`, in order.

Of the others of its class, weighed by their probability: how many are like it, how much so is the likest, how
many are not, and how probable is the surest. Of dashes also: how probable is the surest one that follows in
its line after a gap; 0 for other classes.
"""

_LOG_SIZE_SIGMA = 0.2
_DIRECTION_SIGMA = 0.15
"""Markings of one stencil, as a single image shows them, differ by so much in log size and by so many rad."""

_BEND_RADIUS_M = 20.0
"""And by the angle that a bend of this radius turns by between them."""

_MOST = 3.0
"""More company than this adds nothing."""

_APART_M = 0.3
"""What is nearer is another reading of the same paint."""

_LEAST_GAP = 0.5
_LONGEST_GAP_M = 15.0
"""Dashes of a line are at least so many times their own length apart, and at most so far."""

_BESIDE_M = 0.3
_BESIDE_SHARE = 0.02
"""A line's dashes are so far at most beside an arc between them, and so much of their distance."""

_TURNED_RAD = 0.15
_SHARPEST_RADIUS_M = 12.0
_MOST_TURNED_RAD = 0.9
"""They differ by so much in direction at most, where the way is straight, where it bends, and altogether."""


def company(ground: FloatArray, kinds: Sequence[str], probability: FloatArray) -> FloatArray:
    """The :data:`COMPANY` (M, 5) of quadrilaterals.

    Args:
        ground: corners (M, 4, 2) on the ground, m; NaN above the horizon.
        kinds: their classes.
        probability: (M,) of each one's being a marking, as far as it shows on its own.
    """
    kind = np.array(kinds)
    size, axis, centre = _shapes(ground, kind)
    apart = centre[None] - centre[:, None]
    same = (kind[:, None] == kind) & (np.hypot(apart[..., 0], apart[..., 1]) > _APART_M)
    weight = np.where(same, probability, 0.0)
    log_size = np.log(size)
    misfit = ((log_size[:, None] - log_size) ** 2).sum(axis=2) / _LOG_SIZE_SIGMA**2
    turned = _turned(axis)
    may_turn = np.hypot(_DIRECTION_SIGMA, np.hypot(apart[..., 0], apart[..., 1]) / _BEND_RADIUS_M)
    alike = weight * np.exp(-0.5 * (misfit + (turned / may_turn) ** 2))
    in_line = (kind == LANE_DASH)[:, None] & _follows(apart, axis, size[:, 1], turned)
    columns = (
        np.minimum(alike.sum(axis=1), _MOST),
        alike.max(axis=1, initial=0.0),
        np.minimum((weight - alike).sum(axis=1), _MOST),
        weight.max(axis=1, initial=0.0),
        np.where(in_line, weight, 0.0).max(axis=1, initial=0.0),
    )
    return np.column_stack(columns)


def _shapes(ground: FloatArray, kind: np.ndarray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Short and long extent (M, 2), m, direction (M, 2) of the longer, and centre (M, 2).

    Diamonds extend along their diagonals, everything else along its sides.
    """
    ground = np.nan_to_num(ground)
    diagonals = ground[:, [2, 3]] - ground[:, [0, 1]]
    tangent, _, length = side_frames(ground)
    sides = (tangent * length[..., None])[:, :2] - (tangent * length[..., None])[:, 2:]
    extents = np.where((kind == DIAMOND)[:, None, None], diagonals, sides / 2)
    size = np.hypot(extents[..., 0], extents[..., 1])
    longer = extents[np.arange(len(extents)), size.argmax(axis=1)]
    axis = longer / np.maximum(size.max(axis=1), 1e-9)[:, None]
    return np.clip(np.sort(size, axis=1), 0.01, 100.0), axis, ground.mean(axis=1)


def _turned(axis: FloatArray) -> FloatArray:
    """Angle (M, M), rad, between axes (M, 2) of no sense of direction."""
    return np.asarray(np.arccos(np.clip(np.abs(axis @ axis.T), 0.0, 1.0)))


def _follows(apart: FloatArray, axis: FloatArray, length: FloatArray, turned: FloatArray) -> np.ndarray:
    """Which (M, M) others follow each along an arc, after a gap.

    The chord between two points of a circle makes equal and opposite angles with the tangents there.
    """
    distance = np.hypot(apart[..., 0], apart[..., 1])
    beside = 0.5 * distance * np.abs(_angle(axis[:, None], apart) + _angle(axis[None], apart))
    gap = distance - (length[:, None] + length) / 2
    sharpest = np.minimum(_TURNED_RAD + distance / _SHARPEST_RADIUS_M, _MOST_TURNED_RAD)
    on_arc = (beside < _BESIDE_M + _BESIDE_SHARE * distance) & (turned < sharpest)
    return np.asarray(on_arc & (gap >= _LEAST_GAP * length[:, None]) & (gap < _LONGEST_GAP_M))


def _angle(axis: FloatArray, chord: FloatArray) -> FloatArray:
    """From axes of no sense of direction to chords (..., 2), rad, at most a right angle either way."""
    across = axis[..., 0] * chord[..., 1] - axis[..., 1] * chord[..., 0]
    along = (axis * chord).sum(axis=-1)
    return np.asarray(np.arctan2(across * np.where(along < 0, -1.0, 1.0), np.abs(along)))
