"""An HD map as GeoJSON (RFC 7946), and back without loss.

With a geodetic origin the geometry is WGS84 longitude and latitude, as the RFC demands, and any GIS
shows the map in its place. Without one it is local metres, which the foreign member ``v2hdm`` says
under ``coordinates``. Either way the properties ``corners_map`` and ``points_map`` hold the local
coordinates at full precision; reading back uses these.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.fields import take_covariance, take_origin, take_whole
from v2hdm.files import load_json, replace_text, take_array, take_mapping, take_number, take_text
from v2hdm.hdmap.geodetic import geodetic_from_enu
from v2hdm.records import FloatArray, GeodeticOrigin, HdMap, Lane, Marking

_WGS84 = "WGS84 longitude and latitude, degrees"
_LOCAL = "local map frame, metres east and north; NOT longitude and latitude"
_MOST_SIGHTINGS = 1_000_000_000
_DEGREE_DECIMALS = 9  # 0.1 mm on the ground


def write_geojson(hd_map: HdMap, path: Path) -> None:
    """Write ``hd_map`` to ``path`` as a FeatureCollection, atomically.

    Markings become Polygons (closed, counter-clockwise), lanes LineStrings.
    """
    features = [
        _marking_feature(number, marking, hd_map.origin) for number, marking in enumerate(hd_map.markings)
    ]
    features += [_lane_feature(number, lane, hd_map.origin) for number, lane in enumerate(hd_map.lanes)]
    about: dict[str, Any] = {"frame": "map", "coordinates": _LOCAL if hd_map.origin is None else _WGS84}
    if hd_map.origin is not None:
        about["origin"] = asdict(hd_map.origin)
    lines = ",\n".join(json.dumps(feature, allow_nan=False) for feature in features)
    text = f'{{"type": "FeatureCollection", "v2hdm": {json.dumps(about)}, "features": [\n{lines}\n]}}\n'
    replace_text(path, text)


def read_geojson(path: Path) -> HdMap:
    """Read what :func:`write_geojson` wrote; markings and lanes keep their order.

    Raises:
        MapFileError: when the file is missing, damaged or no map of this format.
    """
    content = load_json(path, MapFileError)
    about, features = content.get("v2hdm"), content.get("features")
    if not isinstance(about, dict) or not isinstance(features, list):
        raise MapFileError(
            f"{path}: not a map written by v2hdm (no 'v2hdm' member or no 'features'); give one that is"
        )
    markings: list[Marking] = []
    lanes: list[Lane] = []
    for number, feature in enumerate(features):
        where = f"{path}: feature {number}"
        properties = take_mapping(
            take_mapping(feature, where, MapFileError).get("properties"), where, MapFileError
        )
        if "corners_map" in properties:
            markings.append(_read_marking(properties, where))
        elif "points_map" in properties:
            lanes.append(_read_lane(properties, where))
        else:
            raise MapFileError(
                f"{where}: has neither 'corners_map' nor 'points_map'; add one or drop the feature"
            )
    return HdMap(
        markings=tuple(markings),
        lanes=tuple(lanes),
        origin=take_origin(about.get("origin"), f"{path}: origin", MapFileError),
    )


def _marking_feature(number: int, marking: Marking, origin: GeodeticOrigin | None) -> dict[str, Any]:
    corners = marking.corners_map
    x, y = corners.T
    counter_clockwise = float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) >= 0.0
    ring = corners if counter_clockwise else corners[::-1]
    properties: dict[str, Any] = {
        "id": number,
        "class": marking.kind,
        "sightings": marking.sightings,
        "corners_map": corners.tolist(),
    }
    if marking.covariance_m2 is not None:
        properties["sigma_m"] = float(np.sqrt(np.trace(marking.covariance_m2) / len(marking.covariance_m2)))
        properties["covariance_m2"] = marking.covariance_m2.tolist()
    if marking.relative_sigma_m is not None:
        properties["relative_sigma_m"] = marking.relative_sigma_m
    closed = np.vstack([ring, ring[:1]])
    return _feature(f"marking/{number}", "Polygon", [_positions(closed, origin)], properties)


def _lane_feature(number: int, lane: Lane, origin: GeodeticOrigin | None) -> dict[str, Any]:
    properties = {
        "id": number,
        "class": lane.kind,
        "sightings": lane.sightings,
        "points_map": lane.points_map.tolist(),
    }
    return _feature(f"lane/{number}", "LineString", _positions(lane.points_map, origin), properties)


def _feature(
    identity: str, geometry: str, coordinates: list[Any], properties: dict[str, Any]
) -> dict[str, Any]:
    return {
        "type": "Feature",
        "id": identity,
        "geometry": {"type": geometry, "coordinates": coordinates},
        "properties": properties,
    }


def _positions(points_map: FloatArray, origin: GeodeticOrigin | None) -> list[list[float]]:
    """GeoJSON positions of ground points (N, 2): longitude, latitude, or local x, y."""
    if origin is None:
        local: list[list[float]] = points_map.tolist()
        return local
    ground = np.column_stack([points_map, np.zeros(len(points_map))])
    degrees = geodetic_from_enu(origin, ground)[:, [1, 0]]
    positions: list[list[float]] = np.round(degrees, _DEGREE_DECIMALS).tolist()
    return positions


def _read_marking(properties: dict[str, Any], where: str) -> Marking:
    covariance, relative = properties.get("covariance_m2"), properties.get("relative_sigma_m")
    return Marking(
        kind=take_text(properties.get("class"), f"{where}, class", MapFileError),
        corners_map=take_array(properties["corners_map"], (4, 2), f"{where}, corners_map", MapFileError),
        sightings=take_whole(
            properties.get("sightings"), 0, _MOST_SIGHTINGS, f"{where}, sightings", MapFileError
        ),
        covariance_m2=None
        if covariance is None
        else take_covariance(covariance, 8, f"{where}, covariance_m2", MapFileError),
        relative_sigma_m=None
        if relative is None
        else take_number(relative, f"{where}, relative_sigma_m", MapFileError),
    )


def _read_lane(properties: dict[str, Any], where: str) -> Lane:
    return Lane(
        kind=take_text(properties.get("class"), f"{where}, class", MapFileError),
        points_map=take_array(properties["points_map"], (-1, 2), f"{where}, points_map", MapFileError),
        sightings=take_whole(
            properties.get("sightings"), 0, _MOST_SIGHTINGS, f"{where}, sightings", MapFileError
        ),
    )
