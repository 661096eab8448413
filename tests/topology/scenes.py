"""True connections in the made site of ``examples/lanes``: a crossing, and a T with turn lanes."""

from __future__ import annotations

import numpy as np

from examples.lanes.site import (
    DOWN,
    EAST,
    NORTH,
    SOUTH,
    TURN_LANE,
    UP,
    UP_LEFT,
    UP_RIGHT,
    WEST,
)

ENDS = {
    "west in": (-10, EAST), "west out": (-10, WEST), "east in": (10, WEST), "east out": (10, EAST),
    "south in": (NORTH, -10), "south out": (SOUTH, -10), "north in": (SOUTH, 10), "north out": (NORTH, 10),
    "T west in": (92, EAST), "T turn in": (92, TURN_LANE), "T west out": (92, WEST),
    "T east in": (108, WEST), "T east out": (108, EAST),
    "minor out": (DOWN, -16), "minor left in": (UP_LEFT, -16), "minor right in": (UP_RIGHT, -16),
}  # fmt: skip
"""Where lanes truly end (in) and begin (out) at the crossing and at the T."""

CONNECTIONS = {
    ("west in", "east out"), ("east in", "west out"), ("south in", "north out"), ("north in", "south out"),
    ("west in", "north out"), ("west in", "south out"), ("north in", "east out"), ("east in", "south out"),
    ("T west in", "T east out"), ("T east in", "T west out"), ("T turn in", "minor out"),
    ("T east in", "minor out"), ("minor left in", "T west out"), ("minor right in", "T east out"),
}  # fmt: skip
"""The ways through the crossing and the T that were driven."""

UNDRIVEN = {
    ("south in", "east out"), ("south in", "west out"), ("north in", "west out"), ("east in", "north out"),
    ("T west in", "minor out"), ("T turn in", "T east out"),
    ("minor left in", "T east out"), ("minor right in", "T west out"),
}  # fmt: skip
"""The other ways that do not lead back."""

LANES = {
    ((-10, WEST), (-80, WEST)), ((-80, EAST), (-10, EAST)),
    ((92, WEST), (10, WEST)), ((10, EAST), (41.5, -2.5)), ((62, EAST), (92, EAST)),
    ((62, TURN_LANE), (92, TURN_LANE)), ((200, WEST), (108, WEST)), ((108, EAST), (200, EAST)),
    ((SOUTH, -10), (SOUTH, -80)), ((NORTH, -80), (NORTH, -10)),
    ((SOUTH, 80), (SOUTH, 10)), ((NORTH, 10), (NORTH, 80)),
    ((DOWN, -16), (DOWN, -100)), ((UP, -100), (100.7, -65.5)),
    ((UP_LEFT, -48), (UP_LEFT, -16)), ((UP_RIGHT, -48), (UP_RIGHT, -16)),
}  # fmt: skip
"""Where each lane between two lines truly starts and ends."""

SPLITS = {
    ((41.5, -2.5), (62, EAST)), ((41.5, -2.5), (62, TURN_LANE)),
    ((100.7, -65.5), (UP_LEFT, -48)), ((100.7, -65.5), (UP_RIGHT, -48)),
}  # fmt: skip
"""Where a lane truly splits in two."""

WAYS = {(ENDS[before], ENDS[after]) for before, after in CONNECTIONS} | SPLITS
"""All ways from lane to lane."""
NEAR_M = 2.5  # distance, m, within which an end of a lane is that of a true one: less than a lane's width


def lanes_of(graph) -> list:
    """The starts and ends of the lanes outside junctions, those in a row as one."""
    ends = []
    for number, lane in enumerate(graph.lanes):
        outside_before = [k for k in graph.before(number) if not graph.lanes[k].is_connecting]
        if lane.is_connecting or outside_before:
            continue
        last = number
        while after := [k for k in graph.after(last) if not graph.lanes[k].is_connecting]:
            (last,) = after
        ends.append((lane.centre_map[0], graph.lanes[last].centre_map[-1]))
    return ends


def ways_of(graph) -> list:
    """The ends and starts between which lanes of junctions lead, those in a row as one."""
    ways = []
    for number, lane in enumerate(graph.lanes):
        if not lane.is_connecting or any(graph.lanes[k].is_connecting for k in graph.before(number)):
            continue
        pending = [number]
        while pending:
            last = pending.pop()
            inner = [k for k in graph.after(last) if graph.lanes[k].is_connecting]
            pending += inner
            if not inner:
                ways.append((lane.centre_map[0], graph.lanes[last].centre_map[-1]))
    return ways


def matched(ends: list, truth: set) -> set:
    """The true pairs of places that the pairs are, None for one that is none of them."""
    return {
        next((pair for pair in truth if np.linalg.norm(np.array(pair) - got, axis=1).max() < NEAR_M), None)
        for got in ends
    }
