"""Tables and figures of merit as texts with their units: what the templates set."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Table:
    """Rows of texts under their headings; ``numeric`` columns are set to the right.

    ``caption`` says what the table shows.
    """

    caption: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: tuple[bool, ...]


@dataclass(frozen=True)
class Figure:
    """One number that a reader asks for: what, how much with its unit, and what it means."""

    name: str
    value: str
    unit: str
    note: str


def table(caption: str, headings: Sequence[str], rows: Iterable[Sequence[str]], words: int = 1) -> Table:
    """A table whose first ``words`` columns are words and whose others are numbers."""
    return Table(
        caption, tuple(headings), tuple(tuple(row) for row in rows),
        tuple(n >= words for n in range(len(headings))),
    )  # fmt: skip


def number(value: object, digits: int, factor: float = 1.0) -> str:
    """A number as text, a dash where there is none."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        return "–"
    return f"{factor * value:.{digits}f}".replace("-", "−")


def name_of(kind: str) -> str:
    """A class as people write it."""
    return kind.replace("_", " ")


def in_words(count: int, what: str) -> str:
    """``1 marking``, ``2 markings``."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def significant(value: object) -> str:
    """A number with three digits that count."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    return number(value, min(digits, 6))


def pair_table(caption: str, content: Mapping[str, Any]) -> Table | None:
    """Names and values as they stand in ``metrics.json``."""
    rows = [[name_of(str(key)), _plain(value)] for key, value in content.items()]
    return Table(caption, ("", ""), tuple(tuple(row) for row in rows), (False, False)) if rows else None


def _plain(value: object) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_plain(one) for one in value)
    return significant(value) if isinstance(value, float) else str(value)
