"""Kernels in three forms: compiled from C++ at the install, by numba at the first call, or as they stand.

What numba compiles is kept beside the kernels for the next process. Numba is loaded when it first compiles,
since that alone takes half a second.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import os
import pickle
import sys
import tempfile
from collections.abc import Callable
from functools import cache, wraps
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, TypeVar, cast

from v2hdm import native

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
    cast(Any, function).options = _OPTIONS
    return function


def exactly_inlined(function: _Function) -> _Function:
    """A part of exact kernels."""
    cast(Any, function).options = _EXACT
    return function


def kernel(function: _Function) -> _Function:
    """A kernel: compiled at its first call, or read from where an earlier process has left it, if it has."""
    return _kept(function, _OPTIONS)


def exact_kernel(function: _Function) -> _Function:
    """A kernel that rounds each operation as numpy does."""
    return _kept(function, _EXACT)


def twin(name: str) -> Callable[[_Function], _Function]:
    """Have a kernel done by a function of this name in C++, such as "adjust.carry", where that is compiled.

    Goes above the decorator of the kernel, which takes its place elsewhere.
    """
    part, function_name = name.split(".")

    def decorate(function: _Function) -> _Function:
        @wraps(function)
        def call(*arguments: Any) -> Any:
            kernels = native.kernels()
            if kernels is None:
                return function(*arguments)
            return getattr(getattr(kernels, part), function_name)(*arguments)

        return call  # type: ignore[return-value]

    return decorate


@cache
def is_numba_there() -> bool:
    """Whether numba is there to compile kernels."""
    return importlib.util.find_spec("numba") is not None


def _kept(function: _Function, options: dict[str, Any]) -> _Function:
    compiled: Callable[..., Any] | None = None

    @wraps(function)
    def call(*arguments: Any) -> Any:
        nonlocal compiled
        if compiled is None:
            compiled = _compiled(function, options) if is_numba_there() else function
        try:
            return compiled(*arguments)
        except _UNREADABLE:
            if compiled is function:
                raise
            compiled = _by_numba(function, options)
            return compiled(*arguments)

    cast(Any, call).is_kernel = True
    return call  # type: ignore[return-value]


def _compiled(function: _Function, options: dict[str, Any]) -> Callable[..., Any]:
    """A kernel that numba compiles at its first call, or reads from where it is kept."""
    import numba

    _inline_parts(function)
    folder = folder_of(sys.modules[function.__module__])
    settings = cast(Any, numba.config)
    usual = settings.CACHE_DIR
    settings.CACHE_DIR = str(folder or "")
    try:
        return _by_numba(function, options | {"cache": folder is not None})
    except (OSError, RuntimeError):  # numba has no use for the folder
        return _by_numba(function, options)
    finally:
        settings.CACHE_DIR = usual


def _by_numba(function: Callable[..., Any], options: dict[str, Any]) -> Callable[..., Any]:
    import numba

    compiled: Callable[..., Any] = numba.njit(**options)(function)
    return compiled


def _inline_parts(function: Callable[..., Any]) -> None:
    """Put numba's form of all parts that a kernel calls in their place, where numba looks for them."""
    names = vars(sys.modules[function.__module__])
    for name in function.__code__.co_names:
        part = names.get(name)
        options = getattr(part, "options", None)
        if isinstance(part, FunctionType) and options is not None:
            _inline_parts(part)
            names[name] = _inline(part)


@cache
def _inline(part: FunctionType) -> Callable[..., Any]:
    return _by_numba(part, part.options | {"forceinline": True})  # type: ignore[attr-defined]


def folder_of(module: ModuleType) -> Path | None:
    """Where the kernels of a module are kept, None where they cannot be."""
    return _folder(Path(str(module.__file__)).parent)


@cache
def _folder(sources: Path) -> Path | None:
    """The first of :data:`PLACES` that can be written to, or None; by a digest of a kernel's ``sources``."""
    digest = hashlib.sha256(importlib.metadata.version("numba").encode())
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
