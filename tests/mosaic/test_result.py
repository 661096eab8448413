"""From a result folder to files that a GIS reads and a person looks at."""

import json
import shutil
import sys

import cv2
import numpy as np
import pyproj
import pytest
import rasterio

from tests.mosaic import scene
from v2hdm.cli.main import run
from v2hdm.geometry.geodetic import crs_of, geodetic_from_enu
from v2hdm.mosaic.blend import Sheet
from v2hdm.mosaic.result import Picture, _shown_blocks, geotiff
from v2hdm.mosaic.views import Canvas
from v2hdm.store.names import METRICS


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    """The result of a drive over squares whose recorded poses are 20 cm off to and fro."""
    folder = tmp_path_factory.mktemp("squares")
    return scene.result_of(folder, scene.drive_of(folder / "drive", scene.squares, 0.2))


@pytest.fixture(scope="module")
def told(result):
    assert run(["mosaic", str(result)]) == 0
    assert '"mosaic":{"src":"' in (result / "report.html").read_text()
    return json.loads((result / "mosaic.json").read_text())


def test_the_geotiff_has_the_ground_where_it_lies(told, result):
    with rasterio.open(result / "mosaic.tif") as file:
        assert file.res == (0.02, 0.02)
        assert file.overviews(1)
        assert tuple(file.bounds) == pytest.approx(told["bounds_m"])
        inside, outside = np.array([[7.0, 1.0], [9.0, -1.0]]), np.array([[8.0, 1.0], [9.0, -1.7]])
        for places, low, high in ((inside, 190, 230), (outside, 40, 80)):
            for value in file.sample(places):
                assert low < value[0] < high
        assert file.dataset_mask()[0, 0] == 0


def test_the_picture_covers_the_bounds_and_is_clear_where_nothing_was_seen(told, result):
    picture = cv2.imread(str(result / told["image"]), cv2.IMREAD_UNCHANGED)
    west, south, east, north = told["bounds_m"]
    rows, columns = picture.shape[:2]
    assert columns * told["resolution_m"] == pytest.approx(east - west)
    assert rows * told["resolution_m"] == pytest.approx(north - south)
    row, column = (round(value / told["resolution_m"]) for value in (north - 1.0, 9.0 - west))
    assert picture[row, column, 0] > 190
    assert picture[row, column, 3] == 255
    assert picture[0, 0, 3] == 0
    assert cv2.imread(str(result / "mosaic_before_after.png")).shape[1] > 800


def test_the_projection_agrees_with_the_tangent_plane_to_a_millimetre():
    points = np.array([[x, y, 0.0] for x in (-2000, 0, 700, 2000) for y in (-2000, 0, 2000)], dtype=float)
    geodetic = geodetic_from_enu(scene.ORIGIN, points)
    to_grid = pyproj.Transformer.from_crs("EPSG:4326", crs_of(scene.ORIGIN), always_xy=True)
    projected = np.column_stack(to_grid.transform(geodetic[:, 1], geodetic[:, 0]))
    is_near = np.linalg.norm(points, axis=1) <= 2001
    assert np.abs(projected - points[:, :2])[is_near].max() < 1e-3


def test_without_an_origin_the_geotiff_says_that_it_belongs_nowhere_on_the_earth(tmp_path):
    canvas = Canvas(np.array([0.0, 5.12]), 0.02, 256, 256)
    with geotiff(tmp_path / "mosaic.tif", canvas, None) as put:
        put(Sheet(0, 0, np.full((256, 256, 4), 255, dtype=np.uint8)))
    with rasterio.open(tmp_path / "mosaic.tif") as file:
        assert not file.crs.is_geographic
        assert not file.crs.is_projected
        assert "V2HDM map frame" in file.crs.to_wkt()


def test_a_picture_is_reduced_until_it_can_be_drawn_and_keeps_its_colours():
    picture = Picture(Canvas(np.zeros(2), 0.02, 512, 10240))
    assert picture.resolution_m == pytest.approx(0.04)
    rgba = np.zeros((512, 2048, 4), dtype=np.uint8)
    rgba[:, ::2] = [200, 100, 50, 255]
    picture.put(Sheet(0, 2048, rgba))
    np.testing.assert_array_equal(picture._rgba[0, 1024], [200, 100, 50, 128])
    assert not picture._rgba[:, :1024].any()


def test_of_a_sheet_only_blocks_that_show_something_are_written():
    rgba = np.zeros((1024, 768, 4), dtype=np.uint8)
    rgba[600, 700] = [200, 100, 50, 1]
    (block,) = _shown_blocks(Sheet(2048, 4096, rgba))
    assert (block.row, block.column) == (2048 + 512, 4096 + 512)
    np.testing.assert_array_equal(block.rgba, rgba[512:, 512:])


def said_of_drive(folder, **values):
    """Change what a result says of its drive."""
    content = json.loads((folder / METRICS).read_text())
    content["drive"] |= values
    (folder / METRICS).write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda folder: (folder / METRICS).unlink(), "has no metrics.json"),
        (lambda folder: (folder / METRICS).write_text("[]"), "metrics.json"),
        (lambda folder: said_of_drive(folder, limit="x"), "are damaged"),
        (lambda folder: said_of_drive(folder, paths=["gone"]), "give its folder with --drive"),
        (lambda folder: said_of_drive(folder, name="other"), "the result is of drive other"),
        (lambda folder: (folder / "calibration_front.yaml").unlink(), "no calibration_"),
        (lambda folder: (folder / "trajectory.tum").write_text("900 0 0 0 0 0 0 1\n"), "share no time"),
        (shutil.rmtree, "no such folder"),
    ],
)
def test_what_is_no_result_ends_in_one_line(spoil, says, result, tmp_path, capsys):
    folder = tmp_path / "result"
    shutil.copytree(result, folder)
    spoil(folder)
    assert run(["mosaic", str(folder)]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("resolution", ["0", "-1", "1e-9", "nan", "inf"])
def test_a_resolution_that_makes_no_mosaic_is_one_line(resolution, result, capsys):
    assert run(["mosaic", str(result), f"--resolution={resolution}"]) == 2
    assert "resolution of" in capsys.readouterr().err


def test_without_rasterio_the_picture_is_made_and_the_extra_is_named(result, tmp_path, monkeypatch, caplog):
    folder = tmp_path / "result"
    shutil.copytree(result, folder, ignore=shutil.ignore_patterns("mosaic*"))
    monkeypatch.setitem(sys.modules, "rasterio", None)
    assert run(["mosaic", str(folder), "--resolution=0.05"]) == 0
    assert "pip install 'v2hdm[gis]'" in caplog.text
    assert not (folder / "mosaic.tif").exists()
    assert json.loads((folder / "mosaic.json").read_text())["geotiff"] is None
