"""A bag's topics and messages; whatever is wrong with its files ends in one line."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from v2hdm.errors import DriveError
from v2hdm.extras import need

SUFFIXES = (".bag", ".mcap", ".db3")
_METADATA = "metadata.yaml"
_MEND = {
    ".bag": "rosbag reindex",
    ".mcap": "mcap recover",
    ".db3": "ros2 bag reindex",
}


@dataclass(frozen=True)
class Topic:
    """One topic of a bag."""

    name: str
    kind: str
    messages: int


@dataclass(frozen=True)
class Message:
    """One message: its topic, its type, when it was received (s), and its fields."""

    topic: str
    kind: str
    received_s: float
    fields: Any


def is_bag(path: Path) -> bool:
    """Whether ``path`` looks like a bag: a file of one, or a folder of a recorder."""
    return bool(_parts(path)) if path.is_dir() else path.suffix in SUFFIXES


def bag_files(path: Path) -> list[Path]:
    """All files of the bag at ``path``.

    Raises:
        DriveError: there is none.
    """
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise DriveError(f"{path}: no such bag; check the path")
    files = _parts(path)
    if not files:
        raise DriveError(f"{path}: no bag in this folder ({', '.join(SUFFIXES)}); check the path")
    described = path / _METADATA
    return [described, *files] if described.is_file() else files


def _parts(path: Path) -> list[Path]:
    endings = (*SUFFIXES, ".db3.zstd", ".mcap.zstd")
    return sorted(file for file in path.iterdir() if file.is_file() and file.name.endswith(endings))


class Bag:
    """An open bag."""

    def __init__(self, path: Path, reader: Any) -> None:
        self.path = path
        self._reader = reader
        found = reader.topics
        self.topics: Mapping[str, Topic] = {
            name: Topic(name, info.msgtype or "several types", info.msgcount)
            for name, info in sorted(found.items())
        }

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """The messages of some topics in the order in which they were received.

        Raises:
            DriveError: the bag is damaged, or its types are not known.
        """
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:
            return
        with _one_line(self.path):
            stream = iter(self._reader.messages(connections=connections))
        while True:
            with _one_line(self.path):
                item = next(stream, None)
            if item is None:
                return
            connection, received_ns, data = item
            with _one_line(self.path, f"topic {connection.topic}, type {connection.msgtype}: "):
                fields = self._reader.deserialize(data, connection.msgtype)
            yield Message(connection.topic, connection.msgtype, received_ns / 1e9, fields)

    def need(self, name: str, kinds: Collection[str], where: str) -> Topic:
        """The topic ``name``, which is of one of the types ``kinds``.

        Raises:
            DriveError: there is none such; names those that would do.
        """
        fitting = ", ".join(topic.name for topic in self.topics.values() if topic.kind in kinds) or "none"
        wanted = ", ".join(sorted(kind.split("/")[-1] for kind in kinds))
        topic = self.topics.get(name)
        if topic is None:
            raise DriveError(f"{where}: {self.path} has no topic {name}; of type {wanted} it has: {fitting}")
        if topic.kind not in kinds:
            raise DriveError(
                f"{where}: topic {name} of {self.path} is of type {topic.kind}, wanted is {wanted}; it has: {fitting}"
            )
        if not topic.messages:
            raise DriveError(f"{where}: topic {name} of {self.path} holds no message; record it")
        return topic


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open the bag at ``path``: a ROS 1 file, a ROS 2 folder, or one file of it.

    Raises:
        DriveError: it is none, damaged or cut off, or rosbags is not installed.
    """
    need("rosbags", "ros", f"{path}: a bag", DriveError)
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    files = bag_files(path)
    paths = files if files[0].name != _METADATA else [path]
    with _one_line(path):
        reader = AnyReader(paths, default_typestore=get_typestore(Stores.LATEST))
        reader.open()
    try:
        with _one_line(path):
            bag = Bag(path, reader)
        yield bag
    finally:
        reader.close()


@contextmanager
def _one_line(path: Path, what: str = "") -> Iterator[None]:
    """Turn whatever goes wrong in a damaged bag into one line."""
    try:
        yield
    except DriveError:
        raise
    # Bytes that are not what they should be fail anywhere within rosbags, with any error.
    except Exception as failure:
        reason = " ".join(str(failure).split()) or type(failure).__name__
        if isinstance(failure, KeyError):
            reason = f"the type {reason} is not defined in the bag"
        mend = _MEND.get(path.suffix, "ros2 bag reindex")
        raise DriveError(
            f"{path}: {what}not readable as a bag ({reason[:200].rstrip('.')}); copy it again, or mend it with "
            f"'{mend}' if the recording was cut off"
        ) from None
