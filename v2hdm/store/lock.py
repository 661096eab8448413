"""Locks of the operating system on files, which are released by the end of a process, whatever ends it.

Who uses a cache now: a file that each process holds locked while it does.

A run touches all that it uses, so that what was last used before the oldest run in progress began is used by
none of them.
"""

from __future__ import annotations

import atexit
import logging
import os
import secrets
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO

_log = logging.getLogger(__name__)


def take_lock(stream: IO[str]) -> bool:
    """Lock an open file without waiting; whether it was free. Where none can be held, a warning says so."""
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError as failure:
        _log.warning(
            "%s: no lock can be held here (%s); do not write it twice at a time", stream.name, failure
        )
    return True


STAGES = "stages"
"""Folder within a cache of what runs keep, and of their leases."""

_FOLDER = "in_use"
_ENDING = ".lease"
_TRIES = 9
_held: Counter[Path] = Counter()


@contextmanager
def lease(cache: Path) -> Iterator[None]:
    """Tell others, within, that a cache is in use, if anything can be written there."""
    path = cache / STAGES / _FOLDER / f"{os.getpid()}-{secrets.token_hex(4)}{_ENDING}"
    stream = _opened(path)
    if stream is None:
        yield
        return
    here = cache.resolve()
    _held[here] += 1
    try:
        take_lock(stream)
        yield
    finally:
        _held[here] -= 1
        stream.close()
        with suppress(OSError):
            path.unlink(missing_ok=True)
            for folder in (path.parent, path.parent.parent, cache):  # as many as are empty
                folder.rmdir()


def _opened(path: Path) -> IO[str] | None:
    """A new file, open; None where none can be made. Whoever leaves may remove its folder meanwhile."""
    for _ in range(_TRIES):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            return path.open("x", encoding="utf-8")
        except FileNotFoundError:
            continue
        except OSError:
            return None
    return None


def hold_lease(cache: Path) -> None:
    """Tell others, until this process ends, that a cache is in use, unless it tells them already."""
    if _held[cache.resolve()]:
        return
    held = ExitStack()
    held.enter_context(lease(cache))
    atexit.register(held.close)


def unused_before(cache: Path) -> float:
    """What was last used before this time, s since 1970, is used by no run in progress.

    Leases of processes that have died are removed.
    """
    earliest = time.time()
    for path in sorted((cache / STAGES / _FOLDER).glob(f"*{_ENDING}")):
        try:
            began_s = path.stat().st_mtime
        except OSError:  # given up meanwhile
            continue
        if _is_left(path):
            with suppress(OSError):
                path.unlink(missing_ok=True)
        else:
            earliest = min(earliest, began_s)
    return earliest


def _is_left(path: Path) -> bool:
    """Whether the process that held a lease has ended; a lease that cannot be looked at counts as held."""
    try:
        with path.open(encoding="utf-8") as stream:
            return take_lock(stream)
    except FileNotFoundError:
        return True
    except OSError:
        return False
