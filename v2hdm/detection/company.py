"""Evidence on a marking by the others of its image: how many are like it, and whether it lies in a line.

A site's markings are painted from few stencils: the diamonds of a field are of one size and lie one way,
dashes are as long as each other and follow one another in a row, or an arc where the way bends.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import Quad, cross
from v2hdm.records import DIAMOND, LANE_DASH, STOP_LINE, BoolArray, FloatArray

COMPANY = ("alike", "most_alike", "unlike", "surest_other", "in_line")
"""Names of the columns of :func:`company`, in order.

Of the others of its class, weighed by their probability: how many are like it, how much so is the likest, how
many are not, and how probable is the surest. Of dashes also: how probable is the surest one that follows in
its line after a gap; 0 for other classes.
"""

LEAST_SIZE_M = 0.01  # lengths and widths of markings on the ground are clipped from below at this, m
MOST_SIZE_M = 100.0  # lengths and widths on the ground are clipped from above at this, m

_MOST = 3.0  # more company than this many markings adds nothing
_APART_M = 0.3  # quadrilaterals whose middles are nearer than this are readings of the same paint, m

_LOG_SIZE_SIGMA = 0.2  # standard deviation of the log sizes of one stencil's markings, in a single image
_DIRECTION_SIGMA = 0.15  # standard deviation of the directions of one stencil's markings, rad
_BEND_RADIUS_M = 20.0  # radius of a bend, m, by whose angle markings of one stencil may be turned besides

_LEAST_GAP = 0.5  # least gap between the dashes of a line, in lengths of a dash
_LONGEST_GAP_M = 15.0  # longest gap between the dashes of a line, m
_BESIDE_M = 0.3  # how far beside an arc between them a line's dashes are at most, m
_BESIDE_SHARE = 0.02  # how much farther beside the arc they may be, in parts of their distance
_TURNED_RAD = 0.15  # largest difference in direction between a line's dashes where the way is straight, rad
_SHARPEST_RADIUS_M = 12.0  # radius of the sharpest bend, m, by whose angle dashes may be turned besides
_MOST_TURNED_RAD = 0.9  # largest difference in direction between a line's dashes anywhere, rad


def company(ground: FloatArray, kinds: Sequence[str], probability: FloatArray) -> FloatArray:
    """The :data:`COMPANY` (M, 5) of quadrilaterals.

    ``ground`` (M, 4, 2) are corners, m, NaN above the horizon, ``probability`` (M,) is that of each one's
    being a marking, as far as it shows on its own.
    """
    kind = np.array(kinds)
    extents = _Extents.of(ground, kind)
    axis = extents.axis
    offset = extents.centre[None] - extents.centre[:, None]
    distance = np.hypot(offset[..., 0], offset[..., 1])
    weight = np.where((kind[:, None] == kind) & (distance > _APART_M), probability, 0.0)
    # The bars of a crosswalk are many and alike, a stop line keeps no company.
    weight[kind == STOP_LINE] = 0.0
    log_size = np.log(extents.size)
    misfit = ((log_size[:, None] - log_size) ** 2).sum(axis=2) / _LOG_SIZE_SIGMA**2
    # Of axes that have no sense of direction.
    turned = np.arccos(np.clip(np.abs(axis @ axis.T), 0.0, 1.0))
    may_turn = np.hypot(_DIRECTION_SIGMA, distance / _BEND_RADIUS_M)
    alike = weight * np.exp(-0.5 * (misfit + (turned / may_turn) ** 2))
    in_line = (kind == LANE_DASH)[:, None] & _follows(offset, axis, extents.size[:, 1], turned)
    columns = (
        np.minimum(alike.sum(axis=1), _MOST),
        alike.max(axis=1, initial=0.0),
        np.minimum((weight - alike).sum(axis=1), _MOST),
        weight.max(axis=1, initial=0.0),
        np.where(in_line, weight, 0.0).max(axis=1, initial=0.0),
    )
    return np.column_stack(columns)


class _Extents(NamedTuple):
    """How large M quadrilaterals are on the ground, and how they lie; of diamonds it is their diagonals."""

    size: FloatArray  # (M, 2) short and long extent, m
    axis: FloatArray  # (M, 2) unit direction of the longer one
    centre: FloatArray  # (M, 2) m

    @classmethod
    def of(cls, ground: FloatArray, kind: np.ndarray) -> _Extents:
        """From corners (M, 4, 2), m, NaN above the horizon, and classes (M,)."""
        ground = np.nan_to_num(ground)
        diagonals = ground[:, [2, 3]] - ground[:, [0, 1]]
        quad = Quad(ground)
        along = quad.tangent * quad.length[..., None]
        sides = along[:, :2] - along[:, 2:]
        extents = np.where((kind == DIAMOND)[:, None, None], diagonals, sides / 2)
        size = np.hypot(extents[..., 0], extents[..., 1])
        longer = extents[np.arange(len(extents)), size.argmax(axis=1)]
        axis = longer / np.maximum(size.max(axis=1), 1e-9)[:, None]
        return cls(np.clip(np.sort(size, axis=1), LEAST_SIZE_M, MOST_SIZE_M), axis, ground.mean(axis=1))


def _follows(offset: FloatArray, axis: FloatArray, length: FloatArray, turned: FloatArray) -> BoolArray:
    """Which (M, M) follow each along an arc: its chord makes equal and opposite angles with both tangents.

    ``offset`` (M, M, 2) leads from each centre to the others, ``axis`` (M, 2) are directions, ``length`` (M,)
    the long extents and ``turned`` (M, M), rad, the angles between directions.
    """
    distance = np.hypot(offset[..., 0], offset[..., 1])
    beside = 0.5 * distance * np.abs(_angle(axis[:, None], offset) + _angle(axis[None], offset))
    gap = distance - (length[:, None] + length) / 2
    sharpest = np.minimum(_TURNED_RAD + distance / _SHARPEST_RADIUS_M, _MOST_TURNED_RAD)
    on_arc = (beside < _BESIDE_M + _BESIDE_SHARE * distance) & (turned < sharpest)
    return np.asarray(on_arc & (gap >= _LEAST_GAP * length[:, None]) & (gap < _LONGEST_GAP_M))


def _angle(axis: FloatArray, chord: FloatArray) -> FloatArray:
    """From axes of no sense of direction to chords (..., 2), rad, at most a right angle either way."""
    along = (axis * chord).sum(axis=-1)
    return np.asarray(np.arctan2(cross(axis, chord) * np.where(along < 0, -1.0, 1.0), np.abs(along)))
