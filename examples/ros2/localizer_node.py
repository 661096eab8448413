"""A ROS 2 node that says where the vehicle is: markings of a V2HDM map, seen by its cameras.

    python localizer_node.py RESULT --ros-args -r odometry:=/vehicle/odometry -r front:=/front/image_raw

It needs rclpy and cv_bridge; all that it does with messages is in ``v2hdm.localization.messages``.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from v2hdm import Localizer, read_map
from v2hdm.detection.road import RoadDetector
from v2hdm.io.calibration.reading import trusted_calibrations
from v2hdm.localization.messages import motion_of, pose_message, seconds, status_message
from v2hdm.localization.seeing import Look
from v2hdm.store.names import calibration_file


def make(kind: str, **fields: Any) -> Any:
    """A message by its type's name, of ROS's own classes."""
    package, _, name = kind.split("/")
    return getattr(import_module(f"{package}.msg"), name)(**fields)


class Place:
    """A node's work on messages: images and odometry come in, a pose and a status go out."""

    def __init__(self, result: Path) -> None:
        calibrations = trusted_calibrations(result)
        self.localizer = Localizer(read_map(result), calibrations)
        self.roads = {name: RoadDetector.load(result / calibration_file(name)) for name in calibrations}

    def moved(self, message: Any) -> None:
        """Take an Odometry or a TwistStamped."""
        self.localizer.update([], [motion_of(message)])

    def saw(self, camera: str, stamp: Any, pixels: Any) -> list[tuple[str, Any]]:
        """Take an image (H, W, 3) BGR; the messages to publish, by topic."""
        stamp_s = seconds(stamp)
        regions_px = self.localizer.regions(camera, stamp_s)
        found = self.roads[camera].detect(pixels, regions_px=regions_px)
        pose = self.localizer.update([Look.of(camera, stamp_s, found)])
        messages = [("pose", pose_message(pose, make)), ("status", status_message(pose, make))]
        return [(topic, message) for topic, message in messages if message is not None]


def main() -> None:
    """Run the node."""
    rclpy: Any = import_module("rclpy")
    bridge = import_module("cv_bridge").CvBridge()
    image = import_module("sensor_msgs.msg").Image
    odometry = import_module("nav_msgs.msg").Odometry
    place = Place(Path(sys.argv[1]))
    rclpy.init()
    node = rclpy.create_node("v2hdm_localizer")
    pose = import_module("geometry_msgs.msg").PoseWithCovarianceStamped
    text = import_module("std_msgs.msg").String
    publishers = {
        "pose": node.create_publisher(pose, "pose", 1),
        "status": node.create_publisher(text, "status", 1),
    }

    def saw(camera: str, message: Any) -> None:
        pixels = bridge.imgmsg_to_cv2(message, "bgr8")
        for topic, answer in place.saw(camera, message.header.stamp, pixels):
            publishers[topic].publish(answer)

    for name in place.roads:
        # A queue of one: of several images that came while one was looked at, the newest is next.
        node.create_subscription(image, name, lambda message, camera=name: saw(camera, message), 1)
    node.create_subscription(odometry, "odometry", place.moved, 50)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
