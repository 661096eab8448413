"""Signs of a port: words, bay numbers, hatched areas, crosswalks, double lines, on ground that is free.

They are drawn from a stream of their own and come last: all else of a port is the same with and without them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import clip_convex
from v2hdm.records import (
    BOX,
    CROSSWALK,
    CROSSWALK_BAR,
    DOUBLE_LINE,
    LANE_DASH,
    LANE_LINE,
    TEXT,
    FloatArray,
    Lane,
    Marking,
    Symbol,
)
from v2hdm.simulate.port.config import PaintConfig
from v2hdm.simulate.port.paint import Layout, around
from v2hdm.simulate.port.route import Place, Route
from v2hdm.simulate.render.letters import Hand, stroke, word
from v2hdm.simulate.render.scene import RECTANGLE, WHITE_PAINT, YELLOW_PAINT, Bgr, Paint, placed

_TRIES = 400  # number of places that are tried for a sign
_CLEAR_M = 0.35  # least ground between a sign and all else, m, chosen
_BESIDE_M = 0.1  # least ground between the lines of a double line, m: national rules have 0.1 to 0.2
_REACH_M = 5.0  # largest offset of a sign's middle from the route, m
_FROM_ENDS_M = 8.0  # distance of signs from the ends of the route, m
_STRAIGHT_RAD = 0.02  # largest turn of the route along a sign, rad
_HAND = Hand(stretch=1.5)  # level strokes 1.5 times as thick as upright ones: drawn out along the way, chosen
_STEP_M = 0.5  # distance between the vertices of a lane, m


class _Sign(NamedTuple):
    """The class of a sign's paint, and its convex parts (N, 2) and outline (4, 2) about its middle, m."""

    kind: str
    parts: list[FloatArray]
    outline: FloatArray


class _Ground:
    """The ground of things and paint that are there already, as convex polygons (N, 2)."""

    def __init__(self, polygons: Sequence[FloatArray]) -> None:
        self._polygons: list[FloatArray] = []
        self._discs = np.empty((0, 3))  # middles and radii
        self.take(polygons)

    def take(self, polygons: Sequence[FloatArray]) -> None:
        """Keep more ground."""
        self._polygons += polygons
        self._discs = np.vstack([self._discs, *map(_disc, polygons)])

    def is_free(self, outline_map: FloatArray) -> bool:
        """Whether nothing lies on a convex outline (N, 2)."""
        x, y, radius = _disc(outline_map)
        away = np.hypot(self._discs[:, 0] - x, self._discs[:, 1] - y)
        neighbours = np.flatnonzero(away < self._discs[:, 2] + radius)
        return not any(len(clip_convex(self._polygons[k], outline_map)) > 2 for k in neighbours)


def _disc(polygon: FloatArray) -> FloatArray:
    """Middle and radius (3,) of a disc about a polygon (N, 2)."""
    middle = polygon.mean(axis=0)
    return np.array([*middle, np.linalg.norm(polygon - middle, axis=1).max()])


def add_signs(
    layout: Layout, config: PaintConfig, route: Route, footprints_map: Sequence[FloatArray],
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Paint the signs of ``config`` and enter them in the true map.

    Lettering that was painted before is entered, too: it is writing, though nobody can say what it reads.
    Where no free place is found after many tries, a sign is left out. ``footprints_map`` (N, 2) are of what
    stands.
    """
    ground = _Ground([paint.polygon_map for paint in layout.paints] + list(footprints_map))
    painter = _SignPainter(config, route, rng, layout, ground)
    layout.symbols += [Symbol(TEXT, outline, 0) for outline in layout.lettering]
    signs = config.signs
    for _ in range(signs.crosswalks):
        painter.crosswalk()
    for _ in range(signs.double_lines):
        painter.double_line()
    for text in signs.words:
        painter.writing(text, signs.word_height_m)
    for _ in range(signs.hatched):
        painter.hatched_area()
    for number in range(signs.first_number, signs.first_number + signs.numbers):
        painter.writing(str(number), signs.number_height_m)


@dataclass
class _SignPainter:
    config: PaintConfig
    route: Route
    rng: np.random.Generator
    layout: Layout
    ground: _Ground

    def writing(self, text: str, tall_m: float) -> None:
        """A word or number, upright for who drives the route."""
        strokes = list(word(text, tall_m, 0.4 * tall_m, 0.08 * tall_m, _HAND))
        sign = _about_middle(TEXT, strokes)
        place = self._free_place(sign.outline)
        if place is not None:
            self._paint(sign, place, WHITE_PAINT if self.rng.random() < 0.7 else YELLOW_PAINT)
            self.layout.texts[len(self.layout.symbols)] = text
            self._enter(TEXT, sign, place)

    def hatched_area(self) -> None:
        """A framed rectangle with lines across it, one or both ways."""
        rng = self.rng
        half = rng.uniform([0.9, 0.9], [1.2, 1.2])
        thick_m = float(rng.uniform(0.1, 0.15))
        outline = RECTANGLE * half
        parts = [
            stroke(start, end, thick_m) for start, end in zip(outline, np.roll(outline, -1, 0), strict=True)
        ]
        pitch_m = float(rng.uniform(0.5, 0.8))
        for yaw in (0.8, -0.8)[: int(rng.integers(1, 3))]:
            across = np.array([-np.sin(yaw), np.cos(yaw)])
            along = np.array([np.cos(yaw), np.sin(yaw)])
            reach_m = float(np.abs(outline @ across).max())
            for at in np.arange(-reach_m + pitch_m / 2, reach_m, pitch_m):
                line = stroke(at * across - 4 * along, at * across + 4 * along, thick_m)
                part = clip_convex(line, outline)
                parts += [part] if len(part) > 2 else []
        sign = _about_middle(BOX, parts)
        place = self._free_place(sign.outline)
        if place is not None:
            self._paint(sign, place, YELLOW_PAINT)
            self._enter(BOX, sign, place)

    def crosswalk(self) -> None:
        """Bars side by side across the way, between what is painted there."""
        bar = RECTANGLE[[2, 3, 0, 1]] * (1.1, 0.175)
        bars = [bar + np.array([0.0, left]) for left in (-1.05, -0.35, 0.35, 1.05)]
        sign = _about_middle(CROSSWALK_BAR, bars)
        place = self._free_place(sign.outline)
        if place is not None:
            self._paint(sign, place, WHITE_PAINT)
            self._enter(CROSSWALK, sign, place)
            for part in sign.parts:
                corners = placed(part, place.point_map, place.yaw_rad)
                self.layout.markings.append(Marking(CROSSWALK_BAR, corners, 0))

    def double_line(self) -> None:
        """A solid line beside a stretch of a line of the port."""
        config = self.config
        lines = [(LANE_LINE, offset) for offset in config.solid_offsets_m]
        lines += [(LANE_DASH, offset) for offset in config.dashed_offsets_m]
        width_m = config.line_width_m
        for _ in range(_TRIES if lines else 0):
            kind, offset_m = lines[int(self.rng.integers(len(lines)))]
            side = int(self.rng.choice([-1, 1]))
            apart_m = width_m + float(self.rng.uniform(0.12, 0.2))
            long_m = float(self.rng.uniform(15, 25))
            start_m = self.rng.uniform(_FROM_ENDS_M, max(self.route.length_m - long_m - _FROM_ENDS_M, 9))
            ends_m = np.array([start_m, start_m + long_m])
            if not self._is_straight(start_m, start_m + long_m):
                continue
            strip = self._strip(ends_m, offset_m + side * apart_m, width_m)
            if self.ground.is_free(self._strip(ends_m, offset_m + side * apart_m, width_m + 2 * _BESIDE_M)):
                sign = _Sign(LANE_LINE, [strip], strip)
                self._paint(sign, Place((0.0, 0.0), 0.0), WHITE_PAINT)
                self.ground.take([strip])
                at_m = np.arange(start_m, start_m + long_m, _STEP_M)
                middle = self.route.points_at(at_m, offset_m + side * apart_m / 2)
                kinds = (LANE_LINE, kind) if side > 0 else (kind, LANE_LINE)
                self.layout.lanes.append(Lane(DOUBLE_LINE, middle, 0, lines=kinds, apart_m=apart_m))
                return

    def _strip(self, ends_m: FloatArray, offset_m: float, width_m: float) -> FloatArray:
        """A straight line (4, 2) between two stations."""
        right = self.route.points_at(ends_m, offset_m - width_m / 2)
        left = self.route.points_at(ends_m, offset_m + width_m / 2)
        return np.array([right[0], right[1], left[1], left[0]])

    def _is_straight(self, start_m: float, end_m: float) -> bool:
        return float(np.ptp(self.route.yaw_at(np.linspace(start_m, end_m, 9)))) < _STRAIGHT_RAD

    def _free_place(self, outline: FloatArray) -> Place | None:
        """A place near the route, by chance, where nothing is on an outline (4, 2) or close to it."""
        route = self.route
        clear = outline + _CLEAR_M * np.sign(outline)
        for _ in range(_TRIES):
            at_m = float(self.rng.uniform(_FROM_ENDS_M, max(route.length_m - _FROM_ENDS_M, _FROM_ENDS_M + 1)))
            offset_m = float(self.rng.uniform(-_REACH_M, _REACH_M))
            place = route.pose_at(at_m, offset_m)
            beside = float(route.distance_to(np.array([place.point_map]))[0]) >= abs(offset_m) - 0.5
            if beside and self.ground.is_free(placed(clear, place.point_map, place.yaw_rad)):
                return place
        return None

    def _paint(self, sign: _Sign, place: Place, colour: Bgr) -> None:
        """Paint the parts, as worn as other markings are."""
        wear, dirt = np.minimum(
            np.array([self.config.wear, self.config.dirt]) * self.rng.gamma(2.0, 0.5, 2), (0.4, 0.7)
        )
        seed = int(self.rng.integers(1 << 30))
        self.layout.paints += [
            Paint(
                kind=sign.kind,
                polygon_map=placed(part, place.point_map, place.yaw_rad),
                albedo_bgr=colour,
                wear=float(wear),
                dirt=float(dirt),
                seed=seed,
            )
            for part in sign.parts
        ]

    def _enter(self, kind: str, sign: _Sign, place: Place) -> None:
        """Enter a sign in the true map and keep its ground."""
        outline_map = placed(sign.outline, place.point_map, place.yaw_rad)
        self.ground.take([outline_map])
        self.layout.symbols.append(Symbol(kind, outline_map, 0))


def _about_middle(kind: str, parts: Sequence[FloatArray]) -> _Sign:
    """A sign about the middle of its outline."""
    outline = around(parts)
    middle = outline.mean(axis=0)
    return _Sign(kind, [part - middle for part in parts], outline - middle)
