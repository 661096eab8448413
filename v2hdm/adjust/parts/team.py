"""Who works on the parts: this process, one part after the other; or whoever keeps to :class:`Team`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from torch import Tensor

from v2hdm.adjust.parts.condense import Base
from v2hdm.adjust.parts.split import Part
from v2hdm.adjust.parts.worker import Worker


class Team(Protocol):
    """Workers, one for each part. A base stays with its worker; here it is known by what ``keep`` returns."""

    def start(self, parts: Sequence[Part]) -> list[tuple[Tensor, Tensor]]:
        """Take the parts; returns the :attr:`Worker.corners` of each."""

    def keep(self, bases: Sequence[Base]) -> list[Any]:
        """Take a base of each part."""

    def ask(self, question: str, bases: Sequence[Any], *arguments: Sequence[Any]) -> list[Any]:
        """Ask each part's :class:`Worker` by the name of a method; each argument is one for each part."""

    def move(self, bases: Sequence[Any], *arguments: Sequence[Any]) -> list[Any]:
        """As ``ask`` of ``move``, but the bases that come of it stay with their workers."""

    def fetch(self, bases: Sequence[Any]) -> list[Base]:
        """The bases themselves."""


class Local:
    """This process."""

    def start(self, parts: Sequence[Part]) -> list[tuple[Tensor, Tensor]]:
        """Take the parts."""
        self._workers = [Worker(part) for part in parts]
        return [worker.corners for worker in self._workers]

    def keep(self, bases: Sequence[Base]) -> list[Any]:
        """The bases as they are."""
        return list(bases)

    def ask(self, question: str, bases: Sequence[Any], *arguments: Sequence[Any]) -> list[Any]:
        """Ask one after the other."""
        asked = zip(self._workers, bases, *arguments, strict=True)
        return [getattr(worker, question)(*rest) for worker, *rest in asked]

    def move(self, bases: Sequence[Any], *arguments: Sequence[Any]) -> list[Any]:
        """The bases moved."""
        return self.ask("move", bases, *arguments)

    def fetch(self, bases: Sequence[Any]) -> list[Base]:
        """The bases as they are."""
        return list(bases)
