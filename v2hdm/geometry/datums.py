"""Names of datums, and the UTM zone of a place on each: a map's own datum decides which code a zone has."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from v2hdm.records import GeodeticOrigin


class _Zones(NamedTuple):
    """EPSG codes of a datum's UTM zones, less the number of the zone, and the zones that there are."""

    north: int | None
    south: int | None
    first: int = 1
    last: int = 60


_ZONES: Mapping[str, _Zones] = {
    "wgs84": _Zones(32600, 32700),
    "etrs89": _Zones(25800, None, 28, 38),
    "nad83": _Zones(26900, None, 1, 23),
    "nad83(2011)": _Zones(6329, None, 1, 19),
    "gda94": _Zones(None, 28300, 48, 58),
    "gda2020": _Zones(None, 7800, 46, 59),
    "jgd2011": _Zones(6637, None, 51, 55),
    "sirgas2000": _Zones(31954, 31960, 11, 25),
}
"""Datums by their names in small letters without blanks (EPSG dataset)."""

_NORTHERNMOST_DEG = 84.0  # latitude, deg, from which UTM ends and the polar grid begins
_SOUTHERNMOST_DEG = -80.0  # the same in the south
_POLAR = ("EPSG:32661", "EPSG:32761")  # polar grids of WGS84, north and south


def is_same_datum(name: str, other: str) -> bool:
    """Whether two names spell the same datum: WGS84, WGS 84 and wgs84 do."""
    return _plain(name) == _plain(other)


def is_named(name: str) -> bool:
    """Whether a datum has a name, which PROJ's text of an ellipsoid alone leaves open."""
    return not _plain(name).startswith("unknown")


def utm_of(origin: GeodeticOrigin) -> str | None:
    """The UTM zone of an origin on its datum as an EPSG code; None where the datum has none there."""
    datum = _plain(origin.datum)
    zones = _ZONES.get(datum)
    if zones is None:
        return None
    if not _SOUTHERNMOST_DEG <= origin.latitude_deg <= _NORTHERNMOST_DEG:
        return _POLAR[origin.latitude_deg < 0] if datum == "wgs84" else None
    zone = _zone_of(origin.latitude_deg, origin.longitude_deg)
    less = zones.north if origin.latitude_deg >= 0 else zones.south
    return f"EPSG:{less + zone}" if less is not None and zones.first <= zone <= zones.last else None


def _zone_of(latitude_deg: float, longitude_deg: float) -> int:
    """The number of the zone, with the wider ones of Norway and Svalbard (NGA.SIG.0012, 2.3)."""
    if 56 <= latitude_deg < 64 and 3 <= longitude_deg < 6:
        return 32
    if latitude_deg >= 72 and 0 <= longitude_deg < 42:
        return 31 + 2 * int((longitude_deg + 3) // 12)
    return int((longitude_deg + 180) // 6) % 60 + 1


def _plain(name: str) -> str:
    return "".join(name.split()).casefold()
