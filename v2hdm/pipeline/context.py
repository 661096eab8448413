"""How a run tells what it does: progress, the log, the time that each step took.

What the pipeline tells whoever watches a run.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from v2hdm.records import Drive, ImageDetections

if TYPE_CHECKING:
    from v2hdm.mapping.results import MethodResult


_log = logging.getLogger(__name__)


class Progress(Protocol):
    """Told how far a named piece of long work is."""

    def __call__(self, task: str, done: int, total: int) -> None:
        """``done`` of ``total`` steps of ``task`` are finished."""


def silent(task: str, done: int, total: int) -> None:
    """A :class:`Progress` that shows nothing."""


@contextmanager
def timed(seconds: dict[str, float], step: str) -> Iterator[None]:
    """Note how long the block takes, s, as a ``step``, and log it."""
    start = time.perf_counter()
    yield
    seconds[step] = round(time.perf_counter() - start, 2)
    _log.info("%s: %.1f s", step, seconds[step])


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


class Viewer(Protocol):
    """Shows a run while it goes on."""

    def begun(self, folder: Path, drive: Drive) -> None:
        """Detection in a drive's images has begun; ``folder`` takes what a viewer keeps of the run."""

    def detected(self, detections: Sequence[ImageDetections]) -> None:
        """What was found in some more of its images, in any order."""

    def mapped(self, cameras: str, methods: Mapping[str, MethodResult]) -> None:
        """The results by method of a set of cameras, ``front`` or ``both``; all cameras come last."""

    def close(self) -> None:
        """All has been mapped, or nothing more will be: whatever is kept in the folder must be whole now."""


class Unwatched:
    """A :class:`Viewer` that shows nothing."""

    def begun(self, folder: Path, drive: Drive) -> None:
        """Nothing."""

    def detected(self, detections: Sequence[ImageDetections]) -> None:
        """Nothing."""

    def mapped(self, cameras: str, methods: Mapping[str, MethodResult]) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""
