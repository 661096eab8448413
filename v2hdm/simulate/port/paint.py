"""The markings of a port: what is painted where, what was painted anew, and the true map of both."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from v2hdm.catalogue import CORNERED_CLASSES, PAINT_CLASSES
from v2hdm.geometry.planar import signed_area
from v2hdm.records import (
    ARROW,
    DIAMOND,
    LANE_DASH,
    LANE_LINE,
    OTHER_PAINT,
    STOP_LINE,
    FloatArray,
    GeodeticOrigin,
    HdMap,
    Lane,
    Marking,
)
from v2hdm.simulate.port.config import AlteredConfig, PaintConfig, StencilConfig
from v2hdm.simulate.port.route import Route
from v2hdm.simulate.render.scene import WHITE_PAINT, YELLOW_PAINT, Bgr, Paint

_VERTEX_SPACING_M = 0.5
_PIECE_TURN_RAD = 0.06
_PIECE_LENGTH_M = 25.0
_PIECE_OVERLAP_M = 0.1
_LEAST_GAP_M = 1.7
_LINE_GAP_M = 1.1
_STENCIL_TRIES = 10
_STOP_LINE_M = np.array([[-0.2, -1.5], [0.2, -1.5], [0.2, 1.5], [-0.2, 1.5]])
# The bars (x0, x1, y0, y1) of a letter like an eight on a pocket calculator.
_LETTER_BARS_M = (
    (-0.6, 0.6, 0.0, 0.1),
    (-0.6, 0.6, 0.3, 0.4),
    (-0.6, -0.5, 0.1, 0.3),
    (-0.05, 0.05, 0.1, 0.3),
    (0.5, 0.6, 0.1, 0.3),
)


@dataclass
class Layout:
    """Paint, and the markings and lanes of the true map that it stands for."""

    paints: list[Paint] = field(default_factory=list)
    markings: list[Marking] = field(default_factory=list)
    lanes: list[Lane] = field(default_factory=list)
    occupied_map: list[FloatArray] = field(default_factory=list)

    def hd_map(self, origin: GeodeticOrigin | None) -> HdMap:
        """The true map."""
        return HdMap(markings=tuple(self.markings), lanes=tuple(self.lanes), origin=origin)


def build_layout(config: PaintConfig, route: Route, rng: np.random.Generator) -> Layout:
    """Paint a port along its route."""
    layout = Layout()
    for offset in config.solid_offsets_m:
        _solid_line(config, route, offset, layout, rng)
    for offset in config.dashed_offsets_m:
        _dashed_line(config, route, offset, layout, rng)
    _other_paint(config, route, layout, rng)
    for offset in config.diamond_offsets_m:
        _diamond_row(config, route, offset, False, layout, rng)
    for offset in config.field_offsets_m:
        _diamond_row(config, route, offset, True, layout, rng)
    for kind, stencil in config.stencils.items():
        _stencil_rows(config, kind, stencil, route, layout, rng)
    return layout


def _solid_line(
    config: PaintConfig, route: Route, offset_m: float, layout: Layout, rng: np.random.Generator
) -> None:
    vertices = np.arange(0.0, route.length_m, _VERTEX_SPACING_M)
    points = route.points_at(vertices, offset_m)
    layout.lanes.append(Lane(LANE_LINE, points, 0))
    wear, dirt = _worn(config, rng)
    seed = int(rng.integers(1 << 30))
    for start, end in _pieces(route, 0.0, route.length_m):
        around = np.array([max(start - _PIECE_OVERLAP_M, 0.0), min(end + _PIECE_OVERLAP_M, route.length_m)])
        polygon = _ribbon(route, around, offset_m, config.line_width_m)
        layout.paints.append(Paint(kind=LANE_LINE, polygon_map=polygon, wear=wear, dirt=dirt, seed=seed))


def _pieces(route: Route, start: float, end: float) -> list[tuple[float, float]]:
    """Stretches of a route that are straight to within a few millimetres."""
    edges = [start]
    for station in np.arange(start + _VERTEX_SPACING_M, end, 0.25):
        turned = abs(float(route.yaw_at(np.array([station]))[0] - route.yaw_at(np.array([edges[-1]]))[0]))
        if turned > _PIECE_TURN_RAD or station - edges[-1] > _PIECE_LENGTH_M:
            edges.append(float(station))
    edges.append(end)
    return list(pairwise(edges))


def _ribbon(route: Route, ends_m: FloatArray, offset_m: float, width_m: float) -> FloatArray:
    """A quadrilateral (4, 2) along the route between two stations, counter-clockwise."""
    right = route.points_at(ends_m, offset_m - width_m / 2)
    left = route.points_at(ends_m, offset_m + width_m / 2)
    return np.array([right[0], right[1], left[1], left[0]])


def _dashed_line(
    config: PaintConfig, route: Route, offset_m: float, layout: Layout, rng: np.random.Generator
) -> None:
    """Dashes as markings, each straight, and one lane through them all, beside the route between them."""
    period = config.dash_length_m + config.dash_gap_m
    longer = 1 + abs(offset_m) * float(np.abs(route.curvature).max())
    points: list[FloatArray] = []
    last_m = 0.0
    for start in np.arange(rng.uniform(0.5, period), route.length_m - period, period):
        ends = np.array([start, start + config.dash_length_m])
        polygon = _ribbon(route, ends, offset_m, config.line_width_m)
        wear, dirt = _worn(config, rng)
        layout.paints.append(
            Paint(kind=LANE_DASH, polygon_map=polygon, wear=wear, dirt=dirt, seed=int(rng.integers(1 << 30)))
        )
        layout.markings.append(Marking(LANE_DASH, polygon, 0))
        if points:
            gap_m = start - last_m
            points.append(route.points_at(last_m + gap_m * _shares(longer * gap_m)[1:-1], offset_m))
        tail, head = polygon[[0, 3]].mean(axis=0), polygon[[1, 2]].mean(axis=0)
        points.append(tail + _shares(float(np.linalg.norm(head - tail)))[:, None] * (head - tail))
        last_m = float(ends[1])
    if points:
        layout.lanes.append(Lane(LANE_DASH, np.concatenate(points), 0))


def _shares(length_m: float) -> FloatArray:
    """From 0 to 1 in steps that are at most half a metre of a length."""
    return np.linspace(0.0, 1.0, max(int(np.ceil(length_m / _VERTEX_SPACING_M)), 1) + 1)


def _diamond_row(
    config: PaintConfig,
    route: Route,
    offset_m: float,
    is_field: bool,
    layout: Layout,
    rng: np.random.Generator,
) -> None:
    half = np.array([[0.5, 0.0], [0.0, 0.5], [-0.5, 0.0], [0.0, -0.5]])
    half *= (config.diamond_length_m, config.diamond_width_m)
    colour = YELLOW_PAINT if config.yellow_diamonds else WHITE_PAINT
    lines = np.vstack([lane.points_map for lane in layout.lanes] or [np.empty((0, 2))])
    phase = config.diamond_spacing_m * (0.5 + 0.37 * offset_m % 1.0 * 0.5)
    for station in np.arange(phase, route.length_m - 2.0, config.diamond_spacing_m):
        at = np.array([station + rng.normal(0.0, config.placing_sigma_m)])
        yaw = float(route.yaw_at(at)[0]) + np.deg2rad(rng.normal(0.0, config.placing_sigma_deg))
        centre = route.points_at(at, offset_m + rng.normal(0.0, config.placing_sigma_m))[0]
        wear, dirt = _worn(config, rng)
        seed = int(rng.integers(1 << 30))
        if is_field and not route.is_straight(at)[0]:
            continue
        # Rows beyond the lanes may run into another stretch of the route behind a turn.
        if (
            not _is_free(centre, lines, layout)
            or float(route.distance_to(centre[None])[0]) < abs(offset_m) - 0.5
        ):
            continue
        corners = _placed(half, centre, yaw)
        layout.markings.append(Marking(DIAMOND, corners, 0))
        layout.occupied_map.append(centre)
        layout.paints.append(
            Paint(kind=DIAMOND, polygon_map=corners, albedo_bgr=colour, wear=wear, dirt=dirt, seed=seed)
        )


def _stencil_rows(
    config: PaintConfig,
    kind: str,
    stencil: StencilConfig,
    route: Route,
    layout: Layout,
    rng: np.random.Generator,
) -> None:
    shapes = [_counter_clockwise(np.array(shape)) for shape in stencil.shapes_m]
    lines = np.vstack([lane.points_map for lane in layout.lanes] or [np.empty((0, 2))])
    for offset_m in stencil.offsets_m:
        for station in np.arange(
            rng.uniform(0.0, stencil.spacing_m), route.length_m - 2.0, stencil.spacing_m
        ):
            worn, turned = _worn(config, rng), np.deg2rad(rng.normal(0.0, config.placing_sigma_deg))
            colour = WHITE_PAINT if rng.random() < 0.7 else YELLOW_PAINT
            for at in station + np.linspace(0.0, stencil.spacing_m, _STENCIL_TRIES, endpoint=False):
                centre = route.points_at(np.array([at]), offset_m)[0]
                inside = float(route.distance_to(centre[None])[0]) >= abs(offset_m) - 0.5
                if at < route.length_m - 2.0 and inside and _is_free(centre, lines, layout):
                    yaw = float(route.yaw_at(np.array([at]))[0]) + turned
                    _place_shapes(kind, shapes, centre, yaw, worn, layout, colour)
                    break


def _counter_clockwise(shape: FloatArray) -> FloatArray:
    return shape if signed_area(shape) > 0 else shape[::-1]


def _is_free(centre: FloatArray, lines: FloatArray, layout: Layout) -> bool:
    """Whether a marking at ``centre`` (2,) keeps clear of ``lines`` (N, 2) and of all other paint."""
    for points, gap_m in ((lines, _LINE_GAP_M), (np.array(layout.occupied_map), _LEAST_GAP_M)):
        if len(points) and float(((points - centre) ** 2).sum(axis=1).min()) < gap_m**2:
            return False
    return True


def _other_paint(config: PaintConfig, route: Route, layout: Layout, rng: np.random.Generator) -> None:
    """Arrows, stop lines and lettering; of these only the stop lines are markings of the map."""
    for kind, spacing, shapes in (
        (ARROW, config.arrow_spacing_m, _arrow()),
        (STOP_LINE, config.stop_line_spacing_m, [_STOP_LINE_M]),
        (OTHER_PAINT, config.lettering_spacing_m, None),
    ):
        for station in np.arange(spacing * 0.6, route.length_m - 5.0, spacing):
            at = np.array([station + rng.uniform(-2.0, 2.0)])
            offset = 0.0 if shapes is not None else float(rng.choice([-7.2, -3.5, 3.5, 7.2]))
            _place_shapes(
                kind,
                shapes if shapes is not None else _lettering(rng),
                route.points_at(at, offset)[0],
                float(route.yaw_at(at)[0]),
                _worn(config, rng),
                layout,
                WHITE_PAINT if rng.random() < 0.7 else YELLOW_PAINT,
            )


def _place_shapes(
    kind: str,
    shapes: list[FloatArray],
    centre: FloatArray,
    yaw_rad: float,
    worn: tuple[float, float],
    layout: Layout,
    colour: Bgr,
) -> None:
    for shape in shapes:
        polygon = _placed(shape, centre, yaw_rad)
        layout.occupied_map.extend(polygon)
        layout.paints.append(
            Paint(kind=kind, polygon_map=polygon, albedo_bgr=colour, wear=worn[0], dirt=worn[1], seed=7)
        )
        if kind in CORNERED_CLASSES or (kind not in PAINT_CLASSES and len(shapes) == 1 and len(shape) == 4):
            layout.markings.append(Marking(kind, polygon, 0))


def _arrow() -> list[FloatArray]:
    shaft = np.array([[-1.5, -0.08], [0.55, -0.08], [0.55, 0.08], [-1.5, 0.08]])
    return [shaft, np.array([[0.5, -0.35], [1.5, 0.0], [0.5, 0.35]])]


def _lettering(rng: np.random.Generator) -> list[FloatArray]:
    """Block letters of upright and level bars, as bay numbers are painted."""
    bars = []
    for letter in range(int(rng.integers(2, 5))):
        left = -0.55 * letter
        for x0, x1, y0, y1 in _LETTER_BARS_M:
            if rng.random() < 0.7:
                bars.append(np.array([[x0, left + y0], [x1, left + y0], [x1, left + y1], [x0, left + y1]]))
    return bars


def _placed(shape: FloatArray, centre: FloatArray, yaw_rad: float) -> FloatArray:
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.asarray(shape @ np.array([[cos, sin], [-sin, cos]]) + centre)


def _worn(config: PaintConfig, rng: np.random.Generator) -> tuple[float, float]:
    """Wear and dirt of one marking: gamma distributed about the means, never gone altogether."""
    wear = config.wear * float(rng.gamma(2.0, 0.5))
    dirt = config.dirt * float(rng.gamma(2.0, 0.5))
    return min(wear, 0.4), min(dirt, 0.7)


_BESIDE_ROUTE_M = 4.5
"""Only paint this near to the route is altered: a vehicle sees it from everywhere."""

_CLEAR_M = 2.6
"""Distance of an altered marking from all others that are, m: what each was and is can be told apart."""

_FREE_M = 1.3
"""Distance of new paint's centre from other paint, m."""

_TRIES = 4000


@dataclass(frozen=True)
class Alteration:
    """One marking: its corners (4, 2) before, None for an added one, and after, None for a removed one."""

    kind: str
    before: FloatArray | None
    after: FloatArray | None


def alter(
    layout: Layout, config: AlteredConfig, paint: PaintConfig, route: Route, rng: np.random.Generator
) -> tuple[Layout, list[Alteration]]:
    """Paint a port anew in places; fewer where there is no room for so many."""
    done: list[Alteration] = []
    for length_m in np.linspace(config.moved_by_m[0], config.moved_by_m[1], config.moved):
        done += _moved(layout, float(length_m), config.turned_sigma_rad, route, done, rng)
    for _ in range(config.removed):
        done += _removed(layout, route, done, rng)
    for _ in range(config.added):
        done += _added(layout, paint, route, done, rng)
    return _painted(layout, done, rng), done


def _moved(
    layout: Layout,
    length_m: float,
    turned_sigma_rad: float,
    route: Route,
    done: list[Alteration],
    rng: np.random.Generator,
) -> list[Alteration]:
    """A diamond, shifted by a distance and turned a little."""
    for _ in range(_TRIES):
        before = _any(layout, (DIAMOND,), route, done, rng)
        if before is None:
            continue
        angle, turn = rng.uniform(0, 2 * np.pi), rng.normal(0.0, turned_sigma_rad)
        centre = before.mean(axis=0)
        spin = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        after = (before - centre) @ spin.T + centre + length_m * np.array([np.cos(angle), np.sin(angle)])
        if _is_clear(after, layout, before):
            return [Alteration(DIAMOND, before, after)]
    return []


def _removed(
    layout: Layout, route: Route, done: list[Alteration], rng: np.random.Generator
) -> list[Alteration]:
    """A diamond or a dash."""
    for _ in range(_TRIES):
        before = _any(layout, (DIAMOND, LANE_DASH), route, done, rng)
        if before is not None:
            kind = next(one.kind for one in layout.markings if one.corners_map is before)
            return [Alteration(kind, before, None)]
    return []


def _added(
    layout: Layout, paint: PaintConfig, route: Route, done: list[Alteration], rng: np.random.Generator
) -> list[Alteration]:
    """A diamond of the port's stencil, beside the route where there is room."""
    half = np.array([[0.5, 0.0], [0.0, 0.5], [-0.5, 0.0], [0.0, -0.5]])
    half *= (paint.diamond_length_m, paint.diamond_width_m)
    for _ in range(_TRIES):
        at = np.array([rng.uniform(8.0, route.length_m - 8.0)])
        centre = route.points_at(at, rng.uniform(-_BESIDE_ROUTE_M, _BESIDE_ROUTE_M))[0]
        yaw = float(route.yaw_at(at)[0])
        after = half @ np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]) + centre
        if _is_apart(after, done) and _is_clear(after, layout, None):
            return [Alteration(DIAMOND, None, after)]
    return []


def _any(
    layout: Layout, kinds: tuple[str, ...], route: Route, done: list[Alteration], rng: np.random.Generator
) -> FloatArray | None:
    """The corners of a marking beside the route that was not altered, None where the one drawn is not."""
    own = [one.corners_map for one in layout.markings if one.kind in kinds]
    corners = own[int(rng.integers(len(own)))]
    beside = float(route.distance_to(corners.mean(axis=0)[None])[0]) <= _BESIDE_ROUTE_M
    return corners if beside and _is_apart(corners, done) else None


def _is_apart(corners: FloatArray, done: list[Alteration]) -> bool:
    centre = corners.mean(axis=0)
    others = [one.mean(axis=0) for each in done for one in (each.before, each.after) if one is not None]
    return all(np.linalg.norm(centre - other) > _CLEAR_M for other in others)


def _is_clear(corners: FloatArray, layout: Layout, itself: FloatArray | None) -> bool:
    """Whether new paint keeps clear of all other."""
    centre = corners.mean(axis=0)
    others = [one.polygon_map for one in layout.paints if one.polygon_map is not itself]
    lines = [lane.points_map for lane in layout.lanes]
    nearest = min(float(np.linalg.norm(points - centre, axis=1).min()) for points in [*others, *lines])
    return nearest > _FREE_M - 0.3 if itself is not None else nearest > _FREE_M


def _painted(layout: Layout, done: list[Alteration], rng: np.random.Generator) -> Layout:
    after = {id(one.before): one.after for one in done if one.before is not None}
    paints: list[Paint] = []
    for paint in layout.paints:
        if id(paint.polygon_map) not in after:
            paints.append(paint)
        elif (polygon := after[id(paint.polygon_map)]) is not None:
            paints.append(replace(paint, polygon_map=polygon))
    markings: list[Marking] = []
    for marking in layout.markings:
        if id(marking.corners_map) not in after:
            markings.append(marking)
        elif (corners := after[id(marking.corners_map)]) is not None:
            markings.append(replace(marking, corners_map=corners))
    like = next((paint for paint in layout.paints if paint.kind == DIAMOND), None)
    for one in done:
        if one.before is None and one.after is not None and like is not None:
            seed = int(rng.integers(1 << 30))
            paints.append(replace(like, polygon_map=one.after, wear=0.05, dirt=0.05, seed=seed))
            markings.append(Marking(DIAMOND, one.after, 0))
    return Layout(paints, markings, layout.lanes, layout.occupied_map)
