"""Executors of work that can be divided: this process, or the tasks of a fleet."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

_Result = TypeVar("_Result")


class Executor(Protocol):
    """Runs work elsewhere, with the same results, log lines and errors as in this process."""

    @property
    def workers(self) -> int:
        """The number of pieces of work that run at a time."""

    def begin(self, work: Callable[[], _Result]) -> Callable[[], _Result]:
        """Begin ``work``, which can be pickled; the returned function waits for its result.

        Waiting logs the lines of ``work`` and raises its errors.
        """


class InProcess:
    """This process: work is done when its result is waited for."""

    workers = 1

    def begin(self, work: Callable[[], _Result]) -> Callable[[], _Result]:
        """Return ``work`` itself."""
        return work


IN_PROCESS = InProcess()  # the executor where no other is given
