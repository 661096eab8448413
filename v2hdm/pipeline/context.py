"""The surroundings of a run: cache, progress, viewer, workers, times, the log."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from v2hdm.progress import Progress, Steps, silent
from v2hdm.records import Drive, ImageDetections
from v2hdm.store.cache import StageCache

if TYPE_CHECKING:  # loads torch, which a finished run does without
    from v2hdm.detection.batch import Detect
    from v2hdm.mapping.results import MethodResult

_log = logging.getLogger(__name__)


class Viewer(Protocol):
    """Shows a run while it goes on."""

    def begun(self, folder: Path, drive: Drive) -> None:
        """Detection in a drive's images has begun; ``folder`` takes what a viewer keeps of the run."""

    def detected(self, detections: Sequence[ImageDetections]) -> None:
        """Detections in some more of its images, in any order."""

    def mapped(self, cameras: str, methods: Mapping[str, MethodResult]) -> None:
        """The results by method of a set of cameras, ``front`` or ``both``; all cameras come last."""

    def close(self) -> None:
        """All has been mapped, or nothing more will be: whatever is kept in the folder must be whole now."""


class Unwatched:
    """A :class:`Viewer` that shows nothing."""

    def begun(self, *_: object) -> None:
        """Nothing."""

    detected = mapped = close = begun


@dataclass(frozen=True)
class Context:
    """Surroundings of a run.

    By itself the ``cache`` keeps nothing, and detection (``detect``) is by processes of this machine, one per
    core where ``workers`` is 0. ``accept`` refuses a drive that was read and does not suit what is to be
    written. ``folder`` takes what the viewer keeps, ``seconds`` how long each step took.
    """

    cache: StageCache = field(default_factory=lambda: StageCache(None))
    progress: Progress = silent
    viewer: Viewer = field(default_factory=Unwatched)
    detect: Detect | None = None
    accept: Callable[[Drive], None] = lambda drive: None
    workers: int = 0
    folder: Path = Path()
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def processes(self) -> int:
        """The number of processes to work in."""
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
