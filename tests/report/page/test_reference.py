"""The coordinate system that a document states for its coordinates is one of the map's own datum."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest

from tests.asbuilt.site import layout, mapped
from v2hdm.records import GeodeticOrigin
from v2hdm.report.page.facts import Facts
from v2hdm.report.page.layers import systems_of
from v2hdm.report.page.reference import reference_of


def facts_of(origin):
    hd_map = replace(mapped(layout(1, 3).shapes, 1), origin=origin)
    return Facts(Path("result"), {}, "", hd_map, (), {}, None, None, None, (), None, None)


@pytest.mark.parametrize(
    ("datum", "place", "code", "geographic"),
    [
        ("NAD83", (40.7, -73.9), "EPSG:26918", "EPSG:4269"),
        ("GDA2020", (-33.8, 151.2), "EPSG:7856", "EPSG:7844"),
        ("wgs84", (53.5, 9.9), "EPSG:32632", "EPSG:4326"),
    ],
)
def test_coordinates_are_of_a_zone_on_the_datum_of_the_map(datum, place, code, geographic):
    origin = GeodeticOrigin(*place, 10.0, datum)
    reference = reference_of(facts_of(origin))
    assert reference.grid.crs == code
    assert reference.horizontal == f"{pyproj.CRS(code).name} ({code})"
    east, north = pyproj.Transformer.from_crs(geographic, code, always_xy=True).transform(place[1], place[0])
    assert reference.grid.positions(np.zeros((1, 3)))[0, :2] == pytest.approx([east, north], abs=1e-4)


def test_coordinates_on_a_datum_without_zones_are_local_metres():
    facts = facts_of(GeodeticOrigin(-41.0, 174.0, 10.0, "NZGD2000"))
    reference = reference_of(facts)
    assert reference.grid.is_local
    assert reference.horizontal.startswith("local metres, east and north of the map's origin at -41.0")
    extent = (np.array([-5.0, -5.0]), np.array([30.0, 5.0]))
    assert [system["name"] for system in systems_of(facts.hd_map, extent)] == [""]
