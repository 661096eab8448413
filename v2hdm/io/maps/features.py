"""A map as a list of features, which is what every file format writes; and the heights of its points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from typing import Any, TypeVar

import numpy as np

from v2hdm.geometry.geodetic import Grid, geodetic_from_enu
from v2hdm.geometry.planar import signed_area
from v2hdm.records import (
    FloatArray,
    GeodeticOrigin,
    HDMap,
    IntArray,
    Lane,
    Marking,
    PaintLeft,
    Reading,
    Road,
    Symbol,
)

CORNERS = "corners_map"
POINTS = "points_map"
OUTLINE = "outline_map"
"""Properties with the exact local coordinates of a marking's corners, a lane's points, a symbol's outline."""

Heights = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Heights (N,) of points (N, 2), m, and their standard deviations (N,)."""

_Paint = Marking | Lane | Symbol
_PaintT = TypeVar("_PaintT", Marking, Lane, Symbol)

PAINT = ("paint_left", "paint_left_sigma", "paint_left_change", "paint_left_change_sigma")
"""Properties of the paint that a marking has left: its share, the change since an earlier map, and sigmas."""

TEXT_READ = ("text", "text_confidence", "text_alternative", "text_alternative_confidence")
"""Properties of a text that was read: what it says, what else it may say, and their probabilities."""
COMPOSITION = ("kind", "parts", "lines", "apart_m")
"""Properties of a marking's variety, a symbol's parts, and a double line's lines and their distance."""

FARTHEST_M = 1e7  # largest coordinate of a map's point, m: a quarter of a meridian
_ALONG_M = 3.0  # distance within which stations share in a point's height, m: noise averages out; chosen
_AT_ONCE = 1024  # points whose distances to all stations are held in memory at once; chosen


@dataclass(frozen=True)
class Feature:
    """A marking, a symbol or a lane as file formats see it; None is not known."""

    id: int
    kind: str
    points_map: FloatArray  # (N, 2) m, corners of a closed feature, vertices of an open one
    sightings: int
    closed: bool  # a marking of four corners unless a ``symbol``
    heights_m: FloatArray | None = None  # (N,) of the ground, None for z = 0
    covariance_m2: FloatArray | None = None  # (2N, 2N) stacked
    relative_sigma_m: float | None = None
    accuracy: str | None = None
    heights_sigma_m: FloatArray | None = None  # (N,)
    symbol: bool = False
    place_sigma_m: float | None = None  # of a symbol
    vertex_sigma_m: FloatArray | None = None  # (N,) of a lane, across it
    paint: PaintLeft | None = None
    reading: Reading | None = None
    variety: str | None = None  # of a marking
    parts: tuple[int, ...] = ()  # of a symbol
    lines: tuple[str, str] | None = None  # of a double line
    apart_m: float | None = None

    @property
    def key(self) -> str:
        """Property that holds its local coordinates."""
        return OUTLINE if self.symbol else CORNERS if self.closed else POINTS

    @property
    def ring(self) -> IntArray:
        """The points' order (N,) as it is written: counter-clockwise from above where it is closed."""
        order = np.arange(len(self.points_map))
        return order[::-1] if self.closed and signed_area(self.points_map) < 0 else order

    @property
    def ring_covariance_m2(self) -> FloatArray | None:
        """The covariance (2N, 2N) in the order of :attr:`ring`."""
        order = [2 * k + axis for k in self.ring for axis in (0, 1)]
        return None if self.covariance_m2 is None else self.covariance_m2[order][:, order]

    @property
    def sigma_m(self) -> float | None:
        """One standard deviation a coordinate, over all points."""
        if self.covariance_m2 is None:
            return self.place_sigma_m
        return float(np.sqrt(np.trace(self.covariance_m2) / len(self.covariance_m2)))

    @property
    def xyz_map(self) -> FloatArray:
        """The points (N, 3) in the map frame, m."""
        heights = np.zeros(len(self.points_map)) if self.heights_m is None else self.heights_m
        return np.column_stack([self.points_map, heights])

    def positions(self, origin: GeodeticOrigin | Grid | None) -> FloatArray:
        """The points in order of :attr:`ring`.

        (N, 3) longitude and latitude in degrees and ellipsoidal height in m; without an ``origin`` local
        metres, (N, 2) where no height is known; in a :class:`Grid` its coordinates (N, 3).
        """
        if isinstance(origin, Grid):
            return origin.positions(self.xyz_map)[self.ring]
        if origin is None:
            return (self.points_map if self.heights_m is None else self.xyz_map)[self.ring]
        return geodetic_from_enu(origin, self.xyz_map)[self.ring][:, [1, 0, 2]]


def features_of(hd_map: HDMap) -> list[Feature]:
    """Markings, lanes, then symbols, each with its own id: that which it has, else the next free one."""
    paints: list[_Paint] = [*hd_map.markings, *hd_map.lanes, *hd_map.symbols]
    ids = unique_ids([paint.id or 0 for paint in paints], hd_map.largest_id)
    return [_feature_of(paint, number) for paint, number in zip(paints, ids, strict=True)]


def _feature_of(paint: _Paint, number: int) -> Feature:
    """A marking, lane or symbol as the feature of that ``number``."""
    feature = Feature(
        id=number,
        kind=paint.kind,
        points_map=_points_of(paint),
        sightings=paint.sightings,
        closed=not isinstance(paint, Lane),
        heights_m=paint.heights_m,
        heights_sigma_m=paint.heights_sigma_m,
    )
    if isinstance(paint, Lane):
        return replace(feature, vertex_sigma_m=paint.sigma_m, lines=paint.lines, apart_m=paint.apart_m)
    feature = replace(feature, covariance_m2=paint.covariance_m2, accuracy=paint.accuracy)
    if isinstance(paint, Symbol):
        feature = replace(feature, symbol=True, place_sigma_m=paint.sigma_m)
        return replace(feature, parts=paint.parts, reading=paint.reading)
    return replace(feature, relative_sigma_m=paint.relative_sigma_m, paint=paint.paint, variety=paint.variety)


def _points_of(paint: _Paint) -> FloatArray:
    """The corners, vertices or outline (N, 2) of a marking, lane or symbol."""
    if isinstance(paint, Symbol):
        return paint.outline_map
    return paint.points_map if isinstance(paint, Lane) else paint.corners_map


def map_of(features: Sequence[Feature], ids: Sequence[int], origin: GeodeticOrigin | None) -> HDMap:
    """The map whose features these are, in their order, with other ids."""
    markings: list[Marking] = []
    lanes: list[Lane] = []
    symbols: list[Symbol] = []
    for feature, number in zip(features, ids, strict=True):
        if feature.symbol:
            symbol = Symbol(
                kind=feature.kind,
                outline_map=feature.points_map,
                sightings=feature.sightings,
                sigma_m=feature.place_sigma_m,
                heights_m=feature.heights_m,
                id=number,
                heights_sigma_m=feature.heights_sigma_m,
                covariance_m2=feature.covariance_m2,
                accuracy=feature.accuracy,
                reading=feature.reading,
                parts=feature.parts,
            )
            symbols.append(symbol)
        elif feature.closed:
            marking = Marking(
                kind=feature.kind,
                corners_map=feature.points_map,
                sightings=feature.sightings,
                covariance_m2=feature.covariance_m2,
                relative_sigma_m=feature.relative_sigma_m,
                heights_m=feature.heights_m,
                id=number,
                paint=feature.paint,
                heights_sigma_m=feature.heights_sigma_m,
                accuracy=feature.accuracy,
                variety=feature.variety,
            )
            markings.append(marking)
        else:
            lane = Lane(
                kind=feature.kind,
                points_map=feature.points_map,
                sightings=feature.sightings,
                heights_m=feature.heights_m,
                id=number,
                sigma_m=feature.vertex_sigma_m,
                heights_sigma_m=feature.heights_sigma_m,
                lines=feature.lines,
                apart_m=feature.apart_m,
            )
            lanes.append(lane)
    return HDMap(tuple(markings), tuple(lanes), origin, tuple(symbols))


def unique_ids(ids: Sequence[int], largest: int = 0) -> list[int]:
    """``ids`` with those below 1, and repeated ones, replaced by numbers above the ``largest`` ever."""
    following = max([largest, *ids]) + 1
    out: dict[int, None] = {}
    for number in ids:
        if number < 1 or number in out:
            number = following
            following = following + 1
        out[number] = None
    return list(out)


def properties_of(feature: Feature) -> dict[str, Any]:
    """The properties of a feature in files, besides its geometry; arrays are lists."""
    properties = {
        "id": feature.id,
        "class": feature.kind,
        "sightings": feature.sightings,
        feature.key: feature.points_map,
        "heights_m": feature.heights_m,
        "heights_sigma_m": feature.heights_sigma_m,
        "sigma_m": feature.sigma_m,
        "covariance_m2": feature.covariance_m2,
        "relative_sigma_m": feature.relative_sigma_m,
        "accuracy": feature.accuracy,
        "vertex_sigma_m": feature.vertex_sigma_m,
        "kind": feature.variety,
        "parts": list(feature.parts) or None,
        "lines": feature.lines and list(feature.lines),
        "apart_m": feature.apart_m,
        **({} if feature.paint is None else dict(zip(PAINT, astuple(feature.paint), strict=True))),
        **dict(zip(TEXT_READ, feature.reading or (), strict=False)),
    }
    return {
        key: value.tolist() if isinstance(value, np.ndarray) else value
        for key, value in properties.items()
        if value is not None
    }


def in_words(value: object) -> str:
    """A property of :data:`COMPOSITION` as the text of a format that has no lists."""
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def with_heights(hd_map: HDMap, road: Road | None, surface: Heights | None = None) -> HDMap:
    """``hd_map`` with the height of every corner and vertex; as it is without a ``road`` or ``surface``.

    Features that have heights already, of an earlier drive, keep them. ``surface`` gives the heights (N,) of
    the ground at points (N, 2) above the road's planes, with their standard deviations.
    """
    if road is None and surface is None:
        return hd_map

    def raised(paint: _PaintT) -> _PaintT:
        if paint.heights_m is not None:
            return paint
        points_map = _points_of(paint)
        heights_m = np.zeros(len(points_map)) if road is None else ground_height_m(road, points_map)
        above_m, sigma_m = (0.0, None) if surface is None else surface(points_map)
        return replace(paint, heights_m=heights_m + above_m, heights_sigma_m=sigma_m)

    return replace(
        hd_map,
        markings=tuple(raised(marking) for marking in hd_map.markings),
        lanes=tuple(raised(lane) for lane in hd_map.lanes),
        symbols=tuple(raised(symbol) for symbol in hd_map.symbols),
    )


def ground_height_m(road: Road, points_map: FloatArray) -> FloatArray:
    """Recorded height (N,) of the ground at ``points_map`` (N, 2), by the road's planes nearest to them."""
    pieces = [np.empty(0)]
    for start in range(0, len(points_map), _AT_ONCE):
        offset = points_map[start : start + _AT_ONCE, None] - road.points_map
        squared = np.einsum("nsi,nsi->ns", offset, offset)
        weight = np.exp(-0.5 * (squared - squared.min(axis=1, keepdims=True)) / _ALONG_M**2)
        plane = road.height_m + np.einsum("nsi,si->ns", offset, road.slope)
        pieces.append((weight * plane).sum(axis=1) / weight.sum(axis=1))
    return np.concatenate(pieces)
