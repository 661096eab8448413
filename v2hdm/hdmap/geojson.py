"""An HD map as GeoJSON (RFC 7946), and back without loss.

With a geodetic origin the geometry is WGS84 longitude and latitude, as the RFC demands, and any GIS
shows the map in its place. Without one it is local metres, which the foreign member ``v2hdm`` says
under ``coordinates``. Either way the properties ``corners_map``, ``points_map`` and ``outline_map`` hold the
local coordinates at full precision; reading back uses these. ``heights_m`` are the ground's heights in the
map frame. Where there are any, or an origin, positions have a third coordinate, in m: above the ellipsoid, or
above the local z = 0.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.fields import take_covariance, take_origin, take_whole
from v2hdm.files import load_json, replace_text, take_array, take_mapping, take_number, take_text
from v2hdm.geometry.planar import signed_area
from v2hdm.hdmap.geodetic import geodetic_from_enu
from v2hdm.records import FloatArray, GeodeticOrigin, HdMap, Lane, Marking, Symbol

_WGS84 = "WGS84 longitude and latitude, degrees, and height above the ellipsoid, metres"
_LOCAL = "local map frame, metres east and north, up where known; NOT longitude and latitude"
_MOST_SIGHTINGS = 1_000_000_000
_DEGREE_DECIMALS = 9  # 0.1 mm on the ground
_HEIGHT_DECIMALS = 4


def write_geojson(hd_map: HdMap, path: Path, verdict: Mapping[str, Any] | None = None) -> None:
    """Write ``hd_map`` to ``path`` as a FeatureCollection, atomically.

    Markings and symbols become Polygons (closed, counter-clockwise), lanes LineStrings. The ``verdict`` on
    the run that made the map, as JSON, stands in the foreign member ``v2hdm``.
    """
    features = [
        _marking_feature(number, marking, hd_map.origin) for number, marking in enumerate(hd_map.markings)
    ]
    features += [_lane_feature(number, lane, hd_map.origin) for number, lane in enumerate(hd_map.lanes)]
    features += [_symbol_feature(number, one, hd_map.origin) for number, one in enumerate(hd_map.symbols)]
    write_features(path, features, hd_map.origin, {} if verdict is None else {"verdict": dict(verdict)})


def write_features(
    path: Path, features: Sequence[Mapping[str, Any]], origin: GeodeticOrigin | None, about: Mapping[str, Any]
) -> None:
    """Write GeoJSON ``features`` a line each, atomically, with the frame and ``about`` under ``v2hdm``."""
    told: dict[str, Any] = {"frame": "map", "coordinates": _LOCAL if origin is None else _WGS84}
    if origin is not None:
        told["origin"] = asdict(origin)
    head = json.dumps(told | dict(about), allow_nan=False)
    lines = ",\n".join(json.dumps(feature, allow_nan=False) for feature in features)
    text = f'{{"type": "FeatureCollection", "v2hdm": {head}, "features": [\n{lines}\n]}}\n'
    replace_text(path, text)


def read_verdict(path: Path) -> Mapping[str, Any] | None:
    """The verdict that :func:`write_geojson` wrote beside a map, None where there is none.

    Raises:
        MapFileError: when the file is missing or damaged.
    """
    about = load_json(path, MapFileError).get("v2hdm")
    verdict = about.get("verdict") if isinstance(about, dict) else None
    return verdict if isinstance(verdict, dict) else None


def read_geojson(path: Path) -> HdMap:
    """Read what :func:`write_geojson` wrote; markings, lanes and symbols keep their order.

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
    symbols: list[Symbol] = []
    for number, feature in enumerate(features):
        where = f"{path}: feature {number}"
        properties = take_mapping(
            take_mapping(feature, where, MapFileError).get("properties"), where, MapFileError
        )
        if "corners_map" in properties:
            markings.append(_read_marking(properties, where))
        elif "points_map" in properties:
            lanes.append(_read_lane(properties, where))
        elif "outline_map" in properties:
            symbols.append(_read_symbol(properties, where))
        else:
            raise MapFileError(f"{where}: has no 'corners_map', 'points_map' or 'outline_map'; add one")
    return HdMap(
        markings=tuple(markings),
        lanes=tuple(lanes),
        origin=take_origin(about.get("origin"), f"{path}: origin", MapFileError),
        symbols=tuple(symbols),
    )


def _marking_feature(number: int, marking: Marking, origin: GeodeticOrigin | None) -> dict[str, Any]:
    corners = marking.corners_map
    turn = slice(None) if signed_area(corners) >= 0 else slice(None, None, -1)
    heights = marking.heights_m
    ring = geojson_positions(corners[turn], None if heights is None else heights[turn], origin)
    properties: dict[str, Any] = {
        "id": number,
        "class": marking.kind,
        "sightings": marking.sightings,
        "corners_map": corners.tolist(),
    }
    if heights is not None:
        properties["heights_m"] = heights.tolist()
    if marking.covariance_m2 is not None:
        properties["sigma_m"] = float(np.sqrt(np.trace(marking.covariance_m2) / len(marking.covariance_m2)))
        properties["covariance_m2"] = marking.covariance_m2.tolist()
    if marking.relative_sigma_m is not None:
        properties["relative_sigma_m"] = marking.relative_sigma_m
    return geojson_feature(f"marking/{number}", "Polygon", [[*ring, ring[0]]], properties)


def _lane_feature(number: int, lane: Lane, origin: GeodeticOrigin | None) -> dict[str, Any]:
    properties: dict[str, Any] = {
        "id": number,
        "class": lane.kind,
        "sightings": lane.sightings,
        "points_map": lane.points_map.tolist(),
    }
    if lane.heights_m is not None:
        properties["heights_m"] = lane.heights_m.tolist()
    places = geojson_positions(lane.points_map, lane.heights_m, origin)
    return geojson_feature(f"lane/{number}", "LineString", places, properties)


def _symbol_feature(number: int, symbol: Symbol, origin: GeodeticOrigin | None) -> dict[str, Any]:
    properties: dict[str, Any] = {
        "id": number,
        "class": symbol.kind,
        "sightings": symbol.sightings,
        "outline_map": symbol.outline_map.tolist(),
    }
    if symbol.heights_m is not None:
        properties["heights_m"] = symbol.heights_m.tolist()
    if symbol.sigma_m is not None:
        properties["sigma_m"] = symbol.sigma_m
    ring = geojson_positions(symbol.outline_map, symbol.heights_m, origin)
    return geojson_feature(f"symbol/{number}", "Polygon", [[*ring, ring[0]]], properties)


def geojson_feature(
    identity: str, geometry: str, coordinates: list[Any], properties: dict[str, Any]
) -> dict[str, Any]:
    """A feature of a FeatureCollection."""
    return {
        "type": "Feature",
        "id": identity,
        "geometry": {"type": geometry, "coordinates": coordinates},
        "properties": properties,
    }


def geojson_positions(
    points_map: FloatArray, heights_m: FloatArray | None, origin: GeodeticOrigin | None
) -> list[list[float]]:
    """Positions of ground points (N, 2): longitude, latitude and height, or local metres."""
    if origin is None:
        local = points_map if heights_m is None else np.column_stack([points_map, heights_m])
        metres: list[list[float]] = local.tolist()
        return metres
    ground = np.column_stack([points_map, np.zeros(len(points_map)) if heights_m is None else heights_m])
    latitude, longitude, height_m = geodetic_from_enu(origin, ground).T
    degrees = np.round(np.column_stack([longitude, latitude]), _DEGREE_DECIMALS)
    positions: list[list[float]] = np.column_stack([degrees, np.round(height_m, _HEIGHT_DECIMALS)]).tolist()
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
        heights_m=_read_heights(properties, 4, where),
        relative_sigma_m=None
        if relative is None
        else take_number(relative, f"{where}, relative_sigma_m", MapFileError),
    )


def _read_lane(properties: dict[str, Any], where: str) -> Lane:
    points_map = take_array(properties["points_map"], (-1, 2), f"{where}, points_map", MapFileError)
    return Lane(
        kind=take_text(properties.get("class"), f"{where}, class", MapFileError),
        points_map=points_map,
        sightings=take_whole(
            properties.get("sightings"), 0, _MOST_SIGHTINGS, f"{where}, sightings", MapFileError
        ),
        heights_m=_read_heights(properties, len(points_map), where),
    )


def _read_symbol(properties: dict[str, Any], where: str) -> Symbol:
    outline_map = take_array(properties["outline_map"], (-1, 2), f"{where}, outline_map", MapFileError)
    sigma_m = properties.get("sigma_m")
    return Symbol(
        kind=take_text(properties.get("class"), f"{where}, class", MapFileError),
        outline_map=outline_map,
        sightings=take_whole(
            properties.get("sightings"), 0, _MOST_SIGHTINGS, f"{where}, sightings", MapFileError
        ),
        sigma_m=None if sigma_m is None else take_number(sigma_m, f"{where}, sigma_m", MapFileError),
        heights_m=_read_heights(properties, len(outline_map), where),
    )


def _read_heights(properties: dict[str, Any], count: int, where: str) -> FloatArray | None:
    if "heights_m" not in properties:
        return None
    return take_array(properties["heights_m"], (count,), f"{where}, heights_m", MapFileError)
