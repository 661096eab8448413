"""Freed memory that a process keeps for its next arrays."""

from __future__ import annotations

import ctypes
import sys

_KEPT_BYTES = 2**28
"""Freed memory that a process keeps: some solver's largest array of a kilometre; chosen. Measured on 75,000
observations: 2**29 and 2**30 save no more."""

# Sizes, bytes, from which an array has pages of its own; glibc before 2.35 refuses the first.
_POOLED_BYTES = (2**28, 2**25)

# Parameters of glibc's mallopt (malloc.h).
_TRIM_THRESHOLD = -1
_MMAP_THRESHOLD = -3


def keep_freed_memory() -> None:
    """Have this process keep what it frees; elsewhere than on glibc nothing happens.

    By itself glibc hands large arrays back, and the system clears the pages of the next one: an eighth of the
    time of a solve.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
        any(mallopt(_MMAP_THRESHOLD, size) for size in _POOLED_BYTES)
