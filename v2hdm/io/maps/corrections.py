"""Corrections of a map by a person, in a file of their own: ``corrections.yaml``, a control of the next run.

They name places, not candidates: markings get other numbers when a drive is mapped again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.geometry.planar import cross, is_simple, signed_area
from v2hdm.records import FloatArray
from v2hdm.safe.fields import take_whole
from v2hdm.safe.texts import MOST_YAML_BYTES, shown, take_name
from v2hdm.store.files import (
    check_keys,
    dump_yaml,
    load_yaml,
    replace_text,
    take_array,
    take_choice,
    take_mapping,
    take_number,
)
from v2hdm.topology.graph import SUBJECTS

ACCEPTED = "accepted"
REJECTED = "rejected"
CORRECTED = "corrected"
ADDED = "added"  # a marking that the map lacks
ANSWERED = "answered"  # a question on lanes
SIGMA_M = 0.02  # sigma of a corner that a person places beside the others of its marking, m: a mosaic's pixel

_HEAD = "# Corrections of a map by a person: map.corrections=THIS FILE in the next run (docs/report.md).\n"
_MOST = 100_000  # entries that a file of corrections may have; chosen
_LONGEST_REASON = 1000  # letters of a reason; chosen
_FARTHEST_M = 1e7  # from a map's origin to any place in it, m: a quarter of the earth
_LARGEST_ID = 1_000_000_000  # of a marking, as in maps
_CORNERS = ("1", "2", "3", "4")
_SAME_DIGITS = 3  # decimals, m, up to which the outlines of two corrections of one marking are the same

_KIND_AND_OUTLINE_MAP = (
    "kind and outline_map are its class and corners (N, 2), m, in the map that they saw, one point if "
    "left out."
)


@dataclass(kw_only=True)
class Correction:
    """A person's decision on a marking, symbol, lane line or left-out candidate, or an answer on lanes."""

    says: Annotated[str, "accepted, rejected, corrected, added or answered."]
    kind: Annotated[str, _KIND_AND_OUTLINE_MAP]
    outline_map: Annotated[list[list[float]], _KIND_AND_OUTLINE_MAP]
    marking: Annotated[int | None, "its id in that map, only for readers."] = None
    new_kind: Annotated[str | None, "the corrected class."] = None
    moved: Annotated[dict[int, list[float]], "moved has new positions (2,) of corners, numbered from 1."] = (
        field(default_factory=dict)
    )
    sigma_m: Annotated[float, "their standard deviation, m."] = SIGMA_M
    reason: Annotated[str, "an optional comment."] = ""
    is_line: Annotated[bool, "whether outline_map is the course of a lane line, of two points or more."] = (
        False
    )
    answer: Annotated[str, "the answer to a question on lanes, whose subject is kind, of outline_map."] = ""

    @property
    def is_answer(self) -> bool:
        """Whether it answers a question on lanes, which says nothing of paint."""
        return self.says == ANSWERED

    @property
    def stated_kind(self) -> str | None:
        """The class that the person gives it, None where that stays."""
        return self.kind if self.says == ADDED else self.new_kind

    @property
    def place(self) -> str:
        """Its class, id and position, for messages."""
        x, y = np.mean(self.outline_map, axis=0)
        name = "" if self.marking is None else f" {self.marking}"
        return f"{self.kind}{name} at ({x:.2f}, {y:.2f})"


@dataclass(frozen=True)
class Heard:
    """A correction that the map follows, and how the images contradict it; empty where they do not."""

    place: str
    says: str
    against: str = ""

    @property
    def sentence(self) -> str:
        """Both in a line."""
        return f"{self.place}: {self.says}" + (f", but {self.against}" if self.against else "")


def read_corrections(path: Path) -> list[Correction]:
    """Read a file of corrections; raises MapFileError, with the entry, where it is missing or damaged."""
    content = load_yaml(path, MapFileError)
    check_keys(content, ("corrections",), ("result",), str(path), MapFileError)
    entries = content["corrections"]
    if not isinstance(entries, list) or len(entries) > _MOST:
        raise MapFileError(f"{path}: corrections: expected a list; see docs/report.md")
    corrections = [
        correction_of(entry, f"{path}: corrections[{number}]") for number, entry in enumerate(entries)
    ]
    number_of_outline: dict[tuple[float, ...], int] = {}
    for number, correction in enumerate(corrections):
        outline_m = tuple(np.round(np.ravel(correction.outline_map), _SAME_DIGITS).tolist())
        first = number_of_outline.setdefault(outline_m, number)
        if _said(correction) != _said(corrections[first]):
            raise MapFileError(
                f"{path}: corrections[{first}] and corrections[{number}] contradict each other on the "
                f"{correction.place}; keep one of them"
            )
    return corrections


def _said(correction: Correction) -> tuple[object, ...]:
    """The sentence that a correction states of its marking."""
    return correction.says, correction.new_kind, correction.moved, correction.is_line, correction.answer


def correction_of(content: object, where: str) -> Correction:
    """One entry, checked; raises MapFileError."""
    entry = take_mapping(content, where, MapFileError)
    optional = ("marking", "new_class", "moved", "sigma_m", "reason")
    if entry.get("says") == ANSWERED:
        return _answer(entry, where)
    if "line_map" in entry:
        return _line_correction(entry, where)
    check_keys(entry, ("says", "class", "outline_map"), optional, where, MapFileError)
    outline = _take_places(entry["outline_map"], f"{where}: outline_map")
    says = take_choice(entry["says"], (ACCEPTED, REJECTED, CORRECTED, ADDED), f"{where}: says", MapFileError)
    sigma_m = take_number(entry.get("sigma_m", SIGMA_M), f"{where}: sigma_m", MapFileError)
    if not len(outline) or not 0 < sigma_m <= 1:
        raise MapFileError(f"{where}: needs a point in outline_map, and sigma_m above 0 and at most 1 m")
    if says == ADDED:
        _check_added(entry, outline, where)
    marking = entry.get("marking")
    new = entry.get("new_class")
    reason = entry.get("reason") or ""
    if not isinstance(reason, str | int | float) or len(str(reason)) > _LONGEST_REASON:
        raise MapFileError(f"{where}: reason: expected a text of at most {_LONGEST_REASON} letters")
    return Correction(
        says=says,
        kind=take_name(entry["class"], f"{where}: class", MapFileError),
        outline_map=outline.tolist(),
        marking=None if marking is None else _take_id(marking, f"{where}: marking"),
        new_kind=None if new is None else take_name(new, f"{where}: new_class", MapFileError),
        moved=_take_moved(entry.get("moved"), outline, where),
        sigma_m=sigma_m,
        reason=str(reason),
    )


def _line_correction(entry: Mapping[str, Any], where: str) -> Correction:
    """An entry on a lane line: one that was drawn, or one to leave out."""
    check_keys(entry, ("says", "class", "line_map"), ("sigma_m", "reason"), where, MapFileError)
    line = _take_places(entry["line_map"], f"{where}: line_map")
    sigma_m = take_number(entry.get("sigma_m", SIGMA_M), f"{where}: sigma_m", MapFileError)
    if len(line) < 2 or not 0 < sigma_m <= 1:
        raise MapFileError(f"{where}: needs two points in line_map, and sigma_m above 0 and at most 1 m")
    if crosses_itself(line):
        raise MapFileError(f"{where}: line_map crosses itself; draw it again")
    reason = entry.get("reason") or ""
    if not isinstance(reason, str) or len(reason) > _LONGEST_REASON:
        raise MapFileError(f"{where}: reason: expected a text of at most {_LONGEST_REASON} letters")
    return Correction(
        says=take_choice(entry["says"], (REJECTED, ADDED), f"{where}: says", MapFileError),
        kind=take_name(entry["class"], f"{where}: class", MapFileError),
        outline_map=line.tolist(),
        sigma_m=sigma_m,
        reason=reason,
        is_line=True,
    )


def _answer(entry: Mapping[str, Any], where: str) -> Correction:
    """An entry that answers a question on lanes."""
    check_keys(entry, ("says", "subject", "places_map", "answer"), (), where, MapFileError)
    places = _take_places(entry["places_map"], f"{where}: places_map")
    answer = entry["answer"]
    if not 1 <= len(places) <= 2:
        raise MapFileError(f"{where}: places_map: a question has one or two places")
    if not isinstance(answer, str | int | float) or not 0 < len(str(answer)) <= _LONGEST_REASON:
        raise MapFileError(f"{where}: answer: expected a text of at most {_LONGEST_REASON} letters")
    return Correction(
        says=ANSWERED,
        kind=take_choice(entry["subject"], SUBJECTS, f"{where}: subject", MapFileError),
        outline_map=places.tolist(),
        answer=str(answer),
    )


def crosses_itself(line: FloatArray) -> bool:
    """Whether two pieces of a line (N, 2) cross each other."""
    start = line[:-1]
    piece = np.diff(line, axis=0)
    # Signed areas (N-1, N-1) of the ends of a piece beside another: of opposite signs where they cross.
    begin = cross(start[:, None] - start, piece)
    end = cross(line[1:, None] - start, piece)
    crossing = begin * end < 0
    return bool((crossing & crossing.T).any())


def _check_added(entry: Mapping[str, Any], outline: FloatArray, where: str) -> None:
    """Refuse a new marking that is not four corners around some paint, or that is corrected as well."""
    if not is_quadrilateral(outline):
        raise MapFileError(
            f"{where}: outline_map: an added marking has four corners, counter-clockwise from above, whose "
            "sides do not cross"
        )
    stated = sorted({"moved", "new_class"} & entry.keys())
    if stated:
        raise MapFileError(f"{where}: {stated[0]}: state class and outline_map of what is added instead")


def is_quadrilateral(outline: FloatArray) -> bool:
    """Whether an outline (N, 2) has four counter-clockwise corners and no crossing sides."""
    return len(outline) == 4 and is_simple(outline) and float(signed_area(outline)) > 0


def _take_id(content: object, where: str) -> int:
    return take_whole(content, -_LARGEST_ID, _LARGEST_ID, where, MapFileError)


def _take_places(content: object, where: str) -> FloatArray:
    """``content`` as places (N, 2) of a map."""
    places = take_array(content, (-1, 2), where, MapFileError)
    if np.abs(places).max(initial=0.0) > _FARTHEST_M:
        raise MapFileError(f"{where}: a place lies more than {_FARTHEST_M:.0e} m away; fix it")
    return places


def _take_moved(content: object, outline: FloatArray, where: str) -> dict[int, list[float]]:
    """``content`` as new places of corners, which leave an ``outline`` (N, 2) one that goes once around."""
    moved: dict[int, list[float]] = {}
    for corner, place in take_mapping(content or {}, f"{where}: moved", MapFileError).items():
        if len(outline) != 4 or str(corner) not in _CORNERS:
            raise MapFileError(f"{where}: moved: no corner {shown(corner)[1:-1]}; quadrilaterals have 1 to 4")
        moved[int(corner)] = _take_places([place], f"{where}: moved: {corner}")[0].tolist()
    corners = outline.copy()
    for number, place in moved.items():
        corners[number - 1] = place
    if moved and (not is_simple(corners) or signed_area(corners) * signed_area(outline) <= 0):
        numbers = ", ".join(map(str, sorted(moved)))
        raise MapFileError(
            f"{where}: moved: with corner {numbers} there, the outline crosses itself; swap them back"
        )
    return moved


def write_corrections(corrections: Sequence[Correction], result: str, path: Path) -> None:
    """Write corrections of a ``result``, whole; MapFileError where they could not be read again."""
    text = corrections_text(corrections, result)
    if len(corrections) > _MOST or len(text.encode()) > MOST_YAML_BYTES:
        raise MapFileError(f"{path}: would become too large to be read; begin another file")
    replace_text(path, text)


def corrections_text(corrections: Sequence[Correction], result: str) -> str:
    """The file that :func:`write_corrections` writes."""
    content = {"result": result, "corrections": [entry_of(correction) for correction in corrections]}
    return _HEAD + dump_yaml(content)


def entry_of(correction: Correction) -> dict[str, Any]:
    """An entry as it is written."""
    if correction.is_answer:
        places = [_rounded(place) for place in correction.outline_map]
        return {
            "says": ANSWERED, "subject": correction.kind, "answer": correction.answer, "places_map": places,
        }  # fmt: skip
    entry: dict[str, Any] = {"says": correction.says, "class": correction.kind}
    named = {"marking": correction.marking, "new_class": correction.new_kind, "reason": correction.reason}
    entry |= {key: value for key, value in named.items() if value}
    entry["line_map" if correction.is_line else "outline_map"] = [
        _rounded(place) for place in correction.outline_map
    ]
    if correction.moved:
        moved = {corner: _rounded(place) for corner, place in sorted(correction.moved.items())}
        entry |= {"moved": moved, "sigma_m": correction.sigma_m}
    elif correction.says == ADDED and correction.sigma_m != SIGMA_M:
        entry["sigma_m"] = correction.sigma_m
    return entry


def _rounded(place: Sequence[float]) -> list[float]:
    return [round(value, 4) for value in place]
