"""Frames of a bag: fixed ones (``/tf_static``) and moving ones (``/tf``) as transforms between any two."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.rigid import inverse, make_transform, rotation_from_quaternion
from v2hdm.geometry.trajectory import interpolate
from v2hdm.io.trajectory import in_order
from v2hdm.records import FloatArray, Trajectory

Edge = tuple[str, str]  # parent and child
TF_TOPIC, TF_STATIC = "/tf", "/tf_static"

_FIXED = 1e-9  # elements of a transform, m or 1, that change by less do so by rounding


class Frames:
    """A tree of frames; each edge holds ``parent_from_child`` over time, one alone where it is fixed."""

    def __init__(self, edges: Mapping[Edge, Trajectory]) -> None:
        self._edges = edges
        self.names = sorted({name for edge in edges for name in edge})

    @classmethod
    def of(cls, rows: Mapping[Edge, FloatArray], where: str) -> Frames:
        """Frames of rows (N, 8) of stamp, translation and quaternion."""
        edges = {}
        for (parent, child), table in rows.items():
            table = table[in_order(table[:, 0], f"{where}, {parent} to {child}", "transform")]
            norm = np.linalg.norm(table[:, 4:], axis=1, keepdims=True)
            if not np.isfinite(table).all() or (norm < 0.5).any():
                raise DriveError(f"{where}: the transform of {child} in {parent} is none; record it anew")
            poses = make_transform(rotation_from_quaternion(table[:, 4:] / norm), table[:, 1:4])
            # Old recorders publish fixed frames again and again.
            moves = len(poses) > 1 and bool(np.ptp(poses, axis=0).max() > _FIXED)
            count = len(poses) if moves else 1
            edges[parent, child] = Trajectory(table[:count, 0], poses[:count])
        return cls(edges)

    def fixed(self, dst: str, src: str) -> FloatArray | None:
        """``dst_from_src`` (4 x 4) where all edges between them are fixed, else None."""
        path = self._path(dst, src)
        if path is None or any(len(self._edges[edge].stamp_s) > 1 for edge, _ in path):
            return None
        out = np.eye(4)
        for edge, forward in path:
            step = self._edges[edge].map_from_vehicle[0]
            out = out @ (step if forward else inverse(step))
        return out

    def moving(self, dst: str, src: str, max_gap_s: float, where: str) -> Trajectory:
        """``dst_from_src`` at the times of the busiest edge between them; DriveError where there are none."""
        path = self._path(dst, src)
        if path is None:
            names = ", ".join(self.names)
            raise DriveError(f"{where}: no transforms lead from {src} to {dst}; there are: {names}")
        tracks = [(self._edges[edge], forward) for edge, forward in path]
        busiest = max((track for track, _ in tracks), key=lambda track: len(track.stamp_s), default=None)
        if busiest is None or len(busiest.stamp_s) < 2:
            raise DriveError(f"{where}: {src} does not move in {dst}; name the map's frame and the vehicle's")
        stamp_s = busiest.stamp_s
        inside = np.ones(len(stamp_s), dtype=bool)
        out = np.tile(np.eye(4), (len(stamp_s), 1, 1))
        for track, forward in tracks:
            poses = np.broadcast_to(track.map_from_vehicle[0], (len(stamp_s), 4, 4))
            if len(track.stamp_s) > 1:
                poses, known = interpolate(track, stamp_s, max_gap_s)
                inside &= known
            out = out @ (poses if forward else inverse(poses))
        if not inside.any():
            problem = f"the transforms between {src} and {dst} are never known at one time"
            raise DriveError(f"{where}: {problem}; record them anew")
        return Trajectory(stamp_s[inside], out[inside])

    def _path(self, dst: str, src: str) -> list[tuple[Edge, bool]] | None:
        """Edges from ``dst`` to ``src``, each with whether it leads from parent to child."""
        neighbours: dict[str, list[tuple[str, Edge, bool]]] = defaultdict(list)
        for parent, child in self._edges:
            neighbours[parent].append((child, (parent, child), True))
            neighbours[child].append((parent, (parent, child), False))
        paths: dict[str, list[tuple[Edge, bool]]] = {dst: []}
        queue = [dst]
        for here in queue:  # which grows
            for there, edge, forward in neighbours[here]:
                if there not in paths:
                    paths[there] = [*paths[here], (edge, forward)]
                    queue.append(there)
        return paths.get(src)


def transform_rows(fields: Any) -> list[tuple[Edge, tuple[float, ...]]]:
    """Edges of a ``TFMessage`` with their rows of stamp, translation and quaternion."""
    rows: list[tuple[Edge, tuple[float, ...]]] = []
    for one in fields.transforms:
        move, turn = one.transform.translation, one.transform.rotation
        stamp = one.header.stamp
        row = (stamp.sec + stamp.nanosec / 1e9, move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w)
        rows.append(((frame_name(one.header.frame_id), frame_name(one.child_frame_id)), row))
    return rows


def frame_name(name: str) -> str:
    """A frame's name without the slash that old recorders put before it."""
    if not name.isprintable():
        raise DriveError(f"a frame is named {name!r}: names have letters that show; rename it in the bag")
    return name.lstrip("/")
