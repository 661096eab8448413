"""Web tiles of map and mosaic, and GeoParquet, read by ``pmtiles``, GDAL, ``geopandas``, and ours."""

import gzip
import json
import sys

import cv2
import geopandas
import numpy as np
import pyarrow.parquet
import pyogrio
import pytest
import rasterio
import shapely
from pmtiles.reader import MmapSource, Reader, all_tiles
from pmtiles.tile import TileType
from pyproj import Transformer

from tests.maps.gis import ORIGIN, street
from v2hdm.cli.main import run
from v2hdm.errors import ConfigError
from v2hdm.geometry.geodetic import crs_of, geodetic_from_enu
from v2hdm.io.maps.features import features_of
from v2hdm.io.maps.formats import write_map
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.mosaic.blend import Canvas, Sheet
from v2hdm.mosaic.result import geotiff
from v2hdm.safe.backgrounds import Window, background_pixels
from v2hdm.safe.tiles import HALF_WORLD_M

MERCATOR_M = 0.012  # tolerance of a position in Web Mercator, m: half a unit of a tile at the finest level
CELL_M = 0.05


def test_vector_tiles_hold_every_feature_to_a_centimetre(tmp_path):
    (path,) = write_map(street(), tmp_path, "map", ["pmtiles"])
    with path.open("rb") as file:
        header = Reader(MmapSource(file)).header()
    assert header["tile_type"] == TileType.MVT
    assert (header["min_zoom"], header["max_zoom"]) == (12, 18)
    assert header["min_lon_e7"] <= round(ORIGIN.longitude_deg * 1e7) < header["max_lon_e7"]
    meta, _, shapes, columns = pyogrio.raw.read(path)
    table = dict(zip(meta["fields"], columns, strict=True))
    parts = shapely.from_wkb(shapes)
    to_mercator = Transformer.from_crs("EPSG:4326", "EPSG:3857", always_xy=True)
    for feature in features_of(street()):
        earth = geodetic_from_enu(ORIGIN, feature.xyz_map)
        mercator = np.column_stack(to_mercator.transform(earth[:, 1], earth[:, 0]))
        shape = shapely.Polygon(mercator) if feature.closed else shapely.LineString(mercator)
        pieces = shapely.union_all(parts[table["id"] == feature.id])  # a tile cuts what lies on its edge
        assert shapely.hausdorff_distance(pieces, shape) < MERCATOR_M
        assert set(table["class"][table["id"] == feature.id]) == {feature.kind}


def test_coarse_tiles_show_the_site_as_well(tmp_path):
    (path,) = write_map(street(), tmp_path, "map", ["pmtiles"])
    with path.open("rb") as file:
        levels = {place[0] for place, tile in all_tiles(MmapSource(file)) if gzip.decompress(tile)}
    assert levels == set(range(12, 19))


def test_a_map_without_an_origin_has_no_web_tiles(tmp_path):
    with pytest.raises(ConfigError, match=r"map.pmtiles: web tiles need a place on the earth"):
        write_map(street(None), tmp_path, "map", ["pmtiles"])


@pytest.mark.parametrize(("crs", "name"), [(None, "WGS 84"), ("EPSG:32651", "WGS 84 / UTM zone 51N")])
def test_a_geoparquet_holds_every_feature_and_column(tmp_path, crs, name):
    (path,) = write_map(street(), tmp_path, "map", ["geoparquet"], crs=crs)
    frame = geopandas.read_parquet(path)
    assert frame.crs.name == name
    about = json.loads(pyarrow.parquet.read_schema(path).metadata[b"geo"])
    assert about["version"] == "1.1.0"
    assert "covering" in about["columns"]["geometry"]
    on_earth = frame.to_crs("EPSG:4326")
    for feature, (_, row) in zip(features_of(street()), on_earth.iterrows(), strict=True):
        expected = geodetic_from_enu(ORIGIN, feature.xyz_map)[feature.ring][:, [1, 0, 2]]
        positions = shapely.get_coordinates(row.geometry, include_z=True)[: len(expected)]
        np.testing.assert_allclose(positions[:, :2], expected[:, :2], 0.0, 2e-9)
        np.testing.assert_allclose(positions[:, 2], expected[:, 2], 0.0, 1e-4)
        assert (row["id"], row["class"], row["sightings"]) == (feature.id, feature.kind, feature.sightings)
        if feature.ring_covariance_m2 is not None:
            np.testing.assert_array_equal(json.loads(row["covariance_m2"]), feature.covariance_m2)


def test_a_geoparquet_of_local_metres_is_on_no_ellipsoid(tmp_path):
    (path,) = write_map(street(None), tmp_path, "map", ["geoparquet"])
    frame = geopandas.read_parquet(path)
    assert not frame.crs.is_geographic
    np.testing.assert_array_equal(
        shapely.get_coordinates(frame.geometry.iloc[0])[:4],
        features_of(street(None))[0].points_map[features_of(street(None))[0].ring],
    )


def test_the_columns_of_a_geoparquet_do_not_depend_on_what_is_known(tmp_path):
    (path,) = write_map(street(), tmp_path, "full", ["geoparquet"])
    full = pyarrow.parquet.read_schema(path)
    bare = street()
    (path,) = write_map(type(bare)((), bare.lanes, bare.origin), tmp_path, "bare", ["geoparquet"])
    assert pyarrow.parquet.read_schema(path).equals(full)


def test_without_pyarrow_a_geoparquet_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_geojson(street(), tmp_path / "map.geojson")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert run(["export", "map.geojson", "--format", "geoparquet"]) == 2
    words = capsys.readouterr().err
    assert words.count("\n") == 1
    assert "pip install 'v2hdm[parquet]'" in words


@pytest.fixture
def mosaic(tmp_path, monkeypatch):
    """A mosaic of 64 m by 38 m: smooth colours, a white cross, and a corner that nobody has seen."""
    canvas = Canvas(np.array([-20.0, 10.0]), CELL_M, 768, 1280, (1.0, 0.0))
    row, column = np.mgrid[:768, :1280]
    rgba = np.dstack([row / 4, column / 6, np.full_like(row, 120.0), np.full_like(row, 255.0)])
    rgba[380:388] = rgba[:, 600:608] = 255
    rgba[:200, :300, 3] = 0
    with geotiff(tmp_path / "mosaic.tif", canvas, ORIGIN) as put:
        put(Sheet(0, 0, np.round(rgba).astype(np.uint8)))
    monkeypatch.chdir(tmp_path)
    return canvas


def assert_shows_the_mosaic(folder, path, canvas):
    """A folder of tiles, carried back into the map's frame, is the mosaic."""
    west, _, _, north = canvas.bounds_m
    window = Window(crs_of(ORIGIN), west, north, CELL_M, canvas.columns, canvas.rows)
    pixels = background_pixels(folder, window)
    with rasterio.open(path) as source:
        expected = np.moveaxis(source.read([3, 2, 1]), 0, 2).astype(float)
        is_seen = source.dataset_mask() > 0
    inside = cv2.erode(is_seen.astype(np.uint8), np.ones((9, 9))).astype(bool)
    inside[:4] = inside[-4:] = inside[:, :4] = inside[:, -4:] = False
    assert (pixels[..., 3] > 0)[inside].all()
    assert not (pixels[:190, :290, 3] > 0).any()
    off = np.abs(pixels[..., :3] - expected).max(axis=2)[inside]
    assert np.percentile(off, 95) < 8  # a shift by one pixel moves the cross's edges, 3 % of all, by 100
    assert np.median(off) < 2
    cross_px = np.mean(np.flatnonzero((pixels[300:340, 560:650, :3].min(axis=2) > 200).all(axis=0))) + 560
    assert abs(cross_px - 603.5) < 1.0


def test_xyz_tiles_lie_where_the_mosaic_does(mosaic, tmp_path):
    assert run(["export", "mosaic.tif", "--format", "xyz", "--output", "there"]) == 0
    folder = tmp_path / "there" / "mosaic_tiles"
    assert_shows_the_mosaic(folder, "mosaic.tif", mosaic)
    levels = sorted(int(level.name) for level in folder.iterdir())
    pixel_m = 2 * HALF_WORLD_M / 256 / 2 ** levels[-1] * np.cos(np.deg2rad(ORIGIN.latitude_deg))
    assert 2**-0.5 <= pixel_m / CELL_M <= 2**0.5
    assert levels == list(range(levels[0], levels[-1] + 1))
    assert len(list((folder / str(levels[0])).rglob("*.png"))) <= 4


def test_pmtiles_of_a_mosaic_hold_the_same_tiles(mosaic, tmp_path):
    words = ["export", "mosaic.tif", "--format", "pmtiles", "--format", "xyz", "--output", "there"]
    assert run(words) == 0
    folder = tmp_path / "there" / "mosaic_tiles"
    listed = {
        (int(file.parts[-3]), int(file.parts[-2]), int(file.stem)): file for file in folder.rglob("*.png")
    }
    with (tmp_path / "there" / "mosaic.pmtiles").open("rb") as file:
        header = Reader(MmapSource(file)).header()
        tiles = dict(all_tiles(MmapSource(file)))
    assert header["tile_type"] == TileType.WEBP
    assert (header["min_zoom"], header["max_zoom"]) == (min(listed)[0], max(listed)[0])
    assert header["min_lon_e7"] < ORIGIN.longitude_deg * 1e7 < header["max_lon_e7"]
    assert set(tiles) == set(listed)
    for place, data in tiles.items():
        webp = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        png = cv2.imread(str(listed[place]), cv2.IMREAD_UNCHANGED)
        assert np.median(np.abs(webp[..., :3].astype(float) - png[..., :3])) < 6


def test_a_mosaic_on_no_earth_has_no_web_tiles(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    canvas = Canvas(np.zeros(2), CELL_M, 256, 256, (1.0, 0.0))
    with geotiff(tmp_path / "mosaic.tif", canvas, None) as put:
        put(Sheet(0, 0, np.full((256, 256, 4), 255, np.uint8)))
    assert run(["export", "mosaic.tif", "--format", "pmtiles"]) == 2
    words = capsys.readouterr().err
    assert words.count("\n") == 1
    assert "lies nowhere on the earth" in words
    assert not (tmp_path / "mosaic.pmtiles").exists()


def test_a_mosaic_is_a_cloud_optimised_geotiff(mosaic, tmp_path):
    """By the rules of GDAL's validator: its layout is stated, and overviews follow in blocks."""
    with rasterio.open(tmp_path / "mosaic.tif") as source:
        assert source.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert source.overviews(1) == [2, 4, 8, 16]
        assert source.block_shapes[0] == (512, 512)
