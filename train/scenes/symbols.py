"""Paint laid on a road that is there: words, boxes, symbols, crosswalks, double lines, hollow diamonds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from train.scenes.areas import give_way, hatched_area, whole_crosswalk
from train.scenes.letters import CAPITALS, random_hand, random_text
from train.scenes.paint import Bend, Brush, RoadPaint, double_line, rectangle, rhombus
from train.scenes.signs import other_sign, user
from v2hdm.geometry.planar import inside_convex
from v2hdm.records import (
    BICYCLE,
    BOX,
    DIAMOND,
    LANE_DASH,
    LANE_LINE,
    OTHER_PAINT,
    STOP_LINE,
    TEXT,
    FloatArray,
)
from v2hdm.simulate.render.letters import Hand, word
from v2hdm.simulate.render.scene import WHITE_PAINT, YELLOW_PAINT, Paint, placed

_ACROSS_M = 9.0  # distance to either side, m, within which lines meet a stop line
_LANE_M = (2.2, 4.2)
"""Width of what counts as a lane between two lines."""

_DOUBLE_CLEAR_M = 1.0  # least distance of a double line from other lines, m
_SIGN_SHARE = 0.6  # share of all painted scenes that have a word, a box, a symbol or a give-way line


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
    """This road, or in a ``share`` of cases with words or numbers in lanes, half of them turned round."""
    if rng.random() >= share:
        return road
    text = random_text(rng)
    hand = random_hand(rng)
    turn = int(rng.choice([-1, 1]))
    letters = max(len(part) for part in text.split())
    tall_m = float(np.exp(rng.uniform(np.log(0.6), np.log(4.5))))
    broad = rng.uniform(0.4, 0.9) * min(1.0, 0.25 + tall_m / 2)
    along = float(np.exp(rng.uniform(np.log(3), np.log(22))))
    other_brush = _another(rng, brush)
    for middle, lane_m in _some_lanes(rng, road, bend, along):
        wide_m = min(broad, 0.62 * lane_m / letters)
        strokes, size_m = _written(rng, text, tall_m, wide_m, hand)
        ground = _placed(bend, along, middle, rectangle(np.zeros(2), *(size_m + 0.3)))
        parts = (_placed(bend, along, middle, turn * stroke) for stroke in strokes)
        road = laid(road, [other_brush.paint(rng, TEXT, part) for part in parts], ground)
    return road


def _written(
    rng: np.random.Generator, text: str, tall_m: float, wide_m: float, hand: Hand
) -> tuple[list[FloatArray], FloatArray]:
    """The strokes (4, 2) of words about their middle, and the length and width (2,) of them all, m."""
    return _about_middle(word(text, tall_m, wide_m, rng.uniform(0.13, 0.32) * wide_m + 0.02, hand))


def _about_middle(shapes: Iterable[FloatArray]) -> tuple[list[FloatArray], FloatArray]:
    """Shapes (N, 2) about the middle of them all, and their length and width (2,), m."""
    shapes = list(shapes)
    points = np.vstack(shapes)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return [shape - centre for shape in shapes], np.ptp(points, axis=0)


def _another(rng: np.random.Generator, brush: Brush) -> Brush:
    """A brush, or in a third of cases one of another colour in the same state."""
    if rng.random() < 0.67:
        return brush
    blue, green, red = (
        float(c)
        for c in np.array(YELLOW_PAINT if rng.random() < 0.6 else WHITE_PAINT) * rng.uniform(0.8, 1.1)
    )
    return replace(brush, albedo_bgr=(blue, green, red))


def with_bays(rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend, share: float) -> RoadPaint:
    """This road, or in a ``share`` of cases with the numbers of bays or slots in a row along the way.

    They are of one size and hand, near the way or in a lane, and face along it, against it, or aside.
    """
    if rng.random() >= share:
        return road
    hand = random_hand(rng)
    tall_m = float(rng.uniform(0.3, 1.6))
    wide_m = tall_m * float(rng.uniform(0.35, 0.7))
    pitch_m = float(rng.uniform(tall_m + 1.5, 7.0))
    left = float(rng.uniform(-7, 7))
    turn_rad = float(rng.choice([0.0, np.pi, np.pi / 2, -np.pi / 2], p=[0.35, 0.35, 0.15, 0.15]))
    first = int(np.exp(rng.uniform(0, np.log(900))))
    step = int(rng.choice([-2, -1, 1, 2]))
    prefix = "" if rng.random() < 0.6 else str(rng.choice(CAPITALS)) + str(rng.choice(["", "-"]))
    other_brush = _another(rng, brush)
    for k, along in enumerate(np.arange(rng.uniform(1.5, 8), 30, pitch_m)):
        strokes, size_m = _written(rng, f"{prefix}{abs(first + k * step)}", tall_m, wide_m, hand)
        centre = bend.to_map(np.array([along, left]))
        yaw = float(bend.heading(along)) + turn_rad + rng.normal(0, 0.02)
        ground = placed(rectangle(np.zeros(2), *(size_m + 0.3)), centre, yaw)
        shapes = [other_brush.paint(rng, TEXT, placed(stroke, centre, yaw)) for stroke in strokes]
        road = laid(road, shapes, ground)
    return road


def with_boxes(
    rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend, share: float
) -> RoadPaint:
    """This road, or in a ``share`` of cases with an area to be kept clear: framed, hatched, crossed."""
    if rng.random() >= share:
        return road
    shapes, outline = hatched_area(rng)
    along = float(np.exp(rng.uniform(np.log(4), np.log(24))))
    along = max(along, float(np.ptp(outline[:, 0])) / 2 - 1)
    left = float(rng.uniform(-5, 5))
    yellow = rng.random() < 0.6
    other_brush = replace(brush, albedo_bgr=YELLOW_PAINT) if yellow else _another(rng, brush)
    paints = [other_brush.paint(rng, BOX, _placed(bend, along, left, shape)) for shape in shapes]
    return laid(road, paints, _placed(bend, along, left, outline))


def with_users(
    rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend, share: float
) -> RoadPaint:
    """This road, or in a ``share`` of cases with symbols of who may go there: bicycles mostly."""
    return _with_shapes(rng, road, brush, bend, share, BICYCLE, user)


def with_other(
    rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend, share: float
) -> RoadPaint:
    """This road, or in a ``share`` of cases with paint that has no class of its own."""
    return _with_shapes(rng, road, brush, bend, share, OTHER_PAINT, other_sign)


def _with_shapes(
    rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend, share: float,
    kind: str, draw: Callable[[np.random.Generator], Iterable[FloatArray]],
) -> RoadPaint:  # fmt: skip
    if rng.random() >= share:
        return road
    along = float(np.exp(rng.uniform(np.log(2.5), np.log(16))))
    turn = int(rng.choice([-1, 1]))
    shapes, size_m = _about_middle(draw(rng))
    for middle, _ in _some_lanes(rng, road, bend, along):
        ground = _placed(bend, along, middle, rectangle(np.zeros(2), *(size_m + 0.3)))
        parts = (_placed(bend, along, middle, turn * shape) for shape in shapes)
        road = laid(road, [brush.paint(rng, kind, part) for part in parts], ground)
    return road


def with_give_way(
    rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend, share: float
) -> RoadPaint:
    """This road, or in a ``share`` of cases with a give-way line, which is labelled as a stop line."""
    if rng.random() >= share:
        return road
    along = float(np.exp(rng.uniform(np.log(4), np.log(28))))
    extent_m = float(rng.uniform(2.5, 10))
    left = float(rng.uniform(-7, 3))
    askew = np.array([[1.0, 0.0], [_lean(rng), 1.0]])
    shapes = [shape @ askew + np.array([0.0, left]) for shape in give_way(rng, extent_m)]
    paints = [brush.paint(rng, STOP_LINE, _placed(bend, along, 0.0, shape)) for shape in shapes]
    return RoadPaint([*road.paints, *paints], road.lanes)


def with_far_stop(
    rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend, share: float
) -> RoadPaint:
    """This road, or in a ``share`` of cases with a stop line far ahead, perhaps askew or in two steps."""
    if rng.random() >= share:
        return road
    along = float(rng.uniform(12, 40))
    lines = lines_across(road.lanes, bend, along)
    low = float(rng.uniform(-8, -0.5))
    high = low + float(rng.uniform(2.5, 11))
    if len(lines) > 1 and rng.random() < 0.6:
        low = float(lines[0])
        high = float(lines[-1])
    thick_m = float(rng.uniform(0.25, 0.75))
    askew = np.array([[1.0, 0.0], [_lean(rng), 1.0]])
    shapes = [rectangle(np.array([0.0, (low + high) / 2]), thick_m, high - low)]
    if rng.random() < 0.2:
        middle = rng.uniform(low, high)
        back_m = -rng.uniform(1, 5)
        shapes = [
            rectangle(np.array([0.0, (low + middle) / 2]), thick_m, middle - low),
            rectangle(np.array([back_m, (middle + high) / 2]), thick_m, high - middle),
        ]
    paints = [brush.paint(rng, STOP_LINE, _placed(bend, along, 0.0, shape @ askew)) for shape in shapes]
    return RoadPaint([*road.paints, *paints], road.lanes)


def _lean(rng: np.random.Generator) -> float:
    """How far ahead a line across the way is a metre to the left: not at all, mostly."""
    return float(rng.normal(0, 0.2) if rng.random() < 0.35 else 0.0)


def with_crosswalk(
    rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend, share: float
) -> RoadPaint:
    """This road, or in a ``share`` of cases with a whole crosswalk, in place of what was there."""
    if rng.random() >= share:
        return road
    along = float(np.exp(rng.uniform(np.log(4), np.log(35))))
    extent_m = float(rng.uniform(3, 14))
    left = float(rng.uniform(-9, 0))
    parts = [(kind, shape + np.array([0.0, left])) for kind, shape in whole_crosswalk(rng, extent_m)]
    long_m = max(float(np.abs(shape[:, 0]).max()) for _, shape in parts)
    ground = _placed(
        bend, along, 0.0, rectangle(np.array([0.0, left + extent_m / 2]), 2 * long_m + 1, extent_m + 1)
    )
    paints = [brush.paint(rng, kind, _placed(bend, along, 0.0, shape)) for kind, shape in parts]
    return laid(road, paints, ground)


def with_double(
    rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend, share: float
) -> RoadPaint:
    """This road, or in a ``share`` of cases with a double line, yellow half of the time, clear of others."""
    if rng.random() >= share:
        return road
    yellow = rng.random() < 0.5
    other_brush = replace(brush, albedo_bgr=YELLOW_PAINT) if yellow else brush
    lines = np.concatenate([lines_across(road.lanes, bend, along) for along in (2.0, 10.0, 20.0, 30.0)])
    places = rng.uniform(-5, 5, 12)
    free = [left for left in places if not len(lines) or np.abs(lines - left).min() > _DOUBLE_CLEAR_M]
    if not free:
        return road
    doubled = double_line(rng, other_brush, bend, float(free[0]))
    clear = [paint for paint in road.paints if not _is_on(paint, doubled.lanes[0])]
    return RoadPaint([*clear, *doubled.paints], [*road.lanes, *doubled.lanes])


def _is_on(paint: Paint, line_map: FloatArray) -> bool:
    """Whether the middle of a paint lies on a line (N, 2)."""
    return (
        float(np.linalg.norm(line_map - paint.polygon_map.mean(axis=0), axis=1).min()) < _DOUBLE_CLEAR_M / 2
    )


_SIGNS = (
    (0.2, with_words), (0.26, with_boxes), (0.26, with_users), (0.14, with_other), (0.14, with_give_way),
)  # fmt: skip


def with_sign(rng: np.random.Generator, road: RoadPaint, brush: Brush, bend: Bend) -> RoadPaint:
    """This road, mostly with a word, a box, a symbol or a give-way line."""
    if rng.random() >= _SIGN_SHARE:
        return road
    lay = _SIGNS[int(rng.choice(len(_SIGNS), p=[chance for chance, _ in _SIGNS]))][1]
    return lay(rng, road, brush, bend, 1.0)


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
    return placed(shape, bend.to_map(np.array([along, left])), float(bend.heading(along)))


def laid(road: RoadPaint, paints: Sequence[Paint], ground_map: FloatArray) -> RoadPaint:
    """This road with other paint, in place of what had its middle on a convex piece of ground (N, 2)."""
    middles = np.array([paint.polygon_map.mean(axis=0) for paint in road.paints]).reshape(-1, 2)
    is_inside = inside_convex(ground_map, middles)
    others = [paint for paint, inside in zip(road.paints, is_inside, strict=True) if not inside]
    return RoadPaint([*others, *paints], road.lanes)
