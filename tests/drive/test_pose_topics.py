"""Which topic of a bag states its poses, and which one its headings, among those that are like it by type."""

import numpy as np
import pytest

from v2hdm.io.importers.bag.positions import Reference, heading_candidates, position_candidates, the_one
from v2hdm.io.importers.bag.samples import PoseSample, Samples

ODOMETRY = "nav_msgs/msg/Odometry"
FIX = "sensor_msgs/msg/NavSatFix"
IMU = "sensor_msgs/msg/Imu"
QUATERNION = "geometry_msgs/msg/QuaternionStamped"


def pose(name, kind=ODOMETRY, parent="", frame="base_link", **more):
    stamps = [100.0 + 0.1 * k for k in range(50)]
    fields = {"moved_m": 40.0, "has_heading": True, "is_turned": True, "messages": 600} | more
    return PoseSample(name=name, kind=kind, frame=frame, parent=parent, stamp_s=stamps, **fields)


def fix(name, sigma_m=0.02, **more):
    return pose(name, FIX, frame="gps", sigma_m=sigma_m, has_heading=False, is_turned=False, **more)


def heading(name, kind=IMU, **more):
    return pose(name, kind, **({"moved_m": np.nan} | more))


def candidates(*poses, linked=("base_link",), imus=True):
    headings = {"/imu": heading("/imu")} if imus else {}
    samples = Samples({}, {}, {}, {sample.name: sample for sample in poses}, headings)
    return position_candidates(samples, 0.1, lambda frame: frame in linked)


CHOSEN = {
    "wheels": ("/odom", [pose("/wheel/odom", parent="odom"), pose("/odom", parent="odom")]),
    "wheels, in a map": ("/odom", [pose("/wheel/odom", parent="map"), pose("/odom", parent="map")]),
    "an IMU's odometry": ("/odom", [pose("/imu/odometry", parent="odom"), pose("/odom", parent="map")]),
    "a camera's": ("/odom", [pose("/visual_odometry"), pose("/vo"), pose("/odom")]),
    "a local filter": ("/odometry/filtered/global", [
        pose("/odometry/filtered/local", parent="odom"), pose("/odometry/filtered/global", parent="map"),
    ]),
    "localization is no local filter": ("/localization/kinematic_state", [
        pose("/localization/kinematic_state", parent="map"), pose("/wheel/odom", parent="map"),
    ]),
    "map against odom": ("/state", [pose("/state", parent="r1/map"), pose("/odom", parent="r1/odom")]),
    "RTK against wheels": ("/fix", [fix("/fix"), pose("/odom", parent="odom")]),
    "a plain fix against a filter": ("/ins/odom", [fix("/fix", 3.0), pose("/ins/odom", parent="map")]),
    "no fix": ("/rtk/fix", [fix("/gps/fix", np.inf), fix("/rtk/fix")]),
    "covariance of 1e6": ("/odom", [pose("/odometry", parent="map", sigma_m=1000.0), pose("/odom")]),
    "no rotations": ("/odom", [pose("/p", parent="map", has_heading=False, is_turned=False), pose("/odom")]),
    "orientation never set": ("/odom", [pose("/odometry/gps", parent="map", is_turned=False), pose("/odom")]),
    "stands still": ("/odom", [pose("/p", parent="map", moved_m=0.0), pose("/odom")]),
    "a goal": ("/odom", [
        pose("/goal_pose", "geometry_msgs/msg/PoseStamped", "map", "", messages=2),
        pose("/odom", parent="odom"),
    ]),
    "another robot": ("/odom", [pose("/r2/odom", parent="map", frame="r2/base_link"), pose("/odom")]),
    "only wheels": ("/wheel/odom", [pose("/wheel/odom", parent="odom")]),
    "only a bad one": ("/odom", [pose("/odom", sigma_m=0.3)]),
}  # fmt: skip


@pytest.mark.parametrize("name", CHOSEN)
def test_the_topic_of_poses_on_the_earth_is_taken_whatever_else_there_is(name):
    topic, poses = CHOSEN[name]
    for order in (poses, poses[::-1]):
        ranked = candidates(*order)
        best = the_one(ranked)
        assert best is not None
        assert best.sample.name == topic
        assert ranked[0] == best, "the list that a question shows begins with it"


@pytest.mark.parametrize(
    "poses",
    [
        [pose("/odom"), pose("/state")],
        [fix("/fix"), pose("/odometry/global", parent="map")],
        [fix("/front/fix"), fix("/rear/fix")],
        [],
    ],
)
def test_equals_are_asked_about(poses):
    assert the_one(candidates(*poses)) is None


def test_an_antenna_s_positions_without_headings_are_no_poses():
    poses = [fix("/fix"), pose("/odom", parent="map")]
    assert the_one(candidates(*poses)) is None
    best = the_one(candidates(*poses, imus=False))
    assert best is not None
    assert best.sample.name == "/odom"


def test_a_candidate_is_named_with_what_tells_it_from_others():
    ranked = candidates(pose("/odom", parent="map"), pose("/wheel/odom", parent="odom"), fix("/fix", 3.0))
    said = [candidate.about for candidate in ranked]
    assert said == [
        "/odom (Odometry, 10 Hz, in map)",
        "/wheel/odom (Odometry, 10 Hz, in odom)",
        "/fix (NavSatFix, 10 Hz, sigma 3 m, more than 0.1 m)",
    ]
    assert [candidate.reference for candidate in ranked] == [
        Reference.EARTH,
        Reference.START,
        Reference.EARTH,
    ]


HEADINGS = {
    "two antennas": ("/heading", [heading("/imu"), heading("/heading", QUATERNION)]),
    "measures none": ("/imu", [heading("/imu_raw", has_heading=False, is_turned=False), heading("/imu")]),
    "never set": ("/imu", [heading("/camera/imu", is_turned=False), heading("/imu")]),
    "covariance of 1e6": ("/imu", [heading("/lidar/imu", sigma_rad=1000.0), heading("/imu")]),
    "two IMUs": (None, [heading("/a/imu"), heading("/b/imu")]),
}


@pytest.mark.parametrize("name", HEADINGS)
def test_the_topic_that_measures_headings_is_taken(name):
    topic, headings = HEADINGS[name]
    samples = Samples({}, {}, {}, {}, {sample.name: sample for sample in headings})
    best = the_one(heading_candidates(samples, 40.0))
    assert (best and best.sample.name) == topic
