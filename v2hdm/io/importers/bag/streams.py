"""What of a bag is kept as files: images, intrinsics, poses, frames; one class a kind of stream.

A stream writes as messages come, so that its memory grows with the bag by its list of images only.

A bag's streams as entries of the cache: one pass over the bag for all that are not there yet.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from array import array
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.io.calibration.reading import info_of
from v2hdm.io.calibration.writing import write_camera_info
from v2hdm.io.importers.bag import messages as poses
from v2hdm.io.importers.bag.messages import IMAGE_KINDS, VIDEO, VideoDecoder, file_of
from v2hdm.io.importers.bag.reading import Bag, Message, bag_files, open_bag
from v2hdm.io.importers.bag.tf import TF_STATIC, TF_TOPIC, Edge, Frames, frame_name, transform_rows
from v2hdm.io.importers.imported import (
    begin_entry,
    cannot_write,
    drop_entry,
    entry_folder,
    finish_entry,
    is_whole,
)
from v2hdm.io.importers.tables import Readings
from v2hdm.io.safe.pixels import png
from v2hdm.io.trajectory import write_image_list
from v2hdm.records import FloatArray

_log = logging.getLogger(__name__)

STAMPS = ("header", "received")
"""Times that count: those of the messages' headers, or those at which the recorder received them."""

INFO_KIND = "sensor_msgs/msg/CameraInfo"

IMAGE_LIST, INFO_FILE = "images.txt", "camera_info.yaml"
_POSES, _HEADINGS, _KIND, _TRANSFORMS = "positions.txt", "headings.txt", "kind.txt", "transforms.txt"


class Stream(ABC):
    """One stream: ``label`` and ``settings`` tell it from others of the bag."""

    def __init__(self, label: str, settings: Any, where: str) -> None:
        self.label, self.settings, self.where = label, settings, where

    @abstractmethod
    def topics(self, bag: Bag) -> Sequence[str]:
        """The topics to be read.

        Raises:
            DriveError: the bag does not have them, or they are of another type.
        """

    @abstractmethod
    def begin(self, folder: Path) -> None:
        """Make ready to write into ``folder``."""

    @abstractmethod
    def take(self, message: Message) -> None:
        """Write one message."""

    @abstractmethod
    def finish(self) -> None:
        """Write what comes last; called without an error only."""

    def close(self) -> None:  # noqa: B027  # most hold nothing open
        """Let go of open files, whatever has happened."""


class ImageStream(Stream):
    """Images of a topic as files, with their list."""

    def __init__(self, topic: str, stamps: str, where: str) -> None:
        super().__init__(topic, ["images", stamps], where)
        self._stamps = stamps

    def topics(self, bag: Bag) -> Sequence[str]:
        """The topics of this stream, found and of a type that it understands."""
        return [bag.need(self.label, (*IMAGE_KINDS, VIDEO), self.where).name]

    def begin(self, folder: Path) -> None:
        """Make ready to write into ``folder``."""
        self._folder = folder
        self._taken_s = array("d")
        self._names: dict[int, str] = {}
        self._decoder: VideoDecoder | None = None

    def take(self, message: Message) -> None:
        """Write one message."""
        number = len(self._taken_s)
        where = f"{self.where}: topic {self.label}, image {number + 1}"
        stamp_s = stamp_of(message, self._stamps, not number, where)
        if number and stamp_s <= self._taken_s[-1]:
            raise DriveError(
                f"{where}: its time {stamp_s:.6f} s is not after that of the one before "
                f"({self._taken_s[-1]:.6f} s): two clocks or two recordings in one topic; keep one of them"
            )
        self._taken_s.append(stamp_s)
        if message.kind == VIDEO:
            if self._decoder is None:
                self._decoder = VideoDecoder(message.fields.format, f"{self.where}: topic {self.label}")
            self._decode(self._decoder, message.fields.data.tobytes())
        else:
            self._write(number, *file_of(message.kind, message.fields, where))

    def _decode(self, decoder: VideoDecoder, data: bytes | None) -> None:
        for number, pixels in decoder.frames(data, len(self._taken_s) - 1):
            self._write(number, ".png", png(pixels))

    def _write(self, number: int, suffix: str, data: bytes) -> None:
        self._names[number] = f"{number:06d}{suffix}"
        (self._folder / self._names[number]).write_bytes(data)

    def finish(self) -> None:
        """Write what comes last."""
        if self._decoder is not None:
            self._decode(self._decoder, None)
        if len(self._names) < len(self._taken_s):
            _log.warning(
                "%s: topic %s: left out %d of %d packets of video: no key frame before them",
                self.where, self.label, len(self._taken_s) - len(self._names), len(self._taken_s),
            )  # fmt: skip
        if not self._names:
            raise DriveError(f"{self.where}: topic {self.label}: its video has no key frame; record images")
        numbers = sorted(self._names)
        names = [self._names[number] for number in numbers]
        write_image_list(np.array(self._taken_s)[numbers], names, self._folder / IMAGE_LIST)


class InfoStream(Stream):
    """Intrinsics of the first message of a topic, and the frame of the camera."""

    def __init__(self, topic: str, where: str) -> None:
        super().__init__(topic, ["camera_info"], where)

    def topics(self, bag: Bag) -> Sequence[str]:
        """The topics of this stream, found and of a type that it understands."""
        return [bag.need(self.label, [INFO_KIND], self.where).name]

    def begin(self, folder: Path) -> None:
        """Make ready to write into ``folder``."""
        self._folder = folder
        self._done = False

    def take(self, message: Message) -> None:
        """Write one message."""
        if not self._done:
            write_camera_info(
                info_of(message.fields, self.label, f"{self.where}: topic {self.label}"),
                self._folder / INFO_FILE,
            )
            self._done = True

    def finish(self) -> None:
        """All is written."""


class PoseStream(Stream):
    """Positions of a topic, and headings of another one if need be, as rows of numbers."""

    def __init__(self, topic: str, heading_topic: str | None, stamps: str, where: str) -> None:
        super().__init__(topic, ["poses", heading_topic, stamps], where)
        self._heading, self._stamps = heading_topic, stamps
        self._files: list[TextIO] = []

    def topics(self, bag: Bag) -> Sequence[str]:
        """The topics of this stream, found and of a type that it understands."""
        names = [bag.need(self.label, poses.POSE_KINDS, self.where).name]
        if self._heading is not None:
            names.append(bag.need(self._heading, poses.HEADING_KINDS, f"{self.where}, heading_topic").name)
        return names

    def begin(self, folder: Path) -> None:
        """Make ready to write into ``folder``."""
        self._folder = folder
        self._files = [(folder / name).open("w", encoding="utf-8") for name in (_POSES, _HEADINGS)]
        self._kind = ""
        self._begun: set[str] = set()

    def take(self, message: Message) -> None:
        """Write one message."""
        first = message.topic not in self._begun
        self._begun.add(message.topic)
        stamp_s = stamp_of(message, self._stamps, first, f"{self.where}: topic {message.topic}")
        if message.topic == self.label:
            self._kind = message.kind
            if message.kind == poses.NMEA:
                self._files[0].write(f"{stamp_s!r} {message.fields.sentence.strip()}\n")
            else:
                _write_row(self._files[0], stamp_s, poses.position_row(message.kind, message.fields))
        if message.topic == self._heading:
            _write_row(self._files[1], stamp_s, poses.heading_row(message.kind, message.fields))

    def finish(self) -> None:
        """Write what comes last."""
        (self._folder / _KIND).write_text(self._kind, encoding="utf-8")

    def close(self) -> None:
        """Close the files."""
        for file in self._files:
            file.close()

    def readings(self, folder: Path) -> Readings:
        """The readings that the entry in ``folder`` holds."""
        kind = (folder / _KIND).read_text(encoding="utf-8")
        where = f"{self.where}, topic {self.label}"
        if kind == poses.NMEA:
            lines = [
                line.split(" ", 1) for line in (folder / _POSES).read_text(encoding="utf-8").splitlines()
            ]
            stamp_s = np.array([float(stamp) for stamp, _ in lines])
            return poses.readings_of_sentences(stamp_s, [text for _, text in lines], where)
        headings = None if self._heading is None else _read_rows(folder / _HEADINGS, 6)
        return poses.readings_of(kind, _read_rows(folder / _POSES, 10), headings, where)


class TfStream(Stream):
    """Transforms of ``/tf_static``, and of ``/tf`` where frames that move are asked for."""

    def __init__(self, moving: bool, where: str) -> None:
        super().__init__("tf" if moving else "tf_static", ["tf"], where)
        self._wanted = [TF_TOPIC, TF_STATIC] if moving else [TF_STATIC]
        self._file: TextIO | None = None

    def topics(self, bag: Bag) -> Sequence[str]:
        """The topics of this stream, found and of a type that it understands."""
        if not any(name in bag.topics for name in self._wanted):
            raise DriveError(f"{self.where}: {bag.path} has no topic {' or '.join(self._wanted)}")
        return [
            bag.need(name, [poses.TF, poses.OLD_TF], self.where).name
            for name in self._wanted
            if name in bag.topics
        ]

    def begin(self, folder: Path) -> None:
        """Make ready to write into ``folder``."""
        self._file = (folder / _TRANSFORMS).open("w", encoding="utf-8")

    def take(self, message: Message) -> None:
        """Write one message."""
        assert self._file is not None
        for edge, row in transform_rows(message.fields):
            self._file.write("\t".join([*edge, *map(repr, map(float, row))]) + "\n")

    def finish(self) -> None:
        """All is written."""

    def close(self) -> None:
        """Close the files."""
        if self._file is not None:
            self._file.close()

    def frames(self, folder: Path) -> Frames:
        """The frames that the entry in ``folder`` holds."""
        rows: dict[Edge, array[float]] = defaultdict(lambda: array("d"))
        with (folder / _TRANSFORMS).open(encoding="utf-8") as lines:
            for line in lines:
                parent, child, *values = line.rstrip("\n").split("\t")
                rows[parent, child].extend(map(float, values))
        return Frames.of({edge: np.array(flat).reshape(-1, 8) for edge, flat in rows.items()}, self.where)


def stamp_of(message: Message, stamps: str, first: bool, where: str) -> float:
    """The time of a message, s; that of the ``first`` of a simulation may be zero.

    Raises:
        DriveError: its header has none.
    """
    if stamps == "received":
        return message.received_s
    fields = message.fields
    stamp = fields.timestamp if message.kind == VIDEO else fields.header.stamp
    if not stamp.sec and not stamp.nanosec and not first:
        raise DriveError(
            f"{where}: its header has no time; set stamps: received to take the recorder's, which come later "
            "by as much as the computer needed"
        )
    return float(stamp.sec + stamp.nanosec / 1e9)


def frame_of(message: Message) -> str:
    """The frame that a message's header names."""
    return frame_name(message.fields.header.frame_id)


def _write_row(file: TextIO, stamp_s: float, row: Sequence[float]) -> None:
    file.write(" ".join(map(repr, map(float, (stamp_s, *row)))) + "\n")


def _read_rows(path: Path, columns: int) -> tuple[FloatArray, FloatArray]:
    table = np.loadtxt(path, ndmin=2).reshape(-1, columns)
    return table[:, 0], table[:, 1:]


_log = logging.getLogger(__name__)


def import_streams(path: Path, streams: Sequence[Stream], cache: Path) -> list[Path]:
    """The folders of ``streams`` of the bag at ``path``, imported now unless they were before.

    Raises:
        DriveError: the bag is damaged, lacks a topic, or the cache cannot be written.
    """
    files = bag_files(path)
    folders = [entry_folder(cache, files, stream.label, stream.settings) for stream in streams]
    missing = {
        folder: stream for folder, stream in zip(folders, streams, strict=True) if not is_whole(folder)
    }
    if not missing:
        return folders
    size_mb = sum(file.stat().st_size for file in files) / 1e6
    labels = ", ".join(stream.label for stream in missing.values())
    _log.info("%s: importing %s from %.0f MB into %s, once", path, labels, size_mb, cache)
    try:
        with open_bag(path) as bag:
            takers: dict[str, list[Stream]] = defaultdict(list)
            for folder, stream in missing.items():
                for topic in stream.topics(bag):
                    takers[topic].append(stream)
                stream.begin(begin_entry(folder))
            for message in bag.messages(takers):
                for stream in takers[message.topic]:
                    stream.take(message)
            for folder, stream in missing.items():
                stream.finish()
                stream.close()
                finish_entry(folder)
    except OSError as failure:
        raise cannot_write(cache, failure) from None
    finally:
        for folder, stream in missing.items():
            stream.close()
            drop_entry(folder)
    return folders
