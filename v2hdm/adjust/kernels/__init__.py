"""The engine ``numba``: kernels, compiled on first use, for all work per observation.

States, clocks, drifts and extrinsics act through the table of pairs, so that kernels are independent of the
model. Nothing outside of this folder imports numba; others import from here where they use it, if at all.
"""

from __future__ import annotations

import sys
from functools import cache
from importlib.util import find_spec
from pathlib import Path


@cache
def are_compiled() -> bool:
    """Whether numba is there to compile kernels; without it they run as Python, which suits small ones."""
    return find_spec("numba") is not None


def kept_in() -> Path | None:
    """Where compiled kernels are kept, if anywhere."""
    from v2hdm.compiled import folder_of  # loads numba

    return folder_of(sys.modules[__name__])
