"""An OSM document in a projector of Autoware's: nodes, ways and relations; ids follow from the map's."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence

import numpy as np

from v2hdm.errors import ConfigError, need
from v2hdm.geometry.geodetic import geodetic_from_enu, position_of
from v2hdm.io.maps.features import Feature
from v2hdm.records import FloatArray, GeodeticOrigin
from v2hdm.store.files import xml_text

LOCAL, LOCAL_CARTESIAN, MGRS = PROJECTORS = ("Local", "LocalCartesian", "MGRS")
"""Autoware's projectors that this format knows, by their names in ``map_projector_info.yaml``."""

_DEGREE_DECIMALS = 12  # decimals of a longitude or latitude in degrees: 1e-7 m; JOSM writes 11
_HEIGHT_DECIMALS = 6  # decimals of a height in m

# Ids of nodes, ways and relations that are parts of a feature, such as its vertices:
_FIRST_PART = 1 << 40  # smallest id of a part: above all ids of features, and exact in every language
PARTS = 1 << 20  # ids that each feature has for its parts
MOST_VERTICES = PARTS // 2  # the lower half of a feature's parts, those of its vertices

# Lanelet2 reads no node without latitude and longitude: local maps lie where the equator meets Greenwich.
_NOWHERE = GeodeticOrigin(0.0, 0.0, 0.0)


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


class Document:
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
        place_of_node = {part(owner, first + number): place for number, place in enumerate(xyz_map)}
        self._nodes |= place_of_node
        return list(place_of_node)

    def way(self, number: int, nodes: Sequence[int], tags: Mapping[str, str]) -> None:
        """Write a way through nodes."""
        way = ET.Element("way", id=str(number))
        self._elements.append(way)
        for node in nodes:
            ET.SubElement(way, "nd", ref=str(node))
        add_tags(way, tags)

    def relation(self, number: int, members: Sequence[tuple[str, int, str]], tags: Mapping[str, str]) -> None:
        """Write a relation of members, each with its kind, id and role."""
        relation = ET.Element("relation", id=str(number))
        self._elements.append(relation)
        for kind, ref, role in members:
            ET.SubElement(relation, "member", type=kind, ref=str(ref), role=role)
        add_tags(relation, tags)

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
            add_tags(element, tags)
        return square

    def text(self) -> str:
        """The document, ways before relations."""
        self._root.extend(sorted(self._elements, key=lambda element: element.tag != "way"))
        return xml_text(self._root)


def part(owner: Feature, number: int) -> int:
    """The id of a part of a feature, by the number of the part."""
    return _FIRST_PART + owner.id * PARTS + number


def add_tags(element: ET.Element, tags: Mapping[str, str]) -> None:
    """Write the tags of a node, way or relation."""
    for key, value in tags.items():
        ET.SubElement(element, "tag", k=key, v=value)
