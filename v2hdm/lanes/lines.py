"""Lanes: nodes on lane paint strung into polylines, and pieces of a line joined across gaps.

Pieces are joined by direction; trees and wear leave longer gaps. Pieces are one lane if the detector saw, in
several images, one whole line pass both ends of the gap; those lines give its course there.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial import cKDTree

from v2hdm.geometry.planar import angle_between, length_along, points_along
from v2hdm.lanes.points import NODE_SPACING_M, Guides, LaneCloud, Nodes, find_nodes
from v2hdm.records import LANE_DASH, LANE_LINE, BoolArray, FloatArray, IntArray, Lane
from v2hdm.site.options import LaneOptions

_MAX_DASH_GAP_M = 9.0  # longest gap between dashes, m, that is bridged
_MAX_BREAK_M = 3.0  # longest break in solid paint, m, that is bridged
_LEAST_PIECE_M = 2.0  # least length of a lane line, m

_LINKED_COSINE = np.cos(np.deg2rad(25.0))  # least cosine between linked nodes, and of each to their link
_MAX_LINK_SPACINGS = 2.5  # longest link of two nodes, in spacings

_MAX_BEND_RAD, _MAX_ARC_MISMATCH_RAD = np.deg2rad([25.0, 8.0])
"""Limits, rad: angle between a gap's chord and an end's tangent, and its difference between the two ends."""

_END_SIGMA_M = 0.05  # lateral error of an end, m: the angular tolerance of short gaps
_END_LENGTH_M = 2.0  # length, m, that gives an end's direction


@dataclass(frozen=True)
class Path:
    """A polyline: ``points_map`` (N, 2), mean ``dash`` fraction and mean number of supporting ``images``."""

    points_map: FloatArray
    dash: float
    images: float

    @property
    def length_m(self) -> float:
        """Length along the polyline."""
        return float(length_along(self.points_map)[-1])

    def turned(self, turn: bool) -> Path:
        """The path, reversed if ``turn``."""
        return replace(self, points_map=self.points_map[::-1]) if turn else self


def string_nodes(nodes: Nodes) -> list[Path]:
    """String nodes into paths without forks, by links of mutually nearest nodes ahead and behind."""
    if not len(nodes.points_map):
        return []
    return [
        Path(nodes.points_map[path], float(nodes.dash[path].mean()), float(np.median(nodes.images[path])))
        for path in _walk(_mutual_links(nodes, _MAX_LINK_SPACINGS * NODE_SPACING_M))
        if len(path) >= 2
    ]


def join_paths(paths: list[Path]) -> list[Path]:
    """Join paths whose ends lie on one arc, shortest gaps first."""
    joined = []
    for run in _runs(len(paths), _joints(paths)):
        paths_of_run = [paths[path].turned(backwards) for path, backwards in run]
        pieces = [paths_of_run[0].points_map]
        for before, after in itertools.pairwise(paths_of_run):
            pieces += [_bridge(before.points_map, after.points_map, NODE_SPACING_M), after.points_map]
        joined.append(_merged(np.concatenate(pieces), paths_of_run))
    return joined


def _mutual_links(nodes: Nodes, reach_m: float) -> IntArray:
    """Nodes (N, 2) linked ahead of and behind each node, -1 for none."""
    pairs = cKDTree(nodes.points_map).query_pairs(reach_m, output_type="ndarray")
    source, target = np.concatenate([pairs, pairs[:, ::-1]]).T
    offset = nodes.points_map[target] - nodes.points_map[source]
    distance = np.linalg.norm(offset, axis=1)
    tangent = nodes.tangent[source]
    along = np.einsum("pi,pi->p", offset, tangent)
    along_target = np.einsum("pi,pi->p", offset, nodes.tangent[target])
    straight = np.minimum(np.abs(along), np.abs(along_target)) / np.maximum(distance, 1e-9)
    parallel = np.abs(np.einsum("pi,pi->p", tangent, nodes.tangent[target]))
    fits = (straight >= _LINKED_COSINE) & (parallel >= _LINKED_COSINE)
    source = source[fits]
    target = target[fits]
    along = along[fits]
    cost = (distance / straight**4)[fits]
    best = np.full((len(nodes.points_map), 2), -1, dtype=np.int64)
    # In order of falling cost: the cheapest is written last and stays.
    order = np.argsort(-cost, kind="stable")
    best[source[order], (along[order] < 0).astype(int)] = target[order]
    node = np.arange(len(best))[:, None, None]
    return np.where((best[best] == node).any(axis=2) & (best >= 0), best, -1)


def _walk(links: IntArray) -> list[IntArray]:
    """Follow links (N, 2) from end to end, then around closed loops, repeating their start."""
    degree = (links >= 0).sum(axis=1)
    is_unvisited = np.ones(len(links), dtype=bool)
    paths = []
    for start in np.concatenate([np.flatnonzero(degree == 1), np.flatnonzero(degree == 2)]).tolist():
        if not is_unvisited[start]:
            continue
        path = []
        previous = -1
        node = start
        while node >= 0 and is_unvisited[node]:
            is_unvisited[node] = False
            path.append(node)
            ahead = [n for n in links[node].tolist() if n >= 0 and n != previous and is_unvisited[n]]
            previous = node
            node = ahead[0] if ahead else -1
        if degree[start] == 2 and start in links[path[-1]] and len(path) > 2:
            path.append(start)
        paths.append(np.array(path, dtype=np.int64))
    return paths


def _joints(paths: list[Path]) -> list[tuple[int, int, int, int]]:
    """Matching path ends (path, end, path, end) by increasing gap; end 0 is the first, 1 the last."""
    if len(paths) < 2:
        return []
    end = np.array([path.points_map[[0, -1]] for path in paths]).reshape(-1, 2)
    outward = np.array([[_outward(path.points_map[::-1]), _outward(path.points_map)] for path in paths])
    outward = outward.reshape(-1, 2)
    dashed = np.repeat([path.dash > 0.5 for path in paths], 2)
    pairs = cKDTree(end).query_pairs(max(_MAX_DASH_GAP_M, _MAX_BREAK_M), output_type="ndarray")
    a = pairs[:, 0]
    b = pairs[:, 1]
    gap = end[b] - end[a]
    gap_m = np.linalg.norm(gap, axis=1)
    limit_m = np.where(dashed[a] & dashed[b], _MAX_DASH_GAP_M, _MAX_BREAK_M)
    leaving = angle_between(outward[a], gap)
    arriving = angle_between(gap, -outward[b])
    # The chord of an arc meets both tangents at one angle.
    slack = np.arctan2(_END_SIGMA_M, np.maximum(gap_m, 1e-6))
    fits = (gap_m <= limit_m) & (a // 2 != b // 2)
    fits &= np.maximum(np.abs(leaving), np.abs(arriving)) <= _MAX_BEND_RAD + slack
    fits &= np.abs(leaving - arriving) <= _MAX_ARC_MISMATCH_RAD + 2 * slack
    order = np.flatnonzero(fits)[np.argsort(gap_m[fits], kind="stable")]
    return [(int(a[p]) // 2, int(a[p]) % 2, int(b[p]) // 2, int(b[p]) % 2) for p in order]


def _outward(points: FloatArray) -> FloatArray:
    """Direction (2,) of a polyline at its last point, over its last two metres."""
    distance = np.linalg.norm(points - points[-1], axis=1)
    inner = np.flatnonzero(distance <= _END_LENGTH_M)
    start = int(inner[0]) if len(inner) > 1 else max(len(points) - 2, 0)
    return _unit(points[-1] - points[start:-1].mean(axis=0))


def _unit(way: FloatArray) -> FloatArray:
    """``way`` (2,) at unit length."""
    return np.asarray(way / max(float(np.linalg.norm(way)), 1e-9))


def _runs(count: int, joints: list[tuple[int, int, int, int]]) -> list[list[tuple[int, bool]]]:
    """Runs of (path, whether reversed), joining each end at most once and never into a ring."""
    run_of = [[(path, False)] for path in range(count)]
    for a, end_a, b, end_b in joints:
        before = _ending_with((a, end_a == _FIRST), run_of[a])
        after = _ending_with((b, end_b == _FIRST), run_of[b])
        if run_of[a] is not run_of[b] and before and after:
            joined = before + _backwards(after)
            for path, _ in joined:
                run_of[path] = joined
    runs = {id(run): run if run[0][0] <= run[-1][0] else _backwards(run) for run in run_of}
    return sorted(runs.values())


def _ending_with(last: tuple[int, bool], run: list[tuple[int, bool]]) -> list[tuple[int, bool]]:
    """The run, ordered to end with ``last``; empty if another path follows that."""
    return next((way for way in (run, _backwards(run)) if way[-1] == last), [])


def _backwards(run: list[tuple[int, bool]]) -> list[tuple[int, bool]]:
    """The run from its other end."""
    return [(path, not backwards) for path, backwards in reversed(run)]


def _merged(points_map: FloatArray, paths: Sequence[Path]) -> Path:
    """A path along ``points_map``, with the mean attributes of ``paths``."""
    length_m = [max(path.length_m, 1e-9) for path in paths]
    dash = float(np.average([path.dash for path in paths], weights=length_m))
    return Path(points_map, dash, float(np.average([path.images for path in paths], weights=length_m)))


def _bridge(before: FloatArray, after: FloatArray, spacing_m: float) -> FloatArray:
    """Vertices (N, 2) of the Hermite cubic from the end of ``before`` to the start of ``after``."""
    start = before[-1]
    stop = after[0]
    gap_m = float(np.linalg.norm(stop - start))
    t = np.linspace(0.0, 1.0, max(int(np.ceil(gap_m / spacing_m)), 1) + 1)[1:-1]
    leave = gap_m * _outward(before)
    arrive = -gap_m * _outward(after[::-1])
    return np.asarray(CubicHermiteSpline([0.0, 1.0], [start, stop], [leave, arrive])(t))


_MAX_BRIDGE_M = 25.0  # longest gap bridged by images' whole lines, m
_PASSES_M = 0.4  # largest distance, m, of a whole line from the end of a piece that it passes
_LEAST_COSINE = np.cos(np.deg2rad(30.0))  # least cosine between a gap and the directions of its ends
_DIRECTION_LENGTH_M = 5.0  # length, m, of a piece's end that gives a bridge's direction

_FIRST = 0  # number of a path's first end
_LAST = 1  # number of a path's last end


def bridge_paths(paths: list[Path], guides: Guides, least_images: int) -> list[Path]:
    """The paths, joined where ``least_images`` images saw one line, shortest gaps first."""
    if not len(guides.points_map):
        return paths
    tree = cKDTree(guides.points_map)
    bridged = True
    while bridged and len(paths) > 1:
        bridged = False
        for a, end_a, b, end_b in _gaps(np.stack([_ends(path) for path in paths])).tolist():
            before = paths[a].turned(end_a == _FIRST)
            after = paths[b].turned(end_b == _LAST)
            between = _course_between(before.points_map[-1], after.points_map[0], guides, tree, least_images)
            if between is not None:
                points = np.concatenate([before.points_map, between, after.points_map])
                others = [path for k, path in enumerate(paths) if k not in (a, b)]
                paths = [*others, _merged(points, [before, after])]
                bridged = True
                break
    return paths


def _gaps(ends: FloatArray) -> NDArray[np.int64]:
    """Path, end, path, end (G, 4) of all gaps roughly aligned with both paths, shortest first."""
    place, outward = ends.reshape(-1, 2, 2).swapaxes(0, 1)
    gap = place[None] - place[:, None]
    gap_m = np.linalg.norm(gap, axis=2)
    # A gap from i to j leaves along i's outward direction and arrives against j's.
    leaving = np.einsum("ijk,ik->ij", gap, outward)
    straight = np.minimum(leaving, leaving.T) >= _LEAST_COSINE * gap_m
    path = np.arange(len(place)) // 2
    able = straight & (gap_m > 0) & (gap_m <= _MAX_BRIDGE_M) & (path[:, None] < path)
    i, j = np.nonzero(able)
    order = np.argsort(gap_m[i, j], kind="stable")
    return np.asarray(np.column_stack([path[i], i % 2, path[j], j % 2])[order])


def _ends(path: Path) -> FloatArray:
    """Position and outward direction (2, 2, 2) of the first and the last end of a path."""
    points = path.points_map
    return np.array([[points[0], _end_direction(points[::-1])], [points[-1], _end_direction(points)]])


def _end_direction(points: FloatArray) -> FloatArray:
    """Direction (2,) of a polyline's end, over its last metres."""
    distance_m = np.linalg.norm(points - points[-1], axis=1)
    vertex = int(np.argmin(np.abs(distance_m - min(_DIRECTION_LENGTH_M, float(distance_m.max())))))
    return _unit(points[-1] - points[vertex])


def _course_between(
    start: FloatArray, stop: FloatArray, guides: Guides, tree: cKDTree, least_images: int
) -> FloatArray | None:
    """Vertices (N, 2) between two ends, along the whole lines there; None unless enough images saw one."""
    first, last = (np.unique(guides.line[tree.query_ball_point(end, _PASSES_M)]) for end in (start, stop))
    common = np.intersect1d(first, last)
    if len(np.unique(guides.image_of_line[common])) < least_images:
        return None
    gap = stop - start
    gap_m = float(np.linalg.norm(gap))
    ahead = gap / gap_m
    count = max(int(np.ceil(gap_m / NODE_SPACING_M)), 1)
    vertex_m = np.linspace(0.0, gap_m, count + 1)
    courses = []
    for line in common:
        offset = guides.points_map[guides.line == line] - start
        along = offset @ ahead
        across = offset[:, 1] * ahead[0] - offset[:, 0] * ahead[1]
        order = np.argsort(along)
        courses.append(np.interp(vertex_m, along[order], across[order]))
    course = np.median(courses, axis=0)
    # The paint is at the ends: the whole lines' offset there is removed along the gap.
    course -= np.interp(vertex_m, [0.0, gap_m], [course[0], course[-1]])
    points = start + vertex_m[:, None] * ahead + course[:, None] * np.array([-ahead[1], ahead[0]])
    return np.asarray(points[1:-1])


_LEAST_LENGTH_M = 6.0
"""Length, m, at which a lane seen in just enough images is accepted; shorter ones need more."""


def map_lanes(cloud: LaneCloud, options: LaneOptions) -> tuple[Lane, ...]:
    """Polylines of the lane paint, with vertices half a metre apart; a line of dashes is one lane."""
    return lanes_along(paths_of(cloud, options), options)


def paths_of(
    cloud: LaneCloud, options: LaneOptions, is_inside: Callable[[FloatArray], BoolArray] | None = None
) -> list[Path]:
    """Paths along the lane paint, of any length; only where points (N, 2) are ``is_inside`` (N,)."""
    if len(cloud.points_map) < 2:
        return []
    nodes = find_nodes(cloud, options.min_images)
    if is_inside is not None:
        nodes = nodes.subset(is_inside(nodes.points_map))
    return bridge_paths(join_paths(string_nodes(nodes)), cloud.guides, options.min_images)


def lanes_along(paths: Sequence[Path], options: LaneOptions) -> tuple[Lane, ...]:
    """The paths that are long enough to be lanes, smoothed, with vertices half a metre apart."""
    return tuple(
        Lane(
            LANE_DASH if path.dash > 0.5 else LANE_LINE,
            _resample(path.points_map, NODE_SPACING_M),
            round(path.images),
        )
        for path in paths
        if path.length_m >= _LEAST_PIECE_M
        and path.length_m * path.images >= _LEAST_LENGTH_M * options.min_images
    )


def _resample(points: FloatArray, spacing_m: float) -> FloatArray:
    """Vertices at equal steps of about ``spacing_m`` along a smoothed polyline, keeping both ends."""
    # Binomial smoothing removes the nodes' lateral noise.
    inner = 0.25 * points[:-2] + 0.5 * points[1:-1] + 0.25 * points[2:]
    points = np.concatenate([points[:1], inner, points[-1:]])
    length_m = float(length_along(points)[-1])
    return points_along(points, np.linspace(0.0, length_m, max(round(length_m / spacing_m), 1) + 1))
