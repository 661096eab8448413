"""A comparison of the paint with its design (``v2hdm compare``), as pages of the document."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from v2hdm.errors import MapFileError
from v2hdm.report.page.layers import jpeg_of
from v2hdm.report.page.tables import Table, name_of, number, table
from v2hdm.store import names
from v2hdm.store.files import load_json, take_mapping, take_text

_RIGHT = "right"  # the fate of paint that is as designed
_MOST_ROWS = 150  # that are listed: three pages; the table has all
_UNITS: Mapping[str, tuple[str, float]] = {"m": ("cm", 100.0), "deg": ("°", 1.0), "percent": ("%", 1.0)}
"""How the document shows a quantity by its unit in ``comparison.json``: unit and factor."""


class Comparison(NamedTuple):
    """The fate of each shape of a design."""

    source: str
    whole: str  # how the design lies as a whole; empty for rules
    counts: Table
    deviations: Table | None  # of the shapes that are not right
    more: int  # rows that are not listed
    table: str  # the file that has all
    picture: str | None  # JPEG in base64


def comparison_of(folder: Path | None) -> Comparison | None:
    """The comparison in a folder of ``v2hdm compare``; MapFileError where it is damaged, or none."""
    if folder is None:
        return None
    path = folder / names.AS_BUILT
    if not path.is_file():
        raise MapFileError(
            f"{folder}: has no {names.AS_BUILT}; give the folder that v2hdm compare has written"
        )
    content = load_json(path, MapFileError)
    counts = take_mapping(content.get("counts"), f"{path}: counts", MapFileError)
    listed = content.get("findings")
    if not isinstance(listed, list):
        raise MapFileError(f"{path}: findings: expected a list; compare again")
    findings = [take_mapping(entry, f"{path}: findings", MapFileError) for entry in listed]
    rows = [_row(entry) for entry in findings if entry.get("fate") != _RIGHT]
    headings = ("outcome", "class", "marking", "in the design", "deviation ± 1 σ")
    return Comparison(
        source=Path(take_text(content.get("source"), f"{path}: source", MapFileError)).name,
        whole=_whole(content.get("design_as_a_whole")),
        counts=table(("outcome", "shapes"), [[str(fate), str(count)] for fate, count in counts.items()]),
        deviations=table(headings, rows[:_MOST_ROWS], words=len(headings)) if rows else None,
        more=max(0, len(rows) - _MOST_ROWS),
        table=names.AS_BUILT_TABLE,
        picture=jpeg_of(folder / names.AS_BUILT_PICTURE, 1500, 86),
    )


def _row(entry: Mapping[str, Any]) -> list[str]:
    measured = []
    for key in entry:
        if not key.endswith("_probability"):
            continue
        quantity = key.removesuffix("_probability")
        for unit, (shown, factor) in _UNITS.items():
            if f"{quantity}_{unit}" in entry:
                value = number(entry[f"{quantity}_{unit}"], 1, factor)
                sigma = number(entry.get(f"{quantity}_sigma_{unit}"), 1, factor)
                measured.append(f"{name_of(quantity)} {value} ± {sigma} {shown}")
    who = entry.get("id")
    words = [str(entry.get("fate", "")), name_of(str(entry.get("class", "")))]
    return [
        *words,
        "–" if who is None else str(who),
        str(entry.get("design") or "–"),
        "; ".join(measured) or "–",
    ]


def _whole(content: object) -> str:
    """How the design lies in the map as a whole, in a sentence."""
    if not isinstance(content, dict):
        return ""
    shift = content.get("shift_m")
    if not isinstance(shift, list) or len(shift) != 2:
        return ""
    east, north = (number(value, 1, 100) for value in shift)
    turn = number(content.get("turn_deg"), 3)
    lies = "lies off as a whole" if content.get("lies_off") else "lies in place as a whole"
    off = f"the paint is {east} cm east and {north} cm north of it, turned by {turn}°"
    judged = "; the shapes below are judged without this" if content.get("lies_off") else ""
    return f"The design {lies}: {off}{judged}."
