"""Writing an HD map as XML: OpenDRIVE 1.7 for simulators, LandXML 1.2 for surveyors and road designers.

In OpenDRIVE every lane between two lane lines is a road of its own, without links, for a map of paint does
not say how lanes connect: its reference line is the left line, straight from vertex to vertex, its only lane
``-1`` is as wide as the right line is away. Every marking and symbol is an object ``roadMark``, and every
crosswalk a ``crosswalk``, of the nearest road, its class as its name, its outline exact in the object's own
axes, its accuracy in ``userData``. Double lines are marks such as ``solid broken``. Where no two lines bound
a lane, one road without width runs along the longest line or through the markings and carries them.

In LandXML every feature is a ``PlanFeature`` named by its id, its class as ``desc``, made of straight lines
between points ``northing easting height``. Its ``Feature`` of properties holds sightings and sigma.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v2hdm import __version__
from v2hdm.geometry.geodetic import LOCAL, Grid, crs_of
from v2hdm.geometry.planar import length_along
from v2hdm.io.maps.closed_lanes import Bound, closed_lanes
from v2hdm.io.maps.features import COMPOSITION, TEXT_READ, Feature, features_of, in_words, properties_of
from v2hdm.records import CROSSWALK, LANE_DASH, FloatArray, HDMap
from v2hdm.store.files import replace_text, xml_text

_LEAST_STEP_M = 1e-3  # least length of a piece of a reference line, m: readers refuse shorter geometries


class _Place(NamedTuple):
    """The place on a road's reference line that is nearest to a point."""

    distance_m: float  # from the point
    segment: int
    along_m: float  # from the segment's start


@dataclass(frozen=True)
class _Road:
    """A road with one lane, to the right of its reference line."""

    xyz: FloatArray  # (N, 3) m, the reference line
    width_m: FloatArray  # (N,) of the lane at each vertex
    marks: tuple[str, str]  # types of the marks left and right of the lane

    @property
    def steps(self) -> FloatArray:
        """The way (N - 1, 2) from each vertex to the next, m."""
        return np.diff(self.xyz[:, :2], axis=0)

    @property
    def s_m(self) -> FloatArray:
        """The distance of each vertex along the line (N,)."""
        return length_along(self.xyz[:, :2])

    def nearest(self, point: FloatArray) -> _Place:
        """The place on the reference line nearest to a point (2,)."""
        length = np.diff(self.s_m)
        offset = point - self.xyz[:-1, :2]
        along = np.clip((offset * self.steps).sum(axis=1) / length, 0.0, length)
        away = np.linalg.norm(offset - self.steps * (along / length)[:, None], axis=1)
        segment = int(np.argmin(away))
        return _Place(float(away[segment]), segment, float(along[segment]))


def write_opendrive(hd_map: HDMap, path: Path) -> None:
    """Write ``hd_map`` as OpenDRIVE, atomically, in metres of the map frame, whose projection it states."""
    features = features_of(hd_map)
    roads = _roads(features)
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
        ET.SubElement(header, "geoReference").text = crs_of(hd_map.origin)
    objects = [_write_road(root, number, road) for number, road in enumerate(roads, start=1)]
    for feature in features:
        if feature.closed:
            centre = feature.points_map.mean(axis=0)
            places = [road.nearest(centre) for road in roads]
            k = min(range(len(roads)), key=lambda number: places[number].distance_m)
            _write_object(objects[k], feature, roads[k], places[k])
    replace_text(path, xml_text(root))


def _roads(features: Sequence[Feature]) -> list[_Road]:
    """A road for each closed lane, else one without width that carries all markings."""
    open_features = [feature for feature in features if not feature.closed]
    lines = [line for line in open_features if len(_spaced(line.xyz_map)) > 1]
    roads = []
    for lane in closed_lanes([feature.points_map for feature in lines]):
        left = lines[lane.left.line]
        right = lines[lane.right.line]
        xyz = _spaced(left.xyz_map[lane.left.order])
        beside = _spaced(right.xyz_map[lane.right.order])
        if min(len(xyz), len(beside)) < 2:
            continue
        across = _Road(beside, np.zeros(0), ("", ""))
        width_m = np.array([across.nearest(point).distance_m for point in xyz[:, :2]])
        roads.append(_Road(xyz, width_m, (_mark(left, lane.left), _mark(right, lane.right))))
    if roads:
        return roads
    if lines:
        longest = max(lines, key=lambda line: float(np.linalg.norm(np.ptp(line.points_map, axis=0))))
        xyz = _spaced(longest.xyz_map)
    else:
        xyz = _through_centres(features)
    return [_Road(xyz, np.zeros(len(xyz)), ("none", "none"))]


def _through_centres(features: Sequence[Feature]) -> FloatArray:
    """A straight line (2, 3), m, through the centres of features, at least 2 m long."""
    centres = np.array([feature.xyz_map.mean(axis=0) for feature in features]).reshape(-1, 3)
    middle = centres.mean(axis=0) if len(centres) else np.zeros(3)
    axis = np.linalg.svd(centres - middle)[2][0] if len(centres) > 1 else np.eye(3)[0]
    reach_m = max(float(np.abs((centres - middle) @ axis).max(initial=0.0)), 1.0)
    return np.stack([middle - reach_m * axis, middle + reach_m * axis])


def _spaced(xyz: FloatArray) -> FloatArray:
    """A line without vertices that lie upon one another: a single one where all do."""
    is_next_apart = np.linalg.norm(np.diff(xyz[:, :2], axis=0), axis=1) > _LEAST_STEP_M
    spaced: FloatArray = xyz[np.insert(is_next_apart, 0, True)]
    return spaced


def _mark(line: Feature, bound: Bound) -> str:
    """The type of a bound's mark; that of a double line goes from left to right in its lane's direction.

    OpenDRIVE 1.7: in the centre from left to right, else from the inside out, here on the right of a road.
    """
    left_to_right = line.lines or (line.kind,)
    if bound.order[-1] < bound.order[0]:
        left_to_right = left_to_right[::-1]
    return " ".join("broken" if kind == LANE_DASH else "solid" for kind in left_to_right)


def _write_road(root: ET.Element, number: int, road: _Road) -> ET.Element:
    """Write a road; returns the element of its objects."""
    s_m = road.s_m
    whole = {"name": "", "length": _text(s_m[-1]), "id": str(number), "junction": "-1"}
    element = ET.SubElement(root, "road", whole)
    view = ET.SubElement(element, "planView")
    profile = ET.SubElement(element, "elevationProfile")
    heading = np.arctan2(road.steps[:, 1], road.steps[:, 0])
    slope = np.diff(road.xyz[:, 2]) / np.diff(s_m)
    for k, (x, y, z) in enumerate(road.xyz[:-1].tolist()):
        place = {"s": _text(s_m[k]), "x": _text(x), "y": _text(y), "hdg": _text(heading[k])}
        geometry = ET.SubElement(view, "geometry", place | {"length": _text(s_m[k + 1] - s_m[k])})
        ET.SubElement(geometry, "line")
        ET.SubElement(profile, "elevation", {"s": _text(s_m[k])} | _cubic(z, slope[k]))
    section = ET.SubElement(ET.SubElement(element, "lanes"), "laneSection", {"s": "0"})
    mark = {"sOffset": "0", "weight": "standard", "color": "standard", "width": "0.15"}
    middle = ET.SubElement(
        ET.SubElement(section, "center"), "lane", {"id": "0", "type": "none", "level": "false"}
    )
    ET.SubElement(middle, "roadMark", mark | {"type": road.marks[0]})
    kind = "driving" if road.width_m.any() else "none"
    lane = ET.SubElement(
        ET.SubElement(section, "right"), "lane", {"id": "-1", "type": kind, "level": "false"}
    )
    growth = np.diff(road.width_m) / np.diff(s_m)
    for k, width_m in enumerate(road.width_m[:-1].tolist()):
        ET.SubElement(lane, "width", {"sOffset": _text(s_m[k])} | _cubic(width_m, growth[k]))
    ET.SubElement(lane, "roadMark", mark | {"type": road.marks[1]})
    return ET.SubElement(element, "objects")


def _write_object(objects: ET.Element, feature: Feature, road: _Road, nearest: _Place) -> None:
    """Write a marking or symbol as an object at the ``nearest`` place of its road."""
    segment = nearest.segment
    ahead = road.steps[segment] / np.linalg.norm(road.steps[segment])
    axes = np.stack([ahead, [-ahead[1], ahead[0]]])
    start = road.xyz[segment, :2] + nearest.along_m * ahead
    s_m = road.s_m[segment] + nearest.along_m
    height_m = np.interp(s_m, road.s_m, road.xyz[:, 2])
    corners = feature.xyz_map[feature.ring]
    t_m = float((corners[:, :2].mean(axis=0) - start) @ axes[1])
    local = (corners[:, :2] - start - t_m * axes[1]) @ axes.T
    length_m, width_m = np.ptp(local, axis=0)
    place = {"s": _text(s_m), "t": _text(t_m), "zOffset": "0", "hdg": "0"}
    size = {"length": _text(length_m), "width": _text(width_m), "height": "0", "orientation": "none"}
    name = feature.kind if feature.reading is None else feature.reading.text
    kind = "crosswalk" if feature.kind == CROSSWALK else "roadMark"
    about = {"id": str(feature.id), "name": name, "type": kind}
    element = ET.SubElement(objects, "object", about | place | size)
    outline = ET.SubElement(ET.SubElement(element, "outlines"), "outline", {"id": "0", "closed": "true"})
    for k, ((u, v), z) in enumerate(zip(local.tolist(), (corners[:, 2] - height_m).tolist(), strict=True)):
        corner = {"u": _text(u), "v": _text(v), "z": _text(z), "height": "0", "id": str(k)}
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


_NAMESPACE = "http://www.landxml.org/schema/LandXML-1.2"


def write_landxml(hd_map: HDMap, path: Path, grid: Grid | None = None) -> None:
    """Write ``hd_map`` as LandXML, atomically, in metres of the ``grid``, else of the map's own frame."""
    grid = grid or Grid(LOCAL, hd_map.origin)
    now = datetime.now(UTC)
    stamp = {"date": now.strftime("%Y-%m-%d"), "time": now.strftime("%H:%M:%S")}
    root = ET.Element("LandXML", {"xmlns": _NAMESPACE, "version": "1.2", **stamp})
    units = {"areaUnit": "squareMeter", "linearUnit": "meter", "volumeUnit": "cubicMeter"}
    more = {"temperatureUnit": "celsius", "pressureUnit": "milliBars", "angularUnit": "decimal degrees"}
    ET.SubElement(ET.SubElement(root, "Units"), "Metric", units | more)
    system = {"desc": ", ".join(f"{key} {value}" for key, value in grid.stated.items())}
    if grid.crs.upper().startswith("EPSG:"):
        system["epsgCode"] = grid.crs[5:]
    ET.SubElement(root, "CoordinateSystem", system)
    ET.SubElement(root, "Application", {"name": "v2hdm", "version": __version__})
    group = ET.SubElement(root, "PlanFeatures", {"name": "markings"})
    for feature in features_of(hd_map):
        element = ET.SubElement(group, "PlanFeature", {"name": str(feature.id), "desc": feature.kind})
        geometry = ET.SubElement(element, "CoordGeom")
        east_first = feature.positions(grid).tolist()
        points = [f"{north:.4f} {east:.4f} {up:.4f}" for east, north, up in east_first]
        for start, end in pairwise([*points, points[0]] if feature.closed else points):
            line = ET.SubElement(geometry, "Line")
            ET.SubElement(line, "Start").text = start
            ET.SubElement(line, "End").text = end
        about = ET.SubElement(element, "Feature", {"code": "v2hdm"})
        for key, value in properties_of(feature).items():
            if not isinstance(value, list) or key in COMPOSITION:
                text = f"{value:.5g}" if isinstance(value, float) else in_words(value)
                ET.SubElement(about, "Property", {"label": key, "value": text})
    replace_text(path, xml_text(root))
