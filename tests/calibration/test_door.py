"""``v2hdm calibrate points`` and ``compare``: what they write and say, and every mistake in one line."""

import csv
import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from tests.calibration.site import CENTRE, INFO, MATRIX, PLACES, clicked, mounting, project, write_table
from tests.cameras import mounted
from tests.docs.blocks import blocks, document
from tests.drive.example import make_drive
from v2hdm.calibration.compare import FALSE_ALARM, movement
from v2hdm.calibration.from_points import calibrate_from_points
from v2hdm.calibration.points import check_points, read_points
from v2hdm.cli.main import run as run_command
from v2hdm.detection.camera import camera_from_calibration, rough_calibration
from v2hdm.errors import DriveError, MapFileError
from v2hdm.geometry.ipm import apply_homography, project_ground
from v2hdm.geometry.lens import undistort_points
from v2hdm.geometry.rigid import exp
from v2hdm.io.calibration.reading import read_calibration, read_provenance
from v2hdm.io.calibration.writing import write_calibration, write_camera_info
from v2hdm.io.drive import read_drive
from v2hdm.records import Calibration, CameraInfo
from v2hdm.verdict import Status


@pytest.fixture
def intrinsics(tmp_path):
    write_camera_info(INFO, tmp_path / "camera_info.yaml")
    return tmp_path / "camera_info.yaml"


def run(folder, table, *arguments):
    path = write_table(folder, *table)
    output = [] if "--output" in arguments else ["--output", str(folder / "out")]
    return run_command(["calibrate", "points", str(path), *map(str, arguments), *output])


def test_ten_points_end_in_a_calibration_a_drive_entry_a_table_and_a_picture(tmp_path, intrinsics, capsys):
    image = np.full((720, 1280, 3), 90, np.uint8)
    cv2.imwrite(str(tmp_path / "yard.png"), image)
    arguments = ("--intrinsics", intrinsics, "--image", tmp_path / "yard.png")
    assert run(tmp_path, clicked(seed=1), *arguments) == 0
    shown = capsys.readouterr().out
    angles = re.match(
        r"front: roll (\S+) \+- (\S+) deg, pitch (\S+) \+- (\S+) deg, yaw (\S+) \+- (\S+) deg", shown
    )
    values = np.array(angles.groups(), dtype=float).reshape(3, 2)
    assert (np.abs(values[:, 0] - (0.3, 16.0, 0.6)) < 4 * values[:, 1]).all()
    assert "10 of 10 points agree" in shown
    assert "verdict: PASS (nothing raised, 4 checks passed)" in shown

    out = tmp_path / "out"
    calibration = read_calibration(out / "calibration_front.yaml")
    assert calibration.covariance is not None
    assert read_provenance(out / "calibration_front.yaml").drive == "points"
    centre = -calibration.cam_from_vehicle[:3, :3].T @ calibration.cam_from_vehicle[:3, 3]
    np.testing.assert_allclose(centre, CENTRE, atol=0.05)
    assert json.loads((out / "verdict.json").read_text())["status"] == "PASS"
    with (out / "points.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["point"] for row in rows] == [f"point P{n} (line {n + 1})" for n in range(1, 11)]
    picture = cv2.imread(str(out / "points.png"))
    assert picture.shape[0] > 500
    assert (np.abs(picture.astype(int) - 90).max(axis=2) < 3).mean() > 0.2  # the image is in it


def test_the_ipm_takes_recorded_pixels_to_the_surveyed_places(tmp_path, intrinsics):
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


def test_a_drive_takes_the_entry_and_the_detector_the_calibration(tmp_path, intrinsics):
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


def test_intrinsics_of_a_chain_need_the_camera_s_name(tmp_path, capsys):
    entry = {
        "camera_model": "pinhole", "resolution": [1280, 720], "intrinsics": [900.0, 900.0, 645.5, 355.5],
        "distortion_model": "radtan", "distortion_coeffs": list(INFO.distortion[:4]),
    }  # fmt: skip
    chain = tmp_path / "chain.yaml"
    chain.write_text(
        yaml.safe_dump({"cam0": entry | {"intrinsics": [500.0, 500.0, 640.0, 360.0]}, "cam1": entry})
    )
    assert run(tmp_path, clicked(seed=1), "--intrinsics", chain) == 2
    assert "holds the cameras cam0, cam1; choose one with --camera-name" in capsys.readouterr().err
    assert (
        run(tmp_path, clicked(seed=1), "--intrinsics", chain, "--camera-name", "cam1", "--name", "front") == 0
    )
    assert (tmp_path / "out/calibration_front.yaml").is_file()


def test_a_wrong_point_is_a_warning_that_names_it(tmp_path, intrinsics, capsys):
    px, places = clicked(seed=1)
    places[6, 0] += 1.0
    assert run(tmp_path, (px, places), "--intrinsics", intrinsics) == 0
    shown = capsys.readouterr().out
    assert re.search(
        r"WARN point \(front\): point P7 \(line 8\) contradicts the others by \d\d sigmas "
        r"\(2\d\.\d px, (9\d\.\d cm|1\.0\d m) on the ground\) and gets no weight: check its pixel", shown
    )  # fmt: skip
    assert "verdict: WARN (1 finding, 3 checks passed)" in shown


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda px, places: px.__setitem__(9, (640.0, 20.0)), "P10 .*its pixel is above the horizon"),
        (lambda px, places: places.__setitem__(4, (-6.0, 1.0)), "P5 .*its place is behind the camera"),
    ],
)
def test_what_cannot_be_seen_on_the_ground_is_named(tmp_path, intrinsics, capsys, change, words):
    px, places = clicked(seed=1)
    change(px, places)
    assert run(tmp_path, (px, places), "--intrinsics", intrinsics) == 0
    assert re.search(words, capsys.readouterr().out)


def test_points_about_on_a_line_fail_and_the_files_say_so(tmp_path, intrinsics, capsys):
    places = np.column_stack([np.linspace(8, 16, 8), [0.3, 0.45, 0.3, 0.4, 0.3, 0.45, 0.35, 0.3]])
    px = project(mounting(), places) + np.random.default_rng(0).normal(0, 0.5, (8, 2))
    code = run(tmp_path, (px, places), "--intrinsics", intrinsics)
    printed = capsys.readouterr()
    assert code == 3, printed.err
    assert "points along one line do not determine a camera" in printed.out
    assert read_provenance(tmp_path / "out/calibration_front.yaml").verdict == "FAIL"


def test_intrinsics_of_another_lens_fail(tmp_path, intrinsics, capsys):
    px = project(mounting(), PLACES, MATRIX * [[1.12, 1, 1], [1, 1.12, 1], [1, 1, 1]])
    assert run(tmp_path, (px, PLACES), "--intrinsics", intrinsics) == 3
    assert re.search(r"imply a focal length \+1[0-4]\.\d \+- \S+ % longer", capsys.readouterr().out)


MISTAKES = {
    "left and right": (lambda px, places: (px, places * [1, -1]), "y counts to the right"),
    "x and y": (lambda px, places: (px, places[:, ::-1]), "x and y are exchanged"),
    "upward": (lambda px, places: (np.column_stack([px[:, 0], 719 - px[:, 1]]), places), "v counts"),
    "half the size": (lambda px, places: (px / 2, places), "an image 0.5 times as large"),
    "millimetres": (lambda px, places: (px, 1e3 * places), "x and y look like millimetres; .* that is 2.4"),
    "centimetres": (lambda px, places: (px, 1e2 * places), "x and y look like centimetres"),
    "a line": (lambda px, places: (px, places * [1, 0] + [0, 0.5]), "same place|on a line"),
    "three on a line": (
        lambda px, places: (px[[2, 5, 8, 9]], np.array([[8.0, 0.0], [10.0, 0.0], [12.0, 0.0], [12.0, 3.0]])),
        "all but one, lie about on a line",
    ),
    "three points": (lambda px, places: (px[:3], places[:3]), "3 points; 4 barely suffice"),
    "outside": (lambda px, places: (px + np.array([700, 0]), places), "lies outside the image"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line_that_names_the_cause(tmp_path, intrinsics, capsys, mistake):
    change, expected = MISTAKES[mistake]
    assert run(tmp_path, change(*clicked(seed=4)), "--intrinsics", intrinsics) == 2
    error = capsys.readouterr().err
    assert re.search(expected, error), error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_u_and_v_exchanged_are_told_within_the_image_too(tmp_path, capsys):
    square = type(INFO)("front", 1280, 1280, MATRIX, INFO.distortion_model, INFO.distortion)
    write_camera_info(square, tmp_path / "square.yaml")
    px, places = clicked(seed=4)
    assert run(tmp_path, (px[:, ::-1], places), "--intrinsics", tmp_path / "square.yaml") == 2
    assert "u and v are exchanged" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--pixel-sigma", "0", "--survey-sigma", "0"], "are both 0"),
        (["--name", "a/b"], "--name: the name 'a/b' has a path separator; choose another"),
        (["--image", "half.png"], "the image is 640 x 360, but the intrinsics of 'front' are for 1280 x 720"),
        (["--image", "none.png"], "none.png: image listed but missing"),
    ],
)
def test_options_that_cannot_be_are_one_line(tmp_path, intrinsics, capsys, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("half.png", np.zeros((360, 640, 3), np.uint8))
    assert run(tmp_path, clicked(seed=1), "--intrinsics", intrinsics, *arguments) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_the_documented_command_does_what_the_page_says(tmp_path, intrinsics, capsys, monkeypatch):
    text = document("docs/calibration.md")
    command, table = blocks("docs/calibration.md", "sh", "csv")[:2]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "points.csv").write_text(table.text)
    cv2.imwrite("yard.png", np.zeros((720, 1280, 3), np.uint8))
    assert run_command(shlex.split(command.text)[1:]) == 0
    shown = capsys.readouterr().out
    section = text.split("## From surveyed points")[1].split("## From bare ground")[0]
    quoted = [line.strip() for line in re.findall(r"^    ((?:front:|  ).*)$", section, re.MULTILINE)]
    assert quoted
    for line in quoted:
        assert line in shown, shown
    written = re.findall(r"^- `([^`]+)`:", section.split("It writes\n")[1], re.MULTILINE)
    assert written
    for name in written:
        assert (Path("outputs/front-calibrate") / name.replace("<camera>", "front")).exists(), name


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_columns_come_in_any_order_and_with_any_separator(tmp_path, separator):
    rows = [(x, u, f"P{n}", y, v) for n, (u, v, x, y) in enumerate(TABLE)]
    rows = [("x_m", "U", "name", "y_m", "v"), *rows]
    path = tmp_path / "points.csv"
    path.write_text("\ufeff" + "\n".join(separator.join(map(str, row)) for row in rows) + "\n\n# the end\n")
    points = read_points(path)
    np.testing.assert_array_equal(np.column_stack([points.points_px, points.points_vehicle]), TABLE)
    assert points.names[1] == "point P1 (line 3)"
    assert points.labels[:2] == ("P0", "P1")


TABLE = [(10.5, 20.0, 5.0, 1.0), (30.0, 20.5, 5.0, -1.0), (12.0, 12.0, 9.0, 1.5), (28.0, 12.25, 9.0, -1.5)]
TEXT = "u,v,x,y\n" + "".join(",".join(map(str, row)) + "\n" for row in TABLE)

WRONG_TABLES = {
    "empty": ("", "has no point; expected a line of column names"),
    "no header": (TEXT.split("\n", 1)[1], "no column 'u'; the first line must name u, v, x, y"),
    "millimetres by name": (TEXT.replace("x,y", "x_mm,y_mm"), "no column 'x'; .* it has: u, v, x_mm, y_mm"),
    "twice": (TEXT.replace("u,v", "u,u"), "more than one column 'u'"),
    "height": (re.sub(r"([05])\n", r"\1,0\n", TEXT.replace("x,y", "x,y,z")), "column 'z' is not"),
    "nan": (TEXT.replace("30.0", "nan"), "line 3: u: 'nan' is not a finite number; drop or fix"),
    "words": (TEXT.replace("30.0", "left"), "line 3: u: 'left' is not a number; fix that line"),
    "decimal comma": (
        TEXT.replace(",", ";").replace("10.5", "10,5"),
        "line 2: u: '10,5' is not a number; write a decimal point",
    ),
    "short line": (TEXT.replace("30.0,", ""), "line 3: 3 cells under 4 columns"),
}


@pytest.mark.parametrize("mistake", WRONG_TABLES)
def test_a_wrong_table_is_one_line_with_the_place(tmp_path, mistake):
    text, expected = WRONG_TABLES[mistake]
    (tmp_path / "points.csv").write_text(text)
    with pytest.raises(DriveError, match=expected) as caught:
        read_points(tmp_path / "points.csv")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda px, places: px.__setitem__(3, (1300.0, 400.0)), r"point P4 .* \(1300, 400\) lies outside"),
        (
            lambda px, places: px.__setitem__(3, (-1.0, 400.0)),
            "lies outside the image of 1280 x 720; fix",
        ),
        (lambda px, places: px.__setitem__(3, px[6]), "P4 .* and point P7 .* have the same pixel"),
        (lambda px, places: places.__setitem__(3, places[6]), "P4 .* have the same place on the ground"),
        (lambda px, places: px.__setitem__(slice(None), px[:, ::-1].copy()), "u and v look exchanged"),
    ],
)
def test_points_outside_the_image_and_repeated_ones_are_named(tmp_path, change, expected):
    px, places = clicked(seed=3)
    change(px, places)
    points = read_points(write_table(tmp_path, px, places))
    with pytest.raises(DriveError, match=expected) as caught:
        check_points(points, INFO)
    assert "\n" not in str(caught.value)


def test_a_calibration_from_points_is_data_and_writes_nothing(tmp_path):
    fitted = calibrate_from_points(write_table(tmp_path, *clicked(seed=3)), INFO)
    assert fitted.verdict.status is Status.PASS
    assert fitted.calibration.covariance is not None
    assert len(fitted.roi_vehicle) >= 3
    assert [path.name for path in tmp_path.iterdir()] == ["points.csv"]


AHEAD = CameraInfo("front", 1280, 720, np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]]))
SIGMA = np.array([0.006, 0.002, 0.007, 0.0003, 0.0006, 0.0003])


def looking_ahead(info=AHEAD):
    """2.5 m above the ground, 1.8 m ahead of the axle, 12 degrees down."""
    return Calibration(info, mounted([1.8, 0.1, 2.5], pitch_deg=12), np.diag(SIGMA**2))


def measured(true, rng):
    """The same with an error of its covariance."""
    return replace(true, cam_from_vehicle=exp(SIGMA * rng.standard_normal(6)) @ true.cam_from_vehicle)


def turned(true, pitch_deg, yaw_deg, up_m=0.0):
    """The camera pitched down, turned left about its own centre, and raised."""
    p, y = np.deg2rad([pitch_deg, yaw_deg])
    down = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    left = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
    rotation = true.cam_from_vehicle[:3, :3]
    centre = -rotation.T @ true.cam_from_vehicle[:3, 3] + [0, 0, up_m]
    out = np.eye(4)
    out[:3, :3] = rotation @ (left @ down).T
    out[:3, 3] = -out[:3, :3] @ centre
    return replace(true, cam_from_vehicle=out)


def test_a_camera_that_stays_is_said_to_have_moved_as_seldom_as_stated():
    rng = np.random.default_rng(0)
    true = looking_ahead()
    probabilities = [movement(measured(true, rng), measured(true, rng)).probability for _ in range(2000)]
    assert np.mean(np.array(probabilities) < 0.05) == pytest.approx(0.05, abs=0.015)
    assert np.mean(np.array(probabilities) < FALSE_ALARM) < 0.004


def test_a_movement_is_told_along_and_about_the_vehicles_axes():
    true = looking_ahead()
    moved = movement(true, turned(true, 0.4, -0.3, 0.02))
    assert moved.moved
    assert np.degrees(moved.turn_rad) == pytest.approx([0, 0.4, -0.3], abs=0.005)
    assert moved.shift_m == pytest.approx([0, 0, 0.02], abs=1e-9)


def test_the_stated_errors_of_a_movement_hold():
    rng = np.random.default_rng(1)
    true, after = looking_ahead(), turned(looking_ahead(), 2.0, 1.0)
    off = []
    for _ in range(400):
        moved = movement(measured(true, rng), measured(after, rng))
        error = np.concatenate([moved.shift_m, moved.turn_rad - movement(true, after).turn_rad])
        off.append(error @ np.linalg.solve(moved.covariance, error))
    assert np.mean(off) == pytest.approx(6.0, abs=0.6)


def test_a_detectable_turn_is_hardly_ever_missed():
    rng = np.random.default_rng(2)
    true = looking_ahead()
    pitch_deg = float(np.degrees(movement(true, true).detectable[4]))
    moved = [
        movement(measured(true, rng), measured(turned(true, pitch_deg, 0), rng)).moved for _ in range(300)
    ]
    assert np.mean(moved) == pytest.approx(0.95, abs=0.04)


def test_calibrations_of_other_lenses_are_not_compared():
    other = replace(AHEAD, intrinsic=AHEAD.intrinsic * [[1.01], [1.01], [1.0]])
    with pytest.raises(MapFileError, match="intrinsics differ"):
        movement(looking_ahead(), looking_ahead(other))
    with pytest.raises(MapFileError, match="no covariance"):
        movement(looking_ahead(), replace(looking_ahead(), covariance=None))


def test_the_door_tells_which_camera_has_moved(tmp_path, capsys):
    rear = replace(AHEAD, name="rear")
    for folder, pitch_deg in (("before", 0.0), ("after", 0.5)):
        (tmp_path / folder).mkdir()
        write_calibration(looking_ahead(), tmp_path / folder / "calibration_front.yaml")
        moved = turned(looking_ahead(rear), pitch_deg, 0)
        write_calibration(moved, tmp_path / folder / "calibration_rear.yaml")
    before, after = (str(tmp_path / name) for name in ("before", "after"))
    assert run_command(["calibrate", "compare", before, before]) == 0
    assert "MOVED" not in capsys.readouterr().out
    assert run_command(["calibrate", "compare", before, after]) == 3
    front, rear_line = capsys.readouterr().out.splitlines()
    assert front.startswith("front: not moved")
    assert rear_line.startswith("rear: MOVED")
    assert "pitch +0.50 +- " in rear_line


def test_cameras_that_turn_alike_blame_the_heading(tmp_path, capsys):
    for folder, yaw_deg in (("before", 0.0), ("after", 2.0)):
        (tmp_path / folder).mkdir()
        for name in ("front", "rear"):
            calibration = turned(looking_ahead(replace(AHEAD, name=name)), 0, yaw_deg)
            write_calibration(calibration, tmp_path / folder / f"calibration_{name}.yaml")
    assert run_command(["calibrate", "compare", str(tmp_path / "before"), str(tmp_path / "after")]) == 3
    assert "all cameras have turned alike" in capsys.readouterr().out


def test_a_failed_drive_is_not_compared(tmp_path, capsys):
    path = tmp_path / "calibration_front.yaml"
    write_calibration(looking_ahead(), path, verdict={"status": "FAIL"})
    assert run_command(["calibrate", "compare", str(path), str(path)]) == 2
    assert "verdict on its drive is FAIL" in capsys.readouterr().err


def test_a_camera_without_enough_ground_fails_as_its_line_says(tmp_path, capsys):
    """One image matches no other."""
    drive = make_drive(tmp_path / "drive")
    listed = drive.root / "front" / "images.txt"
    rows = [row for row in listed.read_text().splitlines(keepends=True) if not row.startswith("#")]
    listed.write_text(rows[0])
    arguments = [
        "calibrate",
        "ground",
        str(drive.root),
        "--camera",
        "front",
        "--output",
        str(tmp_path / "out"),
    ]
    assert run_command(arguments) == 3
    shown = capsys.readouterr().out
    assert "front: too little ground appears in two images: drive farther" in shown
    assert "verdict: FAIL" in shown
    assert "FAIL ground match (front): no mounting: too little ground" in shown.replace("  ", " ")
    verdict = json.loads((tmp_path / "out" / "verdict.json").read_text())
    assert verdict["status"] == "FAIL"
    assert not list((tmp_path / "out").glob("calibration_*"))


GRID_MISREADINGS = {
    "x and y are exchanged": lambda u, v, x, y: (u, v, y, x),
    "y counts to the right, or x backward": lambda u, v, x, y: (u, v, x, -y),
}


@pytest.mark.parametrize("cause", GRID_MISREADINGS)
@pytest.mark.parametrize("step_m", [1.0, 2.0])
def test_exchanged_axes_of_a_regular_grid_are_named(cause, step_m, tmp_path):
    # A camera below the ground, which none is, would see them just so.
    rough = rough_calibration("front", 1280, 720, 1.6, 12.0, 70.0)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(5.0, 12.0, step_m), np.arange(-3.0, 3.5, step_m)))
    px, _ = project_ground(rough.info.intrinsic, rough.cam_from_vehicle[None], np.column_stack([x, y]))
    inside = ((px[0] > 0) & (px[0] < [1279, 719])).all(axis=1)
    points = np.column_stack([px[0] + np.random.default_rng(1).normal(0, 0.3, px[0].shape), x, y])[inside]
    rows = [GRID_MISREADINGS[cause](*point) for point in points]
    (tmp_path / "points.csv").write_text("\n".join(["u,v,x,y", *(",".join(map(str, row)) for row in rows)]))
    with pytest.raises(DriveError, match=f"the points fit no mounting of this camera: {cause}"):
        calibrate_from_points(tmp_path / "points.csv", rough.info)
