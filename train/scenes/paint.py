"""Random road paint for training: lanes along a gently bent street, fields of diamonds, everything else.

Layouts run along +x from the origin, where the camera is; a :class:`Bend` turns them into the map.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from v2hdm.records import (
    ARROW,
    CHEVRON,
    CROSSWALK_BAR,
    DIAMOND,
    LANE_DASH,
    LANE_LINE,
    STOP_LINE,
    TEXT,
    FloatArray,
)
from v2hdm.simulate.render.scene import WHITE_PAINT, YELLOW_PAINT, Bgr, Paint

FAR_M = 50.0  # distance ahead to which lines are painted, m
_DIAMONDS_FAR_M = 32.0  # distance ahead to which fields of diamonds reach, m
_NEAR_M = -4.0  # distance ahead from which the ground is painted, m
_LANE_STEP_M = 0.5  # distance between the points of a lane's line, m
_PASSING_M = 3.0
"""Over such a length a curve drawn by hand passes from two strands to the one that goes on."""

_LEAST_APART_M = 0.75
"""Strands nearer than this are those of one line to whoever drives or labels."""

_PIECE_M = 2.5  # largest length of a straight piece of a bent line, m
_PIECE_BESIDE_M = 0.02  # largest distance of a straight piece from the bend, m


@dataclass(frozen=True)
class Bend:
    """A way through the origin along +x that bends by ``curvature``, in 1/m, positive to the left.

    It is a circular arc, or one from ``begins_m`` to ``ends_m`` along the way and straight before and after.
    """

    curvature: float
    begins_m: float = -np.inf
    ends_m: float = np.inf

    def heading(self, along: FloatArray | float) -> FloatArray:
        """Direction of the way (...), rad to the left of +x, at distances along it."""
        return np.asarray(self.curvature * self._on_arc(along))

    def to_map(self, points: FloatArray) -> FloatArray:
        """Points (..., 2) as (distance along the way, offset to the left of it) in the map."""
        along = points[..., 0]
        left = points[..., 1]
        on_arc = self._on_arc(along)
        angle = self.heading(along)
        straight = along - on_arc - self._first_m
        x = self._first_m + on_arc * np.sinc(angle / np.pi) + straight * np.cos(angle) - left * np.sin(angle)
        y = on_arc * np.sinc(angle / (2 * np.pi)) * np.sin(angle / 2) + straight * np.sin(angle)
        return np.stack([x, y + left * np.cos(angle)], axis=-1)

    @property
    def _first_m(self) -> float:
        """Where along the way the arc begins as seen from the origin, which may lie on it."""
        return max(self.begins_m, 0.0)

    def _on_arc(self, along: FloatArray | float) -> FloatArray:
        """How much of the way from where the arc begins is arc, m; negative behind the origin."""
        return np.asarray(np.clip(along, self.begins_m, self.ends_m) - self._first_m)


@dataclass(frozen=True)
class Brush:
    """The paint of one scene: its colour and the state it is in."""

    albedo_bgr: Bgr
    wear: float
    dirt: float

    def paint(self, rng: np.random.Generator, kind: str, polygon_map: FloatArray) -> Paint:
        """One piece; wear differs from piece to piece."""
        wear = float(np.clip(self.wear * np.exp(rng.normal(0, 0.5)), 0, 0.62))
        dirt = float(np.clip(self.dirt * np.exp(rng.normal(0, 0.3)), 0, 0.6))
        return Paint(
            kind=kind,
            polygon_map=polygon_map,
            albedo_bgr=self.albedo_bgr,
            wear=wear,
            dirt=dirt,
            seed=int(rng.integers(1 << 30)),
        )


def random_brush(rng: np.random.Generator, difficulty: float) -> Brush:
    """White or yellow paint, the more worn and dirty the higher ``difficulty`` (0 to 1) is."""
    colour = np.array(WHITE_PAINT if rng.random() < 0.82 else YELLOW_PAINT)
    colour = colour * rng.uniform(0.78, 1.15) * np.exp(rng.normal(0, 0.03, 3))
    worn = difficulty * rng.beta(1.2, 3.0)
    return Brush(tuple(float(c) for c in colour), float(0.6 * worn), float(rng.uniform(0, 0.45) * difficulty))  # type: ignore[arg-type]


def rectangle(centre: FloatArray, length: float, width: float, yaw_rad: float = 0.0) -> FloatArray:
    """Corners (4, 2) of a rectangle, counter-clockwise."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (length / 2, width / 2)
    return _turned(corners, yaw_rad) + centre


def rhombus(centre: FloatArray, length: float, width: float, yaw_rad: float = 0.0) -> FloatArray:
    """Corners (4, 2) of a diamond with the diagonals ``length`` and ``width``, counter-clockwise."""
    return (
        _turned(np.array([[-length / 2, 0], [0, -width / 2], [length / 2, 0], [0, width / 2]]), yaw_rad)
        + centre
    )


def _turned(points: FloatArray, yaw_rad: float) -> FloatArray:
    cos = np.cos(yaw_rad)
    sin = np.sin(yaw_rad)
    return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]))


@dataclass
class RoadPaint:
    """The paint of a scene, and the centre lines (N, 2, map) of its lanes' lines, gaps of dashes included."""

    paints: list[Paint] = field(default_factory=list)
    lanes: list[FloatArray] = field(default_factory=list)

    def add(self, line: _LaneLine) -> None:
        """Its paint and its centre."""
        self.paints += line.paints
        self.lanes.append(line.centre_map)


@dataclass(frozen=True)
class _LaneLine:
    """One painted line: its centre (N, 2, map), and how far left of the way its strands are, m."""

    paints: list[Paint]
    centre_map: FloatArray
    strands_m: list[float]

    def apart_m(self, other: _LaneLine) -> float:
        """The distance from its strands to those of another line."""
        return min(abs(a - b) for a in self.strands_m for b in other.strands_m)


@dataclass(frozen=True)
class Facing:
    """Turns a ``share`` of the symbols to face the camera, drawn from a stream of its own.

    A share ``stout`` of the lanes with arrows has stout ones.
    """

    rng: np.random.Generator
    share: float
    stout: float = 0.0

    def turn(self) -> int:
        """-1 for a symbol that is to be turned, otherwise 1."""
        return -1 if self.rng.random() < self.share else 1


def street_paint(
    rng: np.random.Generator, brush: Brush, bend: Bend, facing: Facing | None = None
) -> RoadPaint:
    """Lane lines of all kinds about the camera, and now and then a junction's markings."""
    lane_m = rng.uniform(2.5, 3.9)
    first = rng.integers(-3, 0)
    here = rng.uniform(-0.25, 0.25) * lane_m
    width_m = rng.uniform(0.09, 0.22)
    dash = _dash_pattern(rng)
    road = RoadPaint()
    lines = range(first, first + int(rng.integers(2, 6)))
    for line in lines:
        left = (line + 0.5) * lane_m + here
        outer = line in (lines[0], lines[-1])
        style = rng.choice(4, p=[0.4, 0.5, 0.05, 0.05] if outer else [0.74, 0.16, 0.05, 0.05])
        road.add(_lane_line(rng, brush, bend, int(style), float(left), width_m, dash))
    for lane in lines[:-1]:
        if rng.random() < 0.3:
            road.paints += _lane_symbols(rng, brush, bend, (lane + 1) * lane_m + here, lane_m, facing)
    if rng.random() < 0.45:
        road.paints += _junction(rng, brush, bend, lane_m)
    return road


def port_paint(rng: np.random.Generator, brush: Brush, bend: Bend, facing: Facing | None = None) -> RoadPaint:
    """Columns of diamonds along the way, with lane lines between some of them."""
    length_m = rng.uniform(0.45, 1.9)
    width_m = length_m / rng.uniform(0.9, 3.0)
    yaw = rng.choice([0.0, np.pi / 2, rng.normal(0, 0.3)], p=[0.6, 0.2, 0.2])
    pitch_m = rng.uniform(length_m + 0.6, 7.0)
    columns = int(rng.integers(1, 6))
    across_m = rng.uniform(max(1.0, width_m + 0.5), 5.0)
    jitter = rng.uniform(0, 0.4)
    paints: list[Paint] = []
    for column in range(columns):
        left = (column - (columns - 1) / 2) * across_m + rng.normal(0, 0.4)
        for along in np.arange(_NEAR_M + rng.uniform(0, pitch_m), _DIAMONDS_FAR_M, pitch_m):
            centre = bend.to_map(np.array([along, left]) + rng.normal(0, jitter, 2))
            shape = rhombus(centre, length_m, width_m, yaw + float(bend.heading(along)))
            paints.append(brush.paint(rng, DIAMOND, shape))
    dash = _dash_pattern(rng)
    road = RoadPaint()
    if rng.random() < 0.4:
        road.paints += _junction(rng, brush, bend, 3.2)
    if rng.random() < 0.35:
        road.paints += _lane_symbols(rng, brush, bend, rng.uniform(-4, 4), 3.2, facing)
    lines: list[_LaneLine] = []
    for _ in range(int(rng.integers(0, 4))):
        style = int(rng.choice(4, p=[0.4, 0.5, 0.05, 0.05]))
        line = _lane_line(rng, brush, bend, style, rng.uniform(-6, 6), rng.uniform(0.09, 0.25), dash)
        if all(line.apart_m(other) >= _LEAST_APART_M for other in lines):
            lines.append(line)
            road.add(line)
    road.paints += paints
    return road


def _dash_pattern(rng: np.random.Generator) -> tuple[float, float]:
    """Length of a dash and of the cycle, m."""
    length = rng.uniform(2.0, 6.0) if rng.random() < 0.85 else rng.uniform(0.9, 2.0)
    return float(length), float(length * rng.uniform(1.6, 3.2))


def _lane_line(
    rng: np.random.Generator,
    brush: Brush,
    bend: Bend,
    style: int,
    left: float,
    width_m: float,
    dash: tuple[float, float],
) -> _LaneLine:
    """A line. Style 0: dashes, 1: solid, 2: double solid, 3: dashes beside a solid line."""
    beside = width_m * rng.uniform(1.8, 3.0)
    paints: list[Paint] = []
    strands: list[tuple[float, tuple[float, float]]] = []
    if style in (0, 3):
        for start in np.arange(_NEAR_M - rng.uniform(0, dash[1]), FAR_M, dash[1]):
            strip = _strip(bend, start, start + dash[0], left, width_m)
            paints.append(brush.paint(rng, LANE_DASH, strip))
        strands.append((left, (_NEAR_M, FAR_M)))
    offsets = {1: (0.0,), 2: (-beside / 2, beside / 2), 3: (beside,)}.get(style, ())
    for offset in offsets:
        extent = _solid_extent(rng)
        paints += _solid(rng, brush, bend, extent, left + offset, width_m)
        strands.append((left + offset, extent))
    return _LaneLine(paints, bend.to_map(_centre(strands)), [at for at, _ in strands])


def double_line(rng: np.random.Generator, brush: Brush, bend: Bend, left: float) -> RoadPaint:
    """Two strands beside each other, each solid or dashed, 0.08 to 0.35 m of ground between them."""
    width_m = float(rng.uniform(0.09, 0.2))
    apart_m = width_m + float(rng.uniform(0.08, 0.35))
    dash = _dash_pattern(rng)
    dashed = rng.choice(4, p=[0.6, 0.15, 0.15, 0.1])
    paints: list[Paint] = []
    strands: list[tuple[float, tuple[float, float]]] = []
    extent = _solid_extent(rng)
    phase = rng.uniform(0, dash[1])
    for number, side in enumerate((-1, 1)):
        at = left + side * apart_m / 2
        strands.append((at, extent))
        if not dashed & (1 << number):
            paints += _solid(rng, brush, bend, extent, at, width_m)
            continue
        for start in np.arange(extent[0] - phase, extent[1], dash[1]):
            paints.append(brush.paint(rng, LANE_DASH, _strip(bend, start, start + dash[0], at, width_m)))
    return RoadPaint(paints, [bend.to_map(_centre(strands))])


def _centre(strands: list[tuple[float, tuple[float, float]]]) -> FloatArray:
    """The centre (N, 2), along and beside the way, of strands at a place beside it, each of such an extent.

    It is the middle of those that run beside each other, and keeps to the one that goes on.
    """
    start = min(extent[0] for _, extent in strands)
    end = max(extent[1] for _, extent in strands)
    along = np.arange(start, end + 1e-6, _LANE_STEP_M)
    runs = np.array([(along >= first) & (along <= last) for _, (first, last) in strands])
    some = runs.any(axis=0)
    middle = np.array([left for left, _ in strands]) @ runs[:, some] / runs[:, some].sum(axis=0)
    reach = round(_PASSING_M / _LANE_STEP_M / 2)
    beside = np.pad(np.interp(along, along[some], middle), reach, mode="edge")
    return np.column_stack([along, np.convolve(beside, np.full(2 * reach + 1, 1 / (2 * reach + 1)), "valid")])


def _solid_extent(rng: np.random.Generator) -> tuple[float, float]:
    """Where a solid line begins and ends along the way; some do so in view."""
    start = _NEAR_M if rng.random() < 0.75 else rng.uniform(_NEAR_M, 15)
    return float(start), float(FAR_M if rng.random() < 0.75 else start + rng.uniform(9, 30))


def _solid(
    rng: np.random.Generator,
    brush: Brush,
    bend: Bend,
    extent: tuple[float, float],
    left: float,
    width_m: float,
) -> list[Paint]:
    """A solid line, in short pieces where the way bends."""
    start, end = extent
    piece = _piece_m(bend.curvature) if bend.curvature else end - start
    edges = np.arange(start, end - 0.1, piece)
    seed = int(rng.integers(1 << 30))
    first = brush.paint(rng, LANE_LINE, _strip(bend, start, end, left, width_m))
    return [
        Paint(
            kind=LANE_LINE,
            polygon_map=_strip(bend, a, min(a + piece + 0.02, end), left, width_m),
            albedo_bgr=first.albedo_bgr,
            wear=first.wear,
            dirt=first.dirt,
            seed=seed,
        )
        for a in edges
    ]


def _piece_m(curvature: float) -> float:
    """Length of a straight piece of a bent line, which is at most 2 cm beside it."""
    return min(_PIECE_M, float(np.sqrt(8 * _PIECE_BESIDE_M / abs(curvature))))


def _strip(bend: Bend, start: float, end: float, left: float, width_m: float) -> FloatArray:
    half = width_m / 2
    return bend.to_map(
        np.array([[start, left - half], [end, left - half], [end, left + half], [start, left + half]])
    )


def _lane_symbols(
    rng: np.random.Generator, brush: Brush, bend: Bend, left: float, lane_m: float, facing: Facing | None
) -> list[Paint]:
    """An arrow or a line of writing in a lane, perhaps repeated."""
    draw, kind = (arrow, ARROW) if rng.random() < 0.6 else (_writing, TEXT)
    out: list[Paint] = []
    turn = facing.turn() if facing else 1
    stout = facing is not None and kind == ARROW and facing.rng.random() < facing.stout
    for along in np.arange(rng.uniform(1, 12), 32, rng.uniform(9, 30)):
        for polygon in stout_arrow(facing.rng) if facing and stout else draw(rng, lane_m):
            placed = bend.to_map(turn * polygon + np.array([along, left]))
            out.append(brush.paint(rng, kind, placed))
    return out


def arrow(rng: np.random.Generator, lane_m: float) -> Iterator[FloatArray]:
    """Convex parts of a lane arrow: straight on, a turn, or both."""
    length = rng.uniform(2.0, 6.0)
    shaft = rng.uniform(0.12, 0.3)
    head_length = rng.uniform(0.25, 0.45) * length
    head = rng.uniform(2.5, 4.5) * shaft
    turn = rng.choice([-1, 0, 1])
    straight = rng.random() < 0.6
    if turn == 0 or straight:
        yield rectangle(np.array([(length - head_length) / 2, 0.0]), length - head_length, shaft)
        tip = np.array([[length - head_length, -head / 2], [length, 0.0], [length - head_length, head / 2]])
        yield tip
    if turn:
        root = rng.uniform(0.1, 0.45) * length
        side = turn * rng.uniform(0.5, 0.9)
        if not straight:
            yield rectangle(np.array([root / 2, 0.0]), root, shaft)
        end = np.array([root + rng.uniform(0.1, 0.3) * length, side])
        width = np.array([shaft * 1.5, 0.0])
        start = np.array([root, 0.0])
        bar = np.array([start - width / 2, start + width / 2, end + width / 2, end - width / 2])
        yield bar if turn < 0 else bar[::-1]
        yield end + np.array([[-0.6, 0.0], [0.0, turn * 0.7], [0.6, 0.0]])[::-turn]


def stout_arrow(rng: np.random.Generator) -> Iterator[FloatArray]:
    """Convex parts of an arrow with a thick, tapered shaft and a short head, its turns curved."""
    length = rng.uniform(2.5, 6.0)
    tail_m = rng.uniform(0.22, 0.45)
    neck = rng.uniform(0.68, 0.82) * length
    head = rng.uniform(1.7, 2.6) * tail_m
    wide = rng.uniform(0.7, 1.1)
    side = int(rng.choice([-1, 0, 1]))
    ahead = rng.random() < 0.5
    root = rng.uniform(0.25, 0.55) * length
    end = neck if not side or ahead else root
    half = tail_m / 2 * np.array([1.0, wide])
    yield np.array([[0, -half[0]], [end, -half[1]], [end, half[1]], [0, half[0]]])
    if not side or ahead:
        yield np.array([[neck, -head / 2], [length, 0], [neck, head / 2]])
    if side:
        reach = rng.uniform(0.25, 0.6)
        rise = rng.uniform(0.15, 0.35) * length
        thick = 0.08 * length
        turn = np.linspace(0, np.pi / 2, 4)
        middle = np.column_stack([root + rise * np.sin(turn), side * reach * (1 - np.cos(turn))])
        off = np.column_stack([thick / 2 * np.sin(turn), -side * half[1] * np.cos(turn)])
        outer = middle + off
        inner = middle - off
        for k in range(3):
            part = np.array([inner[k], outer[k], outer[k + 1], inner[k + 1]])
            yield part[::side]
        tip = np.array([[-1.6 * thick, 0], [0, side * rng.uniform(0.4, 0.7)], [1.6 * thick, 0]])
        yield (middle[-1] + tip)[::-side]


def _writing(rng: np.random.Generator, lane_m: float) -> Iterator[FloatArray]:
    """Strokes of letters or digits, drawn out along the lane as road writing is."""
    letters = int(rng.integers(1, 6))
    tall = rng.uniform(1.0, 4.0)
    wide = min(0.75, 0.8 * lane_m / letters)
    stroke = rng.uniform(0.12, 0.2) * wide + 0.03
    for letter in range(letters):
        right = (letter - (letters - 1) / 2) * wide
        for _ in range(int(rng.integers(2, 5))):
            if rng.random() < 0.5:
                at = np.array([tall / 2, -right + rng.choice([-0.35, 0.0, 0.35]) * wide])
                yield rectangle(at, tall * rng.choice([0.5, 1.0]), stroke, rng.choice([0.0, 0.08, -0.08]))
            else:
                at = np.array([rng.choice([0.04, 0.5, 0.96]) * tall, -right])
                yield rectangle(at, stroke * 2.2, wide * 0.8)


def _junction(rng: np.random.Generator, brush: Brush, bend: Bend, lane_m: float) -> list[Paint]:
    """A stop line, a crosswalk, teeth, or chevrons across the way."""
    along = rng.uniform(3, 25)
    left = rng.uniform(-5, 2)
    extent = lane_m * rng.integers(1, 4)
    draw, kind = [
        (stop_line, STOP_LINE),
        (crosswalk, CROSSWALK_BAR),
        (_teeth, STOP_LINE),
        (_chevrons, CHEVRON),
    ][int(rng.choice(4, p=[0.27, 0.27, 0.13, 0.33]))]
    return [
        brush.paint(rng, kind, bend.to_map(shape + np.array([along, left]))) for shape in draw(rng, extent)
    ]


def stop_line(rng: np.random.Generator, extent: float, thick_m: float | None = None) -> Iterator[FloatArray]:
    """One thick line across the way."""
    thick = rng.uniform(0.25, 0.6) if thick_m is None else thick_m
    yield rectangle(np.array([0.0, extent / 2]), thick, extent)


def crosswalk(rng: np.random.Generator, extent: float) -> Iterator[FloatArray]:
    """Bars along the way, side by side across it."""
    bar = rng.uniform(0.35, 0.6)
    long = rng.uniform(2, 4.5)
    for left in np.arange(0, extent, 2 * bar):
        yield rectangle(np.array([0.0, left]), long, bar)


def _teeth(rng: np.random.Generator, extent: float) -> Iterator[FloatArray]:
    """A row of triangles: give way."""
    size = rng.uniform(0.4, 0.7)
    for left in np.arange(0, extent, 1.6 * size):
        yield np.array([[0.0, -0.5], [1.4, 0.0], [0.0, 0.5]]) * size + np.array([0.0, left])


def _chevrons(rng: np.random.Generator, extent: float) -> Iterator[FloatArray]:
    """Parallel slanted bars, or angles made of two, one behind the other."""
    slope = rng.uniform(0.5, 1.1) * rng.choice([-1, 1])
    wide = rng.uniform(1.0, 3.0)
    thick = rng.uniform(0.15, 0.45)
    angles = rng.random() < 0.6
    for along in np.arange(0, 12, rng.uniform(1.0, 2.5)):
        yield _slanted(along, 0.0, wide, thick, slope)
        if angles:
            yield _slanted(along, 0.0, -wide, thick, -slope)


def _slanted(along: float, left: float, wide: float, thick: float, slope: float) -> FloatArray:
    """A bar (4, 2) from (along, left), ``wide`` across the way and ``thick`` along it, counter-clockwise."""
    end = along + wide * slope
    bar = np.array([[along, left], [along + thick, left], [end + thick, left + wide], [end, left + wide]])
    return bar if wide > 0 else bar[::-1]
