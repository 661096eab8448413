"""Where the lanes of the rendered crossing end by their paint: a line of dashes ends with its last dash."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from examples.lanes.site import WIDTH_M
from tests.topology.scenes import LANES
from v2hdm.records import FloatArray

_BESIDE_M = 0.3  # distance, m, of paint from where a lane's border truly runs: half a line and a taper
_REACH_M = 6.0  # a line of dashes may end this far, m, before its line: a dash and a gap

Place = tuple[float, float]
Pair = tuple[Place, Place]


def painted(pairs: set[Pair], paint: Sequence[FloatArray]) -> set[Pair]:
    """The pairs of ends of lanes, each moved into its lane to where both of its sides are painted."""
    inward = _inward()
    return {
        (_moved(first, inward[first], paint), _moved(second, inward[second], paint))
        for first, second in pairs
    }


def _inward() -> dict[Place, FloatArray]:
    """The direction (2,) from each end of a true lane into the lane, along the axis that it follows there."""
    directions = {}
    for start, end in LANES:
        way = np.subtract(end, start)
        axis = int(np.argmax(np.abs(way)))
        ahead = np.sign(way[axis]) * np.eye(2)[axis]
        directions[start] = ahead
        directions[end] = -ahead
    return directions


def _moved(place: Place, inward: FloatArray, paint: Sequence[FloatArray]) -> Place:
    """A lane's end, moved to where paint begins on both of its sides; it stays where paint runs past it."""
    left = np.array([-inward[1], inward[0]])
    missing_m = [0.0]
    for side in (-1, 1):
        begins_m = []
        for corners in paint:
            along_m = (corners - place) @ inward
            across_m = (corners - place) @ left
            is_border = np.abs(across_m - side * WIDTH_M / 2).max() < _BESIDE_M
            if is_border and along_m.max() > 0 and along_m.min() < _REACH_M:
                begins_m.append(max(float(along_m.min()), 0.0))
        missing_m.append(min(begins_m, default=0.0))
    x, y = (place + max(missing_m) * inward).tolist()
    return x, y
