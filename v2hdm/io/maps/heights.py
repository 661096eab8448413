"""Heights of a map's points: those of the recorded road, which the mapping has laid flat."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from v2hdm.records import FloatArray, HdMap, Road

_ALONG_M = 3.0
"""Stations within about this of the nearest one share in a point's height, m: noise and laps average out."""

_AT_ONCE = 1024
"""Points whose distances to all stations are held in memory together."""


def with_heights(hd_map: HdMap, road: Road | None) -> HdMap:
    """``hd_map`` with the recorded height of every corner and vertex; as it is without a ``road``.

    What has heights already, of an earlier drive, keeps them.
    """
    if road is None:
        return hd_map

    def height_m(known: FloatArray | None, points_map: FloatArray) -> FloatArray:
        return ground_height_m(road, points_map) if known is None else known

    markings = tuple(replace(m, heights_m=height_m(m.heights_m, m.corners_map)) for m in hd_map.markings)
    lanes = tuple(replace(one, heights_m=height_m(one.heights_m, one.points_map)) for one in hd_map.lanes)
    symbols = tuple(replace(s, heights_m=height_m(s.heights_m, s.outline_map)) for s in hd_map.symbols)
    return replace(hd_map, markings=markings, lanes=lanes, symbols=symbols)


def ground_height_m(road: Road, points_map: FloatArray) -> FloatArray:
    """Recorded height (N,) of the ground at ``points_map`` (N, 2), by the road's planes nearest to them."""
    pieces = [
        _height_m(road, points_map[start : start + _AT_ONCE]) for start in range(0, len(points_map), _AT_ONCE)
    ]
    return np.concatenate(pieces) if pieces else np.empty(0)


def _height_m(road: Road, points_map: FloatArray) -> FloatArray:
    offset = points_map[:, None] - road.points_map
    squared = np.einsum("nsi,nsi->ns", offset, offset)
    weight = np.exp(-0.5 * (squared - squared.min(axis=1, keepdims=True)) / _ALONG_M**2)
    plane = road.height_m + np.einsum("nsi,si->ns", offset, road.slope)
    return np.asarray((weight * plane).sum(axis=1) / weight.sum(axis=1))
