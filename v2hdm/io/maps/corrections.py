"""Corrections of a map by a person, in a file of their own: ``corrections.yaml``, a control of the next run.

They name places, not candidates: markings get other numbers when a drive is mapped again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.store.files import (
    check_keys,
    dump_yaml,
    load_yaml,
    replace_text,
    take_array,
    take_choice,
    take_mapping,
    take_number,
    take_text,
)

ACCEPTED = "accepted"
REJECTED = "rejected"
CORRECTED = "corrected"
SIGMA_M = 0.02  # sigma of a corner that a person places beside the others of its marking, m: a mosaic's pixel

_HEAD = "# Corrections of a map by a person: map.corrections=THIS FILE in the next run (docs/report.md).\n"
_MOST = 100_000  # entries that a file of corrections may have; chosen

_KIND_AND_OUTLINE_MAP = (
    "kind and outline_map are its class and corners (N, 2), m, in the map that they saw, one point if "
    "left out."
)


@dataclass(kw_only=True)
class Correction:
    """A person's decision on one marking, symbol or candidate that was left out."""

    says: Annotated[str, "accepted, rejected or corrected."]
    kind: Annotated[str, _KIND_AND_OUTLINE_MAP]
    outline_map: Annotated[list[list[float]], _KIND_AND_OUTLINE_MAP]
    marking: Annotated[int | None, "its id in that map, only for readers."] = None
    new_kind: Annotated[str | None, "the corrected class."] = None
    moved: Annotated[dict[int, list[float]], "moved has new positions (2,) of corners, numbered from 1."] = (
        field(default_factory=dict)
    )
    sigma_m: Annotated[float, "their standard deviation, m."] = SIGMA_M
    reason: Annotated[str, "an optional comment."] = ""

    @property
    def place(self) -> str:
        """Its class, id and position, for messages."""
        x, y = np.mean(self.outline_map, axis=0)
        name = "" if self.marking is None else f" {self.marking}"
        return f"{self.kind}{name} at ({x:.2f}, {y:.2f})"


def read_corrections(path: Path) -> list[Correction]:
    """Read a file of corrections; raises MapFileError, with the entry, where it is missing or damaged."""
    content = load_yaml(path, MapFileError)
    check_keys(content, ("corrections",), ("result",), str(path), MapFileError)
    entries = content["corrections"]
    if not isinstance(entries, list) or len(entries) > _MOST:
        raise MapFileError(f"{path}: corrections: expected a list; see docs/report.md")
    return [correction_of(entry, f"{path}: corrections[{number}]") for number, entry in enumerate(entries)]


def correction_of(content: object, where: str) -> Correction:
    """One entry, checked; raises MapFileError."""
    entry = take_mapping(content, where, MapFileError)
    optional = ("marking", "new_class", "moved", "sigma_m", "reason")
    check_keys(entry, ("says", "class", "outline_map"), optional, where, MapFileError)
    outline = take_array(entry["outline_map"], (-1, 2), f"{where}: outline_map", MapFileError)
    says = take_choice(entry["says"], (ACCEPTED, REJECTED, CORRECTED), f"{where}: says", MapFileError)
    moved: dict[int, list[float]] = {}
    for corner, place in take_mapping(entry.get("moved") or {}, f"{where}: moved", MapFileError).items():
        number = int(corner) if str(corner).isdecimal() else 0
        if len(outline) != 4 or not 1 <= number <= 4:
            raise MapFileError(f"{where}: moved: no corner {corner}; quadrilaterals have 1 to 4")
        moved[number] = take_array(place, (2,), f"{where}: moved: {corner}", MapFileError).tolist()
    sigma_m = take_number(entry.get("sigma_m", SIGMA_M), f"{where}: sigma_m", MapFileError)
    if not len(outline) or not 0 < sigma_m <= 1:
        raise MapFileError(f"{where}: needs a point in outline_map, and sigma_m above 0 and at most 1 m")
    marking = entry.get("marking")
    new = entry.get("new_class")
    return Correction(
        says=says,
        kind=take_text(entry["class"], f"{where}: class", MapFileError),
        outline_map=outline.tolist(),
        marking=None if marking is None else int(take_number(marking, f"{where}: marking", MapFileError)),
        new_kind=None if new is None else take_text(new, f"{where}: new_class", MapFileError),
        moved=moved,
        sigma_m=sigma_m,
        reason=str(entry.get("reason") or ""),
    )


def write_corrections(corrections: Sequence[Correction], result: str, path: Path) -> None:
    """Write corrections of a ``result``, whole."""
    content = {"result": result, "corrections": [entry_of(correction) for correction in corrections]}
    replace_text(path, _HEAD + dump_yaml(content))


def entry_of(correction: Correction) -> dict[str, Any]:
    """An entry as it is written."""
    entry: dict[str, Any] = {"says": correction.says, "class": correction.kind}
    named = {"marking": correction.marking, "new_class": correction.new_kind, "reason": correction.reason}
    entry |= {key: value for key, value in named.items() if value}
    entry["outline_map"] = [_rounded(place) for place in correction.outline_map]
    if correction.moved:
        moved = {corner: _rounded(place) for corner, place in sorted(correction.moved.items())}
        entry |= {"moved": moved, "sigma_m": correction.sigma_m}
    return entry


def _rounded(place: Sequence[float]) -> list[float]:
    return [round(value, 4) for value in place]
