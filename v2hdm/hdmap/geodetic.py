"""Between a local east-north-up frame and WGS84 latitude, longitude and height, in plain numpy."""

from __future__ import annotations

import numpy as np

from v2hdm.records import FloatArray, GeodeticOrigin

_SEMI_MAJOR_M = 6378137.0
_FLATTENING = 1.0 / 298.257223563
_SEMI_MINOR_M = _SEMI_MAJOR_M * (1.0 - _FLATTENING)
_ECCENTRICITY2 = _FLATTENING * (2.0 - _FLATTENING)
_SECOND_ECCENTRICITY2 = _ECCENTRICITY2 / (1.0 - _ECCENTRICITY2)


def geodetic_from_enu(origin: GeodeticOrigin, points_map: FloatArray) -> FloatArray:
    """Map points (N, 3) in m to (N, 3): latitude and longitude in degrees, ellipsoidal height in m."""
    origin_ecef, ecef_from_enu = _tangent_frame(origin)
    return _geodetic_from_ecef(points_map @ ecef_from_enu.T + origin_ecef)


def enu_from_geodetic(origin: GeodeticOrigin, geodetic: FloatArray) -> FloatArray:
    """The inverse of :func:`geodetic_from_enu`: (N, 3) degrees, degrees, m to map points (N, 3) in m."""
    origin_ecef, ecef_from_enu = _tangent_frame(origin)
    return np.asarray((_ecef_from_geodetic(geodetic) - origin_ecef) @ ecef_from_enu)


def _tangent_frame(origin: GeodeticOrigin) -> tuple[FloatArray, FloatArray]:
    """Earth-centred position (3,) of the origin and the rotation (3, 3) with the columns E, N, U."""
    position = np.array([[origin.latitude_deg, origin.longitude_deg, origin.altitude_m]])
    lat, lon = np.radians(position[0, :2])
    east = [-np.sin(lon), np.cos(lon), 0.0]
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    return _ecef_from_geodetic(position)[0], np.column_stack([east, north, up])


def _ecef_from_geodetic(geodetic: FloatArray) -> FloatArray:
    lat, lon = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    height_m = geodetic[:, 2]
    normal_m = _SEMI_MAJOR_M / np.sqrt(1.0 - _ECCENTRICITY2 * np.sin(lat) ** 2)
    across_m = (normal_m + height_m) * np.cos(lat)
    along_m = (normal_m * (1.0 - _ECCENTRICITY2) + height_m) * np.sin(lat)
    return np.column_stack([across_m * np.cos(lon), across_m * np.sin(lon), along_m])


def _geodetic_from_ecef(points_ecef: FloatArray) -> FloatArray:
    """Bowring's formula (Survey Review 23, 1976), repeated once: below 1e-9 m near the ground."""
    x, y, z = points_ecef.T
    axis_m = np.hypot(x, y)
    reduced = np.arctan2(z * _SEMI_MAJOR_M, axis_m * _SEMI_MINOR_M)
    lat = reduced
    for _ in range(2):
        lat = np.arctan2(
            z + _SECOND_ECCENTRICITY2 * _SEMI_MINOR_M * np.sin(reduced) ** 3,
            axis_m - _ECCENTRICITY2 * _SEMI_MAJOR_M * np.cos(reduced) ** 3,
        )
        reduced = np.arctan2((1.0 - _FLATTENING) * np.sin(lat), np.cos(lat))
    # This form of the height, unlike p / cos(lat) - N, holds at the poles too.
    normal_m = _SEMI_MAJOR_M / np.sqrt(1.0 - _ECCENTRICITY2 * np.sin(lat) ** 2)
    height_m = axis_m * np.cos(lat) + z * np.sin(lat) - _SEMI_MAJOR_M**2 / normal_m
    return np.column_stack([np.degrees(lat), np.degrees(np.arctan2(y, x)), height_m])
