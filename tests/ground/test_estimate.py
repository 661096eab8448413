"""The ground of a small drive shows its mounting and what is wrong with its poses, clock and lens."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.ground.scene import CENTRE, INFO, extrinsic, make_drive, with_guess, with_trajectory
from v2hdm.cli.main import run
from v2hdm.geometry.ipm import mounting_angles
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.ground import estimate
from v2hdm.ground.adjust import _beside_m, _by_stretch
from v2hdm.ground.estimate import estimate_ground
from v2hdm.ground.model import guessed_mount
from v2hdm.ground.motion import motion_of
from v2hdm.ground.patches import Matcher, read_grey
from v2hdm.ground.prior import Stated
from v2hdm.ground.results import GroundOptions, GroundStatus, Reading, better_start
from v2hdm.ground.start import contradicts
from v2hdm.io.calibration.reading import read_calibration
from v2hdm.io.drive.writing import write_drive
from v2hdm.records import Trajectory
from v2hdm.verdict.inputs.ground import scaled, upside_down

TRUE = extrinsic(roll_deg=0.5, pitch_deg=20.0, yaw_deg=-1.0)
FEW = GroundOptions(pairs=14, clock_pairs=6, readings=False, free=())


@pytest.fixture(scope="module")
def turning(tmp_path_factory):
    return make_drive(tmp_path_factory.mktemp("turning"), 70.0, TRUE)


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    return make_drive(tmp_path_factory.mktemp("straight"), 0.0, TRUE)


def angles_off_deg(cam_from_vehicle):
    return np.rad2deg(mounting_angles(cam_from_vehicle) - mounting_angles(TRUE))


def test_true_poses_give_the_true_mounting_from_a_guess_that_is_4_degrees_off(turning):
    guessed = with_guess(turning, extrinsic(roll_deg=-3.0, pitch_deg=24.0, yaw_deg=3.0))
    estimate = estimate_ground(guessed, "front", FEW)
    assert estimate.status is GroundStatus.FOUND
    cam_from_vehicle = estimate.calibration.cam_from_vehicle
    assert np.abs(angles_off_deg(cam_from_vehicle)).max() < 0.05
    assert np.abs(-cam_from_vehicle[:3, :3].T @ cam_from_vehicle[:3, 3] - CENTRE)[2] < 0.01
    assert estimate.median_residual < 0.5


def test_a_clock_that_is_60_ms_late_is_found_on_a_turning_route(turning):
    early = Trajectory(turning.trajectory.stamp_s - 0.06, turning.trajectory.map_from_vehicle)
    estimate = estimate_ground(with_trajectory(turning, early), "front", replace(FEW, free=("clock_s",)))
    clock = estimate.parameters["clock_s"]
    assert clock.observable
    assert clock.value == pytest.approx(-0.06, abs=0.008)
    assert np.abs(angles_off_deg(estimate.calibration.cam_from_vehicle)).max() < 0.15


def test_a_straight_route_at_constant_speed_cannot_tell_its_clock(straight):
    clock = estimate_ground(straight, "front", replace(FEW, free=("clock_s",))).parameters["clock_s"]
    assert not clock.observable
    assert "include a turn" in clock.why_not


def test_a_clock_that_is_freed_where_hardly_anything_tells_it_stays_near_its_stamps(straight, monkeypatch):
    monkeypatch.setattr(estimate, "clock_shows", lambda motion: True)
    rng = np.random.default_rng(4)
    poses = straight.trajectory.map_from_vehicle.copy()
    poses[:, :2, 3] += rng.normal(0.0, 0.01, (len(poses), 2))
    rough = with_trajectory(straight, replace(straight.trajectory, map_from_vehicle=poses))
    guessed = with_guess(rough, extrinsic(roll_deg=-0.5, pitch_deg=21.0, yaw_deg=0.5))
    with_clock = estimate_ground(guessed, "front", replace(FEW, free=("clock_s",)))
    assert with_clock.status is GroundStatus.FOUND
    assert abs(with_clock.parameters["clock_s"].value) < 0.4
    assert np.abs(angles_off_deg(with_clock.calibration.cam_from_vehicle))[2] < 0.3


def test_poses_that_rise_over_the_ground_are_told(straight):
    poses = straight.trajectory.map_from_vehicle.copy()
    poses[:, 2, 3] += 0.01 * (poses[:, 0, 3] - 15.0)
    rising = with_trajectory(straight, Trajectory(straight.trajectory.stamp_s, poses))
    grade = estimate_ground(rising, "front", replace(FEW, free=("grade",))).parameters["grade"]
    assert grade.observable
    assert grade.value == pytest.approx(0.01, abs=0.001)


def test_a_focal_length_that_is_5_percent_too_long_is_told(turning):
    camera = turning.cameras["front"]
    intrinsic = INFO.intrinsic * [[1.05], [1.05], [1.0]]
    intrinsic[:2, 2] = INFO.intrinsic[:2, 2]
    info = replace(INFO, intrinsic=intrinsic)
    longer = with_guess(turning, TRUE)
    longer = replace(longer, cameras={"front": replace(camera, info=info)})
    focal = estimate_ground(longer, "front", replace(FEW, free=("focal_scale",))).parameters["focal_scale"]
    assert focal.observable
    assert focal.value == pytest.approx(1 / 1.05 - 1, abs=0.01)


@pytest.mark.parametrize("grain", [0.0, 4.0])
@pytest.mark.parametrize("turn_deg", [0.0, 70.0])
def test_the_focal_length_of_an_exact_lens_is_right_within_its_sigma(tmp_path, turn_deg, grain):
    drive = make_drive(tmp_path, turn_deg, TRUE, 20.0, grain)
    estimate = estimate_ground(drive, "front", replace(FEW, free=("focal_scale",)))
    focal = estimate.parameters["focal_scale"]
    assert focal.sigma < 0.012
    assert abs(focal.value) < 3 * focal.sigma


@pytest.mark.parametrize("turn_deg", [0.0, 70.0])
def test_a_crown_beneath_the_vehicle_is_not_taken_for_a_bent_lens(tmp_path, turn_deg):
    drive = make_drive(tmp_path, turn_deg, TRUE, crown=0.03)
    estimate = estimate_ground(drive, "front", replace(FEW, free=("distortion_k1",)))
    bent, mounting = estimate.parameters["distortion_k1"], estimate.calibration.cam_from_vehicle
    assert abs(bent.value) < 0.015
    assert np.abs(-mounting[:3, :3].T @ mounting[:3, 3] - CENTRE)[2] < 0.03


def test_errors_that_go_together_along_the_route_widen_a_variance():
    image = np.repeat(np.arange(48), 10)
    alone, together = np.random.default_rng(0).normal(size=(2, 480, 1))
    together = np.repeat(together[:12], 40, axis=0)
    assert _by_stretch(alone, image)[0] == pytest.approx(480, rel=0.6)
    assert _by_stretch(together, image)[0] > 20 * _by_stretch(alone, image)[0]


def test_how_far_beside_the_path_a_point_lies_does_not_depend_on_where_the_map_begins():
    course_map = np.column_stack([np.arange(0.0, 50.0), np.zeros(50)])
    points_map = np.array([[10.0, 2.5], [20.3, -1.25], [44.0, 0.0]])
    for origin in (np.zeros(2), np.array([4.5e5, 5.4e6])):
        beside_m = _beside_m(course_map + origin, points_map + origin)
        np.testing.assert_allclose(beside_m, [2.5, 1.25, 0.0], atol=1e-8)


def test_a_lens_without_its_distortion_leaves_larger_residuals(turning):
    pinhole = replace(turning.cameras["front"], info=replace(INFO, distortion=(0.0,) * 5))
    bare = replace(turning, cameras={"front": pinhole})
    plain, wrong = (estimate_ground(d, "front", FEW).median_residual for d in (turning, bare))
    assert wrong > 1.5 * plain


def test_a_mirrored_world_is_told_from_the_one_as_given(turning):
    poses = turning.trajectory.map_from_vehicle.copy()
    poses[:, 1, 3] *= -1
    yaw = -np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    zero = np.zeros(len(yaw))
    poses[:, :3, :3] = rotation_from_euler(zero, zero, yaw)
    mirrored = with_trajectory(turning, Trajectory(turning.trajectory.stamp_s, poses))
    straight_reading = estimate_ground(turning, "front", replace(FEW, readings=True))
    swapped = estimate_ground(mirrored, "front", replace(FEW, readings=True))
    assert straight_reading.reading is Reading.AS_GIVEN
    assert swapped.shares[Reading.MIRRORED] > 1.3 * swapped.shares[Reading.AS_GIVEN]


def test_a_heading_measured_from_north_matches_only_along_the_path(straight):
    poses = straight.trajectory.map_from_vehicle.copy()
    poses[:, :3, :3] = rotation_from_euler(*(np.full(len(poses), a) for a in (0.0, 0.0, np.pi / 2)))
    turned = with_trajectory(straight, Trajectory(straight.trajectory.stamp_s, poses))
    estimate = estimate_ground(turned, "front", replace(FEW, readings=True))
    assert estimate.status is GroundStatus.NO_MATCH
    assert estimate.reading is Reading.HEADING_FROM_PATH


@pytest.mark.parametrize(("contrast", "grain"), [(0.0, 0.0), (0.0, 3.0), (1.0, 3.0)])
def test_a_floor_without_texture_over_the_noise_tells_nothing(tmp_path, contrast, grain):
    even = make_drive(tmp_path, 0.0, TRUE, contrast, grain)
    estimate = estimate_ground(even, "front", FEW)
    assert estimate.status is GroundStatus.NO_TEXTURE
    assert estimate.calibration is None


@pytest.mark.parametrize("grain", [0.0, 3.0])
def test_a_rough_floor_that_lies_elsewhere_contradicts_the_poses(tmp_path, grain):
    feet = scaled(make_drive(tmp_path, 0.0, TRUE, 20.0, grain), 1 / 0.3048)
    assert estimate_ground(feet, "front", FEW).status is GroundStatus.NO_MATCH


@pytest.mark.parametrize(
    ("spoil", "wrong"),
    [
        (lambda drive: drive, False),
        (lambda drive: with_guess(drive, extrinsic(roll_deg=0.0, pitch_deg=25.0, yaw_deg=4.0)), False),
        (lambda drive: scaled(drive, 0.3048), True),
        (lambda drive: scaled(drive, 1 / 0.3048), True),
        (upside_down, True),
    ],
)
def test_the_motion_that_images_show_tells_wrong_poses_from_a_wrong_guess(straight, spoil, wrong):
    drive = spoil(straight)
    camera, motion = drive.cameras["front"], motion_of(drive, "front", Reading.AS_GIVEN)
    stated = Stated(drive, camera, motion, guessed_mount(camera))
    assert contradicts(Matcher(drive, "front", motion), stated) is wrong


def test_ground_that_matches_but_is_too_little_to_solve_for_contradicts_nothing(straight):
    assert estimate_ground(straight, "front", replace(FEW, pairs=1)).status is GroundStatus.NO_TEXTURE


def test_dirt_on_a_lens_over_a_floor_without_texture_contradicts_nothing(tmp_path):
    dusk = make_drive(tmp_path, 0.0, TRUE, 0.0, 2.0)
    dirt = np.random.default_rng(3).integers(0, 40, (40, 60), dtype=np.uint8)
    dirt = cv2.resize(dirt, (INFO.width, INFO.height), interpolation=cv2.INTER_CUBIC)
    for image in dusk.images:
        cv2.imwrite(str(image.path), cv2.add(cv2.imread(str(image.path), 0), dirt))
    assert estimate_ground(dusk, "front", FEW).status is GroundStatus.NO_TEXTURE


def test_the_mapper_starts_from_the_ground_only_where_it_was_found(straight, tmp_path):
    estimate = estimate_ground(straight, "front", FEW)
    started = better_start(straight, {"front": estimate}).cameras["front"]
    assert started.initial_ipm == "ground"
    nothing = replace(estimate, status=GroundStatus.NO_MATCH, calibration=None)
    assert better_start(straight, {"front": nothing}).cameras["front"].initial_ipm == "estimated"


def test_the_grey_of_an_image_is_the_same_from_a_jpeg_and_from_its_pixels_as_png(tmp_path):
    colours = np.random.default_rng(2).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    jpeg, png = tmp_path / "a.jpg", tmp_path / "a.png"
    cv2.imwrite(str(jpeg), cv2.resize(colours, (320, 240)))
    cv2.imwrite(str(png), cv2.imread(str(jpeg)))
    np.testing.assert_array_equal(read_grey(str(jpeg)), read_grey(str(png)))


def test_the_command_writes_a_mounting_and_says_how_good_it_is(tmp_path, capsys):
    true = extrinsic(roll_deg=0.5, yaw_deg=-1.0)
    drive = make_drive(tmp_path / "drive", 40.0, true)
    assert drive.trajectory is not None
    write_drive(tmp_path / "drive", drive, drive.trajectory)
    output = tmp_path / "mounting"
    assert run(
        ["calibrate", "ground", str(tmp_path / "drive"), "--output", str(output), "--workers", "1"]
    ) in (0, 3)
    calibration = read_calibration(output / "calibration_front.yaml")
    np.testing.assert_allclose(calibration.cam_from_vehicle[:3, :3], true[:3, :3], atol=0.005)
    shown = capsys.readouterr().out
    assert shown.startswith("front: roll 0.")
    assert "verdict: " in shown
