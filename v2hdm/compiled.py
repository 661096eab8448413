"""Compiles kernels when they are first called, and keeps the result beside them for the next process.

Without numba a kernel runs as the Python function that it is.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import sys
import tempfile
from collections.abc import Callable
from functools import cache, wraps
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar, cast

try:
    import numba
except ModuleNotFoundError:
    numba = None  # type: ignore[assignment]

PLACES = (
    Path(__file__).parent / "__pycache__",
    Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "v2hdm",
)
"""Where compiled kernels may be kept: with the package's bytecode, or else with the user's caches."""

_Function = TypeVar("_Function", bound=Callable[..., Any])

# Kernels allocate nothing, and so need not count references to arrays: done at each use of one, that took
# four times as long as all else. Of the liberties with rounding all that keep NaN and infinity what they are,
# which the line search relies on.
_EXACT: dict[str, Any] = {"_nrt": False, "nogil": True, "error_model": "numpy"}
_OPTIONS = _EXACT | {"fastmath": {"nsz", "arcp", "contract", "afn", "reassoc"}}

# What reading or writing a kernel that is kept fails with; a kernel itself fails with nothing.
_UNREADABLE = (OSError, EOFError, AttributeError, ImportError, pickle.UnpicklingError, ValueError)


def inlined(function: _Function) -> _Function:
    """A part of kernels."""
    return _inlined(function, _OPTIONS)


def exactly_inlined(function: _Function) -> _Function:
    """A part of exact kernels."""
    return _inlined(function, _EXACT)


def _inlined(function: _Function, options: dict[str, Any]) -> _Function:
    if numba is None:
        return function
    part: _Function = numba.njit(forceinline=True, **options)(function)
    return part


def kernel(function: _Function) -> _Function:
    """A kernel: compiled at its first call, or read from where an earlier process has left it, if it has."""
    return _kept(function, _OPTIONS)


def exact_kernel(function: _Function) -> _Function:
    """A kernel that rounds each operation as numpy does."""
    return _kept(function, _EXACT)


def _kept(function: _Function, options: dict[str, Any]) -> _Function:
    if numba is None:
        return function
    folder = folder_of(sys.modules[function.__module__])
    settings = cast(Any, numba.config)
    usual = settings.CACHE_DIR
    settings.CACHE_DIR = str(folder or "")
    try:
        compiled: Callable[..., Any] = numba.njit(cache=folder is not None, **options)(function)
    except (OSError, RuntimeError):  # numba has no use for the folder
        compiled = numba.njit(**options)(function)
    finally:
        settings.CACHE_DIR = usual

    @wraps(function)
    def call(*arguments: Any) -> Any:
        nonlocal compiled
        try:
            return compiled(*arguments)
        except _UNREADABLE:
            compiled = numba.njit(**options)(function)
            return compiled(*arguments)

    cast(Any, call).is_kernel = True
    return call  # type: ignore[return-value]


def folder_of(module: ModuleType) -> Path | None:
    """Where the kernels of a module are kept, None where they cannot be."""
    return _folder(Path(str(module.__file__)).parent)


@cache
def _folder(sources: Path) -> Path | None:
    """The first of :data:`PLACES` that can be written to, or None; by a digest of a kernel's ``sources``."""
    digest = hashlib.sha256(numba.__version__.encode())
    for source in (Path(__file__), *sorted(sources.glob("*.py"))):
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
