"""A vehicle finds itself in a map as it drives, and says when it cannot."""

import io
import json
import queue
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from tests.localization.driven import MOUNT, cameras, drive, follow, lined, mapped, moved, tracked, yard
from v2hdm.cli.main import run
from v2hdm.detection.frames import Frame
from v2hdm.detection.road import Road, RoadLane, RoadMarking, as_record
from v2hdm.errors import ConfigError, MapFileError
from v2hdm.geometry.rigid import exp
from v2hdm.io.calibration.writing import write_calibration
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.localization import belief, live
from v2hdm.localization.antenna import Fix
from v2hdm.localization.localizer import Localizer
from v2hdm.localization.motion import Motion, MotionLog, MotionNoise
from v2hdm.localization.pose import Status
from v2hdm.localization.seeing import Look, expect
from v2hdm.localization.stream import MotionLines, look_of, pose_record
from v2hdm.records import Calibration, GeodeticOrigin, HDMap, Marking, MarkingDetection


def first_said(poses):
    """The first moment with a reason."""
    return next((k for k, pose in enumerate(poses) if pose.reasons), None)


@pytest.mark.parametrize("seed", range(3))
def test_a_vehicle_that_knows_its_place_to_5_m_and_20_deg_finds_itself_to_centimetres(seed):
    painted = yard(seed)
    driven = drive(painted, seed)
    poses = follow(driven, mapped(painted, seed), seed)
    errors, bounds = tracked(driven, poses)
    assert len(errors) > 0.75 * len(poses)
    assert np.sqrt((errors[:, :2] ** 2).mean(axis=0)).max() < 0.03
    assert np.degrees(np.sqrt((errors[:, 2] ** 2).mean())) < 0.1
    assert (np.abs(errors) < bounds).all()
    assert poses[-1].motion[0] == pytest.approx(1 / 1.01, abs=0.004)


def test_the_stated_covariance_holds():
    squared = []
    for seed in range(5):
        painted = yard(seed)
        driven = drive(painted, seed, seconds=3.5)
        poses = follow(driven, mapped(painted, seed), seed)
        for frame in range(14, len(poses), 5):
            if poses[frame].status == Status.TRACKING:
                at = poses[frame].map_from_vehicle[:2, 3] - driven.poses[frame, :2, 3]
                squared.append(at @ np.linalg.solve(poses[frame].covariance[:2, :2], at))
    assert 0.5 < np.mean(squared) < 3.5  # of two coordinates: honest is 2


def test_a_vehicle_that_knows_nothing_finds_itself_by_the_pattern_of_the_markings():
    painted = yard(4)
    driven = drive(painted, 4, begin_m=50.0)
    errors, bounds = tracked(driven, follow(driven, mapped(painted, 4), prior=False))
    assert len(errors) > 30
    assert (np.abs(errors) < bounds).all()


def test_a_vehicle_that_drives_before_its_first_image_is_sought_where_the_odometry_has_brought_it():
    painted = yard(1)
    driven = drive(painted, 1, seconds=16.0)
    localizer = Localizer(mapped(painted, 1), driven.calibrations, driven.rough(np.random.default_rng(0)))
    for frame, (looks, motion) in enumerate(zip(driven.looks, driven.motion, strict=True)):
        pose = localizer.update(looks if frame > 100 else [], motion)
    assert pose.status == Status.TRACKING
    assert (np.abs(driven.errors(pose, frame)[:2]) < pose.protection_m).all()


@pytest.mark.parametrize("seed", range(3))
def test_a_vehicle_that_stands_finds_itself_without_moving(seed):
    painted = yard(seed)
    driven = drive(painted, seed, seconds=2.0, speed=0.0, begin_m=40.0)
    errors, bounds = tracked(driven, follow(driven, mapped(painted, seed), seed))
    assert len(errors) > 5
    assert np.abs(errors[:, :2]).max() < 0.05
    assert (np.abs(errors) < bounds).all()


@pytest.mark.parametrize("speed", [4.0, 0.0])
def test_a_pattern_that_repeats_is_no_place(speed):
    painted = yard(5, diamonds=False)
    driven = drive(painted, 5, begin_m=60.0, seconds=4.0, speed=speed)
    poses = follow(driven, mapped(painted, 5))
    assert not any(pose.status == Status.TRACKING for pose in poses)
    assert all(np.isinf(pose.protection_m).all() for pose in poses)


@pytest.mark.parametrize("seed", range(3))
def test_a_map_of_another_site_is_said_within_a_second_and_never_tracked(seed):
    driven = drive(yard(seed), seed, seconds=4.0)
    poses = follow(driven, mapped(yard(seed + 100), seed))
    assert not any(pose.status == Status.TRACKING for pose in poses)
    assert poses[15].status == Status.LOST
    assert "is it the map of this site" in poses[15].reasons[0]


def test_a_map_whose_site_lies_elsewhere_is_said():
    painted = yard(6)
    driven = drive(painted, 6, seconds=2.0)
    away = HDMap(tuple(Marking(m.kind, m.corners_map + 5000.0, 10) for m in painted.markings))
    poses = follow(driven, away)
    assert poses[-1].status == Status.LOST
    assert any("no marking of the map lies within 60 m" in reason for reason in poses[-1].reasons)


def test_where_half_of_the_markings_were_repainted_it_is_said_within_10_m():
    painted = yard(7)
    driven = drive(painted, 7, seconds=10.0)
    poses = follow(driven, moved(mapped(painted, 7), 0.5, 0.3, beyond_m=32.0))
    errors, bounds = tracked(driven, poses)
    entered = int(np.argmax(driven.poses[:, 0, 3] > 32.0))
    said = first_said(poses[entered:])
    assert said is not None
    assert said < 10 / 4.0 * 10
    assert (np.abs(errors) < bounds).all()


def test_a_camera_that_was_pushed_is_named_and_the_pose_stays_right():
    painted = yard(8)
    turn = np.deg2rad([0.0, 0.5, 0.0])
    driven = drive(painted, 8, turned=("front", 4.0, turn))
    poses = follow(driven, mapped(painted, 8))
    errors, bounds = tracked(driven, poses)
    assert (np.abs(errors) < bounds).all()
    (turned,) = poses[-1].turned
    assert turned.camera == "front"
    assert 3.7 < turned.since_s < 5.0
    assert turned.turn_deg[1] == pytest.approx(0.5, abs=0.1)
    assert not any(pose.turned for pose in poses[:35])


def test_calibrations_of_another_vehicle_give_no_confident_pose():
    painted = yard(9)
    driven = drive(painted, 9, seconds=5.0)
    borrowed = cameras()
    for name, calibration in borrowed.items():
        push = np.array([0.3, 0.1, 0.0, *np.deg2rad([1.5, -1.0, 1.0])])
        borrowed[name] = Calibration(calibration.info, exp(push) @ calibration.cam_from_vehicle, MOUNT)
    poses = follow(driven, mapped(painted, 9), calibrations=borrowed)
    errors, bounds = tracked(driven, poses)
    assert (np.abs(errors) < bounds).all()
    assert first_said(poses) is not None


def test_speeds_in_kilometres_per_hour_are_said():
    painted = yard(10)
    driven = drive(painted, 10, kmh=True)
    poses = follow(driven, mapped(painted, 10))
    assert not any(pose.status == Status.TRACKING for pose in poses[20:])
    assert any("km/h" in reason for reason in poses[-1].reasons)


def test_yaw_rates_in_degrees_are_said():
    localizer = Localizer(yard(0), cameras())
    pose = localizer.update([], [Motion(0.1 * k, 4.0, 12.0) for k in range(5)])
    assert "5 samples of the odometry are impossible for a road vehicle" in pose.reasons[0]


def test_images_in_another_order_give_the_same_pose():
    painted = yard(11)
    driven = drive(painted, 11, seconds=5.0)
    hd_map = mapped(painted, 11)
    in_order = follow(driven, hd_map, seed=1)[-1]
    localizer = Localizer(hd_map, driven.calibrations, driven.rough(np.random.default_rng(1)))
    late = []
    for looks, motion in zip(driven.looks[:-2], driven.motion[:-2], strict=True):
        # The rear camera's images come two moments late.
        late.append([look for look in looks if look.camera == "rear"])
        now = [look for look in looks if look.camera == "front"]
        localizer.update([*(late.pop(0) if len(late) > 2 else ()), *now], motion)
    late_looks = [look for looks in (*late, *driven.looks[-2:]) for look in looks]
    pose = localizer.update(late_looks, [sample for part in driven.motion[-2:] for sample in part])
    assert pose.status == in_order.status == Status.TRACKING
    np.testing.assert_allclose(pose.map_from_vehicle[:2, 3], in_order.map_from_vehicle[:2, 3], atol=0.01)


def test_without_images_the_pose_is_lost_and_images_bring_it_back():
    painted = yard(12)
    driven = drive(painted, 12, seconds=24.0)
    hd_map = mapped(painted, 12)
    localizer = Localizer(hd_map, driven.calibrations, driven.rough(np.random.default_rng(0)))
    statuses = []
    for frame, (looks, motion) in enumerate(zip(driven.looks, driven.motion, strict=True)):
        gone = 30 < frame < 190
        pose = localizer.update([] if gone else looks, motion)
        statuses.append(pose.status)
        said_missing = any("no image of front has come" in reason for reason in pose.reasons)
        assert said_missing == (41 <= frame < 190)
        if pose.status == Status.TRACKING:
            assert (np.abs(driven.errors(pose, frame)[:2]) < pose.protection_m).all()
    assert statuses[30] == Status.TRACKING
    assert statuses[-1] == Status.TRACKING


def test_images_that_never_come_are_missed():
    localizer = Localizer(yard(12), cameras())
    poses = [localizer.update([], [Motion(0.1 * sample, 0.0, 0.0)]) for sample in range(20)]
    assert not poses[5].reasons
    assert poses[-1].reasons == ("no image has come yet",)
    assert poses[-1].status == Status.INITIALISING


def test_an_image_of_another_clock_is_left_out_with_a_reason():
    painted = yard(13)
    driven = drive(painted, 13, seconds=2.0)
    localizer = Localizer(mapped(painted, 13), driven.calibrations)
    localizer.update(driven.looks[0], driven.motion[0])
    strange = Look("front", 1.7e9, driven.looks[0][0].markings)
    pose = localizer.update([strange], driven.motion[1])
    assert "is it on the same clock" in pose.reasons[0]
    assert pose.stamp_s == driven.motion[1][-1].stamp_s


def test_an_odometry_whose_clock_is_set_back_starts_the_search_anew():
    painted = yard(14)
    driven = drive(painted, 14, seconds=3.0)
    localizer = Localizer(mapped(painted, 14), driven.calibrations, driven.rough(np.random.default_rng(0)))
    for looks, motion in zip(driven.looks, driven.motion, strict=True):
        pose = localizer.update(looks, motion)
    assert pose.status == Status.TRACKING
    pose = localizer.update([], [Motion(-100.0, 4.0, 0.0)])
    assert pose.status == Status.LOST
    assert "clock went back" in pose.reasons[0]


def test_a_position_by_rtk_of_another_datum_is_said_and_not_believed():
    painted = yard(15)
    driven = drive(painted, 15, seconds=3.0)
    localizer = Localizer(mapped(painted, 15), driven.calibrations, driven.rough(np.random.default_rng(0)))
    for frame, (looks, motion) in enumerate(zip(driven.looks, driven.motion, strict=True)):
        fix = Fix(driven.stamp_s[frame], driven.poses[frame, :2, 3] + [1.2, 0.4], 0.02)
        pose = localizer.update(looks, motion, [fix] if frame > 20 else [])
    assert np.hypot(*driven.errors(pose, len(driven.looks) - 1)[:2]) < 0.05
    assert "is the map in its datum" in pose.reasons[0]


def test_a_right_position_by_rtk_is_taken():
    painted = yard(16)
    driven = drive(painted, 16, seconds=3.0)
    localizer = Localizer(mapped(painted, 16), driven.calibrations)
    for frame, (looks, motion) in enumerate(zip(driven.looks, driven.motion, strict=True)):
        fix = Fix(driven.stamp_s[frame], driven.poses[frame, :2, 3], 0.02)
        pose = localizer.update(looks, motion, [fix])
    assert pose.status == Status.TRACKING
    assert pose.reasons == ()


def test_a_map_without_markings_or_cameras_is_refused():
    with pytest.raises(MapFileError, match="no markings"):
        Localizer(HDMap(()), cameras())
    with pytest.raises(MapFileError, match="no camera is calibrated"):
        Localizer(yard(0), {})


def test_the_derivatives_of_expected_pixels_are_those_of_their_differences():
    rng = np.random.default_rng(0)
    calibration = cameras()["front"]
    state = belief.start(0.0, np.array([1.0, 2.0, 0.3]), np.ones(3), [MOUNT], MotionNoise())
    mean = state.mean.copy()
    mean[: belief.VEHICLE] += 0.01 * rng.standard_normal(belief.VEHICLE)
    corners = np.array([[[10, 4, 0.1], [11, 4, 0.1], [11, 5, 0.0], [10, 5, 0.0]]])
    plane = belief.Plane(0.05)
    state = belief.replace(state, mean=mean)
    expected = expect(state, plane, 0, calibration, corners)
    derivative = expected.by_states[0]
    step = 1e-6
    for column in range(len(mean)):
        ends = [
            expect(
                belief.replace(state, mean=mean + by * np.eye(len(mean))[column]),
                plane,
                0,
                calibration,
                corners,
            ).px
            for by in (step, -step)
        ]
        numeric = (ends[0] - ends[1]).reshape(8) / (2 * step)
        np.testing.assert_allclose(derivative[:, column], numeric, rtol=1e-4, atol=0.05)


def test_a_prediction_keeps_the_covariance_that_its_derivative_says():
    rng = np.random.default_rng(1)
    noise = MotionNoise()
    log = MotionLog()
    for k in range(20):
        log.add(Motion(0.05 * k, 4.0 + 0.1 * k, 0.2))
    state = belief.start(0.0, np.array([0.0, 0.0, 0.4]), np.array([0.1, 0.1, 0.02]), [MOUNT], noise)
    samples = state.mean[:5] + (state.root[:5, :5] @ rng.standard_normal((5, 1000))).T
    ends = []
    for sample in samples:
        mean = state.mean.copy()
        mean[:5] = sample
        ends.append(belief.predict(belief.replace(state, mean=mean), log.pieces(0.0, 0.9), noise).mean[:3])
    after = belief.predict(state, log.pieces(0.0, 0.9), noise)
    stated = np.sqrt(np.diag(after.covariance([0, 1, 2])))
    # The noise of the motion itself comes on top of what the start leaves open.
    assert (np.std(ends, axis=0) < 1.1 * stated).all()
    assert (np.std(ends, axis=0) > 0.75 * stated).all()


def test_samples_of_the_odometry_out_of_order_are_put_in_order():
    stamps = [0.0, 0.1, 0.3, 0.2, 0.4]
    log = MotionLog()
    for stamp_s in stamps:
        assert log.add(Motion(stamp_s, 1.0 + stamp_s, 0.0)) is None
    assert log.stamps_s == sorted(stamps)
    assert log.late == 1
    assert sum(piece.length_s * piece.speed_m_s for piece in log.pieces(0.0, 0.4)) == pytest.approx(0.48)


def odometry_log(speed_m_s, yaw_rate_rad_s, seed=0):
    """Two seconds of 50 Hz, with the noise of wheels and gyro."""
    rng = np.random.default_rng(seed)
    log = MotionLog()
    for stamp_s in np.arange(0.0, 2.0, 0.02).tolist():
        speed = speed_m_s(stamp_s) + 0.1 * rng.standard_normal()
        log.add(Motion(stamp_s, speed, yaw_rate_rad_s(stamp_s) + 0.004 * rng.standard_normal()))
    return log


def test_noise_of_an_odometry_is_no_change_of_the_motion():
    changes = [
        (piece.faster_m_s, piece.turning_more_rad_s)
        for seed in range(5)
        for piece in odometry_log(lambda stamp_s: 4.0, lambda stamp_s: 0.0, seed).pieces(0.5, 2.0)
    ]
    assert np.mean(np.array(changes) != 0.0) < 0.01


def test_a_bend_and_a_brake_change_the_motion_by_as_much_as_they_do():
    log = odometry_log(lambda stamp_s: 6.0 - 1.5 * stamp_s, lambda stamp_s: 0.3 * max(stamp_s - 0.5, 0.0))
    pieces = log.pieces(0.8, 1.8)
    assert sum(piece.turning_more_rad_s for piece in pieces) == pytest.approx(0.3, rel=0.05)
    assert sum(piece.faster_m_s for piece in pieces) == pytest.approx(-1.5, rel=0.1)


def test_a_straight_drive_does_not_say_how_late_an_odometry_is():
    """Nor that it is on time, as differences of its noise would."""
    log = odometry_log(lambda stamp_s: 4.0, lambda stamp_s: 0.0)
    state = belief.start(0.5, np.zeros(3), np.full(3, 0.01), [MOUNT], MotionNoise())
    for stamp_s in np.arange(0.6, 1.9, 0.1).tolist():
        state = belief.predict(state, log.pieces(state.stamp_s, stamp_s), MotionNoise())
        place = np.array([4.0 * (stamp_s - 0.5), 0.0, 0.0])
        state = belief.pinned(state, [belief.X, belief.Y, belief.HEADING], place, 1e-3)
    assert state.covariance([belief.LATE])[0, 0] ** 0.5 > 0.04


def test_lines_of_an_odometry_are_json_or_csv_and_may_hold_positions():
    origin = GeodeticOrigin(50.0, 8.0, 100.0)
    lines = MotionLines("drive.jsonl", origin)
    assert lines.read('{"stamp_s": 1, "speed_m_s": 4, "yaw_rate_rad_s": 0.1}') == Motion(1.0, 4.0, 0.1)
    fix = lines.read('{"stamp_s": 1, "latitude_deg": 50.0, "longitude_deg": 8.001, "sigma_m": 0.02}')
    assert fix.place_map == pytest.approx([71.7, 0.0], abs=0.1)
    table = MotionLines("drive.csv", None)
    assert table.read("stamp_s,speed_m_s,yaw_rate_rad_s") is None
    assert table.read("2.5,3,-0.1") == Motion(2.5, 3.0, -0.1)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("{", "line 1: is not a JSON object"),
        ("time,v", "names no motion"),
        ('{"speed": 3}', "give stamp_s, speed_m_s, yaw_rate_rad_s"),
        ('{"stamp_s": 1, "speed_m_s": "fast", "yaw_rate_rad_s": 0}', "speed_m_s is 'fast'; give a number"),
        ('{"stamp_s": 1, "speed_m_s": NaN, "yaw_rate_rad_s": 0}', "speed_m_s is nan; give a number"),
        ('{"stamp_s": 1, "east_m": 1, "north_m": 1, "sigma_m": 0}', "a standard deviation above 0"),
        ('{"stamp_s": 1, "latitude_deg": 1, "longitude_deg": 1, "sigma_m": 1}', "no origin on the earth"),
    ],
)
def test_a_line_that_is_no_motion_is_one_line(line, says):
    with pytest.raises(ConfigError, match=says):
        MotionLines("motion.jsonl", None).read(line)


def test_detections_go_through_their_json_lines():
    driven = drive(lined(yard(17)), 17, seconds=1.0)
    first_look = driven.looks[0][0]
    silent = (np.full((4, 2), np.nan), np.full((8, 8), np.nan), np.zeros(4, bool))
    outline_px = np.array([[500.0, 400.0], [560.0, 400.0], [560.0, 440.0]])
    word = MarkingDetection("text", 0.8, *silent, outline_px, np.array([True, False, True]))
    look = replace(first_look, markings=(*first_look.markings, word))
    nothing = np.empty((0, 2))
    lanes = tuple(RoadLane(lane, nothing, np.empty((0, 2, 2))) for lane in look.lanes)
    road = Road(tuple(RoadMarking(m, nothing, np.empty((0, 0)), nothing) for m in look.markings), lanes)
    frame = Frame("image", "image", 0, look.stamp_s, np.zeros((1, 1, 3), np.uint8))
    again = look_of(json.loads(json.dumps(as_record(frame, "front", road))), "front")
    assert again.stamp_s == look.stamp_s
    for marking, two in zip(look.markings, again.markings, strict=True):
        np.testing.assert_allclose(marking.corners_px, two.corners_px, atol=1e-3)
        np.testing.assert_allclose(marking.covariance_px, two.covariance_px, atol=1e-5)
        np.testing.assert_allclose(marking.outline_px, two.outline_px, atol=1e-3)
        np.testing.assert_array_equal(marking.outline_seen, two.outline_seen)
    for lane, two in zip(look.lanes, again.lanes, strict=True):
        assert lane.kind == two.kind
        np.testing.assert_allclose(lane.points_px, two.points_px, atol=1e-3)


def test_a_line_of_a_pose_is_json_whatever_is_unknown():
    localizer = Localizer(yard(0), cameras())
    pose = localizer.update([], [Motion(1.0, 0.0, 0.0)])
    record = json.loads(json.dumps(pose_record(pose), allow_nan=False))
    assert record["status"] == "initialising"
    assert record["east_m"] is None
    assert record["covariance"] is None


def test_the_localiser_needs_no_more_than_the_base_install():
    absent = "('torch', 'scipy', 'hydra', 'kornia', 'numba', 'matplotlib')"
    program = f"import sys\nfor name in {absent}: sys.modules[name] = None\n"
    program += "import v2hdm.localization.live, v2hdm.localization.stream, v2hdm.localization.localizer"
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr


def test_lines_come_as_images_do_and_end_with_the_cameras(monkeypatch, tmp_path):
    painted = yard(18)
    driven = drive(painted, 18, seconds=2.0)
    localizer = Localizer(mapped(painted, 18), driven.calibrations, driven.rough(np.random.default_rng(0)))
    motion = tmp_path / "odometry.csv"
    rows = [",".join(map(str, sample)) for part in driven.motion for sample in part]
    motion.write_text("\n".join(["stamp_s,speed_m_s,yaw_rate_rad_s", *rows, ""]))
    looks = [look for moment in driven.looks for look in moment]

    @contextmanager
    def camera(name, source, calibration, items, delay_s):
        def play():
            time.sleep(0.2)  # the odometry is read first
            for look in looks:
                if look.camera == name:
                    items.put(look)
                    time.sleep(0.002)
            items.put(live._Ended(name, None))

        threading.Thread(target=play, daemon=True).start()
        yield live._Eye(name, io.StringIO(), delay_s)

    monkeypatch.setattr(live, "_camera", camera)
    poses = []
    files = dict.fromkeys(driven.calibrations, tmp_path)
    sources = dict.fromkeys(driven.calibrations, "folder")
    live.localize_live(localizer, sources, files, motion, MotionLines("odometry", None), poses.append)
    assert poses[-1].status == Status.TRACKING
    assert np.hypot(*driven.errors(poses[-1], len(driven.looks) - 1)[:2]) < 0.05


def test_motions_between_images_make_no_poses_but_without_images_some(monkeypatch, tmp_path):
    """Two seconds of an odometry, of a clock that then is set back."""
    lines = [f"{stamp_s:.2f},4.0,0.0" for stamp_s in (*np.arange(50.0, 52.0, 0.02), 7.0)]
    motion = io.StringIO("\n".join(["stamp_s,speed_m_s,yaw_rate_rad_s", *lines, ""]))

    @contextmanager
    def camera(name, source, calibration, items, delay_s):
        def end():
            time.sleep(0.6)  # the odometry is read first
            items.put(live._Ended(name, None))

        threading.Thread(target=end, daemon=True).start()
        yield live._Eye(name, io.StringIO(), delay_s)

    def one_by_one(waiting, waits):
        yield from [waiting.get(timeout=1.0)]

    monkeypatch.setattr(live, "_camera", camera)
    monkeypatch.setattr(live, "_available", one_by_one)
    poses = []
    sources = {"front": "folder"}
    localizer = Localizer(yard(18), cameras())
    odometry = MotionLines("odometry", None)
    live.localize_live(localizer, sources, {"front": tmp_path}, motion, odometry, poses.append)
    assert 4 <= len(poses) <= 6
    assert any("clock went back" in reason for reason in poses[-1].reasons)


def test_all_that_a_camera_shows_reaches_the_localiser_at_the_time_of_its_exposure():
    look = drive(lined(yard(18)), 18, seconds=1.0).looks[0][0]
    nothing = np.empty((0, 2))
    markings = tuple(RoadMarking(m, nothing, np.empty((0, 0)), nothing) for m in look.markings)
    lanes = tuple(RoadLane(lane, nothing, np.empty((0, 2, 2))) for lane in look.lanes)
    frame = Frame("image", "image", 0, 5.0, np.zeros((1, 1, 3), np.uint8))
    line = json.dumps(as_record(frame, "front", Road(markings, lanes)))
    items = queue.SimpleQueue()
    program = [sys.executable, "-c", f"print({line!r})"]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        live._follow_camera("front", process, items, 0.25)
    read = items.get()
    assert read.stamp_s == 4.75
    assert len(read.markings) == len(look.markings) > 0
    assert len(read.lanes) == len(look.lanes) > 0
    assert items.get() == live._Ended("front", None)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ("--images front", "give a camera's name and its folder"),
        ("--images front=images --every-full 0", "--every-full 0: give a number of images, 1 or more"),
        ("--images side=images", "no calibration of camera 'side'"),
        ("--images front=nowhere", "camera front: --live: nowhere is not a camera's index or a folder"),
    ],
)
def test_sources_that_are_none_are_one_line(arguments, says, tmp_path, capsys):
    write_geojson(yard(0), tmp_path / "map.geojson")
    write_calibration(cameras()["front"], tmp_path / "calibration_front.yaml")
    (tmp_path / "motion.csv").write_text("")
    words = f"localize {tmp_path} --live {arguments} --motion {tmp_path / 'motion.csv'}"
    assert run(words.split()) == 2
    assert says in capsys.readouterr().err
