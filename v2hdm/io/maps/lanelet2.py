"""Writing an HD map as Lanelet2 OSM in the dialect of Autoware, with its ``map_projector_info.yaml``.

Every marking is a polygon ``pose_marker`` of four counter-clockwise vertices, a landmark for localisation;
lane lines are line strings, and lanes of the lane graph lanelets: neighbours share a line, and one lanelet
starts with the nodes at which the one before ends. A bound is ``virtual`` where no paint shows it. A stop
line is a line string as well, with the regulatory element that Autoware's map validator asks for: a
``traffic_sign``, as Lanelet2 has no word for paint alone, whose sign is a line beside the paint, tagged
``virtual``; or, of a give-way line, the ``right_of_way`` of the lanelets whose way its own lanelets cross. A
crosswalk is a polygon ``crosswalk_polygon`` and a lanelet ``crosswalk`` between two ``zebra_marking`` lines
along the ends of its bars; other symbols, and the areas of text and boxes, are polygons ``road_symbol``.
Other ids follow from the map's, so that they stay when it is written again.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from v2hdm.errors import ConfigError, MapFileError, shown
from v2hdm.geometry.geodetic import position_of
from v2hdm.io.maps.features import COMPOSITION, TEXT_READ, Feature, features_of, in_words, properties_of
from v2hdm.io.maps.lanelets import Lanelets, line_tags
from v2hdm.io.maps.osm import LOCAL, LOCAL_CARTESIAN, MOST_VERTICES, PROJECTORS, Document, part
from v2hdm.records import CROSSWALK, HDMap
from v2hdm.store.files import dump_yaml, replace_text
from v2hdm.topology.build import lane_graph
from v2hdm.topology.graph import LaneGraph


def write_lanelet2(
    hd_map: HDMap, path: Path, projector: str | None = None, graph: LaneGraph | None = None
) -> None:
    """Write ``hd_map`` to ``path`` and ``map_projector_info.yaml`` beside it, each atomically.

    Without a ``projector`` of :data:`PROJECTORS` it is ``LocalCartesian`` for a map with an origin, else
    ``Local``. ``graph`` is the map's lane graph, without which no drive is known. Raises ConfigError when
    the projector does not suit the map, MapFileError when a line has too many vertices.
    """
    projector = projector or (LOCAL if hd_map.origin is None else LOCAL_CARTESIAN)
    if projector not in PROJECTORS:
        raise ConfigError(f"unknown projector {shown(projector)}; choose from: {', '.join(PROJECTORS)}")
    if hd_map.origin is None and projector != LOCAL:
        problem = f"the map has no origin on the earth, which the projector {projector} needs"
        raise ConfigError(f"{problem}: choose {LOCAL}")
    features = features_of(hd_map)
    for feature in features:
        if len(feature.points_map) >= MOST_VERTICES:
            raise MapFileError(f"feature {feature.id}: more than {MOST_VERTICES} vertices; split it")
    document = Document(hd_map.origin, projector)
    graph = lane_graph(hd_map) if graph is None else graph
    lanelets = Lanelets(document, graph, [feature for feature in features if not feature.closed])
    for feature in features:
        if feature.kind == CROSSWALK and len(feature.points_map) == 4:
            _write_crosswalk(document, feature)
        elif feature.symbol:
            outline = document.nodes(feature, feature.xyz_map[feature.ring])
            tags = {"type": "road_symbol", "subtype": feature.kind, "area": "yes"}
            document.way(feature.id, outline, tags | _more_tags(feature))
        elif feature.closed:
            _write_marking(document, feature)
        else:
            nodes = lanelets.vertices[feature.id]
            document.way(feature.id, nodes, line_tags(feature) | _more_tags(feature))
    for stop_line in graph.stop_lines:  # markings come first among features
        lanelets.write_stop_line(features[stop_line.marking], stop_line)
    for right in graph.stated_rights:
        lanelets.write_right(right)
    lanelets.write()
    square = document.place_nodes()
    replace_text(path, document.text())
    info: dict[str, Any] = {"projector_type": projector}
    if projector != LOCAL and hd_map.origin is not None:
        latitude, longitude, altitude = position_of(hd_map.origin)[0].tolist()
        map_origin = {"latitude": latitude, "longitude": longitude, "altitude": altitude}
        where = {"map_origin": map_origin} if square is None else {"mgrs_grid": square}
        info |= {"vertical_datum": "WGS84"} | where
    replace_text(path.with_name("map_projector_info.yaml"), dump_yaml(info))


def _write_marking(document: Document, feature: Feature) -> None:
    corners = feature.xyz_map[feature.ring]
    tags = {"type": "pose_marker", "subtype": feature.kind, "area": "yes", "marker_id": str(feature.id)}
    document.way(feature.id, document.nodes(feature, corners), tags | _more_tags(feature))


def _write_crosswalk(document: Document, feature: Feature) -> None:
    """The polygon and the lanelet of Autoware's vm-05-01; its rule, Lanelet2 itself would not read."""
    corners = feature.xyz_map  # the ends of its bars are the first two, and the last two
    nodes = document.nodes(feature, corners)
    ring = [nodes[k] for k in feature.ring]
    document.way(feature.id, ring, {"type": "crosswalk_polygon", "area": "yes"} | _more_tags(feature))
    ends = ((nodes[3], nodes[2]), (nodes[0], nodes[1]))
    numbers = [part(feature, MOST_VERTICES + k) for k in range(3)]
    for number, way in zip(numbers, ends, strict=False):
        document.way(number, way, {"type": "zebra_marking"})
    left, right, lanelet_id = numbers
    tags = {"type": "lanelet", "subtype": "crosswalk", "location": "urban", "one_way": "no"}
    bounds = [("way", left, "left"), ("way", right, "right")]
    document.relation(lanelet_id, bounds, tags | {"participant:pedestrian": "yes"})


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
