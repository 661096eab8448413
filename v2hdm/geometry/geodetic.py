"""Between the local east-north-up frame, geodetic coordinates and, by PROJ (pyproj), projected ones.

Datums are never transformed. Those whose ellipsoid is WGS84's to a millimetre are satellite datums (WGS84,
ETRS89, NAD83, GDA2020, JGD2011); others are refused: without national grid files they are metres off.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from v2hdm.errors import MapFileError, V2hdmError, need, shown
from v2hdm.geometry.datums import is_same_datum, utm_of
from v2hdm.records import FloatArray, GeodeticOrigin

_SEMI_MAJOR_M = 6378137.0  # semi-major axis, m, of the ellipsoid WGS84 (NGA.STND.0036)
_FLATTENING = 1 / 298.257223563  # flattening of the ellipsoid WGS84 (NGA.STND.0036)
_ECCENTRICITY2 = _FLATTENING * (2 - _FLATTENING)  # square of the first eccentricity of WGS84

_SAME_ELLIPSOID_M = 1e-3  # axes that differ less, m, are of one ellipsoid: GRS80's and WGS84's by 0.1 mm
_WGS84 = ("World Geodetic System 1984", "World Geodetic System 1984 ensemble")  # datum's names in PROJ
_CONFORMAL_DEG = 1e-3  # tolerance, deg, of a conformal grid's angles, for rounding


def geodetic_from_enu(origin: GeodeticOrigin, points_map: FloatArray) -> FloatArray:
    """Map points (N, 3) in m to (N, 3): latitude and longitude in degrees, ellipsoidal height in m."""
    here = position_of(origin)
    return _geodetic_from_ecef(points_map @ enu_axes(here)[0].T + _ecef_from_geodetic(here)[0])


def enu_from_geodetic(origin: GeodeticOrigin, geodetic: FloatArray) -> FloatArray:
    """The inverse of :func:`geodetic_from_enu`: (N, 3) degrees, degrees, m to map points (N, 3) in m."""
    here = position_of(origin)
    return np.asarray((_ecef_from_geodetic(geodetic) - _ecef_from_geodetic(here)[0]) @ enu_axes(here)[0])


def geodetic_from_ecef(points: FloatArray) -> FloatArray:
    """Latitude and longitude in degrees and height in m (N, 3) of earth-centred points (N, 3), m."""
    return _geodetic_from_ecef(points)


def metres_between(places: FloatArray, others: FloatArray) -> FloatArray:
    """Distance (N,) along the ground, m, of latitudes and longitudes (N, 2), deg, that lie close together."""
    north_m = np.radians(others[:, 0] - places[:, 0]) * _SEMI_MAJOR_M
    turn_deg = (others[:, 1] - places[:, 1] + 180) % 360 - 180
    east_m = np.radians(turn_deg) * _SEMI_MAJOR_M * np.cos(np.radians(places[:, 0]))
    return np.asarray(np.hypot(north_m, east_m))


def enu_axes(geodetic: FloatArray) -> FloatArray:
    """Rotations (N, 3, 3), earth-centred from local, with columns east, north, up at points (N, 3)."""
    lat = np.radians(geodetic[:, 0])
    lon = np.radians(geodetic[:, 1])
    east = np.column_stack([-np.sin(lon), np.cos(lon), np.zeros(len(lat))])
    north = np.column_stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    up = np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    return np.stack([east, north, up], axis=2)


def geodetic_from_grid(crs: str, points: FloatArray, where: str, error: type[V2hdmError]) -> FloatArray:
    """Geodetic (N, 3), in its own datum, of easting, northing in the system's unit and ellipsoidal height, m.

    Raises ``error`` if the system is unknown, geographic or of no satellite datum, or points lie outside it.
    """
    system = _system(crs, where, error)
    if not system.is_projected:
        advice = "give latitude and longitude, or a projected system"
        raise error(f"{where}: {crs} is not projected; {advice}")
    lon, lat = _inverse_of(crs).transform(points[:, 0], points[:, 1])
    geodetic = np.column_stack([lat, lon, points[:, 2]])
    if not np.isfinite(geodetic).all():
        raise error(f"{where}: some points lie outside {crs}; check it and the order easting, northing")
    return geodetic


_LONGEST_CRS = 20_000  # letters of a system's description: WKT of a compound one has 5,000
LOCAL = "local"  # name of the map's own frame as a coordinate system
_GRID_DECIMALS = 4  # decimals of a coordinate in metres: 0.1 mm
_DEGREE_DECIMALS = 9  # decimals of a latitude or longitude in degrees: 0.1 mm on the ground
_ZONE_DEG = 6.0  # deg of longitude that a job's grid may reach beyond a zone's edges: one zone
_BESIDE_DEG = 1.0  # deg of longitude that a zone's grid is used beyond the zone's edges


@dataclass(frozen=True)
class Grid:
    """The coordinate system ``crs`` of a map's exports: :data:`LOCAL` or one that PROJ knows.

    Coordinates are easting, northing, rounded to 0.1 mm, and height in m above the ellipsoid, or the local z.
    The datum is the ``origin``'s.
    """

    crs: str
    origin: GeodeticOrigin | None

    @property
    def is_local(self) -> bool:
        """Whether it is the map's own frame."""
        return self.crs == LOCAL

    @classmethod
    def of(
        cls, crs: str, origin: GeodeticOrigin | None, where: str, error: type[V2hdmError], metres: str = ""
    ) -> Grid:
        """The system for a map with this ``origin``; ``metres`` names a format that only holds metres.

        Raises ``error`` if the system is unknown, of another datum, or does not cover the site.
        """
        if crs == LOCAL:
            return cls(crs, origin)
        system = _system(crs, where, error)
        datum = datum_of(crs, where, error)
        if origin is None:
            raise error(f"{where}: {crs} needs an origin on the earth, which the map lacks; give {LOCAL}")
        zone = utm_of(origin)
        fit = zone or f"a projected system on {origin.datum}"
        if (code := system.to_authority(min_confidence=100)) is None:
            raise error(f"{where}: {shown(crs)} has no code that other programs know; give {fit}")
        if system.is_compound or not (system.is_projected or system.is_geographic):
            raise error(f"{where}: {crs} has a vertical part or unusual axes; give its horizontal part")
        if not is_same_datum(datum, origin.datum):
            raise error(
                f"{where}: {crs} is on {datum}, the map on {origin.datum}, which differ by decimetres; give "
                f"{fit}, or state the datum of the drive's poses (drive.yaml, origin, datum)"
            )
        bare = system.is_geographic or system.axis_info[0].unit_conversion_factor != 1.0
        if metres and bare:
            raise error(f"{where}: {metres} holds metres, but {crs} is not in metres; give {fit}")
        west, south, east, north = system.area_of_use.bounds if system.area_of_use else (-180, -90, 180, 90)
        width_deg = (east - west) % 360 or 360
        inside = (origin.longitude_deg - west + _BESIDE_DEG) % 360 <= width_deg + 2 * _BESIDE_DEG
        inside = inside or ":".join(code) == zone  # as in the west of Norway
        if not inside or not south - _BESIDE_DEG <= origin.latitude_deg <= north + _BESIDE_DEG:
            at = f"latitude {origin.latitude_deg:.2f}, longitude {origin.longitude_deg:.2f}"
            raise error(f"{where}: the site, at {at}, lies outside {crs} ({system.name}); give {fit}")
        return cls(":".join(code), origin)

    @property
    def stated(self) -> dict[str, str]:
        """The system, its datum and its epoch, as text."""
        about = {"crs": self.crs}
        if self.origin is not None:
            about["datum"] = self.origin.datum
            if self.origin.epoch is not None:
                about["epoch"] = repr(self.origin.epoch)
        return about

    def positions(self, xyz_map: FloatArray) -> FloatArray:
        """Points (N, 3) of the map in this system, rounded."""
        if self.is_local or self.origin is None:
            return np.round(xyz_map, _GRID_DECIMALS)
        geodetic = geodetic_from_enu(self.origin, xyz_map)
        if is_geographic(self.crs, self.crs, MapFileError):
            across = np.round(geodetic[:, [1, 0]], _DEGREE_DECIMALS)
        else:
            transformer = _inverse_of(self.crs)
            across = np.column_stack(
                transformer.transform(geodetic[:, 1], geodetic[:, 0], direction="INVERSE")
            )
            across = np.round(across, _GRID_DECIMALS)
        return np.column_stack([across, np.round(geodetic[:, 2], _GRID_DECIMALS)])

    def geodetic(self, positions: FloatArray, where: str, error: type[V2hdmError]) -> FloatArray:
        """Longitude, latitude, height (N, 3) of positions on the earth: :meth:`positions` inverted."""
        assert self.origin is not None
        if self.is_local:
            return geodetic_from_enu(self.origin, positions)[:, [1, 0, 2]]
        if is_geographic(self.crs, where, error):
            return positions
        return geodetic_from_grid(self.crs, positions, where, error)[:, [1, 0, 2]]


_ENGINEERING = (
    'LOCAL_CS["V2HDM map frame: east, north in metres from an origin that the drive does not state",'
    'LOCAL_DATUM["local",0],UNIT["metre",1],AXIS["East",EAST],AXIS["North",NORTH]]'
)


def crs_of(origin: GeodeticOrigin | None) -> str:
    """PROJ or WKT text of the map frame.

    With an origin, a transverse Mercator projection about it, scaled to its ellipsoidal height, which every
    GIS knows: within 1 mm of the tangent plane up to 2 km away. It names WGS84, between which and other
    satellite datums a GIS moves nothing. Without an origin, an engineering system.
    """
    if origin is None:
        return _ENGINEERING
    scale = 1 + origin.altitude_m / _SEMI_MAJOR_M
    return (
        f"+proj=tmerc +lat_0={origin.latitude_deg!r} +lon_0={origin.longitude_deg!r} +k={scale!r} "
        "+x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
    )


def convergence_rad(crs: str, points: FloatArray, where: str, error: type[V2hdmError]) -> FloatArray:
    """Grid convergence (N,), clockwise from true to grid north; raises ``error`` also if not conformal."""
    here = geodetic_from_grid(crs, points, where, error)
    pyproj = need("pyproj", "map", f"{where}: crs", error)
    factors = pyproj.Proj(_horizontal(crs)).get_factors(here[:, 1], here[:, 0])
    if np.max(factors.angular_distortion) > _CONFORMAL_DEG:
        raise error(f"{where}: {crs} is not conformal; give headings from true north (heading: true)")
    return np.asarray(np.radians(factors.meridian_convergence))


def datum_of(crs: str, where: str, error: type[V2hdmError]) -> str:
    """Satellite datum of the coordinates of ``crs``, WGS84 spelt ``WGS84``."""
    system = _system(crs, where, error).geodetic_crs
    datum = str(system.name if system.datum is None else system.datum.name)
    if datum in _WGS84:
        return "WGS84"
    # A system by its parameters alone, as OpenDRIVE has it, is "unknown", but its datum has a name. Systems
    # with longitude before latitude have a suffix: NAD83 (CRS83).
    return datum if system.name == "unknown" else re.sub(r" \(CRS\d+\)$", "", str(system.name))


def has_height_datum(crs: str, where: str, error: type[V2hdmError]) -> bool:
    """Whether ``crs`` is a compound system, with heights above sea level rather than the ellipsoid."""
    return bool(_system(crs, where, error).is_compound)


class System(NamedTuple):
    """A coordinate system as PROJ knows it."""

    name: str
    is_geographic: bool  # whether its coordinates are latitude and longitude


def system_of(crs: str, where: str, error: type[V2hdmError]) -> System:
    """The system with the code ``crs``; raises ``error`` if it is unknown or on no satellite datum."""
    system = _system(crs, where, error)
    return System(str(system.name), bool(system.is_geographic))


def is_geographic(crs: str, where: str, error: type[V2hdmError]) -> bool:
    """Whether coordinates of ``crs`` are latitude and longitude."""
    return bool(_system(crs, where, error).is_geographic)


class Units(NamedTuple):
    """The lengths, m, of a system's units, 1 where it counts in degrees or has no height, and their name."""

    horizontal_m: float
    vertical_m: float
    name: str  # of the horizontal one


def units_of(crs: str, where: str, error: type[V2hdmError]) -> Units:
    """The units of a system. Heights of one without any are in the unit of its easting and northing."""
    system = _system(crs, where, error)
    axes = [axis for axis in system.axis_info if axis.unit_name != "degree"]
    if not axes:
        return Units(1.0, 1.0, "degree")
    is_up = [axis.direction == "up" for axis in axes]
    horizontal = 1.0 if is_up[0] else float(axes[0].unit_conversion_factor)
    return Units(horizontal, float(axes[-1].unit_conversion_factor), str(axes[0].unit_name))


def is_in_use(crs: str, geodetic: FloatArray, where: str, error: type[V2hdmError]) -> bool:
    """Whether positions (N, 3) lie no farther than a zone east or west of where a system is in use."""
    area = _system(crs, where, error).area_of_use
    if area is None:
        return True
    width_deg = (area.east - area.west) % 360 or 360
    ahead_deg = (geodetic[:, 1] - area.west + _ZONE_DEG) % 360
    return bool((ahead_deg <= width_deg + 2 * _ZONE_DEG).any())


def _system(crs: str, where: str, error: type[V2hdmError]) -> Any:
    pyproj = need("pyproj", "map", f"{where}: crs", error)
    try:
        if len(crs) > _LONGEST_CRS:
            raise RecursionError
        system = pyproj.CRS.from_user_input(crs)
    except (pyproj.exceptions.CRSError, RecursionError):  # JSON of many levels
        raise error(f"{where}: unknown crs {shown(crs)}; give an EPSG code such as EPSG:25832") from None
    ellipsoid = system.ellipsoid
    if (
        ellipsoid is None
        or abs(ellipsoid.semi_major_metre - _SEMI_MAJOR_M) > _SAME_ELLIPSOID_M
        or abs(ellipsoid.semi_minor_metre - _SEMI_MAJOR_M * (1 - _FLATTENING)) > _SAME_ELLIPSOID_M
    ):
        raise error(
            f"{where}: {crs} ({system.name}) is not on a satellite datum; convert the coordinates to one "
            "with your survey office's transformation (in Europe ETRS89, such as EPSG:25832)"
        )
    return system


@lru_cache(maxsize=8)
def _inverse_of(crs: str) -> Any:
    """The transformer from a projected system to its longitude and latitude."""
    pyproj = need("pyproj", "map", "a projected system", MapFileError)
    horizontal = _horizontal(crs)
    return pyproj.Transformer.from_crs(horizontal, horizontal.geodetic_crs, always_xy=True)


def _horizontal(crs: str) -> Any:
    """The horizontal part of a system."""
    system = _system(crs, crs, MapFileError)
    return system.sub_crs_list[0] if system.is_compound else system


def position_of(origin: GeodeticOrigin) -> FloatArray:
    """Latitude and longitude in degrees and height in m of ``origin``, (1, 3)."""
    return np.array([[origin.latitude_deg, origin.longitude_deg, origin.altitude_m]])


def _ecef_from_geodetic(geodetic: FloatArray) -> FloatArray:
    lat = np.radians(geodetic[:, 0])
    lon = np.radians(geodetic[:, 1])
    height_m = geodetic[:, 2]
    across_m = _SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY2 * np.sin(lat) ** 2)
    out_m = (across_m + height_m) * np.cos(lat)
    north_m = (across_m * (1 - _ECCENTRICITY2) + height_m) * np.sin(lat)
    return np.column_stack([out_m * np.cos(lon), out_m * np.sin(lon), north_m])


def _geodetic_from_ecef(points: FloatArray) -> FloatArray:
    """Bowring's iteration (Survey Review 23, 1976): accurate to nanometres after two rounds."""
    x, y, z = points.T
    out_m = np.hypot(x, y)
    minor_m = _SEMI_MAJOR_M * (1 - _FLATTENING)
    parametric = np.arctan2(z * _SEMI_MAJOR_M, out_m * minor_m)
    second2 = _ECCENTRICITY2 / (1 - _ECCENTRICITY2)
    for _ in range(3):
        cubed = np.cos(parametric) ** 3
        raised_m = z + second2 * minor_m * np.sin(parametric) ** 3
        lat = np.arctan2(raised_m, out_m - _ECCENTRICITY2 * _SEMI_MAJOR_M * cubed)
        parametric = np.arctan2((1 - _FLATTENING) * np.sin(lat), np.cos(lat))
    on_ellipsoid = out_m - _SEMI_MAJOR_M * np.cos(parametric), z - minor_m * np.sin(parametric)
    height_m = on_ellipsoid[0] * np.cos(lat) + on_ellipsoid[1] * np.sin(lat)
    return np.column_stack([np.degrees(lat), np.degrees(np.arctan2(y, x)), height_m])
