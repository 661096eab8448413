"""A video's frames as PNG files with their times, by PyAV.

PyAV's wheel holds FFmpeg with parts under the GPL (x264, x265): it is an extra of its own, and never
installed by another one.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.extras import need
from v2hdm.io.importers import new_entry
from v2hdm.io.safe.pixels import png
from v2hdm.io.trajectory import write_image_list
from v2hdm.store.folders import (
    entry_folder,
    is_whole,
)

_log = logging.getLogger(__name__)

IMAGE_LIST = "images.txt"


def import_video(path: Path, cache: Path, where: str) -> Path:
    """The folder of the frames of the video at ``path``, decoded now unless they were before.

    Its list has the container's times, s since the first frame. Raises DriveError when the video is missing,
    damaged or without times, or PyAV is not installed.
    """
    if not path.is_file():
        raise DriveError(f"{where}: {path}: no such video; check the path")
    folder = entry_folder(cache, [path], "video", ["frames"])
    if is_whole(folder):
        return folder
    av = need("av", "video", f"{where}: a video", DriveError)
    _log.info("%s: decoding its frames into %s, once", path, cache)
    with new_entry(folder) as partial:
        stamps: list[float] = []
        names: list[str] = []
        try:
            with av.open(str(path)) as container:
                for frame in container.decode(video=0):
                    where = f"{path}: frame {len(stamps) + 1}"
                    if frame.pts is None:
                        raise DriveError(f"{where} has no time; give stamps, a time a line")
                    stamps.append(float(frame.pts * frame.time_base))
                    if len(stamps) > 1 and stamps[-1] <= stamps[-2]:
                        raise DriveError(f"{where}: its time does not rise; convert the video")
                    names.append(f"{len(names):06d}.png")
                    (partial / names[-1]).write_bytes(png(frame.to_ndarray(format="bgr24")))
        except (av.error.FFmpegError, IndexError) as failure:
            reason = " ".join(str(failure).split())
            raise DriveError(
                f"{path}: not readable as a video ({reason}); convert or copy it again"
            ) from None
        if not stamps:
            raise DriveError(f"{path}: holds no frame; convert or copy it again")
        write_image_list(np.array(stamps) - stamps[0], names, partial / IMAGE_LIST)
    return folder
