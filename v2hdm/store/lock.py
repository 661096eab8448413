"""Locks of the operating system on files, which the end of a process releases, whatever ends it.

A process that uses a cache holds a file of its own locked there, and touches all that it uses: nothing that
was last used before the oldest of these locks was taken is used by a run in progress.
"""

from __future__ import annotations

import atexit
import logging
import platform
import secrets
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO

_log = logging.getLogger(__name__)

STAGES = "stages"  # folder within a cache of what runs keep, and of the locks of those in progress
IN_USE = f"{STAGES}/in_use"
HOST = platform.node() or "this host"
_ENDING = ".lock"
_TRIES = 9
_used: Counter[Path] = Counter()


def take_lock(stream: IO[str]) -> bool:
    """Lock an open file without waiting and report whether it was free; a warning where none can be held."""
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
        _log.warning("%s: no lock can be held here (%s); do not write it twice at once", stream.name, failure)
    return True


@contextmanager
def in_use(cache: Path) -> Iterator[None]:
    """Protect from pruning what is used in a cache within this block, if anything can be written there."""
    path, here, stream = cache / IN_USE / f"{secrets.token_hex(8)}{_ENDING}", cache.resolve(), None
    for _ in range(_TRIES):  # whoever leaves may remove the folder meanwhile
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            stream = path.open("x", encoding="utf-8")
            break
        except FileNotFoundError:
            continue
        except OSError:
            break
    if stream is None:
        yield
        return
    _used[here] += 1
    try:
        take_lock(stream)
        yield
    finally:
        _used[here] -= 1
        stream.close()
        with suppress(OSError):
            path.unlink(missing_ok=True)
            for folder in (path.parent, path.parent.parent, cache):  # as many as are empty
                folder.rmdir()


def use_until_exit(cache: Path) -> None:
    """Protect what is used in a cache until this process ends, unless it does so already."""
    if not _used[cache.resolve()]:
        held = ExitStack()
        held.enter_context(in_use(cache))
        atexit.register(held.close)


def unused_before(cache: Path) -> float:
    """The time, s since 1970, before which nothing was last used that a run in progress uses."""
    earliest = time.time()
    for path in (cache / IN_USE).glob(f"*{_ENDING}"):
        with suppress(OSError):  # given up meanwhile
            began_s, is_left = path.stat().st_mtime, False
            with suppress(OSError), path.open(encoding="utf-8") as stream:  # unreadable counts as held
                is_left = take_lock(stream)
            if is_left:
                path.unlink(missing_ok=True)
            else:
                earliest = min(earliest, began_s)
    return earliest
