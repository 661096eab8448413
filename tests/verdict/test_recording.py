"""Checks of stamps, images and cameras."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.verdict.drives import CENTRE, camera, drive, motion, noisy, pictured, poses, raised, with_k
from v2hdm.io.trajectory import why_no_pose
from v2hdm.records import Camera, CentrePrior, Trajectory
from v2hdm.verdict import Status
from v2hdm.verdict.inputs.drive import check_camera
from v2hdm.verdict.inputs.recording import check_clocks, check_images


def every(recorded, rows):
    return Trajectory(recorded.stamp_s[rows], recorded.map_from_vehicle[rows])


def check(recorded):
    return raised(check_clocks(drive(poses()), motion(recorded)))


def test_poses_that_are_few_have_gaps_or_repeat_are_told():
    recorded = poses()
    assert not check(recorded)
    assert "poses are 1.00 s apart" in check(every(recorded, np.arange(0, 320, 20)))["pose rate"]
    findings = check(every(recorded, np.delete(np.arange(320), np.arange(100, 120))))
    assert list(findings) == ["pose gaps"]
    assert "gap of 1.05 s" in findings["pose gaps"]
    held = every(recorded, np.arange(320) // 5 * 5)  # a log faster than its receiver
    findings = check(Trajectory(recorded.stamp_s, held.map_from_vehicle))
    assert list(findings) == ["repeated poses"]
    assert "80 %" in findings["repeated poses"]


def test_a_vehicle_that_stands_repeats_poses_and_is_fine():
    recorded = poses(turn_s=0.0)
    stand = np.full(200, len(recorded.stamp_s) - 1)
    matrices = np.concatenate([recorded.map_from_vehicle, recorded.map_from_vehicle[stand]])
    assert not check(Trajectory(np.arange(len(matrices)) / 20, matrices))


@pytest.mark.parametrize(("without", "status"), [(20, Status.WARN), (200, Status.FAIL)])
def test_images_without_pose_are_counted(without, status):
    some = replace(drive(poses()), unposed={"front": without})
    finding = {finding.check: finding for finding in check_clocks(some, motion(poses()))}[
        "images without pose"
    ]
    assert finding.status is status
    assert f"{without} of {80 + without} images" in finding.says


def test_a_camera_that_stops_early_is_told():
    whole = drive(poses(), ("front", "rear"))
    images = [image for image in whole.images if image.camera == "front" or image.stamp_s < 8]
    findings = raised(check_clocks(replace(whole, images=images), motion(poses())))
    assert "misses 51 %" in findings["camera span"]


def test_images_farther_apart_than_half_the_roi_are_too_few():
    findings = raised(check_clocks(drive(poses(), every=20), motion(poses())))
    assert "5.0 m apart and the ROI is 7.0 m deep" in findings["image spacing"]


def test_the_unit_of_stamps_is_named():
    seconds = np.arange(0.0, 20.0, 0.1)
    for unit, factor in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
        assert f"images' stamps are in {unit}" in why_no_pose(factor * seconds, seconds, 0.5)
        assert f"poses' stamps are in {unit}" in why_no_pose(seconds, factor * seconds, 0.5)
        assert f"all stamps are in {unit}" in why_no_pose(factor * seconds, factor * seconds, 0.5)
    since_1970 = 1.7e9 + seconds
    assert "images' stamps are in nanoseconds" in why_no_pose(1e9 * since_1970, since_1970, 0.5)


def test_another_epoch_is_told_from_another_unit():
    seconds = np.arange(0.0, 20.0, 0.1)
    assert "1700000000 s later" in why_no_pose(seconds, 1.7e9 + seconds, 0.5)
    assert "1 s apart, more than max_gap_s 0.5" in why_no_pose(seconds + 0.05, np.arange(0.0, 20.0), 0.5)


def test_images_of_a_moving_camera_pass(tmp_path):
    findings = check_images(pictured(tmp_path, noisy))
    assert {finding.check for finding in findings} == {"frozen images", "bright images", "dark images"}
    assert not raised(findings)


def test_a_camera_that_freezes_is_told(tmp_path):
    findings = raised(check_images(pictured(tmp_path, lambda k: noisy(min(k, 4)))))
    assert "50 % of the images repeat the one before" in findings["frozen images"]
    assert "first at 2.50 s" in findings["frozen images"]


def test_a_frozen_picture_is_told_although_its_files_differ(tmp_path):
    def encoded_anew(k):
        image = noisy(0)
        image[0, 0] = k
        return image

    assert "100 %" in raised(check_images(pictured(tmp_path, encoded_anew)))["frozen images"]


@pytest.mark.parametrize(
    ("rows", "grey", "told"),
    [
        (slice(360, None), 255, ["bright images"]),
        (slice(360, None), 2, ["dark images"]),
        (slice(150), 255, []),
    ],
    ids=["bright road", "dark road", "white sky"],
)
def test_road_that_is_clipped_is_told_and_a_white_sky_is_none(rows, grey, told, tmp_path):
    def clipped(k):
        image = noisy(k)
        image[rows] = grey
        return image

    assert list(raised(check_images(pictured(tmp_path, clipped)))) == told


def test_one_list_of_images_for_two_cameras_is_told(tmp_path):
    front_alone = pictured(tmp_path, noisy)
    rear = [replace(image, camera="rear") for image in front_alone.images]
    of_both = replace(
        front_alone,
        images=[*front_alone.images, *rear],
        cameras={**front_alone.cameras, "rear": front_alone.cameras["front"]},
    )
    assert "those of camera 'front' given twice" in raised(check_images(of_both))["own images"]


Spoil = Callable[[Camera], Camera]


def roi(change):
    return lambda described: replace(described, roi_vehicle=change(described.roi_vehicle))


def survey(xyz):
    return lambda described: replace(described, centre_prior=CentrePrior(xyz, np.full(3, 0.02)))


WRONG: dict[str, tuple[Spoil, str, str]] = {
    "K of half the size": (
        lambda c: with_k(c, fx=450, fy=450, cx=319.5, cy=179.5), "principal point", "about 640 x 360",
    ),
    "principal point": (lambda c: with_k(c, cx=400.0), "principal point", "19 % of the width"),
    "focal in mm": (lambda c: with_k(c, fx=4.5, fy=4.5), "focal length", "not in mm"),
    "fx": (lambda c: with_k(c, fx=945.0), "square pixels", "945 and fy 900 differ by 5 %"),
    "fx and fy": (
        lambda c: with_k(c, fx=945.0, fy=945.0), "ipm against camera matrix", "most in the focal length",
    ),
    "cx of the IPM": (lambda c: with_k(c, cx=730.0), "ipm against camera matrix", "in the principal point"),
    "ROI behind": (roi(np.negative), "roi", "behind the camera"),
    "ROI aside": (roi(lambda points: points + np.array([0, 30])), "roi", "only 0 % of roi_vehicle"),
    "ROI tiny": (roi(lambda points: 0.05 * points + np.array([9, 0])), "roi", "enlarge it"),
    "ROI far": (roi(lambda points: points * [5, 1]), "roi range", "reaches 68 m"),
    "survey sign": (survey(CENTRE * [-1, 1, 1]), "survey against guess", "its x has the wrong sign"),
    "survey swapped": (survey(CENTRE[[1, 0, 2]]), "survey against guess", "x and y are swapped"),
    "survey in mm": (survey(1e3 * CENTRE), "survey against guess", "in millimetres"),
    "survey in feet": (survey(CENTRE / 0.3048), "survey against guess", "in feet"),
    "survey elsewhere": (survey(CENTRE + np.array([3, 0, 0])), "survey against guess", "by +3.0, "),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_camera_is_told(name):
    spoil, check, says = WRONG[name]
    findings = raised(check_camera("front", spoil(camera())))
    assert says in findings[check]


def test_a_guess_borrowed_from_a_sister_vehicle_is_fine():
    borrowed = camera(pitch_deg=20.0, centre=CENTRE + np.array([0.3, -0.2, 0.3]))
    assert not raised(check_camera("front", borrowed))


@pytest.mark.parametrize("factor", [20, 0.05])
def test_a_guess_at_no_vehicle_s_height_is_told(factor):
    assert "camera height" in raised(check_camera("front", camera(centre=CENTRE * [1, 1, factor])))


def test_a_camera_without_survey_is_checked_without():
    findings = check_camera("front", replace(camera(), centre_prior=None))
    assert "survey against guess" not in {finding.check for finding in findings}
    assert not raised(findings)
