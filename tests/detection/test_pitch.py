"""The pitch of a camera of which only a guess is known, from the lines that its images show."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from train.examples import Example, example
from v2hdm.cli.main import run
from v2hdm.detection.camera import RoadCamera, camera_from_calibration, rough_calibration
from v2hdm.detection.detector import Detector
from v2hdm.detection.pitch import PitchVote, estimate_pitch, guessed_pitch_rad
from v2hdm.geometry.ipm import extrinsic_from_ipm
from v2hdm.records import LANE_BOUNDARY, LANE_LINE, LaneDetection

HEIGHT_M, FOV_DEG = 1.5, 60.0
LEFT_M = (-5.0, -1.7, 1.8, 5.0)
RENDERED = (9, 12)
"""Streets of the renders to fit to, seen nearly level."""


def view_of(pitch_deg: float) -> RoadCamera:
    calibration = rough_calibration("camera", 1280, 720, HEIGHT_M, pitch_deg, FOV_DEG)
    return RoadCamera(camera_from_calibration(calibration))


def line(view: RoadCamera, left_m: float, turned_rad: float = 0.0, sway_px: float = 0.0) -> LaneDetection:
    """A straight line on the ground, so far left of the camera, as it is seen."""
    along = np.linspace(4.0, 25.0, 60)
    ground = np.column_stack([along, left_m + np.tan(turned_rad) * along, np.ones_like(along)])
    seen = ground @ view.pinhole_px_from_vehicle.T
    px = seen[:, :2] / seen[:, 2:]
    px = px[view.inside(px, 0)]
    return LaneDetection(LANE_LINE, 0.9, px + [[sway_px, 0.0]] * np.sin(np.arange(len(px)))[:, None])


@pytest.mark.parametrize("off_deg", [-4.0, 0.0, 4.0])
@pytest.mark.parametrize("turned_rad", [0.0, 0.1])
def test_the_lines_of_a_road_tell_the_pitch_whatever_the_guess(off_deg, turned_rad):
    true = view_of(6.0)
    lines = [line(true, left_m, turned_rad, sway_px=1.0) for left_m in LEFT_M]
    told = estimate_pitch(lines, view_of(6.0 + off_deg))
    assert told is not None
    assert np.rad2deg(told.pitch_rad) == pytest.approx(6.0, abs=0.4)
    assert told.sigma_rad < np.deg2rad(0.6)


def test_a_single_line_and_lines_of_one_slope_tell_nothing():
    true = view_of(6.0)
    assert estimate_pitch([], true) is None
    assert estimate_pitch([line(true, 1.8)], true) is None
    assert estimate_pitch([line(true, 1.8), line(true, 1.9)], true) is None


def test_one_line_that_runs_another_way_does_not_move_the_horizon():
    true = view_of(6.0)
    lines = [line(true, left_m) for left_m in LEFT_M]
    stray = line(true, 3.0, turned_rad=-0.35)
    told = estimate_pitch([*lines, stray], view_of(2.0))
    assert told is not None
    assert np.rad2deg(told.pitch_rad) == pytest.approx(6.0, abs=0.6)


def test_a_stream_has_the_pitch_on_which_three_images_agree():
    views = [view_of(pitch) for pitch in (6.0, 9.0, 6.1, 6.2, 6.0)]
    vote = PitchVote()
    told = [vote.add([line(view, left_m) for left_m in LEFT_M], view_of(3.0)) for view in views]
    assert told[:4] == [None] * 4
    assert told[4] is not None
    assert np.rad2deg(told[4]) == pytest.approx(6.1, abs=0.3)
    assert vote.add([line(views[0], left_m) for left_m in (-5.0, 1.8)], view_of(3.0)) is None, (
        "once is enough"
    )


@cache
def rendered(index: int) -> Example:
    return example(index, 0.2, seed=917)


@pytest.fixture(scope="module")
def detector() -> Detector:
    return Detector.load()


@pytest.mark.parametrize("off_deg", [-4.0, 4.0])
def test_rendered_views_are_corrected_to_within_a_degree_or_left_alone(detector, off_deg):
    corrected = 0
    for index in RENDERED:
        shown = rendered(index)
        true = extrinsic_from_ipm(shown.camera.info, shown.camera.ipm[shown.camera.initial_ipm])
        pitch_rad = guessed_pitch_rad(RoadCamera(shown.camera))
        height_m = float(-(true[:3, :3].T @ true[:3, 3])[2])
        guess = rough_calibration("c", 1280, 720, height_m, np.rad2deg(pitch_rad) + off_deg, FOV_DEG)
        info = replace(shown.camera.info, name=f"{index} {off_deg}")
        camera = camera_from_calibration(replace(guess, info=info))
        _, lanes = detector.detect(shown.image, camera)
        assert any(lane.kind == LANE_BOUNDARY for lane in lanes)
        told = estimate_pitch(lanes, detector.road_camera(camera))
        if told is not None:
            corrected += 1
            assert abs(told.pitch_rad - pitch_rad) < np.deg2rad(1.0)
    assert corrected


def test_a_stream_without_a_calibration_takes_the_pitch_that_its_lines_show(tmp_path, capsys):
    """Said once, and from then on the horizon of the detector is the one of the images."""
    shown = rendered(RENDERED[0])
    for n in range(5):
        cv2.imwrite(str(tmp_path / f"{n}.png"), shown.image)
    (focal_px, _, _), (_, _, centre_px), _ = shown.camera.info.intrinsic
    horizon_px = centre_px - focal_px * np.tan(guessed_pitch_rad(RoadCamera(shown.camera)))
    # A rough camera has its principal point in the middle of the image.
    pitch_deg = np.rad2deg(np.arctan((359.5 - horizon_px) / focal_px))
    fov_deg = np.rad2deg(2 * np.arctan(640 / focal_px))
    mounting = [f"{value:.2f}" for value in (HEIGHT_M, pitch_deg + 4, fov_deg)]
    assert (
        run(["detect", str(tmp_path), "--mounting", *mounting, "--output", str(tmp_path / "out.jsonl")]) == 0
    )
    said = [text for text in capsys.readouterr().err.splitlines() if "meet on a horizon" in text]
    assert len(said) == 1
    assert "the lines of 2 " in said[0]
    assert float(said[0].split("look ")[1].split()[0]) == pytest.approx(pitch_deg, abs=1.0)
