"""Values to bytes and back, exactly: dataclasses, enumerations, paths, numpy arrays, plain values.

The bytes hold no name of a class or function: what they become is decided by the type that the reader asks
for, so that nothing in a file, whoever wrote it, can choose what is made or run.

Keys: digests of everything that an entry is made from, the code that makes it included.

Entries on disk: ``<cache>/stages/<stage>/<key>.v2hdm``, each written at once and checked when it is read.

Several processes, on several machines, may share a store. An entry's time of change is that of its last use.
Behind the folder there may be an object store with entries of the same names, of which it holds copies.

Results of stages, taken from the store where they are there and made where they are not.

What a stage hands on has always been through the codec, whether it was made now or long ago: a run that goes
on with kept results cannot tell them from those of a run in one go. Nor can who reads the log: what was
logged while a result was made is logged again when it is taken.
"""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar, get_origin

import msgspec
import numpy as np

from v2hdm.errors import ConfigError
from v2hdm.store.files import file_digest
from v2hdm.store.lock import STAGES, lease
from v2hdm.store.remote import Bucket

_Value = TypeVar("_Value")

_PLAIN_KINDS = "biufc"
"""Kinds of numpy's element types that are numbers; objects are none."""


class CodecError(ValueError):
    """Bytes are not those of a value of the type that was asked for."""


def encode(value: Any) -> bytes:
    """The bytes of a value; equal values of one type and order have equal bytes.

    Raises:
        TypeError: it holds something that cannot be kept.
    """
    return _ENCODER.encode(value)


def decode(data: bytes, kind: type[_Value]) -> _Value:
    """The value of type ``kind`` that :func:`encode` made ``data`` of; arrays are laid out row by row.

    Raises:
        CodecError: the bytes are of no such value.
    """
    try:
        return msgspec.msgpack.decode(data, type=kind, dec_hook=_special)
    except (msgspec.DecodeError, ValueError, TypeError, RecursionError) as failure:
        raise CodecError(str(failure)) from None


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in _PLAIN_KINDS:
            raise TypeError(f"an array of {value.dtype} cannot be kept")
        return value.dtype.str, value.shape, np.ascontiguousarray(value).tobytes()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} cannot be kept")


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_plain)


def _special(kind: Any, content: Any) -> object:
    kind = get_origin(kind) or kind
    if kind is np.ndarray:
        name, shape, data = content
        dtype = np.dtype(name)
        if dtype.kind not in _PLAIN_KINDS:
            raise ValueError(f"an array of {dtype} is not read")
        return np.frombuffer(data, dtype).reshape(shape).copy()
    if isinstance(kind, type) and issubclass(kind, Path):
        return kind(content)
    raise TypeError(f"{kind} cannot be kept")


_PACKAGE = Path(__file__).parents[1]
_CODE = {".py", ".yaml", ".json", ".onnx", ".html", ".js", ".css"}
"""Files of the package that decide what comes out: sources, catalogue, weights, templates."""

LIBRARIES = (
    "torch",
    "kornia",
    "numpy",
    "scipy",
    "onnxruntime",
    "onnxruntime-gpu",
    "opencv-python-headless",
    "numba",
)
"""Those that the figures of a run depend on."""


def key_of(*parts: object) -> str:
    """SHA-256 in hexadecimal of parts that :func:`v2hdm.store.cache.encode` takes."""
    return hashlib.sha256(encode(parts)).hexdigest()


@cache
def code_key() -> str:
    """Key of this package's files and of the versions of what it computes with: any change makes anew."""
    files = sorted(path for path in _PACKAGE.rglob("*") if path.suffix in _CODE)
    content = [(path.relative_to(_PACKAGE).as_posix(), file_digest(path)) for path in files]
    return key_of(content, library_versions())


def library_versions() -> dict[str, str]:
    """Versions by name of Python, of the libraries that are installed, and the system."""
    found = {"Python": platform.python_version()}
    for package in LIBRARIES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found | {"system": f"{platform.system()} {platform.machine()}"}


_log = logging.getLogger(__name__)

ENDING = ".v2hdm"
"""Of an entry's name, after its key."""

_Answer = TypeVar("_Answer")

_HEAD = b"v2hdm entry 1\n"
_DIGEST_BYTES = hashlib.sha256().digest_size


class Store:
    """The entries of one cache: a folder, and the object store ``behind`` it if there is one."""

    def __init__(self, cache: Path, behind: Bucket | None = None) -> None:
        self.cache, self.folder = cache, cache / STAGES
        self._can_write = True
        self._behind = behind

    @property
    def on_disk(self) -> Store:
        """The folder alone: for what is true of this machine's folders only."""
        return Store(self.cache)

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Within, nothing that is read or written is pruned."""
        with lease(self.cache):
            yield

    def path(self, stage: str, key: str) -> Path:
        """Where the entry of a stage with a key belongs."""
        return self.folder / stage / f"{key}{ENDING}"

    def get(self, stage: str, key: str) -> bytes | None:
        """What is kept under a key; None where there is nothing whole, of which a damaged file is removed."""
        content = self._on_disk(stage, key)
        return self._from_behind(stage, key) if content is None else content

    def _on_disk(self, stage: str, key: str) -> bytes | None:
        path = self.path(stage, key)
        try:
            if not path.is_file():  # a pipe would be waited for
                return None
            data = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as failure:
            _log.warning("%s: cannot be read (%s); it is made anew", path, failure.strerror)
            return None
        content = checked(data)
        if content is None:
            self.drop(stage, key)
            return None
        with suppress(OSError):  # a cache that may only be read
            os.utime(path)
        return content

    def _from_behind(self, stage: str, key: str) -> bytes | None:
        data = self._ask_behind(lambda behind: behind.read(name_of(stage, key)))
        if data is None:
            return None
        content = checked(data)
        if content is None:
            self.drop(stage, key)
        else:
            self._put_on_disk(stage, key, content)
        return content

    def put(self, stage: str, key: str, content: bytes) -> None:
        """Keep ``content`` under a key; where nothing can be written a warning says so, once."""
        self._put_on_disk(stage, key, content)
        self._ask_behind(lambda behind: behind.write(name_of(stage, key), _framed(content)))

    def _put_on_disk(self, stage: str, key: str, content: bytes) -> None:
        if not self._can_write:
            return
        path = self.path(stage, key)
        partial = path.with_name(f".{key[:16]}.{secrets.token_hex(4)}.part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                with partial.open("xb") as stream:
                    stream.write(_framed(content))
                partial.replace(path)
            finally:
                partial.unlink(missing_ok=True)
        except OSError as failure:
            self._can_write = False
            _log.warning(
                "%s: nothing can be kept there (%s), so that a later run begins anew; free space or set "
                "another cache=",
                self.folder, failure.strerror,
            )  # fmt: skip

    def drop(self, stage: str, key: str) -> None:
        """Remove an entry that is damaged."""
        path = self.path(stage, key)
        _log.warning("%s: is damaged; it is made anew", path)
        with suppress(OSError):
            path.unlink(missing_ok=True)
        self._ask_behind(lambda behind: behind.remove(name_of(stage, key)))

    def _ask_behind(self, question: Callable[[Bucket], _Answer]) -> _Answer | None:
        """The answer of the store behind; one that fails is told once and left alone from then on."""
        if self._behind is None:
            return None
        try:
            return question(self._behind)
        except ConfigError as failure:
            self._behind = None
            _log.warning("%s; the run goes on without that cache", failure)
            return None


def name_of(stage: str, key: str) -> str:
    """What the entry of a stage with a key is called in an object store."""
    return f"{STAGES}/{stage}/{key}{ENDING}"


def _framed(content: bytes) -> bytes:
    return _HEAD + hashlib.sha256(content).digest() + content


def checked(data: bytes) -> bytes | None:
    """The content of an entry's file, None where it is damaged."""
    start = len(_HEAD) + _DIGEST_BYTES
    if data[: len(_HEAD)] != _HEAD or hashlib.sha256(data[start:]).digest() != data[len(_HEAD) : start]:
        return None
    return data[start:]


_Value = TypeVar("_Value")
Line = tuple[str, int, str]
"""Name of a logger, level, message."""


class Room:
    """A store as stages use it.

    Args:
        store: where results are kept; None keeps none.
        resume: whether what is there is taken; otherwise all is made anew, and kept.
    """

    def __init__(self, store: Store | None, resume: bool = True) -> None:
        self._store, self._resume = store, resume
        self.taken: list[str] = []
        """Stages whose results were there."""

    def key(self, *parts: object) -> str:
        """The key of what is made of ``parts`` by this version of the code."""
        return key_of(code_key(), *parts)

    def made(self, stage: str, key: str, kind: type[_Value], make: Callable[[], _Value]) -> _Value:
        """The result of a stage, of type ``kind``: that kept under ``key``, or else what ``make`` makes."""
        found = self.take(stage, key, kind)
        if found is not None:
            return found
        with recorded() as lines:
            value = make()
        return self.keep(stage, key, kind, value, lines)

    def each_made(
        self, stage: str, kind: type[_Value], jobs: Sequence[tuple[str, Callable[[], Callable[[], _Value]]]]
    ) -> Iterator[_Value]:
        """Several results of a stage, in order; all that are missing are begun before one is waited for.

        A job is a key, and what begins to make the result and returns what waits for it.
        """
        found = [self.take(stage, key, kind) for key, _ in jobs]
        begun = [begin() if one is None else None for one, (_, begin) in zip(found, jobs, strict=True)]
        for one, wait, (key, _) in zip(found, begun, jobs, strict=True):
            if wait is None:
                assert one is not None
                yield one
                continue
            with recorded() as lines:
                value = wait()
            yield self.keep(stage, key, kind, value, lines)

    def take(self, stage: str, key: str, kind: type[_Value]) -> _Value | None:
        """What is kept under ``key``; None where there is nothing."""
        if self._store is None or not self._resume:
            return None
        data = self._store.get(stage, key)
        if data is None:
            return None
        try:
            lines, content = decode(data, tuple[list[Line], bytes])
            value = decode(content, kind)
        except CodecError:
            self._store.drop(stage, key)
            return None
        log_again(lines)
        self.taken.append(stage)
        return value

    def keep(
        self, stage: str, key: str, kind: type[_Value], value: _Value, lines: list[Line] | None = None
    ) -> _Value:
        """Keep ``value`` under ``key``; returns it as :meth:`take` will."""
        content = encode(value)
        if self._store is not None:
            self._store.put(stage, key, encode((lines or [], content)))
        return decode(content, kind)


class _Recorder(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.DEBUG)
        self.lines: list[Line] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append((record.name, record.levelno, record.getMessage()))


def log_again(lines: Sequence[Line]) -> None:
    """Log what was :func:`recorded`."""
    for name, level, message in lines:
        logging.getLogger(name).log(level, "%s", message)


@contextmanager
def recorded() -> Iterator[list[Line]]:
    """What this library logs within."""
    recorder, logger = _Recorder(), logging.getLogger("v2hdm")
    logger.addHandler(recorder)
    try:
        yield recorder.lines
    finally:
        logger.removeHandler(recorder)
