"""Compiles kernels when they are first called, and keeps the result beside them for the next process."""

from __future__ import annotations

import hashlib
import os
import pickle
import tempfile
from collections.abc import Callable
from functools import cache, wraps
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

PLACES = (
    Path(__file__).parent / "__pycache__",
    Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "v2hdm",
)
"""Where compiled kernels may be kept: with the package's bytecode, or else with the user's caches."""

_Function = TypeVar("_Function", bound=Callable[..., Any])

# Kernels allocate nothing, and so need not count references to arrays: done at each use of one, that took
# four times as long as all else. Of the liberties with rounding all that keep NaN and infinity what they are,
# which the line search relies on.
_OPTIONS: dict[str, Any] = {
    "_nrt": False,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"nsz", "arcp", "contract", "afn", "reassoc"},
}

# What reading or writing a kernel that is kept fails with; a kernel itself fails with nothing.
_UNREADABLE = (OSError, EOFError, AttributeError, ImportError, pickle.UnpicklingError, ValueError)


def inlined(function: _Function) -> _Function:
    """A part of kernels."""
    part: _Function = numba.njit(forceinline=True, **_OPTIONS)(function)
    return part


def kernel(function: _Function) -> _Function:
    """A kernel: compiled at its first call, or read from where an earlier process has left it.

    Where nothing can be kept, or what was kept cannot be read, every process compiles anew.
    """
    folder, settings = _folder(), cast(Any, numba.config)
    usual, settings.CACHE_DIR = settings.CACHE_DIR, str(folder or "")
    try:
        compiled: Callable[..., Any] = numba.njit(cache=folder is not None, **_OPTIONS)(function)
    except (OSError, RuntimeError):  # numba has no use for the folder
        compiled = numba.njit(**_OPTIONS)(function)
    finally:
        settings.CACHE_DIR = usual

    @wraps(function)
    def call(*arguments: Any) -> Any:
        nonlocal compiled
        try:
            return compiled(*arguments)
        except _UNREADABLE:
            compiled = numba.njit(**_OPTIONS)(function)
            return compiled(*arguments)

    return call  # type: ignore[return-value]


@cache
def _folder() -> Path | None:
    """The first of :data:`PLACES` that can be written to, or None.

    The folder is named by the sources: numba itself sees neither a change in a part of a kernel nor one that
    leaves a file's size and time as they were, as another wheel's may be.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    for place in PLACES:
        folder = place / f"kernels-{digest.hexdigest()[:12]}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    return None
