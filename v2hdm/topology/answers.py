"""Statements of a person on lanes: answers to the questions of a lane graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.records import FloatArray
from v2hdm.topology.graph import RIGHT_OF_WAY, Question
from v2hdm.topology.stays import LaneShape

_SAME_M = 1.0  # distance, m, between the places of a question and of its answer; chosen
NEAR_M = 3.0  # distance, m, from a stated end or start of a lane to the lane's; chosen


@dataclass(frozen=True)
class Answer:
    """An answer to a question of a subject, with the question's places (2,), m, and where it was read."""

    subject: str
    answer: str
    place_map: FloatArray
    to_map: FloatArray | None
    where: str

    def closes(self, question: Question) -> bool:
        """Whether it is the answer to a question."""
        if question.subject != self.subject:
            return False
        if question.subject == "speed":
            return True
        pairs = ((question.place_map, self.place_map), (question.to_map, self.to_map))
        places = [
            (asked_map, answered_map)
            for asked_map, answered_map in pairs
            if asked_map is not None and answered_map is not None
        ]
        reach_m = NEAR_M if self.subject == RIGHT_OF_WAY else _SAME_M  # people may point at the lane's end
        return all(
            float(np.linalg.norm(asked_map - answered_map)) < reach_m for asked_map, answered_map in places
        )

    @property
    def speed_kmh(self) -> float:
        """The speed limit that it states."""
        try:
            speed_kmh = float(self.answer)
        except ValueError:
            speed_kmh = float("nan")
        if not 0.0 < speed_kmh < _FASTEST_KMH:
            raise MapFileError(
                f"{self.where}: {self.answer!r} is not a speed in km/h; give a number, such as 30"
            )
        return speed_kmh


_FASTEST_KMH = 200.0  # a speed limit, km/h, that no road has; chosen
WAYS = {"along": (True,), "against": (False,), "both": (True, False)}
"""Answers to a question about a direction, and whether each way is that of the question's line."""


def stated_directions(
    shapes: Sequence[LaneShape], driven: Sequence[set[bool]], answers: Sequence[Answer]
) -> dict[int, set[bool]]:
    """For lanes, by number, whether they are stated to run as their shape (True) or the other way (False).

    Raises MapFileError where no lane lies at the place, or where drives ``driven`` it the other way alone.
    """
    stated: dict[int, set[bool]] = {}
    for answer in answers:
        if answer.subject != "direction":
            continue
        if answer.answer not in WAYS or answer.to_map is None:
            raise MapFileError(
                f"{answer.where}: {answer.answer!r} is not a direction; give along, against or both"
            )
        number = _lane_at(shapes, answer)
        shape = shapes[number]
        ahead = shape.ahead[shape.nearest(answer.place_map[None])[0]]
        is_same = bool(ahead @ (answer.to_map - answer.place_map) > 0)
        ways = {is_along == is_same for is_along in WAYS[answer.answer]}
        if driven[number] and not driven[number] <= ways:
            x, y = answer.place_map.tolist()
            raise MapFileError(
                f"{answer.where}: a drive went the other way along the lane at ({x:.1f}, {y:.1f}); "
                "answer both, or export without that drive"
            )
        stated.setdefault(number, set()).update(ways)
    return stated


def _lane_at(shapes: Sequence[LaneShape], answer: Answer) -> int:
    for number, shape in enumerate(shapes):
        if len(shape.holding(answer.place_map[None])):
            return number
    x, y = answer.place_map.tolist()
    raise MapFileError(
        f"{answer.where}: no lane lies at ({x:.1f}, {y:.1f}); move the line into one, or drop it"
    )


def stated_pair(shapes: Sequence[LaneShape], answer: Answer) -> tuple[int, int]:
    """The two lanes that a stated way connects: one ends at its place, one starts where it leads."""
    if answer.to_map is None:
        raise MapFileError(f"{answer.where}: it has one place; draw a line from the end of a lane to a start")
    ends = np.array([shape.centre[-1] for shape in shapes]).reshape(-1, 2)
    starts = np.array([shape.centre[0] for shape in shapes]).reshape(-1, 2)
    pair = []
    for places, place, what in ((ends, answer.place_map, "ends"), (starts, answer.to_map, "starts")):
        apart_m = np.linalg.norm(places - place, axis=1)
        if not len(apart_m) or apart_m.min() > NEAR_M:
            x, y = place.tolist()
            raise MapFileError(
                f"{answer.where}: no lane {what} at ({x:.1f}, {y:.1f}); draw from an end to a start"
            )
        pair.append(int(np.argmin(apart_m)))
    return pair[0], pair[1]
