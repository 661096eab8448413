"""Small plane geometry that every floor needs: what lies inside, and where on the ground, in numpy."""

from __future__ import annotations

import numpy as np

from v2hdm.records import BoolArray, FloatArray


def inside_convex(polygon: FloatArray, points: FloatArray) -> BoolArray:
    """Whether points (..., 2) lie inside a convex polygon (N, 2) of either turning; nan is outside."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    offsets = np.asarray(points)[..., None, :] - polygon
    cross = edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0]
    return np.asarray((cross >= 0).all(axis=-1) | (cross <= 0).all(axis=-1))


def ground_in_vehicle(map_from_vehicle: FloatArray, points_map: FloatArray) -> FloatArray:
    """Ground points (..., 2) m of the map as (x, y) in the frame of a vehicle at a pose (4 x 4)."""
    offset = np.concatenate([points_map, np.zeros((*np.shape(points_map)[:-1], 1))], axis=-1)
    return np.asarray(((offset - map_from_vehicle[:3, 3]) @ map_from_vehicle[:3, :3])[..., :2])
