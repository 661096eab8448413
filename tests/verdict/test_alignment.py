"""The constant angle between heading and course."""

from dataclasses import replace

import numpy as np
import pytest

from tests.verdict.drives import NOISE, camera, drive, motion, poses, trajectory, with_yaw, yaw_of
from v2hdm.records import DETECTIONS_SUFFIX, Camera, PoseNoise, Trajectory
from v2hdm.verdict import Finding, Status
from v2hdm.verdict.inputs.alignment import check_alignment
from v2hdm.verdict.inputs.drive import input_findings


def turned(recorded: Trajectory, offset_deg: float) -> Trajectory:
    return with_yaw(recorded, yaw_of(recorded) + np.deg2rad(offset_deg))


def surveyed(ahead_m: float, sigma_m: float = 0.02) -> dict[str, Camera]:
    """The camera of a made drive, ``ahead_m`` of the axle."""
    tiny = camera()
    prior = tiny.centre_prior
    assert prior is not None
    prior = replace(prior, centre_vehicle=np.array([ahead_m, 0.0, 2.5]), sigma_m=np.full(3, sigma_m))
    return {"front": replace(tiny, centre_prior=prior)}


def checked(recorded: Trajectory, cameras: dict[str, Camera] | None = None) -> Finding:
    (finding,) = check_alignment(motion(recorded), NOISE, cameras or {})
    return finding


def test_a_heading_is_off_by_the_angle_by_which_the_path_leaves_it():
    offsets_deg = [checked(turned(poses(turn_s=0.0, seed=seed), 0.5)).value for seed in range(8)]
    np.testing.assert_allclose(offsets_deg, -0.5, atol=0.15)
    assert np.mean(offsets_deg) == pytest.approx(-0.5, abs=0.05)


def test_a_heading_three_degrees_off_is_a_misaligned_antenna():
    finding = checked(turned(poses(), 3.0))
    assert finding.status is Status.WARN
    assert "3.0 deg to the right" in finding.says


@pytest.mark.parametrize(("ahead_m", "status"), [(3.6, Status.WARN), (1.0, Status.PASS)])
def test_half_a_degree_matters_where_it_moves_a_surveyed_centre_by_more_than_its_sigma(ahead_m, status):
    finding = checked(turned(poses(straight_s=16.0, turn_s=0.0), 0.5), surveyed(ahead_m))
    assert finding.status is status
    assert ("moves the surveyed centre of front by 3 cm" in finding.says) == (status is Status.WARN)


def test_a_vehicle_within_the_tolerance_of_its_axles_is_sound_however_well_it_is_surveyed():
    assert (
        checked(turned(poses(straight_s=16.0, turn_s=0.0), 0.2), surveyed(3.6, 0.002)).status is Status.PASS
    )


@pytest.mark.parametrize("seed", range(10))
def test_right_headings_pass_over_a_straight_road_and_beside_a_turn(seed):
    for turn_s in (0.0, 8.0):
        assert checked(poses(turn_s=turn_s, seed=seed), surveyed(3.6)).status is Status.PASS


def test_positions_worse_than_stated_widen_the_sigma_and_are_no_offset():
    recorded = poses(straight_s=16.0, turn_s=0.0)
    position = recorded.map_from_vehicle[:, :3, 3].copy()
    position[len(position) // 2 :, 1] += 0.4
    stepped = trajectory(recorded.stamp_s, position, yaw_of(recorded))
    assert checked(stepped, surveyed(3.6)).status is Status.PASS


def test_an_origin_ahead_of_the_axle_moves_aside_as_the_heading_turns_and_is_no_offset():
    recorded = poses()
    recorded.map_from_vehicle[:, :3, 3] += 1.2 * recorded.map_from_vehicle[:, :3, 0]
    assert checked(recorded, surveyed(3.6)).status is Status.PASS


def test_driving_backwards_has_the_same_offset():
    recorded = poses(straight_s=16.0, turn_s=0.0)
    back = trajectory(recorded.stamp_s, recorded.map_from_vehicle[::-1, :3, 3], yaw_of(recorded))
    ahead_deg, back_deg = (checked(turned(path, 0.5)).value for path in (recorded, back))
    assert ahead_deg == pytest.approx(back_deg, abs=0.1)


def test_a_circle_has_no_straight_stretch():
    assert checked(poses(straight_s=0.0)).is_unobservable


def test_a_wrong_convention_is_named_by_the_check_of_the_heading_alone():
    assert not list(check_alignment(motion(turned(poses(), 37.0)), NOISE, {}))


@pytest.mark.parametrize(("turns", "status"), [(True, Status.PASS), (False, Status.WARN)])
def test_a_straight_drive_headed_by_its_course_leaves_yaw_open_and_says_so(turns, status):
    stamp_s = 0.1 * np.arange(300)
    yaw = 0.05 * stamp_s if turns else np.zeros(300)
    step = 0.4 * np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(300)])
    recorded = trajectory(stamp_s, np.cumsum(step, axis=0), yaw)
    (offset,) = check_alignment(motion(recorded), PoseNoise(), {}, by_course=True)
    assert offset.status is status
    assert ("the cameras' yaw look the same" in offset.says) == (not turns)


def test_the_checks_of_a_drive_tell_a_heading_that_its_survey_contradicts():
    spoilt = drive(turned(poses(straight_s=16.0, turn_s=0.0), 0.8))
    images = [replace(image, path=image.path.with_suffix(DETECTIONS_SUFFIX)) for image in spoilt.images]
    spoilt = replace(spoilt, cameras=surveyed(3.6), images=images)
    raised = [finding.check for finding in input_findings(spoilt) if finding.status is not Status.PASS]
    assert "heading offset" in raised
