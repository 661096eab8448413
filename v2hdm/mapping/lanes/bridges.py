"""Gaps in mapped lanes that are bridged because images saw one line run across them.

Paint under trees or worn away leaves pieces too far apart to be joined by their directions alone. Where
the detector saw, in several images, one whole line pass the end of one piece and the start of the next, they
are one lane, and those lines say where it runs between them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from v2hdm.mapping.lanes.paths import Path
from v2hdm.mapping.lanes.points import Guides
from v2hdm.mapping.options import LaneOptions
from v2hdm.records import FloatArray

_MAX_BRIDGE_M = 25.0
_PASSES_M = 0.4
"""A line that comes so near the end of a piece passes it."""

_LEAST_COSINE = np.cos(np.deg2rad(30.0))
_FIRST, _LAST = 0, 1
_DIRECTION_LENGTH_M = 5.0
"""A bridge leaves a piece in about the direction of so much of its end."""


def bridge_paths(paths: list[Path], guides: Guides, options: LaneOptions) -> list[Path]:
    """The paths, those joined that ``options.min_images`` images saw as one line, shortest gaps first."""
    if not len(guides.points_map):
        return paths
    tree = cKDTree(guides.points_map)
    ended = [(path, _ends(path)) for path in paths]
    while (joined := _shortest_bridge(ended, guides, tree, options)) is not None:
        a, b, path = joined
        ended = [of for k, of in enumerate(ended) if k not in (a, b)] + [(path, _ends(path))]
    return [path for path, _ in ended]


def _shortest_bridge(
    ended: list[tuple[Path, FloatArray]], guides: Guides, tree: cKDTree, options: LaneOptions
) -> tuple[int, int, Path] | None:
    """Two of the paths, each with its ends, and what they are together: the shortest gap to be bridged."""
    if len(ended) < 2:
        return None
    for a, end_a, b, end_b in _gaps(np.stack([ends for _, ends in ended])).tolist():
        before = ended[a][0].turned(end_a == _FIRST)
        after = ended[b][0].turned(end_b == _LAST)
        between = _course_between(before.points_map[-1], after.points_map[0], guides, tree, options)
        if between is not None:
            return a, b, _joined(before, between, after)
    return None


def _gaps(ends: FloatArray) -> NDArray[np.int64]:
    """Path, end, path, end (G, 4) of all gaps whose way is roughly that of both paths, the shortest first.

    ``ends`` (P, 2, 2, 2) are position and outward direction of both ends of every path.
    """
    place, outward = ends.reshape(-1, 2, 2).swapaxes(0, 1)
    gap = place[None] - place[:, None]
    gap_m = np.linalg.norm(gap, axis=2)
    # From i to j one leaves i outwards and arrives at j against what is outwards there.
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
    """Direction (2,) in which a polyline ends, over its last metres."""
    away = np.linalg.norm(points - points[-1], axis=1)
    direction = points[-1] - points[int(np.argmin(np.abs(away - min(_DIRECTION_LENGTH_M, float(away.max())))))]
    return np.asarray(direction / max(float(np.linalg.norm(direction)), 1e-9))


def _course_between(
    start: FloatArray, stop: FloatArray, guides: Guides, tree: cKDTree, options: LaneOptions
) -> FloatArray | None:
    """Vertices (N, 2) between two ends, where the lines seen run; None unless enough images saw one."""
    first, last = (np.unique(guides.line[tree.query_ball_point(end, _PASSES_M)]) for end in (start, stop))
    common = np.intersect1d(first, last)
    if len(np.unique(guides.image_of_line[common])) < options.min_images:
        return None
    gap = stop - start
    gap_m = float(np.linalg.norm(gap))
    ahead = gap / gap_m
    count = max(int(np.ceil(gap_m / options.node_spacing_m)), 1)
    at = np.linspace(0.0, gap_m, count + 1)
    courses = []
    for line in common:
        offset = guides.points_map[guides.line == line] - start
        along, across = offset @ ahead, offset[:, 1] * ahead[0] - offset[:, 0] * ahead[1]
        order = np.argsort(along)
        courses.append(np.interp(at, along[order], across[order]))
    course = np.median(courses, axis=0)
    # The paint is where the ends are: what the lines seen are off there is taken off along the way.
    course -= np.interp(at, [0.0, gap_m], [course[0], course[-1]])
    points = start + at[:, None] * ahead + course[:, None] * np.array([-ahead[1], ahead[0]])
    return np.asarray(points[1:-1])


def _joined(before: Path, between: FloatArray, after: Path) -> Path:
    lengths = [max(before.length_m, 1e-9), max(after.length_m, 1e-9)]
    dash = float(np.average([before.dash, after.dash], weights=lengths))
    images = float(np.average([before.images, after.images], weights=lengths))
    return Path(np.concatenate([before.points_map, between, after.points_map]), dash, images)
