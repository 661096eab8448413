"""A port that was painted anew in places: some markings moved, some removed, some added."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from v2hdm.records import DIAMOND, LANE_DASH, FloatArray, Marking
from v2hdm.simulate.port.config import AlteredConfig, PaintConfig
from v2hdm.simulate.port.layout import Layout
from v2hdm.simulate.port.route import Route
from v2hdm.simulate.render.scene import Paint

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
