"""``v2hdm export``: what goes along, what comes back, and what a user may get wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.docs.blocks import blocks
from tests.drive.example import camera_info, looking_forward
from tests.maps.gis import street
from v2hdm.cli.main import run
from v2hdm.io.calibration import write_calibration
from v2hdm.io.maps import read_geojson, read_geopackage_verdict
from v2hdm.io.maps.formats import FORMATS
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.geopackage import write_geopackage
from v2hdm.records import Calibration

VERDICT = {"status": "PASS"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_geojson(street(), tmp_path / "map.geojson", VERDICT)
    write_geopackage(street(), tmp_path / "map.gpkg", VERDICT)
    write_calibration(Calibration(camera_info(), looking_forward()), tmp_path / "calibration_front.yaml")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_format_of_a_map_is_documented() -> None:
    exports = " ".join(block.text for block in blocks("docs/exports.md", "sh"))
    assert all(f"--format {name}" in exports for name in FORMATS)
    assert f"export=[{','.join(FORMATS)}]" in exports


def test_the_verdict_goes_along(folder: Path) -> None:
    assert run(["export", "map.geojson", "--format", "gpkg", "--output", "there"]) == 0
    assert read_geopackage_verdict(folder / "there" / "map.gpkg") == VERDICT


def test_an_edited_geopackage_becomes_the_geojson_again(folder: Path) -> None:
    before = read_geojson(folder / "map.geojson")
    assert run(["export", "map.gpkg", "--format", "geojson"]) == 0
    after = read_geojson(folder / "map.geojson")
    for old, new in zip(before.markings, after.markings, strict=True):
        np.testing.assert_array_equal(new.corners_map, old.corners_map)
        assert new.id == old.id


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["map.geojson", "--format", "shp"], "--format: unknown format 'shp'; choose from: geojson, csv"),
        (["calibration_front.yaml", "--format", "gpkg"], "unknown format 'gpkg' of a calibration"),
        (["map.geojson", "--format", "geojson"], "map.geojson would be written over"),
        (["map.csv", "--format", "gpkg"], "map.csv: no map that can be read"),
        (["none.geojson", "--format", "csv"], "none.geojson: no such file"),
        (["none.gpkg", "--format", "csv"], "none.gpkg: no such file"),
        (["none.yaml", "--format", "urdf"], "none.yaml: no such file"),
        (["map.geojson", "--format", "lanelet2", "--projector", "UTM"], "unknown projector 'UTM'"),
        (["map.geojson", "--format", "csv", "--output", "map.gpkg"], "cannot be written"),
    ],
)
def test_what_a_user_must_mend_is_one_line(
    folder: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["export", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1
