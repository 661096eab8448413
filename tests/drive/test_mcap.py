"""An MCAP file is read by what its channels say, whatever profile its header states."""

import struct
from pathlib import Path
from typing import Any

import pytest

from tests.drive.bags import ROS1, ROS2, Messages, assert_same_drive, messages_of, read, topics_for
from v2hdm.errors import DriveError
from v2hdm.io.drive import read_drive

_MAGIC = b"\x89MCAP0\r\n"


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()


def _record(code: int, content: bytes) -> bytes:
    return struct.pack("<BQ", code, len(content)) + content


def write_mcap(
    path: Path,
    messages: Messages,
    profile: str,
    library: str = "",
    encoding: str | None = None,
    has_own_schemas: bool = False,
) -> Path:
    """A file without chunks or an index, as https://mcap.dev/spec has it; ``own`` adds a channel of JSON."""
    store: Any = ROS1 if messages.ros1 else ROS2
    serialize = store.serialize_ros1 if messages.ros1 else store.serialize_cdr
    language = "ros1msg" if messages.ros1 else "ros2msg"
    records = [_record(1, _text(profile) + _text(library))]
    channels: dict[str, int] = {}
    if has_own_schemas:
        records.append(_record(3, struct.pack("<H", 99) + _text("Own") + _text("jsonschema") + _text("{}")))
        records.append(_record(4, struct.pack("<HH", 99, 99) + _text("/own") + _text("json") + _text("")))
        records.append(_record(5, struct.pack("<HIQQ", 99, 0, 1, 1) + b"{}"))
    for number, (stamp_s, topic, message) in enumerate(messages.rows):
        kind = message.__msgtype__
        if topic not in channels:
            key = len(channels) + 1
            channels[topic] = key
            definition, _ = store.generate_msgdef(kind, ros_version=1 if messages.ros1 else 2)
            name = kind.replace("/msg/", "/") if messages.ros1 else kind
            records.append(
                _record(3, struct.pack("<H", key) + _text(name) + _text(language) + _text(definition))
            )
            wire = encoding or ("ros1" if messages.ros1 else "cdr")
            records.append(_record(4, struct.pack("<HH", key, key) + _text(topic) + _text(wire) + _text("")))
        head = struct.pack("<HIQQ", channels[topic], number, round(stamp_s * 1e9), round(stamp_s * 1e9))
        records.append(_record(5, head + bytes(serialize(message, kind))))
    records += [_record(15, bytes(4)), _record(2, bytes(20))]
    path.write_bytes(_MAGIC + b"".join(records) + _MAGIC)
    return path


@pytest.mark.parametrize("ros1", [False, True])
@pytest.mark.parametrize(
    ("profile", "library"), [("", ""), ("", "mcap go"), ("ros1", "a"), ("x-my-profile", "")]
)
def test_a_file_of_any_profile_is_the_same_drive(ros1, profile, library, folder, tmp_path):
    bag = write_mcap(tmp_path / "site.mcap", messages_of(folder, ros1=ros1), profile, library)
    assert_same_drive(read(tmp_path / "drive", topics_for(folder, bag)), read_drive(folder))


def test_channels_of_another_kind_beside_those_of_ros_do_not_matter(folder, tmp_path):
    bag = write_mcap(tmp_path / "site.mcap", messages_of(folder), "", has_own_schemas=True)
    assert_same_drive(read(tmp_path / "drive", topics_for(folder, bag)), read_drive(folder))


def test_messages_that_are_not_encoded_as_ros_does_are_named(folder, tmp_path):
    bag = write_mcap(tmp_path / "site.mcap", messages_of(folder), "ros2", encoding="protobuf")
    with pytest.raises(
        DriveError, match=r"topic /\S+, type .*: its messages are encoded as protobuf; convert"
    ):
        read(tmp_path / "drive", topics_for(folder, bag))
