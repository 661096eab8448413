"""A port whose paint was moved, removed and added since it was laid out, fewer where there is no room."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from unittest.mock import patch

import numpy as np

from v2hdm.records import DIAMOND, LANE_DASH, FloatArray, Marking
from v2hdm.simulate.port.config import PaintConfig
from v2hdm.simulate.port.paint import _DIAMOND, Layout, build_layout
from v2hdm.simulate.port.route import Route
from v2hdm.simulate.render.scene import placed

_STREAM = 6  # of a port's random numbers
_MOVED_BY_M = (0.1, 1.0)  # the least and the largest distance, with even steps between them
_TURNED_SIGMA_RAD = 0.03  # by how much what is moved is turned as well
_BESIDE_ROUTE_M = 4.5  # only paint this near to the route is altered: a vehicle sees it from everywhere
_CLEAR_M = 2.6  # distance of an altered marking from all other altered ones, before and after, m
_FREE_M = 1.3  # distance of new paint's centre from other paint, m
_TRIES = 4000


@dataclass(frozen=True)
class Alteration:
    """One marking: its corners (4, 2) before, None for an added one, and after, None for a removed one."""

    kind: str
    before: FloatArray | None
    after: FloatArray | None


@contextmanager
def altered(count: int, seed: int) -> Iterator[list[Alteration]]:
    """Within, ports of this process have so many markings moved, removed and added; these are listed."""
    alterations: list[Alteration] = []

    def repainted(paint: PaintConfig, route: Route, rng: np.random.Generator) -> Layout:
        layout, again = build_layout(paint, route, rng), np.random.default_rng([seed, _STREAM])
        anew = _Alterer(layout, route, again, [])
        for length_m in np.linspace(*_MOVED_BY_M, count):
            anew.move(float(length_m), _TURNED_SIGMA_RAD)
        for _ in range(count):
            anew.remove()
        for _ in range(count):
            anew.add(_DIAMOND * (paint.diamond_length_m, paint.diamond_width_m))
        alterations[:] = anew.done
        return _painted(layout, anew.done, again)

    with patch("v2hdm.simulate.port.build.build_layout", repainted):
        yield alterations


@dataclass
class _Alterer:
    layout: Layout
    route: Route
    rng: np.random.Generator
    done: list[Alteration]

    def move(self, length_m: float, turned_sigma_rad: float) -> None:
        """Shift a diamond by a distance and turn it a little."""
        for _ in range(_TRIES):
            before = self._any(DIAMOND)
            if before is None:
                continue
            angle, turn = self.rng.uniform(0, 2 * np.pi), self.rng.normal(0.0, turned_sigma_rad)
            centre = before.mean(axis=0)
            shift = length_m * np.array([np.cos(angle), np.sin(angle)])
            after = placed(before - centre, centre, turn) + shift
            if self._is_clear(after, before):
                self.done.append(Alteration(DIAMOND, before, after))
                return

    def remove(self) -> None:
        """Remove a diamond or a dash."""
        for _ in range(_TRIES):
            before = self._any(DIAMOND, LANE_DASH)
            if before is not None:
                kind = next(marking.kind for marking in self.layout.markings if marking.corners_map is before)
                self.done.append(Alteration(kind, before, None))
                return

    def add(self, half: FloatArray) -> None:
        """Add a diamond beside the route where there is room."""
        route, rng = self.route, self.rng
        for _ in range(_TRIES):
            station = rng.uniform(8.0, route.length_m - 8.0)
            offset_m = rng.uniform(-_BESIDE_ROUTE_M, _BESIDE_ROUTE_M)
            after = placed(half, *route.pose_at(station, offset_m))
            if self._is_apart(after) and self._is_clear(after, None):
                self.done.append(Alteration(DIAMOND, None, after))
                return

    def _any(self, *kinds: str) -> FloatArray | None:
        """Corners of a marking drawn at random; None where it is off the route or near an altered one."""
        of_kinds = [marking.corners_map for marking in self.layout.markings if marking.kind in kinds]
        corners = of_kinds[int(self.rng.integers(len(of_kinds)))]
        beside = float(self.route.distance_to(corners.mean(axis=0)[None])[0]) <= _BESIDE_ROUTE_M
        return corners if beside and self._is_apart(corners) else None

    def _is_apart(self, corners: FloatArray) -> bool:
        centre = corners.mean(axis=0)
        others = [
            outline
            for alteration in self.done
            for outline in (alteration.before, alteration.after)
            if outline is not None
        ]
        return all(np.linalg.norm(centre - other.mean(axis=0)) > _CLEAR_M for other in others)

    def _is_clear(self, corners: FloatArray, itself: FloatArray | None) -> bool:
        """Whether new paint keeps clear of all other."""
        centre = corners.mean(axis=0)
        others = [paint.polygon_map for paint in self.layout.paints if paint.polygon_map is not itself]
        lines = [lane.points_map for lane in self.layout.lanes]
        nearest = min(float(np.linalg.norm(points - centre, axis=1).min()) for points in [*others, *lines])
        return nearest > _FREE_M - (0.0 if itself is None else 0.3)


def _painted(layout: Layout, alterations: list[Alteration], rng: np.random.Generator) -> Layout:
    now = {
        id(alteration.before): alteration.after for alteration in alterations if alteration.before is not None
    }
    paints, markings = [], []
    for paint in layout.paints:
        if (polygon := now.get(id(paint.polygon_map), paint.polygon_map)) is not None:
            paints.append(replace(paint, polygon_map=polygon))
    for marking in layout.markings:
        if (corners := now.get(id(marking.corners_map), marking.corners_map)) is not None:
            markings.append(replace(marking, corners_map=corners))
    like = next((paint for paint in layout.paints if paint.kind == DIAMOND), None)
    for alteration in alterations:
        if alteration.before is None and alteration.after is not None and like is not None:
            seed = int(rng.integers(1 << 30))
            paints.append(replace(like, polygon_map=alteration.after, wear=0.05, dirt=0.05, seed=seed))
            markings.append(Marking(DIAMOND, alteration.after, 0))
    return Layout(paints, markings, layout.lanes, layout.occupied_map)
