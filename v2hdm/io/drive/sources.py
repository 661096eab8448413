"""Sources of images, intrinsics and poses: files, a folder, a video, topics of a bag read in one pass."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import DriveError, need, shown
from v2hdm.io.calibration.intrinsics import read_intrinsics, read_rectified_intrinsics
from v2hdm.io.calibration.reading import Intrinsics, read_camera_info, read_rectification
from v2hdm.io.description import FolderImages, InfoFile, InfoTopic, TopicImages, VideoImages, keys_in
from v2hdm.io.drive.images import ImageFiles
from v2hdm.io.image_lists import image_order, read_image_list, read_stamps
from v2hdm.io.importers.bag import streams
from v2hdm.io.importers.bag.frames import TF_TOPIC
from v2hdm.io.importers.readings import Readings, readings_of_poses
from v2hdm.io.stamps import ZONES, is_unit, number_order, times_of_names
from v2hdm.io.trajectory import UNITS
from v2hdm.records import FloatArray
from v2hdm.safe.child import Limits, in_child, next_step
from v2hdm.safe.pixels import DECODER_OPTIONS, IMAGE_SUFFIXES, VIDEO_OPTIONS, is_image_name, png
from v2hdm.store.files import check_keys, take_choice, take_mapping, take_number, take_text
from v2hdm.store.folders import entry_folder, is_whole, new_entry
from v2hdm.store.remarks import keeping_warnings, tell_again

_log = logging.getLogger(__name__)

_TAIL_S = 1.0  # sound may go on after the last frame
_WITHOUT_TIMES = frozenset({"h264", "hevc", "m4v", "mpegvideo", "mjpeg", "obu"})
"""FFmpeg's names of formats that are frames alone: it invents times for some of them."""
_UNTIMED = "untimed.txt"  # why the frames of an import have no times of their own
_RECTIFIED = "image_rect"  # begins the names of such topics (image_proc, stereo_image_proc)
_PREVIEW = "attached_pic"  # a picture of the video's cover, not the video

_Lister = Callable[[], ImageFiles]


@dataclass
class Sources:
    """The folder of file names, the cache of imports, the bag, if any, and the longest gap in transforms."""

    root: Path
    cache: Path
    bag: Path | None
    max_gap_s: float
    _streams: list[streams.Stream] = field(default_factory=list)
    _folders: list[Path] = field(default_factory=list)

    def want(self, stream: streams.Stream) -> Callable[[], Path]:
        """Put ``stream`` on the list; the function returned imports all of the list and gives its folder."""
        if self.bag is None:
            raise DriveError(f"{stream.where}: names a topic, but the drive has no bag; add the key bag")
        place = len(self._streams)
        self._streams.append(stream)

        def folder() -> Path:
            if len(self._folders) < len(self._streams):
                assert self.bag is not None
                self._folders = streams.import_streams(self.bag, self._streams, self.cache)
            return self._folders[place]

        return folder


def plan_images(content: object, camera: str, sources: Sources, where: str) -> _Lister:
    """The function that lists the images of a camera, to be called once all sources are planned."""
    if isinstance(content, str):
        path = sources.root / take_text(content, where, DriveError)
        if path.is_dir():
            return _of_folder({"folder": content}, camera, sources, where)
        return lambda: _of_list(camera, path)
    entry = take_mapping(content, where, DriveError)
    named = [key for key in IMAGE_SOURCES if key in entry]
    if len(named) != 1:
        raise DriveError(
            f"{where}: name one source, a list file or one of {', '.join(IMAGE_SOURCES)}; "
            f"got {', '.join(named) or 'none'}"
        )
    plan, keys = IMAGE_SOURCES[named[0]]
    check_keys(entry, (named[0],), keys, where, DriveError)
    return plan(entry, camera, sources, where)


def plan_info(
    content: object, camera: str, images: object, sources: Sources, where: str
) -> Callable[[], Intrinsics]:
    """The function that reads the intrinsics in a camera's ``camera_info``, a file or a topic.

    Its ``images`` are rectified if it says so, else if a word of their topic begins ``image_rect``, as ROS
    names them.
    """
    entry = content if isinstance(content, dict) else {"file": take_text(content, where, DriveError)}
    info_keys = keys_in(InfoFile if "file" in entry else InfoTopic)
    check_keys(entry, info_keys.required, info_keys.optional, where, DriveError)
    rectified = _take_rectified(entry, images, where)
    if "file" in entry:
        path = sources.root / take_text(entry["file"], f"{where}, file", DriveError)
        chosen = entry.get("camera")
        if chosen is not None and not isinstance(chosen, int):  # COLMAP numbers its cameras
            chosen = take_text(chosen, f"{where}, camera", DriveError)
        return lambda: _read_info(path, None if chosen is None else str(chosen), rectified)
    topic = take_text(entry["topic"], f"{where}, topic", DriveError)
    folder = sources.want(streams.InfoStream(topic, where, rectified=rectified))

    def intrinsics() -> Intrinsics:
        path = folder() / streams.INFO_FILE
        return Intrinsics(
            replace(read_camera_info(path), name=camera), read_rectification(path) if rectified else None
        )

    return intrinsics


def _take_rectified(entry: Mapping[str, Any], images: object, where: str) -> bool:
    rectified = entry.get("rectified")
    if rectified is None:
        words = str(images.get("topic", "")).split("/") if isinstance(images, dict) else []
        rectified = any(word.startswith(_RECTIFIED) for word in words)
        if rectified and "file" in entry:
            _log.info("%s: P of its file, for the images' topic is called rectified", where)
    if not isinstance(rectified, bool):
        raise DriveError(f"{where}, rectified: expected true or false, got {shown(rectified)}")
    return rectified


def _read_info(path: Path, camera: str | None, rectified: bool) -> Intrinsics:
    name_by = f"camera_info: {{file: {path.name}, camera: NAME}}"
    if rectified:
        return read_rectified_intrinsics(path, camera, name_by)
    return Intrinsics(read_intrinsics(path, camera, name_by))


def plan_topic_poses(content: object, sources: Sources, where: str) -> Callable[[], Readings] | None:
    """The function that reads the poses of a topic in ``poses``, if it names one: of poses, or transforms."""
    if not isinstance(content, dict) or "topic" not in content:
        return None
    topic = take_text(content["topic"], f"{where}, topic", DriveError)
    if topic == TF_TOPIC:
        for key in ("frame", "vehicle"):
            if key not in content:
                raise DriveError(f"{where}: add {key} for {TF_TOPIC}: the map's or the vehicle's frame")
        dst, src = (take_text(content[key], f"{where}, {key}", DriveError) for key in ("frame", "vehicle"))
        tf = streams.TfStream(where)
        tf_folder = sources.want(tf)
        return lambda: readings_of_poses(tf.frames(tf_folder()).moving(dst, src, sources.max_gap_s, where))
    for key in ("frame", "vehicle"):
        if key in content:
            raise DriveError(f"{where}, {key}: only for {TF_TOPIC}; drop it")
    heading = content.get("heading_topic")
    if heading is not None:
        heading = take_text(heading, f"{where}, heading_topic", DriveError)
    gyro = content.get("gyro_topic")
    if gyro is not None:
        gyro = take_text(gyro, f"{where}, gyro_topic", DriveError)
    stream = streams.PoseStream(topic, heading, gyro, _take_stamps(content, where), where)
    folder = sources.want(stream)
    return lambda: stream.readings(folder())


def _of_list(camera: str, path: Path, start_s: float = 0.0) -> ImageFiles:
    listed = read_image_list(path)
    paths = [path.parent / name for name in listed.names]
    return ImageFiles(camera=camera, stamp_s=listed.stamp_s + start_s, paths=paths)


def _of_topic(entry: dict[str, Any], camera: str, sources: Sources, where: str) -> _Lister:
    topic = take_text(entry["topic"], f"{where}, topic", DriveError)
    folder = sources.want(streams.ImageStream(topic, _take_stamps(entry, where), where))
    return lambda: _of_list(camera, folder() / streams.IMAGE_LIST)


def _take_stamps(entry: Mapping[str, Any], where: str) -> str:
    return take_choice(entry.get("stamps", streams.STAMPS[0]), streams.STAMPS, f"{where}, stamps", DriveError)


def _of_folder(entry: dict[str, Any], camera: str, sources: Sources, where: str) -> _Lister:
    folder = sources.root / take_text(entry["folder"], f"{where}, folder", DriveError)
    unit = None
    if entry.get("unit") is not None:
        unit = take_text(entry["unit"], f"{where}, unit", DriveError)
        if not is_unit(unit):
            units = ", ".join(UNITS)
            raise DriveError(f"{where}, unit: expected one of {units}, {ZONES}; got {shown(unit)}")

    def images() -> ImageFiles:
        if not folder.is_dir():
            raise DriveError(f"{where}: {folder}: no such folder; check the path")
        paths = list_folder(folder)
        if not paths:
            raise DriveError(f"{where}: {folder}: no images ({', '.join(IMAGE_SUFFIXES)}) in this folder")
        stems = [path.stem for path in paths]
        about = f"{where}: the images of {folder}"
        if "stamps" in entry:
            stamps = sources.root / take_text(entry["stamps"], f"{where}, stamps", DriveError)
            stamp_s = read_stamps(stamps, len(paths), f"images in {folder}") / UNITS.get(unit or "s", 1.0)
            places = number_order(stems, about)
            _check_lines(stamp_s, [stems[place] for place in places], stamps)
            by_time = image_order(stamp_s, str(stamps), "line")
            rows = [places[row] for row in by_time]
            return ImageFiles(camera=camera, stamp_s=stamp_s[by_time], paths=[paths[row] for row in rows])
        stamp_s = times_of_names(stems, unit, about)
        by_time = image_order(np.sort(stamp_s), about.removeprefix(f"{where}: "))
        rows = np.argsort(stamp_s, kind="stable")[by_time].tolist()
        return ImageFiles(camera=camera, stamp_s=stamp_s[rows], paths=[paths[row] for row in rows])

    return images


def list_folder(folder: Path) -> list[Path]:
    """The images that lie in a folder itself, by name."""
    return sorted(path for path in folder.iterdir() if is_image_name(path.name))


def _check_lines(stamp_s: FloatArray, stems: Sequence[str], stamps: Path) -> None:
    """Refuse times that rise only if images are sorted by letters: frame1, frame10, ..., frame2."""
    by_letters = sorted(range(len(stems)), key=stems.__getitem__)
    if (np.diff(stamp_s) < 0).any() and not (np.diff(stamp_s[np.argsort(by_letters)]) <= 0).any():
        raise DriveError(
            f"{stamps}: its lines are in the order of letters, in which {shown(stems[by_letters[1]])} comes "
            f"second, but images are in that of numbers, where {shown(stems[1])} does; sort its lines by time"
        )


def _import_video(path: Path, cache: Path, where: str) -> Path:
    """The folder of a video's frames as PNG files and of their times, decoded by PyAV unless they were."""
    if not path.is_file():
        raise DriveError(f"{where}: {path}: no such video; check the path")
    folder = entry_folder(cache, [path], "video", ["frames in order"])
    if is_whole(folder):
        tell_again(folder, str(path))
        return folder
    need("av", "video", f"{where}: a video", DriveError)
    _log.info("%s: decoding its frames into %s, once", path, cache)
    with new_entry(folder) as partial, keeping_warnings() as keeper:
        keeper.turn_to(partial, str(path))
        in_child(decode_video, path, partial, limits=Limits.of([path]), where=str(path), error=DriveError)
    return folder


def decode_video(path: Path, folder: Path) -> None:
    """Write the frames of a video, in the order that they are shown in, as PNG files, and their times."""
    av = need("av", "video", f"{path}: a video", DriveError)
    stamps: list[float] = []
    complaint = untimed = ""
    av.logging.set_level(av.logging.ERROR)
    try:
        with (
            av.logging.Capture(local=False) as complaints,
            av.open(str(path), options=VIDEO_OPTIONS) as container,
        ):
            stream = _stream_of(container, path)
            promised_s = _length_of(container, stream, av.time_base)
            stream.codec_context.options = DECODER_OPTIONS
            if container.format.name in _WITHOUT_TIMES:
                untimed = "it is a raw stream, whose frames have no times"
            for frame in container.decode(stream):
                next_step()
                where = f"{path}: frame {len(stamps) + 1}"
                if frame.rotation:
                    raise DriveError(
                        f"{where} asks for a rotation, but a calibration is of stored pixels: "
                        "take the rotation out of the video"
                    )
                if (complaints or frame.is_corrupt) and not complaint:
                    complaint = complaints[-1][2].strip() if complaints else "corrupt"
                    _log.warning("%s: decoder error (%s); is it damaged?", where, complaint)
                if frame.pts is None and not untimed:
                    untimed = f"its frame {len(stamps) + 1} has no time"
                stamps.append(len(stamps) if untimed else float(frame.pts * frame.time_base))
                name = folder / _FRAME_NAME.format(len(stamps) - 1)
                name.write_bytes(png(frame.to_ndarray(format="bgr24")))
    except (av.error.FFmpegError, IndexError) as failure:
        reason = " ".join(str(failure).split())
        raise DriveError(f"{path}: not readable as a video ({reason}); convert or copy it") from None
    finally:
        av.logging.set_level(None)
    if not stamps:
        raise DriveError(f"{path}: has no frames; convert or copy it again")
    stamp_s = np.array(stamps)
    if not untimed and promised_s - np.ptp(stamp_s) > _TAIL_S + 2 * np.diff(stamp_s).max(initial=0.0):
        _log.warning("%s: its frames end before its %.1f s do; is it cut off?", path, promised_s)
    _write_frames(stamp_s, untimed, folder)


_FRAME_NAME = "{:06d}.png"
_FRAME_TIMES = "times.txt"  # of all frames, in the order that they are shown in


def _write_frames(stamp_s: FloatArray, untimed: str, folder: Path) -> None:
    """Write the times of frames (N,) since the first, or why they have none."""
    (folder / _FRAME_TIMES).write_text(
        "".join(f"{stamp:.9f}\n" for stamp in stamp_s - stamp_s[0]), encoding="utf-8"
    )
    if untimed:
        (folder / _UNTIMED).write_text(untimed, encoding="utf-8")


def _stream_of(container: Any, path: Path) -> Any:
    """The video in a container: its first, said where there are several."""
    streams_of_video = [
        stream for stream in container.streams.video if _PREVIEW not in (stream.disposition.name or "")
    ]
    stream = (streams_of_video or container.streams.video)[0]
    if len(streams_of_video) > 1:
        _log.warning(
            "%s: holds %d videos; the first, of %d x %d px, is read",
            path, len(streams_of_video), stream.width, stream.height,
        )  # fmt: skip
    return stream


def _length_of(container: Any, stream: Any, ticks_s: int) -> float:
    """The duration of a video's frames, s, that its container states; 0 if none, as sound may last longer."""
    if stream.duration is not None:
        return float(stream.duration * stream.time_base)
    hours, _, minutes_and_seconds = str(stream.metadata.get("DURATION", "")).partition(
        ":"
    )  # Matroska's hh:mm:ss.fraction
    minutes, _, seconds = minutes_and_seconds.partition(":")
    try:
        return 3600.0 * float(hours) + 60.0 * float(minutes) + float(seconds)
    except ValueError:
        return (container.duration or 0) / ticks_s if len(container.streams) == 1 else 0.0


def _of_video(entry: dict[str, Any], camera: str, sources: Sources, where: str) -> _Lister:
    path = sources.root / take_text(entry["video"], f"{where}, video", DriveError)
    if ("start_s" in entry) == ("stamps" in entry):
        raise DriveError(
            f"{where}: add start_s, the time of the first frame on the poses' clock, or stamps, a file with "
            "the time of every frame, but not both"
        )

    def images() -> ImageFiles:
        folder = _import_video(path, sources.cache, where)
        frame_s = np.loadtxt(folder / _FRAME_TIMES, ndmin=1)
        about = str(path)
        if "start_s" in entry:
            start_s = take_number(entry["start_s"], f"{where}, start_s", DriveError)
            if (folder / _UNTIMED).is_file():
                reason = (folder / _UNTIMED).read_text(encoding="utf-8")
                raise DriveError(
                    f"{path}: {reason}, and start_s is the first one's alone; give stamps, one per line"
                )
            stamp_s = start_s + frame_s
        else:
            stamps = sources.root / take_text(entry["stamps"], f"{where}, stamps", DriveError)
            stamp_s = read_stamps(stamps, len(frame_s), f"frames of {path}")
            about = str(stamps)
        rows = image_order(stamp_s, about, "frame")
        paths = [folder / _FRAME_NAME.format(row) for row in rows.tolist()]
        return ImageFiles(camera=camera, stamp_s=stamp_s[rows], paths=paths)

    return images


IMAGE_SOURCES: Mapping[
    str, tuple[Callable[[dict[str, Any], str, Sources, str], _Lister], tuple[str, ...]]
] = {
    "folder": (_of_folder, keys_in(FolderImages).optional),
    "video": (_of_video, keys_in(VideoImages).optional),
    "topic": (_of_topic, keys_in(TopicImages).optional),
}
"""Sources of images other than a list file, by the key that names them: how they are planned, other keys."""
