"""Writing an HD map as Lanelet2 OSM in the dialect of Autoware, with its ``map_projector_info.yaml``.

Every marking is a polygon ``pose_marker`` of four counter-clockwise vertices, a landmark for localisation;
lane lines are line strings, with a lanelet where two of them bound a lane, and another where a lane goes on,
splits or merges along a line that bounds both: its other bound is ``virtual`` where no paint shows it. A stop
line is a line string as well, with the regulatory element that Autoware's map validator asks for: a
``traffic_sign``, as Lanelet2 has no word for paint alone, whose sign is a line beside the paint, tagged
``virtual``. A crosswalk is a polygon ``crosswalk_polygon`` and a lanelet ``crosswalk`` between two
``zebra_marking`` lines along the ends of its bars; other symbols, and the areas of text and boxes, are
polygons ``road_symbol``. Other ids follow from the map's, so that they stay when it is written again.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from v2hdm.errors import ConfigError, MapFileError, need, shown
from v2hdm.geometry.geodetic import geodetic_from_enu, position_of
from v2hdm.io.maps.closed_lanes import Bound, closed_lanes, connections
from v2hdm.io.maps.features import COMPOSITION, TEXT_READ, Feature, features_of, in_words, properties_of
from v2hdm.records import CROSSWALK, LANE_DASH, STOP_LINE, FloatArray, GeodeticOrigin, HDMap
from v2hdm.store.files import dump_yaml, replace_text, xml_text

LOCAL, LOCAL_CARTESIAN, MGRS = PROJECTORS = ("Local", "LocalCartesian", "MGRS")
"""Autoware's projectors that this format knows, by their names in ``map_projector_info.yaml``."""

_DEGREE_DECIMALS = 12  # decimals of a longitude or latitude in degrees: 1e-7 m; JOSM writes 11
_HEIGHT_DECIMALS = 6  # decimals of a height in m

# Ids of nodes, ways and relations that are parts of a feature, such as its vertices:
_FIRST_PART = 1 << 40  # smallest id of a part: above all ids of features, and exact in every language
_PARTS = 1 << 20  # ids that each feature has for its parts
_MOST_VERTICES = _PARTS // 2  # the lower half of a feature's parts, those of its vertices
_LANELETS = _MOST_VERTICES + _PARTS // 4  # part of a line that those of the lanelets to its right follow
_VIRTUALS = _MOST_VERTICES + 3 * _PARTS // 8  # part of a line that those of its bounds without paint follow

# Lanelet2 reads no node without latitude and longitude: local maps lie where the equator meets Greenwich.
_NOWHERE = GeodeticOrigin(0.0, 0.0, 0.0)


def write_lanelet2(hd_map: HDMap, path: Path, projector: str | None = None) -> None:
    """Write ``hd_map`` to ``path`` and ``map_projector_info.yaml`` beside it, each atomically.

    Without a ``projector`` of :data:`PROJECTORS` it is ``LocalCartesian`` for a map with an origin, else
    ``Local``. Raises ConfigError when the projector does not suit the map, MapFileError when a line has too
    many vertices.
    """
    projector = projector or (LOCAL if hd_map.origin is None else LOCAL_CARTESIAN)
    if projector not in PROJECTORS:
        raise ConfigError(f"unknown projector {shown(projector)}; choose from: {', '.join(PROJECTORS)}")
    if hd_map.origin is None and projector != LOCAL:
        problem = f"the map has no origin on the earth, which the projector {projector} needs"
        raise ConfigError(f"{problem}: choose {LOCAL}")
    features = features_of(hd_map)
    for feature in features:
        if len(feature.points_map) >= _MOST_VERTICES:
            raise MapFileError(f"feature {feature.id}: more than {_MOST_VERTICES} vertices; split it")
    document = _Document(hd_map.origin, projector)
    lanes = _Lanes(document, [feature for feature in features if not feature.closed])
    for feature in features:
        if feature.kind == CROSSWALK and len(feature.points_map) == 4:
            _write_crosswalk(document, feature)
        elif feature.symbol:
            outline = document.nodes(feature, feature.xyz_map[feature.ring])
            tags = {"type": "road_symbol", "subtype": feature.kind, "area": "yes"}
            document.way(feature.id, outline, tags | _more_tags(feature))
        elif feature.closed:
            _write_marking(document, feature, lanes)
        else:
            document.way(feature.id, lanes.vertices[feature.id], _line_tags(feature) | _more_tags(feature))
    lanes.write()
    square = document.place_nodes()
    replace_text(path, document.text())
    info: dict[str, Any] = {"projector_type": projector}
    if projector != LOCAL and hd_map.origin is not None:
        latitude, longitude, altitude = position_of(hd_map.origin)[0].tolist()
        map_origin = {"latitude": latitude, "longitude": longitude, "altitude": altitude}
        where = {"map_origin": map_origin} if square is None else {"mgrs_grid": square}
        info |= {"vertical_datum": "WGS84"} | where
    replace_text(path.with_name("map_projector_info.yaml"), dump_yaml(info))


def _write_marking(document: _Document, feature: Feature, lanes: _Lanes) -> None:
    corners = feature.xyz_map[feature.ring]
    tags = {"type": "pose_marker", "subtype": feature.kind, "area": "yes", "marker_id": str(feature.id)}
    document.way(feature.id, document.nodes(feature, corners), tags | _more_tags(feature))
    if feature.kind != STOP_LINE:
        return
    middle = corners[:, :2].mean(axis=0)
    lane = lanes.of(middle)
    stop, sign = _stop_edges(corners, None if lane is None else lanes.direction(lane, middle))
    stop_id = _part(feature, _MOST_VERTICES)
    sign_id = _part(feature, _MOST_VERTICES + 1)
    rule_id = _part(feature, _MOST_VERTICES + 2)
    stop_nodes = document.nodes(feature, stop, _MOST_VERTICES + 10)
    document.way(stop_id, stop_nodes, {"type": "stop_line"})
    sign_tags = {"type": "traffic_sign", "subtype": "stop_sign", "virtual": "yes"}
    sign_nodes = document.nodes(feature, sign, _MOST_VERTICES + 20)
    document.way(sign_id, sign_nodes, sign_tags)
    members = [("way", sign_id, "refers"), ("way", stop_id, "ref_line")]
    document.relation(rule_id, members, {"type": "regulatory_element", "subtype": "traffic_sign"})
    if lane is not None:
        lanes.rules[lane].append(rule_id)


def _write_crosswalk(document: _Document, feature: Feature) -> None:
    """The polygon and the lanelet of Autoware's vm-05-01; its rule, Lanelet2 itself would not read."""
    corners = feature.xyz_map  # the ends of its bars are the first two, and the last two
    nodes = document.nodes(feature, corners)
    ring = [nodes[k] for k in feature.ring]
    document.way(feature.id, ring, {"type": "crosswalk_polygon", "area": "yes"} | _more_tags(feature))
    ends = ((nodes[3], nodes[2]), (nodes[0], nodes[1]))
    numbers = [_part(feature, _MOST_VERTICES + k) for k in range(3)]
    for number, way in zip(numbers, ends, strict=False):
        document.way(number, way, {"type": "zebra_marking"})
    left, right, lanelet_id = numbers
    tags = {"type": "lanelet", "subtype": "crosswalk", "location": "urban", "one_way": "no"}
    bounds = [("way", left, "left"), ("way", right, "right")]
    document.relation(lanelet_id, bounds, tags | {"participant:pedestrian": "yes"})


def _stop_edges(corners: FloatArray, direction: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """The edge of a stop line's ``corners`` (4, 3) to stop at, and the other one, each (2, 3).

    Vehicles stop at the edge that they meet first (Autoware's vm-02-01), else at the middle of the paint.
    """
    length = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    start = int(length[1] + length[3] > length[0] + length[2])
    edge = corners[[start, start + 1]]
    other_edge = corners[[(start + 3) % 4, (start + 2) % 4]]
    if direction is None:
        return (edge + other_edge) / 2, other_edge
    return (
        (edge, other_edge) if (other_edge - edge)[:, :2].mean(axis=0) @ direction > 0 else (other_edge, edge)
    )


class _Lanes:
    """The lanelets of a map, and the stop lines' rules that they refer to."""

    def __init__(self, document: _Document, lines: Sequence[Feature]) -> None:
        self._document = document
        self._lines = lines
        self._lanes = closed_lanes([line.points_map for line in lines])
        self.vertices = {line.id: document.nodes(line, line.xyz_map) for line in lines}
        self.rules: list[list[int]] = [[] for _ in self._lanes]
        self._bounds: dict[tuple[int, int, int], int] = {}
        self._counts: Counter[int] = Counter()
        self._virtuals: Counter[int] = Counter()

    def of(self, place_map: FloatArray) -> int | None:
        """The lane in which a place (2,) of the map lies."""
        for number, lane in enumerate(self._lanes):
            left = self._lines[lane.left.line].points_map[lane.left.order]
            right = self._lines[lane.right.line].points_map[lane.right.order]
            outline = np.concatenate([left, right[::-1]]) - place_map
            if cv2.pointPolygonTest(outline.astype(np.float32), (0.0, 0.0), False) >= 0:
                return number
        return None

    def direction(self, lane: int, place_map: FloatArray) -> FloatArray:
        """The direction (2,) in which a lane passes a place (2,) of the map."""
        bound = self._lanes[lane].left
        left = self._lines[bound.line].points_map[bound.order]
        nearest = int(np.argmin(((left - place_map) ** 2).sum(axis=1)))
        return np.asarray(np.gradient(left, axis=0)[nearest])

    def write(self) -> None:
        """Write a lanelet of each lane and of each connection, with the lines that they need as bounds."""
        for lane, rules in zip(self._lanes, self.rules, strict=True):
            owner = self._lines[lane.left.line]
            self._lanelet(owner, self._bound(lane.left), self._bound(lane.right), rules)
        for connection in connections(self._lanes, [line.points_map for line in self._lines]):
            before = self._lanes[connection.before]
            after = self._lanes[connection.after]
            left = self._bound_between(connection.left, before.left, after.left)
            right = self._bound_between(connection.right, before.right, after.right)
            self._lanelet(self._lines[before.left.line], left, right, ())

    def _lanelet(self, owner: Feature, left: int, right: int, rules: Sequence[int]) -> None:
        self._counts[owner.id] += 1
        lanelet_id = _part(owner, _LANELETS + self._counts[owner.id])
        members = [("way", left, "left"), ("way", right, "right")]
        members += [("relation", rule, "regulatory_element") for rule in rules]
        tags = {"type": "lanelet", "subtype": "road", "location": "urban", "one_way": "yes"}
        self._document.relation(lanelet_id, members, tags | {"participant:vehicle": "yes"})

    def _bound_between(self, bound: Bound | None, end: Bound, start: Bound) -> int:
        """The line string of a connection's bound: virtual, from ``end`` to ``start``, where it has none."""
        return self._virtual(end, start) if bound is None else self._bound(bound)

    def _virtual(self, end: Bound, start: Bound) -> int:
        """A bound that no paint shows, from where one lane's ends to where another's starts."""
        owner = self._lines[end.line]
        self._virtuals[owner.id] += 1
        number = _part(owner, _VIRTUALS + self._virtuals[owner.id])
        last = self.vertices[owner.id][end.order[-1]]
        first = self.vertices[self._lines[start.line].id][start.order[0]]
        self._document.way(number, [last, first], {"type": "virtual"})
        return number

    def _bound(self, bound: Bound) -> int:
        """The line string of a bound: that of the line where the bound is all of it, else that of a piece."""
        owner = self._lines[bound.line]
        first, last = sorted((int(bound.order[0]), int(bound.order[-1])))
        if last - first + 1 == len(owner.points_map):
            return owner.id
        key = (bound.line, first, last)
        if key not in self._bounds:
            pieces = sum(1 for line, _, _ in self._bounds if line == bound.line)
            self._bounds[key] = _part(owner, _MOST_VERTICES + 1 + pieces)
            nodes = self.vertices[owner.id][first : last + 1]
            self._document.way(self._bounds[key], nodes, _line_tags(owner) | {"part_of": str(owner.id)})
        return self._bounds[key]


def grid_places(longitude_deg: FloatArray, latitude_deg: FloatArray) -> tuple[str, FloatArray]:
    """The MGRS square of points (N,), as ``54SUE``, and m (N, 2) east and north of its south-west corner.

    Raises ConfigError when they lie in several squares or beyond the grid, or a package is missing.
    """
    pyproj = need("pyproj", "gis", "lanelet2 with MGRS", ConfigError)
    mgrs = need("mgrs", "gis", "lanelet2 with MGRS", ConfigError)
    if np.min(latitude_deg) < -80 or np.max(latitude_deg) >= 84:
        raise ConfigError("MGRS ends at 80 degrees south and 84 north: choose the projector LocalCartesian")
    grid = mgrs.MGRS()
    places = zip(latitude_deg.tolist(), longitude_deg.tolist(), strict=True)
    squares = {grid.toMGRS(lat, lon, MGRSPrecision=0).lstrip("0") for lat, lon in places}
    if len(squares) > 1:
        raise ConfigError(
            f"the map spans the MGRS squares {', '.join(sorted(squares))}, and Autoware's MGRS projector "
            "allows one square: choose the projector LocalCartesian"
        )
    (square,) = squares
    utm = pyproj.Proj(proj="utm", zone=int(square[:-3]), ellps="WGS84")
    return square, np.column_stack(utm(longitude_deg, latitude_deg)) % 100_000.0


class _Document:
    """The OSM document; nodes are placed last, all at once."""

    def __init__(self, origin: GeodeticOrigin | None, projector: str) -> None:
        self._origin = origin
        self._projector = projector
        self._root = ET.Element("osm", version="0.6", generator="v2hdm")
        ET.SubElement(self._root, "MetaInfo", format_version="1", map_version="1")
        self._nodes: dict[int, FloatArray] = {}
        self._elements: list[ET.Element] = []

    def nodes(self, owner: Feature, xyz_map: FloatArray, first: int = 0) -> list[int]:
        """Ids of new nodes at places (N, 3) of the map, from part ``first`` of their owner on."""
        place_of_node = {_part(owner, first + number): place for number, place in enumerate(xyz_map)}
        self._nodes |= place_of_node
        return list(place_of_node)

    def way(self, number: int, nodes: Sequence[int], tags: Mapping[str, str]) -> None:
        way = ET.Element("way", id=str(number))
        self._elements.append(way)
        for node in nodes:
            ET.SubElement(way, "nd", ref=str(node))
        _add_tags(way, tags)

    def relation(self, number: int, members: Sequence[tuple[str, int, str]], tags: Mapping[str, str]) -> None:
        relation = ET.Element("relation", id=str(number))
        self._elements.append(relation)
        for kind, ref, role in members:
            ET.SubElement(relation, "member", type=kind, ref=str(ref), role=role)
        _add_tags(relation, tags)

    def place_nodes(self) -> str | None:
        """Write the nodes; returns the grid square where the projector has one."""
        xyz_map = np.array(list(self._nodes.values())).reshape(-1, 3)
        degrees = geodetic_from_enu(self._origin or _NOWHERE, xyz_map)
        local = xyz_map[:, :2]
        square = None
        if self._projector == MGRS:
            if self._origin is not None and not len(xyz_map):
                here = position_of(self._origin)
                return grid_places(here[:, 1], here[:, 0])[0]
            square, local = grid_places(degrees[:, 1], degrees[:, 0])
        heights_m = xyz_map[:, 2] if self._projector == LOCAL else degrees[:, 2]
        for node, (latitude, longitude, _), (x, y), height in zip(
            self._nodes, degrees.tolist(), local.tolist(), heights_m.tolist(), strict=True
        ):
            lat, lon = (f"{degrees:.{_DEGREE_DECIMALS}f}" for degrees in (latitude, longitude))
            element = ET.SubElement(self._root, "node", id=str(node), lat=lat, lon=lon)
            # An MGRS code to the metre is rounded down.
            tags = {} if square is None else {"mgrs_code": f"{square}{int(x):05d}{int(y):05d}"}
            tags |= {"local_x": repr(x), "local_y": repr(y), "ele": f"{height:.{_HEIGHT_DECIMALS}f}"}
            _add_tags(element, tags)
        return square

    def text(self) -> str:
        self._root.extend(sorted(self._elements, key=lambda element: element.tag != "way"))
        return xml_text(self._root)


def _part(owner: Feature, number: int) -> int:
    return _FIRST_PART + owner.id * _PARTS + number


def _line_tags(feature: Feature) -> dict[str, str]:
    """Type, subtype and lane change of a line; the subtype of a double one goes from left to right."""
    dashed = [kind == LANE_DASH for kind in feature.lines or (feature.kind,)]
    if dashed[0] == dashed[-1]:
        words = ["dashed" if dashed[0] else "solid"]  # Lanelet2 has no word for two dashed ones
        subtype = "_".join(words if dashed[0] else words * len(dashed))
        return {"type": "line_thin", "subtype": subtype, "lane_change": "yes" if dashed[0] else "no"}
    subtype = "_".join("dashed" if is_dashed else "solid" for is_dashed in dashed)
    to_right, to_left = ("yes" if is_dashed else "no" for is_dashed in dashed)
    changes = {"lane_change:left": to_left, "lane_change:right": to_right}
    return {"type": "line_thin", "subtype": subtype} | changes


def _more_tags(feature: Feature) -> dict[str, str]:
    """Properties of a feature that Lanelet2 has no tags for."""
    tags = {"class": feature.kind, "sightings": str(feature.sightings)}
    if feature.relative_sigma_m is not None:
        tags["relative_sigma_m"] = repr(feature.relative_sigma_m)
    if feature.accuracy is not None:
        tags["accuracy"] = feature.accuracy
    properties = properties_of(feature)
    tags |= {key: in_words(properties[key]) for key in COMPOSITION if key in properties}
    tags |= {key: str(properties[key]) for key in TEXT_READ if key in properties}
    if feature.heights_sigma_m is not None:
        tags["heights_sigma_m"] = json.dumps(feature.heights_sigma_m[feature.ring].tolist())
    if (covariance := feature.ring_covariance_m2) is not None:
        tags["sigma_m"] = repr(feature.sigma_m)
        tags["covariance_m2"] = json.dumps(covariance.tolist())
    return tags


def _add_tags(element: ET.Element, tags: Mapping[str, str]) -> None:
    for key, value in tags.items():
        ET.SubElement(element, "tag", k=key, v=value)
