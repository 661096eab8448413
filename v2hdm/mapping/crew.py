"""Who does what can be parted of a run: this process, or the workers that a fleet hands in."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

_Result = TypeVar("_Result")


class Crew(Protocol):
    """Workers; what they do comes out as if this process had done it."""

    @property
    def workers(self) -> int:
        """How many can work at a time."""

    def begin(self, work: Callable[[], _Result]) -> Callable[[], _Result]:
        """Begin ``work``, which can be pickled; what is returned waits for what comes of it.

        What it logs is logged then, and what it raises is raised.
        """


class Alone:
    """This process."""

    workers = 1

    def begin(self, work: Callable[[], _Result]) -> Callable[[], _Result]:
        """Leave ``work`` until it is waited for."""
        return work


ALONE = Alone()
"""For whoever is handed no other crew."""
