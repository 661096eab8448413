"""Compiled kernels for what is done to every observation, where numba is there and a problem is on the CPU.

Torch does the same elsewhere, and is what these are tested against. All that is particular to a model, such
as states, clocks, drifts and extrinsics, acts through the table of pairs, so that kernels know none of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from v2hdm.adjust.arrays import Arrays
    from v2hdm.adjust.engines.numba.passes import Passes

_wanted = True


@cache
def _installed() -> bool:
    try:
        import numba  # noqa: F401
    except ImportError:
        return False
    return True


def available() -> bool:
    """Whether kernels can be compiled here: the extra ``fast`` is installed."""
    return _wanted and _installed()


@contextmanager
def reference() -> Iterator[None]:
    """Within, torch does everything: what the kernels are compared with."""
    global _wanted
    before, _wanted = _wanted, False
    try:
        yield
    finally:
        _wanted = before


def passes_over(arrays: Arrays) -> Passes | None:
    """The kernels over a problem, or None where torch has to do their work."""
    if not available() or arrays.measured.device.type != "cpu":
        return None
    from v2hdm.adjust.engines.numba.passes import Passes

    return Passes(arrays)
