"""Bags that are made to take all of the memory, or for ever, are refused in one line."""

import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from backports import zstd
from rosbags.rosbag2 import CompressionMode

from tests.drive.bags import (
    MCAP,
    SQLITE3,
    Messages,
    messages_of,
    mountings,
    read,
    topics_for,
    write_ros1,
    write_ros2,
)
from tests.faults.again import list_again
from v2hdm.errors import DriveError
from v2hdm.io.importers.bag import reading
from v2hdm.io.importers.bag.streams import ImageStream, TfStream, import_streams, write_streams
from v2hdm.safe import child
from v2hdm.safe.databases import opened

HOSTILE = {
    "a constant in parentheses": "module a { module msg { const long X = (1); struct B { long x; }; }; };",
    "nested parentheses": "@a(b((1))) struct B { long x; };",
    "a trillion texts": "string[1000000000000] names",
    "a trillion texts at most": "string[<=1000000000000] names",
    "more digits than a number has": f"uint8[{'9' * 5000}] data",
    "nested brackets": "uint8" + "[" * 3000,
    "four million letters": "uint8 a\n" * 500_000,
    "thousands of no bytes": f"a_msgs/B[9999] x\n{'=' * 80}\nMSG: a_msgs/B\n",
    "thousands of none each": f"a_msgs/B[9999] x\n{'=' * 80}\nMSG: a_msgs/B\nuint8[0] y\n",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_definition_that_would_be_parsed_for_ever_is_refused(name, folder, tmp_path):
    bag = write_ros2(tmp_path / "bag", messages_of(folder), SQLITE3)
    (file,) = bag.glob("*.db3")
    with sqlite3.connect(file) as database:
        values = ("ros2idl" if "struct" in HOSTILE[name] else "ros2msg", HOSTILE[name])
        database.execute(
            "UPDATE message_definitions SET encoding = ?, encoded_message_definition = ?", values
        )
    database.close()
    with pytest.raises(DriveError, match="its definition is not from a recording"):
        read(tmp_path / "drive", topics_for(folder, bag))


COMPUTED = {
    "a view": "DROP TABLE schema; CREATE VIEW schema AS SELECT 4 AS schema_version",  # it might be endless
    "a virtual table": "DROP TABLE schema; CREATE VIRTUAL TABLE schema USING rtree(schema_version, a, b)",
    "a computed column": "ALTER TABLE messages ADD more AS (zeroblob(1000000000))",
    "an index of definitions": "CREATE INDEX again ON message_definitions (id)",
}


@pytest.mark.parametrize("sql", COMPUTED.values(), ids=COMPUTED)
@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.FILE])
def test_a_database_that_computes_its_rows_is_refused(mode, sql, folder, tmp_path):
    bag = write_ros2(tmp_path / "bag", messages_of(folder), SQLITE3, mode)
    (file,) = bag.glob("*.db3*")
    plain = tmp_path / "plain.db3"
    plain.write_bytes(
        zstd.decompress(file.read_bytes()) if mode == CompressionMode.FILE else file.read_bytes()
    )
    with closing(sqlite3.connect(plain)) as database:
        database.executescript(sql)
    data = plain.read_bytes()
    file.write_bytes(zstd.compress(data) if mode == CompressionMode.FILE else data)
    with pytest.raises(DriveError, match="is not a plain table of a recording"):
        read(tmp_path / "drive", topics_for(folder, bag))


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_zeros_that_would_unpack_to_all_of_the_memory_are_refused(mode, folder, tmp_path):
    bag = write_ros2(tmp_path / "bag", messages_of(folder), SQLITE3, mode)
    bomb = zstd.compress(bytes(260_000_000))
    if mode == CompressionMode.FILE:
        (file,) = bag.glob("*.zstd")
        file.write_bytes(bomb)
    else:
        (file,) = bag.glob("*.db3")
        with sqlite3.connect(file) as database:
            database.execute("UPDATE messages SET data = ?", (bomb,))
        database.close()
    with pytest.raises(DriveError, match="unpacks to more than a recording could"):
        read(tmp_path / "drive", topics_for(folder, bag))


DATA = """CREATE TABLE bare (id INTEGER PRIMARY KEY, topic_id, timestamp);
INSERT INTO bare SELECT id, topic_id, timestamp FROM messages; DROP TABLE messages;
ALTER TABLE bare RENAME TO messages; ALTER TABLE messages ADD data DEFAULT '{}'"""
MANY: dict[str, Callable[[Path], None]] = {
    "messages": lambda file: list_again(file, "messages"),
    "topics": lambda file: list_again(file, "topics"),
    "definitions": lambda file: list_again(file, "message_definitions"),
    "definitions that are one default": lambda file: executed(
        file, f"ALTER TABLE message_definitions ADD more DEFAULT '{'x' * 100_000}'"
    ),
    "messages that are one default": lambda file: executed(file, DATA.format("x" * 100_000)),
}


def executed(file, sql):
    with closing(sqlite3.connect(file)) as database:
        database.executescript(sql)


@pytest.mark.parametrize("name", MANY)
def test_more_rows_than_a_database_has_bytes_are_refused(name, folder, tmp_path):
    bag = write_ros2(tmp_path / "bag", messages_of(folder), SQLITE3)
    MANY[name](next(bag.glob("*.db3")))
    with pytest.raises(DriveError, match=r"interrupted|more rows than bytes|more bytes than it"):
        read(tmp_path / "drive", topics_for(folder, bag))


def test_no_query_of_a_database_takes_longer_than_its_bytes_need(tmp_path):
    """Whoever asks, be it of the schema alone, which is read again and again if its pages say so."""
    path, upward = tmp_path / "a.db3", "SELECT 1 UNION ALL SELECT k + 1 FROM n LIMIT 3000000"
    executed(path, "CREATE TABLE a (b)")
    with opened(path, "mode=ro") as data, pytest.raises(sqlite3.OperationalError, match="interrupt"):
        data.execute(f"WITH RECURSIVE n(k) AS ({upward}) SELECT max(k) FROM n").fetchall()


def test_profiles_of_service_that_would_be_parsed_for_ever_end_in_one_line(folder, tmp_path, monkeypatch):
    """In YAML, some thousand bytes that merge mappings take for ever."""
    monkeypatch.setattr(child, "_STEP_S", 2.0)
    bomb = "- &a0 {history: 1}\n" + "".join(f"- &a{k + 1} {{<<: [*a{k}, *a{k}]}}\n" for k in range(40))
    bag = write_ros2(tmp_path / "bag", messages_of(folder), SQLITE3)
    (file,) = bag.glob("*.db3")
    executed(file, f"UPDATE topics SET offered_qos_profiles = '{bomb}'")
    with pytest.raises(DriveError, match=r"bag: takes more than 2 s of a processor for one piece"):
        read(tmp_path / "drive", topics_for(folder, bag))


def test_a_chunk_that_the_index_lists_many_times_is_refused(folder, tmp_path):
    """All of them are held at once, for they are of one time."""
    bag = write_ros2(tmp_path / "bag", messages_of(folder))
    (file,) = bag.glob("*.mcap")
    data, summary, at = file.read_bytes(), b"", 0
    (begin,) = struct.unpack("<Q", data[-28:-20])  # in the footer, see https://mcap.dev/spec
    at = begin
    while at < len(data) - 37:
        end = at + 9 + struct.unpack_from("<Q", data, at + 1)[0]
        summary += data[at:end] * (50 if data[at] == 8 else 1)
        at = end
    file.write_bytes(data[:begin] + summary + data[-37:-20] + bytes(12) + data[-8:])
    with pytest.raises(DriveError, match="its index lists a chunk twice"):
        read(tmp_path / "drive", topics_for(folder, bag))


PACKED: dict[str, Callable[[Path, Messages], Path]] = {
    "ros1 lz4": lambda path, messages: write_ros1(path, messages, "lz4"),
    "ros1 bz2": lambda path, messages: write_ros1(path, messages, "bz2"),
    "mcap zstd chunks": lambda path, messages: write_ros2(path, messages, MCAP, CompressionMode.STORAGE),
}


@pytest.mark.parametrize("kind", PACKED)
def test_chunks_of_zeros_are_refused_together_though_none_is_alone(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "_SPARE_BYTES", 4_000_000)
    messages = Messages(kind.startswith("ros1"))
    for number in range(10):
        zeros = messages.raw_image(1.0 + number, np.zeros((600, 1000, 3), np.uint8), "rgb8", "front")
        messages.add(1.0 + number, "/image", zeros)
    bag = PACKED[kind](tmp_path / "bag", messages)
    images = {tmp_path: ImageStream("/image", "header", "here")}
    with pytest.raises(DriveError, match="unpacks to more than a recording could"):
        write_streams(bag, images)
    messages.rows = messages.rows[:1]
    write_streams(PACKED[kind](tmp_path / "one", messages), images)


@pytest.mark.parametrize("kind", PACKED)
def test_a_message_of_zeros_is_refused(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(reading, "_SPARE_BYTES", 1_000_000)
    messages = Messages(kind.startswith("ros1"))
    zeros = np.zeros((2000, 4000, 3), dtype=np.uint8)
    messages.add(1.0, "/image", messages.raw_image(1.0, zeros, "rgb8", "front"))
    bag = PACKED[kind](tmp_path / "bag", messages)
    (file,) = [bag] if bag.is_file() else bag.glob("*.mcap")
    assert file.stat().st_size < 200_000
    with pytest.raises(DriveError, match="unpacks to more than a recording could") as refused:
        write_streams(bag, {tmp_path: ImageStream("/image", "header", "here")})
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("kind", ["ros1 lz4", "mcap zstd chunks"])  # bz2 takes seconds
def test_zeros_that_do_not_fit_in_the_childs_memory_are_refused(kind, tmp_path, monkeypatch):
    """Wherever rosbags unpacks them, and by whatever."""
    monkeypatch.setattr(child, "_SPARE_BYTES", 300_000_000)
    messages = Messages(kind.startswith("ros1"))
    zeros = np.zeros((10_000, 10_000, 3), dtype=np.uint8)
    messages.add(1.0, "/image", messages.raw_image(1.0, zeros, "rgb8", "front"))
    bag = PACKED[kind](tmp_path / "bag", messages)
    with pytest.raises(DriveError, match="unpacks to more than a recording could") as refused:
        import_streams(bag, [ImageStream("/image", "header", "here")], tmp_path / "cache")
    assert "\n" not in str(refused.value)
    assert not list((tmp_path / "cache").glob("*"))


def test_a_frame_whose_name_has_a_tab_is_refused(folder, tmp_path):
    messages = messages_of(folder, mounted={**mountings(), "a\tb": mountings()["front"]})
    bag = write_ros2(tmp_path / "bag", messages)
    with pytest.raises(DriveError, match="a frame is named") as refused:
        import_streams(bag, [TfStream("here")], tmp_path / "cache")
    assert "\t" not in str(refused.value)
