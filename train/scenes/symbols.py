"""Paint laid on a road that is there: hollow diamonds, words, stop lines that meet lines of lanes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from train.scenes.letters import WORDS, word
from train.scenes.paint import Bend, Brush, RoadPaint, rectangle, rhombus
from v2hdm.geometry.planar import clip_convex, inside_convex
from v2hdm.records import DIAMOND, LANE_DASH, LANE_LINE, OTHER_PAINT, STOP_LINE, FloatArray
from v2hdm.simulate.render.scene import Paint

_ACROSS_M = 9.0  # distance to either side, m, within which lines meet a stop line
_LANE_M = (2.2, 4.2)
"""Width of what counts as a lane between two lines."""


def hollow_diamond(
    brush: Brush, rng: np.random.Generator, corners_map: FloatArray, stroke_m: float
) -> list[Paint]:
    """The outline of a diamond (4, 2), labelled as a whole one: its middle is paint that has all gone.

    So are those of photographs, whose labels follow the outer edge.
    """
    centre = corners_map.mean(axis=0)
    away = np.linalg.norm(corners_map - centre, axis=1)
    inner_radius_m = away[0] * away[1] / np.hypot(away[0], away[1])
    inner = centre + (corners_map - centre) * max(1 - stroke_m / inner_radius_m, 0.2)
    gone = Paint(kind=DIAMOND, polygon_map=corners_map, wear=1.0, seed=int(rng.integers(1 << 30)))
    sides = zip(corners_map, np.roll(corners_map, -1, 0), np.roll(inner, -1, 0), inner, strict=True)
    return [gone, *(brush.paint(rng, DIAMOND, np.array(side)) for side in sides)]


def with_hollow(
    rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend, share: float
) -> RoadPaint:
    """This road, or in a ``share`` of cases with outlines of diamonds: its own, or else some in a lane."""
    if rng.random() >= share:
        return road
    stroke_m = rng.uniform(0.08, 0.32)
    diamonds = [paint.polygon_map for paint in road.paints if paint.kind == DIAMOND]
    if diamonds:
        others = [paint for paint in road.paints if paint.kind != DIAMOND]
        hollow = [part for shape in diamonds for part in hollow_diamond(brush, rng, shape, stroke_m)]
        return RoadPaint(others + hollow, road.lanes)
    length_m = rng.uniform(1.4, 4.0)
    wide_m = rng.uniform(0.7, 1.7)
    start_m = rng.uniform(3, 12)
    pitch_m = rng.uniform(length_m + 2, 30)
    for along in np.arange(start_m, 30, pitch_m):
        for middle, _ in _some_lanes(rng, road, bend, float(along)):
            ground = _placed(bend, along, middle, rectangle(np.zeros(2), length_m + 0.4, wide_m + 0.4))
            shape = _placed(bend, along, middle, rhombus(np.zeros(2), length_m, wide_m))
            road = laid(road, hollow_diamond(brush, rng, shape, stroke_m), ground)
    return road


def with_words(
    rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend, share: float
) -> RoadPaint:
    """This road, or in a ``share`` of cases with a hatched box or words, half of them turned round."""
    if rng.random() >= share:
        return road
    if rng.random() < 0.25:
        return _hatched_box(rng, road, brush, bend)
    text = str(rng.choice(WORDS))
    turn = rng.choice([-1, 1])
    letters = max(len(part) for part in text.split())
    tall_m = rng.uniform(1.2, 4.5)
    along = float(np.exp(rng.uniform(np.log(3), np.log(18))))
    for middle, lane_m in _some_lanes(rng, road, bend, along):
        wide_m = min(rng.uniform(0.4, 0.9), 0.62 * lane_m / letters)
        strokes = list(word(text, tall_m, wide_m, rng.uniform(0.14, 0.3) * wide_m + 0.03))
        points = np.vstack(strokes)
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        ground = _placed(bend, along, middle, rectangle(np.zeros(2), *(np.ptp(points, axis=0) + 0.3)))
        placed = (_placed(bend, along, middle, turn * (stroke - centre)) for stroke in strokes)
        road = laid(road, [brush.paint(rng, OTHER_PAINT, stroke) for stroke in placed], ground)
    return road


def _hatched_box(rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend) -> RoadPaint:
    """This road with a box to be kept clear: its frame, and lines across it one or both ways."""
    along = float(np.exp(rng.uniform(np.log(4), np.log(20))))
    left = float(rng.uniform(-3, 3))
    long_m = rng.uniform(2, 9)
    wide_m = rng.uniform(2, 7)
    thick_m = rng.uniform(0.1, 0.22)
    box = rectangle(np.zeros(2), long_m, wide_m)
    shapes = [rectangle(np.array([end * long_m / 2, 0.0]), thick_m, wide_m + thick_m) for end in (-1, 1)]
    shapes += [rectangle(np.array([0.0, side * wide_m / 2]), long_m + thick_m, thick_m) for side in (-1, 1)]
    lean = rng.uniform(0.5, 1.1)
    pitch_m = rng.uniform(0.7, 2.0)
    for yaw in (lean, -lean)[: int(rng.integers(1, 3))]:
        for at in np.arange(-long_m, long_m, pitch_m):
            bar = clip_convex(rectangle(np.array([at, 0.0]), 2 * (long_m + wide_m), thick_m, yaw), box)
            shapes += [bar] if len(bar) > 2 else []
    paints = [brush.paint(rng, OTHER_PAINT, _placed(bend, along, left, shape)) for shape in shapes]
    return laid(road, paints, _placed(bend, along, left, box))


def with_crossing(
    rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend, share: float
) -> RoadPaint:
    """This road, or in a ``share`` of cases with a stop line from one line of a lane to another.

    It ends at their outer or inner edges, or beyond. Before it dashes may become solid.
    """
    if rng.random() >= share:
        return road
    along = float(np.exp(rng.uniform(np.log(4), np.log(24))))
    lines = lines_across(road.lanes, bend, along)
    if len(lines) < 2:
        return road
    first = int(rng.integers(len(lines) - 1))
    last = int(rng.integers(first + 1, len(lines)))
    thick_m = rng.uniform(0.2, 0.65)
    over_m = rng.choice([0.0, rng.normal(0, 0.15), rng.uniform(0, 1.5)])
    low = lines[first] - over_m
    high = lines[last] + over_m
    if high - low < 1:
        return road
    paints = list(road.paints)
    solid_m = rng.uniform(4, 20)
    wide_m = rng.uniform(0.1, 0.22)
    if rng.random() < 0.5:
        for left in lines[first : last + 1]:
            paints += _solid_before(rng, paints, brush, bend, along, float(left), solid_m, wide_m)
    bar = rectangle(np.array([0.0, (low + high) / 2]), thick_m, high - low)
    paints.append(brush.paint(rng, STOP_LINE, _placed(bend, along, 0.0, bar)))
    return RoadPaint(paints, road.lanes)


def _solid_before(
    rng: np.random.Generator, paints: Sequence[Paint], brush: Brush, bend: Bend, along: float, left: float,
    solid_m: float, wide_m: float,
) -> list[Paint]:  # fmt: skip
    """A solid line in the place of the dashes of a line before a stop line; none where there are none."""
    strip = np.array([[-solid_m, -wide_m / 2], [0, -wide_m / 2], [0, wide_m / 2], [-solid_m, wide_m / 2]])
    ground = _placed(bend, along, left, strip * (1, 2))
    if bend.curvature or not any(
        paint.kind == LANE_DASH and inside_convex(ground, paint.polygon_map.mean(axis=0)[None]).any()
        for paint in paints
    ):
        return []
    return [brush.paint(rng, LANE_LINE, _placed(bend, along, left, strip))]


def lines_across(lanes_map: Iterable[FloatArray], bend: Bend, along: float) -> FloatArray:
    """How far left of the way, in order, lines (N, 2, map) pass a place along it, m."""
    heading = float(bend.heading(along))
    ahead = np.array([np.cos(heading), np.sin(heading)])
    left = np.array([-np.sin(heading), np.cos(heading)])
    origin = bend.to_map(np.array([along, 0.0]))
    passed = []
    for lane in lanes_map:
        before = (lane - origin) @ ahead
        beside = (lane - origin) @ left
        crossings = np.flatnonzero((np.diff(np.sign(before)) != 0) & (np.abs(beside[:-1]) < _ACROSS_M))
        passed += [float(beside[crossings[0]])] if len(crossings) else []
    return np.sort(np.array(passed))


def _some_lanes(
    rng: np.random.Generator, road: RoadPaint, bend: Bend, along: float
) -> list[tuple[float, float]]:
    """Middle and width, m, of some of the lanes at a place, or of one anywhere where there are none."""
    lines = lines_across(road.lanes, bend, along)
    lanes = [(float(a + b) / 2, float(b - a)) for a, b in pairwise(lines) if _LANE_M[0] < b - a < _LANE_M[1]]
    chosen = [lane for lane in lanes if rng.random() < 0.6]
    return chosen or [(float(rng.uniform(-3, 3)), 3.2)]


def _placed(bend: Bend, along: float, left: float, shape: FloatArray) -> FloatArray:
    """A shape (N, 2) in the map, its origin at a place of the way and its first axis along it."""
    heading = float(bend.heading(along))
    cos = np.cos(heading)
    sin = np.sin(heading)
    centre = bend.to_map(np.array([along, left]))
    return np.asarray(centre + shape @ np.array([[cos, sin], [-sin, cos]]))


def laid(road: RoadPaint, paints: Sequence[Paint], ground_map: FloatArray) -> RoadPaint:
    """This road with other paint, in place of what had its middle on a convex piece of ground (N, 2)."""
    middles = np.array([paint.polygon_map.mean(axis=0) for paint in road.paints]).reshape(-1, 2)
    is_inside = inside_convex(ground_map, middles)
    others = [paint for paint, inside in zip(road.paints, is_inside, strict=True) if not inside]
    return RoadPaint([*others, *paints], road.lanes)
