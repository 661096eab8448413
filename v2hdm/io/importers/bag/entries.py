"""Entries of a ``drive.yaml`` for a bag: its poses and cameras, what is missing and what was decided."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.rigid import euler_from_rotation
from v2hdm.io.description import PoseKeys
from v2hdm.io.importers.bag import messages as kinds
from v2hdm.io.importers.bag.cameras import CameraTopic
from v2hdm.io.importers.bag.frames import MOST_NAMES, TF_TOPIC, Frames
from v2hdm.io.importers.bag.mountings import Mount, frames_like, mount_of, mounting_of
from v2hdm.io.importers.bag.positions import (
    Candidate,
    Reference,
    heading_candidates,
    position_candidates,
    the_one,
)
from v2hdm.io.importers.bag.samples import InfoSample, PoseSample, Samples
from v2hdm.records import FloatArray

LENS = "the intrinsics, a file from ROS, Kalibr, OpenCV or COLMAP: front.yaml"
ORIGIN = "the ground under the rear axle"  # which positions on a vehicle count from
MOUNTING = (
    "the camera's position, m forward, left, up from {origin}; its roll, pitch (down) and yaw (left) to some "
    "ten degrees: {{xyz_m: [2.1, 0, 1.6], rpy_deg: [0, 12, 0]}}"
)
LEVER_ARM = "m forward, left, up from {origin}: [1.2, 0, 1.8]"
_MAPS = ("map", "odom")
_TURNED = 1e-6  # elements of a rotation that are closer to the identity's are so by rounding
_ANTENNA = re.compile(r"gps|gnss|antenna|rtk|navsat", re.IGNORECASE)
_PLACES = ("mounting", "cam_from_vehicle", "ipm")  # keys that can state a camera's mounting; one is enough
_OF_FILES = ("tum", "csv", "nmea", "sbet", "pos", "ubx")  # keys of poses that are not of the bag


@dataclass(frozen=True)
class Entry:
    """The ``content`` of a key, the ``missing`` keys of it, dotted, with what to give, and notes."""

    content: dict[str, Any]
    missing: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


class Recording(NamedTuple):
    """A bag's path, samples and frames, and the vehicle's frame: empty if none, None if it is asked for."""

    path: Path
    samples: Samples
    frames: Frames
    vehicle: str | None

    @property
    def origin(self) -> str:
        """The origin of positions on the vehicle, in words."""
        return self.vehicle or ORIGIN

    def vehicle_from(self, sensor: str) -> FloatArray | None:
        """``vehicle_from_sensor`` where fixed frames lead there."""
        if not self.vehicle or not sensor:
            return None
        if sensor == self.vehicle:
            return np.eye(4)
        sensor_frame = self.frames.named(sensor, self.vehicle)
        return None if sensor_frame is None else self.frames.fixed(self.vehicle, sensor_frame)

    def will_tell(self, sensor: str) -> bool:
        """Whether the answer to the question for the vehicle's frame may tell where a sensor is."""
        return self.vehicle is None and self.frames.named(sensor) is not None

    def is_linked(self, frame: str) -> bool:
        """Whether a frame is fixed on the vehicle."""
        try:
            return self.vehicle_from(frame) is not None
        except DriveError:  # by transforms that are no rotations
            return False


def part_of(content: object, key: str) -> Mapping[str, Any]:
    """The mapping that a mapping has under ``key``; empty where it has none."""
    part = content.get(key) if isinstance(content, Mapping) else None
    return part if isinstance(part, Mapping) else {}


def poses_entry(recording: Recording, answers: object) -> Entry:
    """The entry of poses: of the topic that its user names, else of the one that states them best."""
    if answers is not None and (not isinstance(answers, Mapping) or set(answers) & set(_OF_FILES)):
        return Entry({})
    stated = answers or {}
    max_sigma_m = stated.get("max_sigma_m")
    limit_m = float(max_sigma_m) if isinstance(max_sigma_m, int | float) else PoseKeys.max_sigma_m
    has_heading = bool({"heading_topic", "heading_file"} & set(stated)) or _is_course(stated)
    candidates = position_candidates(recording.samples, limit_m, recording.is_linked, has_heading)
    world = _world_of(recording)
    topic = stated.get("topic")
    if topic is None:
        return _best_poses(recording, candidates, world, stated)
    if topic == TF_TOPIC:
        return Entry({"topic": topic} | ({} if world is None else world.content))
    for candidate in candidates:
        if candidate.sample.name == topic:
            return _entry_of(recording, candidate.sample, stated)
    offers = ", ".join(candidate.sample.name for candidate in candidates) or "none"
    raise DriveError(f"--set poses.topic: {recording.path} has no poses on {topic}; it has: {offers}")


def _best_poses(
    recording: Recording, candidates: Sequence[Candidate], world: _World | None, stated: Mapping[str, Any]
) -> Entry:
    best = the_one(candidates)
    is_known = [not candidate.doubt and candidate.reference > Reference.START for candidate in candidates]
    if world is not None and not any(is_known) and (world.is_of_earth or not candidates):
        says = "" if world.is_of_earth else ", which drifts if nothing but wheels and an IMU moves it"
        notes = [f"poses of transforms from {world.content['frame']}{says}"]
        return Entry({"topic": TF_TOPIC} | world.content, notes=notes)
    if best is not None:
        entry = _entry_of(recording, best.sample, stated)
        others = [candidate.about for candidate in candidates if candidate != best]
        if others or best.doubt or best.reference is Reference.START:
            beside = f", not of {'; '.join(others[:MOST_NAMES])}" if others else ""
            entry.notes.append(f"poses of {best.about}{beside}")
        return entry
    offers = [candidate.about for candidate in candidates]
    if world is not None:
        offers.append(f"{TF_TOPIC} (from {world.content['frame']})")
    asked = "the topic of poses on the Earth, best RTK; the bag has "
    question = {"poses.topic": asked + ("; ".join(offers[:MOST_NAMES]) or "none")}
    possible = [candidate for candidate in candidates if not candidate.doubt] or candidates
    positions = [candidate.sample for candidate in possible[:MOST_NAMES]]
    return Entry({"topic": "?"}, question | _further(recording, positions, stated))


def _further(
    recording: Recording, positions: Sequence[PoseSample], stated: Mapping[str, Any]
) -> dict[str, str]:
    """Further questions by their keys, of all topics that may be chosen or of some, which they name."""
    topics_by_question: dict[str, dict[str, list[str]]] = {}
    for position in positions:
        for key, asked in _entry_of(recording, position, stated).missing.items():
            topics_by_question.setdefault(key, {}).setdefault(asked, []).append(position.name)
    missing = {}
    for key, topics in topics_by_question.items():
        texts = []
        for asked, names in topics.items():
            is_of_all = len(names) == len(positions)
            texts.append(asked if is_of_all else f"for {' or '.join(names)}: {asked}")
        missing[key] = "; ".join(texts)
    return missing


class _World(NamedTuple):
    """The keys of poses by transforms, and whether they count from the Earth, not from the start."""

    content: dict[str, str]
    is_of_earth: bool


def _world_of(recording: Recording) -> _World | None:
    """The map's frame in which transforms move the vehicle."""
    frames = recording.frames
    vehicle = recording.vehicle
    for last in _MAPS:
        for name in frames.names:
            if name.rpartition("/")[2] == last and vehicle and frames.leads(name, vehicle):
                prefix = name.rpartition("/")[0]
                odom = f"{prefix}/odom".lstrip("/")
                is_moved = odom not in frames.names or frames.fixed(name, odom) is None
                return _World({"frame": name, "vehicle": vehicle}, last == _MAPS[0] and is_moved)
    return None


def _entry_of(recording: Recording, position: PoseSample, stated: Mapping[str, Any]) -> Entry:
    """The entry of poses of one topic."""
    entry = Entry({"topic": position.name})
    heading: PoseSample | None = None
    if _is_course(stated):
        heading = _gyro_of(recording, stated, entry)
    elif position.kind == kinds.FIX and "heading_file" not in stated:
        heading = _heading_of(recording, position, stated, entry)
    vehicle_from_sensor = recording.vehicle_from(position.frame)
    if vehicle_from_sensor is None and recording.will_tell(position.frame):
        return entry
    if vehicle_from_sensor is None:
        entry.missing["poses.lever_arm_m"] = _lever_arm(recording, position)
        entry.content["lever_arm_m"] = "?"
    else:
        entry.content["lever_arm_m"] = vehicle_from_sensor[:3, 3].tolist()
    turned = vehicle_from_sensor
    if heading is not None:
        turned = recording.vehicle_from(heading.frame)
    if turned is None:
        if heading is not None and not recording.will_tell(heading.frame):
            entry.missing["poses.mounting_rpy_deg"] = (
                f"roll, pitch and yaw of the {'gyro' if _is_course(stated) else 'heading sensor'} "
                f"'{heading.frame}', deg: [0, 0, 0]"
            )
            entry.content["mounting_rpy_deg"] = "?"
    elif (position.kind == kinds.FIX or _is_course(stated)) and heading is None:
        return entry  # a file's headings are not of the antenna's frame
    elif np.abs(turned[:3, :3] - np.eye(3)).max() > _TURNED:
        entry.content["mounting_rpy_deg"] = np.degrees(euler_from_rotation(turned[:3, :3])).tolist()
    return entry


def _is_course(stated: Mapping[str, Any]) -> bool:
    """Whether headings are those of the course."""
    return stated.get("heading") == "course"


def _gyro_of(recording: Recording, stated: Mapping[str, Any], entry: Entry) -> PoseSample | None:
    """The sample of the topic of a gyro, put into the entry of poses headed by their course; None without."""
    gyros = {
        name: sample
        for name, sample in recording.samples.headings.items()
        if sample.kind == kinds.IMU and not sample.problem
    }
    if "gyro_topic" in stated or "gyro_file" in stated:
        return gyros.get(str(stated.get("gyro_topic")))
    if len(gyros) == 1:
        (topic,) = gyros
        entry.content["gyro_topic"] = topic
        return gyros[topic]
    if gyros:
        offers = ", ".join(list(gyros)[:MOST_NAMES])
        entry.missing["poses.gyro_topic"] = f"the topic of the gyro, null for none; the bag has {offers}"
        entry.content["gyro_topic"] = "?"
    return None


def _heading_of(
    recording: Recording, position: PoseSample, stated: Mapping[str, Any], entry: Entry
) -> PoseSample | None:
    """The sample of the topic of headings that belongs to an antenna's positions, put into its entry."""
    candidates = heading_candidates(recording.samples, position.moved_m)
    topic = stated.get("heading_topic")
    if topic is not None:
        entry.content["heading_topic"] = topic
        poses = recording.samples.headings | recording.samples.poses
        return poses.get(str(topic))
    best = the_one(candidates)
    if best is not None and not best.doubt:
        entry.content["heading_topic"] = best.sample.name
        if others := [candidate.about for candidate in candidates if candidate != best]:
            entry.notes.append(f"headings of {best.about}, not of {'; '.join(others[:MOST_NAMES])}")
        return best.sample
    offers = "; ".join(candidate.about for candidate in candidates[:MOST_NAMES]) or "none"
    asked = (
        f"the topic of headings, such as /imu; the bag has {offers}; without any, --set poses.heading=course "
        "instead takes them from the antenna's course and a gyro"
    )
    entry.missing["poses.heading_topic"] = asked
    entry.content["heading_topic"] = "?"
    return None


def _lever_arm(recording: Recording, position: PoseSample) -> str:
    """The question which point on the vehicle the positions refer to, if nothing says it."""
    if not position.frame and position.kind not in (kinds.FIX, kinds.NMEA):
        return (
            f"{position.name} does not say of which frame its poses are: that frame's origin, m "
            f"forward, left, up from {recording.origin}: [0, 0, 0] if it is that frame itself"
        )
    asked = (
        f"position of '{position.frame}' in the vehicle frame, {LEVER_ARM.format(origin=recording.origin)}"
    )
    antennas = {
        name: recording.vehicle_from(name)
        for name in recording.frames.names
        if _ANTENNA.search(name) and recording.is_linked(name)
    }
    offers = [
        f"{name} is at {np.round(pose[:3, 3], 3).tolist()}"
        for name, pose in antennas.items()
        if pose is not None
    ]
    return f"{asked} (in the transforms {', '.join(offers[:MOST_NAMES])})" if offers else asked


def camera_entry(
    recording: Recording, name: str, topic: CameraTopic, names: Sequence[str], answers: Mapping[str, Any]
) -> Entry:
    """The entry of a camera, whose messages name the frames ``names``; its user states ``answers`` of it."""
    entry = Entry({"camera_info": {"topic": "?"}, "images": {"topic": topic.image.name}})
    key = f"cameras.{name}"
    if refusal := topic.image.problem or topic.image.refusal:
        entry.missing[f"{key}.images.topic"] = (
            f"another topic, for the images of {topic.image.name} cannot be read ({refusal}); "
            f"--set {key}=null leaves the camera out"
        )
    if topic.info is not None and not topic.info.problem:
        entry.content["camera_info"] = {"topic": topic.info.name}
    elif "camera_info" not in answers:
        entry.missing[f"{key}.camera_info"] = _lens(recording, topic.info)
    mount = mount_of(recording.frames, recording.vehicle or "", names, name)
    if mount.frame:
        entry.content["frame"] = mount.frame
    if recording.will_tell(mount.frame) or set(answers) & set(_PLACES):
        return entry
    if mount.vehicle_from_cam is not None:
        entry.content["mounting"] = mounting_of(mount.vehicle_from_cam)
        return entry
    entry.missing[f"{key}.mounting"] = _mounting(recording, name, mount)
    entry.content["mounting"] = "?"
    return entry


def _lens(recording: Recording, info: InfoSample | None) -> str:
    """The question for the intrinsics of a camera, where the bag has none."""
    if info is not None:
        return f"{LENS} ({info.name}: {info.problem})"
    others = [sample.name for sample in recording.samples.infos.values() if not sample.problem]
    return f"{LENS} (the bag has {{topic: {', '.join(others[:MOST_NAMES])}}})" if others else LENS


def _mounting(recording: Recording, name: str, mount: Mount) -> str:
    """The question for the mounting of a camera, where the bag does not tell."""
    asked = MOUNTING.format(origin=recording.origin)
    if mount.offer:
        return f"{mount.problem}; if the images are of a camera that looks along its x axis: {mount.offer}"
    offers = frames_like(recording.frames, recording.vehicle, name) if recording.vehicle else []
    takes = f"--set cameras.{name}.frame={' or '.join(offers)} takes one"
    reason = mount.problem
    if not reason and offers:
        reason = (
            f"its images name {f'{mount.frame!r}, which no transform has' if mount.frame else 'no frame'}"
        )
    reasons = [reason] * bool(reason) + [takes] * bool(offers)
    return f"{asked} ({'; '.join(reasons)})" if reasons else asked
