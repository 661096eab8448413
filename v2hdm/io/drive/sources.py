"""Sources of images, intrinsics and poses: files, a folder, a video, topics of a bag read in one pass."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import DriveError, need
from v2hdm.io.calibration.intrinsics import read_intrinsics
from v2hdm.io.calibration.reading import read_camera_info
from v2hdm.io.description import FolderImages, InfoFile, TopicImages, VideoImages, keys_in
from v2hdm.io.drive.images import ImageFiles
from v2hdm.io.importers.bag import streams
from v2hdm.io.importers.bag.frames import TF_TOPIC
from v2hdm.io.importers.readings import Readings, read_stamps, readings_of_poses
from v2hdm.io.trajectory import UNITS, read_image_list, write_image_list
from v2hdm.records import CameraInfo
from v2hdm.safe.child import Limits, in_child, next_step
from v2hdm.safe.pixels import DECODER_OPTIONS, VIDEO_OPTIONS, png
from v2hdm.store.files import check_keys, take_choice, take_mapping, take_number, take_text
from v2hdm.store.folders import entry_folder, is_whole, new_entry

_log = logging.getLogger(__name__)

_TAIL_S = 1.0  # sound may go on after the last frame

_Lister = Callable[[], ImageFiles]
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


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


def plan_info(content: object, camera: str, sources: Sources, where: str) -> Callable[[], CameraInfo]:
    """The function that reads the intrinsics of a camera's ``camera_info``, a file or a topic."""
    if not isinstance(content, dict):
        path = sources.root / take_text(content, where, DriveError)
        return lambda: _read_info(path, None)
    if "file" in content:
        info_keys = keys_in(InfoFile)
        check_keys(content, info_keys.required, info_keys.optional, where, DriveError)
        named = sources.root / take_text(content["file"], f"{where}, file", DriveError)
        chosen = content.get("camera")
        if chosen is not None and not isinstance(chosen, int):  # COLMAP numbers its cameras
            chosen = take_text(chosen, f"{where}, camera", DriveError)
        return lambda: _read_info(named, None if chosen is None else str(chosen))
    check_keys(content, ("topic",), (), where, DriveError)
    topic = take_text(content["topic"], f"{where}, topic", DriveError)
    folder = sources.want(streams.InfoStream(topic, where))
    return lambda: replace(read_camera_info(folder() / streams.INFO_FILE), name=camera)


def _read_info(path: Path, camera: str | None) -> CameraInfo:
    return read_intrinsics(path, camera, f"camera_info: {{file: {path.name}, camera: NAME}}")


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
    stream = streams.PoseStream(topic, heading, _take_stamps(content, where), where)
    folder = sources.want(stream)
    return lambda: stream.readings(folder())


def _of_list(camera: str, path: Path, start_s: float = 0.0) -> ImageFiles:
    stamp_s, names = read_image_list(path)
    return ImageFiles(camera=camera, stamp_s=stamp_s + start_s, paths=[path.parent / name for name in names])


def _of_topic(entry: dict[str, Any], camera: str, sources: Sources, where: str) -> _Lister:
    topic = take_text(entry["topic"], f"{where}, topic", DriveError)
    folder = sources.want(streams.ImageStream(topic, _take_stamps(entry, where), where))
    return lambda: _of_list(camera, folder() / streams.IMAGE_LIST)


def _take_stamps(entry: Mapping[str, Any], where: str) -> str:
    return take_choice(entry.get("stamps", streams.STAMPS[0]), streams.STAMPS, f"{where}, stamps", DriveError)


def _of_folder(entry: dict[str, Any], camera: str, sources: Sources, where: str) -> _Lister:
    folder = sources.root / take_text(entry["folder"], f"{where}, folder", DriveError)
    unit = take_choice(entry.get("unit", "s"), UNITS, f"{where}, unit", DriveError)

    def images() -> ImageFiles:
        if not folder.is_dir():
            raise DriveError(f"{where}: {folder}: no such folder; check the path")
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
        if not paths:
            raise DriveError(f"{where}: {folder}: no images ({', '.join(SUFFIXES)}) in this folder")
        if "stamps" in entry:
            stamps = sources.root / take_text(entry["stamps"], f"{where}, stamps", DriveError)
            stamp_s = read_stamps(stamps, len(paths), f"images in {folder}")
        else:
            try:
                stamp_s = np.array([float(path.stem) for path in paths])
                if not np.isfinite(stamp_s).all():  # "nan" and "inf" are numbers to Python, and no times
                    raise ValueError
            except ValueError:
                raise DriveError(
                    f"{where}: the images of {folder} are not named by their times; add stamps, one per line"
                ) from None
            order = np.argsort(stamp_s, kind="stable")
            stamp_s = stamp_s[order]
            paths = [paths[n] for n in order.tolist()]
        if (np.diff(stamp_s) <= 0).any():
            raise DriveError(f"{where}: the image times of {folder} do not increase strictly; fix them")
        return ImageFiles(camera=camera, stamp_s=stamp_s / UNITS[unit], paths=paths)

    return images


def _import_video(path: Path, cache: Path, where: str) -> Path:
    """The folder of a video's frames as PNG files and of their times, decoded by PyAV unless they were."""
    if not path.is_file():
        raise DriveError(f"{where}: {path}: no such video; check the path")
    folder = entry_folder(cache, [path], "video", ["frames"])
    if is_whole(folder):
        return folder
    need("av", "video", f"{where}: a video", DriveError)
    _log.info("%s: decoding its frames into %s, once", path, cache)
    with new_entry(folder) as partial:
        in_child(decode_video, path, partial, limits=Limits.of([path]), where=str(path), error=DriveError)
    return folder


def decode_video(path: Path, folder: Path) -> None:
    """Write the frames of a video as PNG files, and the list of their times."""
    av = need("av", "video", f"{path}: a video", DriveError)
    stamps: list[float] = []
    names: list[str] = []
    complaint = ""
    av.logging.set_level(av.logging.ERROR)
    try:
        with (
            av.logging.Capture(local=False) as complaints,
            av.open(str(path), options=VIDEO_OPTIONS) as container,
        ):
            promised_s = (container.duration or 0) / av.time_base
            container.streams.video[0].codec_context.options = DECODER_OPTIONS
            for frame in container.decode(video=0):
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
                if frame.pts is None:
                    raise DriveError(f"{where} has no time; give stamps, one per line")
                stamps.append(float(frame.pts * frame.time_base))
                if len(stamps) > 1 and stamps[-1] <= stamps[-2]:
                    raise DriveError(f"{where}: its time does not increase; convert the video")
                names.append(f"{len(names):06d}.png")
                (folder / names[-1]).write_bytes(png(frame.to_ndarray(format="bgr24")))
    except (av.error.FFmpegError, IndexError) as failure:
        reason = " ".join(str(failure).split())
        raise DriveError(f"{path}: not readable as a video ({reason}); convert or copy it") from None
    finally:
        av.logging.set_level(None)
    if not stamps:
        raise DriveError(f"{path}: has no frames; convert or copy it again")
    if promised_s - (stamps[-1] - stamps[0]) > _TAIL_S + 2 * max(np.diff(stamps), default=0.0):
        _log.warning("%s: its frames end before its %.1f s do; is it cut off?", path, promised_s)
    write_image_list(np.array(stamps) - stamps[0], names, folder / streams.IMAGE_LIST)


def _of_video(entry: dict[str, Any], camera: str, sources: Sources, where: str) -> _Lister:
    path = sources.root / take_text(entry["video"], f"{where}, video", DriveError)
    if ("start_s" in entry) == ("stamps" in entry):
        raise DriveError(
            f"{where}: add start_s, the time of the first frame on the poses' clock, or stamps, a file with "
            "the time of every frame, but not both"
        )

    def images() -> ImageFiles:
        frames = _import_video(path, sources.cache, where) / streams.IMAGE_LIST
        if "start_s" in entry:
            return _of_list(camera, frames, take_number(entry["start_s"], f"{where}, start_s", DriveError))
        listed = _of_list(camera, frames)
        stamps = sources.root / take_text(entry["stamps"], f"{where}, stamps", DriveError)
        stamp_s = read_stamps(stamps, len(listed.paths), f"frames of {path}")
        if (np.diff(stamp_s) <= 0).any():
            raise DriveError(f"{stamps}: times do not increase strictly; fix them")
        return replace(listed, stamp_s=stamp_s)

    return images


IMAGE_SOURCES: Mapping[
    str, tuple[Callable[[dict[str, Any], str, Sources, str], _Lister], tuple[str, ...]]
] = {
    "folder": (_of_folder, keys_in(FolderImages).optional),
    "video": (_of_video, keys_in(VideoImages).optional),
    "topic": (_of_topic, keys_in(TopicImages).optional),
}
"""Sources of images other than a list file, by the key that names them: how they are planned, other keys."""
