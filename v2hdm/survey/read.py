"""A survey's points in a CSV file (docs/accuracy.md): control points and check points.

Coordinates are local metres, latitudes and longitudes, or eastings and northings of any projected system;
:func:`in_map` brings them into the map, where :func:`v2hdm.survey.match.match` finds their corners.
"""

from __future__ import annotations

import difflib
import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

import numpy as np

from v2hdm.errors import DriveError, shown
from v2hdm.geometry import geodetic
from v2hdm.geometry.datums import is_named, is_same_datum, utm_of
from v2hdm.io.rows import read_rows
from v2hdm.io.trajectory import parse_number
from v2hdm.records import FOOT_M, FloatArray, GeodeticOrigin

_log = logging.getLogger(__name__)


class Frame(Enum):
    """The columns of a survey's coordinates, which say what they count from."""

    MAP = "x_m, y_m"
    GRID = "east_m, north_m"
    GEODETIC = "latitude_deg, longitude_deg"

    @property
    def columns(self) -> list[str]:
        """The columns of its two coordinates."""
        return self.value.split(", ")


_CALLED: Mapping[str, tuple[str, ...]] = {
    "id": ("point", "name", "point_id"),
    "x_m": ("x", "x_map_m"),
    "y_m": ("y", "y_map_m"),
    "east_m": ("east", "easting", "easting_m"),
    "north_m": ("north", "northing", "northing_m"),
    "latitude_deg": ("latitude", "lat"),
    "longitude_deg": ("longitude", "lon"),
    "height_m": ("height", "z_m", "z", "altitude_m", "altitude", "ellipsoidal_height_m"),
    "sigma_m": (),
    "sigma_east_m": ("sigma_east", "sigma_x_m"),
    "sigma_north_m": ("sigma_north", "sigma_y_m"),
    "role": (),
    "description": ("about", "comment"),
}
"""Columns that are understood, and their other names."""

NAMES: Mapping[str, str] = {name: ours for ours, others in _CALLED.items() for name in (ours, *others)}
_NEARLY = 0.8  # likeness (:mod:`difflib`) from which an unknown column counts as misspelt


@dataclass(frozen=True)
class SurveyedPoint:
    """A point of a survey, in the map."""

    id: str
    position_map: FloatArray  # (2,) m
    sigma_m: FloatArray  # (2,) along the map's axes
    height_m: float | None = None  # above its origin, None where unknown
    is_check: bool = False  # held out of the adjustment, to check the map by
    description: str = ""


@dataclass(frozen=True)
class SurveyTable:
    """N points as a file states them."""

    path: Path
    frame: Frame
    coordinates: FloatArray  # (N, 2) in the order of the frame's columns
    height_m: FloatArray  # (N,) nan where not stated
    sigma_m: FloatArray  # (N, 2) east and north
    ids: tuple[str, ...]
    is_check: tuple[bool, ...]
    descriptions: tuple[str, ...]
    crs: str | None = None  # None for the system of the drive
    geoid_m: float | None = None  # above the ellipsoid, for heights above the sea


def read_survey(path: Path, crs: str | None, geoid_m: float | None, sigma_m: float) -> SurveyTable:
    """Read the CSV file at ``path``: names in its first line, then one point per line.

    ``crs`` is the projected system of eastings and northings, such as ``EPSG:32632``, ``geoid_m`` the height
    of the geoid above the ellipsoid, where heights count from the sea, and ``sigma_m`` that of points without
    one. Raises DriveError, with the line, when a column is missing, misspelt or there twice, or a cell wrong.
    """
    header, lines = read_rows(path, ";\t,", "point")
    names = _columns(header, path)
    rows = []
    line_of = dict[str, int]()
    for line, cells in lines:
        cell_of = {name: cell for name, cell in zip(names, cells, strict=True) if name is not None}
        where = f"{path}: line {line}"
        rows.append(_Row(cell_of, where))
        point = cell_of["id"]
        if not point:
            raise DriveError(f"{where}: the point has no id; name it")
        if point in line_of:
            raise DriveError(f"{where}: point {point} is already in line {line_of[point]}; keep one")
        line_of[point] = line
    frame = _frame(names, crs, path)
    first, second = frame.columns
    return SurveyTable(
        path=path,
        frame=frame,
        coordinates=np.array([[row.number(first), row.number(second)] for row in rows]),
        height_m=np.array([row.number("height_m", np.nan) for row in rows]),
        sigma_m=np.array([row.sigmas(sigma_m) for row in rows]),
        ids=tuple(line_of),
        is_check=tuple(row.is_check() for row in rows),
        descriptions=tuple(row.text("description") for row in rows),
        crs=crs,
        geoid_m=geoid_m,
    )


def in_map(table: SurveyTable, origin: GeodeticOrigin | None) -> tuple[SurveyedPoint, ...]:
    """The points of ``table`` in the map of a drive with that ``origin``, at whose height unknown ones are.

    Grids become local metres over the earth's centre, without scale and convergence; sigmas stay. Raises
    DriveError when the drive has no origin that the coordinates need, they are of another datum, or outside
    of their system.
    """
    positions = table.coordinates
    height_m = table.height_m
    if table.frame is not Frame.MAP:
        positions, height_m = _on_earth(table, origin)
    heights = [float(height) if np.isfinite(height) else None for height in height_m]
    return tuple(
        SurveyedPoint(
            id=name,
            position_map=positions[k],
            sigma_m=table.sigma_m[k],
            height_m=heights[k],
            is_check=table.is_check[k],
            description=table.descriptions[k],
        )
        for k, name in enumerate(table.ids)
    )


def misreadings(table: SurveyTable, origin: GeodeticOrigin | None) -> dict[str, FloatArray]:
    """Positions (N, 2) of the points in the map, had the file meant something else; by that meaning."""
    first, second = table.frame.columns
    others = {f"with {first} and {second} swapped": replace(table, coordinates=table.coordinates[:, ::-1])}
    if table.crs is not None and table.frame is Frame.GRID:
        units = geodetic.units_of(table.crs, str(table.path), DriveError)
        if units.horizontal_m != 1.0:
            others["in metres"] = replace(
                table,
                coordinates=table.coordinates / units.horizontal_m,
                height_m=table.height_m / units.vertical_m,
            )
    if table.frame is not Frame.GEODETIC:
        others["in feet"] = replace(table, coordinates=FOOT_M * table.coordinates)
        others["in millimetres"] = replace(table, coordinates=1e-3 * table.coordinates)
    if table.frame is Frame.GRID:
        others["as local metres (columns x_m, y_m)"] = replace(table, frame=Frame.MAP)
    if table.frame is Frame.MAP:
        others["as latitude and longitude"] = replace(table, frame=Frame.GEODETIC)
    for crs in _other_systems(table, origin):
        others[f"in {crs}"] = replace(table, frame=Frame.GRID, crs=crs)
    out = {}
    for meaning, other in others.items():
        with suppress(DriveError):
            out[meaning] = np.array([point.position_map for point in in_map(other, origin)])
    return {meaning: positions for meaning, positions in out.items() if np.isfinite(positions).all()}


def _other_systems(table: SurveyTable, origin: GeodeticOrigin | None) -> list[str]:
    """Other systems of a survey's coordinates: the neighbouring zones, or the UTM zone of the site."""
    systems = []
    authority, _, code = (table.crs or "").partition(":")
    if authority.upper() == "EPSG" and code.isdecimal():
        systems = [f"EPSG:{int(code) - 1}", f"EPSG:{int(code) + 1}"]
    if origin is not None and table.frame is not Frame.GEODETIC and (zone := utm_of(origin)) is not None:
        systems.append(zone)
    return [crs for crs in systems if crs != table.crs]


def _on_earth(table: SurveyTable, origin: GeodeticOrigin | None) -> tuple[FloatArray, FloatArray]:
    """Positions (N, 2) and heights (N,) in the map, nan where they are not known."""
    where = str(table.path)
    crs = table.crs
    if origin is None:
        raise DriveError(
            f"{where}: {table.frame.value} have a position on the earth, the drive's map has none; give the "
            "drive an origin, or the points as x_m, y_m in the frame of its poses"
        )
    height_m = table.height_m
    if crs is not None:
        units = geodetic.units_of(crs, where, DriveError)
        height_m = units.vertical_m * height_m
        if units.horizontal_m != 1.0:
            _log.info("%s: east, north and heights are read in the unit of %s, %s", where, crs, units.name)
        datum = geodetic.datum_of(crs, where, DriveError)
        if is_named(datum) and not is_same_datum(datum, origin.datum):
            raise DriveError(
                f"{where}: the points are in {datum} ({crs}), the drive's origin in {origin.datum}, which "
                "differ by decimetres; give the points in the origin's datum"
            )
        if geodetic.has_height_datum(crs, where, DriveError) and table.geoid_m is None:
            unused = "%s: heights of %s are above sea level and not used: set mapping.survey.geoid_m"
            _log.warning(unused, where, crs)
            height_m = np.full_like(height_m, np.nan)
    is_known = np.isfinite(height_m)
    raised_m = np.where(is_known, height_m + (table.geoid_m or 0.0), origin.altitude_m)
    points = np.column_stack([table.coordinates, raised_m])
    if table.frame is Frame.GEODETIC:
        for name, (latitude_deg, longitude_deg) in zip(table.ids, table.coordinates, strict=True):
            if abs(latitude_deg) > 90 or abs(longitude_deg) > 180:
                raise DriveError(
                    f"{where}: latitude {latitude_deg:g}, longitude {longitude_deg:g} of {name} is not a "
                    "position on the earth; are they swapped?"
                )
    else:
        assert crs is not None
        points = geodetic.geodetic_from_grid(crs, points, where, DriveError)
    out = geodetic.enu_from_geodetic(origin, points)
    return out[:, :2], np.where(is_known, out[:, 2], np.nan)


@dataclass(frozen=True)
class _Row:
    """One line of the file: its cells by our names of the columns."""

    cells: Mapping[str, str]
    where: str

    def text(self, name: str) -> str:
        return self.cells.get(name, "")

    def number(self, name: str, missing: float | None = None) -> float:
        cell = self.text(name)
        return missing if missing is not None and not cell else parse_number(cell, f"{self.where}: {name}")

    def sigmas(self, usual_m: float) -> tuple[float, float]:
        both_m = self.number("sigma_m", usual_m)
        east_m = self.number("sigma_east_m", both_m)
        north_m = self.number("sigma_north_m", both_m)
        if min(east_m, north_m) <= 0:
            raise DriveError(f"{self.where}: a sigma of {min(east_m, north_m):g} m; give one above 0")
        return east_m, north_m

    def is_check(self) -> bool:
        role = self.text("role").lower() or "control"
        if role not in ("control", "check"):
            raise DriveError(f"{self.where}: role {shown(role)} is neither control nor check; fix that line")
        return role == "check"


def _columns(header: Sequence[str], path: Path) -> list[str | None]:
    """Our name of each column, None for those that are not used."""
    ours = [NAMES.get(name.lower()) for name in header]
    for name, our_name in zip(header, ours, strict=True):
        if our_name is not None and ours.count(our_name) > 1:
            twice = [other for other, meant in zip(header, ours, strict=True) if meant == our_name]
            raise DriveError(f"{path}: the columns {' and '.join(twice)} mean the same; keep one of them")
        similar = difflib.get_close_matches(name.lower(), NAMES, n=1, cutoff=_NEARLY)
        if our_name is None and similar:
            raise DriveError(f"{path}: unknown column {shown(name)}; did you mean '{similar[0]}'?")
    unused = [name for name, our_name in zip(header, ours, strict=True) if our_name is None]
    if unused:
        _log.info("%s: the columns %s are not used", path, ", ".join(unused))
    if "id" not in ours:
        raise DriveError(f"{path}: has no column id; it has: {', '.join(header)}")
    return ours


def _frame(names: Sequence[str | None], crs: str | None, path: Path) -> Frame:
    """The frame whose columns the file has, checked against ``crs``."""
    frames = [frame for frame in Frame if any(name in names for name in frame.columns)]
    if len(frames) != 1:
        ways = " or ".join(frame.value for frame in Frame)
        raise DriveError(f"{path}: needs the columns {ways}, one of these pairs")
    missing = [name for name in frames[0].columns if name not in names]
    if missing:
        raise DriveError(f"{path}: has no column {missing[0]}; add it")
    (frame,) = frames
    if frame is Frame.GRID and crs is None:
        raise DriveError(
            f"{path}: which system are east and north in? Set mapping.survey.crs, such as EPSG:32632, or "
            "call the columns x_m, y_m if they are in the frame of the poses"
        )
    if frame is Frame.MAP and crs is not None:
        problem = f"x_m, y_m are in the frame of the poses, and mapping.survey.crs is {crs}"
        raise DriveError(f"{path}: {problem}; call them east_m, north_m, or drop crs")
    if crs is not None and (frame is Frame.GEODETIC) != geodetic.is_geographic(crs, str(path), DriveError):
        kind = "latitudes and longitudes" if frame is Frame.GEODETIC else "east and north"
        raise DriveError(f"{path}: holds {kind}, which {crs} does not have; fix mapping.survey.crs")
    return frame
