"""Streams of a bag kept as files: images, intrinsics, poses, frames; one class per kind of stream.

One pass over the bag imports all streams that the cache lacks. A stream writes as messages come, so that its
memory grows with the bag by its list of images only.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from array import array
from collections import defaultdict
from collections.abc import Collection, Generator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.io.calibration.reading import info_numbers, info_of
from v2hdm.io.calibration.writing import write_camera_info
from v2hdm.io.image_lists import image_order, write_image_list
from v2hdm.io.importers.bag import messages as kinds
from v2hdm.io.importers.bag.frames import (
    ROW,
    TF_STATIC,
    TF_TOPIC,
    Edge,
    Frames,
    frame_name,
    tf_topics,
    transform_rows,
)
from v2hdm.io.importers.bag.reading import Bag, Message, bag_files, in_child_of, open_bag
from v2hdm.io.importers.nmea import nmea_readings
from v2hdm.io.importers.readings import Readings
from v2hdm.records import FloatArray
from v2hdm.safe.pixels import png
from v2hdm.store.folders import entry_folder, is_whole, new_entry
from v2hdm.store.remarks import keeping_warnings, tell_again

_log = logging.getLogger(__name__)

STAMPS = ("header", "received")  # times that count: the headers', or when the recorder received the message
INFO_KIND = "sensor_msgs/msg/CameraInfo"
IMAGE_LIST = "images.txt"
INFO_FILE = "camera_info.yaml"
_POSES = "positions.txt"
_HEADINGS = "headings.txt"
_RATES = "rates.txt"
_KIND = "kind.txt"
_TRANSFORMS = "transforms.txt"

Writer = Generator[None, Message | None, None]  # is sent its messages, then None; closing closes its files


class Need(NamedTuple):
    """A topic that a stream needs, the types of message that it may be of, and where it is asked for."""

    topic: str
    kinds: Collection[str]
    where: str


class Stream(ABC):
    """One stream of a bag, which ``label`` and ``settings`` tell from others; ``needs`` are its topics."""

    def __init__(self, label: str, settings: Any, where: str, needs: Sequence[Need] = ()) -> None:
        self.label = label
        self.settings = settings
        self.where = where
        self.needs = needs

    def topics(self, bag: Bag) -> Sequence[str]:
        """The topics to read; raises DriveError if the bag lacks one or has it with another type."""
        return [bag.need(need.topic, need.kinds, need.where).name for need in self.needs]

    @abstractmethod
    def write(self, folder: Path) -> Writer:
        """Write the messages into ``folder``."""


class ImageStream(Stream):
    """Images of a topic as files, with their list."""

    def __init__(self, topic: str, stamps: str, where: str) -> None:
        need = Need(topic, kinds.IMAGE_KINDS, where)
        super().__init__(topic, ["images with colours", stamps], where, [need])
        self._stamps = stamps

    def write(self, folder: Path) -> Writer:
        """Write an image file per message, or per frame of a video, and the list of them."""
        stamp_s = array("d")
        names = dict[int, str]()
        topic = f"{self.where}: topic {self.label}"
        decoder: kinds.VideoDecoder | None = None

        def put(number: int, suffix: str, data: bytes) -> None:
            names[number] = f"{number:06d}{suffix}"
            (folder / names[number]).write_bytes(data)

        def decode(decoder: kinds.VideoDecoder, data: bytes | None) -> None:
            for number, pixels in decoder.frames(data, len(stamp_s) - 1):
                put(number, ".png", png(pixels))

        while (message := (yield)) is not None:
            number = len(stamp_s)
            stamp_s.append(stamp_of(message, self._stamps))
            if not len(message.fields.data):
                continue
            if form := kinds.video_format(message.kind, message.fields):
                decoder = decoder or kinds.VideoDecoder(form, topic)
                decode(decoder, message.fields.data.tobytes())
            else:
                suffix, data = kinds.file_of(message.kind, message.fields, f"{topic}, image {number + 1}")
                put(number, suffix, data)
        if decoder is not None:
            decode(decoder, None)
        is_video = decoder is not None
        if len(names) < len(stamp_s):
            things = "packets of video: no key frame before them" if is_video else "images, which are empty"
            _log.warning("%s: left out %d of %d %s", topic, len(stamp_s) - len(names), len(stamp_s), things)
        if not names:
            problem = "its video has no key frame" if is_video else "all of its images are empty"
            raise DriveError(f"{topic}: {problem}; record images")
        numbers = np.array(sorted(names))
        taken_s = np.array(stamp_s)[numbers]
        rows = image_order(taken_s, topic, numbers=(numbers + 1).tolist())
        write_image_list(taken_s[rows], [names[k] for k in numbers[rows]], folder / IMAGE_LIST)


class InfoStream(Stream):
    """Intrinsics of a topic, the same in each of its messages, for images that are ``rectified`` or not."""

    def __init__(self, topic: str, where: str, *, rectified: bool = False) -> None:
        settings = ["camera_info", "rectified"] if rectified else ["camera_info"]
        super().__init__(topic, settings, where, [Need(topic, [INFO_KIND], where)])
        self._rectified = rectified

    def write(self, folder: Path) -> Writer:
        """Write the first message as ``camera_info``."""
        if (first := (yield)) is not None:
            where = f"{self.where}: topic {self.label}"
            intrinsics = info_of(first.fields, self.label, where, self._rectified)
            write_camera_info(intrinsics.info, folder / INFO_FILE, intrinsics.rectified_from_camera)
            number = 1
            lens = _lens(first.fields)
            while (later := (yield)) is not None:
                number += 1
                if _lens(later.fields) != lens:
                    raise DriveError(
                        f"{where}: message {number} has another lens than the first; map the parts of the "
                        "recording separately, or give the right camera_info as a file"
                    )


class PoseStream(Stream):
    """Positions of a topic, and headings of another one if need be, as rows of numbers."""

    def __init__(
        self, topic: str, heading_topic: str | None, gyro_topic: str | None, stamps: str, where: str
    ) -> None:
        needs = [Need(topic, kinds.POSE_KINDS, where)]
        label = ["poses with status", heading_topic, stamps]
        if gyro_topic is not None:
            needs.append(Need(gyro_topic, (kinds.IMU,), f"{where}, gyro_topic"))
            label.append(gyro_topic)
        if heading_topic is not None:
            needs.append(Need(heading_topic, kinds.HEADING_KINDS, f"{where}, heading_topic"))
        super().__init__(topic, label, where, needs)
        self._heading = heading_topic
        self._gyro = gyro_topic
        self._stamps = stamps

    def write(self, folder: Path) -> Writer:
        """Write rows of positions and of headings, and the type of the messages."""
        kind = ""
        with (
            (folder / _POSES).open("w", encoding="utf-8") as positions,
            (folder / _HEADINGS).open("w", encoding="utf-8") as headings,
            (folder / _RATES).open("w", encoding="utf-8") as rates,
        ):
            while (message := (yield)) is not None:
                stamp_s = stamp_of(message, self._stamps)
                if message.topic == self.label:
                    kind = message.kind
                    if kind == kinds.NMEA:
                        positions.write(f"{stamp_s!r} {message.fields.sentence.strip()}\n")
                    else:
                        _write_row(positions, stamp_s, kinds.position_row(kind, message.fields))
                if message.topic == self._heading:
                    _write_row(headings, stamp_s, kinds.heading_row(message.kind, message.fields))
                if message.topic == self._gyro:
                    _write_row(rates, stamp_s, kinds.rate_row(message.fields))
        (folder / _KIND).write_text(kind, encoding="utf-8")

    def readings(self, folder: Path) -> Readings:
        """The readings that the entry in ``folder`` holds."""
        readings = self._poses(folder)
        if self._gyro is None:
            return readings
        stamp_s, rates = _read_rows(folder / _RATES, 4)
        where = f"{self.where}, gyro_topic {self._gyro}"
        return replace(readings, rates=kinds.rates_of(stamp_s, rates, where))

    def _poses(self, folder: Path) -> Readings:
        kind = (folder / _KIND).read_text(encoding="utf-8")
        where = f"{self.where}, topic {self.label}"
        if kind == kinds.NMEA:
            text = (folder / _POSES).read_text(encoding="utf-8")
            rows = [line.split(" ", 1) for line in text.splitlines()]
            stamps = [stamp_s for stamp, _ in rows if (stamp_s := float(stamp))]
            near_s = float(np.median(stamps)) if stamps else None
            return nmea_readings([sentence for _, sentence in rows], where, near_s=near_s)
        headings = None if self._heading is None else _read_rows(folder / _HEADINGS, 6)
        return kinds.readings_of(kind, _read_rows(folder / _POSES, 11), headings, where)


class TfStream(Stream):
    """Transforms of ``/tf`` and ``/tf_static``; of a bag without them none, unless they are ``needed``."""

    def __init__(self, where: str, *, needed: bool = True) -> None:
        super().__init__("tf", ["tf", ROW], where)
        self._needed = needed

    def topics(self, bag: Bag) -> Sequence[str]:
        """Its topics in the bag."""
        types = (kinds.TF, kinds.OLD_TF)
        recorded = tf_topics(topic.name for topic in bag.topics.values() if topic.messages)
        if not self._needed:
            return [name for name in recorded if bag.topics[name].kind in types]
        if not recorded:
            raise DriveError(f"{self.where}: {bag.path} has no transforms on {TF_TOPIC} or {TF_STATIC}")
        return [bag.need(name, types, self.where).name for name in recorded]

    def write(self, folder: Path) -> Writer:
        """Write a row per transform."""
        with (folder / _TRANSFORMS).open("w", encoding="utf-8") as file:
            while (message := (yield)) is not None:
                for edge, row in transform_rows(message.fields, message.topic):
                    file.write("\t".join([*edge, *map(repr, map(float, row))]) + "\n")

    def frames(self, folder: Path) -> Frames:
        """The frames that the entry in ``folder`` holds."""
        rows: dict[Edge, array[float]] = defaultdict(lambda: array("d"))
        with (folder / _TRANSFORMS).open(encoding="utf-8") as lines:
            for line in lines:
                parent, child, *values = line.rstrip("\n").split("\t")
                rows[parent, child].extend(map(float, values))
        edges = {edge: np.array(flat).reshape(-1, ROW) for edge, flat in rows.items()}
        return Frames(edges, self.where)


def import_streams(path: Path, streams: Sequence[Stream], cache: Path) -> list[Path]:
    """The folders of ``streams``, imported now unless before; raises DriveError where that fails."""
    files = bag_files(path)
    folders = [entry_folder(cache, files, stream.label, stream.settings) for stream in streams]
    missing = {
        folder: stream for folder, stream in zip(folders, streams, strict=True) if not is_whole(folder)
    }
    for folder, stream in zip(folders, streams, strict=True):
        if folder not in missing:
            tell_again(folder, stream.where)
    if not missing:
        return folders
    size_mb = sum(file.stat().st_size for file in files) / 1e6
    labels = ", ".join(stream.label for stream in missing.values())
    _log.info("%s: importing %s from %.0f MB into %s, once", path, labels, size_mb, cache)
    with ExitStack() as entries:
        partial = {entries.enter_context(new_entry(folder)): stream for folder, stream in missing.items()}
        in_child_of(path, write_streams, partial)
    return folders


def write_streams(path: Path, streams: Mapping[Path, Stream]) -> None:
    """Write streams of the bag at ``path`` into their folders, in one pass."""
    takers: dict[str, list[_Taker]] = defaultdict(list)
    everyone: list[_Taker] = []
    with open_bag(path) as bag, keeping_warnings() as keeper, ExitStack() as unfinished:
        for folder, stream in streams.items():
            topics = stream.topics(bag)
            taker = _Taker(stream.write(folder), folder, stream.where)
            unfinished.callback(taker.writer.close)
            everyone.append(taker)
            next(taker.writer)
            for topic in topics:
                takers[topic].append(taker)
        for message in bag.messages(takers):
            for taker in takers[message.topic]:
                keeper.turn_to(taker.folder, taker.where)
                taker.writer.send(message)
        for taker in everyone:
            keeper.turn_to(taker.folder, taker.where)
            next(taker.writer, None)  # sends None


class _Taker(NamedTuple):
    """The writer of a stream, its folder, and where its topic is named."""

    writer: Writer
    folder: Path
    where: str


def _lens(fields: Any) -> list[float]:
    """Size, camera matrix and distortion."""
    return [fields.width, fields.height, *info_numbers(fields, "k"), *info_numbers(fields, "d")]


def stamp_of(message: Message, stamps: str) -> float:
    """The time of a message, s, as one of ``STAMPS``; 0 in a header without one."""
    if stamps == "received":
        return message.received_s
    fields = message.fields
    stamp = fields.timestamp if message.kind == kinds.VIDEO else fields.header.stamp
    return float(stamp.sec + stamp.nanosec / 1e9)


def frame_of(message: Message) -> str:
    """The frame that a message's header names."""
    fields = message.fields
    return frame_name(fields.frame_id if message.kind == kinds.VIDEO else fields.header.frame_id)


def _write_row(file: TextIO, stamp_s: float, row: kinds.Row) -> None:
    file.write(" ".join(repr(float(number)) for number in (stamp_s, *row)) + "\n")


def _read_rows(path: Path, columns: int) -> tuple[FloatArray, FloatArray]:
    table = np.loadtxt(path, ndmin=2).reshape(-1, columns)
    return table[:, 0], table[:, 1:]
