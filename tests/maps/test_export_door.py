"""``v2hdm export``: calibrations in the forms of other tools, and what a user may get wrong."""

import json
import xml.etree.ElementTree as ET
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from examples.lanes.site import made_site
from tests.docs.blocks import blocks
from tests.drive.example import camera_info, looking_forward
from tests.maps.gis import street
from v2hdm.cli.main import run
from v2hdm.errors import MapFileError
from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.geometry.rigid import exp
from v2hdm.io.calibration.reading import Provenance, read_calibration, read_provenance
from v2hdm.io.calibration.writing import CALIBRATION_FORMATS, write_calibration, write_calibration_as
from v2hdm.io.maps.formats import FORMATS
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.io.maps.geopackage import write_geopackage
from v2hdm.io.maps.reading import read_geojson, read_map, read_verdict
from v2hdm.io.trajectory import write_tum
from v2hdm.records import Calibration, CameraFrames

VERDICT = {"status": "PASS"}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    write_geojson(street(), tmp_path / "map.geojson", VERDICT)
    write_geopackage(street(), tmp_path / "map.gpkg", VERDICT)
    write_calibration(Calibration(camera_info(), looking_forward()), tmp_path / "calibration_front.yaml")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_format_of_a_map_is_documented():
    exports = " ".join(block.text for block in blocks("docs/exports.md", "sh"))
    assert all(f"--format {name}" in exports for name in FORMATS)
    assert f"export=[{','.join(FORMATS)}]" in exports


def test_the_verdict_goes_along(folder):
    assert run(["export", "map.geojson", "--format", "gpkg", "--output", "there"]) == 0
    assert read_verdict(folder / "there" / "map.gpkg") == VERDICT


def test_an_edited_geopackage_becomes_the_geojson_again(folder):
    before = read_geojson(folder / "map.geojson")
    assert run(["export", "map.gpkg", "--format", "geojson", "--output", "edited"]) == 0
    after = read_geojson(folder / "edited" / "map.geojson")
    for old, new in zip(before.markings, after.markings, strict=True):
        np.testing.assert_array_equal(new.corners_map, old.corners_map)
        assert new.id == old.id


EXPORT = ("export", "map.geojson", "--format", "csv", "--format", "lanelet2")


def _refused(folder, name, capsys, words):
    before = (folder / name).read_bytes()
    assert run(words) == 2
    assert "move it, or give another --output" in capsys.readouterr().err
    assert (folder / name).read_bytes() == before


def test_an_export_replaces_what_it_has_written_of_the_same_map_and_nothing_else(folder, capsys):
    """Edited files, links and the user's own files have cases for each format in tests/faults."""
    for _ in range(2):
        assert run(EXPORT) == 0
    write_geojson(street(), folder / "other" / "map.geojson")  # of the same name, from elsewhere
    _refused(folder, "map.csv", capsys, ("export", "other/map.geojson", "--format", "csv", "--output", "."))


@pytest.mark.parametrize("source", ["map.geojson", "map.gpkg"])
def test_a_project_opens_the_geopackage_that_is_there_and_replaces_no_other(folder, source, capsys):
    data = (folder / "map.gpkg").read_bytes()
    assert run(["export", source, "--format", "qgis"]) == 0
    assert capsys.readouterr().out.split() == ["map.qgs"]
    assert (folder / "map.gpkg").read_bytes() == data
    if source == "map.geojson":
        write_geopackage(replace(street(), symbols=(), lanes=()), folder / "map.gpkg")
        _refused(folder, "map.gpkg", capsys, ("export", source, "--format", "qgis"))


def test_a_geopackage_of_an_earlier_export_is_made_anew_for_a_project(folder):
    for hd_map in (replace(street(), lanes=()), street()):
        write_geojson(hd_map, folder / "map.geojson")
        assert run(["export", "map.geojson", "--format", "qgis", "--output", "there"]) == 0
        assert len(read_map(folder / "there" / "map.gpkg")[0].lanes) == len(hd_map.lanes)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["map.geojson", "--format", "shp"], "--format: unknown format 'shp'; choose from: geojson, csv"),
        (["map.geojson", "--format", "opencrg"], "--format opencrg: a map file does not hold the ground"),
        (["calibration_front.yaml", "--format", "gpkg"], "unknown format 'gpkg' for a calibration"),
        (["map.csv", "--format", "gpkg"], "map.csv: not a readable map"),
        (["none.gpkg", "--format", "csv"], "none.gpkg: no such file"),
        (["none.yaml", "--format", "urdf"], "none.yaml: no such file"),
        (["map.geojson", "--format", "lanelet2", "--projector", "UTM"], "unknown projector 'UTM'"),
        (["map.geojson", "--format", "csv", "--output", "map.gpkg"], "map.gpkg is a file; give another"),
    ],
)
def test_what_a_user_must_mend_is_one_line(folder, arguments, message, capsys):
    assert run(["export", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1


SIGMAS = [0.01, 0.02, 0.03, *np.radians([0.1, 0.2, 0.3])]
MOVED = exp(np.array([0.1, -0.2, 0.3, 0.05, 0.3, -0.1]))
FRAMES = CameraFrames("base_link", "front_optical_frame")
CALIBRATION = Calibration(camera_info("front"), MOVED @ looking_forward(), np.diag(np.square(SIGMAS)), FRAMES)
ABOUT = Provenance("yard: 7", "2026-05-04", "WARN")
FORMS = list(CALIBRATION_FORMATS)


def written(folder, form, calibration=CALIBRATION):
    return write_calibration_as(form, calibration, ABOUT, folder, "front")


@pytest.mark.parametrize("form", FORMS)
def test_every_form_tells_sigmas_drive_date_and_verdict(tmp_path, form):
    lines = written(tmp_path, form).read_text(encoding="utf-8").splitlines()
    header = yaml.safe_load("\n".join(line[2:] for line in lines if line.startswith("# ")))
    assert header["camera_name"] == "front"
    assert (header["drive"], str(header["date"]), header["verdict"]) == ("yard: 7", "2026-05-04", "WARN")
    np.testing.assert_allclose(header["translation_sigma_m"], SIGMAS[:3])
    np.testing.assert_allclose(header["rotation_sigma_deg"], np.degrees(SIGMAS[3:]))


def test_camera_info_has_the_matrices_of_ros(tmp_path):
    content = yaml.safe_load(written(tmp_path, "camera_info").read_text(encoding="utf-8"))
    for name, columns in (("camera", 3), ("projection", 4), ("rectification", 3)):
        matrix = content[f"{name}_matrix"]
        assert (matrix["rows"], matrix["cols"], len(matrix["data"])) == (3, columns, 3 * columns)


def test_a_static_transform_is_where_the_camera_sits_on_the_vehicle(tmp_path):
    (transform,) = yaml.safe_load(written(tmp_path, "static_transform").read_text())["transforms"]
    assert (transform["header"]["frame_id"], transform["child_frame_id"]) == (
        "base_link",
        "front_optical_frame",
    )
    rotation = Rotation.from_quat([transform["transform"]["rotation"][axis] for axis in "xyzw"]).as_matrix()
    translation = [transform["transform"]["translation"][axis] for axis in "xyz"]
    assert_inverse(rotation, translation, CALIBRATION.cam_from_vehicle)


def assert_inverse(rotation, translation, cam_from_vehicle):
    vehicle_from_cam = np.linalg.inv(cam_from_vehicle)
    np.testing.assert_allclose(rotation, vehicle_from_cam[:3, :3], atol=1e-12)
    np.testing.assert_allclose(np.array(translation), vehicle_from_cam[:3, 3], atol=1e-12)


@pytest.mark.parametrize(
    "cam_from_vehicle",
    [
        CALIBRATION.cam_from_vehicle,
        looking_forward(),
        np.diag([1.0, -1.0, -1.0, 1.0]),  # straight down
        looking_forward(2.0, 0.0) @ exp(np.array([0.0, 0.0, 0.0, np.pi / 2, 0.0, 0.0])),  # on its side
    ],
    ids=["askew", "forward", "down", "on its side"],
)
def test_a_urdf_s_origin_is_where_the_camera_sits_on_the_vehicle(tmp_path, cam_from_vehicle):
    path = written(tmp_path, "urdf", replace(CALIBRATION, cam_from_vehicle=cam_from_vehicle))
    root = ET.parse(path).getroot()
    (joint,) = root.findall("joint[@type='fixed']")
    ends = [joint.find(side).get("link") for side in ("parent", "child")]  # type: ignore[union-attr]
    assert ends == [link.get("name") for link in root.findall("link")] == ["base_link", "front_optical_frame"]
    origin = joint.find("origin")
    xyz, rpy = ([float(value) for value in origin.get(key, "").split()] for key in ("xyz", "rpy"))
    assert_inverse(Rotation.from_euler("xyz", rpy).as_matrix(), xyz, cam_from_vehicle)


def test_kalibr_has_the_mounting_beside_the_lens(tmp_path):
    """That its pixels are the same is told by reading them back, in tests/drive."""
    camera = yaml.safe_load(written(tmp_path, "kalibr").read_text())["cam0"]
    np.testing.assert_array_equal(camera["T_cam_vehicle"], CALIBRATION.cam_from_vehicle)
    assert (camera["camera_model"], camera["distortion_model"]) == ("pinhole", "radtan")


@pytest.mark.parametrize(
    ("model", "lens", "named"),
    [
        ("plumb_bob", (-0.1, 0.02, 0.001, -0.001, 0.01), None),
        ("rational_polynomial", (0.1, 0.02, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0), None),
        ("equidistant", (0.01, 0.002, 0.0, 0.0), "equidistant"),
    ],
)
def test_a_lens_that_kalibr_lacks_is_refused_in_one_line(tmp_path, model, lens, named):
    info = replace(CALIBRATION.info, distortion_model=model, distortion=lens)
    if named is not None:
        text = written(tmp_path, "kalibr", replace(CALIBRATION, info=info)).read_text()
        assert yaml.safe_load(text)["cam0"]["distortion_model"] == named
        return
    with pytest.raises(MapFileError, match="camera 'front': Kalibr supports neither") as caught:
        written(tmp_path, "kalibr", replace(CALIBRATION, info=info))
    assert "\n" not in str(caught.value)


def test_opencv_reads_the_ipm_and_all_else(tmp_path):
    storage = cv2.FileStorage(str(written(tmp_path, "opencv")), cv2.FileStorage_READ)
    assert storage.isOpened()
    assert storage.getNode("camera_name").string() == "front"
    assert storage.getNode("image_width").real() == 64
    info = CALIBRATION.info
    for key, expected in (
        ("camera_matrix", info.intrinsic),
        ("distortion_coefficients", [info.distortion]),
        ("cam_from_vehicle", CALIBRATION.cam_from_vehicle),
        ("vehicle_from_pinhole_px", ipm_from_extrinsic(info, CALIBRATION.cam_from_vehicle)),
        ("covariance", CALIBRATION.covariance),
    ):
        np.testing.assert_array_equal(storage.getNode(key).mat(), expected)
    storage.release()


def test_a_calibration_keeps_its_drive_and_date_in_its_file(tmp_path):
    path = tmp_path / "calibration_front.yaml"
    about = Provenance.today("yard", {"status": "PASS"})
    write_calibration(CALIBRATION, path, verdict={"status": "PASS"}, about=about)
    assert read_provenance(path) == about
    np.testing.assert_array_equal(read_calibration(path).cam_from_vehicle, CALIBRATION.cam_from_vehicle)
    write_calibration(CALIBRATION, path)
    assert read_provenance(path) == Provenance()


def test_paths_beside_the_map_or_named_say_where_lanes_lead(tmp_path, monkeypatch, capsys):
    site = made_site()
    write_geojson(site.hd_map, tmp_path / "map.geojson", VERDICT)
    for number, trajectory in enumerate(site.trajectories):
        write_tum(trajectory, tmp_path / f"trajectory_{number}.tum")
    monkeypatch.chdir(tmp_path)
    assert run(["export", "map.geojson", "--format", "opendrive", "--output", "all"]) == 0
    assert "questions" in capsys.readouterr().out
    named = ["--path", "trajectory_0.tum", "--output", "one"]
    assert run(["export", "map.geojson", "--format", "opendrive", *named]) == 0
    counts = [
        len(ET.parse(tmp_path / folder / "map.xodr").getroot().findall("junction/connection"))
        for folder in ("all", "one")
    ]
    assert counts[0] == 18
    assert counts[1] < 8


def test_a_path_far_from_the_map_is_one_line(tmp_path, monkeypatch, capsys):
    site = made_site(drives=(0,))
    write_geojson(site.hd_map, tmp_path / "map.geojson", VERDICT)
    (trajectory,) = site.trajectories
    far = trajectory.map_from_vehicle.copy()
    far[:, 0, 3] += 5000.0
    write_tum(replace(trajectory, map_from_vehicle=far), tmp_path / "far.tum")
    monkeypatch.chdir(tmp_path)
    assert run(["export", "map.geojson", "--format", "lanelet2", "--path", "far.tum"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "far.tum: no pose is near a lane of the map" in line
    assert run(["export", "map.geojson", "--format", "csv", "--path", "far.tum"]) == 2
    assert "--path" in capsys.readouterr().err


def answered(folder, source, answer):
    """The file of questions with an answer to each of those about ways."""
    content = yaml.safe_load((folder / source).read_text())
    for feature in content["features"]:
        if feature["properties"]["subject"] == "connection":
            feature["properties"]["answer"] = answer
    (folder / "answers.geojson").write_text(json.dumps(content))


def test_questions_that_were_answered_in_their_file_are_followed(tmp_path, monkeypatch, capsys):
    site = made_site()
    write_geojson(site.hd_map, tmp_path / "map.geojson", VERDICT)
    for number, trajectory in enumerate(site.trajectories):
        write_tum(trajectory, tmp_path / f"trajectory_{number}.tum")
    monkeypatch.chdir(tmp_path)
    assert run(["export", "map.geojson", "--format", "opendrive"]) == 0
    answered(tmp_path, "map_questions.geojson", "yes")
    again = ["export", "map.geojson", "--format", "opendrive"]
    assert run([*again, "--answers", "map_questions.geojson"]) == 2  # the answers would be lost
    assert "map_questions.geojson would be overwritten" in capsys.readouterr().err
    assert run([*again, "--answers", "answers.geojson", "--output", "answered"]) == 0
    root = ET.parse(tmp_path / "answered" / "map.xodr").getroot()
    assert len(root.findall("junction/connection")) == 18 + 8
    answered(tmp_path, "map_questions.geojson", "yes")
    text = (tmp_path / "answers.geojson").read_text().replace('"connection"', '"colour"')
    (tmp_path / "answers.geojson").write_text(text)
    assert run([*again, "--answers", "answers.geojson", "--output", "there"]) == 2
    assert "'colour' is not a subject of a question" in capsys.readouterr().err
