"""How far long work is: bars on a terminal; in a log, or under a service, a line now and then."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

_EVERY_S = 10.0
"""Between two lines on one task."""

TellShare = Callable[[float, str], None]
"""Is told what share of the work is done, and what is being done."""


class TellSteps(Protocol):
    """Is told how many steps of a task are done, and of how many."""

    def __call__(self, task: str, done: int, total: int) -> None:
        """``done`` of ``total`` steps of ``task`` are finished."""


def progress_lines(write: Callable[[str], None]) -> TellSteps:
    """For a log: a line when a task begins and when it ends, and every ten seconds between."""
    told_s: dict[str, float] = {}

    def advance(task: str, done: int, total: int) -> None:
        now_s = time.monotonic()
        if task not in told_s or done == total or now_s - told_s[task] >= _EVERY_S:
            told_s[task] = now_s
            write(f"{task}: {done} of {total}")

    return advance


@contextmanager
def share_of_work(console: Console, first: str, transient: bool = False) -> Iterator[TellShare]:
    """One bar over all that is done, which begins with ``first``; it goes away in the end if ``transient``.

    In a log there is a line every ten seconds, and one in the end.
    """
    if not console.is_terminal:
        yield _share_lines(lambda line: console.print(line, highlight=False, markup=False, soft_wrap=True))
        return
    columns = (
        BarColumn(),
        TextColumn("{task.percentage:.0f} %"),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns, console=console, transient=transient) as bar:
        task = bar.add_task(first, total=1.0)
        yield lambda share, doing: bar.update(task, completed=share, description=doing)


def _share_lines(write: Callable[[str], None]) -> TellShare:
    told_s = -_EVERY_S

    def tell(share: float, doing: str) -> None:
        nonlocal told_s
        now_s = time.monotonic()
        if now_s - told_s >= _EVERY_S or share >= 1.0:
            told_s = now_s
            write(f"{share:4.0%}  {doing}")

    return tell
