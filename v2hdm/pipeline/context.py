"""The surroundings of a run: cache, progress, executor, times, the log."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from v2hdm.executor import HERE, Executor
from v2hdm.progress import Progress, Steps, silent
from v2hdm.records import Drive
from v2hdm.store.cache import StageCache

if TYPE_CHECKING:  # loads torch, which a finished run does without
    from v2hdm.detection.batch import Detect

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Context:
    """Surroundings of a run."""

    cache: StageCache = field(default_factory=lambda: StageCache(None))  # keeps nothing by itself
    progress: Progress = silent
    detect: Detect | None = None  # in place of processes of this machine
    # refuses a drive that does not suit what is to be written
    accept: Callable[[Drive], None] = lambda drive: None
    executor: Executor = HERE  # of the stages that are shared out
    workers: int = 0  # threads of this process, 0 for one per core
    seconds: dict[str, float] = field(default_factory=dict)  # how long each step took

    @property
    def threads(self) -> int:
        """The number of threads of this process to work in."""
        return self.workers or os.cpu_count() or 1

    def steps(self, task: str) -> Steps:
        """The progress of one task: called with how many steps are done, and of how many."""
        return partial(self.progress, task)

    @contextmanager
    def timed(self, step: str) -> Iterator[None]:
        """Note how long the block takes, s, as a ``step``, and log it."""
        start = time.perf_counter()
        yield
        self.seconds[step] = round(time.perf_counter() - start, 2)
        _log.info("%s: %.1f s", step, self.seconds[step])


@contextmanager
def logging_to(handler: logging.Handler) -> Iterator[None]:
    """Send this library's log to ``handler`` as well, for as long as the block runs."""
    logger = logging.getLogger("v2hdm")
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        handler.close()


class _LogFile(logging.FileHandler):
    """A log that is part of a result: where it cannot be written, the result cannot."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        """Raise what went wrong; logging itself would print a traceback and go on."""
        raise


def log_file(path: Path) -> logging.Handler:
    """A log in a file of the result."""
    handler = _LogFile(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    return handler
