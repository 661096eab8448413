"""Freed memory that a process keeps for its next arrays, or gives back."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

_KEPT_BYTES = 2**28
"""Freed memory that a process keeps: some solver's largest array of a kilometre; chosen. Measured on 75,000
observations: 2**29 and 2**30 save no more."""

# Sizes, bytes, from which an array has pages of its own; glibc before 2.35 refuses the first.
_POOLED_BYTES = (2**28, 2**25)

_TRIM_THRESHOLD = -1  # parameter M_TRIM_THRESHOLD of glibc's mallopt (malloc.h)
_MMAP_THRESHOLD = -3  # parameter M_MMAP_THRESHOLD of the same


def keep_freed_memory() -> None:
    """Have this process keep the memory that it frees; without glibc nothing happens.

    By itself glibc hands large arrays back, and the system clears the pages of the next one: an eighth of the
    time of a solve.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
        for size_bytes in _POOLED_BYTES:
            if mallopt(_MMAP_THRESHOLD, size_bytes):
                break


def release_freed_memory() -> None:
    """Give all memory that this process has freed back to the system; without glibc nothing happens.

    Between two long jobs: what one has freed in many places is seldom where the next one needs it.
    """
    if sys.platform != "linux":
        return
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


@dataclass(frozen=True)
class TidyWork:
    """Long ``work``, after which its process gives back what it has freed; picklable if that is."""

    work: Callable[..., Any]

    def __call__(self, *arguments: Any) -> Any:
        """Do the work."""
        result = self.work(*arguments)
        release_freed_memory()
        return result
