"""The lanes of a result in its page, by lines, paths, and a person's corrections and answers."""

from __future__ import annotations

import json
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.io.maps.corrections import Correction
from v2hdm.io.maps.questions import answers_among
from v2hdm.io.trajectory import read_tum
from v2hdm.records import FloatArray, HDMap, Trajectory
from v2hdm.report.view.session import answer_key, flat_mm, thinned
from v2hdm.site.line_corrections import with_lines_corrected
from v2hdm.store import names
from v2hdm.topology.build import Answered, answered_graph
from v2hdm.topology.graph import LaneOfGraph, Question


class Lanes:
    """The lane graph of a map with its current corrections; rebuilt when they change it."""

    def __init__(self, hd_map: HDMap, trajectories: Sequence[Trajectory]) -> None:
        """``trajectories`` are those of the drives, in the map frame."""
        self._hd_map = hd_map
        self._trajectories = trajectories
        self._lock = threading.Lock()
        self._corrections: list[Correction] | None = None  # those on lanes that ``_answered`` follows
        self._answered: Answered | None = None

    @classmethod
    def of(cls, folder: Path, hd_map: HDMap) -> Lanes:
        """The lanes of a result; MapFileError where its poses are damaged."""
        return cls(hd_map, [read_tum(path) for path in sorted(folder.glob(names.TRAJECTORIES))])

    def with_corrections(self, corrections: Sequence[Correction]) -> Answered:
        """The graph with a person's lane lines and answers."""
        on_lanes = [correction for correction in corrections if correction.is_line or correction.is_answer]
        with self._lock:
            if self._answered is None or on_lanes != self._corrections:
                hd_map, _ = with_lines_corrected(self._hd_map, on_lanes)
                self._answered = answered_graph(hd_map, self._trajectories, answers_among(on_lanes))
                self._corrections = on_lanes
            return self._answered

    def check(self, correction: Correction, corrections: Sequence[Correction]) -> None:
        """Raise MapFileError if a new answer among the corrections contradicts the drives or has no lane."""
        for refusal in self.with_corrections(corrections).refused:
            if answer_key(refusal.answer.subject, _places(refusal.answer)) == answer_key(
                correction.kind, np.array(correction.outline_map)
            ):
                raise MapFileError(refusal.reason)

    def document(self, corrections: Sequence[Correction]) -> bytes:
        """Lanes and open questions as JSON, places in millimetres, and why an answer is not followed."""
        answered = self.with_corrections(corrections)
        content = {
            "lanes": [_lane(lane) for lane in answered.graph.lanes],
            "questions": [_question(question) for question in answered.graph.questions],
            "refused": [refusal.reason for refusal in answered.refused],
        }
        return json.dumps(content, allow_nan=False, separators=(",", ":")).encode()


def _lane(lane: LaneOfGraph) -> dict[str, Any]:
    entry: dict[str, Any] = {"p": flat_mm(thinned(lane.centre_map)), "by": lane.direction.value}
    entry["drives"] = len(lane.drives)
    if lane.is_connecting:
        entry["connects"] = 1
    if lane.turn is not None:
        entry["turn"] = lane.turn.value
    if lane.speed_kmh is not None:
        entry["kmh"] = lane.speed_kmh
    return entry


def _question(question: Question) -> dict[str, Any]:
    places = np.rint(1000 * _places(question)) / 1000  # as the page states them in an answer
    key = answer_key(question.subject, places)
    return {"key": key, "subject": question.subject, "text": question.text, "p": flat_mm(places)}


def _places(question: Any) -> FloatArray:
    """The one or two places (N, 2), m, of a question or an answer."""
    return np.stack([place for place in (question.place_map, question.to_map) if place is not None])
