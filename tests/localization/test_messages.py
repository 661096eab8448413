"""Poses and odometry as messages of ROS 2, made and read without ROS."""

import importlib.util
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from tests.drive.bags import ROS2, Messages
from tests.localization.driven import cameras, drive, mapped, yard
from v2hdm.errors import DriveError
from v2hdm.geometry.rigid import rotation_from_quaternion
from v2hdm.localization.localizer import Localizer
from v2hdm.localization.messages import fix_of, motion_of, pose_bag, pose_message, status_message
from v2hdm.localization.pose import Status

NODE = Path(__file__).parents[2] / "examples" / "ros2" / "localizer_node.py"


def make(kind, **fields):
    return ROS2.types[kind](**fields)


@pytest.fixture(scope="module")
def poses():
    painted = yard(20)
    driven = drive(painted, 20, seconds=2.0)
    localizer = Localizer(mapped(painted, 20), driven.calibrations, driven.rough(np.random.default_rng(0)))
    return [
        localizer.update(looks, motion) for looks, motion in zip(driven.looks, driven.motion, strict=True)
    ]


def odometry(stamp_s, speed, rate, messages=None):
    messages = messages or Messages()
    vector = lambda x, y, z: make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)  # noqa: E731
    twist = make("geometry_msgs/msg/Twist", linear=vector(speed, 0.0, 0.0), angular=vector(0.0, 0.0, rate))
    return SimpleNamespace(header=messages.header(stamp_s, "base_link"), twist=SimpleNamespace(twist=twist))


def test_an_odometry_is_a_speed_and_a_yaw_rate_whether_its_twist_has_a_covariance_or_not():
    message = odometry(12.5, 4.0, 0.1)
    assert motion_of(message) == (12.5, 4.0, 0.1)
    plain = SimpleNamespace(header=message.header, twist=message.twist.twist)
    assert motion_of(plain) == (12.5, 4.0, 0.1)


def test_a_tracked_pose_is_the_message_of_its_numbers(poses):
    pose = poses[-1]
    assert pose.status == Status.TRACKING
    message = pose_message(pose, make)
    again = ROS2.deserialize_cdr(ROS2.serialize_cdr(message, message.__msgtype__), message.__msgtype__)
    at = again.pose.pose
    turn = at.orientation
    rotation = rotation_from_quaternion(np.array([[turn.x, turn.y, turn.z, turn.w]]))[0]
    np.testing.assert_allclose(rotation, pose.map_from_vehicle[:3, :3], atol=1e-12)
    assert [at.position.x, at.position.y] == pytest.approx(pose.map_from_vehicle[:2, 3])
    covariance = again.pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(covariance[np.ix_([0, 1, 5], [0, 1, 5])], pose.covariance)
    fix = fix_of(again)
    assert fix.place_map == pytest.approx(pose.map_from_vehicle[:2, 3])
    assert fix.stamp_s == pytest.approx(pose.stamp_s)


def test_a_pose_that_is_not_tracked_misleads_nobody_who_looks_at_its_covariance_alone(poses):
    unsure = next(
        pose for pose in poses if pose.map_from_vehicle is not None and pose.status != Status.TRACKING
    )
    covariance = pose_message(unsure, make).pose.covariance.reshape(6, 6)
    assert (np.diag(covariance) > 1e5).all()
    assert json.loads(status_message(unsure, make).data)["status"] == "initialising"


def test_an_mcap_holds_every_pose_and_status(poses, tmp_path):
    with pose_bag(tmp_path / "bag") as write:
        for pose in poses:
            write(pose)
    with Reader(tmp_path / "bag") as reader:
        topics = [connection.topic for connection, _, _ in reader.messages()]
    assert topics.count("/v2hdm/status") == len(poses)
    assert topics.count("/v2hdm/pose") == sum(pose.map_from_vehicle is not None for pose in poses)
    with pytest.raises(DriveError, match="exists; give another --mcap"), pose_bag(tmp_path / "bag"):
        pass


def test_the_node_answers_images_with_poses(monkeypatch):
    specification = importlib.util.spec_from_file_location("localizer_node", NODE)
    node = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(node)
    monkeypatch.setattr(node, "make", make)
    painted = yard(21)
    driven = drive(painted, 21, seconds=2.0)
    place = node.Place.__new__(node.Place)
    place.localizer = Localizer(mapped(painted, 21), cameras(), driven.rough(np.random.default_rng(0)))
    received = {}

    class Road:
        def detect(self, pixels, regions_px=None):
            markings = [SimpleNamespace(image=marking) for marking in received["look"].markings]
            return SimpleNamespace(markings=markings, lanes=[], is_whole=regions_px is None)

    place.roads = {name: Road() for name in cameras()}
    for looks, motion in zip(driven.looks, driven.motion, strict=True):
        for sample in motion:
            place.moved(odometry(*(float(value) for value in sample)))
        for look in looks:
            received["look"] = look
            answers = dict(place.saw(look.camera, Messages().header(look.stamp_s, "").stamp, None))
    assert json.loads(answers["status"].data)["status"] == "tracking"
    at = answers["pose"].pose.pose.position
    assert np.hypot(at.x - driven.poses[-1, 0, 3], at.y - driven.poses[-1, 1, 3]) < 0.05
