"""Paint rolled by the metre: a port of whose dashes some are of another length than the rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.benchmarks.made.draw import Recipe
from tests.benchmarks.made.world import World, make
from v2hdm.records import LANE_DASH, FloatArray

_SHORT_SHARE = 0.75  # length of a short dash over that of the others, as a piece that a box leaves in view
_PERIOD = 4  # every fourth dash is short


def make_lengths(recipe: Recipe) -> World:
    """The world of a drive past dashes of two lengths, the ends of all of which are in view."""
    world = make(recipe)
    markings = list(world.port.hd_map.markings)
    corners = world.corners_map.copy()
    dashes = [number for number, marking in enumerate(markings) if marking.kind == LANE_DASH]
    for number in dashes[::_PERIOD]:
        corners[number] = _shortened(corners[number])
        markings[number] = replace(markings[number], corners_map=corners[number, :, :2])
    hd_map = replace(world.port.hd_map, markings=tuple(markings))
    return replace(world, port=replace(world.port, hd_map=hd_map), corners_map=corners)


def _shortened(corners_map: FloatArray) -> FloatArray:
    """Corners (4, 3) of a dash whose two ends are moved towards its middle."""
    sides = np.roll(corners_map, -1, axis=0) - corners_map
    longest = sides[np.linalg.norm(sides, axis=1).argmax()]
    along = longest / np.linalg.norm(longest)
    ahead = (corners_map - corners_map.mean(axis=0)) @ along
    return np.asarray(corners_map - (1 - _SHORT_SHARE) * ahead[:, None] * along)
