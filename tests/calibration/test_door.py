"""``v2hdm calibrate points``: other commands take what it writes, and every mistake is one line."""

from __future__ import annotations

import csv
import json
import re
import shlex
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from tests.calibration.site import CENTRE, INFO, MATRIX, PLACES, clicked, mounting, project, write_table
from tests.docs.blocks import blocks, document
from tests.drive.example import make_drive
from v2hdm.cli.main import run as run_command
from v2hdm.detection.camera import camera_from_calibration
from v2hdm.geometry.ipm import apply_homography
from v2hdm.geometry.lens import undistort_points
from v2hdm.io.calibration import read_calibration, read_provenance, write_camera_info
from v2hdm.io.drive import read_drive
from v2hdm.records import FloatArray


@pytest.fixture
def intrinsics(tmp_path: Path) -> Path:
    write_camera_info(INFO, tmp_path / "camera_info.yaml")
    return tmp_path / "camera_info.yaml"


def run(folder: Path, table: tuple[FloatArray, FloatArray], *arguments: object) -> int:
    path = write_table(folder, *table)
    output = [] if "--output" in arguments else ["--output", str(folder / "out")]
    return run_command(["calibrate", "points", str(path), *map(str, arguments), *output])


def test_ten_points_end_in_a_calibration_a_drive_entry_a_table_and_a_picture(
    tmp_path: Path, intrinsics: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = np.full((720, 1280, 3), 90, np.uint8)
    cv2.imwrite(str(tmp_path / "yard.png"), image)
    given = ("--intrinsics", intrinsics, "--image", tmp_path / "yard.png")
    assert run(tmp_path, clicked(seed=1), *given) == 0
    shown = capsys.readouterr().out
    angles = re.match(
        r"front: roll (\S+) \+- (\S+) deg, pitch (\S+) \+- (\S+) deg, yaw (\S+) \+- (\S+) deg", shown
    )
    assert angles is not None
    values = np.array(angles.groups(), dtype=float).reshape(3, 2)
    assert (np.abs(values[:, 0] - (0.3, 16.0, 0.6)) < 4 * values[:, 1]).all()
    assert "10 of 10 points agree" in shown
    assert "verdict: PASS (nothing raised, 4 checks passed)" in shown

    out = tmp_path / "out"
    found = read_calibration(out / "calibration_front.yaml")
    assert found.covariance is not None
    assert read_provenance(out / "calibration_front.yaml").drive == "points"
    centre = -found.cam_from_vehicle[:3, :3].T @ found.cam_from_vehicle[:3, 3]
    np.testing.assert_allclose(centre, CENTRE, atol=0.05)
    assert json.loads((out / "verdict.json").read_text())["status"] == "PASS"
    with (out / "points.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["point"] for row in rows] == [f"point P{n} (line {n + 1})" for n in range(1, 11)]
    picture = cv2.imread(str(out / "points.png"))
    assert picture.shape[0] > 500
    assert (np.abs(picture.astype(int) - 90).max(axis=2) < 3).mean() > 0.2  # the image is in it


def test_the_ipm_takes_recorded_pixels_to_the_surveyed_places(tmp_path: Path, intrinsics: Path) -> None:
    assert run(tmp_path, clicked(seed=1), "--intrinsics", intrinsics) == 0
    entry = yaml.safe_load((tmp_path / "out/drive_camera.yaml").read_text())["cameras"]["front"]
    pinhole_px = undistort_points(INFO, project(mounting(), PLACES))
    np.testing.assert_allclose(
        apply_homography(np.array(entry["ipm"]["calibrated"]), pinhole_px), PLACES, atol=0.06
    )
    # The outermost points, not the three that lie among them; P10 is one of them or not, by its error.
    assert len(entry["roi_vehicle"]) in (6, 7)
    for inside in PLACES[[2, 5, 6]]:
        assert np.linalg.norm(np.array(entry["roi_vehicle"]) - inside, axis=1).min() > 0.5
    assert entry["centre_prior"]["sigma_m"][2] < 0.02


def test_a_drive_takes_the_entry_and_the_detector_the_calibration(tmp_path: Path, intrinsics: Path) -> None:
    assert run(tmp_path, clicked(seed=1), "--intrinsics", intrinsics) == 0
    drive = tmp_path / "drive"
    drive.mkdir()
    make_drive(drive)
    content = yaml.safe_load((drive / "drive.yaml").read_text())
    content["cameras"] = yaml.safe_load((tmp_path / "out/drive_camera.yaml").read_text())["cameras"]
    (drive / "drive.yaml").write_text(yaml.safe_dump(content))
    shutil.copy(tmp_path / "out/front/camera_info.yaml", drive / "front/camera_info.yaml")
    for path in (drive / "front/images").iterdir():
        cv2.imwrite(str(path), np.zeros((720, 1280, 3), np.uint8))
    camera = read_drive(drive).cameras["front"]
    assert camera.initial_ipm == "calibrated"
    assert camera.centre_prior is not None
    detector = camera_from_calibration(read_calibration(tmp_path / "out/calibration_front.yaml"))
    np.testing.assert_allclose(detector.ipm["calibrated"], camera.ipm["calibrated"], atol=1e-12)


def test_two_calibrations_of_one_camera_say_that_it_has_not_moved(
    tmp_path: Path, intrinsics: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tilted = mounting((0.3, 17.0, 0.6))
    for name, seed, truth in (("monday", 1, None), ("friday", 2, None), ("knocked", 3, tilted)):
        table = clicked(seed, cam_from_vehicle=truth)
        assert run(tmp_path, table, "--intrinsics", intrinsics, "--output", tmp_path / name) == 0
    assert run_command(["calibrate", "compare", str(tmp_path / "monday"), str(tmp_path / "friday")]) == 0
    assert run_command(["calibrate", "compare", str(tmp_path / "monday"), str(tmp_path / "knocked")]) == 3
    assert re.search(r"front: MOVED .* pitch \+(0\.9|1\.0)", capsys.readouterr().out)


def test_intrinsics_of_a_chain_need_the_camera_s_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entry = {
        "camera_model": "pinhole",
        "distortion_coeffs": list(INFO.distortion[:4]),
        "distortion_model": "radtan",
        "intrinsics": [900.0, 900.0, 645.5, 355.5],
        "resolution": [1280, 720],
    }
    chain = tmp_path / "chain.yaml"
    chain.write_text(
        yaml.safe_dump({"cam0": entry | {"intrinsics": [500.0, 500.0, 640.0, 360.0]}, "cam1": entry})
    )
    assert run(tmp_path, clicked(seed=1), "--intrinsics", chain) == 2
    assert "holds the cameras cam0, cam1; name one by --camera-name" in capsys.readouterr().err
    assert (
        run(tmp_path, clicked(seed=1), "--intrinsics", chain, "--camera-name", "cam1", "--name", "front") == 0
    )
    assert (tmp_path / "out/calibration_front.yaml").is_file()


def test_a_wrong_point_is_a_warning_that_names_it(
    tmp_path: Path, intrinsics: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    px, places = clicked(seed=1)
    places[6, 0] += 1.0
    assert run(tmp_path, (px, places), "--intrinsics", intrinsics) == 0
    shown = capsys.readouterr().out
    assert re.search(
        r"WARN point \(front\): point P7 \(line 8\) contradicts the others by \d\d sigmas "
        r"\(2\d\.\d px, (9\d\.\d cm|1\.0\d m) on the ground\) and counts for nothing: check its pixel", shown
    )  # fmt: skip
    assert "verdict: WARN (1 finding, 3 checks passed)" in shown


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda px, places: px.__setitem__(9, (640.0, 20.0)), "P10 .*its pixel is above the horizon"),
        (lambda px, places: places.__setitem__(4, (-6.0, 1.0)), "P5 .*its place is behind the camera"),
    ],
)
def test_what_cannot_be_seen_on_the_ground_is_named(tmp_path, intrinsics, capsys, change, words) -> None:
    px, places = clicked(seed=1)
    change(px, places)
    assert run(tmp_path, (px, places), "--intrinsics", intrinsics) == 0
    assert re.search(words, capsys.readouterr().out)


def test_points_about_on_a_line_fail_and_the_files_say_so(
    tmp_path: Path, intrinsics: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    places = np.column_stack([np.linspace(8, 16, 8), [0.3, 0.45, 0.3, 0.4, 0.3, 0.45, 0.35, 0.3]])
    px = project(mounting(), places) + np.random.default_rng(0).normal(0, 0.5, (8, 2))
    code = run(tmp_path, (px, places), "--intrinsics", intrinsics)
    printed = capsys.readouterr()
    assert code == 3, printed.err
    assert "points along one line fix no camera" in printed.out
    assert read_provenance(tmp_path / "out/calibration_front.yaml").verdict == "FAIL"


def test_intrinsics_of_another_lens_fail(
    tmp_path: Path, intrinsics: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    px = project(mounting(), PLACES, MATRIX * [[1.12, 1, 1], [1, 1.12, 1], [1, 1, 1]])
    assert run(tmp_path, (px, PLACES), "--intrinsics", intrinsics) == 3
    assert re.search(r"want the focal length \+1[0-4]\.\d \+- \S+ % longer", capsys.readouterr().out)


MISTAKES = {
    "left and right": (lambda px, places: (px, places * [1, -1]), "y is counted to the right"),
    "x and y": (lambda px, places: (px, places[:, ::-1]), "x and y are exchanged"),
    "upward": (lambda px, places: (np.column_stack([px[:, 0], 719 - px[:, 1]]), places), "v is counted"),
    "half the size": (lambda px, places: (px / 2, places), "an image 0.5 times as large"),
    "millimetres": (lambda px, places: (px, 1e3 * places), "x and y look like millimetres; .* that is 2.4"),
    "centimetres": (lambda px, places: (px, 1e2 * places), "x and y look like centimetres"),
    "a line": (lambda px, places: (px, places * [1, 0] + [0, 0.5]), "same place|on a line"),
    "three on a line": (
        lambda px, places: (px[[2, 5, 8, 9]], np.array([[8.0, 0.0], [10.0, 0.0], [12.0, 0.0], [12.0, 3.0]])),
        "on a line, or all but one do",
    ),
    "three points": (lambda px, places: (px[:3], places[:3]), "3 points; 4 barely fix"),
    "outside": (lambda px, places: (px + np.array([700, 0]), places), "lies outside the image"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line_that_names_the_cause(tmp_path, intrinsics, capsys, mistake) -> None:
    change, expected = MISTAKES[mistake]
    assert run(tmp_path, change(*clicked(seed=4)), "--intrinsics", intrinsics) == 2
    error = capsys.readouterr().err
    assert re.search(expected, error), error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_u_and_v_exchanged_are_told_within_the_image_too(tmp_path, capsys) -> None:
    square = type(INFO)("front", 1280, 1280, MATRIX, INFO.distortion_model, INFO.distortion)
    write_camera_info(square, tmp_path / "square.yaml")
    px, places = clicked(seed=4)
    assert run(tmp_path, (px[:, ::-1], places), "--intrinsics", tmp_path / "square.yaml") == 2
    assert "u and v are exchanged" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--pixel-sigma", "-1"], "--pixel-sigma -1: give a standard deviation"),
        (["--pixel-sigma", "0", "--survey-sigma", "0"], "are both 0"),
        (["--name", "a/b"], "no file name; give another --name"),
        (["--image", "half.png"], "the image is 640 x 360, but the intrinsics of 'front' are for 1280 x 720"),
        (["--image", "none.png"], "none.png: image listed but missing"),
    ],
)
def test_options_that_cannot_be_are_one_line(
    tmp_path, intrinsics, capsys, monkeypatch, arguments, words
) -> None:
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("half.png", np.zeros((360, 640, 3), np.uint8))
    assert run(tmp_path, clicked(seed=1), "--intrinsics", intrinsics, *arguments) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_the_documented_command_does_what_the_page_says(tmp_path, intrinsics, capsys, monkeypatch) -> None:
    text = document("docs/calibrate.md")
    command, table = blocks("docs/calibrate.md", "sh", "csv")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "points.csv").write_text(table.text)
    cv2.imwrite("yard.png", np.zeros((720, 1280, 3), np.uint8))
    assert run_command(shlex.split(command.text)[1:]) == 0
    shown = capsys.readouterr().out
    quoted = [line.strip() for line in re.findall(r"^    ((?:front:|  ).*)$", text, re.MULTILINE)]
    assert quoted
    for line in quoted:
        assert line in shown, shown
    for name in re.findall(r"^\| `([^`]+)` \|", text, re.MULTILINE):
        place = Path("outputs/front-calibrate") / name.replace("<camera>", "front")
        assert place.exists() or name not in text.split("## What it writes")[1].split("##")[0], name
