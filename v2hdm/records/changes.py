"""A map against an earlier one."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from v2hdm.records.arrays import FloatArray


class Fate(Enum):
    """The fate of a marking between an earlier map and a new drive."""

    MOVED = "moved"
    VANISHED = "vanished"
    NEW = "new"
    FIRST_SEEN = "first seen"
    """In the map now and not before, but the earlier drive may have missed it."""
    NOT_SEEN = "not seen"
    """Still in the map: no image shows its place, or too few to miss it."""


@dataclass(frozen=True)
class Change:
    """One marking that differs from the earlier map, with the evidence."""

    id: int
    kind: str
    fate: Fate
    before: FloatArray | None  # (4, 2) corners, if any
    after: FloatArray | None  # (4, 2) corners, if any
    shift_m: FloatArray | None  # (2,) of its centre, beyond the local shift between the maps
    shift_sigma_m: FloatArray | None
    probability: float  # of its fate
    views: int  # images with its place in near view (of a new one, the earlier drive's)
    views_showing: int  # of these, that showed it
    sightings: int  # of the map that has it


@dataclass(frozen=True)
class Changes:
    """An earlier map against a new drive: the ``changes``, how many are the ``same``, its mean shift (2,)."""

    changes: tuple[Change, ...]
    same: int
    shift_m: FloatArray

    def of(self, fate: Fate) -> tuple[Change, ...]:
        """The changes of one fate."""
        return tuple(change for change in self.changes if change.fate is fate)
