"""The stage cache: results of stages, kept under a digest of everything that they were made from.

An entry is a file, ``<cache>/stages/<stage>/<key>.v2hdm``, written whole or not at all and checked by its
checksum whenever it is read: a damaged one counts as absent. Its time of change is that of its last use.
Several processes, on several machines, may share a cache. Its bytes hold no name of a class or function: the
type that the reader asks for decides what they become, so that nothing in a file can choose code to run.

Where a cache must shrink, only our own files are removed, and none that is in use: the least recently used
of them go first.
"""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import re
import secrets
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar, get_origin

import numpy as np

from v2hdm.errors import ConfigError, need
from v2hdm.store.files import file_digest, refuse_url
from v2hdm.store.folders import HOST, LIST, STAGES, in_use, is_stale, remove_ours, size_of, unused_before

_log = logging.getLogger(__name__)
_Value = TypeVar("_Value")
Line = tuple[str, int, str]  # name of a logger, level, message
ENDING = ".v2hdm"  # of an entry's name, after its key

LIBRARIES = (
    "torch", "kornia", "numpy", "scipy", "onnxruntime", "onnxruntime-gpu", "opencv-python-headless", "numba",
    "simplejpeg",
)  # fmt: skip
"""Libraries that the figures of a run depend on."""

_HEAD = b"v2hdm entry 1\n"  # an entry's first bytes: what it is, and the version of its layout
_START = len(_HEAD) + hashlib.sha256().digest_size  # bytes before an entry's content: head and digest

_PACKAGE = Path(__file__).parents[1]  # the folder of this package
_CODE = {".py", ".yaml", ".json", ".onnx", ".html", ".js", ".css"}
"""Files of the package that decide what comes out: sources, catalogue, weights, templates."""

_NUMBERS = "biufc"  # numpy's kinds of element types that are numbers: bool, int, uint, float, complex


class CodecError(ValueError):
    """Bytes are not those of a value of the type that was asked for."""


def encode(value: Any) -> bytes:
    """The bytes of dataclasses, enumerations, paths, numpy arrays, plain values; TypeError for others."""
    data: bytes = _encoder().encode(value)
    return data


def decode(data: bytes, kind: type[_Value]) -> _Value:
    """The value of type ``kind`` that :func:`encode` made ``data`` of; CodecError where it is none."""
    codec = _codec()
    try:
        value: _Value = codec.msgpack.decode(data, type=kind, dec_hook=_special)
    except (codec.DecodeError, ValueError, TypeError, RecursionError) as failure:
        raise CodecError(str(failure)) from None
    return value


def _codec() -> Any:
    return need("msgspec", "map", "the stage cache", ConfigError)


@cache
def _encoder() -> Any:
    return _codec().msgpack.Encoder(enc_hook=_plain)


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray) and value.dtype.kind in _NUMBERS:
        return value.dtype.str, value.shape, np.ascontiguousarray(value).tobytes()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} cannot be cached")


def _special(kind: Any, content: Any) -> object:
    kind = get_origin(kind) or kind
    if kind is np.ndarray:
        name, shape, data = content
        dtype = np.dtype(name)
        if dtype.kind not in _NUMBERS:
            raise ValueError(f"an array of {dtype} is not read")
        return np.frombuffer(data, dtype).reshape(shape).copy()
    if isinstance(kind, type) and issubclass(kind, Path):
        return kind(content)
    raise TypeError(f"{kind} cannot be cached")


def key_of(*parts: object) -> str:
    """SHA-256 in hexadecimal of parts that :func:`encode` takes."""
    return hashlib.sha256(encode(parts)).hexdigest()


@cache
def code_key() -> str:
    """The key of this package's files and its libraries' versions: any change invalidates entries."""
    files = sorted(path for path in _PACKAGE.rglob("*") if path.suffix in _CODE)
    content = [(path.relative_to(_PACKAGE).as_posix(), file_digest(path)) for path in files]
    return key_of(content, library_versions())


def library_versions() -> dict[str, str]:
    """Versions by name of Python, of the libraries that are installed, and the system."""
    from importlib.metadata import PackageNotFoundError, version

    versions = {"Python": platform.python_version()}
    for package in LIBRARIES:
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return versions | {"system": f"{platform.system()} {platform.machine()}"}


class StageCache:
    """The entries of a cache folder.

    The results of a stage have always been through the codec, and the log lines of their making are logged
    again: a run that goes on with entries cannot tell them from results of its own. No ``folder`` keeps
    nothing; without ``resume`` everything is made anew, and kept. Raises ConfigError for a URL.
    """

    def __init__(self, folder: Path | None, resume: bool = True) -> None:
        if folder is not None:
            refuse_url(folder)
        self.folder = folder
        self._resume = resume
        self._can_write = folder is not None
        self.hits: list[str] = []
        """Stages that were read from the cache."""

    def in_use(self) -> AbstractContextManager[None]:
        """Protect entries that are read or written within this block from pruning."""
        return nullcontext() if self.folder is None else in_use(self.folder)

    def key(self, *parts: object) -> str:
        """The key of this code version's result for the inputs ``parts``."""
        return key_of(code_key(), *parts)

    def path(self, stage: str, key: str) -> Path:
        """Where the entry of a stage belongs."""
        return (self.folder or Path()) / STAGES / stage / f"{key}{ENDING}"

    def get_or_make(self, stage: str, key: str, kind: type[_Value], make: Callable[[], _Value]) -> _Value:
        """The result of a stage, of type ``kind``: its entry, or what ``make`` returns if there is none."""
        if (cached := self.get(stage, key, kind)) is not None:
            return cached
        with recorded() as lines:
            value = make()
        return self.put(stage, key, kind, value, lines)

    def get(self, stage: str, key: str, kind: type[_Value]) -> _Value | None:
        """The entry of a stage under ``key``; None if it is missing or damaged."""
        path = self.path(stage, key)
        if not self._resume or self.folder is None or not path.is_file():  # a pipe would be waited for
            return None
        try:
            content = checked(path.read_bytes())
            lines, encoded = decode(content or b"", tuple[list[Line], bytes])
            value = decode(encoded, kind)
        except FileNotFoundError:
            return None
        except OSError as failure:
            _log.warning("%s: cannot be read (%s); it is recomputed", path, failure.strerror)
            return None
        except CodecError:
            _log.warning("%s: is damaged; it is recomputed", path)
            with suppress(OSError):
                path.unlink(missing_ok=True)
            return None
        with suppress(OSError):  # a cache that may only be read
            os.utime(path)
        log_again(lines)
        self.hits.append(stage)
        return value

    def put(
        self, stage: str, key: str, kind: type[_Value], value: _Value, lines: list[Line] | None = None
    ) -> _Value:
        """Store ``value`` under ``key`` and return it as :meth:`get` will; warn if it cannot be stored."""
        content = encode(value)
        path = self.path(stage, key)
        partial = path.with_name(f".{HOST}-{secrets.token_hex(8)}.part")
        try:
            if self._can_write:
                entry = encode((lines or [], content))
                path.parent.mkdir(parents=True, exist_ok=True)
                try:
                    with partial.open("xb") as stream:
                        stream.write(_HEAD + hashlib.sha256(entry).digest() + entry)
                    partial.replace(path)
                finally:
                    partial.unlink(missing_ok=True)
        except OSError as failure:
            self._can_write = False
            _log.warning(
                "%s: cannot be written (%s): later runs cannot resume; free space or set cache=",
                path.parents[1], failure.strerror,
            )  # fmt: skip
        return decode(content, kind)


def checked(data: bytes) -> bytes | None:
    """The content of an entry's file; None if it is damaged."""
    content = data[_START:]
    return content if data[:_START] == _HEAD + hashlib.sha256(content).digest() else None


class _Recorder(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.DEBUG)
        self.lines: list[Line] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append((record.name, record.levelno, record.getMessage()))


def log_again(lines: Sequence[Line]) -> None:
    """Log again the lines that were :func:`recorded`."""
    for name, level, message in lines:
        logging.getLogger(name).log(level, "%s", message)


@contextmanager
def recorded() -> Iterator[list[Line]]:
    """Record what this library logs within this block."""
    recorder = _Recorder()
    logger = logging.getLogger("v2hdm")
    logger.addHandler(recorder)
    try:
        yield recorder.lines
    finally:
        logger.removeHandler(recorder)


_ENTRY = re.compile(rf"[0-9a-f]{{64}}{re.escape(ENDING)}")
_PARTIAL = re.compile(r"\.[\w.-]+[.-][0-9a-f]{8,16}\.part")

DRIVES = "drives and imports"  # kind of an item that is a folder; that of an entry is its stage
LEFT = "left by killed runs"  # kind of a file or folder that was never finished


@dataclass(frozen=True)
class Item:
    """One file or folder that a cache keeps."""

    kind: str  # its stage, :data:`DRIVES` or :data:`LEFT`
    path: Path
    size: int  # bytes
    used_s: float  # last use, s since 1970
    remove: Callable[[], None]


def items_of(cache: Path) -> list[Item]:
    """All our items in a cache, the least recently used first."""
    items = []
    for path in (cache / STAGES).glob("*/*"):
        kind = path.parent.name if _ENTRY.fullmatch(path.name) else LEFT
        if (kind == LEFT and not _PARTIAL.fullmatch(path.name)) or not path.is_file():
            continue
        with suppress(OSError):  # another process has removed it
            about = path.stat()
            remove = partial(path.unlink, missing_ok=True)
            items.append(Item(kind, path, about.st_size, about.st_mtime, remove))
    for folder in cache.glob(".*.part"):
        with suppress(OSError):
            if _PARTIAL.fullmatch(folder.name) and folder.is_dir() and is_stale(folder):
                left = sum(file.stat().st_size for file in folder.rglob("*"))
                items.append(Item(LEFT, folder, left, folder.stat().st_mtime, partial(shutil.rmtree, folder)))
    for listing in cache.glob(f"*/{LIST}"):
        folder = listing.parent
        size = size_of(listing.parent)
        with suppress(OSError):
            if size is not None:
                used_s = listing.stat().st_mtime
                items.append(Item(DRIVES, folder, size, used_s, partial(remove_ours, folder)))
    return sorted(items, key=lambda item: (item.used_s, item.path))


def prune(cache: Path, limit: float) -> list[Item]:
    """Remove the least recently used items down to ``limit`` bytes, and what killed runs left."""
    before_s = unused_before(cache)
    items = items_of(cache)
    removed = []
    size = sum(item.size for item in items)
    for item in items:
        if item.used_s >= before_s or (size <= limit and item.kind != LEFT):
            continue
        with suppress(OSError):  # not ours to remove: on a shared folder, another user's
            item.remove()
            size -= item.size
            removed.append(item)
    return removed


def prune_to_limit(cache: Path, limit_gb: float) -> None:
    """Prune a cache to a limit in GB, and log the removed items."""
    removed = prune(cache, limit_gb * 1e9)
    if removed:
        size_gb = sum(item.size for item in removed) / 1e9
        _log.info(
            "%s: removed the %d least recently used entries, %.1f GB (cache_gb=%g)",
            cache, len(removed), size_gb, limit_gb,
        )  # fmt: skip
