"""Colours and words of the figures: methods look as in the report of a run (:mod:`v2hdm.report.style`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from v2hdm.report import style

PAINT = "#dfe4e8"
"""Filling of true markings."""

LINK = "#e3001b"
"""Colour of lines between corners that belong together."""


def colour(row: str) -> str:
    """Colour of a row of the tables: that of its method, under whichever recipe."""
    return style.METHOD.get(method_of(row), "k")


def method_of(row: str) -> str:
    """The method of a row of the tables, such as ``Opt, paper``."""
    return row.split(",")[0]


def drive_of(record: Mapping[str, Any]) -> str:
    """The drive of a record in words."""
    return str(record["port"]) if record["seed"] is None else f"{record['port']}, seed {record['seed']}"
