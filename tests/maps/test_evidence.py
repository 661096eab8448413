"""Files beside map and calibration: residuals, exclusions, the verdict, the clocks."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from v2hdm.errors import MapFileError
from v2hdm.io.calibration import read_calibration, write_calibration
from v2hdm.io.maps import read_geojson, read_verdict, write_geojson
from v2hdm.io.maps.evidence import (
    ExcludedMarking,
    Residuals,
    read_exclusions,
    read_residuals,
    write_exclusions,
    write_residuals,
)  # fmt: skip
from v2hdm.records import Calibration, CameraInfo, GeodeticOrigin, HdMap, Marking, Road
from v2hdm.store.files import load_yaml


def some_residuals() -> Residuals:
    random = np.random.default_rng(4)
    return Residuals(
        image=("front/a, b.png", 'rear/"c".png'),
        camera=("front", "rear"),
        taken_s=np.array([10.25, 11.5]),
        row_image=np.array([0, 0, 1]),
        marking=np.array([3, 0, 12]),
        corner=np.array([0, 3, 1]),
        is_point=np.array([True, False, True]),
        observed_px=np.round(random.uniform(0, 1000, (3, 2)), 3),
        residual_px=np.round(random.normal(0, 0.3, (3, 2)), 4),
        distance_sigma=np.array([0.5, 1.25, 2.0]),
    )


def test_residuals_are_read_back_as_written(tmp_path: Path) -> None:
    written = some_residuals()
    write_residuals(written, tmp_path / "residuals.csv")
    read = read_residuals(tmp_path / "residuals.csv")
    for name, value in vars(written).items():
        np.testing.assert_array_equal(getattr(read, name), value, err_msg=name)
    assert len(read) == 3


@pytest.mark.parametrize("line", ["front/x.png,front,1.0,2,1", "front/x.png,front,late,2,1,1,0,0,0,0,0"])
def test_a_damaged_line_is_named(line: str, tmp_path: Path) -> None:
    path = tmp_path / "residuals.csv"
    write_residuals(some_residuals(), path)
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(MapFileError, match="line 5"):
        read_residuals(path)


@pytest.mark.parametrize("origin", [None, GeodeticOrigin(53.5, 9.9, 40.0)])
def test_exclusions_are_read_back_as_written(origin: GeodeticOrigin | None, tmp_path: Path) -> None:
    written = [ExcludedMarking("diamond", np.array([1.25, -3.5]), 4, "its position is too uncertain", "both")]
    write_exclusions(written, tmp_path / "excluded.geojson", origin, None)
    (read,) = read_exclusions(tmp_path / "excluded.geojson")
    np.testing.assert_array_equal(read.position_map, written[0].position_map)
    assert (read.kind, read.sightings, read.reason, read.cameras) == (
        "diamond", 4, "its position is too uncertain", "both",
    )  # fmt: skip


def test_exclusions_without_a_place_are_refused(tmp_path: Path) -> None:
    (tmp_path / "excluded.geojson").write_text('{"features": [{"properties": {"class": "diamond"}}]}')
    with pytest.raises(MapFileError, match="feature 0"):
        read_exclusions(tmp_path / "excluded.geojson")


VERDICT = {"status": "WARN", "findings": [{"check": "clock", "says": "late"}], "passed": []}
MAP = HdMap((Marking("diamond", np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), 3),))
CALIBRATION = Calibration(CameraInfo("front", 640, 480, np.diag([500.0, 500.0, 1.0])), np.eye(4))


def test_a_map_keeps_the_verdict_on_it(tmp_path: Path) -> None:
    write_geojson(MAP, tmp_path / "map.geojson", VERDICT)
    assert read_verdict(tmp_path / "map.geojson") == VERDICT
    np.testing.assert_array_equal(
        read_geojson(tmp_path / "map.geojson").markings[0].corners_map, MAP.markings[0].corners_map
    )


def test_a_map_without_a_verdict_has_none(tmp_path: Path) -> None:
    write_geojson(MAP, tmp_path / "map.geojson")
    assert read_verdict(tmp_path / "map.geojson") is None


@pytest.mark.parametrize(("sigma_s", "known"), [(0.001, True), (float("inf"), False)])
def test_a_calibration_says_the_clock_and_the_verdict(tmp_path: Path, sigma_s: float, known: bool) -> None:
    calibration = Calibration(CALIBRATION.info, _looking_down())
    path = tmp_path / "front.yaml"
    write_calibration(calibration, path, clock_s=(0.06, sigma_s), verdict=VERDICT)
    content = load_yaml(path, MapFileError)
    assert content["clock_offset_s"] == 0.06
    assert ("clock_sigma_s" in content) is known
    assert content["verdict"] == VERDICT
    np.testing.assert_allclose(read_calibration(path).cam_from_vehicle, _looking_down())


def test_what_was_left_out_is_a_point_with_its_reason(tmp_path: Path) -> None:
    one = ExcludedMarking("diamond", np.array([3.0, 4.0]), 2, "seen once", "front")
    road = Road(np.array([[3.0, 4.0]]), np.array([46.2]), np.zeros((1, 2)))
    write_exclusions([one], tmp_path / "excluded.geojson", None, road)
    (feature,) = json.loads((tmp_path / "excluded.geojson").read_text())["features"]
    assert feature["geometry"] == {"type": "Point", "coordinates": [3.0, 4.0, 46.2]}
    assert feature["properties"]["reason"] == "seen once"
    assert feature["properties"]["cameras"] == "front"
    write_exclusions([one], tmp_path / "wgs.geojson", GeodeticOrigin(48.0, 11.0, 500.0), None)
    (feature,) = json.loads((tmp_path / "wgs.geojson").read_text())["features"]
    assert feature["geometry"]["coordinates"][:2] == pytest.approx([11.0, 48.0], abs=1e-3)


def _looking_down() -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]
    matrix[2, 3] = 2.0
    return matrix
