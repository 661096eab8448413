"""Files that a command reads: it overwrites none of them, and reports a result's file that was changed.

Each reader notes what it reads and each writer asks before it replaces a file. Outside of a command nothing
is noted: a program that reads a map, changes it and writes it back means to.
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

_log = logging.getLogger(__name__)

LIST = ".v2hdm-results.jsonl"
"""Name of the list of our files in a folder of results: a head, then a line of JSON for each file written."""

_DEEPEST = 3  # folders above a file in which its list may lie: our files lie at most two folders below it
_noted: ContextVar[set[tuple[int, int]] | None] = ContextVar("inputs of this command", default=None)
_reported: set[tuple[Path, str]] = set()


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
    """Raise ConfigError where ``path`` is one of the files that this command reads."""
    noted = _noted.get()
    if noted and _identity(path) in noted:
        raise ConfigError(f"{path}: is one of the inputs and is not overwritten; choose another output")


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        about = path.stat()
    except (OSError, ValueError):
        return None
    return about.st_dev, about.st_ino


def is_as_written(path: Path, data: bytes) -> bool:
    """Whether a file of a result holds the ``data`` that we wrote."""
    with suppress(OSError, RuntimeError):
        return hashlib.sha256(data).hexdigest() in _digests(path.resolve())
    return False


def _digests(path: Path) -> set[str]:
    """The digests of the content that we wrote to a file, from its result's list; empty if unlisted."""
    folder = next((parent for parent in path.parents[:_DEEPEST] if (parent / LIST).is_file()), None)
    if folder is None:
        return set()
    written = set()
    for line in (folder / LIST).read_text(encoding="utf-8", errors="replace").splitlines()[1:]:
        with suppress(ValueError, TypeError, LookupError, RecursionError):  # a torn or foreign line
            entry = json.loads(line)
            if entry["file"] == path.relative_to(folder).as_posix():
                written.add(str(entry["sha256"]))
    return written


def warn_if_changed(path: Path, data: bytes) -> None:
    """Warn once if a result's file holds other ``data`` than we wrote; it is still read."""
    with suppress(OSError, RuntimeError):
        path = path.resolve()
        digest = hashlib.sha256(data).hexdigest()
        written = _digests(path)
        if written and digest not in written and (path, digest) not in _reported:
            _reported.add((path, digest))
            advice = "edited since, or damaged; if nobody edited it, make it again"
            _log.warning("%s: has changed since we wrote it: %s", path, advice)
