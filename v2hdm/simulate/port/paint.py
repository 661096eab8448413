"""The markings of a port: its paint, and the true map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from v2hdm.catalogue import CORNERED_CLASSES, PAINT_CLASSES
from v2hdm.geometry.planar import signed_area
from v2hdm.records import (
    ARROW,
    DIAMOND,
    LANE_DASH,
    LANE_LINE,
    STOP_LINE,
    TEXT,
    FloatArray,
    GeodeticOrigin,
    HDMap,
    Lane,
    Marking,
    Symbol,
)
from v2hdm.simulate.port.config import PaintConfig, StencilConfig
from v2hdm.simulate.port.route import Place, Route
from v2hdm.simulate.render.scene import WHITE_PAINT, YELLOW_PAINT, Bgr, Paint, placed

_VERTEX_SPACING_M = 0.5  # largest distance between neighbouring vertices of a lane

# A solid line is painted in straight pieces. In each the route turns by this angle at most: the first piece
# of a turn of 12 m radius is 4 mm off the straight line before it.
_PIECE_TURN_RAD = 0.015
_PIECE_STEP_M = 0.1  # distance between the stations at which a piece may end
_PIECE_LENGTH_M = 25.0  # largest length of a piece
_PIECE_OVERLAP_M = 0.02  # overlap of two pieces: more than their gap on the outer side of a turn

_LEAST_GAP_M = 1.7  # least distance of a marking's centre from other paint, chosen
_LINE_GAP_M = 1.1  # least distance of a marking's centre from the vertices of lanes, chosen
_STENCIL_TRIES = 10  # number of places that are tried for a stencil within its spacing
_STRAIGHT_PER_M = 1e-4  # curvature below which the route counts as straight

# Corners of a diamond of unit length and width, ahead and to the left of its centre.
_DIAMOND = np.array([[0.5, 0.0], [0.0, 0.5], [-0.5, 0.0], [0.0, -0.5]])

# Shaft and head of an arrow, ahead and to the left of its centre, m.
_ARROW_M = [
    np.array([[-1.5, -0.08], [0.55, -0.08], [0.55, 0.08], [-1.5, 0.08]]),
    np.array([[0.5, -0.35], [1.5, 0.0], [0.5, 0.35]]),
]

# A stop line of 0.4 m by 3 m, ahead and to the left of its centre, m.
_STOP_LINE_M = [np.array([[-0.2, -1.5], [0.2, -1.5], [0.2, 1.5], [-0.2, 1.5]])]

# The bars (x0, x1, y0, y1) of a letter like an eight on a pocket calculator, m: two upright, three level.
_LETTER_BARS_M = (
    (-0.6, 0.6, 0.0, 0.1),
    (-0.6, 0.6, 0.3, 0.4),
    (-0.6, -0.5, 0.1, 0.3),
    (-0.05, 0.05, 0.1, 0.3),
    (0.5, 0.6, 0.1, 0.3),
)

_Worn = tuple[float, float]  # wear and dirt


@dataclass
class Layout:
    """Paint, with its markings and lanes in the true map."""

    paints: list[Paint] = field(default_factory=list)
    markings: list[Marking] = field(default_factory=list)
    lanes: list[Lane] = field(default_factory=list)
    occupied_map: list[FloatArray] = field(default_factory=list)
    symbols: list[Symbol] = field(default_factory=list)
    texts: dict[int, str] = field(default_factory=dict)  # of symbols, by their place among these
    lettering: list[FloatArray] = field(default_factory=list)  # rectangles (4, 2) about what cannot be read

    def hd_map(self, origin: GeodeticOrigin | None) -> HDMap:
        """The true map."""
        symbols = tuple(self.symbols)
        return HDMap(tuple(self.markings), tuple(self.lanes), origin=origin, symbols=symbols)

    def vertices(self) -> FloatArray:
        """The vertices (N, 2) of all lanes."""
        return np.vstack([lane.points_map for lane in self.lanes] or [np.empty((0, 2))])

    def is_free(self, centre: FloatArray, lines: FloatArray) -> bool:
        """Whether a marking at ``centre`` (2,) keeps clear of ``lines`` (N, 2) and of all other paint."""
        gaps_m = ((lines, _LINE_GAP_M), (np.array(self.occupied_map), _LEAST_GAP_M))
        return not any(
            len(points) and ((points - centre) ** 2).sum(axis=1).min() < gap_m**2 for points, gap_m in gaps_m
        )


def build_layout(config: PaintConfig, route: Route, rng: np.random.Generator) -> Layout:
    """Paint a port along its route."""
    painter = _Painter(config, route, rng, Layout())
    for offset in config.solid_offsets_m:
        painter.solid_line(offset)
    for offset in config.dashed_offsets_m:
        painter.dashed_line(offset)
    painter.other_paint()
    for is_field, offsets in ((False, config.diamond_offsets_m), (True, config.field_offsets_m)):
        for offset in offsets:
            painter.diamond_row(offset, is_field)
    for kind, stencil in config.stencils.items():
        painter.stencil_rows(kind, stencil)
    return painter.layout


@dataclass
class _Painter:
    config: PaintConfig
    route: Route
    rng: np.random.Generator
    layout: Layout

    def _paint(
        self, kind: str, polygon: FloatArray, worn: _Worn, seed: int, colour: Bgr = WHITE_PAINT
    ) -> None:
        wear, dirt = worn
        self.layout.paints.append(
            Paint(kind=kind, polygon_map=polygon, albedo_bgr=colour, wear=wear, dirt=dirt, seed=seed)
        )

    def _worn(self) -> _Worn:
        """Wear and dirt of one marking: gamma distributed about the means, never complete."""
        wear = self.config.wear * float(self.rng.gamma(2.0, 0.5))
        dirt = self.config.dirt * float(self.rng.gamma(2.0, 0.5))
        return min(wear, 0.4), min(dirt, 0.7)

    def _seed(self) -> int:
        return int(self.rng.integers(1 << 30))

    def _colour(self) -> Bgr:
        return WHITE_PAINT if self.rng.random() < 0.7 else YELLOW_PAINT

    def _ribbon(self, ends_m: FloatArray, offset_m: float) -> FloatArray:
        """A quadrilateral (4, 2) of a line between two stations, counter-clockwise."""
        right = self.route.points_at(ends_m, offset_m - self.config.line_width_m / 2)
        left = self.route.points_at(ends_m, offset_m + self.config.line_width_m / 2)
        return np.array([right[0], right[1], left[1], left[0]])

    def solid_line(self, offset_m: float) -> None:
        length_m = self.route.length_m
        points = self.route.points_at(np.arange(0.0, length_m, _VERTEX_SPACING_M), offset_m)
        self.layout.lanes.append(Lane(LANE_LINE, points, 0))
        worn = self._worn()
        seed = self._seed()
        for start, end in self._straight_pieces():
            around = np.array([max(start - _PIECE_OVERLAP_M, 0.0), min(end + _PIECE_OVERLAP_M, length_m)])
            self._paint(LANE_LINE, self._ribbon(around, offset_m), worn, seed)

    def _straight_pieces(self) -> list[tuple[float, float]]:
        """Segments of the route that are straight to within a few millimetres."""
        edges = [0.0]
        for station in np.arange(_VERTEX_SPACING_M, self.route.length_m, _PIECE_STEP_M):
            yaw, first_yaw = (float(self.route.yaw_at(np.array([at]))[0]) for at in (station, edges[-1]))
            if abs(yaw - first_yaw) > _PIECE_TURN_RAD or station - edges[-1] > _PIECE_LENGTH_M:
                edges.append(float(station))
        return list(pairwise([*edges, self.route.length_m]))

    def dashed_line(self, offset_m: float) -> None:
        """Dashes as markings, each straight, and one lane through them all, beside the route between them."""
        config = self.config
        route = self.route
        period = config.dash_length_m + config.dash_gap_m
        longer = 1 + abs(offset_m) * float(np.abs(route.curvature).max())
        points: list[FloatArray] = []
        last_m = 0.0
        for start in np.arange(self.rng.uniform(0.5, period), route.length_m - period, period):
            ends = np.array([start, start + config.dash_length_m])
            polygon = self._ribbon(ends, offset_m)
            self._paint(LANE_DASH, polygon, self._worn(), self._seed())
            self.layout.markings.append(Marking(LANE_DASH, polygon, 0))
            if points:
                gap_m = start - last_m
                points.append(route.points_at(last_m + gap_m * _shares(longer * gap_m)[1:-1], offset_m))
            tail = polygon[[0, 3]].mean(axis=0)
            head = polygon[[1, 2]].mean(axis=0)
            points.append(tail + _shares(float(np.linalg.norm(head - tail)))[:, None] * (head - tail))
            last_m = float(ends[1])
        if points:
            self.layout.lanes.append(Lane(LANE_DASH, np.concatenate(points), 0))

    def diamond_row(self, offset_m: float, is_field: bool) -> None:
        config = self.config
        route = self.route
        rng = self.rng
        half = _DIAMOND * (config.diamond_length_m, config.diamond_width_m)
        colour = YELLOW_PAINT if config.yellow_diamonds else WHITE_PAINT
        lines = self.layout.vertices()
        phase = config.diamond_spacing_m * (0.5 + 0.37 * offset_m % 1.0 * 0.5)
        for station in np.arange(phase, route.length_m - 2.0, config.diamond_spacing_m):
            at = np.array([station + rng.normal(0.0, config.placing_sigma_m)])
            yaw = float(route.yaw_at(at)[0]) + np.deg2rad(rng.normal(0.0, config.placing_sigma_deg))
            centre = route.points_at(at, offset_m + rng.normal(0.0, config.placing_sigma_m))[0]
            worn = self._worn()
            seed = self._seed()
            if is_field and abs(np.interp(at[0], route.station_m, route.curvature)) >= _STRAIGHT_PER_M:
                continue
            # Rows beyond the lanes may run into another part of the route behind a turn.
            near_route = float(route.distance_to(centre[None])[0]) < abs(offset_m) - 0.5
            if near_route or not self.layout.is_free(centre, lines):
                continue
            corners = placed(half, centre, yaw)
            self.layout.markings.append(Marking(DIAMOND, corners, 0))
            self.layout.occupied_map.append(centre)
            self._paint(DIAMOND, corners, worn, seed, colour)

    def stencil_rows(self, kind: str, stencil: StencilConfig) -> None:
        route = self.route
        rng = self.rng
        spacing_m = stencil.spacing_m
        shapes = [np.array(shape) for shape in stencil.shapes_m]
        shapes = [shape if signed_area(shape) > 0 else shape[::-1] for shape in shapes]
        lines = self.layout.vertices()
        for offset_m in stencil.offsets_m:
            for station in np.arange(rng.uniform(0.0, spacing_m), route.length_m - 2.0, spacing_m):
                worn = self._worn()
                turned = np.deg2rad(rng.normal(0.0, self.config.placing_sigma_deg))
                colour = self._colour()
                for at in station + np.linspace(0.0, spacing_m, _STENCIL_TRIES, endpoint=False):
                    centre = route.points_at(np.array([at]), offset_m)[0]
                    beside = float(route.distance_to(centre[None])[0]) >= abs(offset_m) - 0.5
                    if at < route.length_m - 2.0 and beside and self.layout.is_free(centre, lines):
                        yaw = float(route.yaw_at(np.array([at]))[0]) + turned
                        x, y = centre.tolist()
                        self._place(kind, shapes, Place((x, y), yaw), worn, colour)
                        break

    def other_paint(self) -> None:
        """Arrows, stop lines and lettering; of these only the stop lines are markings of the map."""
        config = self.config
        route = self.route
        rng = self.rng
        for kind, spacing, shapes in (
            (ARROW, config.arrow_spacing_m, _ARROW_M),
            (STOP_LINE, config.stop_line_spacing_m, _STOP_LINE_M),
            (TEXT, config.lettering_spacing_m, None),
        ):
            for station in np.arange(spacing * 0.6, route.length_m - 5.0, spacing):
                at = station + rng.uniform(-2.0, 2.0)
                offset = 0.0 if shapes is not None else float(rng.choice([-7.2, -3.5, 3.5, 7.2]))
                drawn = shapes if shapes is not None else self._lettering()
                place = route.pose_at(at, offset)
                self._place(kind, drawn, place, self._worn(), self._colour())
                if kind == TEXT and drawn:
                    outline = placed(around(drawn), place.point_map, place.yaw_rad)
                    self.layout.lettering.append(outline)

    def _lettering(self) -> list[FloatArray]:
        """Block letters of upright and level bars, as bay numbers are painted."""
        bars = []
        for letter in range(int(self.rng.integers(2, 5))):
            left = -0.55 * letter
            for x0, x1, y0, y1 in _LETTER_BARS_M:
                if self.rng.random() < 0.7:
                    low = left + y0
                    high = left + y1
                    bars.append(np.array([[x0, low], [x1, low], [x1, high], [x0, high]]))
        return bars

    def _place(self, kind: str, shapes: Sequence[FloatArray], place: Place, worn: _Worn, colour: Bgr) -> None:
        for shape in shapes:
            polygon = placed(shape, place.point_map, place.yaw_rad)
            self.layout.occupied_map.extend(polygon)
            self._paint(kind, polygon, worn, 7, colour)
            is_stencil = kind not in PAINT_CLASSES and len(shapes) == 1 and len(shape) == 4
            if kind in CORNERED_CLASSES or is_stencil:
                self.layout.markings.append(Marking(kind, polygon, 0))


def around(shapes: Sequence[FloatArray]) -> FloatArray:
    """The rectangle (4, 2) about shapes (N, 2), ahead and to the left, from the lower left counter-clockwise.

    There a word begins for those who drive ahead.
    """
    points = np.vstack(shapes)
    back, right = points.min(axis=0)
    front, left = points.max(axis=0)
    return np.array([[back, left], [back, right], [front, right], [front, left]])


def _shares(length_m: float) -> FloatArray:
    """Fractions of a length from 0 to 1, at most half a metre apart."""
    return np.linspace(0.0, 1.0, max(int(np.ceil(length_m / _VERTEX_SPACING_M)), 1) + 1)
