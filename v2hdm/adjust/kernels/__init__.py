"""The engine ``native``: kernels for all work per observation, compiled from C++ or by numba.

States, clocks, drifts and extrinsics act through the table of pairs, so that kernels are independent of the
model. Each kernel is written twice: here, for numba, which compiles it on first use, and in ``native/src``,
from which an installation compiles it if it can.
"""

from __future__ import annotations

import sys
from pathlib import Path

from v2hdm import native
from v2hdm.compiled import folder_of, is_numba_there

NAMES = ("native", "numba")
"""The names of this engine: the second is an earlier one, still accepted."""


def are_compiled() -> bool:
    """Whether kernels are compiled, or numba is there to do it; as Python they suit small problems."""
    return native.kernels() is not None or is_numba_there()


def kept_in() -> Path | None:
    """Where numba's kernels are kept, if it compiles any and they can be kept."""
    is_numba_needed = native.kernels() is None and is_numba_there()
    return folder_of(sys.modules[__name__]) if is_numba_needed else None
