"""Recordings and files of other tools, imported into the cache once, whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from v2hdm.store.folders import begin_entry, cannot_write, drop_entry, finish_entry


@contextmanager
def new_entry(folder: Path) -> Iterator[Path]:
    """A hidden folder to fill, which takes the place of the entry ``folder`` when the block succeeds."""
    partial = begin_entry(folder)
    try:
        yield partial
        finish_entry(folder)
    except OSError as failure:
        raise cannot_write(folder, failure) from None
    finally:
        drop_entry(folder)
