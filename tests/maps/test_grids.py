"""Results in the user's own grid, read by tools that are not ours and by us."""

import csv
import sqlite3
import xml.etree.ElementTree as ET
from dataclasses import replace

import ezdxf
import numpy as np
import pyogrio.raw
import pyproj
import pytest

from tests.maps.gis import move_feature, street
from v2hdm.cli.main import run
from v2hdm.errors import ConfigError
from v2hdm.geometry.geodetic import Grid, geodetic_from_enu
from v2hdm.io.maps.formats import write_map
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.reading import read_map
from v2hdm.records import GeodeticOrigin

HAMBURG = GeodeticOrigin(53.54, 9.98, 40.0, "ETRS89", 2024.5)
UTM = "EPSG:25832"


def in_utm(points, heights):
    """By PROJ alone, from our geodetic positions."""
    lat, lon, up = geodetic_from_enu(HAMBURG, np.column_stack([points, heights])).T
    return np.column_stack([*pyproj.Proj(UTM)(lon, lat), up])


def exported(folder, name, crs=UTM, origin=HAMBURG):
    (path,) = write_map(street(origin), folder, "map", [name], None, crs=crs)
    return path


def expected():
    return {
        k: in_utm(marking.corners_map, marking.heights_m)
        for k, marking in enumerate(street().markings, start=1)
    }


def is_rounded(values):
    return np.abs(np.asarray(values) * 1e4 - np.round(np.asarray(values) * 1e4)).max() < 1e-3


@pytest.mark.parametrize("name", ["gpkg", "geojson"])
def test_gdal_finds_the_map_in_the_grid_that_was_asked_for(tmp_path, name):
    layer = {"layer": "markings"} if name == "gpkg" else {}
    meta, _, shapes, columns = pyogrio.raw.read(exported(tmp_path, name), **layer)
    assert meta["crs"] == UTM
    ids = columns[list(meta["fields"]).index("id")]
    for number, wkb in zip(ids.tolist(), shapes, strict=True):
        if (corners := expected().get(number)) is not None:
            ring = np.frombuffer(wkb[13:], "<f8").reshape(-1, 3)[:4]
            assert np.linalg.norm(ring[:, None] - corners, axis=2).min(axis=0).max() < 2e-4
            assert is_rounded(ring)


def test_csv_dxf_and_landxml_have_the_same_rounded_metres_and_state_datum_and_epoch(tmp_path):
    with exported(tmp_path, "csv").open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["id"] == "1"]
    columns = ("easting", "northing", "ellipsoidal_height_m")
    of_csv = np.array([[float(row[name]) for name in columns] for row in rows])
    assert {(row["crs"], row["datum"], row["epoch"]) for row in rows} == {(UTM, "ETRS89", "2024.5")}
    drawing = ezdxf.readfile(exported(tmp_path, "dxf"))
    assert not drawing.audit().errors
    assert dict(drawing.header.custom_vars) == {"crs": UTM, "datum": "ETRS89", "epoch": "2024.5"}
    of_dxf = np.array([tuple(vertex) for vertex in drawing.modelspace()[0].points()])
    root = ET.parse(exported(tmp_path, "landxml")).getroot()
    spaces = {"x": "http://www.landxml.org/schema/LandXML-1.2"}
    assert root.find("x:CoordinateSystem", spaces).attrib["epsgCode"] == "25832"
    labels = root.findall("x:PlanFeatures/x:PlanFeature[@name='1']//x:Property", spaces)
    assert {label.get("label"): label.get("value") for label in labels}["accuracy"] == "A"
    starts = root.findall("x:PlanFeatures/x:PlanFeature[@name='1']//x:Start", spaces)
    of_landxml = np.array([[float(value) for value in start.text.split()] for start in starts])[:, [1, 0, 2]]
    for values in (of_csv, of_dxf, of_landxml):
        np.testing.assert_allclose(values, expected()[1], atol=1e-4)
        assert is_rounded(values)


@pytest.mark.parametrize("name", ["gpkg", "geojson"])
@pytest.mark.parametrize(("crs", "origin"), [(UTM, HAMBURG), ("local", HAMBURG), ("local", None)])
def test_a_map_in_a_grid_comes_back_as_it_was_and_an_edit_counts_as_drawn(tmp_path, name, crs, origin):
    before, path = street(origin), exported(tmp_path, name, crs, origin)
    after = read_map(path)[0]
    for old, new in zip(before.markings, after.markings, strict=True):
        np.testing.assert_array_equal(new.corners_map, old.corners_map)
        np.testing.assert_array_equal(new.covariance_m2, old.covariance_m2)
    assert after.origin == origin
    if name == "gpkg":
        move_feature(path, 1, 0.03, -0.04, "markings")
        moved = read_map(path)[0].markings[0].corners_map - before.markings[0].corners_map
        np.testing.assert_allclose(np.hypot(*moved.T), 0.05, rtol=2e-3, atol=2e-4)


@pytest.mark.parametrize(
    ("crs", "origin", "metres", "message"),
    [
        ("EPSG:25833", HAMBURG, "", r"lies outside EPSG:25833 .*; give EPSG:25832"),
        ("EPSG:4258", HAMBURG, "DXF", "DXF holds metres, but EPSG:4258 is not in metres; give EPSG:25832"),
        (
            "EPSG:2225",
            replace(HAMBURG, latitude_deg=40.0, longitude_deg=-122.0, datum="NAD83"),
            "DXF",
            "metres",
        ),
        ("EPSG:32632", HAMBURG, "", "on WGS84, the map on ETRS89"),
        (UTM, None, "", "which the map lacks; give local"),
        ("EPSG:5555", HAMBURG, "", "give its horizontal part"),
        ("+proj=utm +zone=32 +ellps=GRS80 +units=m", HAMBURG, "", "no satellite datum|no code|is of unknown"),
        ("EPSG:1", HAMBURG, "", "unknown crs"),
    ],
)
def test_a_system_that_cannot_hold_the_site_is_refused_in_one_line(crs, origin, metres, message):
    with pytest.raises(ConfigError, match=message) as refused:
        Grid.of(crs, origin, "--crs", ConfigError, metres)
    assert "\n" not in str(refused.value)


def test_a_zone_holds_a_site_beyond_the_date_line():
    assert Grid.of("EPSG:32701", GeodeticOrigin(-17.0, -179.5, 0.0), "crs", ConfigError).crs == "EPSG:32701"
    assert Grid.of("EPSG:32660", GeodeticOrigin(17.0, -179.5, 0.0), "crs", ConfigError).crs == "EPSG:32660"


def test_the_command_takes_a_grid_and_refuses_before_it_writes(tmp_path, monkeypatch, capsys):
    write_geojson(street(HAMBURG), tmp_path / "map.geojson")
    monkeypatch.chdir(tmp_path)
    assert run(["export", "map.geojson", "--format", "gpkg", "--crs", "EPSG:25833"]) == 2
    assert "outside EPSG:25833" in capsys.readouterr().err
    assert run(["export", "map.geojson", "--format", "lanelet2", "--crs", UTM]) == 2
    assert not list(tmp_path.glob("map*[!n]"))
    assert run(["export", "map.geojson", "--format", "gpkg", "--crs", UTM]) == 0
    with sqlite3.connect(tmp_path / "map.gpkg") as data:
        assert data.execute("SELECT srs_id FROM gpkg_contents WHERE table_name = 'markings'").fetchone() == (
            25832,
        )
