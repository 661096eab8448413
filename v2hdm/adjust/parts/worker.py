"""A part at work: what it is asked, it answers from its part, a base and a loss alone.

What it has computed for the last base is kept, but can be made anew: a worker that died in the middle is
replaced by one that answers the same.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from v2hdm.adjust.parts.condense import Base, Condensed, HandedOn, Laid
from v2hdm.adjust.parts.split import Part
from v2hdm.adjust.residuals import Loss

QUANTILES = 256
"""Into so many a part cuts its residuals, for the median of all parts to be found between two."""


class Step(NamedTuple):
    """Shared unknowns (s,) of a part and its own whitened ones (o,); ``number`` is that of the base there."""

    number: int
    shared: Tensor
    own: Tensor


class Worker:
    """One part of a problem."""

    def __init__(self, part: Part) -> None:
        self._laid = Laid.of(part)
        self._condensed: tuple[int, Loss, Condensed] | None = None
        self._reached: Base | None = None

    @property
    def corners(self) -> tuple[Tensor, Tensor]:
        """Its own corners and the shared ones that it saw, by their places in the part, in its order."""
        return self._laid.own_corners, self._laid.common_corners

    def hand_on(self, base: Base, robust: Loss) -> HandedOn:
        """What the part says of the shared unknowns at a base."""
        return self._at(base, robust).handed_on

    def evaluate(self, base: Base, robust: Loss, step: Step) -> HandedOn:
        """Cost and gradient a step away from a base."""
        self._reached, handed_on = self._at(base, robust).evaluate(*step)
        return handed_on

    def move(self, base: Base, robust: Loss, step: Step) -> Base:
        """The base that a step leads to."""
        if self._reached is None or self._reached.number != step.number:
            self.evaluate(base, robust, step)
        assert self._reached is not None
        return self._reached

    def quantiles(self, base: Base) -> tuple[int, Tensor]:
        """How many residuals there are, and their squares' quantiles, the least and the greatest included."""
        squared = self._laid.squared(base).sort().values
        places = torch.linspace(0, len(squared) - 1, QUANTILES + 1, dtype=torch.float64).round().long()
        return len(squared), squared[places]

    def between(self, base: Base, low: float, high: float) -> tuple[int, Tensor]:
        """How many squared residuals are below ``low``, and those from there to ``high``."""
        squared = self._laid.squared(base)
        return int((squared < low).sum()), squared[(squared >= low) & (squared <= high)]

    def _at(self, base: Base, robust: Loss) -> Condensed:
        if self._condensed is None or self._condensed[:2] != (base.number, robust):
            self._condensed = None  # before the next one takes its memory
            self._condensed = base.number, robust, Condensed(self._laid, base, robust)
        return self._condensed[2]
