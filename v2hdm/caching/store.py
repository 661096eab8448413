"""Entries on disk: ``<cache>/stages/<stage>/<key>.v2hdm``, each written at once and checked when it is read.

Several processes, on several machines, may share a store. An entry's time of change is that of its last use.
"""

from __future__ import annotations

import hashlib
import logging
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from v2hdm.caching.leases import STAGES, lease

_log = logging.getLogger(__name__)

ENDING = ".v2hdm"
"""Of an entry's name, after its key."""

_HEAD = b"v2hdm entry 1\n"
_DIGEST_BYTES = hashlib.sha256().digest_size


class Store:
    """The entries of one cache."""

    def __init__(self, cache: Path) -> None:
        self.cache, self.folder = cache, cache / STAGES
        self._can_write = True

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

    def put(self, stage: str, key: str, content: bytes) -> None:
        """Keep ``content`` under a key; where nothing can be written a warning says so, once."""
        if not self._can_write:
            return
        path = self.path(stage, key)
        partial = path.with_name(f".{key[:16]}.{secrets.token_hex(4)}.part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                with partial.open("xb") as stream:
                    stream.write(_HEAD + hashlib.sha256(content).digest())
                    stream.write(content)
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


def checked(data: bytes) -> bytes | None:
    """The content of an entry's file, None where it is damaged."""
    start = len(_HEAD) + _DIGEST_BYTES
    if data[: len(_HEAD)] != _HEAD or hashlib.sha256(data[start:]).digest() != data[len(_HEAD) : start]:
        return None
    return data[start:]
