"""A bag without a ``drive.yaml``: the description that its topics and frames tell, if they tell enough.

The mounting of the cameras comes from ``/tf_static``; where it is not there, the error holds the description
as far as it is known, to be completed and put beside the bag.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from v2hdm.errors import DriveError
from v2hdm.geometry.rigid import inverse
from v2hdm.io.drive.mounting import roi_ahead
from v2hdm.io.importers.bag import poses
from v2hdm.io.importers.bag.encoded_video import VIDEO
from v2hdm.io.importers.bag.importing import import_streams
from v2hdm.io.importers.bag.pixels import IMAGE_KINDS as PICTURES
from v2hdm.io.importers.bag.reading import Bag, Topic, bag_files, open_bag
from v2hdm.io.importers.bag.streams import INFO_KIND, TfStream, frame_of
from v2hdm.io.importers.bag.tf import TF_STATIC, TF_TOPIC, Frames, frame_name
from v2hdm.records import FloatArray
from v2hdm.store.files import dump_yaml, load_yaml
from v2hdm.store.folders import (
    begin_entry,
    cannot_write,
    drop_entry,
    entry_folder,
    finish_entry,
    is_whole,
)

_VEHICLES = ("base_footprint", "base_link")
"""Frames of a vehicle, the one on the ground first (REP-105, REP-120)."""

_MAPS = ("map", "odom")
_LEAST_MESSAGES = 2
_IMAGE_WORDS = frozenset(
    {"image", "image_raw", "image_color", "image_mono", "image_rect", "image_rect_color", "compressed",
     "camera", "cameras", "sensing", "sensors", "raw", "image_raw_compressed"}
)  # fmt: skip

_TURNED = 1e-6
"""Elements of a rotation that are less than this from the identity's are so by rounding."""

_DESCRIPTION = "drive.yaml"
IMAGE_KINDS = (*PICTURES, VIDEO)


@dataclass(frozen=True)
class _Found:
    """What the first messages tell: by topic, the frame whose pose or image they hold."""

    frames: Mapping[str, str]


def describe_bag(path: Path, cache: Path) -> dict[str, Any]:
    """The content of a ``drive.yaml`` for the bag at ``path``, which names the bag relative to its folder.

    Raises:
        DriveError: the bag does not tell enough; the message is one line with the description so far.
    """
    folder = entry_folder(cache, bag_files(path), "drive", ["bare"])
    if not is_whole(folder):
        content, missing = _describe(path, cache)
        if missing:
            flow = dump_flow(content)
            raise DriveError(
                f"{path}: says no {', no '.join(missing)}; complete this and save it as drive.yaml in a "
                f"folder beside the bag: {flow}"
            )
        partial = begin_entry(folder)
        try:
            (partial / _DESCRIPTION).write_text(dump_yaml(content), encoding="utf-8")
            finish_entry(folder)
        except OSError as failure:
            raise cannot_write(folder, failure) from None
        finally:
            drop_entry(folder)
    return load_yaml(folder / _DESCRIPTION, DriveError) | {"bag": path.name}


def list_topics(path: Path, cache: Path) -> str:
    """The topics of a bag with types and counts, and the ``drive.yaml`` for it as far as it is known.

    Raises:
        DriveError: it is no bag or damaged.
    """
    with open_bag(path) as bag:
        topics = list(bag.topics.values())
    width = max((len(topic.name) for topic in topics), default=0)
    lines = [f"{topic.name:<{width}}  {topic.messages:>8}  {topic.kind}" for topic in topics]
    if not any(topic.kind in IMAGE_KINDS for topic in topics):
        return "\n".join([*lines, "", "# no topic of images: not a drive"])
    content, missing = _describe(path, cache)
    said = f"; still to be said: {', '.join(missing)}" if missing else ""
    return "\n".join([*lines, "", f"# drive.yaml{said}", dump_yaml(content).rstrip()])


def dump_flow(content: Mapping[str, Any]) -> str:
    """``content`` as YAML on one line."""
    return str(
        yaml.safe_dump(dict(content), sort_keys=False, default_flow_style=True, width=1_000_000)
    ).strip()


def _describe(path: Path, cache: Path) -> tuple[dict[str, Any], list[str]]:
    """The description as far as it is known, and what is missing."""
    with open_bag(path) as bag:
        images = _cameras(bag)
        infos = {name: _info_topic(bag, topic) for name, topic in images.items()}
        position = _only(bag, poses.POSE_KINDS[:-1])
        heading = _heading(bag, position)
        wanted = [*infos.values(), position, heading]
        names = {topic.name for topic in wanted if topic is not None}
        has_static, has_tf = TF_STATIC in bag.topics, TF_TOPIC in bag.topics
        found = _first_messages(bag, names)
    if not images:
        raise DriveError(f"{path}: has no topic of images ({', '.join(IMAGE_KINDS)}); not a drive")
    frames = Frames({})
    if has_static or has_tf:
        stream = TfStream(has_tf, f"{path}: tf")
        frames = stream.frames(import_streams(path, [stream], cache)[0])
    vehicle = next((name for name in _VEHICLES if name in frames.names), None)
    missing: list[str] = []
    content: dict[str, Any] = {"name": path.stem, "bag": path.name}
    content["poses"] = _poses(position, heading, found, frames, vehicle, missing)
    content["cameras"] = {
        name: _camera(name, topic, infos[name], found, frames, vehicle, missing)
        for name, topic in images.items()
    }
    return content, list(dict.fromkeys(missing))


def _first_messages(bag: Bag, names: set[str]) -> _Found:
    frames: dict[str, str] = {}
    for message in bag.messages(names):
        if message.topic in frames:
            continue
        frames[message.topic] = frame_of(message)
        if message.kind == poses.ODOMETRY:
            frames[message.topic] = frame_name(message.fields.child_frame_id)
        elif message.kind in poses.HEADING_KINDS and message.kind not in (poses.IMU, poses.QUATERNION):
            frames[message.topic] = ""  # a pose's header names the frame that it is in, not whose it is
        if len(frames) == len(names):
            break
    return _Found(frames)


def _cameras(bag: Bag) -> dict[str, Topic]:
    """Topics of images by the camera's name; a camera's compressed ones rather than its raw ones."""
    topics = [topic for topic in bag.topics.values() if topic.kind in IMAGE_KINDS and topic.messages]
    by_base: dict[str, Topic] = {}
    for topic in sorted(topics, key=lambda topic: topic.kind != IMAGE_KINDS[1]):
        by_base.setdefault(topic.name.removesuffix("/compressed"), topic)
    names = {base: _camera_name(base) for base in by_base}
    if len(set(names.values())) < len(names):
        names = {base: base.strip("/").replace("/", "_") for base in by_base}
    return {names[base]: topic for base, topic in sorted(by_base.items())}


def _camera_name(base: str) -> str:
    words = [word for word in base.split("/") if word and word not in _IMAGE_WORDS]
    return words[-1] if words else "camera"


def _info_topic(bag: Bag, image: Topic) -> Topic | None:
    """The ``camera_info`` beside the images, as ``image_transport`` names it."""
    base = image.name.removesuffix("/compressed")
    topic = bag.topics.get(base.rsplit("/", 1)[0] + "/camera_info") or bag.topics.get(base + "/camera_info")
    return topic if topic is not None and topic.kind == INFO_KIND and topic.messages else None


def _only(bag: Bag, kinds: Sequence[str]) -> Topic | None:
    found = [
        topic for topic in bag.topics.values() if topic.kind in kinds and topic.messages >= _LEAST_MESSAGES
    ]
    return found[0] if len(found) == 1 else None


def _heading(bag: Bag, position: Topic | None) -> Topic | None:
    if position is None or position.kind != poses.FIX:
        return None
    return _only(bag, [poses.QUATERNION]) or _only(bag, [poses.IMU])


def _poses(
    position: Topic | None,
    heading: Topic | None,
    found: _Found,
    frames: Frames,
    vehicle: str | None,
    missing: list[str],
) -> dict[str, Any]:
    if position is None:
        world = next((name for name in _MAPS if name in frames.names), None)
        if world is not None and vehicle is not None:
            return {"topic": TF_TOPIC, "frame": world, "vehicle": vehicle}
        missing.append("one topic of poses")
        return {"topic": "?"}
    entry: dict[str, Any] = {"topic": position.name}
    if position.kind == poses.FIX:
        if heading is None:
            missing.append("topic of headings")
        entry["heading_topic"] = "?" if heading is None else heading.name
    sensor = found.frames.get(position.name, "")
    vehicle_from_sensor = _fixed(frames, vehicle, sensor)
    if vehicle_from_sensor is None:
        missing.append(f"place of the poses' frame '{sensor}' on the vehicle (lever_arm_m)")
        entry["lever_arm_m"] = "?"
        return entry
    entry["lever_arm_m"] = vehicle_from_sensor[:3, 3].tolist()
    turned: FloatArray | None = vehicle_from_sensor
    if heading is not None:
        turned = _fixed(frames, vehicle, found.frames.get(heading.name, ""))
    if turned is None:
        missing.append("turn of the heading's sensor on the vehicle (mounting_rpy_deg)")
        entry["mounting_rpy_deg"] = "?"
    elif np.abs(turned[:3, :3] - np.eye(3)).max() > _TURNED:
        entry["mounting_rpy_deg"] = _rpy_deg(turned[:3, :3])
    return entry


def _camera(
    name: str,
    topic: Topic,
    info: Topic | None,
    found: _Found,
    frames: Frames,
    vehicle: str | None,
    missing: list[str],
) -> dict[str, Any]:
    entry: dict[str, Any] = {"camera_info": {"topic": "?"}, "images": {"topic": topic.name}}
    vehicle_from_cam = None
    if info is None:
        missing.append(f"camera_info of {topic.name}")
    else:
        entry["camera_info"] = {"topic": info.name}
        vehicle_from_cam = _fixed(frames, vehicle, found.frames[info.name])
    if vehicle_from_cam is None:
        missing.append(f"mounting of camera '{name}' (cam_from_vehicle, roi_vehicle)")
        entry["cam_from_vehicle"], entry["roi_vehicle"] = "?", "?"
        return entry
    entry["cam_from_vehicle"] = inverse(vehicle_from_cam).tolist()
    entry["roi_vehicle"] = roi_ahead(vehicle_from_cam).tolist()
    return entry


def _fixed(frames: Frames, vehicle: str | None, sensor: str) -> FloatArray | None:
    """``vehicle_from_sensor`` where fixed frames tell it."""
    if vehicle is not None and sensor == vehicle:
        return np.eye(4)
    return None if vehicle is None or not sensor else frames.fixed(vehicle, sensor)


def _rpy_deg(rotation: FloatArray) -> list[float]:
    """Roll, pitch and yaw in degrees, about fixed axes (REP-103)."""
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[2, 1], rotation[2, 2]))
    roll, yaw = np.arctan2(rotation[2, 1], rotation[2, 2]), np.arctan2(rotation[1, 0], rotation[0, 0])
    return [float(np.degrees(angle)) for angle in (roll, pitch, yaw)]
