"""Kernels of detector and adjustment, compiled from C++ when the package was installed or its wheel built.

Each is the twin of Python code that does the same where nothing could be compiled, by numpy in the detector
and by numba in the adjustment, and that tests compare it with. ``V2HDM_NATIVE=0`` in the environment leaves
them out.
"""

from __future__ import annotations

import importlib
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from v2hdm.native.sources import digest

_log = logging.getLogger(__name__)

SWITCH = "V2HDM_NATIVE"  # environment variable: 0 for numpy and numba
_REMEDY = (
    "detection runs in numpy, at half the speed, and mapping first compiles for some 20 s; "
    "with a C++ compiler, install v2hdm again"
)


class _Kernels:
    """The kernels, if there are any, and else the reason."""

    def __init__(self) -> None:
        self.module: Any = None
        self.problem = ""
        self.is_wanted = os.environ.get(SWITCH, "1") != "0"
        if not self.is_wanted:
            self.problem = f"{SWITCH} is 0"
            return
        try:
            module = importlib.import_module("v2hdm.native._kernels")
        except ImportError as error:
            is_there = any(Path(__file__).parent.glob("_kernels.*"))
            self.problem = (
                f"the compiled kernels do not load ({error})" if is_there else "nothing is compiled"
            )
            return
        sources = digest(Path(__file__).parent / "src")
        if sources and sources != module.SOURCES:
            self.problem = "the compiled kernels are older than their sources"
            return
        self.module = module


@cache
def _loaded() -> _Kernels:
    return _Kernels()


def kernels() -> Any:
    """The module of compiled kernels, or None where numpy does the work."""
    return _loaded().module


def which_runs() -> str:
    """Which of the two runs, in a few words."""
    loaded = _loaded()
    return "kernels compiled" if loaded.module else f"kernels in numpy and numba ({loaded.problem})"


@contextmanager
def numpy_alone() -> Iterator[None]:
    """Let numpy do the work of the kernels for a while."""
    loaded = _loaded()
    module = loaded.module
    loaded.module = None
    try:
        yield
    finally:
        loaded.module = module


@cache
def tell_missing() -> None:
    """Say once, in a line, that numpy does the work of the kernels, unless that was asked for."""
    loaded = _loaded()
    if loaded.module is None and loaded.is_wanted:
        _log.warning("%s: %s", loaded.problem, _REMEDY)
