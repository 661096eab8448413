"""The path of a drive in its map: places by arc length and offset, and the part that a frame may see."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.geometry.planar import cross, turned_left
from v2hdm.records import FloatArray, IntArray

_STATION_M = 1.0  # least distance of places on the path: the noise of a standing vehicle is no motion
AHEAD_M = 30.0  # range along the path that a frame may see; beyond, the route may pass again
_TURN_M = 10.0  # distance that a heading difference of 1 rad counts as


class Beside(NamedTuple):
    """K places beside a path."""

    station_m: FloatArray  # (K,) arc length along the path
    left_m: FloatArray  # (K,) offset to its left


class OnPath(NamedTuple):
    """A path at K stations."""

    points_map: FloatArray  # (K, 2) m
    ahead: FloatArray  # (K, 2) unit vectors of the vehicle's heading
    sense: FloatArray  # (K,) 1 when driving forwards, -1 backwards


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
            step_x_m, step_y_m = points[frame] - points[last]
            if session[frame] != session[last] or np.hypot(step_x_m, step_y_m) >= _STATION_M:
                first.append(frame)
        place = np.zeros(len(points), dtype=np.int64)
        place[first[1:]] = 1
        place = np.cumsum(place)
        places_map = points[first]
        ahead = map_from_vehicle[first][:, :2, 0]
        step = np.diff(places_map, axis=0)
        begins = np.append(True, np.diff(session[first]) != 0)
        # A gap between sessions keeps each out of the ground of the next.
        way_m = np.where(begins[1:], 2 * AHEAD_M, np.linalg.norm(step, axis=1))
        station = np.concatenate([[0.0], np.cumsum(way_m)])
        # A place has the sense of the step before it, at a session's start of the step after it.
        forwards = np.where(np.einsum("ni,ni->n", step, ahead[1:]) < 0, -1.0, 1.0)
        sense = np.where(begins, np.append(forwards, 1.0), np.append(1.0, forwards))
        span_of_session = {v: station[session[first] == v][[0, -1]] for v in np.unique(session).tolist()}
        range_m = station[place][:, None] + np.array([-AHEAD_M, AHEAD_M])
        span = np.array([span_of_session[v] for v in session.tolist()])
        forward = map_from_vehicle[:, :2, 0]
        heading = forward / np.linalg.norm(forward, axis=1, keepdims=True)
        return cls(
            place=place,
            points_map=places_map,
            ahead=heading[first],
            sense=sense,
            station_m=station,
            bounds_m=np.clip(range_m, span[:, :1], span[:, 1:]),
            position_map=points,
            heading=heading,
            session_ends=np.array(list(span_of_session.values())),
        )

    def beside(self, points_map: FloatArray, frame: IntArray) -> Beside:
        """The places of points (K, 2) near frames (K,)."""
        station = self.station_m[self.place[frame]]
        least_m, most_m = self.bounds_m[frame].T
        for _ in range(4):
            points, ahead, sense = self.at(station)
            along = np.einsum("ki,ki->k", points_map - points, ahead) * sense
            station = np.clip(station + along, least_m, most_m)
        points, ahead, sense = self.at(station)
        off = points_map - points
        beyond = np.einsum("ki,ki->k", off, ahead) * sense
        return Beside(station + beyond, cross(ahead, off))

    def at(self, station_m: FloatArray) -> OnPath:
        """The path at stations (K,)."""
        columns = np.hstack([self.points_map, self.ahead])
        last = len(self.station_m) - 1
        after = np.searchsorted(self.station_m, station_m).clip(max=last)
        before = np.maximum(after - 1, 0)
        begin_m = self.station_m[before]
        way_m = self.station_m[after] - self.station_m[before]
        share = np.clip((station_m - begin_m) / np.where(way_m > 0, way_m, 1.0), 0.0, 1.0)[:, None]
        interpolated = (1 - share) * columns[before] + share * columns[after]
        ahead = interpolated[:, 2:] / np.maximum(
            np.linalg.norm(interpolated[:, 2:], axis=1, keepdims=True), 1e-9
        )
        return OnPath(interpolated[:, :2], ahead, self.sense[after])

    def points_at(self, beside: Beside) -> FloatArray:
        """Map points (K, 2) of places beside the path, which goes on straight beyond its ends."""
        station_m = beside.station_m
        points, ahead, sense = self.at(station_m)
        beyond = sense * (station_m - np.clip(station_m, self.station_m[0], self.station_m[-1]))
        left = turned_left(ahead)
        return np.asarray(points + beyond[:, None] * ahead + beside.left_m[:, None] * left)

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
