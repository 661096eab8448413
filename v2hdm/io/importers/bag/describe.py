"""A bag without a ``drive.yaml``: its description from topics and frames, as far as they suffice."""

from __future__ import annotations

import logging
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.io.importers.bag import messages as kinds
from v2hdm.io.importers.bag.cameras import CameraTopic, Choice, choose_cameras, info_of_images
from v2hdm.io.importers.bag.entries import Entry, Recording, camera_entry, part_of, poses_entry
from v2hdm.io.importers.bag.frames import MOST_NAMES, VEHICLES
from v2hdm.io.importers.bag.positions import position_candidates, the_one
from v2hdm.io.importers.bag.reading import bag_files
from v2hdm.io.importers.bag.samples import InfoSample, Samples, samples_of
from v2hdm.io.importers.bag.streams import TfStream, import_streams
from v2hdm.store.files import dump_yaml, load_yaml
from v2hdm.store.folders import entry_folder, is_whole, new_entry

_log = logging.getLogger(__name__)

_DESCRIPTION = "drive.yaml"
_NOTES = "notes.txt"
HEIGHT = "vehicle_frame_height_m"


def describe_bag(path: Path, cache: Path, chosen: Sequence[str] = ()) -> dict[str, Any]:
    """The content of a ``drive.yaml`` for the bag at ``path``; DriveError where it does not suffice.

    ``chosen`` are the cameras that are wanted, all where none is named.
    """
    folder = entry_folder(cache, bag_files(path), "drive", ["bare", 2, sorted(chosen)])
    if not is_whole(folder):
        description = BagDescription(path, cache, chosen=chosen)
        if description.missing:
            raise DriveError(
                f"{path}: does not state {', '.join(description.missing)}; "
                f"v2hdm check {path.name} --write FOLDER asks for it and writes the drive.yaml"
            )
        with new_entry(folder) as partial:
            (partial / _DESCRIPTION).write_text(dump_yaml(description.content), encoding="utf-8")
            (partial / _NOTES).write_text("\n".join(description.notes), encoding="utf-8")
    log_notes(path, (folder / _NOTES).read_text(encoding="utf-8").splitlines())
    return load_yaml(folder / _DESCRIPTION, DriveError) | {"bag": path.name}


def log_notes(path: Path, notes: Sequence[str]) -> None:
    """Say what was decided about the bag at ``path``, and may be wrong."""
    for note in notes:
        _log.info("%s: %s", path, note)


def list_topics(path: Path, cache: Path) -> str:
    """The topics of a bag with types and counts, and the ``drive.yaml`` for it as far as it is known."""
    samples = samples_of(path)
    topics = samples.topics.values()
    width = max((len(topic.name) for topic in topics), default=0)
    lines = [f"{topic.name:<{width}}  {topic.messages:>8}  {topic.kind}" for topic in topics]
    if not samples.images:
        return "\n".join([*lines, "", "# no image topic: not a drive"])
    description = BagDescription(path, cache, samples=samples)
    notes = [f"# {note}" for note in description.notes]
    gaps = f"; missing: {', '.join(description.missing)}" if description.missing else ""
    content = dump_yaml(description.content).rstrip()
    return "\n".join([*lines, "", *notes, f"# drive.yaml{gaps}", content])


class BagDescription:
    """The ``content`` of a ``drive.yaml`` as far as a bag tells it, and the ``missing`` keys, dotted.

    ``answers`` are what its user states of that content already, ``chosen`` the cameras that are wanted.
    ``notes`` say what was decided that may be wrong.
    """

    def __init__(
        self,
        path: Path,
        cache: Path,
        answers: Mapping[str, Any] | None = None,
        chosen: Sequence[str] = (),
        samples: Samples | None = None,
    ) -> None:
        self.missing: dict[str, str] = {}
        self.notes: list[str] = []
        self._path = path
        self._answers = answers or {}
        self._samples = samples or samples_of(path)
        if not self._samples.images:
            raise DriveError(f"{path}: has no image topic ({', '.join(kinds.IMAGE_KINDS)}); not a drive")
        stream = TfStream(f"{path}: tf", needed=False)
        self._frames = stream.frames(import_streams(path, [stream], cache)[0])
        topics = self._cameras(chosen)
        names_of_camera = {name: self._frame_names(name, topic) for name, topic in topics.items()}
        vehicle = self._choose_vehicle(names_of_camera.values())
        recording = Recording(path, self._samples, self._frames, vehicle)
        poses = self._taken(poses_entry(recording, self._answers.get("poses")))
        cameras = {
            name: self._taken(
                camera_entry(recording, name, topic, names_of_camera[name], self._answers_for(name))
            )
            for name, topic in topics.items()
        }
        about: dict[str, Any] = {"name": path.stem, "bag": path.name}
        if vehicle:
            about["vehicle_frame"] = vehicle
            height_m = self._frames.height_m(vehicle)
            is_ground = vehicle.rpartition("/")[2] == VEHICLES[0]
            if height_m is not None:
                about[HEIGHT] = round(height_m, 4)
            elif self.missing and not is_ground and HEIGHT not in self._answers:
                self.notes.append(
                    f"{vehicle} is taken to be on the ground; else also set {HEIGHT}, its height in m"
                )
        self.content = about | {"poses": poses, "cameras": cameras}

    def _taken(self, entry: Entry) -> dict[str, Any]:
        """The content of an entry, whose questions and notes are taken."""
        self.missing |= entry.missing
        self.notes += entry.notes
        return entry.content

    def _cameras(self, chosen: Sequence[str]) -> dict[str, CameraTopic]:
        """The topics of the cameras that are wanted."""
        choice = choose_cameras(self._samples, self._frames)
        answers = part_of(self._answers, "cameras")
        cameras = dict(choice.cameras)
        for name, entry in answers.items():
            if entry is None:
                if name not in choice.cameras and name not in choice.left_out:
                    self._refuse_camera(f"cameras.{name}", choice)
                cameras.pop(name, None)
                continue
            topic = part_of(entry, "images").get("topic")
            if topic is not None:
                image = self._samples.images.get(str(topic))
                if image is None:
                    offers = ", ".join(self._samples.images)
                    raise DriveError(f"--set cameras.{name}.images.topic: no images on {topic}; on {offers}")
                cameras[name] = CameraTopic(image, info_of_images(image, self._samples))
            elif name in choice.left_out and not part_of(entry, "images") and name not in choice.cameras:
                self._refuse_camera(f"cameras.{name}", choice)
        for name in chosen:
            if name not in cameras:
                self._refuse_camera(f"--camera {name}", choice)
        selection = {name: topic for name, topic in cameras.items() if not chosen or name in chosen}
        if not selection:
            reasons = [
                f"{left.image.name}: {left.reason}" for left in choice.left_out.values() if left.reason
            ]
            raise DriveError(f"{self._path}: no camera is left; {'; '.join(reasons) or 'leave fewer out'}")
        image_topics = {topic.image.name for topic in selection.values()}
        for name, left in choice.left_out.items():
            if left.reason and left.image.name not in image_topics and answers.get(name, {}) is not None:
                self.notes.append(f"{left.image.name} left out: {left.reason}")
        return selection

    def _answers_for(self, name: str) -> Mapping[str, Any]:
        return part_of(part_of(self._answers, "cameras"), name)

    def _refuse_camera(self, what: str, choice: Choice) -> None:
        name = re.split(r"[. ]", what)[-1]
        if name in choice.left_out:
            left = choice.left_out[name]
            reason = left.reason or "the same images are on another topic"
            way_in = f"; cameras.{name}.images.topic={left.image.name} takes it in"
            says = "" if left.image.refusal or left.image.problem else way_in
            raise DriveError(f"{what}: {left.image.name} is left out: {reason}{says}")
        raise DriveError(f"{what}: no camera of that name; choose from: {', '.join(choice.cameras)}")

    def _frame_names(self, name: str, topic: CameraTopic) -> list[str]:
        """The frames that a camera's messages name, or its user."""
        answer = self._answers_for(name).get("frame")
        if isinstance(answer, str):
            return [self._frames.needed(answer, f"{self._path}: cameras.{name}.frame")]
        info = self._info_of(name, topic)
        named = [topic.image.frame, "" if info is None else info.frame]
        return [frame for frame in dict.fromkeys(named) if frame]

    def _info_of(self, name: str, topic: CameraTopic) -> InfoSample | None:
        """The intrinsics of a camera in the bag, as its user chooses them."""
        info_topic = part_of(self._answers_for(name), "camera_info").get("topic")
        return topic.info if info_topic is None else self._samples.infos.get(str(info_topic))

    def _choose_vehicle(self, names_of_cameras: Collection[Sequence[str]]) -> str | None:
        """The vehicle's frame as the bag tells it; empty where it has none, None where it is asked for."""
        answer = self._answers.get("vehicle_frame")
        if isinstance(answer, str):
            return self._frames.needed(answer, f"{self._path}: vehicle_frame")
        frames = [[self._frames.named(name) for name in names] for names in names_of_cameras]
        in_tree = [next(filter(None, named)) for named in frames if any(named)]
        vehicle = self._frames.vehicle_of(in_tree)
        if vehicle is not None:
            return vehicle
        if not self._frames.names:
            frames_of_poses = {pose.frame for pose in self._samples.poses.values()}
            best = the_one(position_candidates(self._samples, np.inf, lambda frame: False))
            moved = frames_of_poses if best is None else {best.sample.frame}
            vehicles = [frame for frame in moved if frame.rpartition("/")[2] in VEHICLES]
            return vehicles[0] if len(vehicles) == 1 else ""
        holders = self._frames.holders(in_tree)
        if not in_tree or not holders:
            return ""
        self.missing["vehicle_frame"] = (
            "the frame that the vehicle moves with, x forward, level, best on the ground under the rear "
            f"axle; the cameras hang on {', '.join(holders[:MOST_NAMES])}"
        )
        return None
