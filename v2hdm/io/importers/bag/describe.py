"""A bag without a ``drive.yaml``: its description from topics and frames, as far as they suffice."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.ipm import mounting_angles
from v2hdm.geometry.rigid import euler_from_rotation, inverse
from v2hdm.io.importers.bag import messages as kinds
from v2hdm.io.importers.bag.frames import TF_TOPIC, VEHICLES, frame_name
from v2hdm.io.importers.bag.reading import Bag, Topic, bag_files, in_child_of, open_bag
from v2hdm.io.importers.bag.streams import INFO_KIND, TfStream, frame_of, import_streams
from v2hdm.records import FloatArray
from v2hdm.store.files import dump_yaml, load_yaml
from v2hdm.store.folders import entry_folder, is_whole, new_entry

_MAPS = ("map", "odom")
_IMAGE_WORDS = frozenset(
    {"image", "image_raw", "image_color", "image_mono", "image_rect", "image_rect_color", "compressed",
     "camera", "cameras", "sensing", "sensors", "raw", "image_raw_compressed"}
)  # fmt: skip
LENS = "the intrinsics, a file from ROS, Kalibr, OpenCV or COLMAP: front.yaml"
ORIGIN = "the ground under the rear axle"  # which positions on a vehicle count from
MOUNTING = (
    "the camera's position, m forward, left, up from {origin}; its roll, pitch (down) and yaw (left) to some "
    "ten degrees: {{xyz_m: [2.1, 0, 1.6], rpy_deg: [0, 12, 0]}}"
)
LEVER_ARM = "m forward, left, up from {origin}: [1.2, 0, 1.8]"
_MOST_NAMES = 12  # of frames that a question lists
_TURNED = 1e-6  # elements of a rotation that are closer to the identity's are so by rounding
_DESCRIPTION = "drive.yaml"
IMAGE_KINDS = (*kinds.IMAGE_KINDS, kinds.VIDEO)


def describe_bag(path: Path, cache: Path) -> dict[str, Any]:
    """The content of a ``drive.yaml`` for the bag at ``path``; DriveError where it does not suffice."""
    folder = entry_folder(cache, bag_files(path), "drive", ["bare"])
    if not is_whole(folder):
        description = BagDescription(path, cache)
        if description.missing:
            raise DriveError(
                f"{path}: does not state {', '.join(description.missing)}; "
                f"v2hdm check {path.name} --write FOLDER asks for it and writes the drive.yaml"
            )
        with new_entry(folder) as partial:
            (partial / _DESCRIPTION).write_text(dump_yaml(description.content), encoding="utf-8")
    return load_yaml(folder / _DESCRIPTION, DriveError) | {"bag": path.name}


def list_topics(path: Path, cache: Path) -> str:
    """The topics of a bag with types and counts, and the ``drive.yaml`` for it as far as it is known."""
    outline = _outline_of(path)
    topics = outline.topics.values()
    width = max((len(topic.name) for topic in topics), default=0)
    lines = [f"{topic.name:<{width}}  {topic.messages:>8}  {topic.kind}" for topic in topics]
    if not any(topic.kind in IMAGE_KINDS for topic in topics):
        return "\n".join([*lines, "", "# no image topic: not a drive"])
    description = BagDescription(path, cache, outline)
    gaps = f"; missing: {', '.join(description.missing)}" if description.missing else ""
    return "\n".join([*lines, "", f"# drive.yaml{gaps}", dump_yaml(description.content).rstrip()])


@dataclass(frozen=True)
class _Outline:
    """What a bag holds: its topics by name, and the frames that their first messages are of."""

    topics: Mapping[str, Topic]
    frame_of: Mapping[str, str]  # by the topics that a description needs the frame of

    @property
    def cameras(self) -> dict[str, Topic]:
        """Topics of images by the camera's name; a camera's compressed ones rather than its raw ones."""
        topics = [topic for topic in self.topics.values() if topic.kind in IMAGE_KINDS and topic.messages]
        by_base: dict[str, Topic] = {}
        for topic in sorted(topics, key=lambda topic: topic.kind != kinds.COMPRESSED):
            by_base.setdefault(topic.name.removesuffix("/compressed"), topic)
        names = {}
        for base in by_base:
            words = [word for word in base.split("/") if word and word not in _IMAGE_WORDS]
            names[base] = words[-1] if words else "camera"
        if len(set(names.values())) < len(names):
            names = {base: base.strip("/").replace("/", "_") for base in by_base}
        return {names[base]: topic for base, topic in sorted(by_base.items())}

    def info_of(self, image: Topic) -> Topic | None:
        """The ``camera_info`` beside the images, as ``image_transport`` names it."""
        base = image.name.removesuffix("/compressed")
        beside = f"{base.rsplit('/', 1)[0]}/camera_info"
        topic = self.topics.get(beside) or self.topics.get(f"{base}/camera_info")
        return topic if topic is not None and topic.kind == INFO_KIND and topic.messages else None

    @property
    def position(self) -> Topic | None:
        """The only topic of positions."""
        return self._only(kinds.POSE_KINDS[:-1])

    @property
    def heading(self) -> Topic | None:
        """The only topic of headings, where positions lack them."""
        if self.position is None or self.position.kind != kinds.FIX:
            return None
        return self._only([kinds.QUATERNION]) or self._only([kinds.IMU])

    def _only(self, message_kinds: Sequence[str]) -> Topic | None:
        recorded = [topic for topic in self.topics.values() if topic.messages > 1]
        fitting = [topic for topic in recorded if topic.kind in message_kinds]
        return fitting[0] if len(fitting) == 1 else None


def _outline_of(path: Path) -> _Outline:
    outline = in_child_of(path, outline_bag)
    topics = [Topic(**fields) for fields in outline["topics"]]
    return _Outline({topic.name: topic for topic in topics}, outline["frame_of"])


def outline_bag(path: Path) -> dict[str, Any]:
    """The topics of a bag, and frames by topic, in plain values."""
    with open_bag(path) as bag:
        outline = _Outline(bag.topics, {})
        images = outline.cameras.values()
        infos = [outline.info_of(topic) for topic in images]
        read = (*images, *infos, outline.position, outline.heading)
        names = {topic.name for topic in read if topic is not None}
        frame_of = _frames_of_topics(bag, names)
        return {"topics": [asdict(topic) for topic in bag.topics.values()], "frame_of": frame_of}


class BagDescription:
    """The ``content`` of a ``drive.yaml`` as far as a bag tells it, and the ``missing`` keys, dotted.

    ``vehicle_frame`` is the vehicle's frame where its user names it.
    """

    def __init__(
        self, path: Path, cache: Path, outline: _Outline | None = None, vehicle_frame: str | None = None
    ) -> None:
        self.missing: dict[str, str] = {}
        outline = outline or _outline_of(path)
        images = outline.cameras
        if not images:
            raise DriveError(f"{path}: has no image topic ({', '.join(IMAGE_KINDS)}); not a drive")
        self._frame_of = outline.frame_of
        stream = TfStream(f"{path}: tf", needed=False)
        self._frames = stream.frames(import_streams(path, [stream], cache)[0])
        infos = {name: outline.info_of(topic) for name, topic in images.items()}
        frame_of_camera = {name: self._frame_of[(infos[name] or images[name]).name] for name in images}
        self._vehicle = (
            self._choose_vehicle(outline.position, frame_of_camera.values())
            if vehicle_frame is None
            else self._frames.needed(vehicle_frame, f"{path}: vehicle_frame")
        )
        poses = self._poses(outline.position, outline.heading)
        cameras = {
            name: self._camera(name, topic, infos[name], frame_of_camera[name])
            for name, topic in images.items()
        }
        about: dict[str, Any] = {"name": path.stem, "bag": path.name}
        if self._vehicle:
            about["vehicle_frame"] = self._vehicle
            height_m = self._frames.height_m(self._vehicle)
            if height_m is not None:
                about["vehicle_frame_height_m"] = round(height_m, 4)
        self.content = about | {"poses": poses, "cameras": cameras}

    def _choose_vehicle(self, position: Topic | None, camera_frames: Collection[str]) -> str:
        """The vehicle's frame as the bag tells it; empty where it does not, and what it offers is asked."""
        in_tree = [name for frame in camera_frames if (name := self._frames.named(frame)) is not None]
        vehicle = self._frames.vehicle_of(in_tree)
        if vehicle is not None:
            return vehicle
        moved = "" if position is None else self._frame_of.get(position.name, "")
        if not self._frames.names:
            return moved if moved.rpartition("/")[2] in VEHICLES else ""
        holders = self._frames.holders(in_tree)
        if in_tree and holders:
            self.missing["vehicle_frame"] = (
                "the frame that the vehicle moves with, x forward, level, best on the ground under the rear "
                f"axle; the cameras hang on {', '.join(holders[:_MOST_NAMES])}"
            )
        return ""

    def _poses(self, position: Topic | None, heading: Topic | None) -> dict[str, Any]:
        if position is None:
            world = self._world()
            if world is not None:
                return {"topic": TF_TOPIC, "frame": world, "vehicle": self._vehicle}
            self.missing["poses.topic"] = "the topic of poses; the bag has several or none"
            return {"topic": "?"}
        entry: dict[str, Any] = {"topic": position.name}
        if position.kind == kinds.FIX:
            if heading is None:
                self.missing["poses.heading_topic"] = "the topic of headings, such as /imu"
            entry["heading_topic"] = "?" if heading is None else heading.name
        if "vehicle_frame" in self.missing:
            return entry
        sensor = self._frame_of.get(position.name, "")
        vehicle_from_sensor = self._vehicle_from(sensor)
        if vehicle_from_sensor is None:
            lever_arm = LEVER_ARM.format(origin=self._origin)
            asked = f"position of '{sensor}' in the vehicle frame, {lever_arm}"
            if not sensor and position.kind != kinds.FIX:
                asked = (
                    f"{position.name} does not say of which frame its poses are: that frame's origin, m "
                    f"forward, left, up from {self._origin}: [0, 0, 0] if it is that frame itself"
                )
            self.missing["poses.lever_arm_m"] = asked
            entry["lever_arm_m"] = "?"
            return entry
        entry["lever_arm_m"] = vehicle_from_sensor[:3, 3].tolist()
        turned: FloatArray | None = vehicle_from_sensor
        if heading is not None:
            turned = self._vehicle_from(self._frame_of.get(heading.name, ""))
        if turned is None:
            self.missing["poses.mounting_rpy_deg"] = (
                "roll, pitch and yaw of the heading sensor, deg: [0, 0, 0]"
            )
            entry["mounting_rpy_deg"] = "?"
        elif np.abs(turned[:3, :3] - np.eye(3)).max() > _TURNED:
            entry["mounting_rpy_deg"] = np.degrees(euler_from_rotation(turned[:3, :3])).tolist()
        return entry

    def _world(self) -> str | None:
        """The map's frame in which transforms move the vehicle."""
        worlds = [name for last in _MAPS for name in self._frames.names if name.rpartition("/")[2] == last]
        return next(
            (name for name in worlds if self._vehicle and self._frames.leads(name, self._vehicle)), None
        )

    def _camera(self, name: str, topic: Topic, info: Topic | None, frame: str) -> dict[str, Any]:
        entry: dict[str, Any] = {"camera_info": {"topic": "?"}, "images": {"topic": topic.name}}
        if info is None:
            self.missing[f"cameras.{name}.camera_info"] = LENS
        else:
            entry["camera_info"] = {"topic": info.name}
        camera_frame = self._frames.named(frame, self._vehicle) or frame
        if camera_frame:
            entry["frame"] = camera_frame
        if "vehicle_frame" in self.missing:
            return entry
        vehicle_from_cam = self._vehicle_from(frame)
        if vehicle_from_cam is None:
            asked = MOUNTING.format(origin=self._origin)
            problem = (
                self._frames.link(self._vehicle, camera_frame).problem
                if camera_frame in self._frames.names
                else ""
            )
            self.missing[f"cameras.{name}.mounting"] = f"{asked} ({problem})" if problem else asked
            return entry | {"mounting": "?"}
        angles_deg = np.degrees(mounting_angles(inverse(vehicle_from_cam)))
        xyz_m = np.round(vehicle_from_cam[:3, 3], 9).tolist()
        rpy_deg = np.round(angles_deg, 9).tolist()
        return entry | {"mounting": {"xyz_m": xyz_m, "rpy_deg": rpy_deg}}

    @property
    def _origin(self) -> str:
        return self._vehicle or ORIGIN

    def _vehicle_from(self, sensor: str) -> FloatArray | None:
        """``vehicle_from_sensor`` where fixed frames lead there."""
        if not self._vehicle or not sensor:
            return None
        if sensor == self._vehicle:
            return np.eye(4)
        sensor_frame = self._frames.named(sensor, self._vehicle)
        return None if sensor_frame is None else self._frames.fixed(self._vehicle, sensor_frame)


def _frames_of_topics(bag: Bag, names: set[str]) -> dict[str, str]:
    """By topic, the frame whose pose or image its first message holds."""
    frames: dict[str, str] = {}
    for message in bag.messages(names):
        if message.topic in frames:
            continue
        frames[message.topic] = frame_of(message)
        if message.kind == kinds.ODOMETRY:
            frames[message.topic] = frame_name(message.fields.child_frame_id)
        elif message.kind in kinds.HEADING_KINDS and message.kind not in (kinds.IMU, kinds.QUATERNION):
            frames[message.topic] = ""  # a pose's header names the frame that it is in, not whose it is
        if len(frames) == len(names):
            break
    return frames
