"""Doors in forks of this process, which has loaded everything and has done nothing with it.

A process that has worked has threads and locks, of which a fork keeps the locks alone.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import cv2

from tests.benchmarks.faults.failing_calls import Failure, watch
from tests.faults.judge import LONGEST_WAIT_S, Case, Ran, run_here

# A fork has none of the threads of OpenCV's pool, and would wait for them when it sets their number.
cv2.setNumThreads(1)

_LOADED = ("v2hdm", "train", "matplotlib", "rich", "hydra", "torch", "scipy", "cv2")
"""Packages that are loaded here once a door has loaded them."""


class Forked:
    """Runs a door in a fork of this process, whose calls that write below a folder may fail."""

    def __init__(self, below: Path, failure: Failure | None = None) -> None:
        self.below, self.failure = below, failure
        self.calls: list[str] = []

    def __call__(self, case: Case) -> Ran:
        """As :func:`tests.faults.judge.run_here`."""
        handle, name = tempfile.mkstemp()
        os.close(handle)

        def work() -> int:
            Path(name).write_text(json.dumps([*run_here(case), sorted(sys.modules)]))
            return 0

        watched = watch(work, self.below, self.failure, LONGEST_WAIT_S + 10)
        self.calls = watched.calls
        text = Path(name).read_text()
        Path(name).unlink()
        if not text:
            return f"killed ({watched.code})", "", ""
        code, error, output, modules = json.loads(text)
        _load(modules)
        return code, error, output


_seen: set[str] = set(sys.modules)


def _load(modules: Sequence[str]) -> None:
    """Load here what a door has loaded, so that later ones need not."""
    for name in modules:
        if name not in _seen and name.split(".")[0] in _LOADED:
            with suppress(Exception):
                importlib.import_module(name)
        _seen.add(name)
