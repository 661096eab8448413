"""MCAP files of any profile: ``rosbags`` reads those of ROS 2 only, whose messages others hold as well.

Tools that merge, cut or convert recordings leave the profile (https://mcap.dev/spec) empty or write that of
ROS 1. How a message is encoded is what its channel says, not the profile.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, cast

ROS1 = "ros1"  # encodings of messages, as channels name them
ROS2 = "cdr"

_MAGIC = b"\x89MCAP0\r\n"
_PROFILE_AT = 17  # behind the magic, the code of the first record and its length
_PROFILE = b"\x04\x00\x00\x00ros2"  # a text's length and the text; a header is never shorter than that
_DEFINITIONS = {"ros1msg": "ros2msg"}  # of types: both use the same grammar
_KNOWN = ("ros2msg", "ros2idl", "omgidl", "")


def mcap_reader(path: Path) -> Any:
    """The reader of ``rosbags`` for the MCAP file at ``path``, whatever its profile."""
    from rosbags.rosbag2 import Reader

    reader: Any = Reader(path)
    reader.storage.path = _File(path)
    reader.storage.schemas = _Schemas()
    return reader


class _File:
    """A file that is opened as one of the profile of ROS 2."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def open(self, mode: str) -> io.BufferedReader:
        return io.BufferedReader(_AsRos2(self._path))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._path, name)

    def __str__(self) -> str:
        return str(self._path)


class _AsRos2(io.FileIO):
    """The bytes of a file, with the profile of ROS 2 in its header."""

    def readinto(self, buffer: Any) -> int:
        start = self.tell()
        count = cast(int, super().readinto(buffer))
        view = memoryview(buffer).cast("B")
        for place, byte in enumerate(_PROFILE, start=_PROFILE_AT - start):
            if 0 <= place < count:
                view[place] = byte
        return count


class _Schemas(dict[int, Any]):
    """Types by number; definitions in a language that ``rosbags`` lacks are left out, not refused."""

    def __setitem__(self, number: int, schema: Any) -> None:
        language = _DEFINITIONS.get(schema.encoding, schema.encoding)
        known_language = language if language in _KNOWN else ""
        text = schema.data if known_language else ""
        super().__setitem__(
            number, schema._replace(name=_kind(schema.name), encoding=known_language, data=text)
        )


def _kind(name: str) -> str:
    """A type by the name that ROS 2 gives it: ``sensor_msgs/msg/Image`` for ``sensor_msgs/Image``."""
    package, slash, message = name.partition("/")
    return f"{package}/msg/{message}" if slash and "/" not in message else name
