"""One bar over all of a training's work; in a log, or under a service, a line now and then."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars

_EVERY_S = 10.0
"""Between two lines."""

Share = Callable[[float, str], None]
"""Called with the share of the work that is done, and with what is being done."""


@contextmanager
def share_of_work(console: Console, first: str, transient: bool = False) -> Iterator[Share]:
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
    with Bars(*columns, console=console, transient=transient) as bar:
        task = bar.add_task(first, total=1.0)
        yield lambda share, doing: bar.update(task, completed=share, description=doing)


def _share_lines(write: Callable[[str], None]) -> Share:
    written_s = -_EVERY_S

    def show(share: float, doing: str) -> None:
        nonlocal written_s
        now_s = time.monotonic()
        if now_s - written_s >= _EVERY_S or share >= 1.0:
            written_s = now_s
            write(f"{share:4.0%}  {doing}")

    return show
