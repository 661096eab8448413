"""The project of QGIS, the mosaic as a cloud-optimised GeoTIFF, and its points, opened by tools not ours."""

import os
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import cv2
import numpy as np
import pyogrio
import pytest
import rasterio
from pypcd4 import PointCloud
from pyproj import CRS

from tests.maps.gis import street, write_empty
from v2hdm.cli.main import run
from v2hdm.geometry.rigid import exp
from v2hdm.io.maps.formats import write_map
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.trajectory import write_tum
from v2hdm.mosaic.blend import Sheet
from v2hdm.mosaic.result import geotiff
from v2hdm.mosaic.views import Canvas
from v2hdm.records import Trajectory

QGIS = """
import sys
from qgis.core import QgsApplication, QgsMapRendererParallelJob, QgsMapSettings, QgsProject, QgsXmlUtils
from PyQt5.QtCore import QSize
from PyQt5.QtXml import QDomDocument
app = QgsApplication([], False)
app.initQgis()
project = QgsProject.instance()
assert project.read(sys.argv[1])
layers = [node.layer() for node in project.layerTreeRoot().findLayers()]
assert len(layers) == 4 and all(one and one.isValid() and one.crs().isValid() for one in layers), layers
text = QDomDocument()
text.setContent(open(sys.argv[1]).read())
settings = QgsMapSettings()
settings.setLayers(layers)
settings.setDestinationCrs(project.crs())
settings.setExtent(QgsXmlUtils.readRectangle(text.elementsByTagName("extent").at(0).toElement()))
settings.setOutputSize(QSize(1000, 600))
job = QgsMapRendererParallelJob(settings)
job.start()
job.waitForFinished()
job.renderedImage().save(sys.argv[2])
os_exit = __import__("os")._exit
os_exit(0)
"""
PYTHON_OF_QGIS = "/usr/bin/python3"


@pytest.fixture
def result(tmp_path):
    """A folder with a mosaic of grey ground, unseen beyond y = 15 m, and the map upon it."""
    canvas = Canvas.around(np.array([[-5.0, -8.0], [35.0, 20.0]]), 0.02, 256)
    rgba = np.full((canvas.rows, canvas.columns, 4), 255, np.uint8)
    rgba[..., :3] = 90
    rgba[: canvas.rows // 4, :, 3] = 0
    rgba[-200:-100, 100:200, :3] = 200
    with geotiff(tmp_path / "mosaic.tif", canvas, street().origin) as put:
        put(Sheet(0, 0, rgba))
    return tmp_path, canvas


def colours(picture):
    pixels = cv2.imread(str(picture)).reshape(-1, 3).astype(int)
    return lambda bgr: int((np.abs(pixels - bgr).max(axis=1) < 12).sum())


@pytest.mark.parametrize("crs", [None, "EPSG:32651"])
def test_qgis_itself_draws_the_project(result, crs):
    qgis = subprocess.run([PYTHON_OF_QGIS, "-c", "import qgis.core"], capture_output=True, check=False)
    if qgis.returncode:
        pytest.skip("needs QGIS, 1 GB: apt-get install python3-qgis")
    folder, _ = result
    write_map(street(), folder, "map", ["qgis"], crs=crs)
    offscreen = {**os.environ, "QT_QPA_PLATFORM": "offscreen", "PYTHONPATH": ""}
    drawn = [PYTHON_OF_QGIS, "-c", QGIS, folder / "map.qgs", folder / "drawn.png"]
    process = subprocess.run(drawn, env=offscreen, capture_output=True, text=True, check=False, timeout=120)
    assert process.returncode == 0, process.stderr
    count = colours(folder / "drawn.png")
    assert count((90, 90, 90)) > 100_000  # ground
    assert count((233, 180, 86)) > 200  # lane lines


@pytest.mark.parametrize(("crs", "code"), [(None, 4326), ("EPSG:32651", 32651)])
def test_every_source_and_system_of_the_project_opens_and_is_relative(result, crs, code):
    folder, _ = result
    write_map(street(), folder, "map", ["qgis"], crs=crs)
    root = ET.parse(folder / "map.qgs").getroot()
    sources = {layer.findtext("layername"): layer for layer in root.findall("projectlayers/maplayer")}
    assert list(sources) == ["symbols", "lanes", "markings", "mosaic"]
    for name, element in sources.items():
        file, _, layer = element.findtext("datasource").partition("|layername=")
        assert not Path(file).is_absolute()
        system = CRS.from_wkt(element.findtext("srs/spatialrefsys/wkt"))
        if name == "mosaic":
            with rasterio.open(folder / file) as data:
                parameters = CRS.from_wkt(data.crs.to_wkt()).coordinate_operation.params
                stated = system.coordinate_operation.params
                np.testing.assert_allclose(
                    [parameter.value for parameter in parameters], [parameter.value for parameter in stated]
                )
        else:
            assert pyogrio.read_info(folder / file, layer=layer)["crs"] == f"EPSG:{code}"
            assert system.to_epsg() == code
    assert CRS.from_wkt(root.findtext("projectCrs/spatialrefsys/wkt")).is_projected


def test_the_mosaic_is_a_cloud_optimised_geotiff(result):
    folder, canvas = result
    with rasterio.open(folder / "mosaic.tif") as data:
        assert data.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert data.overviews(1)[:2] == [2, 4]
        assert (data.height, data.width) == (canvas.rows, canvas.columns)
        is_covered = data.dataset_mask()
        assert not is_covered[: canvas.rows // 4].any()
        assert is_covered[canvas.rows // 4 :].all()
        assert np.abs(data.read(1)[canvas.rows // 2].astype(int) - 90).max() <= 2


def test_the_ground_as_points_has_heights_and_the_paint_where_it_is(result, monkeypatch):
    folder, canvas = result
    poses = np.stack(
        [exp(np.array([x, 0.0, 0.02 * x, 0, np.arctan(-0.02), 0])) for x in np.arange(0, 40.0, 0.5)]
    )
    for pose, x in zip(poses, np.arange(0, 40.0, 0.5), strict=True):
        pose[:3, 3] = x, 0.0, 0.02 * x
    write_tum(Trajectory(np.arange(len(poses)) / 10, poses), folder / "trajectory.tum")
    monkeypatch.chdir(folder)
    assert run(["export", "mosaic.tif", "--format", "pcd"]) == 0
    cloud = PointCloud.from_path(folder / "mosaic.pcd")
    assert cloud.fields == ("x", "y", "z", "intensity")
    x, y, z, grey = cloud.numpy().T
    west, south, _, _ = canvas.bounds_m
    bright = grey > 180
    assert bright.sum() == pytest.approx(50 * 50, rel=0.1)  # 2 m by 2 m, two pixels of 2 cm apart
    assert x[bright].min() == pytest.approx(west + 2.0, abs=0.06)
    assert y[bright].max() == pytest.approx(south + 4.0, abs=0.06)
    on_road = (np.abs(y) < 2) & (x > 5) & (x < 30)
    np.testing.assert_allclose(z[on_road], 0.02 * x[on_road], atol=0.02)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["mosaic.tif", "--format", "gpkg"], "its other formats are pcd, pmtiles, xyz"),
        (["mosaic.tif", "--format", "pcd", "--crs", "local"], "points are in the map's own frame"),
        (["broken.tif", "--format", "pcd"], "broken.tif: not a readable GeoTIFF"),
        (["pipe.tif", "--format", "pcd"], "pipe.tif: not a readable GeoTIFF (no such file)"),
        (["huge.tif", "--format", "pcd"], "huge.tif: has more pixels than its bytes could hold"),
        (["map.gpkg", "--format", "qgis", "--crs", "local"], "map.gpkg would be overwritten"),
    ],
)
def test_what_cannot_be_exported_is_refused_in_one_line(result, monkeypatch, capsys, words, message):
    folder, _ = result
    still = np.repeat(np.eye(4)[None], 2, axis=0)
    write_tum(Trajectory(np.array([0.0, 1.0]), still), folder / "trajectory.tum")
    write_geojson(street(), folder / "map.geojson")
    write_map(street(), folder, "map", ["gpkg"])
    (folder / "broken.tif").write_bytes(b"II*\0" + bytes(40))
    write_empty(folder / "huge.tif")
    if words[0] == "pipe.tif":
        os.mkfifo(folder / words[0])
    monkeypatch.chdir(folder)
    assert run(["export", *words]) == 2
    shown = capsys.readouterr().err
    assert message in shown
    assert len(shown.strip().splitlines()) == 1
