"""FlatGeobuf, Shapefiles, KML and JSON-FG, read by GDAL."""

import json
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pyogrio
import pytest
import shapely
from pyproj import Transformer

from tests.maps.gis import ORIGIN, street
from v2hdm.errors import ConfigError
from v2hdm.geometry.geodetic import geodetic_from_enu
from v2hdm.io.maps.colours import channels, colours_of
from v2hdm.io.maps.features import features_of
from v2hdm.io.maps.formats import write_map
from v2hdm.records import HDMap, Reading, Symbol

SIDE_M = 0.001  # tolerance of a position, m: 3e-8 degrees


def site() -> HDMap:
    """A street with a class that nobody knows and a text that was read."""
    outline = np.array([[20.0, 2.0], [22.0, 2.0], [22.0, 3.0], [20.0, 3.0]])
    hd_map = street()
    strange = replace(hd_map.markings[0], kind="helipad H")
    text = Symbol("text", outline, 7, 0.01, np.ones(4), reading=Reading("EBH & 7", 0.9))
    return replace(hd_map, markings=(*hd_map.markings, strange), symbols=(text,))


def written(folder, name, **more):
    *_, path = write_map(site(), folder, "map", [name], **more)
    return path


def rows_of(path, **layer):
    """The classes, ids and points (N, 3) of a file's features, as GDAL reads them."""
    meta, _, shapes, columns = pyogrio.raw.read(path, **layer)
    table = dict(zip(meta["fields"], columns, strict=True))
    points = [np.array(shapely.get_coordinates(shapely.from_wkb(shape), include_z=True)) for shape in shapes]
    return table, points, meta["crs"]


def assert_all_there(ids, points):
    features = {feature.id: feature for feature in features_of(site())}
    assert sorted(map(int, ids)) == sorted(features)
    for number, places in zip(ids, points, strict=True):
        feature = features[int(number)]
        expected = geodetic_from_enu(ORIGIN, feature.xyz_map)[feature.ring][:, [1, 0, 2]]
        count = len(expected)
        forward = places[:count]
        if not np.allclose(forward[0, :2], expected[0, :2], 0.0, 3e-8):  # Shapefile turns rings round
            start = int(np.argmin(np.abs(forward[:, :2] - expected[0, :2]).sum(axis=1)))
            forward = np.roll(forward, -start, axis=0)
        if feature.closed and not np.allclose(forward[1, :2], expected[1, :2], 0.0, 3e-8):
            forward = np.concatenate([forward[:1], forward[:0:-1]])
        np.testing.assert_allclose(forward[:, :2], expected[:, :2], 0.0, 3e-8)
        np.testing.assert_allclose(forward[:, 2], expected[:, 2], 0.0, 2e-3)


def test_flatgeobufs_hold_every_feature_of_every_class(tmp_path):
    path = written(tmp_path, "flatgeobuf")
    ids, points, ids_with_sigma, classes = [], [], [], {}
    for file in sorted(path.parent.glob("*.fgb")):
        table, places, crs = rows_of(file)
        assert crs == "EPSG:4326"
        ids += table["id"].tolist()
        points += places
        classes |= dict(zip(table["id"], table["class"], strict=True))
        ids_with_sigma += table["id"][np.isfinite(table["sigma_m"])].tolist()
    assert_all_there(ids, points)
    assert classes == {feature.id: feature.kind for feature in features_of(site())}
    assert sorted(ids_with_sigma) == [
        feature.id for feature in features_of(site()) if feature.sigma_m is not None
    ]
    table, _, _ = rows_of(path.with_name("symbols.fgb"))
    assert table["text"].tolist() == ["EBH & 7"]


def test_shapefiles_hold_every_feature_by_its_kind_of_geometry(tmp_path):
    path = f"/vsizip/{written(tmp_path, 'shapefile')}"
    ids, points = [], []
    for name, _ in pyogrio.list_layers(path):
        table, places, crs = rows_of(path, layer=name)
        assert crs == "EPSG:4326"
        assert set(table) == {
            "id",
            "class",
            "sightings",
            "sigma_m",
            "rel_sig_m",
            "accuracy",
            "paint_left",
            "kind",
            "text",
        }
        ids += list(table["id"])
        points += places
    assert_all_there(ids, points)


def test_a_kml_holds_every_feature_in_the_report_s_colours(tmp_path):
    path = written(tmp_path, "kml")
    ids, points = [], []
    for name, _ in pyogrio.list_layers(path):
        table, places, _ = rows_of(path, layer=name)
        ids += [title.rsplit(" ", 1)[1] for title in table["Name"]]
        points += places
    assert_all_there(ids, points)
    space = {"k": "http://www.opengis.net/kml/2.2"}
    root = ET.parse(path).getroot()
    styles = {
        style.get("id"): style.findtext("k:LineStyle/k:color", None, space)
        for style in root.iterfind(".//k:Style", space)
    }
    for kind, colour in colours_of(features_of(site())).items():
        red, green, blue = channels(colour)
        assert styles[f"area-{kind}".replace(" ", "_")] == f"ff{blue:02x}{green:02x}{red:02x}"
    used = {url.text[1:] for url in root.iterfind(".//k:styleUrl", space)}
    assert used == set(styles)


def test_a_kml_without_an_origin_is_one_line(tmp_path):
    with pytest.raises(ConfigError, match=r"map.kml: KML needs a place on the earth"):
        write_map(street(None), tmp_path, "map", ["kml"])


def test_a_json_fg_has_a_grid_s_coordinates_beside_degrees(tmp_path):
    path = written(tmp_path, "jsonfg", crs="EPSG:32651")
    content = json.loads(path.read_text())
    assert any("json-fg" in name for name in content["conformsTo"])
    to_grid = Transformer.from_crs("EPSG:4326", "EPSG:32651", always_xy=True)
    for feature in content["features"]:
        ring = feature["geometry"]["coordinates"]
        place = feature["place"]["coordinates"]
        if feature["geometry"]["type"] == "Polygon":
            ring, place = ring[0], place[0]
        np.testing.assert_allclose(
            to_grid.transform(*np.array(ring)[:, :2].T), np.array(place)[:, :2].T, atol=SIDE_M * 20
        )
    table, points, _ = rows_of(written(tmp_path / "degrees", "jsonfg"))
    assert_all_there(table["id"], points)


@pytest.mark.parametrize("name", ["flatgeobuf", "shapefile", "jsonfg"])
def test_a_map_without_an_origin_is_in_local_metres(tmp_path, name):
    (path,) = write_map(street(None), tmp_path, "map", [name])
    sources = {"shapefile": f"/vsizip/{path}/lanes.shp", "flatgeobuf": path.with_name("lanes.fgb")}
    source = sources.get(name, path)
    table, points, _ = rows_of(source)
    lane = next(feature for feature in features_of(street(None)) if not feature.closed)
    (places,) = [place for number, place in zip(table["id"], points, strict=True) if number == lane.id]
    np.testing.assert_allclose(places[:, :2], lane.points_map, atol=1e-4)
