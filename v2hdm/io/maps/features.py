"""A map as a list of features, which is what every file format writes, and back again.

Where a file holds a feature's geometry and its exact local coordinates, :func:`believed` decides between
them: the geometry is the truth, for people edit it; the stored coordinates stand where they agree with it.

Heights of a map's points: those of the recorded road, which the mapping has laid flat.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.geometry.geodetic import enu_from_geodetic, geodetic_from_enu
from v2hdm.geometry.planar import signed_area
from v2hdm.io.safe.fields import take_covariance, take_whole
from v2hdm.io.safe.texts import take_name
from v2hdm.records import FloatArray, GeodeticOrigin, HdMap, IntArray, Lane, Marking, Road, Symbol
from v2hdm.store.files import take_array, take_number

_log = logging.getLogger(__name__)

LARGEST_ID = 1_000_000_000
"""Largest id that a file may give: every format and GIS holds it as a whole number of 32 bits."""

_MOST_SIGHTINGS = 1_000_000_000

_LEAST_OF_A_RING = 3
"""Corners of a polygon, the repeated first one aside (RFC 7946, section 3.1.6)."""

_NAMED = 9
"""Edited features that the log names."""

CORNERS = "corners_map"
"""Property that holds the exact local coordinates of a closed feature."""

POINTS = "points_map"
"""Property that holds the exact local coordinates of an open feature."""

OUTLINE = "outline_map"
"""Property that holds the exact local coordinates of a symbol's outline, a closed feature of any shape."""


@dataclass(frozen=True)
class Feature:
    """A marking, a symbol or a lane as file formats see it.

    ``points_map`` (N, 2) m are the corners of a ``closed`` feature or the vertices of an open one. A closed
    one is a marking of four corners unless it is a ``symbol``, of which ``place_sigma_m`` may be known.
    ``heights_m`` (N,) are those of the ground there in the map frame, None where it is the plane z = 0.
    ``covariance_m2`` (2N, 2N) is that of the stacked points, None where it is not known.
    """

    id: int
    kind: str
    points_map: FloatArray
    sightings: int
    closed: bool
    heights_m: FloatArray | None = None
    covariance_m2: FloatArray | None = None
    relative_sigma_m: float | None = None
    symbol: bool = False
    place_sigma_m: float | None = None

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
    def ordered_heights_m(self) -> FloatArray | None:
        """The heights (N,) in the order of :attr:`ring`."""
        return None if self.heights_m is None else self.heights_m[self.ring]

    @property
    def sigma_m(self) -> float | None:
        """One standard deviation a coordinate, over all points."""
        covariance = self.covariance_m2
        return (
            self.place_sigma_m
            if covariance is None
            else float(np.sqrt(np.trace(covariance) / len(covariance)))
        )

    @property
    def xyz_map(self) -> FloatArray:
        """The points (N, 3) in the map frame, m."""
        heights = np.zeros(len(self.points_map)) if self.heights_m is None else self.heights_m
        return np.column_stack([self.points_map, heights])

    def positions(self, origin: GeodeticOrigin | None) -> FloatArray:
        """The points in order of :attr:`ring`.

        (N, 3) longitude and latitude in degrees and ellipsoidal height in m; without an ``origin`` local
        metres, (N, 2) where no height is known.
        """
        if origin is None:
            return (self.points_map if self.heights_m is None else self.xyz_map)[self.ring]
        return geodetic_from_enu(origin, self.xyz_map)[self.ring][:, [1, 0, 2]]


def features_of(hd_map: HdMap) -> list[Feature]:
    """Markings, lanes, then symbols, each with its own id: that which it has, else the next free one."""
    features = [
        Feature(
            id=marking.id or 0,
            kind=marking.kind,
            points_map=marking.corners_map,
            sightings=marking.sightings,
            closed=True,
            heights_m=marking.heights_m,
            covariance_m2=marking.covariance_m2,
            relative_sigma_m=marking.relative_sigma_m,
        )
        for marking in hd_map.markings
    ]
    features += [
        Feature(lane.id or 0, lane.kind, lane.points_map, lane.sightings, False, lane.heights_m)
        for lane in hd_map.lanes
    ]
    features += [
        Feature(
            one.id or 0,
            one.kind,
            one.outline_map,
            one.sightings,
            True,
            one.heights_m,
            symbol=True,
            place_sigma_m=one.sigma_m,
        )
        for one in hd_map.symbols
    ]
    ids = unique_ids([feature.id for feature in features], hd_map.largest_id)
    return [_with_id(feature, number) for feature, number in zip(features, ids, strict=True)]


def map_of(features: Iterable[Feature], origin: GeodeticOrigin | None) -> HdMap:
    """The map whose features these are, in their order."""
    markings: list[Marking] = []
    lanes: list[Lane] = []
    symbols: list[Symbol] = []
    for one in features:
        if one.symbol:
            symbols.append(
                Symbol(one.kind, one.points_map, one.sightings, one.place_sigma_m, one.heights_m, one.id)
            )
        elif one.closed:
            markings.append(
                Marking(
                    kind=one.kind,
                    corners_map=one.points_map,
                    sightings=one.sightings,
                    covariance_m2=one.covariance_m2,
                    relative_sigma_m=one.relative_sigma_m,
                    heights_m=one.heights_m,
                    id=one.id,
                )
            )
        else:
            lanes.append(Lane(one.kind, one.points_map, one.sightings, one.heights_m, one.id))
    return HdMap(tuple(markings), tuple(lanes), origin, tuple(symbols))


def unique_ids(ids: Sequence[int], largest: int = 0) -> list[int]:
    """``ids`` with those below 1, and those taken already, replaced by numbers above the ``largest`` ever."""
    following = max([largest, *ids]) + 1
    taken: set[int] = set()
    out = []
    for number in ids:
        if number < 1 or number in taken:
            number, following = following, following + 1
        taken.add(number)
        out.append(number)
    return out


def properties_of(feature: Feature) -> dict[str, Any]:
    """What a file tells of a feature besides its geometry; :func:`read_feature` reads it."""
    properties: dict[str, Any] = {
        "id": feature.id,
        "class": feature.kind,
        "sightings": feature.sightings,
        feature.key: feature.points_map.tolist(),
    }
    if feature.heights_m is not None:
        properties["heights_m"] = feature.heights_m.tolist()
    if feature.sigma_m is not None:
        properties["sigma_m"] = feature.sigma_m
    if feature.covariance_m2 is not None:
        properties["covariance_m2"] = feature.covariance_m2.tolist()
    if feature.relative_sigma_m is not None:
        properties["relative_sigma_m"] = feature.relative_sigma_m
    return properties


@dataclass(frozen=True)
class Geometry:
    """A feature's geometry as a file has it: ``positions`` (N, 2 or 3) without a closing one."""

    positions: FloatArray
    closed: bool


class FeatureReader:
    """Reads the features of one file: counts those whose geometry was edited, and gives ids.

    Attributes:
        path: names the file in errors.
        origin: the map's place on the earth.
        rounding: how far (3,) positions may be off for having been rounded, in the file's own units.
    """

    def __init__(self, path: object, origin: GeodeticOrigin | None, rounding: FloatArray) -> None:
        self.path = path
        self.origin = origin
        self.rounding = rounding
        self._features: list[Feature] = []
        self._edited: list[int] = []

    def add(self, properties: Mapping[str, Any], geometry: Geometry | None, where: str) -> None:
        """Read one feature.

        Raises:
            MapFileError: It has neither a geometry nor local coordinates, or something in it is damaged.
        """
        if geometry is None and not properties.keys() & {CORNERS, POINTS, OUTLINE}:
            raise MapFileError(
                f"{where}: has neither a geometry nor '{CORNERS}', '{POINTS}' or '{OUTLINE}'; drop it"
            )
        if geometry is not None and geometry.closed and len(geometry.positions) < _LEAST_OF_A_RING:
            raise MapFileError(f"{where}: its ring has fewer than three corners; mend it, or drop it")
        if geometry is not None and self.origin is not None and (np.abs(geometry.positions[:, 1]) > 90).any():
            raise MapFileError(f"{where}: its geometry is not in degrees of longitude and latitude; mend it")
        closed = POINTS not in properties if geometry is None else geometry.closed
        stored = _stored(properties, closed, where)
        feature = stored if geometry is None else believed(stored, geometry, self.origin, self.rounding)
        if closed and not feature.symbol and len(feature.points_map) != 4:
            raise MapFileError(
                f"{where}: a marking has four corners, this has {len(feature.points_map)}; mend its outline"
            )
        if feature is not stored and len(stored.points_map):
            self._edited.append(len(self._features))
        self._features.append(feature)

    def map(self) -> HdMap:
        """All that was read; says in the log what was edited and which ids are new."""
        before = [feature.id for feature in self._features]
        ids = unique_ids(before)
        if self._edited:
            named = ", ".join(str(ids[index]) for index in self._edited[:_NAMED])
            more = ", ..." if len(self._edited) > _NAMED else ""
            _log.info(
                "%s: %d features were edited and are taken as drawn: %s",
                self.path,
                len(self._edited),
                named + more,
            )
        new = sum(a != b for a, b in zip(before, ids, strict=True))
        if new:
            _log.info("%s: %d features had no id of their own and were given one", self.path, new)
        return map_of(
            [_with_id(feature, number) for feature, number in zip(self._features, ids, strict=True)],
            self.origin,
        )


def believed(
    stored: Feature, geometry: Geometry, origin: GeodeticOrigin | None, rounding: FloatArray
) -> Feature:
    """``stored`` itself where the geometry says the same, else what the geometry says, point by point.

    A ring may start at another corner and run the other way round. Points whose number has not changed keep
    their order and covariance, and their heights unless these were edited, too.
    """
    positions, size = geometry.positions, geometry.positions.shape[1]
    if len(positions) != len(stored.points_map):
        xyz = _in_map(positions, None, origin)
        if geometry.closed and signed_area(xyz[:, :2]) < 0:
            xyz = xyz[::-1]
        raised = np.abs(xyz[:, 2]).max(initial=0.0) > rounding[2]
        return replace(
            stored,
            points_map=xyz[:, :2],
            heights_m=xyz[:, 2] if raised else None,
            covariance_m2=None,
            relative_sigma_m=None,
        )
    drawn = stored.positions(origin)
    expected = np.zeros((len(positions), 3))
    expected[stored.ring, : drawn.shape[1]] = drawn
    positions = positions[_aligned(expected[:, :2], positions, geometry.closed)]
    agree = np.abs(positions - expected[:, :size]) <= rounding[:size]
    if agree.all():
        return stored
    xyz = _in_map(positions, stored.heights_m, origin)
    points_map = np.where(agree[:, :2].all(axis=1, keepdims=True), stored.points_map, xyz[:, :2])
    heights_m = stored.heights_m
    if not agree[:, 2:].all():
        heights_m = np.where(agree[:, 2], stored.xyz_map[:, 2], xyz[:, 2])
    return replace(stored, points_map=points_map, heights_m=heights_m)


def _in_map(positions: FloatArray, heights_m: FloatArray | None, origin: GeodeticOrigin | None) -> FloatArray:
    """A file's positions (N, 2 or 3) in the map: (N, 3), m; heights that they lack are ``heights_m`` or 0."""
    known = np.zeros(len(positions)) if heights_m is None else heights_m
    if origin is None:
        return np.column_stack([positions, known])[:, :3]
    above_m = np.column_stack([positions, origin.altitude_m + known])[:, 2]
    return enu_from_geodetic(origin, np.column_stack([positions[:, 1], positions[:, 0], above_m]))


def _aligned(expected: FloatArray, positions: FloatArray, closed: bool) -> IntArray:
    """The order of ``positions`` that comes nearest to ``expected``: as they are unless they form a ring."""
    count = len(positions)
    order = np.arange(count)
    if not closed:
        return order
    orders = [np.roll(one, -start) for one in (order, order[::-1]) for start in range(count)]
    return min(orders, key=lambda one: float(((positions[one, :2] - expected) ** 2).sum()))


def _stored(properties: Mapping[str, Any], closed: bool, where: str) -> Feature:
    """The feature by its properties alone; without points where they are not among them."""
    symbol = closed and properties.get(CORNERS) is None and properties.get(OUTLINE) is not None
    key = OUTLINE if symbol else CORNERS if closed else POINTS
    points = np.empty((0, 2))
    if properties.get(key) is not None:
        shape = (4, 2) if key == CORNERS else (-1, 2)
        points = take_array(properties[key], shape, f"{where}, {key}", MapFileError)
    # What is known of each point is nothing without the points that it is known of.
    of_points = properties if len(points) else {}
    heights, covariance = of_points.get("heights_m"), of_points.get("covariance_m2")
    relative, sigma = properties.get("relative_sigma_m"), properties.get("sigma_m")
    number, sightings = properties.get("id"), properties.get("sightings")
    least = -LARGEST_ID
    return Feature(
        id=0 if number is None else take_whole(number, least, LARGEST_ID, f"{where}, id", MapFileError),
        kind=take_name(properties.get("class"), f"{where}, class", MapFileError),
        points_map=points,
        sightings=0
        if sightings is None
        else take_whole(sightings, 0, _MOST_SIGHTINGS, f"{where}, sightings", MapFileError),
        closed=closed,
        heights_m=None
        if heights is None
        else take_array(heights, (len(points),), f"{where}, heights_m", MapFileError),
        covariance_m2=None
        if covariance is None
        else take_covariance(covariance, 2 * len(points), f"{where}, covariance_m2", MapFileError),
        relative_sigma_m=None
        if relative is None
        else take_number(relative, f"{where}, relative_sigma_m", MapFileError),
        symbol=symbol,
        place_sigma_m=take_number(sigma, f"{where}, sigma_m", MapFileError)
        if symbol and sigma is not None
        else None,
    )


def _with_id(feature: Feature, number: int) -> Feature:
    return feature if feature.id == number else replace(feature, id=number)


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
