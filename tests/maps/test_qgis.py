"""The QGIS project, drawn by QGIS itself: skipped where Debian's ``python3-qgis`` is not installed."""

import json
import os
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from tests.maps.gis import street
from v2hdm.io.maps.colours import LINE, channels, colours_of
from v2hdm.io.maps.features import features_of
from v2hdm.io.maps.formats import write_map
from v2hdm.records import FloatArray, Symbol

PYTHON = Path("/usr/bin/python3")  # QGIS is for the system's Python
SCRIPT = Path(__file__).with_name("render_qgis.py")


class Drawn(NamedTuple):
    """A project as QGIS reads it, and its picture (H, W, 3) RGB."""

    about: dict
    rgb: np.ndarray

    def at(self, points_map: FloatArray) -> np.ndarray:
        """The colours (N, 3, 3, 3) about points (N, 2) of the map."""
        west, south, east, north = self.about["shown"]
        rows, columns = self.rgb.shape[:2]
        column = (points_map[:, 0] - west) / (east - west) * columns
        row = (north - points_map[:, 1]) / (north - south) * rows
        px = np.floor(np.column_stack([row, column])).astype(int)
        return np.array([self.rgb[r - 1 : r + 2, c - 1 : c + 2] for r, c in px])


def site(origin):
    arrow = Symbol("arrow", np.array([[20.0, 2.0], [24.0, 3.0], [20.0, 4.0]]), 7, 0.01, np.ones(3))
    return replace(street(origin), symbols=(arrow,))


def run_qgis(*words):
    environment = {"QT_QPA_PLATFORM": "offscreen", "PATH": os.environ["PATH"], "HOME": os.environ["HOME"]}
    return subprocess.run(
        [PYTHON, *words], capture_output=True, text=True, timeout=120, env=environment, check=False
    )


@pytest.fixture(scope="module", params=["on earth", "local"])
def drawn(request, tmp_path_factory):
    if not PYTHON.exists() or run_qgis("-c", "import qgis.core").returncode:
        pytest.skip("no QGIS: apt-get install python3-qgis")
    folder = tmp_path_factory.mktemp("qgis")
    hd_map = site(street().origin if request.param == "on earth" else None)
    *_, project = write_map(hd_map, folder, "map", ["qgis"])
    process = run_qgis(SCRIPT, project, folder / "picture.png")
    assert process.returncode == 0, process.stderr
    picture = cv2.imread(str(folder / "picture.png"))
    return Drawn(json.loads(process.stdout.splitlines()[-1]), picture[..., ::-1])


def test_qgis_reads_every_layer_in_a_system_of_metres_that_it_knows(drawn):
    about = drawn.about
    assert about["read"]
    assert about["crs"]
    assert about["metres"]
    assert about["errors"] == []
    assert about["layers"] == {"markings": True, "lanes": True, "symbols": True}


def test_qgis_outlines_each_class_in_the_report_s_colour(drawn):
    features = features_of(site(None))
    for feature in features:
        if feature.closed:
            around = drawn.at((feature.points_map + np.roll(feature.points_map, 1, axis=0)) / 2)
            expected = channels(colours_of(features)[feature.kind])
            off = np.abs(around.astype(int) - expected).max(axis=-1).min(axis=(1, 2))
            assert off.max() <= 3, feature.kind


def test_qgis_draws_dashed_lane_lines_dashed_and_others_whole(drawn):
    for feature in features_of(site(None)):
        if feature.closed:
            continue
        along = np.linspace(0, len(feature.points_map) - 1, 2000)
        vertices = np.arange(len(feature.points_map))
        places = [np.interp(along, vertices, feature.points_map[:, axis]) for axis in (0, 1)]
        around = drawn.at(np.column_stack(places)).astype(int)
        is_drawn = np.abs(around[:, 1, 1] - channels(LINE)).max(axis=-1) < 60
        if feature.kind == "lane_dash":
            assert 0.3 < is_drawn.mean() < 0.9
        else:
            assert is_drawn.mean() > 0.97
