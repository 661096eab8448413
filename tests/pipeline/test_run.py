"""The main job on a short rendered drive: images and poses in, map and calibrations out."""

import json
import re
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from tests.drive.example import description, make_drive, make_map
from tests.ports import blind_copy, run_config, short_port
from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import ConfigError, DetectorError, DriveError, MapFileError
from v2hdm.geometry.geodetic import crs_of
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.calibration.reading import read_calibration
from v2hdm.io.calibration.writing import CALIBRATION_FORMATS
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.io.maps.evidence import read_residuals
from v2hdm.io.maps.formats import FORMATS
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.reading import read_geojson
from v2hdm.io.trajectory import read_tum, write_tum
from v2hdm.mapping.options import MappingOptions
from v2hdm.mapping.results import AdjustedPoses
from v2hdm.pipeline import map_drive
from v2hdm.pipeline.config import MapConfig, ReportConfig, admit, run_name
from v2hdm.pipeline.result import _along_route
from v2hdm.pipeline.run import made_of, run
from v2hdm.pipeline.saving import write_trajectories
from v2hdm.pipeline.stages import camera_sets
from v2hdm.records import Drive, HDMap, Image, Lane, Trajectory
from v2hdm.site.options import AcceptanceOptions, LaneOptions
from v2hdm.store.inputs import protected_inputs
from v2hdm.store.results import result_folder
from v2hdm.verdict import Status


@pytest.fixture(scope="module")
def result(short_drive, coarse_mosaics, tmp_path_factory):
    output = tmp_path_factory.mktemp("outputs")
    report = ReportConfig(background=str(aerial_picture(output / "aerial.tif", read_drive(short_drive))))
    config = run_config(short_drive, output, export=list(FORMATS), mosaic=True, report=report, all_maps=True)
    return run(config).folder


def aerial_picture(path, drive):
    """400 m of grey ground around a drive's origin."""
    rasterio = pytest.importorskip("rasterio")
    size = {"width": 400, "height": 400, "count": 3, "dtype": "uint8", "crs": crs_of(drive.origin)}
    with rasterio.open(path, "w", transform=rasterio.Affine(1, 0, -200, 0, -1, 200), **size) as dataset:
        dataset.write(np.full((3, 400, 400), 90, np.uint8))
    return path


def test_a_picture_of_the_users_own_lies_under_the_map_of_the_report(result, short_drive, tmp_path):
    assert '"background":{"src":"UklGR' in (result / "report.html").read_text()
    gone = run_config(short_drive, tmp_path, report=ReportConfig(background=str(tmp_path / "gone.tif")))
    with pytest.raises(ConfigError, match=r"report.background: no file or folder .*gone\.tif"):
        run(gone)
    (tmp_path / "points.csv").write_text("name,u,v\n")
    table = ReportConfig(background=str(tmp_path / "points.csv"))
    with pytest.raises(MapFileError, match="not a readable GeoTIFF"):
        admit(run_config(short_drive, tmp_path, report=table))


def test_a_picture_of_another_place_costs_no_map_and_one_of_no_place_no_time(tiny_drive, tmp_path):
    rasterio = pytest.importorskip("rasterio")
    size = {"width": 40, "height": 40, "count": 3, "dtype": "uint8", "crs": "EPSG:32632"}
    away = tmp_path / "away.tif"
    with rasterio.open(
        away, "w", transform=rasterio.Affine(1, 0, 400_000, 0, -1, 4_000_000), **size
    ) as dataset:
        dataset.write(np.full((3, 40, 40), 90, np.uint8))
    report = ReportConfig(background=str(away))
    result = run(run_config(tiny_drive, tmp_path / "out", report=report))
    assert "no picture lies under the report's map: " in (result.folder / "run.log").read_text()
    assert '"background":null' in (result.folder / "report.html").read_text()
    lost = blind_copy(tiny_drive, tmp_path / "lost")
    with description(lost) as content:
        content.pop("origin")
    with pytest.raises(ConfigError, match=r"report\.background: this drive has no position on the earth"):
        run(run_config(lost, tmp_path / "lost_out", report=report))


@pytest.mark.slow
def test_every_method_is_judged_on_every_camera_set(result):
    metrics = json.loads((result / "metrics.json").read_text())
    assert set(metrics["results"]) == {"front", "rear", "both"}
    for methods in metrics["results"].values():
        assert set(methods) == {"CNI", "ENI", "Opt", "ONI"}
        for figures in methods.values():
            assert {"markings", "recall", "corner_rmse_m", "corner_bias_m"} <= set(figures)
    assert set(metrics["extrinsics"]) == {"front", "rear"}
    assert metrics["disturbances"]


def test_a_good_drive_passes_and_every_file_says_so(result):
    verdict = json.loads((result / "metrics.json").read_text())["verdict"]
    assert verdict["status"] == "PASS", verdict["findings"]
    assert {"heading", "clock", "ground match"} <= {
        finding["check"] for finding in verdict["passed"] + verdict["unobservable"]
    }
    assert json.loads((result / "map.geojson").read_text())["v2hdm"]["verdict"]["status"] == "PASS"
    assert yaml.safe_load((result / "calibration_front.yaml").read_text())["verdict"]["status"] == "PASS"
    assert "verdict: PASS" in (result / "run.log").read_text()


def test_yaw_from_north_fails_by_name_and_what_was_computed_is_still_written(tiny_drive, tmp_path):
    drive = blind_copy(tiny_drive, tmp_path / "north")
    recorded = read_tum(drive / "poses.tum")
    poses = recorded.map_from_vehicle.copy()
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    poses[:, :3, :3] = rotation_from_euler(0 * yaw, 0 * yaw, np.pi / 2 - yaw)
    write_tum(Trajectory(recorded.stamp_s, poses), drive / "poses.tum")
    outcome = run(run_config(drive, tmp_path / "out"))
    assert outcome.verdict.status is Status.FAIL
    assert outcome.verdict.findings[0].check == "heading"
    assert "north" in outcome.verdict.findings[0].says
    metrics = json.loads((outcome.folder / "metrics.json").read_text())
    assert metrics["verdict"]["status"] == "FAIL"


def test_the_optimisation_repairs_another_vehicles_calibration(result):
    metrics = json.loads((result / "metrics.json").read_text())
    of_both = metrics["results"]["both"]
    assert of_both["ENI"]["corner_rmse_m"] > 0.2
    assert of_both["Opt"]["corner_rmse_m"] < 0.06
    assert of_both["Opt"]["recall"] > 0.8  # a floor against breakage: 16 of 19 are found today
    assert of_both["Opt"]["false_markings"] == 0
    for camera in ("front", "rear"):
        assert metrics["extrinsics"][camera]["rotation_error_deg"] < 0.2


def test_the_files_of_a_result_can_be_read_back(result):
    hd_map = read_geojson(result / "map.geojson")
    metrics = json.loads((result / "metrics.json").read_text())
    assert len(hd_map.markings) == metrics["results"]["both"]["Opt"]["markings"]
    assert all(marking.covariance_m2 is not None for marking in hd_map.markings)
    accuracies = Counter(paint.accuracy for paint in (*hd_map.markings, *hd_map.symbols))
    assert accuracies == Counter(metrics["results"]["both"]["Opt"]["accuracy"])
    for camera in ("front", "rear"):
        calibration = read_calibration(result / f"calibration_{camera}.yaml")
        assert calibration.covariance is not None
        assert np.linalg.det(calibration.cam_from_vehicle[:3, :3]) == pytest.approx(1.0)
        for ending, _ in CALIBRATION_FORMATS.values():
            text = (result / f"calibration_{camera}" / f"{camera}_{ending}").read_text()
            assert "# drive: short\n# date: " in text
    for map_format in FORMATS.values():
        assert (result / map_format.file.format(name="map")).stat().st_size > 1000
    for picture in ("overlay_front.png", "overlay_rear.png", "mosaic_before_after.png"):
        image = cv2.imread(str(result / picture))
        assert image is not None, picture
        assert image.std() > 5.0
    residuals = read_residuals(result / "residuals.csv")
    assert set(residuals.marking[residuals.marking > 0]) == {m.id for m in hd_map.markings}
    assert set(residuals.camera) == {"front", "rear"}
    report = (result / "report.html").read_text()
    assert f'<dd class="value">{len(hd_map.markings)}</dd>' in report
    assert report.count("data:image/jpeg;base64,") >= 2
    assert (result / "config.yaml").stat().st_size > 0
    assert "detected" in (result / "run.log").read_text()


def test_lane_lines_run_as_the_drive_passed_them(result, short_drive):
    poses = np.array([image.map_from_vehicle for image in read_drive(short_drive).images])
    lanes = read_geojson(result / "map.geojson").lanes
    assert lanes
    for lane in lanes:
        steps = np.diff(lane.points_map, axis=0)
        offset = lane.points_map[:-1, None] - poses[:, :2, 3]
        headings = poses[np.argmin((offset**2).sum(axis=2), axis=1), :2, 0]
        assert (steps * headings).sum() > 0


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (Path.unlink, ""),
        (lambda image: image.write_bytes(image.read_bytes()[:-2000]), ""),
        (lambda image: cv2.imwrite(str(image), np.zeros((480, 320, 3), np.uint8)), "320 x 480.*640 x 360"),
    ],
    ids=["missing", "truncated", "of another size"],
)
def test_a_wrong_image_is_named_and_leaves_nothing_behind(spoil, says, tiny_drive, tmp_path):
    drive, output = blind_copy(tiny_drive, tmp_path / "drive"), tmp_path / "out"
    image = sorted(drive.rglob("*.jpg"))[2]
    spoil(image)
    with pytest.raises(DriveError, match=f"{image.name}.*{says}") as caught:
        run(run_config(drive, output))
    assert "\n" not in str(caught.value)
    assert not output.exists() or not any(output.iterdir())


def test_a_drive_past_nothing_fails_and_says_that_no_marking_was_found(tiny_drive, tmp_path):
    drive = blind_copy(tiny_drive, tmp_path / "drive")
    for image in drive.rglob("*.jpg"):
        cv2.imwrite(str(image), np.full((360, 640, 3), 90, np.uint8))
    outcome = run(run_config(drive, tmp_path / "out"))
    assert outcome.verdict.status is Status.FAIL
    assert any("no markings were found" in finding.says for finding in outcome.verdict.raised)
    assert not (outcome.folder / "map.geojson").exists()
    assert "no markings were found" in (outcome.folder / "report.html").read_text()


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"name": "../elsewhere"}, "the name '../elsewhere' has a path separator"),
        ({"workers": -1}, "workers is -1"),
        ({"mapping": MappingOptions(loss="square")}, "mapping.loss is 'square'"),
        ({"mapping": MappingOptions(model_floor_px=-0.1)}, "mapping.model_floor_px is -0.1"),
        ({"mapping": MappingOptions(lanes=LaneOptions(max_range_m=float("nan")))}, "mapping.lanes.max_range"),
        ({"mapping": MappingOptions(acceptance=AcceptanceOptions(min_probability=50))}, "probability is 50"),
        (
            {"mapping": MappingOptions(acceptance=AcceptanceOptions(accuracy="D"))},
            "mapping.acceptance.accuracy is 'D'; choose from A, B or C.",
        ),
        ({"detector": DetectorOptions(model="no such.onnx")}, "no such.onnx"),
        ({"export": ["geojson", "shp"]}, "export: unknown format 'shp'"),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_read(tmp_path, changes, named):
    with pytest.raises((ConfigError, DetectorError), match=re.escape(named)):
        run(run_config(tmp_path / "no such drive", tmp_path / "outputs", **changes))
    assert not list(tmp_path.iterdir())


def test_a_base_in_the_place_of_the_result_is_refused_before_any_work(tmp_path, monkeypatch):
    make_drive(tmp_path / "drive")
    base = MapConfig(base=str(tmp_path / "out" / "short"))
    config = run_config(tmp_path / "drive", tmp_path / "out", map=base)
    with result_folder(tmp_path / "out" / "short", maker=made_of(config)) as folder:
        write_geojson(make_map(), folder / "map.geojson")
    monkeypatch.setattr(map_drive, "map_drive", lambda *_, **__: pytest.fail("it worked"))
    with protected_inputs(), pytest.raises(ConfigError, match="is one of the inputs"):
        run(config)


def test_a_run_without_a_name_has_that_of_its_drive(tiny_drive, tmp_path):
    drive = blind_copy(tiny_drive, tmp_path / "folder")
    assert run_name(run_config(drive, tmp_path, name=None)) == "port"
    with description(drive) as content:
        content.pop("name")
    assert run_name(run_config(drive, tmp_path, name=None)) == "folder"
    assert run_name(run_config(drive, tmp_path, name="given")) == "given"


def test_a_run_that_both_renders_and_reads_is_refused(tmp_path):
    config = run_config(tmp_path, tmp_path / "out", simulate=short_port())
    with pytest.raises(ConfigError, match=r"drive\.path"):
        run(config)


def test_a_single_camera_is_one_set_and_two_are_three(short_drive):
    assert list(camera_sets(read_drive(short_drive))) == ["front", "rear", "both"]
    assert list(camera_sets(read_drive(short_drive, ReadOptions(cameras=["rear"])))) == ["rear"]


def poses(height_m=0.0, pitch_rad=0.0, forward_m=0.0):
    """Three poses a metre apart, moved along themselves by ``forward_m``."""
    out = np.tile(np.eye(4), (3, 1, 1))
    zero = np.zeros(3)
    out[:, :3, :3] = rotation_from_euler(zero, np.full(3, pitch_rad), zero)
    out[:, :3, 3] = np.column_stack([np.arange(3.0), zero, np.full(3, height_m)])
    moved = np.eye(4)
    moved[0, 3] = forward_m
    return np.asarray(out @ moved)


def test_poses_that_were_laid_flat_are_written_at_their_recorded_height(tmp_path):
    stamp_s = np.array([10.0, 10.5, 11.0])
    recorded = Trajectory(stamp_s, poses(46.2, 0.02))
    drive = Drive("d", tmp_path, {}, (), recorded=recorded)
    sigma = np.tile([0.01, 0.02, 0.003, 1e-4, 2e-4, 3e-4], (3, 1))
    is_seen = np.array([True, False, True])
    session = np.zeros(len(stamp_s), dtype=np.int64)
    adjusted = AdjustedPoses(stamp_s, poses(), poses(forward_m=0.05), sigma, is_seen, {}, session)
    write_trajectories(adjusted, drive, tmp_path)
    got = read_tum(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(got.stamp_s, stamp_s)
    np.testing.assert_allclose(got.map_from_vehicle, poses(46.2, 0.02, 0.05), atol=1e-8)
    header, first, second, _ = (tmp_path / "trajectory_sigma.csv").read_text().splitlines()
    assert header == "stamp_s,seen,forward_m,left_m,up_m,roll_rad,pitch_rad,heading_rad"
    assert first == "10.000000000,1,0.01,0.02,0.003,0.0001,0.0002,0.0003"
    assert second.split(",")[1] == "0"


def test_a_lane_that_is_turned_to_the_route_takes_the_sigmas_of_its_vertices_along():
    rising = np.arange(3.0)
    lane = Lane("lane_line", np.column_stack([-rising, rising]), 3, rising, 1, rising + 1, rising + 2)
    drive = Drive("east", Path(), {}, [Image("front", 0.0, Path("0.png"), np.eye(4))])
    (turned,) = _along_route(HDMap((), (lane,)), drive).lanes
    assert turned.points_map[:, 0].tolist() == [-2, -1, 0]
    assert turned.heights_m.tolist() == [2, 1, 0]
    assert turned.sigma_m.tolist() == [3, 2, 1]
    assert turned.heights_sigma_m.tolist() == [4, 3, 2]
