"""Markings composed of others: crosswalks of parallel bars, double lines of two lane lines, give-way lines.

The network has no class of them. A crosswalk's bars stay markings of the map, as its parts; a double line
takes the place of its two lines where they run beside each other, a give-way line that of its pieces.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count

import numpy as np

from v2hdm.geometry.planar import length_along, turned_left
from v2hdm.geometry.rows import outline_of_row, rows_of_bars
from v2hdm.records import (
    CROSSWALK,
    CROSSWALK_BAR,
    DOUBLE_LINE,
    BoolArray,
    FloatArray,
    HDMap,
    Lane,
    Marking,
    Symbol,
)
from v2hdm.site.give_way import with_give_way_lines
from v2hdm.site.joint import joint_covariance

APART_M = (0.15, 0.5)
"""Distance between the centres of a double line's two lines, m: gaps of .08 to .35 m (RMS-1 4.1, MUTCD 3A.06)
between lines of .1 to .15 m."""
_LEAST_BESIDE_M = 3.0  # least length of a double line, m: of one pair of dashes beside each other
_LEAST_REST_M = 1.0  # shorter remnants of its lines, m, are dropped: their ends are as uncertain
_PARALLEL = 0.98  # least cosine between the two lines
_STEP_M = 0.5  # distance between the vertices of a double line, m


def composed(hd_map: HDMap) -> HDMap:
    """The map with crosswalks, double lines and give-way lines; known crosswalks keep their ids."""
    hd_map = with_give_way_lines(hd_map)
    places = [k for k, marking in enumerate(hd_map.markings) if marking.kind == CROSSWALK_BAR]
    corners = np.array([hd_map.markings[k].corners_map for k in places]).reshape(-1, 4, 2)
    rows = rows_of_bars(corners)
    lanes = with_double_lines(hd_map.lanes)
    earlier = [symbol for symbol in hd_map.symbols if symbol.kind == CROSSWALK]
    if not rows and not earlier:
        return replace(hd_map, lanes=lanes)
    free = _free_ids(hd_map)
    markings = tuple(
        marking if marking.id else replace(marking, id=next(free)) for marking in hd_map.markings
    )
    crosswalks = [_crosswalk([markings[places[k]] for k in row], earlier) for row in rows]
    others = [symbol for symbol in hd_map.symbols if symbol.kind != CROSSWALK]
    return replace(hd_map, markings=markings, lanes=lanes, symbols=(*others, *crosswalks))


def _free_ids(hd_map: HDMap) -> Iterator[int]:
    """Ids that no feature has or had, in order."""
    features: list[Marking | Lane | Symbol] = [*hd_map.markings, *hd_map.lanes, *hd_map.symbols]
    return count(1 + max([hd_map.largest_id, *(feature.id or 0 for feature in features)]))


def _crosswalk(bars: Sequence[Marking], earlier: Sequence[Symbol]) -> Symbol:
    """The crosswalk of bars in order, with the id of the one of ``earlier`` crosswalks about its middle."""
    outline = outline_of_row(np.array([bar.corners_map for bar in bars]))
    covariance_m2 = joint_covariance(bars)
    if covariance_m2 is not None:
        covariance_m2 = outline.by_corner @ covariance_m2 @ outline.by_corner.T
    heights = [bar.heights_m for bar in bars if bar.heights_m is not None]
    sigmas = [bar.heights_sigma_m for bar in bars if bar.heights_sigma_m is not None]
    middle = outline.corners.mean(axis=0)
    reach_m = float(np.ptp(outline.corners, axis=0).max()) / 2
    same = [s.id for s in earlier if np.linalg.norm(s.outline_map.mean(axis=0) - middle) < reach_m]
    return Symbol(
        kind=CROSSWALK,
        outline_map=outline.corners,
        sightings=max(bar.sightings for bar in bars),
        sigma_m=None if covariance_m2 is None else float(np.sqrt(np.trace(covariance_m2) / 8)),
        heights_m=np.concatenate(heights)[outline.corner_of_bars] if len(heights) == len(bars) else None,
        heights_sigma_m=np.concatenate(sigmas)[outline.corner_of_bars] if len(sigmas) == len(bars) else None,
        id=same[0] if same else None,
        covariance_m2=covariance_m2,
        parts=tuple(bar.id or 0 for bar in bars),
    )


def with_double_lines(lanes: Sequence[Lane]) -> tuple[Lane, ...]:
    """The lane lines; two that run beside each other become one double line for as long as they do."""
    pieces = list(lanes)
    doubles: list[Lane] = []
    number = 0
    while number < len(pieces):
        neighbour = _beside(pieces[number], pieces[number + 1 :])
        if neighbour is None:
            number += 1
            continue
        other, is_beside = neighbour
        line = pieces[number]
        second = pieces.pop(number + 1 + other)
        begin, end = np.flatnonzero(is_beside)[[0, -1]]
        double, remnants = _double(line, second, int(begin), int(end))
        doubles.append(double)
        pieces[number : number + 1] = _remnants(line, int(begin), int(end)) + remnants
    return (*pieces, *doubles)


def _directions(points: FloatArray) -> FloatArray:
    ahead = np.gradient(points, axis=0)
    return np.asarray(ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9))


def _beside(line: Lane, others: Sequence[Lane]) -> tuple[int, BoolArray] | None:
    """The index of the line that runs beside a line the longest, and the run of vertices (N,) it passes."""
    if line.kind == DOUBLE_LINE or len(line.points_map) < 2:
        return None
    arc_m = length_along(line.points_map)
    best = None
    longest_m = _LEAST_BESIDE_M
    for number, other in enumerate(others):
        if other.kind == DOUBLE_LINE or len(other.points_map) < 2 or _apart(line, other):
            continue
        off_m, cosine = _offsets(line.points_map, other.points_map)
        side = np.sign(np.nansum(np.sign(off_m)))
        with np.errstate(invalid="ignore"):
            fits = (side * off_m >= APART_M[0]) & (side * off_m <= APART_M[1]) & (cosine >= _PARALLEL)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], fits.astype(int), [0]])))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            length_m = float(arc_m[end - 1] - arc_m[begin])
            if length_m > longest_m:
                longest_m = length_m
                best = number, (np.arange(len(arc_m)) >= begin) & (np.arange(len(arc_m)) < end)
    return best


def _apart(line: Lane, other: Lane) -> bool:
    """Whether two lines are nowhere near each other."""
    (low, high), (other_low, other_high) = (
        (lane.points_map.min(axis=0), lane.points_map.max(axis=0)) for lane in (line, other)
    )
    return bool((low > other_high + APART_M[1]).any() or (other_low > high + APART_M[1]).any())


def _offsets(points: FloatArray, other: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far left (N,) of vertices (N, 2) another line runs, nan past its ends, and the cosine (N,)."""
    start = other[:-1]
    step = np.diff(other, axis=0)
    length = np.maximum(np.linalg.norm(step, axis=1), 1e-9)
    share = np.einsum("nsi,si->ns", points[:, None] - start, step) / length**2
    # By coordinate: numpy is slow with pairs.
    foot = start.T[:, None] + np.clip(share, 0.0, 1.0) * step.T[:, None]
    east, north = points.T[:, :, None] - foot
    nearest = np.sqrt(east * east + north * north).argmin(axis=1)
    rows = np.arange(len(points))
    ahead = _directions(points)
    off_m = ((foot[:, rows, nearest].T - points) * turned_left(ahead)).sum(axis=1)
    cosine = np.abs((step[nearest] / length[nearest, None] * ahead).sum(axis=1))
    beyond = (nearest == 0) & (share[rows, nearest] < -_STEP_M / length[nearest])
    beyond |= (nearest == len(step) - 1) & (share[rows, nearest] > 1 + _STEP_M / length[nearest])
    return np.where(beyond, np.nan, off_m), cosine


def _double(line: Lane, other: Lane, begin: int, end: int) -> tuple[Lane, list[Lane]]:
    """The double line along a line's vertices ``begin`` to ``end``, and the remnants of the other line."""
    part = slice(begin, end + 1)
    points = line.points_map[part]
    off_m, _ = _offsets(points, other.points_map)
    apart_m = float(np.abs(off_m).mean())
    is_left = bool(off_m.mean() < 0)  # the line itself is the left one
    nearest = np.linalg.norm(other.points_map[:, None] - points, axis=2)
    sigma_m = None
    if line.sigma_m is not None and other.sigma_m is not None:
        # The worst case: both err alike.
        sigma_m = np.maximum(line.sigma_m[part], other.sigma_m[nearest.argmin(axis=0)])
    within = np.unique(nearest[:, [0, -1]].argmin(axis=0))
    double = replace(
        line,
        kind=DOUBLE_LINE,
        points_map=points + turned_left(_directions(points)) * off_m[:, None] / 2,
        sightings=min(line.sightings, other.sightings),
        sigma_m=sigma_m,
        heights_m=_part(line.heights_m, part),
        heights_sigma_m=_part(line.heights_sigma_m, part),
        lines=(line.kind, other.kind) if is_left else (other.kind, line.kind),
        apart_m=apart_m,
    )
    return double, _remnants(other, int(within[0]), int(within[-1]))


def _remnants(line: Lane, begin: int, end: int) -> list[Lane]:
    """The remnants of a line before vertex ``begin`` and after vertex ``end``, without an id."""
    remnants = []
    for part in (slice(0, begin + 1), slice(end, None)):
        points = line.points_map[part]
        if len(points) > 1 and length_along(points)[-1] >= _LEAST_REST_M:
            remnant = replace(
                line,
                points_map=points,
                id=None,
                heights_m=_part(line.heights_m, part),
                sigma_m=_part(line.sigma_m, part),
                heights_sigma_m=_part(line.heights_sigma_m, part),
            )
            remnants.append(remnant)
    return remnants


def _part(values: FloatArray | None, part: slice) -> FloatArray | None:
    return None if values is None else values[part]
