"""Bags of a drive folder, written with rosbags' own writers, for the tests of reading them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.drive.example import looking_forward, make_drive
from v2hdm.geometry.rigid import inverse, quaternion_from_rotation
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.records import Drive, FloatArray

SQLITE3, MCAP = StoragePlugin.SQLITE3, StoragePlugin.MCAP
FRONT = "/sensing/front/image_raw"  # topic of the front camera of :func:`messages_of`
VIDEO = "foxglove_msgs/msg/CompressedVideo"
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.LATEST)
_PACKET = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format"
ROS2.register(get_types_from_msg(_PACKET, VIDEO))
FFMPEG = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
_FFMPEG_PACKET = """std_msgs/Header header
int32 width
int32 height
string encoding
uint64 pts
uint8 flags
bool is_bigendian
uint8[] data
"""
ROS2.register(get_types_from_msg(_FFMPEG_PACKET, FFMPEG))
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))

Row = tuple[float, str, Any]
"""Time of reception, topic, message."""


@dataclass
class Messages:
    """Makes messages of either ROS."""

    ros1: bool = False
    rows: list[Row] = field(default_factory=list)

    @property
    def store(self) -> Any:
        return ROS1 if self.ros1 else ROS2

    def make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def header(self, stamp_s: float, frame: str) -> Any:
        nanoseconds = round(stamp_s * 1e9)
        time = self.make("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        sequence = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **sequence)

    def add(self, stamp_s: float, topic: str, message: Any) -> None:
        self.rows.append((stamp_s, topic, message))

    def raw_image(self, stamp_s: float, pixels: np.ndarray, encoding: str, frame: str, pad: int = 0) -> Any:
        height, width = pixels.shape[:2]
        rows = pixels.reshape(height, -1)
        data = np.pad(rows, ((0, 0), (0, pad)), constant_values=77)
        return self.make(
            "sensor_msgs/msg/Image", header=self.header(stamp_s, frame), height=height, width=width,
            encoding=encoding, is_bigendian=0, step=data.shape[1], data=data.ravel(),
        )  # fmt: skip

    def packet(self, kind: str, stamp_s: float, data: bytes, form: str, frame: str) -> Any:
        """A packet of video in a message of that ``kind``."""
        header = self.header(stamp_s, frame)
        numbers = np.frombuffer(data, np.uint8)
        if kind == VIDEO:
            return self.make(VIDEO, timestamp=header.stamp, frame_id=frame, data=numbers, format=form)
        if kind == FFMPEG:
            return self.make(
                FFMPEG, header=header, width=0, height=0, encoding=form, pts=0, flags=0, is_bigendian=False,
                data=numbers,
            )  # fmt: skip
        return self.compressed(stamp_s, data, form, frame)

    def compressed(self, stamp_s: float, data: bytes, form: str, frame: str) -> Any:
        return self.make(
            "sensor_msgs/msg/CompressedImage", header=self.header(stamp_s, frame), format=form,
            data=np.frombuffer(data, np.uint8),
        )  # fmt: skip

    def info(self, stamp_s: float, camera: Any, frame: str) -> Any:
        names = ("K", "D", "R", "P") if self.ros1 else ("k", "d", "r", "p")
        values = (
            camera.intrinsic.ravel(), np.array(camera.distortion), np.eye(3).ravel(),
            np.column_stack([camera.intrinsic, np.zeros(3)]).ravel(),
        )  # fmt: skip
        roi = self.make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self.make(
            "sensor_msgs/msg/CameraInfo", header=self.header(stamp_s, frame), height=camera.height,
            width=camera.width, distortion_model=camera.distortion_model, binning_x=0, binning_y=0, roi=roi,
            **dict(zip(names, values, strict=True)),
        )  # fmt: skip

    def pose(self, matrix: FloatArray) -> Any:
        x, y, z, w = quaternion_from_rotation(matrix[None, :3, :3])[0].tolist()
        px, py, pz = matrix[:3, 3].tolist()
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", x=px, y=py, z=pz),
            orientation=self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )

    def pose_stamped(self, stamp_s: float, matrix: FloatArray) -> Any:
        return self.make(
            "geometry_msgs/msg/PoseStamped", header=self.header(stamp_s, "map"), pose=self.pose(matrix)
        )

    def with_covariance(self, stamp_s: float, matrix: FloatArray, covariance: FloatArray) -> Any:
        pose = self.make(
            "geometry_msgs/msg/PoseWithCovariance", pose=self.pose(matrix), covariance=covariance.ravel()
        )
        return self.make(
            "geometry_msgs/msg/PoseWithCovarianceStamped", header=self.header(stamp_s, "map"), pose=pose
        )

    def odometry(self, stamp_s: float, matrix: FloatArray, covariance: FloatArray, child: str) -> Any:
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        return self.make(
            "nav_msgs/msg/Odometry", header=self.header(stamp_s, "map"), child_frame_id=child,
            pose=self.make(
                "geometry_msgs/msg/PoseWithCovariance", pose=self.pose(matrix), covariance=covariance.ravel()
            ),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )  # fmt: skip

    def fix(self, stamp_s: float, place: Sequence[float], status: int, sigma_m: float, frame: str) -> Any:
        covariance = np.diag([sigma_m**2, sigma_m**2, (2 * sigma_m) ** 2]).ravel()
        return self.make(
            "sensor_msgs/msg/NavSatFix", header=self.header(stamp_s, frame),
            status=self.make("sensor_msgs/msg/NavSatStatus", status=status, service=1),
            latitude=float(place[0]), longitude=float(place[1]), altitude=float(place[2]),
            position_covariance=covariance, position_covariance_type=2 if sigma_m else 0,
        )  # fmt: skip

    def imu(self, stamp_s: float, rotation: FloatArray, frame: str) -> Any:
        x, y, z, w = quaternion_from_rotation(rotation[None])[0].tolist()
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        return self.make(
            "sensor_msgs/msg/Imu", header=self.header(stamp_s, frame),
            orientation=self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
            orientation_covariance=np.diag([1e-4, 1e-4, 4e-6]).ravel(), angular_velocity=zero,
            angular_velocity_covariance=np.zeros(9), linear_acceleration=zero,
            linear_acceleration_covariance=np.zeros(9),
        )  # fmt: skip

    def transforms(self, stamp_s: float, edges: Mapping[tuple[str, str], FloatArray]) -> Any:
        stamped = []
        for (parent, child), matrix in edges.items():
            x, y, z = matrix[:3, 3].tolist()
            move, turn = self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z), self.pose(matrix).orientation
            motion = self.make("geometry_msgs/msg/Transform", translation=move, rotation=turn)
            fields = {"header": self.header(stamp_s, parent), "child_frame_id": child, "transform": motion}
            stamped.append(self.make("geometry_msgs/msg/TransformStamped", **fields))
        return self.make("tf2_msgs/msg/TFMessage", transforms=stamped)


def messages_of(
    folder: Path,
    ros1: bool = False,
    fixed_frames: bool = True,
    mounted: Mapping[str, FloatArray] | None = None,
) -> Messages:
    """The drive in ``folder``: raw images of ``front``, those of ``rear`` as they are, odometry, frames."""
    drive = read_drive(folder)
    messages = Messages(ros1)
    assert drive.trajectory is not None
    for image in drive.images:
        frame = f"{image.camera}_optical"
        topic = f"/sensing/{image.camera}/image_raw"
        if image.camera == "front":
            pixels = cv2.imread(str(image.path), cv2.IMREAD_COLOR)
            rgb = np.ascontiguousarray(pixels[..., ::-1])
            messages.add(image.stamp_s, topic, messages.raw_image(image.stamp_s, rgb, "rgb8", frame, pad=5))
        else:
            data = image.path.read_bytes()
            packed = messages.compressed(image.stamp_s, data, "jpeg", frame)
            messages.add(image.stamp_s, f"{topic}/compressed", packed)
        info = messages.info(image.stamp_s, drive.cameras[image.camera].info, frame)
        messages.add(image.stamp_s, f"/sensing/{image.camera}/camera_info", info)
    for stamp_s, pose in zip(drive.trajectory.stamp_s, drive.trajectory.map_from_vehicle, strict=True):
        messages.add(stamp_s, "/odom", messages.odometry(stamp_s, pose, np.zeros(36), "base_link"))
    if fixed_frames:
        edges = {
            ("base_link", f"{name}_optical"): inverse(np.array(guess))
            for name, guess in (mounted or mountings()).items()
        }
        first_s = drive.trajectory.stamp_s[0]
        messages.add(first_s, "/tf_static", messages.transforms(first_s, edges))
    messages.rows.sort(key=lambda row: row[0])
    return messages


def mountings() -> dict[str, FloatArray]:
    return {"front": looking_forward(2.0), "rear": looking_forward(3.0)}


def write_ros1(path: Path, messages: Messages, compression: str | None = None) -> Path:
    path = path.with_suffix(".bag")
    writer = Writer1(path)
    if compression:
        writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    with writer:
        _write(writer, messages, ROS1.serialize_ros1, ROS1)
    return path


def write_ros2(
    path: Path,
    messages: Messages,
    storage: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    writer = Writer2(path, version=9, storage_plugin=storage)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        _write(writer, messages, ROS2.serialize_cdr, ROS2)
    return path


def _write(writer: Any, messages: Messages, serialize: Callable[..., Any], store: Any) -> None:
    connections: dict[str, Any] = {}
    for stamp_s, topic, message in messages.rows:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
        data = serialize(message, message.__msgtype__)
        writer.write(connections[topic], round(stamp_s * 1e9) + 1_000_000, data)


def assert_same_drive(got: Drive, expected: Drive) -> None:
    """Poses to a micrometre, pixels and times to the last bit."""
    assert_same_poses(got, expected)
    for image, other in zip(got.images, expected.images, strict=True):
        np.testing.assert_array_equal(cv2.imread(str(image.path)), cv2.imread(str(other.path)))
    for name, camera in expected.cameras.items():
        info = got.cameras[name].info
        assert info.name == name
        for key in ("width", "height", "distortion_model", "distortion"):
            assert getattr(info, key) == getattr(camera.info, key)
        np.testing.assert_array_equal(info.intrinsic, camera.info.intrinsic)
        expected_ipm = camera.ipm[camera.initial_ipm]
        np.testing.assert_allclose(got.cameras[name].ipm[camera.initial_ipm], expected_ipm, rtol=1e-12)


def assert_same_poses(got: Drive, expected: Drive) -> None:
    for image, other in zip(got.images, expected.images, strict=True):
        assert (image.camera, image.stamp_s) == (other.camera, other.stamp_s)
        np.testing.assert_allclose(image.map_from_vehicle, other.map_from_vehicle, rtol=0, atol=1e-6)


def assert_mounted(got: Drive) -> None:
    """The IPM keeps two columns of the extrinsic, the ground's axes, and the translation."""
    for name, cam_from_vehicle in mountings().items():
        ground = got.cameras[name].info.intrinsic @ cam_from_vehicle[:3, [0, 1, 3]]
        product = got.cameras[name].ipm["estimated"] @ ground
        np.testing.assert_allclose(product / product[2, 2], np.eye(3), atol=1e-9)


def topics_for(folder: Path, bag: Path, **changes: Any) -> dict[str, Any]:
    """The folder's ``drive.yaml`` with the topics of ``bag`` in the place of files."""
    content: dict[str, Any] = yaml.safe_load((folder / "drive.yaml").read_text())
    content.pop("truth")
    content |= {"bag": str(bag), "poses": {"topic": "/odom"}}
    for name, suffix in (("front", ""), ("rear", "/compressed")):
        content["cameras"][name] |= {
            "camera_info": {"topic": f"/sensing/{name}/camera_info"},
            "images": {"topic": f"/sensing/{name}/image_raw{suffix}"},
        }
    return content | changes


def read(root: Path, content: Mapping[str, Any]) -> Drive:
    """The drive that a drive.yaml of this content in a folder describes."""
    root.mkdir(exist_ok=True)
    (root / "drive.yaml").write_text(yaml.safe_dump(content))
    return read_drive(root, ReadOptions(cache=str(root / "cache")))


def make_pictured_drive(root: Path) -> Path:
    """The example drive with a picture in its images, so that a wrong channel or row would be seen."""
    drive = make_drive(root)
    rng = np.random.default_rng(5)
    for image in drive.images:
        cv2.imwrite(str(image.path), rng.integers(0, 255, (48, 64, 3), np.uint8))
    return root


def front_times(drive: Drive) -> list[float]:
    """Stamps of the front camera's images, s."""
    return [image.stamp_s for image in drive.images if image.camera == "front"]
