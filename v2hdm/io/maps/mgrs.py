"""Places in the Military Grid Reference System: UTM within a square of 100 km, through ``pyproj``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.errors import ConfigError
from v2hdm.io.maps.needs import need
from v2hdm.records import FloatArray

_BANDS = "CDEFGHJKLMNPQRSTUVWXX"
"""Letters of the latitude bands, 8 degrees each from 80 degrees south; the last one has 12."""

_COLUMNS = ("ABCDEFGH", "JKLMNPQR", "STUVWXYZ")
"""Letters of the squares' columns from 100 km easting, in zones 1, 2, 3; they repeat every three zones."""

_ROWS = "ABCDEFGHJKLMNPQRSTUV"
"""Letters of the squares' rows from the equator in odd zones; even ones begin five later. They repeat every
2000 km."""

_SQUARE_M = 100_000.0


@dataclass(frozen=True)
class GridPlaces:
    """Points of one grid square, as ``54SUE``: ``local`` (N, 2) m east and north of its south-west corner."""

    square: str
    local: FloatArray


def grid_places(longitude_deg: FloatArray, latitude_deg: FloatArray) -> GridPlaces:
    """Where points (N,) lie in the grid (NGA.STND.0037, Universal Grids).

    Raises:
        ConfigError: they lie in several squares or beyond the grid, or ``pyproj`` is not installed.
    """
    pyproj = need("pyproj", "lanelet2 with MGRS")
    if np.min(latitude_deg) < -80 or np.max(latitude_deg) >= 84:
        raise ConfigError("MGRS ends at 80 degrees south and 84 north: choose the projector LocalCartesian")
    zones = np.array([_zone(*place) for place in zip(longitude_deg, latitude_deg, strict=True)])
    projected = np.empty((len(zones), 2))
    for zone in np.unique(zones):
        mine = zones == zone
        utm = pyproj.Proj(proj="utm", zone=int(zone), ellps="WGS84")
        projected[mine] = np.column_stack(utm(longitude_deg[mine], latitude_deg[mine]))
    northing = projected[:, 1] % (
        len(_ROWS) * _SQUARE_M
    )  # also right in the south, whose false northing is 10 000 km
    columns = (projected[:, 0] // _SQUARE_M).astype(int) - 1
    rows = (northing // _SQUARE_M).astype(int) + 5 * (zones % 2 == 0)
    bands = ((np.asarray(latitude_deg) + 80) // 8).astype(int)
    squares = {
        f"{zone}{_BANDS[band]}{_COLUMNS[(zone - 1) % 3][column]}{_ROWS[row % len(_ROWS)]}"
        for zone, band, column, row in zip(zones, bands, columns, rows, strict=True)
    }
    if len(squares) > 1:
        raise ConfigError(
            f"the map spans the MGRS squares {', '.join(sorted(squares))}, and Autoware's MGRS projector "
            "takes one square: choose the projector LocalCartesian"
        )
    return GridPlaces(squares.pop(), np.column_stack([projected[:, 0], northing]) % _SQUARE_M)


def _zone(longitude_deg: float, latitude_deg: float) -> int:
    """The UTM zone of a place, with the exceptions of Norway and Svalbard."""
    if 56 <= latitude_deg < 64 and 3 <= longitude_deg < 12:
        return 32
    if latitude_deg >= 72 and 0 <= longitude_deg < 42:
        return 31 + 2 * int((longitude_deg + 3) // 12)
    return int((longitude_deg + 180) // 6) % 60 + 1
