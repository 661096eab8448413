"""A person's corrections of lane lines: what was drawn is in the map, what was deleted is not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from v2hdm.geometry.planar import length_along, points_along
from v2hdm.io.maps.corrections import ADDED, REJECTED, Correction, Heard
from v2hdm.records import BoolArray, FloatArray, HDMap, Lane

_SAME_M = 0.4  # largest distance, m, between a line and what a person says of it, as of markings
_STEP_M = 0.5  # distance, m, between the vertices of a line that was drawn, as of those that are mapped
_LEAST_M = 2.0  # least length, m, of what is left of a line beside a deleted part
_MOSTLY = 0.5  # share of a line's length, from which the images show it, or another line takes its place


def with_lines_corrected(hd_map: HDMap, corrections: Sequence[Correction]) -> tuple[HDMap, tuple[Heard, ...]]:
    """The map with a person's corrections of its lane lines, and what it follows.

    A drawn line lies on the lines that the images show where they are within 0.4 m of it, with their sigma.
    """
    drawn = [correction for correction in corrections if correction.is_line and correction.says == ADDED]
    deleted = [correction for correction in corrections if correction.is_line and correction.says == REJECTED]
    added_lines = []
    heard = []
    for correction in drawn:
        drawn_line, shown = _drawn_line(correction, hd_map.lanes)
        added_lines.append(drawn_line)
        against = "" if shown >= _MOSTLY else f"the images show a line along {100 * shown:.0f} % of it"
        heard.append(Heard(correction.place, "drawn", against))
    lanes = list(hd_map.lanes)
    for correction in deleted:
        line = np.array(correction.outline_map)
        images = max((lane.sightings for lane in lanes if _is_along(lane.points_map, line).any()), default=0)
        lanes = [part for lane in lanes for part in _without(lane, line)]
        is_replaced = any(_is_along(line, added.points_map).mean() >= _MOSTLY for added in added_lines)
        against = (
            "" if is_replaced else f"{images} images show it" if images else "no line of the map is there"
        )
        heard.append(Heard(correction.place, "deleted", against))
    for added in added_lines:
        # What is drawn over a line that stays takes its place.
        lanes = [part for lane in lanes for part in _without(lane, added.points_map)]
    return replace(hd_map, lanes=(*lanes, *added_lines)), tuple(heard)


def _drawn_line(correction: Correction, lanes: Sequence[Lane]) -> tuple[Lane, float]:
    """A drawn line, and the share of it along which the images show one."""
    course = np.array(correction.outline_map)
    length_m = float(length_along(course)[-1])
    at_m = np.linspace(0.0, length_m, max(round(length_m / _STEP_M), 1) + 1)
    points = points_along(course, at_m)
    sigma_m = np.full(len(points), correction.sigma_m)
    nearest_m = np.full(len(points), _SAME_M)
    placed = points.copy()
    sightings = 0
    for lane in lanes:
        if len(lane.points_map) < 2:
            continue
        feet = _feet(points, lane.points_map)
        is_near = feet.off_m < nearest_m
        if not is_near.any():
            continue
        placed[is_near] = feet.points_map[is_near]
        nearest_m[is_near] = feet.off_m[is_near]
        if lane.sigma_m is not None:
            sigma_m[is_near] = lane.sigma_m[feet.vertex[is_near]]
        sightings = max(sightings, lane.sightings)
    is_shown = nearest_m < _SAME_M
    return Lane(correction.kind, placed, sightings, sigma_m=sigma_m), float(is_shown.mean())


def _without(lane: Lane, line: FloatArray) -> list[Lane]:
    """The pieces of a lane line that lie beside a deleted one (N, 2)."""
    if len(lane.points_map) < 2:
        return [lane]
    is_deleted = _is_along(lane.points_map, line)
    if not is_deleted.any():
        return [lane]
    vertices = np.flatnonzero(np.logical_not(is_deleted))
    parts = np.split(vertices, np.flatnonzero(np.diff(vertices) > 1) + 1)
    return [
        _part(lane, rows)
        for rows in parts
        if len(rows) > 1 and length_along(lane.points_map[rows])[-1] >= _LEAST_M
    ]


def _part(lane: Lane, rows: np.ndarray) -> Lane:
    def of(values: FloatArray | None) -> FloatArray | None:
        return None if values is None else values[rows]

    return replace(
        lane,
        points_map=lane.points_map[rows],
        heights_m=of(lane.heights_m),
        sigma_m=of(lane.sigma_m),
        heights_sigma_m=of(lane.heights_sigma_m),
        id=None,
    )


def _is_along(points: FloatArray, line: FloatArray) -> BoolArray:
    """Which points (N,) lie on a line (M, 2), as well as lines are the same."""
    return np.asarray(_feet(points, line).off_m < _SAME_M)


class _Feet(NamedTuple):
    """The places on a line that are nearest to N points."""

    points_map: FloatArray  # (N, 2)
    off_m: FloatArray  # (N,) distances of the points
    vertex: np.ndarray  # (N,) number of the vertex before each place


def _feet(points: FloatArray, line: FloatArray) -> _Feet:
    """The places on a line (M, 2) that are nearest to points (N, 2)."""
    begin = line[:-1]
    piece = np.diff(line, axis=0)
    squared = np.maximum((piece**2).sum(axis=1), 1e-12)
    share = np.clip(((points[:, None] - begin) * piece).sum(axis=2) / squared, 0.0, 1.0)
    feet = begin + share[..., None] * piece
    off_m = np.linalg.norm(points[:, None] - feet, axis=2)
    best = off_m.argmin(axis=1)
    row = np.arange(len(points))
    return _Feet(feet[row, best], off_m[row, best], best)
