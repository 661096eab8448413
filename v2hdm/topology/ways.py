"""The ways that drives took from the end of one lane to the start of another: through crossings and turns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import angle_between
from v2hdm.records import FloatArray
from v2hdm.topology.closed_lanes import Bound, ClosedLane
from v2hdm.topology.directions import DirectedLanes, end_of, start_of
from v2hdm.topology.graph import Direction, Question
from v2hdm.topology.paths import STEP_M, Path
from v2hdm.topology.stays import LaneShape, Stay, stays_of

_SNAP_M = 10.0  # way, m, from the end of a lane within which a path that leaves it leaves its end; chosen
_LONGEST_M = 80.0  # longest way between lanes, m, that is one connection: a wide crossing of a port; chosen
_DEPARTED_RAD = np.deg2rad(10.0)  # angle from a lane at which a path has begun to turn out of it; chosen
_MOST_LINKS = 4  # lanes that a path may pass unseen on its way along lanes that are linked; chosen

Cut = tuple[int, int]
"""A line and its vertex at which lanes are to end."""


class Way(NamedTuple):
    """A way from the end of the lane ``before`` to the start of the lane ``after``."""

    before: int
    after: int
    path: int
    first: int  # point of the path beside the end of ``before``
    last: int  # point of the path beside the start of ``after``
    off_m: float  # how far the path is from the middles of both lanes there


@dataclass
class DrivenWays:
    """All that the paths say on how lanes lead on."""

    ways: list[Way] = field(default_factory=list)
    cuts: list[Cut] = field(default_factory=list)
    followed: dict[tuple[int, int], set[int]] = field(default_factory=dict)  # drives along given links
    questions: list[Question] = field(default_factory=list)


class _Place(NamedTuple):
    """A place on a lane."""

    lane: int
    at_m: float
    point: int  # of the path


class WayFinder:
    """Finds the ways of paths between directed lanes; ``links`` (before, after) are known from paint."""

    def __init__(
        self,
        directed: DirectedLanes,
        lines_map: Sequence[FloatArray],
        paths: Sequence[Path],
        links: Sequence[tuple[int, int]],
    ) -> None:
        self._lanes = directed.lanes
        self._paths = paths
        self._links = links
        self._shapes = [LaneShape(lane, lines_map) for lane in directed.lanes]
        self._is_driven = [direction is not Direction.ASKED for direction in directed.direction]
        starts = {start_of(lane): number for number, lane in enumerate(directed.lanes)}
        self._next = {
            number: starts[end_of(lane)]
            for number, lane in enumerate(directed.lanes)
            if end_of(lane) in starts
        }
        self._last = {after: before for before, after in self._next.items()}
        self._all_links = {*self._next.items(), *links}
        self._following: dict[int, list[int]] = {}
        for before, after in sorted(self._all_links):
            self._following.setdefault(before, []).append(after)

    def find(self) -> DrivenWays:
        """The ways of all paths, the best path for each pair of lanes."""
        result = DrivenWays()
        best: dict[tuple[int, int], Way] = {}
        for number in range(len(self._paths)):
            stays = [
                stay
                for stay in stays_of(number, self._paths, self._shapes)
                if stay.is_forward and self._is_driven[stay.lane]
            ]
            for before, after in pairwise(stays):
                for way in self._between(stays, before, after, result):
                    pair = (way.before, way.after)
                    drive = self._paths[number].drive
                    result.followed.setdefault(pair, set()).add(drive)
                    if pair not in best or way.off_m < best[pair].off_m:
                        best[pair] = way
        result.ways = [best[pair] for pair in sorted(best) if pair not in self._all_links]
        return result

    def _between(self, stays: Sequence[Stay], before: Stay, after: Stay, result: DrivenWays) -> Iterator[Way]:
        """The way from one stay to the next, where there is one that no lane leads along."""
        if before.lane == after.lane or self._is_lane_change(before.lane, after.lane):
            return
        chain = self._chain(before.lane, after.lane)
        drive = self._paths[before.path].drive
        if chain is not None:
            for pair in pairwise(chain):
                result.followed.setdefault(pair, set()).add(drive)
            return
        gap_m = (after.first - before.last) * STEP_M
        if gap_m > _LONGEST_M:
            text = f"a drive went {gap_m:.0f} m without lanes from this lane to another; is it a lane?"
            places = self._paths[before.path].points_map[[before.last, after.first]]
            pair = (before.lane, after.lane)
            result.questions.append(Question("connection", text, places[0], pair, places[1]))
            return
        left = self._end(self._departure(stays, before), result)
        entered = self._start(self._arrival(stays, after), result)
        if left == entered or self._chain(left, entered) is not None:
            return
        way = self._way(before, after, left, entered)
        if way is not None:
            yield way

    def _chain(self, first: int, last: int) -> list[int] | None:
        """The few lanes, linked one to the next, from one lane to another."""
        chains = [[first]]
        for _ in range(_MOST_LINKS):
            longer = []
            for chain in chains:
                for after in self._following.get(chain[-1], ()):
                    if after in chain:
                        continue
                    if after == last:
                        return [*chain, after]
                    longer.append([*chain, after])
            chains = longer
        return None

    def _is_lane_change(self, before: int, after: int) -> bool:
        """Whether the lanes, or those next to them along their lines, lie side by side."""
        behind = self._next.get(before)
        ahead = self._last.get(after)
        pairs = ((before, after), (behind, after), (before, ahead))
        return any(
            lane is not None
            and next_lane is not None
            and are_beside(self._lanes[lane], self._lanes[next_lane])
            for lane, next_lane in pairs
        )

    def _departure(self, stays: Sequence[Stay], stay: Stay) -> _Place:
        """Where the path last went along its lane, or the one that this lane follows."""
        earlier = [
            other for other in stays if other.last < stay.first and other.lane == self._last.get(stay.lane)
        ]
        for followed in [stay, *earlier[-1:]]:
            for point in range(followed.last, followed.first - 1, -1):
                place, angle_rad = self._place(followed, point)
                if angle_rad < _DEPARTED_RAD:
                    return place
        return self._place(stay, stay.first)[0]

    def _arrival(self, stays: Sequence[Stay], stay: Stay) -> _Place:
        """Where the path first went along its lane, or the one that follows this lane."""
        later = [
            other for other in stays if other.first > stay.last and other.lane == self._next.get(stay.lane)
        ]
        for followed in [stay, *later[:1]]:
            for point in range(followed.first, followed.last + 1):
                place, angle_rad = self._place(followed, point)
                if angle_rad < _DEPARTED_RAD:
                    return place
        return self._place(stay, stay.last)[0]

    def _place(self, stay: Stay, point: int) -> tuple[_Place, float]:
        path = self._paths[stay.path]
        shape = self._shapes[stay.lane]
        (nearest,) = shape.nearest(path.points_map[None, point])
        (angle_rad,) = angle_between(shape.ahead[None, nearest], path.ahead[None, point])
        return _Place(stay.lane, float(shape.at_m[nearest]), point), abs(float(angle_rad))

    def _end(self, place: _Place, result: DrivenWays) -> int:
        """The lane whose end is where a path left lanes; asks for a cut where none is."""
        shape = self._shapes[place.lane]
        left_m = shape.length_m - place.at_m
        before = self._last.get(place.lane)
        if before is not None and place.at_m < left_m and place.at_m <= _SNAP_M:
            return before
        if left_m > _SNAP_M:
            result.cuts.append(self._cut(place))
        return place.lane

    def _start(self, place: _Place, result: DrivenWays) -> int:
        """The lane whose start is where a path entered lanes; asks for a cut where none is."""
        shape = self._shapes[place.lane]
        left_m = shape.length_m - place.at_m
        after = self._next.get(place.lane)
        if after is not None and left_m < place.at_m and left_m <= _SNAP_M:
            return after
        if place.at_m > _SNAP_M:
            result.cuts.append(self._cut(place))
        return place.lane

    def _cut(self, place: _Place) -> Cut:
        shape = self._shapes[place.lane]
        middle = shape.centre[int(np.argmin(np.abs(shape.at_m - place.at_m)))]
        nearest = int(np.argmin(((shape.left - middle) ** 2).sum(axis=1)))
        return shape.lane.left.line, int(shape.lane.left.order[nearest])

    def _way(self, before: Stay, after: Stay, left: int, entered: int) -> Way | None:
        """The stretch of a path beside the end of one lane and then the start of another."""
        points = self._paths[before.path].points_map
        reach = int(2 * _SNAP_M / STEP_M)
        low = max(before.last - reach, 0)
        high = min(after.first + reach, len(points) - 1)
        ends = np.stack([self._shapes[left].centre[-1], self._shapes[entered].centre[0]])
        apart_m = np.linalg.norm(points[low : high + 1, None] - ends, axis=2)
        first, last = (low + int(k) for k in np.argmin(apart_m, axis=0))
        if last <= first:
            return None
        off_m = float(apart_m.min(axis=0).sum())
        return Way(left, entered, before.path, first, last, off_m)


def are_beside(first: ClosedLane, second: ClosedLane) -> bool:
    """Whether two lanes of the same direction lie on either side of one stretch of a line."""
    return _share(first.left, second.right) or _share(first.right, second.left)


def _share(first: Bound, second: Bound) -> bool:
    if first.line != second.line or (first.order[-1] > first.order[0]) != (
        second.order[-1] > second.order[0]
    ):
        return False
    return bool(min(first.order.max(), second.order.max()) > max(first.order.min(), second.order.min()))
