"""Locks of the operating system on files, which are released by the end of a process, whatever ends it."""

from __future__ import annotations

import logging
import sys
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
