"""Orders for a kind of fault, and rows for the ends of its cases."""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.faults.doors import Doors
from tests.faults.judge import Outcome


@dataclass(frozen=True)
class Row:
    """The end of a case: ``right``, ``told`` or ``DEFECT``."""

    name: str
    end: str
    said: str


@dataclass(frozen=True)
class Order:
    """An order: how many cases of each door or file, which of these, where, and by what chance."""

    doors: Doors
    scratch: Path
    each: int
    only: str
    rng: np.random.Generator


Kind = Callable[[Order], Iterator[Row]]


def in_fork(work: Callable[[], Any]) -> Any:
    """The result of work in a fork of this process; None where that died."""
    ours, theirs = multiprocessing.Pipe(duplex=False)
    process = os.fork()
    if not process:
        try:
            theirs.send(work())
        finally:
            os._exit(0)
    theirs.close()
    try:
        answer = ours.recv()
    except EOFError:
        answer = None
    os.waitpid(process, 0)
    return answer


@contextmanager
def folder_in(scratch: Path) -> Iterator[Path]:
    """A folder for one case."""
    with tempfile.TemporaryDirectory(dir=scratch) as name:
        yield Path(name).resolve()


def row_of(name: str, outcome: Outcome, defects: Sequence[str]) -> Row:
    """The row of a case by its outcome and defects."""
    said = " | ".join(outcome.error.strip().splitlines()[-3:])[-300:]
    if defects:
        return Row(name, "DEFECT", f"{'; '.join(defects)} -- {said}")
    return Row(name, "told" if outcome.code == 2 else "right", said)
