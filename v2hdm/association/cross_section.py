r"""The ground beside the vehicle's path where it is no plane: its cross-section, and pixels as of a plane.

Everything else of the mapping knows the plane z = 0 on which the vehicle stands. A road falls to both sides
of its crown; relative to that plane a point d to the left of the vehicle's own path lies at the height

.. math:: h(d) = -a_0 |d| - \sum_k a_k \max(0, \pm d - d_k),

alike along the route: slopes that change at the path and at knots beside it, which hold a crown anywhere and
sides that lean. A slope common to both sides is none of it: whatever leans under the vehicle takes the
vehicle along, and is the recorded road's (:mod:`v2hdm.io.drive.road`).

So that no engine, association or lane fit has to know of h, pixels are moved to where the image would show
the same place of the map on the plane (:meth:`CrossSection.flattened`), covariances with them. Under the
poses by which they are moved, a corner then fits its pixels exactly where its point on the ground does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.association.sightings import Rig, Sightings
from v2hdm.geometry.ipm import apply_homography, pinhole_px_from_ground
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import BoolArray, FloatArray, IntArray

KNOTS_M = (1.75, 3.5, 5.25)
"""Where beside the path the slope may change: every half lane of 3.5 m. A crown lies along a lane line, half
a lane or one and a half from the middle of the vehicle's own; one elsewhere is smoothed by 2 cm at most."""

SLOPE_SIGMA = 0.03
"""Standard deviation of a change of slope: roads fall by 1.5 to 2.5 % to each side of a crown (AASHTO, A
Policy on Geometric Design of Highways and Streets, 7th ed., section 4.2.2)."""

_STATION_M = 1.0  # nearer frames are one place of the path: a vehicle that stands drives none in its noise
_AHEAD_M = 30.0  # beyond this way, ahead or behind, the path is another time's
_REACH_M = 40.0  # ground farther from the camera stays as it is: h is known beside the path alone
_STEPS = 8  # of Newton's method, where three to four are enough
_SURE_M = 1e-7  # of its end
_STEP_PX = 0.5  # of the differences by pixel


@dataclass(frozen=True)
class Paths:
    """The paths of a drive's visits through F frames.

    Attributes:
        place: (F,) the place, of N, that each frame is at.
        points_map: (N, 2) m.
        ahead: (N, 2) unit vectors of the vehicle's heading.
        sense: (N,) 1 where it drives that way, -1 backwards.
        station_m: (N,) the way, rising with it, through one visit after the other.
        bounds_m: (F, 2) stations between which a frame's ground is looked for.
    """

    place: IntArray
    points_map: FloatArray
    ahead: FloatArray
    sense: FloatArray
    station_m: FloatArray
    bounds_m: FloatArray

    @classmethod
    def of(cls, map_from_vehicle: FloatArray, visit: IntArray) -> Paths:
        """Of poses (F, 4, 4) of the frames of visits (F,), each in driving order."""
        points, first = map_from_vehicle[:, :2, 3], [0]
        for frame in range(1, len(points)):
            last = first[-1]
            if visit[frame] != visit[last] or np.hypot(*(points[frame] - points[last])) >= _STATION_M:
                first.append(frame)
        place = np.zeros(len(points), dtype=np.int64)
        place[first[1:]] = 1
        place = np.cumsum(place)
        at, ahead = points[first], map_from_vehicle[first][:, :2, 0]
        step = np.diff(at, axis=0)
        station = np.concatenate([[0.0], np.cumsum(np.linalg.norm(step, axis=1))])
        # The step that a place ends has its sense, or where a visit begins the one that follows.
        forwards = np.where(np.einsum("ni,ni->n", step, ahead[1:]) < 0, -1.0, 1.0)
        begins = np.append(True, np.diff(visit[first]) != 0)
        sense = np.where(begins, np.append(forwards, 1.0), np.append(1.0, forwards))
        span = {v: station[visit[first] == v][[0, -1]] for v in np.unique(visit).tolist()}
        here = station[place][:, None] + np.array([-_AHEAD_M, _AHEAD_M])
        bounds = np.clip(here, *np.array([span[v] for v in visit.tolist()]).T[:, :, None])
        return cls(place, at, ahead / np.linalg.norm(ahead, axis=1, keepdims=True), sense, station, bounds)

    def beside(self, points_map: FloatArray, frame: IntArray) -> tuple[FloatArray, FloatArray]:
        """How far points (K, 2) lie to the left of the path near frames (K,), and the left there (K, 2)."""
        station = self.station_m[self.place[frame]]
        for _ in range(4):
            at, ahead, sense = self._at(station)
            along = np.einsum("ki,ki->k", points_map - at, ahead) * sense
            station = np.clip(station + along, *self.bounds_m[frame].T)
        at, ahead, _ = self._at(station)
        left = np.column_stack([-ahead[:, 1], ahead[:, 0]])
        return np.einsum("ki,ki->k", points_map - at, left), left

    def _at(self, station_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        columns = np.column_stack([self.points_map, self.ahead])
        at = np.column_stack([np.interp(station_m, self.station_m, one) for one in columns.T])
        ahead = at[:, 2:] / np.maximum(np.linalg.norm(at[:, 2:], axis=1, keepdims=True), 1e-9)
        near = np.searchsorted(self.station_m, station_m).clip(max=len(self.station_m) - 1)
        return at[:, :2], ahead, self.sense[near]

    def nearest_frame(self, points_map: FloatArray) -> IntArray:
        """The frame (K,) at the place nearest to each point (K, 2)."""
        _, place = cKDTree(self.points_map).query(points_map)
        return np.asarray(np.searchsorted(self.place, place), dtype=np.int64)


def hinges(left_m: FloatArray) -> FloatArray:
    """The heights (K, B) that a unit of each parameter gives to points (K,) to the left of the path."""
    sides = [np.maximum(side * left_m - knot, 0.0) for side in (1.0, -1.0) for knot in KNOTS_M]
    return -np.column_stack([np.abs(left_m), *sides])


def sentence_of(falls: FloatArray) -> str:
    """One sentence on the heights that parameters (B,) give the ground."""
    left_m = np.array([-8.0, -4.0, 4.0, 8.0])
    heights_cm = (100 * hinges(left_m) @ falls).tolist()
    told = ", ".join(
        f"{height:+.0f} cm {abs(d):.0f} m to the {'left' if d > 0 else 'right'}"
        for d, height in zip(left_m.tolist(), heights_cm, strict=True)
    )
    return f"the ground beside the vehicle's path is no plane: {told}"


@dataclass(frozen=True)
class CrossSection:
    """The cross-section of the ground along the ``paths``: ``falls`` (B,) a_0 and a_k, left ones first."""

    falls: FloatArray
    paths: Paths

    def height_m(self, points_map: FloatArray, frame: IntArray | None = None) -> FloatArray:
        """Heights (K,) of the ground at points (K, 2) seen from frames (K,); None takes the nearest ones."""
        frame = self.paths.nearest_frame(points_map) if frame is None else frame
        return np.asarray(hinges(self.paths.beside(points_map, frame)[0]) @ self.falls)

    def _slope(self, left_m: FloatArray) -> FloatArray:
        """Slopes (K,) of the ground to the left."""
        side = np.sign(left_m)
        sides = [s * (s * left_m > knot) for s in (1.0, -1.0) for knot in KNOTS_M]
        return np.asarray(-np.column_stack([side, *sides]) @ self.falls)

    def points(
        self, rays: FloatArray, centre_map: FloatArray, frame: IntArray
    ) -> tuple[FloatArray, BoolArray]:
        """Where rays (K, 3) from cameras (K, 3) at frames (K,) meet the ground (K, 2), and which (K,) do.

        Those that meet it nowhere, or far away, stay on the plane.
        """
        with np.errstate(all="ignore"):
            plane = centre_map[:, :2] - (centre_map[:, 2:] / rays[:, 2:]) * rays[:, :2]
            found = (rays[:, 2] < 0) & (np.linalg.norm(plane - centre_map[:, :2], axis=1) < _REACH_M)
        far = np.where(found, -centre_map[:, 2] / np.where(found, rays[:, 2], -1.0), 0.0)
        off = np.zeros(len(far))
        for _ in range(_STEPS):
            points = centre_map + far[:, None] * rays
            left_m, left = self.paths.beside(points[:, :2], frame)
            off = points[:, 2] - hinges(left_m) @ self.falls
            fall = rays[:, 2] - self._slope(left_m) * np.einsum("ki,ki->k", rays[:, :2], left)
            far = far - np.where(found, off / np.where(fall < 0, fall, -np.inf), 0.0)
        found &= (np.abs(off) < _SURE_M) & (far > 0)
        return np.where(found[:, None], centre_map[:, :2] + far[:, None] * rays[:, :2], plane), found

    def flattened_px(
        self, intrinsic: FloatArray, cam_from_map: FloatArray, frame: IntArray, pixels: FloatArray
    ) -> FloatArray:
        """Where images would show on the plane what they show at pinhole pixels (K, 2) of the ground.

        Args:
            intrinsic: (K, 3, 3).
            cam_from_map: (K, 4, 4).
            frame: (K,).
            pixels: (K, 2).
        """
        turn = cam_from_map[:, :3, :3]
        cam = np.linalg.solve(intrinsic, np.column_stack([pixels, np.ones(len(pixels))])[..., None])
        rays = (np.swapaxes(turn, 1, 2) @ cam)[..., 0]
        points, found = self.points(rays, camera_centre(cam_from_map), frame)
        plan = pinhole_px_from_ground(intrinsic, cam_from_map)
        moved = apply_homography(plan, np.where(found[:, None], points, 0.0)[:, None])[:, 0]
        return np.where(found[:, None], moved, pixels)

    def flattened(self, sightings: Sightings, rig: Rig) -> Sightings:
        """``sightings`` as if all that they show lay on the plane z = 0, under the cameras of ``rig``."""

        def moved(camera: IntArray, frame: IntArray, pixels: FloatArray) -> FloatArray:
            known = np.isfinite(pixels).all(axis=1)
            camera, frame, out = camera[known], frame[known], pixels.copy()
            cam_from_map = rig.cam_from_map(camera, frame)
            out[known] = self.flattened_px(rig.intrinsic[camera], cam_from_map, frame, pixels[known])
            return out

        camera, frame = np.repeat(sightings.camera, 4), np.repeat(sightings.frame, 4)
        pixels = sightings.corners_pinhole_px.reshape(-1, 2)
        columns = [
            moved(camera, frame, pixels + step) - moved(camera, frame, pixels - step)
            for step in _STEP_PX * np.eye(2)
        ]
        jacobian = np.stack(columns, axis=2).reshape(-1, 4, 2, 2) / (2 * _STEP_PX)
        symbols = sightings.symbols
        if len(symbols.camera):
            length = [len(outline) for outline in symbols.outlines_pinhole_px]
            of_point = np.repeat(np.arange(len(length)), length)
            outlines = np.concatenate(symbols.outlines_pinhole_px)
            outlines = moved(symbols.camera[of_point], symbols.frame[of_point], outlines)
            parts = np.split(outlines, np.cumsum(length)[:-1])
            symbols = replace(symbols, outlines_pinhole_px=tuple(parts))
        return replace(
            sightings,
            corners_pinhole_px=moved(camera, frame, pixels).reshape(-1, 4, 2),
            covariance_px=jacobian @ sightings.covariance_px @ np.swapaxes(jacobian, -1, -2),
            symbols=symbols,
        )
