"""Inputs of a door are never written over.

Each reader notes what it reads and each writer asks before it replaces a file. Outside of a door nothing is
noted: a program that reads a map, changes it and writes it back means to.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
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
