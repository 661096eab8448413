"""Bare ground becomes one sentence a quantity, of the true cause; usual mistakes explain why none matches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.verdict.drives import CENTRE, camera, drive, estimate, poses, raised
from v2hdm.geometry.ipm import apply_homography
from v2hdm.geometry.lens import undistort_points
from v2hdm.ground.results import GroundEstimate, GroundOptions, GroundStatus, Parameter, Reading
from v2hdm.records import Calibration, Drive
from v2hdm.verdict import Status, clock_corrections
from v2hdm.verdict.inputs import ground as ground_checks
from v2hdm.verdict.inputs.ground import CHECKS, check_ground, find_cause, path_of, scaled, upside_down
from v2hdm.verdict.inputs.heading import Path


def told(*estimates: GroundEstimate) -> dict[str, str]:
    names = tuple(one.camera for one in estimates)
    return raised(check_ground(drive(poses(), names), {one.camera: one for one in estimates}))


def test_a_clean_camera_passes_every_check_of_the_ground() -> None:
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
def test_a_quantity_that_the_ground_contradicts_is_told(
    name: str, value: float, check: str, says: str
) -> None:
    found = told(estimate(**{name: value}))
    assert list(found) == [check]
    assert says in found[check]


def test_a_clock_that_is_off_in_all_cameras_alike_is_that_of_the_poses() -> None:
    found = told(estimate("front", clock_s=0.060), estimate("rear", clock_s=0.063))
    assert "the poses' clock" in found["clock"]


def test_a_clock_beyond_what_is_corrected_fails() -> None:
    (found,) = [
        finding
        for finding in check_ground(drive(poses()), {"front": estimate(clock_s=0.4)})
        if finding.check == "clock"
    ]
    assert found.status is Status.FAIL


def test_a_value_within_five_of_its_sigmas_passes() -> None:
    vague = estimate(clock_s=0.05)
    parameters = {**vague.parameters, "clock_s": Parameter("clock_s", 0.05, 0.012, observable=True)}
    assert not told(replace(vague, parameters=parameters))


def test_what_a_drive_cannot_tell_is_said_with_what_would() -> None:
    straight = estimate()
    why = "constant speed on a straight road: drive a turn"
    parameters = {
        **straight.parameters,
        "clock_s": Parameter("clock_s", 0.1, 0.01, observable=False, why_not=why),
    }
    findings = check_ground(drive(poses()), {"front": replace(straight, parameters=parameters)})
    (clock,) = [finding for finding in findings if finding.check == "clock"]
    assert clock.is_unobservable
    assert why in clock.says


def test_a_place_known_worse_than_a_decimetre_is_not_told() -> None:
    vague = estimate()
    parameters = {**vague.parameters, "forward_m": Parameter("forward_m", 3.0, 0.5, observable=True)}
    findings = check_ground(drive(poses()), {"front": replace(vague, parameters=parameters)})
    assert [finding.check for finding in findings if finding.is_unobservable] == ["survey forward"]


def test_a_camera_without_survey_has_none_to_contradict() -> None:
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
def test_poses_that_match_when_read_otherwise_name_the_cause(
    reading: Reading, says: str, path: Path | None
) -> None:
    other = replace(
        estimate(),
        status=GroundStatus.NO_MATCH,
        reading=reading,
        shares={Reading.AS_GIVEN: 0.1, reading: 0.85},
    )
    found = told(other)
    assert says in found["path"]
    assert path_of({"front": other}) is path


def test_ground_that_never_matches_fails_and_lists_what_to_look_at() -> None:
    nothing = replace(estimate(), status=GroundStatus.NO_MATCH, shares={Reading.AS_GIVEN: 0.02})
    assert "check the clock, the unit of the positions" in told(nothing)["ground match"]


@pytest.mark.parametrize(
    ("status", "helps"),
    [(GroundStatus.TOO_LITTLE, "drive further"), (GroundStatus.NO_TEXTURE, "drive by day")],
)
def test_ground_that_cannot_be_matched_is_no_fault_and_what_would_help_is_said(
    status: GroundStatus, helps: str
) -> None:
    little = replace(estimate(), status=status, shares={Reading.AS_GIVEN: 0.0}, parameters={})
    (found,) = check_ground(drive(poses()), {"front": little})
    assert found.is_unobservable
    assert helps in found.says


def test_residuals_without_another_cause_point_to_the_lens() -> None:
    assert "distortion or focal length" in told(replace(estimate(), median_residual=1.2))["ground residual"]


def test_poses_that_pull_are_told_where_nothing_else_is() -> None:
    pulled = replace(estimate(), innovations={"heading": 4.0, "position": 1.0})
    assert "their heading is 4 times pose_noise off" in told(pulled)["poses against ground"]
    assert list(told(replace(pulled, parameters=estimate(clock_s=0.06).parameters))) == ["clock"]


def test_only_clocks_that_are_surely_off_and_correctable_are_corrected() -> None:
    ground = {
        "front": estimate("front", clock_s=0.06),
        "rear": estimate("rear", clock_s=0.01),
        "left": estimate("left", clock_s=0.4),
    }
    assert clock_corrections(ground) == {"front": 0.06}


def test_a_mirrored_path_is_told_although_most_of_a_straight_route_matches_as_given() -> None:
    mirrored = {Reading.AS_GIVEN: 0.41, Reading.MIRRORED: 0.52}
    bent = {name: replace(estimate(name, clock_s=-0.3), shares=mirrored) for name in ("front", "rear")}
    found = raised(check_ground(drive(poses(), ("front", "rear")), bent))
    assert list(found) == ["path"]
    assert "swapped (NED" in found["path"]
    assert path_of(bent) is Path.MIRRORED
    assert not clock_corrections(bent)


def test_a_clean_drive_that_matches_mirrored_as_well_is_taken_as_given() -> None:
    alike = replace(estimate(), shares={Reading.AS_GIVEN: 0.41, Reading.MIRRORED: 0.52})
    assert not raised(check_ground(drive(poses()), {"front": alike}))


def test_a_straight_road_cannot_tell_the_focal_length_from_the_height() -> None:
    straight = estimate(focal_scale=0.08)
    ahead = Parameter("forward_m", 0.4, 0.8, observable=False, why_not="the vehicle drives straight")
    straight = replace(straight, parameters={**straight.parameters, "forward_m": ahead})
    findings = check_ground(drive(poses()), {"front": straight})
    assert not raised(findings)
    assert "focal length from ground" in {finding.check for finding in findings if finding.is_unobservable}


def test_a_level_camera_cannot_tell_a_bent_lens_from_a_bent_road() -> None:
    level = np.eye(4)
    level[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    flat = replace(estimate(distortion_k1=-0.055), calibration=Calibration(camera().info, level, np.eye(6)))
    findings = check_ground(drive(poses()), {"front": flat})
    assert not raised(findings)
    assert "distortion" in {finding.check for finding in findings if finding.is_unobservable}


def test_dark_ground_that_matches_once_a_mistake_is_undone_fails() -> None:
    dark = replace(LOST, status=GroundStatus.NO_TEXTURE, parameters={})
    (found,) = check_ground(drive(poses()), {"front": dark}, "the images are upside down")
    assert (found.status, found.says) == (Status.FAIL, "the images are upside down")


LOST = replace(estimate(), status=GroundStatus.NO_MATCH, shares={Reading.AS_GIVEN: 0.0})


def test_undoing_feet_shortens_the_path() -> None:
    metres = scaled(drive(poses()), 0.3048)
    assert metres.images[-1].map_from_vehicle[:3, 3] == pytest.approx(
        0.3048 * drive(poses()).images[-1].map_from_vehicle[:3, 3]
    )
    assert metres.trajectory is not None
    assert metres.trajectory.map_from_vehicle[-1, :3, :3] == pytest.approx(
        poses().map_from_vehicle[-1, :3, :3]
    )


def test_a_pixel_of_an_image_upside_down_shows_the_ground_of_the_opposite_pixel() -> None:
    lens = replace(camera().info, distortion=(-0.1, 0.02, 0.003, -0.002, 0.0))
    one = replace(drive(poses()), cameras={"front": replace(camera(), info=lens)})
    right, turned = one.cameras["front"], upside_down(one).cameras["front"]
    points_px = np.array([[300.0, 500.0], [700.0, 650.0]])
    opposite_px = np.array([1279.0, 719.0]) - points_px
    seen = apply_homography(right.ipm["estimated"], undistort_points(right.info, points_px))
    also = apply_homography(turned.ipm["estimated"], undistort_points(turned.info, opposite_px))
    assert also == pytest.approx(seen, abs=1e-6)


def test_the_first_mistake_whose_undoing_makes_the_ground_match_is_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def only_in_metres(tried: Drive, name: str, options: GroundOptions) -> GroundEstimate:
        length_m = tried.images[-1].map_from_vehicle[0, 3]
        return estimate() if length_m < 0.5 * drive(poses()).images[-1].map_from_vehicle[0, 3] else LOST

    monkeypatch.setattr(ground_checks, "estimate_ground", only_in_metres)
    says = find_cause(drive(poses()), {"front": LOST})
    assert says is not None
    assert "feet" in says


def test_nothing_is_tried_where_a_camera_matches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ground_checks, "estimate_ground", None)
    assert find_cause(drive(poses()), {"front": LOST, "rear": estimate("rear")}) is None
    assert find_cause(drive(poses()), {}) is None
