"""The tree of frames that ``/tf_static`` and ``/tf`` of a bag state, and what leads from one to another."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.rigid import interpolate, inverse, log, make_transform, rotation_from_quaternion
from v2hdm.io.trajectory import in_order
from v2hdm.records import FloatArray, FrameStep, Trajectory

Edge = tuple[str, str]  # parent and child
TF_TOPIC = "/tf"
TF_STATIC = "/tf_static"
VEHICLES = ("base_footprint", "base_link")
"""Usual names of a vehicle's frame, the one on the ground first (REP-105, REP-120)."""

ROW = 9
"""Numbers of a row: stamp, translation (3), quaternion (4), and 1 for one of ``/tf_static``."""

MOST_NAMES = 12  # of frames or topics that a message lists; chosen

_STILL_M = 0.003  # largest shift of a joint that is held still, m: play of a bracket; chosen
_STILL_RAD = np.deg2rad(0.1)  # largest turn of a joint that is held still, rad; chosen


class Link(NamedTuple):
    """The edges from a frame to another one; None where ``problem`` says why there is no fixed chain."""

    steps: tuple[FrameStep, ...] | None
    problem: str


class Frames:
    """A tree of frames: each edge has rows (N, :data:`ROW`), which are looked at where they are needed."""

    def __init__(self, rows: Mapping[Edge, FloatArray], where: str = "") -> None:
        self._rows = rows
        self._where = where
        self._tracks: dict[Edge, Trajectory] = {}
        self.names = sorted({name for edge in rows for name in edge})

    def named(self, name: str, beside: str = "") -> str | None:
        """The tree's frame of that ``name``; where only one of them has a prefix, as ``beside`` has it.

        A driver that does not know the prefix of its robot calls ``tractor_07/camera`` just ``camera``.
        """
        if name in self.names or not name:
            return name or None
        alike = [frame for frame in self.names if frame.endswith(f"/{name}") or name.endswith(f"/{frame}")]
        prefix = beside.rpartition("/")[0]
        of_robot = [frame for frame in alike if frame.rpartition("/")[0] == prefix]
        chosen = of_robot if len(of_robot) == 1 else alike
        return chosen[0] if len(chosen) == 1 else None

    def needed(self, name: str, where: str) -> str:
        """The tree's frame of that ``name``; DriveError where a tree has none, which says what it has."""
        frame = self.named(name) if self.names else name
        if frame is None:
            first = ", ".join(self.names[:MOST_NAMES])
            more = f" and {len(self.names) - MOST_NAMES} more" if len(self.names) > MOST_NAMES else ""
            raise DriveError(f"{where}: the bag's transforms have no frame '{name}'; they have {first}{more}")
        return frame

    def vehicles(self) -> list[str]:
        """Frames with the usual names of a vehicle's, with or without a prefix, the ground's ones first."""
        return [frame for name in VEHICLES for frame in self.names if frame.rpartition("/")[2] == name]

    def vehicle_of(self, cameras: Iterable[str]) -> str | None:
        """The vehicle's frame, by its usual names, that most of ``cameras`` hang on without moving."""
        fixed_cameras = {
            vehicle: sum(self.fixed(vehicle, camera) is not None for camera in cameras)
            for vehicle in self.vehicles()
        }
        best = max(fixed_cameras, key=lambda vehicle: fixed_cameras[vehicle], default=None)
        prefixes = {vehicle.rpartition("/")[0] for vehicle in fixed_cameras}
        return best if best is not None and (fixed_cameras[best] or len(prefixes) == 1) else None

    def holders(self, cameras: Iterable[str]) -> list[str]:
        """Frames that all of ``cameras`` hang on without moving, but for these themselves."""
        cameras = list(cameras)
        return [
            name
            for name in self.names
            if name not in cameras and all(self.fixed(name, camera) is not None for camera in cameras)
        ]

    def height_m(self, vehicle: str) -> float | None:
        """Median height of a vehicle's frame above its moving ``base_footprint``; None without one."""
        footprint = f"{vehicle.rpartition('/')[0]}/{VEHICLES[0]}".lstrip("/")
        path = None if footprint == vehicle else self._path(footprint, vehicle)
        if path is None or len(path) != 1 or len(self._track(path[0][0]).stamp_s) == 1:
            return None
        ((edge, forward),) = path
        poses = self._track(edge).map_from_vehicle
        return float(np.median((poses if forward else inverse(poses))[:, 2, 3]))

    def link(self, dst: str, src: str) -> Link:
        """The fixed edges on the way from ``dst`` to ``src``."""
        path = self._path(dst, src)
        if path is None:
            return Link(None, f"no transforms lead from {src} to {dst}")
        steps = []
        for edge, _ in path:
            if (problem := self._moves(edge)) or (problem := self._contradicts(edge, dst, src, path)):
                return Link(None, problem)
            steps.append(FrameStep(*edge, self._still(edge)))
        return Link(tuple(steps), "")

    def fixed(self, dst: str, src: str) -> FloatArray | None:
        """``dst_from_src`` (4 x 4) where all edges between them are fixed, else None."""
        path = self._path(dst, src)
        return None if path is None or self.link(dst, src).steps is None else self._along(path)

    def leads(self, dst: str, src: str) -> bool:
        """Whether transforms lead from ``src`` to ``dst``, moving or not."""
        return self._path(dst, src) is not None

    def root(self, name: str) -> str:
        """The frame that ``name`` hangs on in the end."""
        parents = {child: parent for parent, child in self._rows}
        passed = {name}
        while name in parents and parents[name] not in passed:
            name = parents[name]
            passed.add(name)
        return name

    def below(self, name: str) -> list[str]:
        """The frames that hang on ``name``, nearest ones first."""
        frames = [name]
        for frame in frames:  # which grows
            frames += [child for parent, child in self._rows if parent == frame and child not in frames]
        return frames[1:]

    def moving(self, dst: str, src: str, max_gap_s: float, where: str) -> Trajectory:
        """``dst_from_src`` at the times of the busiest edge between them; DriveError where there are none."""
        path = self._path(dst, src)
        if path is None:
            names = ", ".join(self.names)
            raise DriveError(f"{where}: no transforms lead from {src} to {dst}; available: {names}")
        tracks = [(self._track(edge), forward) for edge, forward in path]
        busiest = max((track for track, _ in tracks), key=lambda track: len(track.stamp_s), default=None)
        if busiest is None or len(busiest.stamp_s) < 2:
            raise DriveError(f"{where}: {src} does not move in {dst}; give the map's frame and the vehicle's")
        stamp_s = busiest.stamp_s
        inside = np.ones(len(stamp_s), dtype=bool)
        out = np.tile(np.eye(4), (len(stamp_s), 1, 1))
        for track, forward in tracks:
            poses = np.broadcast_to(track.map_from_vehicle[0], (len(stamp_s), 4, 4))
            if len(track.stamp_s) > 1:
                poses, has_pose = interpolate(track, stamp_s, max_gap_s)
                inside &= has_pose
            out = out @ (poses if forward else inverse(poses))
        if not inside.any():
            problem = f"the transforms between {src} and {dst} are never known at the same time"
            raise DriveError(f"{where}: {problem}; record them again")
        return Trajectory(stamp_s[inside], out[inside])

    def _track(self, edge: Edge) -> Trajectory:
        """``parent_from_child`` over time, once where the edge is still, else in the order of time."""
        if edge not in self._tracks:
            rows = self._rows[edge]
            place = f"{self._where}, {edge[0]} to {edge[1]}"
            # What is always so has no order of time; stated beside a motion, it is what holds (tf2).
            always = rows[rows[:, ROW - 1] > 0]
            rows = always if len(always) else rows[in_order(rows[:, 0], place, "transform")]
            norm = np.linalg.norm(rows[:, 4:8], axis=1, keepdims=True)
            if not np.isfinite(rows).all() or (norm < 0.5).any():
                problem = f"the transform of {edge[1]} in {edge[0]} is invalid"
                raise DriveError(f"{self._where}: {problem}; record it again")
            poses = make_transform(rotation_from_quaternion(rows[:, 4:8] / norm), rows[:, 1:4])
            middle = int(np.argmin(np.abs(poses - np.median(poses, axis=0)).max(axis=(1, 2))))
            stamp_s = rows[:, 0]
            if _is_still(poses):  # old recorders publish fixed frames again and again
                stamp_s = stamp_s[[middle]]
                poses = poses[[middle]]
            self._tracks[edge] = Trajectory(stamp_s, poses)
        return self._tracks[edge]

    def _still(self, edge: Edge) -> FloatArray:
        """``parent_from_child`` of an edge that does not move."""
        return np.asarray(self._track(edge).map_from_vehicle[0])

    def _moves(self, edge: Edge) -> str:
        """The reason why an edge is not fixed; empty where it is."""
        poses = self._track(edge).map_from_vehicle
        if len(poses) == 1:
            return ""
        shift_m, turn_rad = _spread(poses)
        much = f"{shift_m:.2g} m and {np.rad2deg(turn_rad):.2g} deg"
        if self._rows[edge][:, ROW - 1].any():
            return f"{TF_STATIC} states where {edge[1]} is on {edge[0]} several times, up to {much} apart"
        return f"{edge[1]} moves on {edge[0]} while recorded, by up to {much}"

    def _contradicts(self, edge: Edge, dst: str, src: str, path: Path) -> str:
        """The complaint if a way around an edge of ``path`` leads elsewhere; empty where none does.

        A frame that hangs on two others is no tree, and TF keeps whichever was stated last.
        """
        around = self._path(dst, src, without=edge)
        if around is None or any(len(self._track(step).stamp_s) > 1 for step, _ in around):
            return ""
        poses_of_ways = np.array([self._along(path), self._along(around)])
        if _is_still(poses_of_ways):
            return ""
        shift_m, turn_rad = _spread(poses_of_ways)
        ways = " and on ".join(sorted({parent for parent, child in self._rows if child == edge[1]}))
        return (
            f"{edge[1]} hangs on {ways}, which puts {src} at two places on {dst}, {shift_m:.2g} m and "
            f"{np.rad2deg(turn_rad):.2g} deg apart"
        )

    def _along(self, path: Path) -> FloatArray:
        out = np.eye(4)
        for edge, forward in path:
            out = out @ (self._still(edge) if forward else inverse(self._still(edge)))
        return out

    def _path(self, dst: str, src: str, without: Edge | None = None) -> Path | None:
        """Edges from ``dst`` to ``src``, each with whether it leads from parent to child."""
        paths: dict[str, Path] = {dst: []}
        queue = [dst]
        for here in queue:  # which grows
            for neighbour, edge, forward in self._neighbours[here]:
                if neighbour not in paths and edge != without:
                    paths[neighbour] = [*paths[here], (edge, forward)]
                    queue.append(neighbour)
        return paths.get(src)

    @cached_property
    def _neighbours(self) -> Mapping[str, list[tuple[str, Edge, bool]]]:
        neighbours: dict[str, list[tuple[str, Edge, bool]]] = defaultdict(list)
        for parent, child in self._rows:
            neighbours[parent].append((child, (parent, child), True))
            neighbours[child].append((parent, (parent, child), False))
        return neighbours


Path = list[tuple[Edge, bool]]  # edges, and whether each leads from parent to child


def _is_still(poses: FloatArray) -> bool:
    shift_m, turn_rad = _spread(poses)
    return shift_m <= _STILL_M and turn_rad <= _STILL_RAD


def _spread(poses: FloatArray) -> tuple[float, float]:
    """The largest shift, m, and turn, rad, of poses (N, 4, 4) from the first one."""
    tangents = log(inverse(poses[0]) @ poses)
    shift_m = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1)
    return float(shift_m.max()), float(np.linalg.norm(tangents[:, 3:], axis=1).max())


def tf_topics(names: Iterable[str]) -> list[str]:
    """The topics of transforms among ``names``: those of the only namespace that has any, or of none."""
    of_namespace: dict[str, list[str]] = defaultdict(list)
    for name in names:
        namespace, slash, last = name.rpartition("/")
        if f"{slash}{last}" in (TF_TOPIC, TF_STATIC):
            of_namespace[namespace].append(name)
    without = of_namespace.pop("", [])
    return without or (next(iter(of_namespace.values())) if len(of_namespace) == 1 else [])


def transform_rows(fields: Any, topic: str) -> Iterable[tuple[Edge, tuple[float, ...]]]:
    """Edges of a ``TFMessage`` on ``topic`` with their rows."""
    for transform in fields.transforms:
        move = transform.transform.translation
        turn = transform.transform.rotation
        stamp = transform.header.stamp
        stamp_s = stamp.sec + stamp.nanosec / 1e9
        is_static = float(topic.endswith(TF_STATIC))
        row = (stamp_s, move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w, is_static)
        yield (frame_name(transform.header.frame_id), frame_name(transform.child_frame_id)), row


def frame_name(name: str) -> str:
    """A frame's name without the slash that old recorders put before it."""
    if not name.isprintable():
        raise DriveError(f"a frame is named {name!r}: names need visible characters; rename it in the bag")
    return name.lstrip("/")
