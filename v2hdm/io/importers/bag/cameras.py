"""Which image topics of a bag are its cameras: one per sensor, none of depth, none that a node has drawn."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence
from itertools import chain, count
from typing import NamedTuple

from v2hdm.errors import shown
from v2hdm.io.importers.bag import messages as kinds
from v2hdm.io.importers.bag.frames import Frames
from v2hdm.io.importers.bag.samples import ImageSample, InfoSample, Samples, is_together

# Of depth, thermal and label images (REP-118, sensor_msgs/image_encodings): more than 8 bits of one channel.
_NO_LIGHT = re.compile(r"\s*(mono(1[0-6])|(16|32|64)[USF]C1|Z16|Y1[0-6])\b|.*compresseddepth", re.IGNORECASE)
_RECTIFIED = re.compile(r"rect(?!angle)")
_TRANSPORTS = (
    "/compressed",
    "/compressedDepth",
    "/ffmpeg",
    "/foxglove",
    "/h264",
)  # ends of topics' names, of image_transport
_PLAIN = ("image_raw", "image_color", "image", "image_mono", "compressed")
"""Last names of a sensor's own images, the best first (image_proc)."""
_IMAGE_WORDS = frozenset(
    {"image", "image_raw", "image_color", "image_mono", "image_rect", "image_rect_color", "compressed",
     "camera", "cameras", "sensing", "sensors", "raw", "image_raw_compressed"}
)  # fmt: skip
_SAME_TIME_S = 1e-4  # largest difference of one image's stamps on two topics, s: some nodes round them
_OFTEN = 1.5  # how many times the messages of another topic make that the better one
_SAME_LENS = 1e-6  # relative difference of intrinsics that are the same


class CameraTopic(NamedTuple):
    """The images of a camera and its intrinsics, None where the bag has none of it."""

    image: ImageSample
    info: InfoSample | None


class LeftOut(NamedTuple):
    """A topic that is no camera, or another one's again, and why."""

    image: ImageSample
    reason: str  # empty where the same images come twice, which nobody needs to be told


class Choice(NamedTuple):
    """Cameras and topics that are none, by names."""

    cameras: dict[str, CameraTopic]
    left_out: dict[str, LeftOut]


def choose_cameras(samples: Samples, frames: Frames) -> Choice:
    """The cameras of a bag by its samples and its tree of frames."""
    topics = [CameraTopic(image, info_of_images(image, samples)) for image in samples.images.values()]
    chosen: list[CameraTopic] = []
    left_out: list[LeftOut] = []
    most = max((topic.image.messages for topic in topics), default=1)
    for topic in sorted(topics, key=lambda topic: _order(topic, most)):
        reason = _why_no_camera(topic.image)
        twin = next((other for other in chosen if _is_same_sensor(topic, other, frames)), None)
        if reason:
            left_out.append(LeftOut(topic.image, reason))
        elif twin is None:
            chosen.append(topic)
        else:
            is_again = _base(topic.image.name) == _base(twin.image.name)
            reason = "" if is_again else f"{_relation(topic, twin)} {twin.image.name}"
            left_out.append(LeftOut(topic.image, reason))
    chosen.sort(key=lambda topic: _base(topic.image.name))
    names = _names_of([topic.image.name for topic in chosen], ())
    names |= _names_of([topic.image.name for topic in left_out], set(names.values()))
    return Choice(
        {names[topic.image.name]: topic for topic in chosen},
        {names[topic.image.name]: topic for topic in left_out},
    )


def info_of_images(image: ImageSample, samples: Samples) -> InfoSample | None:
    """The ``camera_info`` beside images, else the only one of their frame and size beside no others."""
    if (beside := _info_beside(image, samples)) is not None:
        return beside
    names_beside_others = {
        info.name for other in samples.images.values() if (info := _info_beside(other, samples))
    }
    of_frame = [
        info
        for info in samples.infos.values()
        if info.frame == image.frame
        and image.frame
        and image.size_px in (None, info.size_px)
        and info.name not in names_beside_others
    ]
    return of_frame[0] if len(of_frame) == 1 else None


def _info_beside(image: ImageSample, samples: Samples) -> InfoSample | None:
    """The ``camera_info`` where ``image_transport`` has that of a topic of images."""
    base = _base(image.name)
    names = [f"{base.rpartition('/')[0]}/camera_info", f"{base}/camera_info"]
    return next((samples.infos[name] for name in names if name in samples.infos), None)


def _why_no_camera(image: ImageSample) -> str:
    if _NO_LIGHT.match(image.form) or image.name.endswith("/compressedDepth"):
        return f"its images are {shown(image.form)}: of depth, heat or labels"
    return f"its images have more than 8 bits ({shown(image.form)})" if image.is_wide else ""


def _order(topic: CameraTopic, most: int) -> tuple[object, ...]:
    """A key that sorts a sensor's best topic first: readable, calibrated, frequent, as the sensor has it."""
    image = topic.image
    last = _base(image.name).rpartition("/")[2]
    rarity = round(math.log(most / image.messages, _OFTEN))
    place = _PLAIN.index(last) if last in _PLAIN else len(_PLAIN)
    width, height = image.size_px or (0, 0)
    is_refused = bool(image.problem or image.refusal)
    quality = (is_rectified(image), place, -width * height, image.kind != kinds.RAW, image.name)
    return (is_refused, topic.info is None, rarity, *quality)


def is_rectified(image: ImageSample) -> bool:
    """Whether a topic is called that of rectified images."""
    return bool(_RECTIFIED.search(image.name.lower()))


def _is_same_sensor(topic: CameraTopic, chosen: CameraTopic, frames: Frames) -> bool:
    """Whether a topic shows again, or has drawn over, the images of a topic that comes before it."""
    image = topic.image
    other = chosen.image
    if _base(image.name) == _base(other.name):
        return True
    is_simultaneous = is_together(image.stamp_s, other.stamp_s, _SAME_TIME_S)
    if image.frame != other.frame:
        # A node that draws over an image keeps its time, and may forget its frame.
        is_somewhere = bool(image.frame) and frames.named(image.frame) is not None
        return is_simultaneous and topic.info is None and chosen.info is not None and not is_somewhere
    if not image.frame and not is_simultaneous:
        return False
    if topic.info is None or chosen.info is None:
        # What a node makes of images is not called raw; two drivers may both name the frame that is default.
        are_drivers = all(_base(name).endswith("/image_raw") for name in (image.name, other.name))
        return not are_drivers and (is_simultaneous or chosen.info is not None)
    if topic.info.name == chosen.info.name:
        return True
    # Two cameras of a stereo rig may name one frame; the second one's P has their baseline.
    has_baseline = not math.isclose(topic.info.baseline, chosen.info.baseline)
    if not is_simultaneous or has_baseline:
        return False
    return is_rectified(image) != is_rectified(other) or _is_same_lens(topic.info, chosen.info)


def _is_same_lens(info: InfoSample, other: InfoSample) -> bool:
    if info.size_px != other.size_px or len(info.lens) != len(other.lens) or not any(info.lens[:9]):
        return False
    pairs = zip(info.lens, other.lens, strict=True)
    return all(math.isclose(number, value, rel_tol=_SAME_LENS, abs_tol=1e-12) for number, value in pairs)


def _relation(topic: CameraTopic, twin: CameraTopic) -> str:
    if is_rectified(topic.image) != is_rectified(twin.image):
        return "rectified images of the same sensor as"
    return "the same sensor as" if topic.info is not None else "no camera_info of its own; it shows again"


def _base(name: str) -> str:
    """A topic's name without the suffix that ``image_transport`` adds for each encoding."""
    for transport in _TRANSPORTS:
        name = name.removesuffix(transport)
    return name


def _names_of(topics: Sequence[str], other_names: Collection[str]) -> dict[str, str]:
    """Names of cameras by their topics: the last word that is one of its own, else all of them."""
    short_names: dict[str, str] = {}
    for topic in topics:
        words = [word for word in _base(topic).split("/") if word and word not in _IMAGE_WORDS]
        short_names[topic] = words[-1] if words else "camera"
    is_unique = len(set(short_names.values())) == len(short_names)
    names: dict[str, str] = {}
    for topic in topics:
        whole_names = [part.strip("/").replace("/", "_") for part in (_base(topic), topic)]
        numbered = (f"{whole_names[-1]}_{number}" for number in count(2))
        options = chain([short_names[topic]] if is_unique else [], whole_names, numbered)
        names[topic] = next(
            name for name in options if name not in other_names and name not in names.values()
        )
    return names
