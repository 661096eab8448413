"""Poses as messages of ROS 2, and odometry from them: by fields, whatever library made their classes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import DriveError, need
from v2hdm.geometry.rigid import quaternion_from_rotation
from v2hdm.localization.antenna import Fix
from v2hdm.localization.motion import Motion
from v2hdm.localization.pose import Pose, Status
from v2hdm.localization.stream import pose_record

Make = Callable[..., Any]
"""``make("std_msgs/msg/Header", stamp=..., ...)``: a message of a type, with these fields."""

POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
STATUS = "std_msgs/msg/String"

POSE_TOPIC = "/v2hdm/pose"
STATUS_TOPIC = "/v2hdm/status"

_UNKNOWN = 1e6  # variance, m2 and rad2, of what is not estimated, or of a pose that is not tracked


def seconds(stamp: Any) -> float:
    """A ``builtin_interfaces/msg/Time`` in seconds; ROS 2 says ``nanosec``."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def motion_of(message: Any) -> Motion:
    """The motion that a ``nav_msgs/msg/Odometry`` or a ``geometry_msgs/msg/TwistStamped`` states.

    Its twist is the vehicle's own: forward, left, up.
    """
    twist = message.twist
    twist = getattr(twist, "twist", twist)
    return Motion(seconds(message.header.stamp), float(twist.linear.x), float(twist.angular.z))


def fix_of(message: Any) -> Fix:
    """The place of a ``PoseWithCovarianceStamped`` or an ``Odometry`` in the map's frame."""
    place = message.pose.pose.position
    covariance = np.asarray(message.pose.covariance, dtype=np.float64).reshape(6, 6)
    sigma_m = float(np.sqrt(max(np.trace(covariance[:2, :2]) / 2, 1e-6)))
    return Fix(seconds(message.header.stamp), np.array([place.x, place.y]), sigma_m)


def pose_message(pose: Pose, make: Make, frame: str = "map") -> Any | None:
    """The pose as a ``PoseWithCovarianceStamped``; None where there is none.

    Its covariance is huge unless the pose is tracked: who looks at nothing else is not misled.
    """
    at = pose.map_from_vehicle
    if at is None:
        return None
    covariance = np.diag(np.full(6, _UNKNOWN))
    if pose.status == Status.TRACKING:
        planar = [0, 1, 5]
        covariance[np.ix_(planar, planar)] = pose.covariance
    x, y, z = at[:3, 3].tolist()
    qx, qy, qz, qw = quaternion_from_rotation(at[None, :3, :3])[0].tolist()
    return make(
        POSE,
        header=_header(pose, make, frame),
        pose=make(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=make(
                "geometry_msgs/msg/Pose",
                position=make("geometry_msgs/msg/Point", x=x, y=y, z=z),
                orientation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
            ),
            covariance=covariance.ravel(),
        ),
    )


def status_message(pose: Pose, make: Make) -> Any:
    """The whole line of a pose (docs/live.md) as a ``String``."""
    return make(STATUS, data=json.dumps(pose_record(pose)))


def _header(pose: Pose, make: Make, frame: str) -> Any:
    nanoseconds = _nanoseconds(pose)
    stamp = make("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def _nanoseconds(pose: Pose) -> int:
    return round(pose.stamp_s * 1e9)


@contextmanager
def pose_bag(folder: Path | None) -> Iterator[Callable[[Pose], None]]:
    """A function that writes poses to an MCAP in a new folder; DriveError where it is not new."""
    if folder is None:
        yield lambda pose: None
        return
    need("rosbags", "ros", f"{folder}: an MCAP", DriveError)
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    if folder.exists():
        raise DriveError(f"{folder}: exists; give another --mcap, a folder that is made")
    store = get_typestore(Stores.LATEST)

    def make(kind: str, **fields: Any) -> Any:
        return store.types[kind](**fields)

    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics: Sequence[tuple[str, str]] = ((POSE_TOPIC, POSE), (STATUS_TOPIC, STATUS))
        connections = {kind: writer.add_connection(topic, kind, typestore=store) for topic, kind in topics}

        def write(pose: Pose) -> None:
            messages = ((POSE, pose_message(pose, make)), (STATUS, status_message(pose, make)))
            for kind, message in messages:
                if message is not None:
                    serialised = store.serialize_cdr(message, kind)
                    writer.write(connections[kind], _nanoseconds(pose), serialised)

        yield write
