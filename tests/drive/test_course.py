"""Headings of one antenna and a gyro, against drives whose truth is integrated here."""

import logging
from typing import NamedTuple

import numpy as np
import pytest

from v2hdm.errors import DriveError
from v2hdm.io.importers.course.headings import course_headings
from v2hdm.io.importers.course.recording import Turning, course_of
from v2hdm.io.importers.poses import read_poses

LEVER_M = np.array([1.2, -0.3])
SIGMA_M = 0.015
BIAS_RAD_S = np.radians(0.01)
FINE_S = 0.01
"""The gyro's interval, and that of the integration."""


class Drive(NamedTuple):
    """A drive's truth at the gyro's times."""

    stamp_s: np.ndarray
    axle: np.ndarray
    heading_rad: np.ndarray
    speed_m_s: np.ndarray
    yaw_rate_rad_s: np.ndarray


def driven(*pieces):
    """A drive of pieces (time, speed, curvature): both change within 1 s, linearly, at a piece's begin."""
    speed = np.concatenate([np.full(round(lasts_s / FINE_S), v) for lasts_s, v, _ in pieces])
    curvature = np.concatenate([np.full(round(lasts_s / FINE_S), k) for lasts_s, _, k in pieces])
    window = np.ones(100) / 100
    speed = np.convolve(np.pad(speed, 100, mode="edge"), window, mode="same")[100:-100]
    curvature = np.convolve(np.pad(curvature, 100, mode="edge"), window, mode="same")[100:-100]
    yaw_rate = speed * curvature
    heading = 0.3 + np.concatenate([[0], np.cumsum(0.5 * (yaw_rate[1:] + yaw_rate[:-1])) * FINE_S])
    velocity = speed[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    axle = np.concatenate([[[0, 0]], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]), axis=0) * FINE_S])
    return Drive(FINE_S * np.arange(len(speed)), axle, heading, speed, yaw_rate)


def antenna_of(drive, rng, lever_m=LEVER_M):
    """The rows of 10 Hz, and the antenna there, with noise half of which drifts over 30 m."""
    rows = np.arange(0, len(drive.stamp_s), 10)
    cosine, sine = np.cos(drive.heading_rad[rows]), np.sin(drive.heading_rad[rows])
    x, y = lever_m
    antenna = drive.axle[rows] + np.column_stack([cosine * x - sine * y, sine * x + cosine * y])
    way = np.linalg.norm(np.diff(drive.axle[rows], axis=0, prepend=drive.axle[:1]), axis=1)
    drift = np.zeros((len(rows), 2))
    drift[0] = rng.normal(size=2)
    for row in range(1, len(rows)):
        memory = np.exp(-max(way[row], 0.01) / 30)
        drift[row] = memory * drift[row - 1] + np.sqrt(1 - memory**2) * rng.normal(size=2)
    noise = np.sqrt(0.5) * SIGMA_M * (drift + rng.normal(size=drift.shape))
    return rows, antenna + noise


def gyro_of(drive, rng, scale=1.0):
    noise = np.radians(0.01) / np.sqrt(FINE_S) * rng.normal(size=len(drive.stamp_s))
    rate = scale * (drive.yaw_rate_rad_s + BIAS_RAD_S + noise)
    return Turning(drive.stamp_s, rate, np.full(len(rate), np.nan))


def headings(drive, seed=0, lever_m=LEVER_M, gyro=True, starts=None, scale=1.0, speed=None):
    """The headings' errors, rad, and what they say of themselves."""
    rng = np.random.default_rng(seed)
    rows, antenna = antenna_of(drive, rng)
    turning = gyro_of(drive, rng, scale) if gyro else None
    if speed is not None:
        turning = Turning(drive.stamp_s, np.full(len(drive.stamp_s), np.nan), speed)
    course = course_of(
        drive.stamp_s[rows], antenna, np.full(len(rows), SIGMA_M), np.asarray(lever_m), turning, "log"
    )
    got = course_headings(course, starts, "log")
    error = got.heading_rad - drive.heading_rad[rows]
    return (error + np.pi) % (2 * np.pi) - np.pi, got


YARD = driven((8, 4, 0), (6, 3, 0.1), (8, 5, 0), (6, 3, -0.12), (4, 0, 0), (8, 4, 0))
STRAIGHT = driven((30, 5, 0))
SHUNTED = driven((10, 4, 0), (6, 3, 0.1), (4, 0, 0.05), (8, -2, -0.1), (3, 0, 0), (15, 4, 0.03))


@pytest.mark.parametrize(
    ("drive", "rmse_deg"),
    [(YARD, 0.15), (STRAIGHT, 0.15), (SHUNTED, 0.15)],
    ids=["yard", "straight", "shunted"],
)
def test_with_a_gyro_headings_are_within_three_of_their_sigmas(drive, rmse_deg):
    for seed in range(3):
        error, got = headings(drive, seed)
        assert np.abs(error).max() < 3.5 * got.noise["heading_rad"]
        assert np.degrees(np.sqrt(np.mean(error**2))) < rmse_deg


@pytest.mark.parametrize("drive", [YARD, STRAIGHT, SHUNTED], ids=["yard", "straight", "shunted"])
def test_without_a_gyro_headings_are_less_sure_and_say_so(drive):
    error, got = headings(drive, gyro=False)
    _, better = headings(drive)
    rmse = np.sqrt(np.mean(error**2))
    assert rmse < 2 * got.noise["heading_rad"]
    assert np.degrees(rmse) < 1.5
    assert got.noise["heading_rad"] > better.noise["heading_rad"]


def test_a_standing_vehicle_keeps_its_heading():
    drive = driven((10, 4, 0.02), (60, 0, 0.02), (10, 4, 0.02))
    error, got = headings(drive)
    stands = np.abs(drive.speed_m_s[::10]) < 1e-6
    assert np.ptp(got.heading_rad[stands]) < np.radians(0.1)
    assert np.degrees(np.abs(error).max()) < 0.6


def test_most_of_the_way_is_taken_as_forward():
    backed_out = driven((8, -2, 0.1), (3, 0, 0), (20, 5, 0.02), (6, 4, 0.1), (10, 5, 0))
    error, _ = headings(backed_out)
    assert np.degrees(np.abs(error).max()) < 1
    error, _ = headings(backed_out, gyro=False)
    assert np.abs(error).max() < np.radians(20)


def test_a_drive_backward_is_asked_for_and_believed():
    backward = driven((10, -4, 0), (6, -3, 0.1), (8, -4, 0), (6, -3, -0.1))
    with pytest.raises(
        DriveError, match=r"swings as if the vehicle drove backward.*add starts: backward; if not"
    ):
        headings(backward)
    error, _ = headings(backward, starts="backward")
    assert np.degrees(np.abs(error).max()) < 1
    error, _ = headings(backward, gyro=False, speed=backward.speed_m_s)
    assert np.degrees(np.sqrt(np.mean(error**2))) < 1.5


def test_an_antenna_that_is_elsewhere_is_named(caplog):
    drive = driven((8, 4, 0), (6, 2, 0.1), (8, 5, 0), (6, 4, -0.08), (8, 4, 0), (8, 1.5, 0.15))
    with caplog.at_level(logging.WARNING):
        error, got = headings(drive, lever_m=LEVER_M - [0.6, 0])
    assert "farther ahead than lever_arm_m says" in caplog.text
    assert got.lever_ahead_m == pytest.approx(LEVER_M[0], abs=0.2)
    assert np.degrees(np.sqrt(np.mean(error**2))) < 0.5
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        headings(drive)
    assert not caplog.records


@pytest.mark.parametrize(
    ("scale", "says"),
    [
        (np.degrees(1), "in deg/s"),
        (np.radians(1), "in rad/s; name it yaw_rate_rad_s"),
        (-1, "its z axis points down"),
        (0.3, "check its axis, unit and clock"),
    ],
)
def test_a_gyro_of_another_unit_or_axis_is_refused(scale, says):
    with pytest.raises(DriveError, match=says):
        headings(YARD, scale=scale)


def test_a_standing_vehicle_has_no_course():
    with pytest.raises(DriveError, match="a vehicle that stands has no course"):
        headings(driven((30, 0, 0)))


def test_a_turn_that_nobody_saw_is_asked_for():
    turned = driven((10, 4, 0), (12, 0.5, 0.26), (10, 4, 0))
    rows, antenna = antenna_of(turned, np.random.default_rng(0))
    is_recorded = (turned.stamp_s[rows] < 10) | (turned.stamp_s[rows] > 21)
    rows, antenna = rows[is_recorded], antenna[is_recorded]
    course = course_of(turned.stamp_s[rows], antenna, np.full(len(rows), SIGMA_M), LEVER_M, None, "log")
    with pytest.raises(
        DriveError, match=r"the course turns by .* where the vehicle stands or positions lack"
    ):
        course_headings(course, None, "log")


def write_log(folder, drive, rate="yaw_rate_rad_s", scale=1.0):
    """Files of positions and of a gyro."""
    rng = np.random.default_rng(1)
    rows, antenna = antenna_of(drive, rng)
    lines = [
        f"{drive.stamp_s[row]:.3f},{x:.4f},{y:.4f},1.8,0.015"
        for row, (x, y) in zip(rows, antenna, strict=True)
    ]
    (folder / "rtk.csv").write_text("\n".join(["stamp_s,x_m,y_m,z_m,sigma_m", *lines]))
    gyro = gyro_of(drive, rng, scale)
    lines = [
        f"{stamp:.3f},{value:.7f}" for stamp, value in zip(gyro.stamp_s, gyro.yaw_rate_rad_s, strict=True)
    ]
    (folder / "imu.csv").write_text("\n".join([f"stamp_s,{rate}", *lines]))
    return rows


def test_a_log_of_one_antenna_becomes_poses_of_the_axle(tmp_path):
    rows = write_log(tmp_path, YARD, "yaw_rate_deg_s", np.degrees(1))
    content = {"csv": "rtk.csv", "heading": "course", "lever_arm_m": [*LEVER_M, 1.8], "gyro_file": "imu.csv"}
    recorded = read_poses(content, tmp_path, None, 0.5, "poses", None)
    poses = recorded.trajectory.map_from_vehicle
    off_m = np.linalg.norm(poses[:, :2, 3] - YARD.axle[rows], axis=1)
    assert np.sqrt(np.mean(off_m**2)) < 2 * SIGMA_M
    assert np.abs(poses[:, 2, 3]).max() < 1e-9
    assert recorded.noise["heading_drift_rad"] < recorded.noise["heading_rad"] < np.radians(0.2)
    assert recorded.noise["position_m"] == pytest.approx(SIGMA_M)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"lever_arm_m": None}, "needs lever_arm_m"),
        ({"heading": None}, "gyro_file: only with heading: course"),
        ({"starts": "north"}, "starts: "),
        ({"gyro_file": "rtk.csv"}, "rtk.csv: needs a column yaw_rate_rad_s or yaw_rate_deg_s"),
        (
            {"gyro_file": {"csv": "imu.csv", "offset_s": 1e4}},
            "the gyro's times .* are not those of the positions",
        ),
    ],
)
def test_what_a_course_lacks_is_said_in_one_line(change, says, tmp_path):
    write_log(tmp_path, STRAIGHT)
    content = {"csv": "rtk.csv", "heading": "course", "lever_arm_m": [*LEVER_M, 1.8], "gyro_file": "imu.csv"}
    content = {key: value for key, value in (content | change).items() if value is not None}
    with pytest.raises(DriveError, match=says) as caught:
        read_poses(content, tmp_path, None, 0.5, "poses", None)
    assert "\n" not in str(caught.value)
