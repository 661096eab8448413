"""An HD map as GeoJSON (RFC 7946), and back without loss.

With a geodetic origin the geometry is WGS84 longitude and latitude, as the RFC demands, and any GIS
shows the map in its place. Without one it is local metres, which the foreign member ``v2hdm`` says
under ``coordinates``. The geometry is the truth when a map is read, so that edits survive. The properties
``corners_map`` and ``points_map`` hold the local coordinates at full precision, and stand where they agree
with the geometry to 0.1 mm, or to a coarser ``xy_coordinate_resolution`` and ``z_coordinate_resolution``.
``heights_m`` are the ground's heights in the map frame. Where there are any, or an origin, positions have a
third coordinate, in m: above the ellipsoid, or above the local z = 0.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.geometry.geodetic import geodetic_from_enu
from v2hdm.io.maps.features import LARGEST_ID, Feature, FeatureReader, Geometry, features_of, properties_of
from v2hdm.io.safe.fields import take_origin, take_whole
from v2hdm.records import FloatArray, GeodeticOrigin, HdMap
from v2hdm.store.files import load_json, replace_text, take_array, take_mapping, take_number

_WGS84 = "WGS84 longitude and latitude, degrees, and height above the ellipsoid, metres"
_LOCAL = "local map frame, metres east and north, up where known; NOT longitude and latitude"
_DEGREE_DECIMALS = 11  # 0.001 mm on the ground
_HEIGHT_DECIMALS = 5
_ROUNDING = np.array([1e-9, 1e-9, 1e-4])
"""Degrees and m, 0.1 mm on the ground, by which positions may be off without an edit: GDAL takes a last digit
after several zeros for noise and drops it, and files of version 0.1 have nine and four decimals."""
_LOCAL_ROUNDING_M = 1e-6
"""Metres are written at full precision; a GIS that rewrites the file keeps 15 digits of them."""

_RESOLUTION = ("xy_coordinate_resolution", "z_coordinate_resolution")
"""Members of a FeatureCollection by which GDAL since 3.9 tells how coordinates are rounded, m or degrees."""


def write_geojson(hd_map: HdMap, path: Path, verdict: Mapping[str, Any] | None = None) -> None:
    """Write ``hd_map`` to ``path`` as a FeatureCollection, atomically.

    Markings become Polygons (closed, counter-clockwise), lanes LineStrings. The ``verdict`` on the run that
    made the map, as JSON, stands in the foreign member ``v2hdm``.
    """
    features = [_feature(one, hd_map.origin) for one in features_of(hd_map)]
    about: dict[str, Any] = {"largest_id": max([hd_map.largest_id, *(one["id"] for one in features)])}
    if hd_map.drift_over_m is not None:
        about["drift_over_m"] = hd_map.drift_over_m
    if verdict is not None:
        about["verdict"] = dict(verdict)
    write_features(path, features, hd_map.origin, about)


def write_features(
    path: Path, features: Sequence[Mapping[str, Any]], origin: GeodeticOrigin | None, about: Mapping[str, Any]
) -> None:
    """Write GeoJSON ``features`` a line each, atomically, with the frame and ``about`` under ``v2hdm``."""
    told: dict[str, Any] = {"frame": "map", "coordinates": _LOCAL if origin is None else _WGS84}
    if origin is not None:
        told["origin"] = asdict(origin)
    decimals = (_DEGREE_DECIMALS, _HEIGHT_DECIMALS)
    resolution = {} if origin is None else {k: 10.0**-n for k, n in zip(_RESOLUTION, decimals, strict=True)}
    head = json.dumps(
        {"type": "FeatureCollection", **resolution, "v2hdm": told | dict(about)}, allow_nan=False
    )
    lines = ",\n".join(json.dumps(feature, allow_nan=False) for feature in features)
    replace_text(path, f'{head[:-1]}, "features": [\n{lines}\n]}}\n')


def read_verdict(path: Path) -> Mapping[str, Any] | None:
    """The verdict that :func:`write_geojson` wrote beside a map, None where there is none.

    Raises:
        MapFileError: when the file is missing or damaged.
    """
    about = load_json(path, MapFileError).get("v2hdm")
    verdict = about.get("verdict") if isinstance(about, dict) else None
    return verdict if isinstance(verdict, dict) else None


def read_geojson(path: Path) -> HdMap:
    """Read what :func:`write_geojson` wrote and others may have edited; markings and lanes keep their order.

    Ids that are missing or taken already are given anew. The log says what was edited.

    Raises:
        MapFileError: when the file is missing, damaged or no map of this format.
    """
    content = load_json(path, MapFileError)
    about, features = content.get("v2hdm"), content.get("features")
    if not isinstance(about, dict) or not isinstance(features, list):
        raise MapFileError(
            f"{path}: not a map written by v2hdm (no 'v2hdm' member or no 'features'); give one that is. A "
            "GIS keeps that member when it saves edits in place, and drops it from a copy"
        )
    origin = take_origin(about.get("origin"), f"{path}: origin", MapFileError)
    rounding = np.full(3, _LOCAL_ROUNDING_M) if origin is None else _ROUNDING.copy()
    for axes, key in zip((slice(0, 2), slice(2, 3)), _RESOLUTION, strict=True):
        if key in content:
            rounding[axes] = np.maximum(
                rounding[axes], take_number(content[key], f"{path}: {key}", MapFileError)
            )
    reader = FeatureReader(path, origin, rounding)
    for number, feature in enumerate(features):
        where = f"{path}: feature {number}"
        entry = take_mapping(feature, where, MapFileError)
        properties = take_mapping(entry.get("properties"), where, MapFileError)
        reader.add(properties, _read_geometry(entry.get("geometry"), where), where)
    largest, over_m = about.get("largest_id"), about.get("drift_over_m")
    return replace(
        reader.map(),
        largest_id=0
        if largest is None
        else take_whole(largest, 0, LARGEST_ID, f"{path}: largest_id", MapFileError),
        drift_over_m=None if over_m is None else take_number(over_m, f"{path}: drift_over_m", MapFileError),
    )


def _feature(feature: Feature, origin: GeodeticOrigin | None) -> dict[str, Any]:
    positions = geojson_positions(feature.points_map[feature.ring], feature.ordered_heights_m, origin)
    properties = properties_of(feature)
    if feature.closed:
        return geojson_feature(feature.id, "Polygon", [[*positions, positions[0]]], properties)
    return geojson_feature(feature.id, "LineString", positions, properties)


def _read_geometry(content: object, where: str) -> Geometry | None:
    """A Polygon of one ring, a LineString, or a Multi... of one of them, as a GIS may make of it."""
    if content is None:
        return None
    entry = take_mapping(content, f"{where}, geometry", MapFileError)
    kind, parts = entry.get("type"), entry.get("coordinates")
    closed = kind in ("Polygon", "MultiPolygon")
    if not closed and kind not in ("LineString", "MultiLineString"):
        raise MapFileError(
            f"{where}: its geometry is a {kind}; draw markings as Polygons, lanes as LineStrings"
        )
    for _ in range({"Polygon": 1, "MultiPolygon": 2, "MultiLineString": 1}.get(str(kind), 0)):
        if not isinstance(parts, list) or len(parts) != 1:
            raise MapFileError(f"{where}: its {kind} has holes or several parts; split it")
        (parts,) = parts
    heights = isinstance(parts, list) and bool(parts) and isinstance(parts[0], list) and len(parts[0]) > 2
    positions = take_array(parts, (-1, 3 if heights else 2), f"{where}, coordinates", MapFileError)
    return Geometry(positions[:-1] if closed else positions, closed)


def geojson_feature(
    identity: int | str, geometry: str, coordinates: list[Any], properties: dict[str, Any]
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
