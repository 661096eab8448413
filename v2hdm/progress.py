"""How far long work is: bars on a terminal; in a log, or under a service, a line now and then."""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:  # of the map extra; progress itself is reported without it
    from rich.console import Console

_EVERY_S = 10.0  # between two lines on one task

Steps = Callable[[int, int], None]  # called with how many steps of one task are done, and of how many


# Called with the name of a piece of long work, how many of its steps are done, and of how many.
Progress = Callable[[str, int, int], None]


def silent(task: str, finished: int, total: int) -> None:
    """A ``Progress`` that shows nothing."""


def progress_lines(write: Callable[[str], None]) -> Progress:
    """A ``Progress`` for a log: a line when a task begins and ends, and every ten seconds between."""
    written_s: dict[str, float] = {}

    def advance(task: str, finished: int, total: int) -> None:
        now_s = time.monotonic()
        if task not in written_s or finished == total or now_s - written_s[task] >= _EVERY_S:
            written_s[task] = now_s
            write(f"{task}: {finished} of {total}")

    return advance


failures_of_stdout: list[OSError] = []
"""The last failure that :func:`patient` has kept back, for the end of the command."""


class _Patient(io.StringIO):
    def __init__(self, stream: IO[str]) -> None:
        super().__init__()
        self._stream = stream
        self.isatty = stream.isatty  # type: ignore[method-assign]

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return getattr(self._stream, "encoding", None) or "utf-8"

    def write(self, text: str) -> int:
        try:
            self._stream.write(text)
            self._stream.flush()
        except OSError as failure:
            failures_of_stdout[:] = [failure] if self._stream is sys.stdout else failures_of_stdout
        return len(text)


def patient(stream: IO[str]) -> IO[str]:
    """A stream that keeps failures back, so that a full disk or a closed pipe behind it stops no work."""
    return _Patient(stream)


@contextmanager
def progress_bars(console: Console) -> Iterator[Progress]:
    """A bar per task, made the first time that a task reports; lines where there is no terminal."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    if not console.is_terminal:
        yield progress_lines(console.print)
        return
    title = TextColumn("{task.description:<28}")
    with Bars(title, BarColumn(40), MofNCompleteColumn(), TimeRemainingColumn(), console=console) as bars:
        tasks = {}

        def advance(task: str, finished: int, total: int) -> None:
            if task not in tasks:
                tasks[task] = bars.add_task(task, total=total)
            bars.update(tasks[task], completed=finished, total=total)

        yield advance
