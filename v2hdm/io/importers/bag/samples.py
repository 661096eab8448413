"""Samples of a bag's topics, from their first messages: images, lenses, poses and headings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.geodetic import enu_from_geodetic
from v2hdm.io.calibration.reading import info_numbers, info_of
from v2hdm.io.importers.bag import messages as kinds
from v2hdm.io.importers.bag.frames import frame_name
from v2hdm.io.importers.bag.reading import Bag, Message, Topic, in_child_of, open_bag
from v2hdm.io.importers.bag.streams import INFO_KIND, STAMPS, frame_of, stamp_of
from v2hdm.records import FloatArray, GeodeticOrigin
from v2hdm.safe.pixels import AS_STORED, pixels_of

POSE_KINDS = kinds.POSE_KINDS[:-1]  # without transforms, which share their topic

_IMAGES = 40  # images and lenses that are looked at per topic: times enough to compare two topics
_POSES = 1000  # poses that are looked at per topic: 10 s of the fastest
_BEST_SHARE = 0.1  # of the poses looked at are at least as sure as a topic's sigma says
_NORMS = (0.5, 1.5)  # within which the norm of a quaternion is if it was set at all; chosen
_NEVER_TURNED = 1e-9  # elements of a quaternion that are this near to the identity's were never set


@dataclass(frozen=True, kw_only=True)
class Sample:
    """A topic and what its first messages show; ``problem`` says why they are useless."""

    name: str
    kind: str
    messages: int
    frame: str = ""  # whose image, or pose, it is
    stamp_s: list[float] = field(default_factory=list)  # of the first messages' headers
    problem: str = ""

    @property
    def rate_hz(self) -> float:
        """Messages a second; nan where that is not known."""
        span_s = float(np.ptp(self.stamp_s)) if len(self.stamp_s) > 1 else 0.0
        return (len(self.stamp_s) - 1) / span_s if span_s > 0 else np.nan


@dataclass(frozen=True, kw_only=True)
class ImageSample(Sample):
    """A topic of images."""

    form: str = ""  # encoding of raw ones, format of compressed ones
    size_px: list[int] | None = None  # width and height
    is_wide: bool = False  # whether compressed pixels are numbers of more than 8 bits
    refusal: str = ""  # of its first image by the reader of images


@dataclass(frozen=True, kw_only=True)
class InfoSample(Sample):
    """A topic of intrinsics."""

    size_px: list[int] | None = None  # width and height
    lens: list[float] = field(default_factory=list)  # camera matrix (9), R (9), P (12) and distortion

    @property
    def baseline(self) -> float:
        """The baseline of a stereo pair's second camera in P, px m; 0 of others."""
        return self.lens[21] if len(self.lens) > 21 else 0.0


@dataclass(frozen=True, kw_only=True)
class PoseSample(Sample):
    """A topic of poses or headings."""

    parent: str = ""  # the frame that they are in
    moved_m: float = np.nan  # largest distance of a position from the first
    sigma_m: float = np.nan  # of the surer positions, as stated or by the fix's status
    sigma_rad: float = np.nan  # of the surer headings, as stated
    has_heading: bool = False
    is_turned: bool = False  # whether a heading is another one than the identity


@dataclass(frozen=True)
class Samples:
    """The topics of a bag and samples of those that a drive may need, by their names."""

    topics: dict[str, Topic]
    images: dict[str, ImageSample]
    infos: dict[str, InfoSample]
    poses: dict[str, PoseSample]
    headings: dict[str, PoseSample]


def samples_of(path: Path) -> Samples:
    """The samples of the bag at ``path``; DriveError where it cannot be opened."""
    plain = in_child_of(path, sample_bag)
    topics = [Topic(**content) for content in plain["topics"]]
    images = [ImageSample(**content) for content in plain["images"]]
    infos = [InfoSample(**content) for content in plain["infos"]]
    poses = [PoseSample(**content) for content in plain["poses"]]
    headings = [PoseSample(**content) for content in plain["headings"]]
    return Samples(
        {topic.name: topic for topic in topics},
        {sample.name: sample for sample in images},
        {sample.name: sample for sample in infos},
        {sample.name: sample for sample in poses},
        {sample.name: sample for sample in headings},
    )


def sample_bag(path: Path) -> dict[str, list[dict[str, Any]]]:
    """The topics of a bag and the samples of them, in plain values."""
    with open_bag(path) as bag:
        recorded = [topic for topic in bag.topics.values() if topic.messages]
        tracks = [topic for topic in recorded if topic.messages > 1]
        cameras = [topic for topic in recorded if topic.kind in kinds.IMAGE_KINDS]
        samples: dict[str, Sequence[Sample]] = {
            "images": [_image_sample(bag, topic) for topic in cameras],
            "infos": [_info_sample(bag, topic) for topic in recorded if topic.kind == INFO_KIND],
            "poses": [_pose_sample(bag, topic) for topic in tracks if topic.kind in POSE_KINDS],
            "headings": [
                _heading_sample(bag, topic) for topic in tracks if topic.kind in (kinds.QUATERNION, kinds.IMU)
            ],
        }
        plain = {name: [asdict(sample) for sample in group] for name, group in samples.items()}
        return plain | {"topics": [asdict(topic) for topic in bag.topics.values()]}


def _first(bag: Bag, topic: Topic, count: int) -> Iterator[Message]:
    return islice(bag.messages([topic.name]), count)


def _image_sample(bag: Bag, topic: Topic) -> ImageSample:
    about: dict[str, Any] = asdict(topic)
    stamps: list[float] = []
    try:
        for message in _first(bag, topic, _IMAGES):
            if not len(message.fields.data):
                continue
            if not stamps:
                about |= {"frame": frame_of(message)} | _look_of(message)
            stamps.append(stamp_of(message, STAMPS[0]))
    except DriveError as refusal:
        about["problem"] = str(refusal)
    return ImageSample(**about, stamp_s=stamps)


def _look_of(message: Message) -> dict[str, Any]:
    """The form of an image and its size, or what is wrong with it."""
    fields = message.fields
    if form := kinds.video_format(message.kind, fields):
        return {"form": form}
    if message.kind == kinds.RAW:
        look: dict[str, Any] = {"form": fields.encoding, "size_px": [int(fields.width), int(fields.height)]}
        return look | _refusal_of(lambda: kinds.file_of(message.kind, fields, _HERE))
    look = {"form": fields.format}

    def decode() -> None:
        pixels = pixels_of(fields.data.tobytes(), Path(_HERE), AS_STORED)
        is_wide = pixels.dtype != np.uint8 and pixels.ndim == 2 and not fields.format.startswith("bayer")
        look.update(size_px=[pixels.shape[1], pixels.shape[0]], is_wide=is_wide)
        kinds.file_of(message.kind, fields, _HERE)

    return _refusal_of(decode) | look


_HERE = "first message"


def _refusal_of(read: Callable[[], object]) -> dict[str, str]:
    try:
        read()
    except DriveError as refusal:
        return {"refusal": str(refusal).removeprefix(f"{_HERE}: ")}
    return {}


def _info_sample(bag: Bag, topic: Topic) -> InfoSample:
    about: dict[str, Any] = asdict(topic)
    stamps: list[float] = []
    try:
        for message in _first(bag, topic, _IMAGES):
            if not stamps:
                about |= {"frame": frame_of(message)} | _lens_of(message.fields)
            stamps.append(stamp_of(message, STAMPS[0]))
    except DriveError as refusal:
        about["problem"] = str(refusal)
    return InfoSample(**about, stamp_s=stamps)


def _lens_of(fields: Any) -> dict[str, Any]:
    lens = np.concatenate([info_numbers(fields, key) for key in ("k", "r", "p", "d")]).tolist()
    size_px = [int(fields.width), int(fields.height)]
    refusal = _refusal_of(lambda: info_of(fields, "camera", _HERE))
    return {"size_px": size_px, "lens": lens, "problem": refusal.get("refusal", "")}


def _pose_sample(bag: Bag, topic: Topic) -> PoseSample:
    about: dict[str, Any] = asdict(topic)
    stamps: list[float] = []
    rows: list[kinds.Row] = []
    try:
        for message in _first(bag, topic, _POSES):
            fields = message.fields
            if not stamps:
                about |= _frames_of(message)
            stamps.append(stamp_of(message, STAMPS[0]))
            if topic.kind != kinds.NMEA:
                rows.append(kinds.position_row(topic.kind, fields))
    except DriveError as refusal:
        about["problem"] = str(refusal)
    if rows:
        table = np.array(rows, dtype=np.float64)
        positions = table[:, :3]
        if topic.kind == kinds.FIX:
            positions = enu_from_geodetic(GeodeticOrigin(*positions[0].tolist()), positions)
        moved_m = np.linalg.norm(positions - positions[0], axis=1)
        about |= {"moved_m": _most(moved_m), "sigma_m": _best(table[:, 3])}
        about |= _turns_of(table[:, 4:8]) | {"sigma_rad": _best(table[:, 8])}
    return PoseSample(**about, stamp_s=stamps)


def _frames_of(message: Message) -> dict[str, str]:
    """Whose pose a message holds, and the frame that it is in."""
    header = frame_of(message)
    if message.kind == kinds.ODOMETRY:
        return {"frame": frame_name(message.fields.child_frame_id), "parent": header}
    if message.kind in kinds.HEADING_KINDS:
        return {"parent": header}  # a pose's header names the frame that it is in, not whose it is
    return {"frame": header}


def _heading_sample(bag: Bag, topic: Topic) -> PoseSample:
    about: dict[str, Any] = asdict(topic)
    stamps: list[float] = []
    rows: list[kinds.Row] = []
    try:
        for message in _first(bag, topic, _POSES):
            if not stamps:
                about |= {"frame": frame_of(message)}
            stamps.append(stamp_of(message, STAMPS[0]))
            rows.append(kinds.heading_row(topic.kind, message.fields))
    except DriveError as refusal:
        about["problem"] = str(refusal)
    if rows:
        table = np.array(rows, dtype=np.float64)
        about |= _turns_of(table[:, :4]) | {"sigma_rad": _best(table[:, 4])}
    return PoseSample(**about, stamp_s=stamps)


def _turns_of(quaternions: FloatArray) -> dict[str, bool]:
    """Whether quaternions (N, 4), x first, are headings, and whether they were ever set."""
    norms = np.linalg.norm(quaternions, axis=1)
    is_set = (norms > _NORMS[0]) & (norms < _NORMS[1])
    is_turned = np.abs(quaternions[:, :3]).max(axis=1) > _NEVER_TURNED
    return {"has_heading": bool(is_set.any()), "is_turned": bool((is_set & is_turned).any())}


def _best(sigmas: FloatArray) -> float:
    """The sigma that the surer ones of a topic are below; nan where none is stated."""
    stated = np.sort(sigmas[~np.isnan(sigmas)])
    return float(stated[int(_BEST_SHARE * len(stated))]) if len(stated) else np.nan


def _most(distances_m: FloatArray) -> float:
    finite_m = distances_m[np.isfinite(distances_m)]
    return float(finite_m.max()) if len(finite_m) else np.nan


def is_together(stamp_s: Sequence[float], other_s: Sequence[float], apart_s: float) -> bool:
    """Whether two topics' messages have the same times while both were recorded; False without messages."""
    if not len(stamp_s) or not len(other_s):
        return False
    begin_s = max(min(stamp_s), min(other_s)) - apart_s
    end_s = min(max(stamp_s), max(other_s)) + apart_s
    shared = [[stamp for stamp in stamps if begin_s <= stamp <= end_s] for stamps in (stamp_s, other_s)]
    fewer, more = sorted(shared, key=len)
    if not fewer or not any(fewer):  # or none has a time
        return False
    gaps_s = np.abs(np.array(fewer)[:, None] - np.array(more)).min(axis=1)
    return bool((gaps_s <= apart_s).mean() > _MOST_SHARE)


_MOST_SHARE = 0.8  # of the messages of the rarer topic that have one of the other's times; chosen
