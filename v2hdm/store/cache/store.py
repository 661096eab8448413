"""Entries on disk: ``<cache>/stages/<stage>/<key>.v2hdm``, each written at once and checked when it is read.

Several processes, on several machines, may share a store. An entry's time of change is that of its last use.
Behind the folder there may be an object store with entries of the same names, of which it holds copies.
"""

from __future__ import annotations

import hashlib
import logging
import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from v2hdm.errors import ConfigError
from v2hdm.store.cache.leases import STAGES, lease
from v2hdm.store.objects.bucket import Bucket

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
