"""The path of a drive in its map: places by arc length and offset, and the part that a frame may see."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.geometry.planar import cross, turned_left
from v2hdm.records import FloatArray, IntArray

_STATION_M = 1.0  # least distance of places on the path: the noise of a standing vehicle is no motion
AHEAD_M = 30.0  # range along the path that a frame may see; beyond, the route may pass again
_TURN_M = 10.0  # distance that a heading difference of 1 rad counts as


@dataclass(frozen=True)
class Paths:
    """The paths of a drive's sessions through F frames."""

    place: IntArray  # (F,) index of each frame's place, of N
    points_map: FloatArray  # (N, 2) m
    ahead: FloatArray  # (N, 2) unit vectors of the vehicle's heading
    sense: FloatArray  # (N,) 1 when driving forwards, -1 backwards
    station_m: FloatArray  # (N,) arc length, continued from session to session
    bounds_m: FloatArray  # (F, 2) range of stations that a frame may see
    position_map: FloatArray  # (F, 2) m, the vehicle's
    heading: FloatArray  # (F, 2) unit vectors
    session_ends: FloatArray  # (V, 2) stations of each session's begin and end

    @classmethod
    def of(cls, map_from_vehicle: FloatArray, session: IntArray) -> Paths:
        """Paths of poses (F, 4, 4) of sessions (F,), each in driving order."""
        points = map_from_vehicle[:, :2, 3]
        first = [0]
        for frame in range(1, len(points)):
            last = first[-1]
            if session[frame] != session[last] or np.hypot(*(points[frame] - points[last])) >= _STATION_M:
                first.append(frame)
        place = np.zeros(len(points), dtype=np.int64)
        place[first[1:]] = 1
        place = np.cumsum(place)
        at = points[first]
        ahead = map_from_vehicle[first][:, :2, 0]
        step = np.diff(at, axis=0)
        begins = np.append(True, np.diff(session[first]) != 0)
        # A gap between sessions keeps each out of the ground of the next.
        way_m = np.where(begins[1:], 2 * AHEAD_M, np.linalg.norm(step, axis=1))
        station = np.concatenate([[0.0], np.cumsum(way_m)])
        # A place has the sense of the step before it, at a session's start of the step after it.
        forwards = np.where(np.einsum("ni,ni->n", step, ahead[1:]) < 0, -1.0, 1.0)
        sense = np.where(begins, np.append(forwards, 1.0), np.append(1.0, forwards))
        span = {v: station[session[first] == v][[0, -1]] for v in np.unique(session).tolist()}
        here = station[place][:, None] + np.array([-AHEAD_M, AHEAD_M])
        bounds = np.clip(here, *np.array([span[v] for v in session.tolist()]).T[:, :, None])
        forward = map_from_vehicle[:, :2, 0]
        heading = forward / np.linalg.norm(forward, axis=1, keepdims=True)
        spans = np.array([*span.values()])
        return cls(place, at, heading[first], sense, station, bounds, points, heading, spans)

    def beside(self, points_map: FloatArray, frame: IntArray) -> tuple[FloatArray, FloatArray]:
        """Stations (K,) and left offsets (K,), m, of points (K, 2) near frames (K,)."""
        station = self.station_m[self.place[frame]]
        bounds = self.bounds_m[frame].T
        for _ in range(4):
            at, ahead, sense = self.at(station)
            along = np.einsum("ki,ki->k", points_map - at, ahead) * sense
            station = np.clip(station + along, *bounds)
        at, ahead, sense = self.at(station)
        off = points_map - at
        beyond = np.einsum("ki,ki->k", off, ahead) * sense
        return station + beyond, cross(ahead, off)

    def at(self, station_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Points (K, 2), unit headings (K, 2) and senses (K,) of the path at stations (K,)."""
        columns = np.hstack([self.points_map, self.ahead])
        last = len(self.station_m) - 1
        near = np.searchsorted(self.station_m, station_m).clip(max=last)
        before = np.maximum(near - 1, 0)
        begin_m = self.station_m[before]
        way_m = self.station_m[near] - self.station_m[before]
        share = np.clip((station_m - begin_m) / np.where(way_m > 0, way_m, 1.0), 0.0, 1.0)[:, None]
        at = (1 - share) * columns[before] + share * columns[near]
        ahead = at[:, 2:] / np.maximum(np.linalg.norm(at[:, 2:], axis=1, keepdims=True), 1e-9)
        return at[:, :2], ahead, self.sense[near]

    def places(self, station_m: FloatArray, left_m: FloatArray) -> FloatArray:
        """Map points (K, 2) at stations (K,) and left offsets (K,); straight beyond the ends."""
        at, ahead, sense = self.at(station_m)
        beyond = sense * (station_m - np.clip(station_m, *self.station_m[[0, -1]]))
        left = turned_left(ahead)
        return np.asarray(at + beyond[:, None] * ahead + left_m[:, None] * left)

    def seen_from(self, map_from_vehicle: FloatArray) -> Paths:
        """The same paths for frames at poses (F, 4, 4), in any order."""
        position = map_from_vehicle[:, :2, 3]
        ahead = map_from_vehicle[:, :2, 0]
        ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        # Where a route crosses itself, the place passed in this direction.
        passed = cKDTree(np.hstack([self.points_map, _TURN_M * self.ahead]))
        _, place = passed.query(np.hstack([position, _TURN_M * ahead]))
        station = self.station_m[place]
        ends = self.session_ends[np.searchsorted(self.session_ends[:, 1], station)]
        bounds = np.clip(station[:, None] + np.array([-AHEAD_M, AHEAD_M]), ends[:, :1], ends[:, 1:])
        return replace(self, place=place, bounds_m=bounds, position_map=position, heading=ahead)

    def nearest_frame(self, points_map: FloatArray) -> IntArray:
        """The frame (K,) at the place nearest to each point (K, 2)."""
        _, place = cKDTree(self.points_map).query(points_map)
        return np.asarray(np.searchsorted(self.place, place), dtype=np.int64)
