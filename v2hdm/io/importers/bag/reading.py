"""Topics and messages of ROS 1 and ROS 2 bags, through ``rosbags``; damage ends in one line."""

from __future__ import annotations

import re
import sys
from collections import defaultdict, deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from v2hdm.errors import REASON_LETTERS, DriveError, bounded, need
from v2hdm.io.importers.bag.mcap import ROS1, ROS2, mcap_reader
from v2hdm.safe.child import Limits, in_child, next_step
from v2hdm.safe.databases import opened, rows_of
from v2hdm.safe.placeholders import placeholder_words
from v2hdm.store.files import load_yaml, take_mapping

SUFFIXES = (".bag", ".mcap", ".db3")
_LIBRARIES = (
    "rosbags.rosbag1",
    "rosbags.rosbag2",
    "rosbags.typesys",
)  # a third of the time to read a short bag
_METADATA = "metadata.yaml"
_TIMES = 10  # largest ratio of a message's or file's bytes to those of the bag that packs it
_TIMES_IN_ALL = 100  # the same of all messages: raw pictures of a simulator may pack twenty times
_SPARE_BYTES = 200_000_000  # which either may have beyond that
_BLOCK_BYTES = 1 << 20  # that a compressed file is unpacked by
_TRAP = "is cut off, or unpacks to more than a recording could; unpack it yourself"
_MOST_LETTERS = 1_000_000  # of a type's definition
_TEXTS = re.compile(r'"(?:[^"\\]|\\.)*(?:"|\Z)|//[^\n]*|#[^\n]*|/\*.*?(?:\*/|\Z)', re.DOTALL)
_CONSTANT = re.compile(r"\bconst\b[^=;]*=([^;]*)")
_LITERAL = re.compile(r"\s*[-+]?[\w.:]*\s*")
_LONG = re.compile(r"\[[\s<=]*\d{8,}")  # an array of ten million elements
_NESTED = re.compile(r"\([^()]*\(|\[[^\[\]]*\[")
_NO_RECORDING = "its definition is not from a recording; convert it where it was recorded"
_MEND = {".bag": "rosbag reindex", ".mcap": "mcap recover", ".db3": "ros2 bag reindex"}


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
    """All files of the bag at ``path``, at least one."""
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise DriveError(f"{path}: no such bag; check the path")
    files = _parts(path)
    if not files:
        raise DriveError(f"{path}: no bags in this folder ({', '.join(SUFFIXES)}); check the path")
    described = path / _METADATA
    return [described, *files] if described.is_file() else files


def _parts(path: Path) -> list[Path]:
    endings = (*SUFFIXES, ".db3.zstd", ".mcap.zstd")
    files = (file for file in path.iterdir() if file.is_file() and not file.name.startswith("."))
    return sorted(file for file in files if file.name.endswith(endings))


class Bag:
    """An open bag: a reader for each of its files, in the order of time; types are taken when needed."""

    def __init__(self, path: Path, readers: Sequence[Any]) -> None:
        self.path = path
        self._readers = readers
        self._stores: dict[tuple[str, bool], Any] = {}
        kinds: dict[str, set[str]] = defaultdict(set)
        counts: dict[str, int] = defaultdict(int)
        for reader in readers:
            for connection in reader.connections:
                kinds[connection.topic].add(connection.msgtype)
                counts[connection.topic] += connection.msgcount
        self.topics: Mapping[str, Topic] = {
            name: Topic(name, " and ".join(sorted(kinds[name])), counts[name]) for name in sorted(kinds)
        }

    def messages(self, topics: Collection[str]) -> Iterator[Message]:
        """The messages of some topics in the order received; DriveError where damaged, or some lack."""
        missing = sum(self.topics[name].messages for name in topics if name in self.topics)
        size = sum(file.stat().st_size for file in bag_files(self.path))
        spare_bytes = _TIMES_IN_ALL * size + _SPARE_BYTES
        stream = chain.from_iterable(_messages_of(reader, topics) for reader in self._readers)
        while True:
            next_step()
            with _one_line(self.path):
                packed = next(stream, None)
            if packed is None:
                break
            missing -= 1
            connection, received_ns, data = packed
            spare_bytes -= len(data)
            if spare_bytes < 0 or len(data) > _TIMES * size + _SPARE_BYTES:
                raise DriveError(f"{self.path}: {_TRAP}")
            with _one_line(self.path, f"topic {connection.topic}, type {connection.msgtype}: "):
                fields = self._fields(connection, data)
            yield Message(connection.topic, connection.msgtype, received_ns / 1e9, fields)
        if missing > 0:
            raise DriveError(
                f"{self.path}: {missing} listed messages of {', '.join(sorted(topics))} are "
                "missing; copy it again, or repair it with 'ros2 bag reindex'"
            )

    def _fields(self, connection: Any, data: bytes) -> Any:
        kind = connection.msgtype
        # Connections of a ROS 1 bag do not name their encoding, for there is no other.
        encoding = getattr(connection.ext, "serialization_format", ROS1)
        if encoding not in (ROS1, ROS2):
            raise DriveError(
                f"its messages are encoded as {encoding or 'nothing'}; convert it to ROS 2's cdr"
            )
        is_ros1 = encoding == ROS1
        if (kind, is_ros1) not in self._stores:
            store = self._store_of(connection, is_ros1)
            self._stores[kind, is_ros1] = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
        return self._stores[kind, is_ros1](data, kind)

    def _store_of(self, connection: Any, is_ros1: bool) -> Any:
        """The types of one connection: as the bag defines them, else the common ones."""
        from rosbags.interfaces import MessageDefinitionFormat, Nodetype
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

        definition = connection.msgdef
        _check_definition(definition.data)
        if definition.format == MessageDefinitionFormat.NONE:
            return get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
        store = get_typestore(Stores.EMPTY)
        types: dict[str, Any] = {}
        if definition.format == MessageDefinitionFormat.MSG:
            types = get_types_from_msg(definition.data, connection.msgtype)
        else:
            for part in filter(str.strip, definition.data.split("=" * 80 + "\n")):
                head, _, definition_below = part.partition("\n")
                types |= get_types_from_idl(definition_below if head.startswith("IDL: ") else part)
        for _, fields in types.values():
            if all(kind == Nodetype.ARRAY and not what[1] for _, (kind, what) in fields):
                raise DriveError(_NO_RECORDING)  # it has no bytes: any number of them fits in a message
        store.register(types)
        return store

    def need(self, name: str, kinds: Collection[str], where: str) -> Topic:
        """The topic ``name``, of one of the types ``kinds``; else DriveError names those that would do."""
        fitting = ", ".join(topic.name for topic in self.topics.values() if topic.kind in kinds) or "none"
        expected = ", ".join(sorted(kind.split("/")[-1] for kind in kinds))
        topic = self.topics.get(name)
        if topic is None:
            raise DriveError(
                f"{where}: {self.path} has no topic {name}; topics of type {expected}: {fitting}"
            )
        if topic.kind not in kinds:
            problem = f"topic {name} of {self.path} has type {topic.kind}, expected {expected}"
            raise DriveError(f"{where}: {problem}; it has: {fitting}")
        if not topic.messages:
            raise DriveError(f"{where}: topic {name} of {self.path} has no messages; record it")
        return topic


def in_child_of(path: Path, work: Callable[..., Any], *arguments: Any) -> Any:
    """The answer of ``work`` on the bag at ``path`` and more ``arguments``, done in a child."""
    need("rosbags", "ros", f"{path}: a bag", DriveError)
    limits = Limits.of(bag_files(path))
    return in_child(
        work, path, *arguments, limits=limits, where=str(path), error=DriveError, libraries=_LIBRARIES
    )


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open the bag at ``path``: a ROS 1 file, a ROS 2 folder, or one file of it."""
    from rosbags import rosbag1, rosbag2

    files = bag_files(path)
    with TemporaryDirectory() as scratch, ExitStack() as opened_readers:
        with _one_line(path):
            about = load_yaml(files[0], DriveError) if files[0].name == _METADATA else {}
            about = take_mapping(about.get("rosbag2_bagfile_information", {}), str(files[0]), DriveError)
            storages = files[files[0].name == _METADATA :]
            plain = [_unpacked(file, Path(scratch)) if file.suffix == ".zstd" else file for file in storages]
            for file in plain:
                if file.suffix == ".db3":
                    _check_database(file)
                    _check_plain(file)
            readers: list[Any] = []
            # Each of its messages may be compressed, which the folder's description states.
            if str(about.get("compression_mode")).lower() == "message":
                readers.append(opened_readers.enter_context(rosbag2.Reader(path)))
            else:
                # rosbags skips, without a word, topics of which the folder's description and the file state
                # other qualities of service, as bags that were rewritten do. The files alone have them all.
                for file in plain:
                    reader_of = {".bag": rosbag1.Reader, ".mcap": mcap_reader}
                    open_file = reader_of.get(file.suffix, rosbag2.Reader)
                    readers.append(opened_readers.enter_context(open_file(file)))
                readers.sort(key=lambda reader: reader.start_time)
            _check_chunks(readers)
            bag = Bag(path, readers)
        yield bag


def _messages_of(reader: Any, topics: Collection[str]) -> Iterator[Any]:
    """Connection, time received (ns) and bytes of each message of some topics in an open file."""
    connections = [connection for connection in reader.connections if connection.topic in topics]
    return reader.messages(connections=connections) if connections else iter(())


def _unpacked(file: Path, folder: Path) -> Path:
    """A file that is compressed as a whole, unpacked into ``folder``."""
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd

    plain = folder / file.stem
    spare_bytes = _TIMES * file.stat().st_size + _SPARE_BYTES
    with zstd.open(file) as packed, plain.open("wb") as unpacked:
        while block := packed.read(_BLOCK_BYTES):
            spare_bytes -= len(block)
            if spare_bytes < 0:
                raise DriveError(f"{file.name}: {_TRAP}")
            unpacked.write(block)
    return plain


def _check_chunks(readers: Sequence[Any]) -> None:
    """Refuse an MCAP file whose index lists a chunk again and again: chunks of one time are held together."""
    for reader in readers:
        storage = getattr(reader, "storage", None)
        for part in getattr(storage, "storages", [storage]):
            chunks = getattr(part, "chunks", [])
            if chunks and sum(chunk.compressed_size for chunk in chunks) > part.path.stat().st_size:
                raise DriveError("its index lists a chunk twice; run 'mcap recover'")


def _check_definition(text: str) -> None:
    """Refuse a type on which rosbags' parser, or what it generates, would take for ever."""
    plain = _TEXTS.sub("", text)
    computes = any(not _LITERAL.fullmatch(constant[1]) for constant in _CONSTANT.finditer(plain))
    if len(text) > _MOST_LETTERS or computes or _NESTED.search(plain) or _LONG.search(plain):
        raise DriveError(_NO_RECORDING)


def _check_database(path: Path) -> None:
    """Refuse an SQLite file (https://www.sqlite.org/fileformat.html, 1.3) whose end SQLite would not miss."""
    if words := placeholder_words(path):
        raise DriveError(f"{path}: {words}")
    journal = path.with_name(f"{path.name}-wal")
    if journal.is_file() and journal.stat().st_size:
        raise DriveError(f"{path}: was not closed; {journal.name} holds its end; run 'ros2 bag reindex'")
    with path.open("rb") as file:
        page_bytes = int.from_bytes(file.read(18)[16:], "big")
    if path.stat().st_size % (page_bytes if page_bytes > 1 else 65536):  # which two bytes cannot hold
        raise DriveError(f"{path}: is cut off in its last page; copy it again")


def _check_plain(path: Path) -> None:
    """Refuse an SQLite file that computes, or lists a row again and again: its rows need never end."""
    computes = "m.type = 'view' OR m.sql LIKE 'CREATE VIRTUAL%' OR x.hidden"
    repeats = "m.type = 'index' AND m.tbl_name <> 'messages'"
    columns = "sqlite_master m LEFT JOIN pragma_table_xinfo(m.name) x"
    query = f"SELECT m.name FROM {columns} WHERE {computes} OR {repeats}"
    with opened(path, "immutable=1") as data:
        for (name,) in data.execute(query):
            raise DriveError(f"{path}: {name} is not a plain table of a recording; convert it to MCAP")
        names = {name.lower() for (name,) in data.execute("SELECT name FROM sqlite_master")}
        for table in names & {"topics", "message_definitions"}:
            deque(rows_of(data, path, table), maxlen=0)
        ((message_bytes,),) = data.execute("SELECT total(length(data) + 1) FROM messages")
        if message_bytes > path.stat().st_size:
            raise DriveError(f"{path}: its messages have more bytes than it; convert it to MCAP")


@contextmanager
def _one_line(path: Path, what: str = "") -> Iterator[None]:
    """Turn whatever goes wrong in a damaged bag into one line."""
    try:
        yield
    except DriveError as refusal:
        if str(refusal).startswith(str(path)):
            raise
        raise DriveError(f"{path}: {what}{refusal}") from None
    except MemoryError:
        raise DriveError(f"{path}: {what}{_TRAP}") from None
    # Bytes that are not what they should be fail anywhere within rosbags, with any error.
    except Exception as failure:
        if isinstance(failure, KeyError) and what:
            raise DriveError(
                f"{path}: {what}the bag does not define the type {failure}; convert it to MCAP, which holds "
                "its types, where it was recorded: 'ros2 bag convert'"
            ) from None
        if words := placeholder_words(path):
            raise DriveError(f"{path}: {words}") from None
        said = " ".join(str(failure).split()) or type(failure).__name__
        reason = bounded(said, REASON_LETTERS).rstrip(".")
        raise DriveError(
            f"{path}: {what}not readable as a bag ({reason}); copy it again, or fix it "
            f"with '{_MEND.get(path.suffix, 'ros2 bag reindex')}' if the recording was cut off"
        ) from None
