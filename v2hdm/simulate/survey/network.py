"""A network of streets and yards along one path, its paint, and the drives through it, there and back."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import cycle, pairwise

import numpy as np

from v2hdm.records import FloatArray, GeodeticOrigin, HDMap
from v2hdm.simulate.port.config import PaintConfig, PortConfig
from v2hdm.simulate.port.paint import Layout, build_layout
from v2hdm.simulate.port.route import Route, build_route

_Piece = list[float]  # length, m, and turn to the left, deg

_TURN_M = 24.0  # length of the path of a turn by 90 degrees, as in the shipped ports
# Pieces of a street, 320 m with a gentle bend in the middle, and of a yard's lane, straight; chosen.
_STREET: list[_Piece] = [[80.0, 0.0], [40.0, 6.0], [40.0, -12.0], [40.0, 6.0], [120.0, 0.0]]
_STREETS = 2  # streets of a block, one behind the other; even, so that a block ends where it began
_STREET_GAP_M = 36.0  # straight from turn to turn between two streets, which are 66 m apart
_YARD: list[_Piece] = [[90.0, 0.0]]  # see _STREET
_LANES = 4  # lanes of a block's yard; even, for the same reason
_YARD_GAP_M = 8.0  # straight from turn to turn between two lanes of a yard, which are 39 m apart

_STRETCH_M = 200.0  # least length of path that is painted by itself: time grows with its square
_CLEAR_M = 25.0  # straight path at least on both sides of where a stretch ends, so that no paint meets
_STRAIGHT_PER_M = 1e-9  # curvature below which the path is straight
_SPARSE = 3.0  # factor by which diamonds on streets are farther apart than in yards
_BESIDE_M = 0.8  # distance of the vehicle's way from the path: to the right there, to the left back

_PAINT = 7  # stream of a seed; a port's own are 0 to 6


@dataclass(frozen=True)
class Network:
    """A path through streets and yards with the true map of its paint."""

    path: Route
    hd_map: HDMap
    beside_m: float = _BESIDE_M  # distance of the vehicle's way to the right of the path

    def way(self, drive: int) -> Route:
        """The vehicle's way on a drive: even ones go there, odd ones back."""
        if drive % 2 == 0:
            return _beside(self.path, -self.beside_m)
        return _reversed(_beside(self.path, self.beside_m))


def build_network(config: PortConfig, origin: GeodeticOrigin | None) -> Network:
    """The network of a port's survey, the same from the same configuration."""
    length_m = 1000.0 * config.survey.length_km / config.survey.drives
    path = build_route(replace(config.route, pieces=_pieces(length_m)))
    whole = Layout()
    for number, (begin, end) in enumerate(pairwise(_ends(path))):
        stretch = _part(path, begin, end)
        paint = config.paint if _is_yard(stretch) else _of_street(config.paint)
        layout = build_layout(paint, stretch, np.random.default_rng([config.seed, _PAINT, number]))
        whole.markings += layout.markings
        whole.lanes += layout.lanes
    return Network(path, whole.hd_map(origin))


def _pieces(length_m: float) -> list[_Piece]:
    """Pieces of a path of at least ``length_m``: blocks of two streets and a yard, one behind the other."""
    pieces: list[_Piece] = []
    driven_m = 0.0
    for piece in _blocks():
        if driven_m >= length_m:
            break
        pieces.append(piece)
        driven_m += piece[0]
    # The path ends on a straight, whatever it ends in.
    return pieces if pieces[-1][1] == 0.0 else [*pieces, [_STREET_GAP_M, 0.0]]


def _blocks() -> Iterator[_Piece]:
    sides = cycle([90.0, -90.0])
    while True:
        for rows, row, gap_m in ((_STREETS, _STREET, _STREET_GAP_M), (_LANES, _YARD, _YARD_GAP_M)):
            for _ in range(rows):
                side = next(sides)
                yield from [*row, [_TURN_M, side], [gap_m, 0.0], [_TURN_M, side]]


def _ends(path: Route) -> list[int]:
    """Indices of the path at which stretches begin, and its last: amid straights."""
    step_m = path.length_m / (len(path.station_m) - 1)
    clear = round(_CLEAR_M / step_m)
    least = round(_STRETCH_M / step_m)
    bends = np.concatenate([[0], np.cumsum(np.abs(path.curvature) > _STRAIGHT_PER_M)])
    last = len(path.station_m) - 1
    ends = [0]
    for at in range(least, last - least, max(round(1.0 / step_m), 1)):
        if at - ends[-1] >= least and bends[at + clear] == bends[at - clear]:
            ends.append(at)
    return [*ends, last]


def _part(path: Route, begin: int, end: int) -> Route:
    """A stretch of a path as a route of its own."""
    rows = slice(begin, end + 1)
    return replace(
        path,
        station_m=path.station_m[rows] - path.station_m[begin],
        points_map=path.points_map[rows],
        yaw_rad=path.yaw_rad[rows],
        curvature=path.curvature[rows],
    )


def _is_yard(stretch: Route) -> bool:
    """Whether a stretch turns as often as the lanes of a yard do."""
    turned_rad = float(np.abs(np.diff(stretch.yaw_rad)).sum())
    street_rad = np.pi / (sum(length for length, _ in _STREET) + _STREET_GAP_M)
    return turned_rad / stretch.length_m > 1.5 * street_rad


def _of_street(paint: PaintConfig) -> PaintConfig:
    """The paint of a street: that of a yard without its fields, and with fewer diamonds."""
    return replace(paint, field_offsets_m=[], diamond_spacing_m=_SPARSE * paint.diamond_spacing_m)


def _beside(path: Route, offset_m: float) -> Route:
    """The way ``offset_m`` to the left of a path, with the lengths of its own."""
    points_map = path.points_at(path.station_m, offset_m)
    steps_m = np.linalg.norm(np.diff(points_map, axis=0), axis=1)
    station_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    curvature = path.curvature / (1 - offset_m * path.curvature)
    return replace(path, station_m=station_m, points_map=points_map, curvature=curvature)


def _reversed(way: Route) -> Route:
    """A way from its end to its beginning."""
    back: FloatArray = way.station_m[-1] - way.station_m[::-1]
    return replace(
        way,
        station_m=back,
        points_map=way.points_map[::-1],
        yaw_rad=way.yaw_rad[::-1] + np.pi,
        curvature=-way.curvature[::-1],
    )
