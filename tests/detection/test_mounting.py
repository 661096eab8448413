"""The mounting of a camera of which nothing is known, from the lines of its images."""

import cv2
import numpy as np
import pytest

from tests.benchmarks.detector_mounting import SEED, rendered
from v2hdm.catalogue import SHIPPED
from v2hdm.cli.main import run
from v2hdm.detection.camera import RoadCamera, camera_from_calibration, rough_calibration
from v2hdm.detection.horizons import BODY_SIGMA_RAD, Horizons
from v2hdm.detection.mounting import Lines, Mounting, image_lines, output_lines
from v2hdm.detection.network import Network, run_on_road

FOV_DEG = 60.0
LEFT_M = (-5.0, -1.7, 1.8, 5.0)
PRIOR = Mounting(1.6, np.deg2rad(5.0), 0.0, np.deg2rad(FOV_DEG), (np.deg2rad(8.0), np.deg2rad(1.5)), 0.3)


def lines_of(pitch_deg, left_m=LEFT_M, turned_deg=0.0, roll_deg=0.0):
    """The lines of a road that leads to the left, so far left of a camera, as they are seen."""
    calibration = rough_calibration("c", 1280, 720, 1.5, pitch_deg, FOV_DEG, roll_deg)
    view = RoadCamera(camera_from_calibration(calibration))
    turned = np.tan(np.deg2rad(turned_deg))
    ends = np.array([[[x, left + turned * x] for x in (6.0, 30.0)] for left in left_m])
    near_ends, far = view.project(ends.reshape(-1, 2)).reshape(-1, 2, 2).swapaxes(0, 1)
    along = (near_ends - far) / np.linalg.norm(near_ends - far, axis=1, keepdims=True)
    count = np.ones(len(left_m))
    return Lines((near_ends + far) / 2, along, 0.5 * count, 0.002 * count, count)


NO_LINES = Lines(np.zeros((0, 2)), np.zeros((0, 2)), *[np.zeros(0)] * 3)


def horizons(*images):
    estimates = Horizons(rough_calibration("c", 1280, 720, 1.6, 5.0, FOV_DEG).info, PRIOR)
    for lines in images:
        estimates.add(lines)
    return estimates


def estimate(*images):
    return horizons(*images).mounting


def pitch_deg_of(mounting):
    return np.rad2deg(mounting.pitch_rad), np.rad2deg(mounting.sigma_rad[0])


@pytest.mark.parametrize("pitch_deg", [-10.0, 5.0, 20.0])
@pytest.mark.parametrize("turned_deg", [0.0, 6.0])
def test_images_of_a_road_show_the_pitch_whatever_the_prior(pitch_deg, turned_deg):
    mounting = estimate(*[lines_of(pitch_deg, turned_deg=turned_deg)] * 4)
    assert np.rad2deg(mounting.pitch_rad) == pytest.approx(pitch_deg, abs=0.5)
    assert mounting.sigma_rad[0] < BODY_SIGMA_RAD


def test_one_image_may_show_something_else():
    """Its lines may be those of a wall: some of the prior stays."""
    mounting = estimate(lines_of(-10.0))
    assert np.rad2deg(mounting.sigma_rad[0]) > 1.0
    assert np.rad2deg(mounting.pitch_rad) == pytest.approx(-10.0, abs=3.0)


@pytest.mark.parametrize("left_m", [(), (1.8,), (1.8, 1.8)])
def test_lines_that_do_not_cross_leave_the_prior(left_m):
    lines = lines_of(-10.0, LEFT_M)
    rows = [LEFT_M.index(1.8)] * len(left_m)
    mounting = estimate(Lines(*(part[rows] for part in vars(lines).values())))
    assert np.rad2deg(mounting.sigma_rad[0]) > 3.0


def test_lines_that_run_another_way_do_not_move_the_horizon():
    lines, stray = lines_of(10.0), lines_of(10.0, (3.0, -4.0), turned_deg=-20.0)
    with_others = Lines(
        *(np.concatenate(pair) for pair in zip(vars(lines).values(), vars(stray).values(), strict=False))
    )
    assert np.rad2deg(estimate(*[with_others] * 4).pitch_rad) == pytest.approx(10.0, abs=0.6)


@pytest.mark.parametrize("roll_deg", [-2.0, 2.0])
def test_roads_that_lead_aside_show_the_roll(roll_deg):
    images = [lines_of(6.0, turned_deg=turned, roll_deg=roll_deg) for turned in (-16.0, 0.0, 16.0)]
    mounting = estimate(*images * 2)
    assert np.rad2deg(mounting.roll_rad) == pytest.approx(roll_deg, abs=0.8)
    assert mounting.sigma_rad[1] < 0.6 * PRIOR.sigma_rad[1]
    ahead = estimate(*[lines_of(6.0, roll_deg=roll_deg)] * 6)
    assert ahead.sigma_rad[1] > 0.8 * PRIOR.sigma_rad[1], "one vanishing point does not show it"


def test_an_image_without_lines_has_the_horizon_of_the_others_as_far_as_they_agree():
    pitch_deg, sigma_deg = pitch_deg_of(horizons(*[lines_of(12.0)] * 12).next(NO_LINES))
    assert pitch_deg == pytest.approx(12.0, abs=0.5)
    unrelated = horizons(*[lines_of(pitch) for pitch in np.linspace(-12.0, 20.0, 12)]).next(NO_LINES)
    assert pitch_deg_of(unrelated)[1] > 2 * sigma_deg, "unrelated photographs narrow nothing"
    alone_deg, alone_sigma_deg = pitch_deg_of(horizons().next(NO_LINES))
    assert alone_deg == pytest.approx(5.0, abs=0.5)
    assert alone_sigma_deg == pytest.approx(8.0, abs=0.6)


def test_images_of_two_mountings_keep_their_own_horizons():
    estimates = horizons(*[lines_of(-8.0), lines_of(14.0)] * 6)
    for pitch_deg in (-8.0, 14.0):
        mounting = estimates.next(lines_of(pitch_deg))
        assert np.rad2deg(mounting.pitch_rad) == pytest.approx(pitch_deg, abs=0.5)
        assert mounting.sigma_rad[0] < np.deg2rad(2.0)
    assert estimates.of_mounting == pytest.approx(0.5, abs=0.1)


def test_images_of_one_camera_share_it_tightly_and_keep_the_pitch_of_their_body():
    estimates = horizons(*[lines_of(10.0)] * 10)
    assert pitch_deg_of(estimates.next(lines_of(10.0)))[1] < 0.6 * pitch_deg_of(estimate(lines_of(10.0)))[1]
    pitched = estimates.next(lines_of(11.2))
    assert 10.4 < np.rad2deg(pitched.pitch_rad) < 11.3


def test_an_image_after_one_of_a_mounting_is_expected_to_be_of_that():
    """Photographs of two days come one day after the other."""
    estimates = horizons()
    for pitch_deg in (-8.0, 14.0):
        for _ in range(8):
            estimates.next(lines_of(pitch_deg))
    mounting = estimates.next(NO_LINES)
    assert np.rad2deg(mounting.pitch_rad) == pytest.approx(14.0, abs=1.0)


def test_an_image_that_was_looked_at_before_counts_once():
    estimates = horizons()
    estimates.add(lines_of(12.0), key="first")
    others = horizons()
    assert pitch_deg_of(estimates.earlier("first")) == pytest.approx(
        pitch_deg_of(others.next(lines_of(12.0)))
    )
    assert estimates.earlier("first") is None


def test_of_many_mountings_those_of_the_fewest_images_are_given_up():
    estimates = horizons(*[lines_of(5.0)] * 3, *[lines_of(pitch) for pitch in np.linspace(-14, 26, 25)])
    assert estimates.images == 28
    assert np.rad2deg(estimates.mounting.pitch_rad) == pytest.approx(5.0, abs=1.5)


def test_the_expected_horizon_lies_where_the_images_show_ground():
    """A pitch of 20 degrees up would show the sky alone."""
    expected, highest_rad = horizons().coming(0.99)
    assert np.deg2rad(-17) < expected.pitch_rad < highest_rad < np.deg2rad(35)


def test_sizes_are_as_uncertain_as_the_mounting():
    calibration = rough_calibration("c", 1280, 720, 1.5, 5.0, FOV_DEG)
    stated, guessed = (
        RoadCamera(camera_from_calibration(calibration, mounting_sigma=sigma))
        for sigma in ((0.0, 0.0), (0.01, 0.3))
    )
    assert stated.log_size_sigma(15.0) == 0.0
    assert guessed.log_size_sigma(15.0) == pytest.approx(np.hypot(2 * 0.01 * 15 / 1.5, 0.3))
    # The same pixels of a camera that looks down by 0.01 rad more, 15 m away and along the view.
    other = RoadCamera(camera_from_calibration(rough_calibration("c", 1280, 720, 1.5, 5.0 - 0.573, FOV_DEG)))
    ends = stated.project(np.array([[15.0, 0.0], [15.1, 0.0]]))
    assert abs(np.log(np.ptp(other.ground(ends)[:, 0]) / 0.1)) == pytest.approx(0.2, abs=0.05)
    dash = SHIPPED.classes["lane_dash"]
    sizes = {"length_m": 14.0, "width_m": 0.15, "whole": True}
    assert dash.size_log_likelihood(**sizes, log_sigma=0.3) > 0.2 * dash.size_log_likelihood(**sizes)


def test_a_folder_without_a_mounting_is_seen_from_where_its_lines_meet(tmp_path, capsys):
    """Said once, with a standard deviation that holds."""
    folder = rendered(tmp_path, camera=1, images=4, seed=SEED + 1)
    pitch_deg, info = folder.mounting[1], rough_calibration("c", 1280, 720, 1.6, 5.0, folder.mounting[2]).info
    arguments = ["--mounting", "1.6", f"{pitch_deg + 4:.2f}", f"{folder.mounting[2]:.2f}"]
    assert run(["detect", str(folder.path), *arguments, "--output", str(tmp_path / "out.jsonl")]) == 0
    said = [text for text in capsys.readouterr().err.splitlines() if "from the lines of" in text]
    assert len(said) == 1
    stated_deg, sigma = (float(word) for word in said[0].split("looks ")[1].split(" deg")[0].split(" +- "))
    assert abs(stated_deg - pitch_deg) < 3 * np.hypot(sigma, np.rad2deg(BODY_SIGMA_RAD) / 2)
    image, network = cv2.imread(str(folder.path / "000.png")), Network()
    lines = image_lines(network, image, info)
    assert np.allclose(np.linalg.norm(lines.direction, axis=1), 1)
    view = RoadCamera(camera_from_calibration(rough_calibration("c", 1280, 720, *folder.mounting)))
    again = output_lines(run_on_road(network, image, view), info)
    pitches = [np.rad2deg(estimate(lines_of_image).pitch_rad) for lines_of_image in (lines, again)]
    assert abs(pitches[0] - pitches[1]) < 1.5, "the output on the road's rows shows the same horizon"


def test_photographs_of_different_sizes_have_a_horizon_each(tmp_path):
    """Only a stated camera has a size."""
    rng = np.random.default_rng(1)
    for number, size in enumerate([(64, 96, 3), (96, 64, 3)]):
        cv2.imwrite(str(tmp_path / f"{number}.png"), rng.integers(90, 110, size, dtype=np.uint8))
    assert run(["detect", str(tmp_path), "--output", str(tmp_path / "out.jsonl")]) == 0
    assert len((tmp_path / "out.jsonl").read_text().splitlines()) == 2
