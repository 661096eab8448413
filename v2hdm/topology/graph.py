"""The records of a lane graph: directed lanes, which leads to which, junctions, stop lines, questions."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import length_along, points_along
from v2hdm.records import FloatArray
from v2hdm.topology.closed_lanes import Bound


class Direction(Enum):
    """The evidence that vehicles drive a lane in its direction."""

    DRIVEN = "driven"
    """A drive went along it, or along the lane that it continues."""
    STATED = "stated"
    """A person said so."""
    DRAWN = "drawn"
    """The direction of its lines; no path of any drive is known."""
    ASKED = "asked"
    """Nothing: drives are known, and none went along it."""


class Turn(Enum):
    """The way that a lane takes through a crossing, by its name in Lanelet2."""

    LEFT = "left"
    STRAIGHT = "straight"
    RIGHT = "right"


class Right(Enum):
    """The rule that a line across a lane sets for vehicles."""

    STOP = "stop"
    GIVE_WAY = "give way"


@dataclass(frozen=True)
class Border:
    """One side of a lane, in the lane's direction; ``bound`` is None where no paint shows it."""

    xyz_map: FloatArray  # (N, 3) m
    bound: Bound | None = None

    @property
    def points_map(self) -> FloatArray:
        """The points (N, 2), m."""
        return self.xyz_map[:, :2]


@dataclass(frozen=True)
class LaneOfGraph:
    """A lane in its direction of driving.

    ``is_connecting`` says that it lies in a junction: where lanes split, merge, turn or cross.
    """

    left: Border
    right: Border
    direction: Direction
    drives: tuple[int, ...] = ()  # numbers of the paths that pass it
    is_connecting: bool = False
    turn: Turn | None = None  # of a lane through a crossing
    speed_kmh: float | None = None  # as stated

    @property
    def centre_map(self) -> FloatArray:
        """Points (N, 2), m, midway between its sides, about half a metre apart."""
        length_m = max(length_along(side.points_map)[-1] for side in (self.left, self.right))
        share = np.linspace(0.0, 1.0, max(int(np.ceil(length_m / _STEP_M)), 1) + 1)
        sides = [
            points_along(side.points_map, share * length_along(side.points_map)[-1])
            for side in (self.left, self.right)
        ]
        return (sides[0] + sides[1]) / 2

    @property
    def outline_map(self) -> FloatArray:
        """Its outline (N, 2), m."""
        return np.concatenate([self.left.points_map, self.right.points_map[::-1]])


_STEP_M = 0.5  # spacing of the points along the middle of a lane, m; chosen


class Link(NamedTuple):
    """The lane ``after`` begins where the lane ``before`` ends, both by number."""

    before: int
    after: int


@dataclass(frozen=True)
class Junction:
    """Connecting lanes that begin, end or cross in one place."""

    lanes: tuple[int, ...]
    is_crossing: bool  # ways cross or turn there; else lanes only split or merge


@dataclass(frozen=True)
class StopLine:
    """A painted line, by its number among the map's markings, and the lanes that it ends."""

    marking: int
    right: Right
    lanes: tuple[int, ...]
    yields_to: tuple[int, ...] = ()  # lanes of the junction whose way a give-way line's lanes cross


@dataclass(frozen=True)
class StatedRight:
    """A lane into a crossing that is stated to give way to the ways ``yields_to`` of others through it."""

    lane: int
    yields_to: tuple[int, ...]


RIGHT_OF_WAY = "right of way"
SUBJECTS = ("direction", "connection", "speed", "two ways", "stop line", RIGHT_OF_WAY, "line")
"""Subjects of questions."""


@dataclass(frozen=True)
class Question:
    """A question that paint and drives leave open, at ``place_map`` (2,), m, about ``lanes``.

    A question about a connection also has the place ``to_map`` (2,), m, where the other lane begins.
    """

    subject: str  # one of :data:`SUBJECTS`
    text: str
    place_map: FloatArray
    lanes: tuple[int, ...] = ()
    to_map: FloatArray | None = None


@dataclass(frozen=True)
class LaneGraph:
    """The lanes of a map, each named by its number here, and how they belong together."""

    lanes: tuple[LaneOfGraph, ...]
    links: tuple[Link, ...] = ()
    junctions: tuple[Junction, ...] = ()
    stop_lines: tuple[StopLine, ...] = ()
    questions: tuple[Question, ...] = ()
    stated_rights: tuple[StatedRight, ...] = ()

    def after(self, lane: int) -> list[int]:
        """The lanes that follow a lane."""
        return [link.after for link in self.links if link.before == lane]

    def before(self, lane: int) -> list[int]:
        """The lanes that a lane follows."""
        return [link.before for link in self.links if link.after == lane]
