"""Names of datums, and UTM zones on each, against PROJ's own database."""

import pyproj
import pytest

from v2hdm.errors import MapFileError
from v2hdm.geometry.datums import is_same_datum, utm_of
from v2hdm.geometry.geodetic import Grid, datum_of
from v2hdm.records import GeodeticOrigin

PLACES = [
    ("WGS84", 53.5, 9.9, "EPSG:32632"),
    ("wgs 84", -33.9, 18.4, "EPSG:32734"),
    ("WGS84", 65.0, 179.99, "EPSG:32660"),
    ("WGS84", 60.4, 4.9, "EPSG:32632"),  # Norway's zone 32 reaches west to 3 degrees
    ("WGS84", 78.2, 15.6, "EPSG:32633"),
    ("WGS84", 85.0, 15.6, "EPSG:32661"),
    ("ETRS89", 53.5, 9.9, "EPSG:25832"),
    ("NAD83", 40.7, -73.9, "EPSG:26918"),
    ("NAD83(2011)", 40.7, -73.9, "EPSG:6347"),
    ("GDA94", -33.8, 151.2, "EPSG:28356"),
    ("GDA2020", -33.8, 151.2, "EPSG:7856"),
    ("JGD2011", 35.6, 139.7, "EPSG:6691"),
    ("SIRGAS 2000", -23.5, -46.6, "EPSG:31983"),
    ("SIRGAS 2000", 4.6, -74.1, "EPSG:31972"),
]


@pytest.mark.parametrize(("datum", "latitude_deg", "longitude_deg", "code"), PLACES)
def test_the_utm_zone_of_a_place_is_on_its_own_datum(datum, latitude_deg, longitude_deg, code):
    origin = GeodeticOrigin(latitude_deg, longitude_deg, 10.0, datum)
    assert utm_of(origin) == code
    assert is_same_datum(datum_of(code, "here", MapFileError), datum)
    assert Grid.of(code, origin, "here", MapFileError).crs == code
    area = pyproj.CRS(code).area_of_use
    assert area.south <= latitude_deg <= area.north


@pytest.mark.parametrize(
    "origin",
    [GeodeticOrigin(-41.0, 174.0, 0.0, "NZGD2000"), GeodeticOrigin(-85.0, 0.0, 0.0, "GDA2020"),
     GeodeticOrigin(40.0, 100.0, 0.0, "ETRS89")],
)  # fmt: skip
def test_a_datum_without_zones_at_a_place_has_none(origin):
    assert utm_of(origin) is None


def test_a_system_of_another_datum_is_refused_with_the_map_s_own_zone():
    origin = GeodeticOrigin(40.7, -73.9, 10.0, "NAD83")
    with pytest.raises(MapFileError, match=r"EPSG:32618 is on WGS84, the map on NAD83, .*; give EPSG:26918"):
        Grid.of("EPSG:32618", origin, "here", MapFileError)
    origin = GeodeticOrigin(-41.0, 174.0, 0.0, "NZGD2000")
    with pytest.raises(MapFileError, match="give a projected system on NZGD2000"):
        Grid.of("EPSG:32760", origin, "here", MapFileError)
