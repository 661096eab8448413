"""Who uses a store now: a file that each process holds locked while it runs.

A run touches every entry that it uses, so that what was last used before the oldest run in progress began is
used by none of them.
"""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from v2hdm.locks import take_lock

_FOLDER = "in_use"
_ENDING = ".lease"


@contextmanager
def lease(folder: Path) -> Iterator[None]:
    """Tell others, within, that the store in ``folder`` is in use, if anything can be written there."""
    path = folder / _FOLDER / f"{os.getpid()}-{secrets.token_hex(4)}{_ENDING}"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream = path.open("x", encoding="utf-8")
    except OSError:
        yield
        return
    try:
        with suppress(OSError):
            take_lock(stream)
        yield
    finally:
        stream.close()
        with suppress(OSError):
            path.unlink(missing_ok=True)


def unused_before(folder: Path) -> float:
    """What was last used before this time, s since 1970, is used by no run in progress.

    Leases of processes that have died are removed.
    """
    earliest = time.time()
    for path in sorted((folder / _FOLDER).glob(f"*{_ENDING}")):
        try:
            began = path.stat().st_mtime
            with path.open("a", encoding="utf-8") as stream:
                is_left = take_lock(stream)
            if is_left:
                path.unlink(missing_ok=True)
            else:
                earliest = min(earliest, began)
        except OSError:
            continue
    return earliest
