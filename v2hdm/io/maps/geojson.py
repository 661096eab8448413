"""Writing an HD map as GeoJSON (RFC 7946), without loss.

With a geodetic origin the geometry is WGS84, as the RFC demands; without one local metres, as the foreign
member ``v2hdm`` states; in another system that and ``crs`` of GeoJSON 2008, by which GDAL goes, name it. The
properties ``corners_map`` and ``points_map`` hold the local coordinates at full precision, ``heights_m`` the
ground's heights in the map frame. With heights or an origin, positions have a third coordinate, in m: above
the ellipsoid, or above the local z = 0.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.geometry.geodetic import Grid
from v2hdm.io.maps.features import Feature, features_of, properties_of
from v2hdm.io.maps.reading import RESOLUTION
from v2hdm.records import FloatArray, GeodeticOrigin, HDMap
from v2hdm.store.files import replace_text

_WGS84 = "WGS84 longitude and latitude, degrees, and height above the ellipsoid, metres"
_LOCAL = "local map frame, metres east and north, up where known; NOT longitude and latitude"
_DEGREE_DECIMALS = 11  # decimals of a longitude or latitude in degrees: 0.001 mm on the ground
_HEIGHT_DECIMALS = 5  # decimals of a height in m: 0.01 mm


def write_geojson(
    hd_map: HDMap, path: Path, verdict: Mapping[str, Any] | None = None, grid: Grid | None = None
) -> None:
    """Write ``hd_map`` to ``path`` as a FeatureCollection, atomically, in a ``grid`` if there is one.

    Markings become Polygons (closed, counter-clockwise), lanes LineStrings. The ``verdict`` on the run that
    made the map, as JSON, stands in the foreign member ``v2hdm``.
    """
    features = []
    for feature in features_of(hd_map):
        positions = _rounded(feature.positions(grid or hd_map.origin), grid or hd_map.origin)
        if feature.closed:
            shape = "Polygon"
            coordinates: list[Any] = [[*positions, positions[0]]]
        else:
            shape = "LineString"
            coordinates = positions
        features.append(geojson_feature(feature.id, shape, coordinates, properties_of(feature)))

    about: dict[str, Any] = {"largest_id": max([hd_map.largest_id, *(feature["id"] for feature in features)])}
    if hd_map.drift_over_m is not None:
        about["drift_over_m"] = hd_map.drift_over_m
    if verdict is not None:
        about["verdict"] = dict(verdict)
    write_features(path, features, hd_map.origin, about, grid)


def write_features(
    path: Path,
    features: Sequence[Mapping[str, Any]],
    origin: GeodeticOrigin | None,
    about: Mapping[str, Any],
    grid: Grid | None = None,
) -> None:
    """Write GeoJSON ``features``, one a line, atomically, with the frame and ``about`` under ``v2hdm``."""
    frame: dict[str, Any] = {"frame": "map", "coordinates": _LOCAL if origin is None else _WGS84}
    if origin is not None:
        frame["origin"] = asdict(origin)
    decimals = (_DEGREE_DECIMALS, _HEIGHT_DECIMALS)
    members_of_gis: dict[str, Any] = {}
    if grid is not None:
        frame |= {"crs": grid.crs} | ({"coordinates": _LOCAL} if grid.is_local else {"coordinates": grid.crs})
        name = f"urn:ogc:def:crs:{grid.crs.upper().replace(':', '::')}"
        members_of_gis = {} if grid.is_local else {"crs": {"type": "name", "properties": {"name": name}}}
    elif origin is not None:
        members_of_gis = {key: 10.0**-count for key, count in zip(RESOLUTION, decimals, strict=True)}
    members = {"type": "FeatureCollection", **members_of_gis, "v2hdm": frame | dict(about)}
    head = json.dumps(members, allow_nan=False)
    lines = ",\n".join(json.dumps(feature, allow_nan=False) for feature in features)
    replace_text(path, f'{head[:-1]}, "features": [\n{lines}\n]}}\n')


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
    return _rounded(Feature(0, "", points_map, 0, False, heights_m).positions(origin), origin)


def _rounded(positions: FloatArray, origin: GeodeticOrigin | Grid | None) -> list[list[float]]:
    if isinstance(origin, GeodeticOrigin):
        heights_m = np.round(positions[:, 2], _HEIGHT_DECIMALS)
        positions = np.column_stack([np.round(positions[:, :2], _DEGREE_DECIMALS), heights_m])
    rounded: list[list[float]] = positions.tolist()
    return rounded
