"""Inputs of a door are never written over.

Each reader notes what it reads and each writer asks before it replaces a file. Outside of a door nothing is
noted: a program that reads a map, changes it and writes it back means to.

The list of our files in a folder of results, and telling of files that are not what we wrote there.

It has a line of JSON for each file after one that says what it is. A file that was written again has several;
a torn or foreign line says nothing of any.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from v2hdm.errors import ConfigError

_noted: ContextVar[set[tuple[int, int]] | None] = ContextVar("inputs of this door", default=None)


@contextmanager
def protected_inputs() -> Iterator[None]:
    """Files that are noted within this block are not written over within it."""
    token = _noted.set(set())
    try:
        yield
    finally:
        _noted.reset(token)


def note_input(path: Path) -> None:
    """Protect the file at ``path``, under whatever name; one that cannot be looked at needs none."""
    noted = _noted.get()
    if noted is not None and (identity := _identity(path)) is not None:
        noted.add(identity)


def refuse_input(path: Path) -> None:
    """Refuse to write over what has been noted.

    Raises:
        ConfigError: ``path`` is one of the files that this door reads.
    """
    noted = _noted.get()
    if noted and _identity(path) in noted:
        raise ConfigError(f"{path}: is one of the inputs and is not written over; name another output")


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        about = path.stat()
    except (OSError, ValueError):
        return None
    return about.st_dev, about.st_ino


_log = logging.getLogger(__name__)

LIST = ".v2hdm-results.jsonl"
"""Name of the list in a folder."""

_DEEPEST = 3
"""Folders above a file that may have a list: ours lie at most two folders deep."""

_told: set[tuple[Path, str]] = set()


def tell_if_changed(path: Path, data: bytes) -> None:
    """Warn, once, of a file of a result that holds other ``data`` than we wrote: edited, or damaged.

    It is read all the same: a map that was mended by hand is a map.
    """
    with suppress(OSError, RuntimeError):
        path = path.resolve()
        for folder in path.parents[:_DEEPEST]:
            listing = folder / LIST
            if not listing.is_file():
                continue
            written = _written(listing, path.relative_to(folder).as_posix())
            digest = hashlib.sha256(data).hexdigest()
            if written and digest not in written and (path, digest) not in _told:
                _told.add((path, digest))
                _log.warning(
                    "%s: is not as we wrote it, so it was edited since or is damaged; if nobody edited it, "
                    "make it anew",
                    path,
                )
            return


def _written(listing: Path, name: str) -> set[str]:
    """Digests of all that we have written under a name."""
    found = set()
    for line in listing.read_text(encoding="utf-8", errors="replace").splitlines()[1:]:
        with suppress(ValueError, TypeError, LookupError, RecursionError):
            entry = json.loads(line)
            if entry["file"] == name:
                found.add(str(entry["sha256"]))
    return found
