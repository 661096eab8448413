"""The corrections of a result while a person makes them, in a file that others may write as well."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextvars import Context
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from v2hdm.errors import MapFileError, V2hdmError, one_line
from v2hdm.io.maps.corrections import (
    Correction,
    correction_of,
    corrections_text,
    entry_of,
    read_corrections,
    write_corrections,
)
from v2hdm.records import Exclusion, FloatArray, HDMap, Lane
from v2hdm.safe.texts import parse_json, parse_yaml
from v2hdm.store.files import dump_yaml, load_yaml, refuse_unwritable, refuse_url
from v2hdm.store.folders import waited_for

_SAME_M = 0.01  # largest distance, m, between a correction and its feature
_MOST_CHANGES = 1000  # corrections that are sent in one piece, chosen: what a person selects at once


def file_beside(folder: Path) -> Path:
    """Default path of a result's corrections."""
    return folder.resolve().with_name(f"{folder.resolve().name}.corrections.yaml")


class MeanwhileError(MapFileError):
    """Somebody else has corrected the same, or has edited the file."""


class _Change(NamedTuple):
    """A correction for the feature ``key``, None to take one back, in the place of ``before``."""

    key: str
    correction: Correction | None
    before: Correction | None


class Session:
    """Corrections of a result by key of the feature, in a file that others may write as well.

    It is read before it is written: what another ``v2hdm view`` has put there is kept, and what a person
    has written there by hand is not replaced before the page has shown it. A link stays one.
    """

    def __init__(
        self,
        folder: Path,
        path: Path,
        places: Mapping[str, FloatArray],
        check: Callable[[Correction, Sequence[Correction]], None] | None = None,
    ) -> None:
        """Start from the file's content; MapFileError if that is something else, ConfigError if no place.

        ``places`` (N, 2) are those of the result's features, m, by their key in the page. ``check`` raises
        MapFileError for a new answer that cannot be followed, among all corrections.
        """
        refuse_url(path)
        refuse_unwritable(path.resolve())
        self.path = path
        self.corrections: dict[str, Correction] = {}
        self._folder = folder
        self._keys = _Keys(places)
        self._check = check
        self._place = path.resolve()
        self._content: bytes | None = None  # of the file, as it was last read or written
        self._lock = threading.Lock()
        if self._place.exists():
            self._read()

    def state(self) -> dict[str, Any]:
        """Every correction by its key, as it is in the file now, and why that cannot be read, if so."""
        problem = ""
        with self._lock:
            try:
                content = self._place.read_bytes() if self._place.exists() else None
                if content is not None and content != self._content:
                    self._read()
            except (V2hdmError, OSError) as error:
                problem = one_line(str(error))
            entries = {key: entry_of(correction) for key, correction in self.corrections.items()}
        return {"file": self.path.name, "corrections": entries, "problem": problem}

    def take(self, sent: bytes) -> list[str]:
        """Store or remove corrections, all of them or none, and write the file; returns their keys.

        Raises:
            MapFileError: they are malformed, or outdated.
        """
        changes = self._changes(sent)
        self._place.parent.mkdir(parents=True, exist_ok=True)
        with self._lock, waited_for(self._place.with_name(f".{self._place.name}.lock")):
            self._follow()
            corrections = dict(self.corrections)
            for change in changes:
                if not _is_same(corrections.get(change.key), change.before):
                    raise MeanwhileError(
                        f"{self.path}: this was corrected elsewhere meanwhile; reload the page"
                    )
                corrections.pop(change.key, None)
                if change.correction is not None:
                    corrections[change.key] = change.correction
            for change in changes:
                if self._check is not None and change.correction is not None and change.correction.is_answer:
                    self._check(change.correction, [*corrections.values()])
            # This command read the file at its start, and continues after writing it.
            Context().run(write_corrections, [*corrections.values()], str(self._folder), self._place)
            self._content = self._place.read_bytes()
            self.corrections = corrections
        return [change.key for change in changes]

    def merge(self, corrections: Sequence[Correction]) -> int:
        """Take over corrections from elsewhere, all of them or none; returns how many are new.

        Raises:
            MapFileError: one contradicts a correction that is in the file.
        """
        self._place.parent.mkdir(parents=True, exist_ok=True)
        with self._lock, waited_for(self._place.with_name(f".{self._place.name}.lock")):
            self._follow()
            merged = dict(self.corrections)
            for correction in corrections:
                entry = self._kept(entry_of(correction))
                key = self._keys.of(entry)
                if not _is_same(merged.setdefault(key, entry), entry):
                    raise MapFileError(
                        f"{self.path}: corrects the {entry.place} otherwise already; take one back"
                    )
            count = len(merged) - len(self.corrections)
            if count:
                Context().run(write_corrections, [*merged.values()], str(self._folder), self._place)
                self._content = self._place.read_bytes()
                self.corrections = merged
        return count

    def _changes(self, sent: bytes) -> list[_Change]:
        """The corrections that a page has sent: one, or a list under ``changes``."""
        try:
            content = parse_json(sent.decode(), "correction", MapFileError)
            parts = content.get("changes", [content])
            if not isinstance(parts, list) or len(parts) > _MOST_CHANGES:
                raise MapFileError(f"changes: expected a list of at most {_MOST_CHANGES} corrections")
            return [self._change(part) for part in parts]
        except (ValueError, TypeError, LookupError, AttributeError):
            raise MapFileError("not a correction: expected a key and a correction") from None

    def _change(self, content: Mapping[str, Any]) -> _Change:
        key = str(content["key"])
        entry = content["correction"]
        correction = None if entry is None else self._kept(entry)
        if correction is not None:
            key = self._keys.of(correction)
        before = self.corrections.get(key)
        if "before" in content:
            before = None if content["before"] is None else self._kept(content["before"])
        return _Change(key, correction, before)

    def _kept(self, entry: object) -> Correction:
        """A correction after writing and reading it."""
        where = f"{self.path}: the new correction"
        text = dump_yaml(entry_of(correction_of(entry, where)))
        return correction_of(parse_yaml(text, where, MapFileError), where)

    def _read(self) -> None:
        content = self._place.read_bytes()
        corrections: dict[str, Correction] = {}
        for correction in Context().run(read_corrections, self._place):
            key = self._keys.of(correction)
            if not _is_same(corrections.setdefault(key, correction), correction):
                raise MapFileError(
                    f"{self.path}: two corrections contradict each other on the {correction.place}; keep one"
                )
        self.corrections = corrections
        self._content = content

    def _follow(self) -> None:
        """Take over what another view has written; refuse where anybody else has changed the file."""
        try:
            content = self._place.read_bytes()
        except FileNotFoundError:
            if self._content is None:
                return
            raise MeanwhileError(
                f"{self.path}: was removed meanwhile; put it back, or start view again"
            ) from None
        if content == self._content:
            return
        corrections = Context().run(read_corrections, self._place)
        result = str(Context().run(load_yaml, self._place, MapFileError).get("result", ""))
        if content != corrections_text(corrections, result).encode():
            raise MeanwhileError(f"{self.path}: was edited meanwhile; reload the page to go on from there")
        self._read()


def _is_same(correction: Correction | None, other: Correction | None) -> bool:
    """Whether two corrections are written in the same way."""
    return (correction and entry_of(correction)) == (other and entry_of(other))


def places_of(hd_map: HDMap, excluded: Sequence[Exclusion]) -> dict[str, FloatArray]:
    """Places (N, 2) of a result's features, m, by their key in the page."""
    places = {f"x{n}": candidate.position_map[None] for n, candidate in enumerate(excluded)}
    places |= {f"m{marking.id}": marking.corners_map for marking in hd_map.markings}
    places |= {f"s{symbol.id}": symbol.outline_map for symbol in hd_map.symbols}
    places |= {f"l{n}": thinned(line.points_map) for n, line in enumerate(painted_lines(hd_map))}
    return places


def painted_lines(hd_map: HDMap) -> list[Lane]:
    """The lane lines as they are painted, in the order of their keys."""
    return [line for lane in hd_map.lanes for line in lane.painted if len(line.points_map) > 1]


_THIN_M = 0.02  # largest distance, m, of a thinned line from the line


def thinned(line_map: FloatArray) -> FloatArray:
    """A line (N, 2), m, by fewer of its vertices."""
    # OpenCV's single precision is that of the distance from the first vertex.
    offset_m = (line_map - line_map[0]).astype(np.float32)
    kept_m = np.asarray(cv2.approxPolyDP(offset_m, _THIN_M, False), np.float64)[:, 0]
    return np.asarray(kept_m + line_map[0])


_KEY_DIGITS = 2  # decimals, m, of the places in the key of a question
_CELL_M = 2 * _SAME_M  # side of the cells in which features are looked up by their first point, m


class _Keys:
    """Keys in the page of features, by their places."""

    def __init__(self, places: Mapping[str, FloatArray]) -> None:
        self._in_cell: dict[tuple[int, int], list[tuple[str, FloatArray]]] = {}
        for key, place in places.items():
            self._in_cell.setdefault(_cell(place[0]), []).append((key, place))

    def of(self, correction: Correction) -> str:
        """The id of a correction's feature; its outline, if that is not in the map."""
        outline = np.array(correction.outline_map)
        if correction.is_answer:
            return answer_key(correction.kind, outline)
        x, y = _cell(outline[0])
        for cell in [(x + dx, y + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]:
            for key, place in self._in_cell.get(cell, ()):
                if place.shape == outline.shape and np.abs(place - outline).max() < _SAME_M:
                    return key
        return str(outline.round(3).tolist())


def answer_key(subject: str, places: FloatArray) -> str:
    """The key in the page of a question, and of its answer: by ``subject`` and ``places`` (1 or 2, 2), m."""
    return f"q {subject} {places.round(_KEY_DIGITS).tolist()}"


def flat_mm(points_m: FloatArray) -> list[int]:
    """Points (N, 2), m, as x, y, x, y, ... in whole millimetres, which are short and fast to read."""
    flat: list[int] = np.rint(1000.0 * points_m).astype(np.int64).ravel().tolist()
    return flat


def _cell(point_m: FloatArray) -> tuple[int, int]:
    x, y = np.floor(point_m / _CELL_M).astype(np.int64).tolist()
    return x, y
