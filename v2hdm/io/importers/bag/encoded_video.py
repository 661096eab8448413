"""Video that a bag holds a packet a message (``foxglove_msgs/CompressedVideo``), decoded by PyAV."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.extras import need

VIDEO = "foxglove_msgs/msg/CompressedVideo"

_FORMATS = ("h264", "h265", "vp9", "av1")
_CODECS = {"h265": "hevc"}
"""FFmpeg's names of formats, where they are others."""


class VideoDecoder:
    """Decodes the packets of one topic in their order.

    Args:
        form: format of the packets as messages name it.
        where: the topic, for errors.

    Raises:
        DriveError: the format is not known, or PyAV is not installed.
    """

    def __init__(self, form: str, where: str) -> None:
        self._av = need("av", "video", f"{where}: video in a bag", DriveError)
        if form not in _FORMATS:
            raise DriveError(f"{where}: video in the format '{form}', known are {', '.join(_FORMATS)}")
        self._where = where
        self._context: Any = self._av.CodecContext.create(_CODECS.get(form, form), "r")
        self._begun = False
        self._context.thread_count = 1  # frames of several threads come late

    def frames(self, data: bytes | None, number: int) -> Iterator[tuple[int, np.ndarray]]:
        """The frames that are whole once the packet ``number`` is there, with their packets' numbers.

        Pixels are (H, W, 3) BGR. Frames before the first key frame never come. None ends the video.

        Raises:
            DriveError: the packet is damaged.
        """
        packet = None
        if data is not None:
            packet = self._av.Packet(data)
            packet.pts = number
        try:
            for frame in self._context.decode(packet):
                self._begun = True
                yield int(frame.pts), frame.to_ndarray(format="bgr24")
        except self._av.error.FFmpegError as failure:
            if not self._begun:
                return  # parameters come with the first key frame
            raise DriveError(
                f"{self._where}: packet {number + 1} cannot be decoded ({' '.join(str(failure).split())}); "
                "leave it out, or record images"
            ) from None
