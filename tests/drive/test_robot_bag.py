"""The bag of a robot with all of its topics: what it asks, and that one answer makes a drive of it."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from tests.drive.bags import assert_same_poses, messages_of, write_ros1, write_ros2
from tests.drive.test_frames import AXLE_M, at, composed, tree_of
from v2hdm.cli.main import run
from v2hdm.errors import DriveError
from v2hdm.geometry.ipm import initial_extrinsic
from v2hdm.geometry.rigid import inverse
from v2hdm.io.calibration.reading import info_of
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.io.drive.draft import draft_drive

pytestmark = pytest.mark.usefixtures("working_directory")

PREFIX = "tractor_07/"


def robot(folder, infos="none", ros1=False, footprint=False):
    """All topics of a robot with two cameras on a roof bar: ``infos`` are none, or uncalibrated."""
    messages = messages_of(folder, ros1=ros1, fixed_frames=False)
    tree = tree_of(PREFIX, footprint)
    rows = []
    for stamp_s, topic, message in messages.rows:
        if topic == "/odom":
            message.header.frame_id = f"{PREFIX}map"
            message.child_frame_id = f"{PREFIX}base_link"
            rows.append((stamp_s, "/tractor_07/odometry/global", message))
            for number, (decoy, parent) in enumerate({"wheel/odom": "odom", "imu/odometry": "map"}.items()):
                pose = messages.odometry(
                    stamp_s, at(number, 0.1 * stamp_s, 0), np.zeros(36), f"{PREFIX}base_link"
                )
                pose.header.frame_id = f"{PREFIX}{parent}"
                rows.append((stamp_s, f"/tractor_07/{decoy}", pose))
            fix = messages.fix(stamp_s, (29.95, 122.05, 12.0), 0, 1.5, f"{PREFIX}gps")
            rows.append((stamp_s, "/tractor_07/gps/fix", fix))
            continue
        camera = topic.split("/")[2]
        message.header.frame_id = f"{PREFIX}{camera}_optical"
        named = topic.replace("/sensing", "/tractor_07/sensors")
        if topic.endswith("camera_info"):
            if infos == "uncalibrated":
                setattr(message, "K" if ros1 else "k", np.zeros(9))
                rows.append((stamp_s, named, message))
            continue
        rows.append((stamp_s, named, message))
        rows.append((stamp_s, named.replace("image_raw", "image_rect"), message))
        depth = messages.raw_image(stamp_s, np.zeros((8, 16), np.uint8), "16UC1", f"{PREFIX}{camera}_depth")
        depth.width = 8
        rows.append((stamp_s, f"/tractor_07/sensors/{camera}/depth/image_raw", depth))
    first_s = rows[0][0]
    rows.append((first_s, "/tf_static", messages.transforms(first_s, tree)))
    messages.rows = sorted(rows, key=lambda row: row[0])
    return messages, tree


@pytest.mark.parametrize("ros1", [False, True])
@pytest.mark.parametrize("infos", ["none", "uncalibrated"])
def test_a_robot_s_bag_asks_once_for_what_it_lacks(infos, ros1, folder, tmp_path, capsys):
    messages, tree = robot(folder, infos, ros1)
    bag = write_ros1(tmp_path / "site", messages) if ros1 else write_ros2(tmp_path / "site", messages)
    check = ["check", str(bag), "--no-ground", "--output", "out", "--write", "drive"]
    assert run(check) == 2
    error = capsys.readouterr().err
    keys = [f"cameras.{name}.camera_info" for name in ("front", "rear")]
    assert re.findall(r"--set (\S+)=", error) == keys
    assert ("(K is zero)" in error) == (infos == "uncalibrated")
    answers = [f"{key}={folder / key.split('.')[1] / 'camera_info.yaml'}" for key in keys]
    assert run([*check, "--set", *answers, f"vehicle_frame_height_m={AXLE_M}"]) in (0, 3)
    drive = read_drive("drive")
    content = yaml.safe_load((tmp_path / "drive" / "drive.yaml").read_text())
    assert content["poses"]["topic"] == "/tractor_07/odometry/global"
    assert content["vehicle_frame"] == f"{PREFIX}base_link"
    assert list(drive.cameras) == ["front", "rear"]
    for name, camera in drive.cameras.items():
        optical = f"{PREFIX}{name}_optical"
        base_from_cam = composed(tree, f"{PREFIX}base_link", optical)
        got = inverse(np.array(initial_extrinsic(camera)))
        np.testing.assert_allclose(got, at(0, 0, AXLE_M) @ base_from_cam, atol=1e-6)
        assert (camera.frames.camera, camera.frames.problem) == (optical, "")
        assert camera.frames.steps


def test_what_was_decided_is_said_and_the_height_that_nothing_states(folder, tmp_path, caplog):
    caplog.set_level("INFO", "v2hdm.io")
    messages, _ = robot(folder)
    missing = draft_drive(write_ros2(tmp_path / "site", messages), tmp_path / "drive", [])
    assert len(missing) == 2
    for words in (
        "/front/image_rect left out: rectified images of the same sensor as /tractor_07/sensors/front/",
        "poses of /tractor_07/odometry/global (Odometry",
        "/tractor_07/wheel/odom (Odometry, 10 Hz, in tractor_07/odom",
        "tractor_07/base_link is taken to be on the ground; else also set vehicle_frame_height_m",
    ):
        assert words in caplog.text


def test_a_footprint_says_the_height_and_nothing_asks_for_it(folder, tmp_path, caplog):
    caplog.set_level("INFO", "v2hdm.io")
    messages, _ = robot(folder, footprint=True)
    draft_drive(write_ros2(tmp_path / "site", messages), tmp_path / "drive", [])
    assert "is taken to be on the ground" not in caplog.text


def test_all_that_a_bag_lacks_is_asked_for_at_once_with_what_it_offers(folder, tmp_path):
    """Two antennas that are equals, no heading, intrinsics of another size, frames that nothing leads to."""
    messages = messages_of(folder, fixed_frames=False)
    rows = []
    for stamp_s, topic, message in messages.rows:
        if topic == "/odom":
            place = (29.95 + 1e-6 * stamp_s, 122.05, 12.0)
            rows += [
                (stamp_s, f"/{end}/fix", messages.fix(stamp_s, place, 2, 0.02, end))
                for end in ("bow", "stern")
            ]
        elif topic.endswith("camera_info"):
            rows.append((stamp_s, f"/calibration{topic}", message))
        else:
            message.header.frame_id = "usb_cam"
            rows.append((stamp_s, topic, message))
    edges = {("base_link", "lidar"): at(0, 0, 1), ("base_link", "gnss_antenna"): at(1.5, 0, 2)}
    rows.append((rows[0][0], "/tf_static", messages.transforms(rows[0][0], edges)))
    messages.rows = sorted(rows, key=lambda row: row[0])
    bag = write_ros2(tmp_path / "site", messages)
    missing = draft_drive(bag, tmp_path / "drive", [])
    cameras = [f"cameras.{name}.{key}" for name in ("front", "rear") for key in ("camera_info", "mounting")]
    of_poses = ["poses.topic", "poses.heading_topic", "poses.lever_arm_m"]
    assert list(missing) == [*of_poses, *cameras]
    assert "/bow/fix (NavSatFix" in missing["poses.topic"]
    assert missing["poses.heading_topic"].startswith(
        "the topic of headings, such as /imu; the bag has none; "
    )
    assert re.match(
        r"for /bow/fix: position of 'bow' .*; for /stern/fix: position of 'stern' ",
        missing["poses.lever_arm_m"],
    )
    assert "/stern/fix" in missing["poses.topic"]
    assert "/calibration/sensing/front/camera_info" in missing["cameras.front.camera_info"]
    again = draft_drive(bag, tmp_path / "drive", ["poses.topic=/bow/fix"])
    assert list(again) == [*of_poses[1:], *cameras], "nothing is asked that was not asked before"
    assert "position of 'bow'" in again["poses.lever_arm_m"]
    assert "gnss_antenna is at [1.5, 0.0, 2.0]" in again["poses.lever_arm_m"]
    with pytest.raises(DriveError, match="no poses on /none; it has: /bow/fix, /stern/fix"):
        draft_drive(bag, tmp_path / "drive", ["poses.topic=/none"])


def test_one_antenna_is_one_question_and_its_gyro_is_found(folder, tmp_path):
    messages = messages_of(folder)
    rows = []
    for stamp_s, topic, message in messages.rows:
        if topic == "/odom":
            place = (29.95 + 1e-6 * stamp_s, 122.05, 12.0)
            rows.append((stamp_s, "/fix", messages.fix(stamp_s, place, 2, 0.02, "gnss")))
            imu = messages.imu(stamp_s, np.eye(3), "imu")
            imu.orientation_covariance[0] = -1
            rows.append((stamp_s, "/imu", imu))
        else:
            rows.append((stamp_s, topic, message))
    messages.rows = rows
    bag = write_ros2(tmp_path / "site", messages)
    missing = draft_drive(bag, tmp_path / "drive", [])
    about_heading = [key for key in missing if "heading" in key or "gyro" in key]
    assert about_heading == ["poses.heading_topic"]
    assert "/imu (Imu, 10 Hz, it measures no orientation)" in missing["poses.heading_topic"]
    assert "--set poses.heading=course" in missing["poses.heading_topic"]
    again = draft_drive(bag, tmp_path / "drive", ["poses.heading=course"])
    assert set(again) - set(missing) == {"poses.mounting_rpy_deg"}
    assert "of the gyro 'imu'" in again["poses.mounting_rpy_deg"]
    assert "poses.heading_topic" not in again


def test_what_one_topic_of_poses_alone_needs_is_asked_for_together_with_the_topic(folder, tmp_path):
    """Odometry of the vehicle's frame, and the same as poses that do not say of which frame they are."""
    messages = messages_of(folder)
    for stamp_s, topic, message in list(messages.rows):
        if topic == "/odom":
            pose = messages.make(
                "geometry_msgs/msg/PoseStamped", header=message.header, pose=message.pose.pose
            )
            messages.add(stamp_s, "/fused", pose)
    bag = write_ros2(tmp_path / "site", messages)
    missing = draft_drive(bag, tmp_path / "drive", [])
    assert list(missing) == ["poses.topic", "poses.lever_arm_m"]
    assert missing["poses.lever_arm_m"].startswith("for /fused: /fused does not say of which frame its poses")
    assert not draft_drive(bag, tmp_path / "drive", ["poses.topic=/fused", "poses.lever_arm_m=[0, 0, 0]"])
    assert not draft_drive(bag, tmp_path / "other", ["poses.topic=/odom"])


def test_poses_of_a_file_go_with_the_images_of_a_bag(folder, tmp_path):
    messages = messages_of(folder)
    messages.rows = [row for row in messages.rows if row[1] != "/odom"]
    bag = write_ros2(tmp_path / "site", messages)
    assert list(draft_drive(bag, tmp_path / "drive", [])) == ["poses.topic"]
    assert not draft_drive(bag, tmp_path / "drive", [f"poses.tum={folder / 'poses.tum'}"])
    assert_same_poses(read_drive("drive", ReadOptions(cache="cache")), read_drive(folder))


def lens(model, distortion=(0.1, 0.0, 0.0, 0.0), width=1280):
    roi = SimpleNamespace(width=0, height=0)
    return SimpleNamespace(
        k=[900.0, 0, 640, 0, 900, 360, 0, 0, 1], d=list(distortion), distortion_model=model, width=width,
        height=720, binning_x=0, binning_y=0, roi=roi,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("stated", "model"),
    [("", "plumb_bob"), ("plumb_bob", "plumb_bob"), ("Brown Conrady", "plumb_bob"), ("none", "plumb_bob"),
     ("radtan", "plumb_bob"), ("rational_polynomial", "rational_polynomial"), ("fisheye", "equidistant"),
     ("equidistant", "equidistant"), ("kannala_brandt4", "equidistant"), ("Kannala-Brandt4", "equidistant")],
)  # fmt: skip
def test_lenses_are_known_by_the_names_that_drivers_have_for_them(stated, model):
    assert info_of(lens(stated), "front", "here").info.distortion_model == model


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        (lens("double_sphere"), "unknown distortion_model 'double_sphere'; give camera_info as a file"),
        (lens("thin_prism_fisheye"), "unknown distortion_model"),
        (lens("kannala_brandt8", [0.1] * 8), "unknown distortion_model"),
        (lens("plumb_bob", width=0), "states no size"),
    ],
)
def test_a_lens_that_cannot_be_used_is_named(fields, why):
    with pytest.raises(DriveError, match=why):
        info_of(fields, "front", "here")
