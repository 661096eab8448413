"""Bare ground becomes one sentence a quantity, of the true cause; usual mistakes explain why none matches."""

from dataclasses import replace

import numpy as np
import pytest

from tests.verdict.drives import CENTRE, camera, drive, estimate, poses, raised
from v2hdm.geometry.ipm import apply_homography
from v2hdm.geometry.lens import undistort_points
from v2hdm.ground.results import GroundStatus, Parameter, Reading
from v2hdm.records import Calibration
from v2hdm.verdict import Status, clock_corrections
from v2hdm.verdict.inputs.ground import CHECKS, check_ground, find_cause, path_of, scaled, upside_down
from v2hdm.verdict.inputs.heading import Path


def told(*estimates):
    names = tuple(one.camera for one in estimates)
    return raised(check_ground(drive(poses(), names), {one.camera: one for one in estimates}))


def test_a_clean_camera_passes_every_check_of_the_ground():
    findings = check_ground(drive(poses()), {"front": estimate()})
    assert all(finding.status is Status.PASS and finding.value is not None for finding in findings)
    assert {finding.check for finding in findings} == set(CHECKS) - {"path"}


@pytest.mark.parametrize(
    ("name", "value", "check", "says"),
    [
        ("clock_s", 0.12, "clock", "taken 120 ms later than their stamps say (this camera's clock is off)"),
        ("clock_s", -0.03, "clock", "taken 30 ms earlier"),
        ("focal_scale", -0.049, "focal length from ground", "4.9 % too long"),
        ("distortion_k1", -0.18, "distortion", "k1 should be 0.18 smaller"),
        ("grade", 0.003, "grade", "rise over the ground by 0.30 %"),
        ("up_m", -0.1, "survey height", "0.10 m too high"),
        ("forward_m", -1.2, "survey forward", "1.2 m too far ahead"),
        ("left_m", 0.8, "survey left", "0.8 m too far to the right"),
    ],
)
def test_a_quantity_that_the_ground_contradicts_is_told(name, value, check, says):
    found = told(estimate(**{name: value}))
    assert list(found) == [check]
    assert says in found[check]


def test_a_clock_that_is_off_in_all_cameras_alike_is_that_of_the_poses():
    found = told(estimate("front", clock_s=0.060), estimate("rear", clock_s=0.063))
    assert "the poses' clock" in found["clock"]


def known(one, name, value, sigma, why_not=""):
    """The estimate, of which one parameter is known otherwise, or not at all for a reason."""
    parameter = Parameter(name, value, sigma, observable=not why_not, why_not=why_not)
    return replace(one, parameters={**one.parameters, name: parameter})


def test_a_value_within_five_of_its_sigmas_passes_and_a_clock_beyond_what_is_corrected_fails():
    assert not told(known(estimate(), "clock_s", 0.05, 0.012))
    findings = check_ground(drive(poses()), {"front": estimate(clock_s=0.4)})
    assert [one.status for one in findings if one.check == "clock"] == [Status.FAIL]


WHY = "constant speed on a straight road: include a turn"
LEVEL = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
OPEN = {
    "clock": (known(estimate(), "clock_s", 0.1, 0.01, WHY), WHY),
    "survey forward": (known(estimate(), "forward_m", 3.0, 0.5), ""),  # worse than a decimetre
    "focal length from ground": (known(estimate(focal_scale=0.08), "forward_m", 0.4, 0.8, WHY), ""),
    # A level camera cannot tell a bent lens from a bent road.
    "distortion": (
        replace(
            estimate(distortion_k1=-0.055), calibration=Calibration(camera().info, LEVEL, np.eye(6))
        ), "",
    ),
}  # fmt: skip


@pytest.mark.parametrize("check", OPEN)
def test_what_a_drive_cannot_tell_is_said_with_what_would(check):
    one, why = OPEN[check]
    findings = check_ground(drive(poses()), {"front": one})
    assert not raised(findings)
    assert why in {one.check: one.says for one in findings if one.is_unobservable}[check]


def test_a_camera_without_survey_has_none_to_contradict():
    bare = drive(poses())
    bare = replace(bare, cameras={"front": replace(camera(centre=CENTRE), centre_prior=None)})
    assert not raised(check_ground(bare, {"front": estimate(up_m=0.3)}))


@pytest.mark.parametrize(
    ("reading", "says", "path"),
    [
        (Reading.HEADING_FROM_PATH, "recorded yaw is wrong", Path.RIGHT_YAW_WRONG),
        (Reading.MIRRORED, "x and y of the positions are swapped (NED", Path.MIRRORED),
        (Reading.BACKWARDS, "images of front and rear are swapped", None),
    ],
)
def test_poses_that_match_when_read_otherwise_name_the_cause(reading, says, path):
    other = replace(
        estimate(),
        status=GroundStatus.NO_MATCH,
        reading=reading,
        shares={Reading.AS_GIVEN: 0.1, reading: 0.85},
    )
    found = told(other)
    assert says in found["path"]
    assert path_of({"front": other}) is path


PULLED = replace(estimate(), innovations={"heading": 4.0, "position": 1.0})
LOST = replace(estimate(), status=GroundStatus.NO_MATCH, shares={Reading.AS_GIVEN: 0.0})


@pytest.mark.parametrize(
    ("one", "check", "says"),
    [
        (LOST, "ground match", "check the clock, the unit of the positions"),
        (replace(estimate(), median_residual=1.2), "ground residual", "distortion or focal length"),
        (PULLED, "poses against ground", "their heading is 4 times pose_noise off"),
    ],
)
def test_ground_that_does_not_fit_lists_what_to_look_at(one, check, says):
    assert says in told(one)[check]


def test_poses_that_pull_are_not_told_where_something_else_is():
    assert list(told(replace(PULLED, parameters=estimate(clock_s=0.06).parameters))) == ["clock"]


@pytest.mark.parametrize(
    ("status", "helps"),
    [(GroundStatus.TOO_LITTLE, "drive farther"), (GroundStatus.NO_TEXTURE, "drive by day")],
)
def test_ground_that_cannot_be_matched_is_no_fault_and_what_would_help_is_said(status, helps):
    little = replace(estimate(), status=status, shares={Reading.AS_GIVEN: 0.0}, parameters={})
    (found,) = check_ground(drive(poses()), {"front": little})
    assert found.is_unobservable
    assert helps in found.says


def test_only_clocks_that_are_surely_off_and_correctable_are_corrected():
    ground = {
        "front": estimate("front", clock_s=0.06),
        "rear": estimate("rear", clock_s=0.01),
        "left": estimate("left", clock_s=0.4),
    }
    assert clock_corrections(ground) == {"front": 0.06}


def test_a_mirrored_path_is_told_although_most_of_a_straight_route_matches_as_given():
    mirrored = {Reading.AS_GIVEN: 0.41, Reading.MIRRORED: 0.52}
    bent = {name: replace(estimate(name, clock_s=-0.3), shares=mirrored) for name in ("front", "rear")}
    found = raised(check_ground(drive(poses(), ("front", "rear")), bent))
    assert list(found) == ["path"]
    assert "swapped (NED" in found["path"]
    assert path_of(bent) is Path.MIRRORED
    assert not clock_corrections(bent)


def test_a_clock_that_runs_off_is_no_wrong_yaw_although_more_ground_matches_along_the_smooth_path():
    smoother = {Reading.AS_GIVEN: 0.54, Reading.HEADING_FROM_PATH: 0.62}
    fast = {name: replace(estimate(name, clock_s=-0.039), shares=smoother) for name in ("front", "rear")}
    assert list(raised(check_ground(drive(poses(), ("front", "rear")), fast))) == ["clock"]
    assert path_of(fast) is Path.AS_GIVEN
    assert set(clock_corrections(fast)) == {"front", "rear"}


def test_a_clean_drive_that_matches_mirrored_as_well_is_taken_as_given():
    alike = replace(estimate(), shares={Reading.AS_GIVEN: 0.41, Reading.MIRRORED: 0.52})
    assert not raised(check_ground(drive(poses()), {"front": alike}))


def test_dark_ground_that_matches_once_a_mistake_is_undone_fails():
    dark = replace(LOST, status=GroundStatus.NO_TEXTURE, parameters={})
    (found,) = check_ground(drive(poses()), {"front": dark}, "the images are upside down")
    assert (found.status, found.says) == (Status.FAIL, "the images are upside down")


def test_undoing_feet_shortens_the_path():
    feet, metres = drive(poses()), scaled(drive(poses()), 0.3048)
    there, here = (one.images[-1].map_from_vehicle for one in (feet, metres))
    assert here[:3, 3] == pytest.approx(0.3048 * there[:3, 3])
    there, here = (one.trajectory.map_from_vehicle[-1, :3, :3] for one in (feet, metres))
    assert here == pytest.approx(there)


def test_a_pixel_of_an_image_upside_down_shows_the_ground_of_the_opposite_pixel():
    lens = replace(camera().info, distortion=(-0.1, 0.02, 0.003, -0.002, 0.0))
    one = replace(drive(poses()), cameras={"front": replace(camera(), info=lens)})
    right, turned = one.cameras["front"], upside_down(one).cameras["front"]
    points_px = np.array([[300.0, 500.0], [700.0, 650.0]])
    opposite_px = np.array([1279.0, 719.0]) - points_px
    seen = apply_homography(right.ipm["estimated"], undistort_points(right.info, points_px))
    also = apply_homography(turned.ipm["estimated"], undistort_points(turned.info, opposite_px))
    assert also == pytest.approx(seen, abs=1e-6)


def test_the_first_mistake_whose_undoing_makes_the_ground_match_is_told(monkeypatch):
    def only_in_metres(tried, name, options):
        length_m = tried.images[-1].map_from_vehicle[0, 3]
        return estimate() if length_m < 0.5 * drive(poses()).images[-1].map_from_vehicle[0, 3] else LOST

    monkeypatch.setattr("v2hdm.ground.estimate.estimate_ground", only_in_metres)
    says = find_cause(drive(poses()), {"front": LOST})
    assert says is not None
    assert "feet" in says


def test_nothing_is_tried_where_a_camera_matches(monkeypatch):
    monkeypatch.setattr("v2hdm.ground.estimate.estimate_ground", None)
    assert find_cause(drive(poses()), {"front": LOST, "rear": estimate("rear")}) is None
    assert find_cause(drive(poses()), {}) is None
