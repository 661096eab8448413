"""Writing an HD map as OpenDRIVE 1.7, for simulators.

Every lane of the lane graph is a road, or several that follow each other are one: its reference line is the
left line, its only lane ``-1`` as wide as the right line is away. Where lanes split, merge or cross, a
junction connects roads by roads of its own, one for each way through it. Heights and widths are thinned to a
millimetre. Every marking and symbol is an object ``roadMark``, and every crosswalk a ``crosswalk``, of the
nearest road, its class as its name, its outline exact in the object's own axes, its accuracy in ``userData``.
Double lines are marks such as ``solid broken``. Where no two lines bound a lane, one road without width runs
along the longest line or through the markings and carries them.
"""

from __future__ import annotations

import logging
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from v2hdm.geometry.datums import is_same_datum
from v2hdm.geometry.geodetic import crs_of
from v2hdm.geometry.planar import length_along, turned_left
from v2hdm.io.maps.features import COMPOSITION, TEXT_READ, Feature, features_of, in_words, properties_of
from v2hdm.io.maps.road_curves import Course, Piece, linear_records
from v2hdm.io.maps.roads import Marks, Road, roads_of, spaced
from v2hdm.records import CROSSWALK, FloatArray, GeodeticOrigin, HDMap
from v2hdm.store.files import replace_text, xml_text
from v2hdm.topology.build import lane_graph
from v2hdm.topology.graph import LaneGraph
from v2hdm.topology.lines import tangents

_log = logging.getLogger(__name__)

_FLAT_M = 0.001  # tolerance of heights and widths, m: below what a map knows; chosen
_FIRST_JUNCTION = 1_000_000  # ids of junctions begin above those of roads; chosen


def write_opendrive(hd_map: HDMap, path: Path, graph: LaneGraph | None = None) -> None:
    """Write ``hd_map`` as OpenDRIVE, atomically, in metres of the map frame, whose projection it states.

    ``graph`` is the map's lane graph, without which no drive is known.
    """
    features = features_of(hd_map)
    graph = lane_graph(hd_map) if graph is None else graph
    roads = _roads(graph, features, path)
    root = ET.Element("OpenDRIVE")
    stamp = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S")
    everything = np.concatenate([feature.points_map for feature in features] or [np.zeros((1, 2))])
    west, south = everything.min(axis=0)
    east, north = everything.max(axis=0)
    sides_m = {"north": north, "south": south, "east": east, "west": west}
    bounds = {side: f"{value_m:.4f}" for side, value_m in sides_m.items()}
    about = {"revMajor": "1", "revMinor": "7", "name": path.stem, "date": stamp, "vendor": "v2hdm"}
    header = ET.SubElement(root, "header", about | bounds)
    if hd_map.origin is not None:
        ET.SubElement(header, "geoReference").text = _reference_of(hd_map.origin)
    objects = [_write_road(root, number, roads) for number in range(len(roads))]
    for feature in features:
        if feature.closed:
            centre = feature.points_map.mean(axis=0)
            apart_m = [float(((road.tree - centre) ** 2).sum(axis=1).min()) for road in roads]
            k = int(np.argmin(apart_m))
            _write_object(objects[k], feature, roads[k])
    for number in range(len(graph.junctions)):
        _write_junction(root, number, roads, graph)
    replace_text(path, xml_text(root))


def _reference_of(origin: GeodeticOrigin) -> str:
    """The map's frame as PROJ text, which names WGS84 alone: another datum is stated by its ellipsoid."""
    text = crs_of(origin)
    if is_same_datum(origin.datum, "WGS84"):
        return text
    return text.replace("+datum=WGS84", "+ellps=GRS80 +towgs84=0,0,0,0,0,0,0")


def _roads(graph: LaneGraph, features: Sequence[Feature], path: Path) -> list[Road]:
    """The roads of the graph's lanes, else one without width that carries all markings."""
    lines = [feature for feature in features if not feature.closed]
    drawn = roads_of(graph, lines)
    if drawn.left_out:
        text = "%s: %d ways between lanes turn about a point and are left out"
        _log.warning(text, path.name, drawn.left_out)
    if drawn.roads:
        return drawn.roads
    long_lines = [spaced(line.xyz_map) for line in lines if len(spaced(line.xyz_map)) > 1]
    if long_lines:
        xyz = max(long_lines, key=lambda line: float(np.linalg.norm(np.ptp(line[:, :2], axis=0))))
    else:
        xyz = _through_centres(features)
    course = Course.through(xyz[:, :2], tangents(xyz[:, :2]))
    stations = course.stations
    way_m = length_along(xyz[:, :2])
    heights_m = np.interp(stations.s_m, way_m * course.length_m / way_m[-1], xyz[:, 2])
    none = Marks(0.0, "none", "none")
    return [Road(course, heights_m, np.zeros(len(stations.s_m)), (none,), kind="none")]


def _through_centres(features: Sequence[Feature]) -> FloatArray:
    """A straight line (2, 3), m, through the centres of features, at least 2 m long."""
    centres = np.array([feature.xyz_map.mean(axis=0) for feature in features]).reshape(-1, 3)
    middle = centres.mean(axis=0) if len(centres) else np.zeros(3)
    axis = np.linalg.svd(centres - middle)[2][0] if len(centres) > 1 else np.eye(3)[0]
    reach_m = max(float(np.abs((centres - middle) @ axis).max(initial=0.0)), 1.0)
    return np.stack([middle - reach_m * axis, middle + reach_m * axis])


def _write_road(root: ET.Element, number: int, roads: Sequence[Road]) -> ET.Element:
    """Write a road; returns the element of its objects."""
    road = roads[number]
    junction = "-1" if road.junction is None else str(_FIRST_JUNCTION + road.junction)
    whole = {"name": "", "length": _text(road.course.length_m), "id": str(number + 1), "junction": junction}
    element = ET.SubElement(root, "road", whole)
    _write_link(element, number, roads)
    if road.speed_kmh is not None:
        kind = ET.SubElement(element, "type", {"s": "0", "type": "town"})
        ET.SubElement(kind, "speed", {"max": _text(road.speed_kmh), "unit": "km/h"})
    view = ET.SubElement(element, "planView")
    for piece, s_m in zip(road.course.pieces, road.course.start_m.tolist(), strict=False):
        _write_piece(view, piece, s_m)
    profile = ET.SubElement(element, "elevationProfile")
    s_m = road.course.stations.s_m
    for at_m, z, slope in linear_records(s_m, road.heights_m, _FLAT_M):
        ET.SubElement(profile, "elevation", {"s": _text(at_m)} | _cubic(z, slope))
    section = ET.SubElement(ET.SubElement(element, "lanes"), "laneSection", {"s": "0"})
    about = {"type": "none", "level": "false"}
    middle = ET.SubElement(ET.SubElement(section, "center"), "lane", {"id": "0"} | about)
    lane = ET.SubElement(
        ET.SubElement(section, "right"), "lane", {"id": "-1", "type": road.kind, "level": "false"}
    )
    if road.junction is not None or number in (road.before, road.after):
        link = ET.SubElement(lane, "link")
        for name, other in (("predecessor", road.before), ("successor", road.after)):
            if other is not None:
                ET.SubElement(link, name, {"id": "-1"})
    for at_m, width_m, growth in linear_records(s_m, road.widths_m, _FLAT_M):
        ET.SubElement(lane, "width", {"sOffset": _text(at_m)} | _cubic(width_m, growth))
    for marks in road.marks:
        look = {"weight": "standard", "color": "standard", "width": "0.15"}
        mark = {"sOffset": _text(marks.s_m)} | look
        ET.SubElement(middle, "roadMark", mark | {"type": marks.left})
        ET.SubElement(lane, "roadMark", mark | {"type": marks.right})
    return ET.SubElement(element, "objects")


def _write_link(element: ET.Element, number: int, roads: Sequence[Road]) -> None:
    """Write what a road comes from and leads to: a junction's road to roads, others to junctions."""
    road = roads[number]
    if road.junction is not None or number in (road.before, road.after):
        ends = {"predecessor": (road.before, "end"), "successor": (road.after, "start")}
        links = {
            name: {"elementType": "road", "elementId": str(other + 1), "contactPoint": contact}
            for name, (other, contact) in ends.items()
            if other is not None
        }
    else:
        junctions = {
            "predecessor": {other.junction for other in roads if other.after == number},
            "successor": {other.junction for other in roads if other.before == number},
        }
        links = {
            name: {"elementType": "junction", "elementId": str(_FIRST_JUNCTION + junction)}
            for name, (junction,) in ((name, tuple(ids)) for name, ids in junctions.items() if ids)
            if junction is not None
        }
    if links:
        link = ET.SubElement(element, "link")
        for name, attributes in links.items():
            ET.SubElement(link, name, attributes)


def _write_piece(view: ET.Element, piece: Piece, s_m: float) -> None:
    x, y = piece.place.tolist()
    place = {"s": _text(s_m), "x": _text(x), "y": _text(y), "hdg": _text(piece.heading_rad)}
    geometry = ET.SubElement(view, "geometry", place | {"length": _text(piece.length_m)})
    if piece.is_straight:
        ET.SubElement(geometry, "line")
        return
    names = [f"{letter}{axis}" for axis in "UV" for letter in "abcd"]
    values = [0.0, *piece.u, 0.0, *piece.v]
    cubic = {name: _text(value) for name, value in zip(names, values, strict=True)}
    ET.SubElement(geometry, "paramPoly3", cubic | {"pRange": "normalized"})


def _write_junction(root: ET.Element, number: int, roads: Sequence[Road], graph: LaneGraph) -> None:
    """Write a junction: a connection for each of its roads, and which of them give way."""
    members = {k: road for k, road in enumerate(roads) if road.junction == number}
    incoming = {k: road for k, road in members.items() if road.before is not None}
    if not incoming:
        return
    about = {"name": "", "id": str(_FIRST_JUNCTION + number), "type": "default"}
    element = ET.SubElement(root, "junction", about)
    for count, (k, road) in enumerate(incoming.items()):
        ways = {"id": str(count), "incomingRoad": str((road.before or 0) + 1), "connectingRoad": str(k + 1)}
        connection = ET.SubElement(element, "connection", ways | {"contactPoint": "start"})
        ET.SubElement(connection, "laneLink", {"from": "-1", "to": "-1"})
    rights = [(stop.lanes, stop.yields_to) for stop in graph.stop_lines]
    rights += [((right.lane,), right.yields_to) for right in graph.stated_rights]
    for yielding_lanes, lanes_first in rights:
        onward = {after for lane in yielding_lanes for after in graph.after(lane)}
        low = [k for k, road in members.items() if onward & set(road.lanes)]
        high = [k for k, road in members.items() if set(lanes_first) & set(road.lanes)]
        for preferred in high:
            for yielding in low:
                ET.SubElement(element, "priority", {"high": str(preferred + 1), "low": str(yielding + 1)})


def _write_object(objects: ET.Element, feature: Feature, road: Road) -> None:
    """Write a marking or symbol as an object beside the nearest point of its road's course."""
    stations = road.course.stations
    corners = feature.xyz_map[feature.ring]
    centre = corners[:, :2].mean(axis=0)
    k = int(np.argmin(((stations.points - centre) ** 2).sum(axis=1)))
    axes = np.stack([stations.ahead[k], turned_left(stations.ahead[k])])
    t_m = float((centre - stations.points[k]) @ axes[1])
    local = (corners[:, :2] - stations.points[k] - t_m * axes[1]) @ axes.T
    length_m, width_m = np.ptp(local, axis=0)
    place = {"s": _text(stations.s_m[k]), "t": _text(t_m), "zOffset": "0", "hdg": "0"}
    size = {"length": _text(length_m), "width": _text(width_m), "height": "0", "orientation": "none"}
    name = feature.kind if feature.reading is None else feature.reading.text
    kind = "crosswalk" if feature.kind == CROSSWALK else "roadMark"
    about = {"id": str(feature.id), "name": name, "type": kind}
    element = ET.SubElement(objects, "object", about | place | size)
    outline = ET.SubElement(ET.SubElement(element, "outlines"), "outline", {"id": "0", "closed": "true"})
    heights_m = (corners[:, 2] - road.heights_m[k]).tolist()
    for number, ((u, v), z) in enumerate(zip(local.tolist(), heights_m, strict=True)):
        corner = {"u": _text(u), "v": _text(v), "z": _text(z), "height": "0", "id": str(number)}
        ET.SubElement(outline, "cornerLocal", corner)
    if feature.accuracy is not None:
        ET.SubElement(element, "userData", {"code": "accuracy", "value": feature.accuracy})
    keys = COMPOSITION if feature.reading is None else (*COMPOSITION, "class", *TEXT_READ)
    for key in keys:
        if (value := properties_of(feature).get(key)) is not None:
            ET.SubElement(element, "userData", {"code": key, "value": in_words(value)})


def _cubic(start: float, growth: float) -> dict[str, str]:
    return {"a": _text(start), "b": _text(growth), "c": "0", "d": "0"}


def _text(value: float) -> str:
    return f"{value:.9g}" if abs(value) < 1e5 else repr(float(value))
