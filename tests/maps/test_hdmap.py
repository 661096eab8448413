"""Maps and calibrations survive their files, with residuals, exclusions, verdict and clocks beside them."""

import json
from dataclasses import replace

import numpy as np
import pyproj
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from tests.drive.example import ORIGIN, camera_info, looking_forward, make_map
from tests.maps.gis import assert_same_map
from v2hdm.errors import MapFileError
from v2hdm.geometry.geodetic import enu_from_geodetic, geodetic_from_enu
from v2hdm.io.calibration.reading import read_calibration
from v2hdm.io.calibration.writing import write_calibration
from v2hdm.io.maps.evidence import (
    Residuals,
    read_exclusions,
    read_residuals,
    write_exclusions,
    write_residuals,
)
from v2hdm.io.maps.features import with_heights
from v2hdm.io.maps.formats import FORMATS
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.reading import read_geojson, read_geopackage, read_verdict
from v2hdm.records import (
    Calibration,
    CameraInfo,
    Exclusion,
    GeodeticOrigin,
    HDMap,
    Lane,
    Marking,
    Road,
    Symbol,
)
from v2hdm.store.files import load_yaml

LATITUDES, LONGITUDES = st.floats(-89.9, 89.9), st.floats(-180, 180)


@given(LATITUDES, LONGITUDES, st.floats(-400, 4000))
def test_enu_agrees_with_pyproj_and_returns(latitude, longitude, altitude):
    origin = GeodeticOrigin(latitude, longitude, altitude)
    points = np.random.default_rng(0).uniform(-3000, 3000, (50, 3)) * [1, 1, 0.05]
    degrees = geodetic_from_enu(origin, points)
    np.testing.assert_allclose(enu_from_geodetic(origin, degrees), points, atol=1e-6)
    enu = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lat_0={latitude!r} +lon_0={longitude!r} +h_0={altitude!r}"
    )
    expected = np.column_stack(enu.transform(degrees[:, 1], degrees[:, 0], degrees[:, 2]))
    np.testing.assert_allclose(expected, points, atol=1e-6)


@pytest.mark.parametrize("origin", [None, ORIGIN])
def test_symbols_survive_their_file_and_are_polygons(tmp_path, origin):
    outline = np.array([[0.1, 0.0], [1.0, 0.2], [0.3, 0.7]])
    symbols = (
        Symbol("parking_t", outline, 5, 0.1, np.array([0.1, 0.2, 0.3]), None, None, 0.01 * np.eye(6), "C"),
        Symbol("arrow", 2 * outline, 3),
    )
    path = tmp_path / "map.geojson"
    write_geojson(HDMap(make_map().markings, (), origin, symbols), path)
    for got, expected in zip(read_geojson(path).symbols, symbols, strict=True):
        assert (got.kind, got.sightings, got.sigma_m) == (expected.kind, expected.sightings, expected.sigma_m)
        np.testing.assert_array_equal(got.outline_map, expected.outline_map)
        np.testing.assert_array_equal(got.covariance_m2, expected.covariance_m2)
        np.testing.assert_array_equal(got.heights_m, expected.heights_m)
        assert got.accuracy == expected.accuracy
    feature = json.loads(path.read_text())["features"][-1]
    assert (feature["id"], feature["geometry"]["type"]) == (4, "Polygon")
    assert feature["properties"]["class"] == "arrow"
    (ring,) = feature["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    assert len(ring) == 4


@pytest.mark.parametrize("ending", ["csv", "gpkg", "dxf", "osm"])
def test_every_format_holds_a_symbol_of_three_corners(tmp_path, ending):
    symbol = Symbol("parking_t", np.array([[0.1, 0.0], [1.0, 0.2], [0.3, 0.7]]), 5, 0.013, accuracy="B")
    hd_map = HDMap((), (), ORIGIN, (symbol,))
    file_format = {"osm": "lanelet2"}.get(ending, ending)
    path = tmp_path / f"map.{ending}"
    FORMATS[file_format].write(hd_map, path, None)
    assert path.stat().st_size > 0
    if ending == "gpkg":
        (got,) = read_geopackage(path).symbols
        assert (got.kind, got.sightings, got.sigma_m, got.id) == ("parking_t", 5, 0.013, 1)
        assert got.accuracy == "B"
        np.testing.assert_allclose(got.outline_map, symbol.outline_map, atol=1e-12)
    elif ending in ("csv", "osm"):
        assert "parking_t" in path.read_text()


@pytest.mark.parametrize("turn", [1, -1])
def test_rings_are_closed_and_counter_clockwise_whatever_the_corners_do(tmp_path, turn):
    corners = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]])[::turn]
    write_geojson(HDMap((Marking("diamond", corners, 3),), (), ORIGIN), tmp_path / "map.geojson")
    geometry = json.loads((tmp_path / "map.geojson").read_text())["features"][0]["geometry"]
    ring = np.array(geometry["coordinates"][0])
    assert geometry["type"] == "Polygon"
    assert ring.shape == (5, 3)
    np.testing.assert_array_equal(ring[0], ring[-1])
    x, y, _ = (ring - ring[0]).T
    assert x[:-1] @ y[1:] - y[:-1] @ x[1:] > 0


@pytest.mark.parametrize(("origin", "above_m"), [(None, 0.0), (ORIGIN, ORIGIN.altitude_m)])
def test_the_road_s_height_is_the_third_coordinate_and_survives_the_file(tmp_path, origin, above_m):
    stations = np.column_stack([np.arange(-20.0, 21.0), np.zeros(41)])
    road = Road(stations, 2.0 + 0.05 * stations[:, 0], np.tile([0.05, 0.02], (41, 1)))
    corners = np.array([[0.0, 1.0], [0.0, 0.0], [2.0, 0.0], [2.0, 1.0]])
    lane = Lane("lane_line", np.array([[0.0, 2.0], [10.0, 2.0]]), 4)
    hd_map = with_heights(HDMap((Marking("diamond", corners, 3),), (lane,), origin), road)
    expected = [2.02, 2.0, 2.1, 2.12]
    assert hd_map.markings[0].heights_m is not None
    np.testing.assert_allclose(hd_map.markings[0].heights_m, expected, atol=1e-9)
    write_geojson(hd_map, tmp_path / "map.geojson")
    ring, line = (
        feature["geometry"]["coordinates"]
        for feature in json.loads((tmp_path / "map.geojson").read_text())["features"]
    )
    np.testing.assert_allclose([p[2] - above_m for p in ring[0]], [*expected, expected[0]], atol=2e-4)
    np.testing.assert_allclose([p[2] - above_m for p in line], [2.04, 2.54], atol=2e-4)
    assert_same_map(read_geojson(tmp_path / "map.geojson"), hd_map)


def test_local_metres_say_that_they_are_not_degrees(tmp_path):
    write_geojson(HDMap(make_map().markings), tmp_path / "map.geojson")
    assert "metres" in json.loads((tmp_path / "map.geojson").read_text())["v2hdm"]["coordinates"]


def test_a_map_that_cannot_be_written_leaves_the_old_one(tmp_path):
    path = tmp_path / "map.geojson"
    write_geojson(make_map(), path)
    broken = HDMap((Marking("diamond", np.full((4, 2), np.nan), 3),))
    with pytest.raises(ValueError, match="JSON compliant"):
        write_geojson(broken, path)
    assert_same_map(read_geojson(path), make_map())
    assert [entry.name for entry in tmp_path.iterdir()] == ["map.geojson"]


def damaged_map(origin=None, **properties):
    """A map of one marking with properties that are wrong."""
    right = {"class": "diamond", "sightings": 3, "corners_map": [[0, 0], [1, 0], [1, 1], [0, 1]]}
    features = [{"properties": right | properties}]
    return json.dumps({"v2hdm": {"origin": origin}, "features": features})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"v2hdm": {}, "features": [{"properties": {}}]}', "feature 0: has no geometry, 'corn"),
        ('{"v2hdm": {}, "features": [{"properties": {"corners_map": [[0, 0]]}}]}', "feature 0, "),
        ('{"v2hdm": {"origin": {"lat": 1}}, "features": []}', "origin: unknown key 'lat'"),
        (damaged_map(origin={"latitude_deg": "x", "longitude_deg": 1, "altitude_m": 1}), "origin, latitude"),
        (damaged_map(origin={"latitude_deg": 91, "longitude_deg": 1, "altitude_m": 1}), "latitude must lie"),
        (damaged_map(heights_m=[1.0, 2.0]), "feature 0, heights_m"),
        (damaged_map(sightings=1.5), "feature 0, sightings: expected a whole number"),
        (damaged_map(sightings=2**70), "feature 0, sightings: expected a whole number"),
        (damaged_map(sightings=10**400), "feature 0, sightings: expected a finite number"),
        (damaged_map(corners_map=[[10**400, 0], [1, 0], [1, 1], [0, 1]]), "corners_map: holds a number that"),
        (damaged_map(accuracy="D"), "feature 0, accuracy is 'D'; give one of A, B, C, or leave it out"),
        (damaged_map(accuracy=["A"]), "feature 0, accuracy is a list of one; give one of A, B, C"),
        (damaged_map(covariance_m2=(-np.eye(8)).tolist()), "covariance_m2: not symmetric or negative"),
        (
            '{"v2hdm": {}, "features": [{"geometry": {"type": "Polygon", "coordinates": [[[0, 0, 0]]]}, '
            '"properties": {}}]}',
            "feature 0: its ring has fewer than three corners",
        ),
    ],
)
def test_a_damaged_map_is_refused(tmp_path, text, message):
    (tmp_path / "map.geojson").write_text(text)
    with pytest.raises(MapFileError, match=message):
        read_geojson(tmp_path / "map.geojson")


@pytest.mark.parametrize("with_covariance", [True, False])
def test_a_calibration_survives_its_file(tmp_path, with_covariance):
    half = np.random.default_rng(2).normal(size=(6, 6))
    written = Calibration(camera_info(), looking_forward(), half @ half.T if with_covariance else None)
    write_calibration(written, tmp_path / "front.yaml")
    got = read_calibration(tmp_path / "front.yaml")
    np.testing.assert_array_equal(got.cam_from_vehicle, written.cam_from_vehicle)
    np.testing.assert_array_equal(got.info.intrinsic, written.info.intrinsic)
    assert (got.info.name, got.info.distortion) == (written.info.name, written.info.distortion)
    assert (got.covariance is None) == (not with_covariance)
    if got.covariance is not None:
        np.testing.assert_array_equal(got.covariance, half @ half.T)


def test_sigmas_are_written_in_metres_and_degrees(tmp_path):
    covariance = np.diag(np.square([0.01, 0.02, 0.03, *np.radians([0.1, 0.2, 0.3])]))
    write_calibration(Calibration(camera_info(), looking_forward(), covariance), tmp_path / "front.yaml")
    text = (tmp_path / "front.yaml").read_text()
    assert "translation_sigma_m: [0.01, 0.02, 0.03]" in text
    assert "rotation_sigma_deg: [0.1" in text


def test_a_calibration_with_a_typo_is_refused(tmp_path):
    write_calibration(Calibration(camera_info(), looking_forward()), tmp_path / "front.yaml")
    text = (tmp_path / "front.yaml").read_text().replace("camera_matrix", "camera_matriks")
    (tmp_path / "front.yaml").write_text(text)
    with pytest.raises(MapFileError, match="did you mean 'camera_matrix'"):
        read_calibration(tmp_path / "front.yaml")


@pytest.mark.parametrize(
    "wrong",
    [-np.eye(6), np.eye(6) + np.eye(6, k=1) / 2, np.eye(6) + 2 * (np.eye(6, k=1) + np.eye(6, k=-1))],
    ids=["negative", "not symmetric", "correlated by more than 1"],
)
def test_what_is_no_covariance_is_refused(tmp_path, wrong):
    path = tmp_path / "front.yaml"
    write_calibration(Calibration(camera_info(), looking_forward(), np.eye(6)), path)
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    path.write_text(yaml.safe_dump(content | {"covariance": wrong.tolist()}), encoding="utf-8")
    with pytest.raises(MapFileError, match=r"front\.yaml: covariance: not symmetric or negative"):
        read_calibration(path)


@pytest.mark.parametrize(
    ("key", "wrong", "message"),
    [
        ("image_width", 640.5, "image_width: expected a whole number of 1 to 65535, got 640.5"),
        ("image_height", 1e308, "image_height: expected a whole number of 1 to 65535"),
        ("image_height", 2**70, "image_height: expected a whole number of 1 to 65535"),
        ("camera_matrix", [[500, 0, 320], [0, 500, 240], [-1, 0, 1]], "camera_matrix: not of the form"),
        ("camera_matrix", [[1e308, 0, 320], [0, 500, 240], [0, 0, 1]], "camera_matrix: beyond"),
        ("distortion_coefficients", [-0.9, 0, 0, 0, 0], "this lens folds over itself"),
    ],
)
def test_a_camera_that_cannot_be_is_refused_by_name(tmp_path, key, wrong, message):
    path = tmp_path / "front.yaml"
    write_calibration(Calibration(camera_info(), looking_forward()), path)
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    path.write_text(yaml.safe_dump(content | {key: wrong}), encoding="utf-8")
    with pytest.raises(MapFileError, match=f"front.yaml: .*{message}"):
        read_calibration(path)


def some_residuals():
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


def test_residuals_are_read_back_as_written(tmp_path):
    written = some_residuals()
    write_residuals(written, tmp_path / "residuals.csv")
    read = read_residuals(tmp_path / "residuals.csv")
    for name, value in vars(written).items():
        np.testing.assert_array_equal(getattr(read, name), value, err_msg=name)
    assert len(read) == 3


@pytest.mark.parametrize("distance", [np.inf, np.nan])
def test_a_corner_behind_the_camera_has_no_finite_residual_and_is_read_back(distance, tmp_path):
    written = replace(some_residuals(), distance_sigma=np.array([0.5, distance, 2.0]))
    write_residuals(written, tmp_path / "residuals.csv")
    read = read_residuals(tmp_path / "residuals.csv")
    np.testing.assert_array_equal(read.distance_sigma, written.distance_sigma)


@pytest.mark.parametrize(
    "line",
    [
        "front/x.png,front,1.0,2,1",
        "front/x.png,front,late,2,1,1,0,0,0,0,0",
        "front/x.png,front,1.0,2.5,1,1,0,0,0,0,0",
        "front/x.png,front,1.0,2,5,1,0,0,0,0,0",
        "front/x.png,front,1.0,2,1,1,0,1e13,0,0,0",
        "front/x.png,front,1e13,2,1,1,0,0,0,0,0",
    ],
)
def test_a_damaged_line_is_named(line, tmp_path):
    path = tmp_path / "residuals.csv"
    write_residuals(some_residuals(), path)
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(MapFileError, match="line 5"):
        read_residuals(path)


def test_exclusions_without_a_place_are_refused(tmp_path):
    (tmp_path / "excluded.geojson").write_text('{"features": [{"properties": {"class": "diamond"}}]}')
    with pytest.raises(MapFileError, match="feature 0"):
        read_exclusions(tmp_path / "excluded.geojson")


VERDICT = {"status": "WARN", "findings": [{"check": "clock", "says": "late"}], "passed": []}
MAP = HDMap((Marking("diamond", np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), 3),))
CALIBRATION = Calibration(CameraInfo("front", 640, 480, np.diag([500.0, 500.0, 1.0])), np.eye(4))


@pytest.mark.parametrize("verdict", [VERDICT, None])
def test_a_map_keeps_the_verdict_on_it(tmp_path, verdict):
    write_geojson(MAP, tmp_path / "map.geojson", verdict)
    assert read_verdict(tmp_path / "map.geojson") == verdict


@pytest.mark.parametrize(("sigma_s", "is_sigma_known"), [(0.001, True), (float("inf"), False)])
def test_a_calibration_says_clock_read_out_time_and_verdict(tmp_path, sigma_s, is_sigma_known):
    calibration = Calibration(CALIBRATION.info, _looking_down())
    path = tmp_path / "front.yaml"
    write_calibration(calibration, path, clock_s=(0.06, sigma_s), read_out_s=(0.03, 0.0005), verdict=VERDICT)
    content = load_yaml(path, MapFileError)
    assert content["clock_offset_s"] == 0.06
    assert (content["read_out_s"], content["read_out_sigma_s"]) == (0.03, 0.0005)
    assert ("clock_sigma_s" in content) is is_sigma_known
    assert content["verdict"] == VERDICT
    np.testing.assert_allclose(read_calibration(path).cam_from_vehicle, _looking_down())


def test_what_was_left_out_is_a_point_with_its_reason_and_is_read_back(tmp_path):
    exclusion = Exclusion("diamond", np.array([3.0, 4.0]), 2, "seen once", "front")
    road = Road(np.array([[3.0, 4.0]]), np.array([46.2]), np.zeros((1, 2)))
    write_exclusions([exclusion], tmp_path / "excluded.geojson", None, road)
    (feature,) = json.loads((tmp_path / "excluded.geojson").read_text())["features"]
    assert feature["geometry"] == {"type": "Point", "coordinates": [3.0, 4.0, 46.2]}
    write_exclusions([exclusion], tmp_path / "wgs.geojson", GeodeticOrigin(48.0, 11.0, 500.0), None)
    for name in ("excluded", "wgs"):
        (read,) = read_exclusions(tmp_path / f"{name}.geojson")
        np.testing.assert_array_equal(read.position_map, exclusion.position_map)
        assert (read.kind, read.sightings, read.reason, read.cameras) == ("diamond", 2, "seen once", "front")
    (feature,) = json.loads((tmp_path / "wgs.geojson").read_text())["features"]
    assert feature["geometry"]["coordinates"][:2] == pytest.approx([11.0, 48.0], abs=1e-3)


def _looking_down():
    matrix = np.eye(4)
    matrix[:3, :3] = [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]
    matrix[2, 3] = 2.0
    return matrix
