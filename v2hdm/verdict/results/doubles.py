"""The same marking mapped twice beside itself, as clocks, drift and mountings that disagree map it."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial import KDTree

from v2hdm.mapping.results import MethodResult
from v2hdm.records import FloatArray, Marking
from v2hdm.verdict.judgement import judge
from v2hdm.verdict.verdict import Finding

OVERLAP = 0.1
"""Share of the smaller of two markings of a class that both cover; paint does not lie on paint."""

DOUBLES_LIMIT = 0.02
"""Share of markings that overlap another: clean drives have none, one in a hundred may be paint over old
paint."""


def check_doubles(best: MethodResult) -> list[Finding]:
    """Markings of one class that overlap."""
    pairs = overlapping(best.hd_map.markings)
    count = len(best.hd_map.markings)
    if not count:
        return []
    where = ""
    if pairs:
        x, y = best.hd_map.markings[pairs[0][0]].corners_map.mean(axis=0)
        where = f", first at ({x:.1f}, {y:.1f})"
    return [
        judge(
            "double markings",
            "map",
            len(pairs) / count,
            DOUBLES_LIMIT,
            "",
            fine=f"{len(pairs)} of {count} markings overlap another of their class",
            wrong=f"{len(pairs)} of {count} markings overlap another of their class{where}: laps or "
            f"cameras do not "
            "agree; check clocks, the receiver's fix and the mountings",
        )
    ]


def overlapping(markings: tuple[Marking, ...]) -> list[tuple[int, int]]:
    """Pairs of markings of one class that share at least :data:`OVERLAP` of the smaller one."""
    if len(markings) < 2:
        return []
    corners = [np.ascontiguousarray(one.corners_map, dtype=np.float32) for one in markings]
    centres = np.array([one.mean(axis=0) for one in corners])
    longest_m = max(float(np.ptp(one, axis=0).max()) for one in corners)
    near = KDTree(centres).query_pairs(longest_m, output_type="ndarray")
    return [
        (int(a), int(b))
        for a, b in near
        if markings[a].kind == markings[b].kind and _overlap(corners[a], corners[b]) > OVERLAP
    ]


def _overlap(first: FloatArray, second: FloatArray) -> float:
    area = min(abs(cv2.contourArea(first)), abs(cv2.contourArea(second)))
    # About an origin of their own: in map coordinates single precision would not do.
    origin = first.mean(axis=0)
    shared, _ = cv2.intersectConvexConvex(first - origin, second - origin)
    return float(shared) / max(area, 1e-6)
