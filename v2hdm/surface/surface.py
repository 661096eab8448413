r"""Ground that is not a plane: heights along and beside the path, and sightings reduced to the plane.

The rest of the mapping assumes the plane z = 0 under the vehicle. At arc length s along the path and offset
d to its left, the ground's height is

.. math:: H(s, d) = g x(s, d) - a_0 |d| - \sum_k a_k \max(0, \pm d - d_k) + \sum_{ij} c_{ij} B_i(s) B_j(d),

a grade g of the whole map, a cross-section whose slopes change at the path and at knots beside it (a crown),
and a bicubic spline: bank, ramps, crests and dips. The grade is a term of its own, as a plane has a kink in s
where the path begins to bend. Priors: slopes a are 0 +- 3 %; second differences of c along, across and mixed
have one standard deviation each, estimated by marginal likelihood, so that without evidence the ground is a
plane; heights and slopes on the path are the recorded ones (:mod:`v2hdm.io.drive.road`) within their noise.

A frame sees heights above the plane on which its vehicle stands, which touches H: planes drop out. Pixels and
their covariances are moved to where the image would show the same map point on that plane
(:meth:`Surface.flattened`), so that engines, association and lane fits need not know H. Under the poses of
that reduction a corner fits its pixels exactly where its ground point does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize
from scipy.sparse import csr_array, diags_array, hstack

from v2hdm.association.sightings import Rig, Sightings, Symbols
from v2hdm.geometry.ipm import apply_homography, pinhole_px_from_ground
from v2hdm.geometry.planar import cross, turned_left
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import BoolArray, FloatArray, GroundStrip, IntArray
from v2hdm.surface.basis import (
    ACROSS,
    ACROSS_KNOTS,
    ALONG_M,
    GRADES,
    MOST_ALONG,
    SHAPE,
    Knots,
    cubic,
    hinges,
)
from v2hdm.surface.paths import AHEAD_M, Beside, Paths
from v2hdm.surface.prior import CURVATURE, LEAN, SIZES_SIGMA, Recorded, Smoothness

_GRID_M = 0.5  # cell size of the ground as written, m
_STRIP_M = 8.0  # half width of the ground as written, m
_WHEELS_M = (2.8, 0.8)  # wheelbase and half the track, m; the vehicle's origin is under the rear axle

_REACH_M = 40.0  # ground farther from the camera, m, is not corrected: H is known near the path alone
_STEPS = 12  # most steps of the secant method by which a ray meets the ground; four to six suffice
_SURE_M = 1e-7  # tolerance of the secant method, m
_STEP_PX = 0.5  # step of finite differences by pixel, px
_TOUCH_M = 0.01  # step of finite differences of heights by position, m

_MOST_RECORDED = 500  # largest number of evenly spaced path points whose records are used
_FORGOTTEN = 1e-2  # fraction of the total height variance that is dropped with the smallest errors

Heights = Callable[[FloatArray], FloatArray]
"""Heights (K,) at points (K, 2)."""

_STORED = ("points_map", "ahead", "sense", "station_m", "session_ends")
"""Fields of the paths that are stored; frames are assigned on reading."""


class _Footprints(NamedTuple):
    """Jacobians (F, B), by the parameters, of the planes on which vehicles stand at F frames."""

    height: csr_array
    forwards: csr_array  # of the slope ahead
    sideways: csr_array  # of the slope to the left


class _Stands(NamedTuple):
    """The planes on which vehicles stand at F frames."""

    height_m: FloatArray  # (F,)
    forwards: FloatArray  # (F,) slope ahead
    sideways: FloatArray  # (F,) slope to the left


class _Records(NamedTuple):
    """Records of the ground on the path."""

    information: FloatArray  # (B, B) on the parameters
    vector: FloatArray  # (B,) information times parameters
    datum_m: float  # mean height, m


@dataclass(frozen=True)
class Surface:
    """The ground along the ``paths``."""

    paths: Paths  # of all sessions
    parameters: FloatArray  # (B,) grade g, slopes a, left ones first, then c, across varying fastest
    covariance: FloatArray  # (B, B) of the parameters
    knots: Knots  # along the path
    datum_m: float = 0.0  # added to all heights
    _stands: _Stands = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Cache the plane of each frame's vehicle."""
        height, forwards, sideways = (jacobian @ self.parameters for jacobian in self._footprints())
        object.__setattr__(self, "_stands", _Stands(height, forwards, sideways))

    @classmethod
    def level(cls, paths: Paths) -> Surface:
        """A plane, the start value."""
        begin_m, end_m = (paths.station_m[[0, -1]] + [-AHEAD_M, AHEAD_M]).tolist()
        step_m = max(ALONG_M, (end_m - begin_m) / MOST_ALONG)
        along = int(np.ceil((end_m - begin_m) / step_m)) + 3
        size = SHAPE + along * ACROSS
        return cls(paths, np.zeros(size), np.zeros((size, size)), Knots(begin_m, step_m, along))

    def _columns(self, beside: Beside) -> csr_array:
        """Jacobian (K, B) by the parameters of heights at places beside the path."""
        i, by_way = cubic(beside.station_m, self.knots)
        j, by_side = cubic(beside.left_m, ACROSS_KNOTS)
        index = (i[:, :, None] * ACROSS + j[:, None, :]).reshape(-1)
        value = (by_way[:, :, None] * by_side[:, None, :]).reshape(-1)
        places = len(beside.station_m)
        bounds = 16 * np.arange(places + 1)
        spline = csr_array((value, index, bounds), (places, self.knots.functions * ACROSS))
        shape = np.hstack([self._off_middle(beside), hinges(beside.left_m)])
        return csr_array(hstack([csr_array(shape), spline]))

    def _off_middle(self, beside: Beside) -> FloatArray:
        """Map x and y (K, 2), from the path's mean point, of places beside the path."""
        return np.asarray(self.paths.points_at(beside) - self.paths.points_map.mean(axis=0))

    def _footprints(self) -> _Footprints:
        """The planes of all frames, by the parameters.

        A plane touches the ground under the wheels: on a crown its origin lies below the ground.
        """
        paths = self.paths
        long, wide = _WHEELS_M
        frame = np.arange(len(paths.place))
        ahead = paths.heading
        left = turned_left(ahead)

        def under_wheels(along: float, side: float) -> csr_array:
            wheels_map = paths.position_map + along * ahead + side * left
            return self._columns(paths.beside(wheels_map, frame))

        # In a bend the front wheels leave the path of the rear axle.
        right_rear = under_wheels(0.0, -wide)
        left_rear = under_wheels(0.0, wide)
        right_front = under_wheels(long, -wide)
        left_front = under_wheels(long, wide)
        rear = (right_rear + left_rear) / 2
        front = (right_front + left_front) / 2
        sideways = (left_rear - right_rear + left_front - right_front) / (4 * wide)
        return _Footprints(rear, (front - rear) / long, sideways)

    def _from(self, points_map: FloatArray, frame: IntArray) -> FloatArray:
        """Forward and left offsets (K, 2), m, of points (K, 2) from the vehicle at frames (K,)."""
        off = points_map - self.paths.position_map[frame]
        ahead = self.paths.heading[frame]
        forwards = np.einsum("ki,ki->k", off, ahead)
        return np.column_stack([forwards, cross(ahead, off)])

    def _leaning(self, points_map: FloatArray, above_m: FloatArray, frame: IntArray) -> FloatArray:
        """Horizontal shifts (K, 2) of map points (K, 2), at heights (K,), on inclined planes at frames (K,).

        A length along a slope exceeds its map length by half the slope squared; heights lean with the plane.
        """
        forwards = self._stands.forwards[frame]
        sideways = self._stands.sideways[frame]
        along, across = self._from(points_map, frame).T
        ahead = self.paths.heading[frame]
        by_along = forwards * (forwards * along / 2 + sideways * across + above_m)
        by_across = sideways * (sideways * across / 2 + above_m)
        left = turned_left(ahead)
        return np.asarray(by_along[:, None] * ahead + by_across[:, None] * left)

    def seen_columns(self, points_map: FloatArray, frame: IntArray) -> csr_array:
        """Jacobian (K, B) of :meth:`seen_height_m` by the parameters."""
        footprints = self._footprints()
        away = self._from(points_map, frame)
        plane = footprints.height[frame]
        plane = plane + diags_array(away[:, 0]) @ footprints.forwards[frame]
        plane = plane + diags_array(away[:, 1]) @ footprints.sideways[frame]
        return csr_array(self._columns(self.paths.beside(points_map, frame)) - plane)

    def seen_errors_m(self, points_map: FloatArray, frame: IntArray) -> FloatArray:
        """Independent errors (K, B) of :meth:`seen_height_m`, one sigma each, the largest alone."""
        values, vectors = np.linalg.eigh(self.covariance)
        errors = self.seen_columns(points_map, frame) @ (vectors * np.sqrt(np.maximum(values, 0.0)))
        squared, ways = np.linalg.eigh(errors.T @ errors)
        is_large = np.cumsum(squared) > _FORGOTTEN * squared.sum()
        return np.asarray(errors @ ways[:, is_large])

    def seen_height_m(self, points_map: FloatArray, frame: IntArray) -> FloatArray:
        """Heights (K,) of the ground at points (K, 2) above the planes of the vehicle at frames (K,)."""
        away = self._from(points_map, frame)
        height_m, forwards, sideways = self._stands
        plane = height_m[frame] + away[:, 0] * forwards[frame] + away[:, 1] * sideways[frame]
        return np.asarray(self._height_m(self.paths.beside(points_map, frame)) - plane)

    def _height_m(self, beside: Beside) -> FloatArray:
        """Heights (K,) at places beside the path."""
        i, by_way = cubic(beside.station_m, self.knots)
        j, by_side = cubic(beside.left_m, ACROSS_KNOTS)
        around = self.parameters[SHAPE:].reshape(-1, ACROSS)[i[:, :, None], j[:, None, :]]
        spline = np.einsum("ki,kij,kj->k", by_way, around, by_side, optimize=True)
        graded = self._off_middle(beside) @ self.parameters[:GRADES]
        return np.asarray(graded + hinges(beside.left_m) @ self.parameters[GRADES:SHAPE] + spline)

    def height_m(self, points_map: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Heights (K,) of the ground at points (K, 2) of the map, and their standard deviations (K,)."""
        return self._at(self.paths.beside(points_map, self.paths.nearest_frame(points_map)))

    def _at(self, beside: Beside) -> tuple[FloatArray, FloatArray]:
        """Heights and standard deviations (K,) at places beside the path."""
        columns = self._columns(beside)
        variance = np.asarray((columns @ self.covariance * columns.toarray()).sum(axis=1))
        return columns @ self.parameters + self.datum_m, np.sqrt(np.maximum(variance, 0.0))

    def seen_from(self, map_from_vehicle: FloatArray) -> Surface:
        """The same ground for frames at poses (F, 4, 4) on the flat road."""
        return replace(self, paths=self.paths.seen_from(map_from_vehicle))

    def on_plane(self, points_map: FloatArray, cam_from_map: FloatArray, frame: int) -> FloatArray:
        """Points (K, 2) of z = 0 on a camera's rays to the ground's (K, 2): inverts :meth:`flattened_px`."""
        height_m = self.seen_height_m(points_map, np.full(len(points_map), frame))
        centre = camera_centre(cam_from_map)
        place = points_map
        frames = np.full(len(points_map), frame)
        for _ in range(4):
            points_map = place + self._leaning(points_map, height_m, frames)
        off = points_map - centre[:2]
        is_corrected = (np.linalg.norm(off, axis=1) < _REACH_M) & (height_m < centre[2] / 2)
        return points_map + off * np.where(is_corrected, height_m / (centre[2] - height_m), 0.0)[:, None]

    def stored(self) -> dict[str, Any]:
        """File content for :meth:`from_stored`, without the covariance."""
        arrays = {name: getattr(self.paths, name).tolist() for name in _STORED}
        return arrays | {"parameters": self.parameters.tolist(), "knots": self.knots, "datum_m": self.datum_m}

    @classmethod
    def from_stored(cls, content: Mapping[str, Any], map_from_vehicle: FloatArray) -> Surface:
        """The ground under vehicles at poses (F, 4, 4); raises ValueError if unusable."""
        try:
            points, ahead, sense, station, ends, parameters = (
                np.array(content[name], dtype=np.float64) for name in (*_STORED, "parameters")
            )
            begin_m, step_m = (float(number) for number in content["knots"][:2])
            datum_m = float(content["datum_m"])
            along = int(content["knots"][2])
        except (IndexError, KeyError, OverflowError, TypeError, ValueError):
            raise ValueError("not a ground surface: numbers are missing") from None
        places = len(station)
        nothing = np.zeros((0, 2))
        shapes = (points.shape, ahead.shape, sense.shape, ends.shape[1:], parameters.shape)
        expected = ((places, 2), (places, 2), (places,), (2,), (SHAPE + along * ACROSS,))
        numbers = np.array([begin_m, step_m, datum_m])
        arrays = (numbers, points, ahead, sense, station, ends, parameters)
        is_sound = shapes == expected and places and all(np.isfinite(array).all() for array in arrays)
        if not is_sound or step_m <= 0 or (np.diff(station) <= 0).any() or station[-1] > ends[-1, 1]:
            raise ValueError("not a ground surface: its numbers are inconsistent")
        paths = Paths(
            place=np.zeros(0, np.int64),
            points_map=points,
            ahead=ahead,
            sense=sense,
            station_m=station,
            bounds_m=nothing,
            position_map=nothing,
            heading=nothing,
            session_ends=ends,
        )
        no_covariance = np.zeros((len(parameters), len(parameters)))
        knots = Knots(begin_m, step_m, along)
        return cls(paths.seen_from(map_from_vehicle), parameters, no_covariance, knots, datum_m)

    def strips(self) -> tuple[GroundStrip, ...]:
        """The ground by session, on a grid of 0.5 m."""
        paths = self.paths
        strips = []
        left_m = np.arange(-_STRIP_M, _STRIP_M + _GRID_M / 2, _GRID_M)
        for begin_m, end_m in paths.session_ends.tolist():
            station = np.arange(begin_m, end_m, _GRID_M)
            if len(station) < 2:
                continue
            points, ahead, sense = paths.at(station)
            ahead = ahead * sense[:, None]
            stations_m, offsets_m = np.broadcast_arrays(station[:, None], (sense[:, None] * left_m))
            height, sigma = self._at(Beside(stations_m.ravel(), offsets_m.ravel()))
            shape = stations_m.shape
            strips.append(
                GroundStrip(points, ahead, _GRID_M, left_m, height.reshape(shape), sigma.reshape(shape))
            )
        return tuple(strips)

    @property
    def sentence(self) -> str:
        """One sentence on the range of the ground's heights."""
        at = self.paths.position_map
        ahead = self.paths.heading
        frame = np.arange(len(self.paths.place))
        left = turned_left(ahead)
        ranges = []
        places = (10.0 * ahead, "10 m ahead"), (4.0 * left, "4 m to the left"), (-4.0 * left, "right")
        for offset_map, where in places:
            height_cm = 100 * self.seen_height_m(at + offset_map, frame)
            ranges.append(f"{height_cm.min():+.0f} to {height_cm.max():+.0f} cm {where}")
        return f"the ground around the vehicle is not a plane: {', '.join(ranges)}"

    def estimated(
        self, information: FloatArray, score: FloatArray, recorded: Recorded
    ) -> tuple[Surface, float]:
        """Maximum a posteriori surface of a drive, and its gain: the fall of the cost beyond that by noise.

        ``information`` (B, B) and ``score`` (B,), the cost's gradient, hold at the present parameters, all
        else eliminated.
        """
        records = self._recorded(recorded)
        vector = records.vector + information @ self.parameters - score
        usual = np.full(3, np.log(CURVATURE))
        total = information + records.information
        smoothness = Smoothness.of(self.knots)

        def cost(sizes: FloatArray) -> float:
            try:
                lower = cholesky(total + smoothness.prior(sizes), lower=True, check_finite=False)
                of_prior = smoothness.log_root(sizes)
            except np.linalg.LinAlgError:  # so even that rounding leaves nothing of the ridge
                return np.inf
            fit = solve_triangular(lower, vector, lower=True, check_finite=False)
            odds = of_prior - np.log(lower.diagonal()).sum() + fit @ fit / 2
            return float(np.sum((sizes - usual) ** 2) / (2 * SIZES_SIGMA**2) - odds)

        search = {"maxfev": 60, "xatol": 0.2, "fatol": 0.2}
        best = minimize(cost, usual, method="Nelder-Mead", options=search).x
        covariance = np.asarray(np.linalg.inv(total + smoothness.prior(best)), dtype=np.float64)
        parameters = covariance @ vector
        step = parameters - self.parameters
        gain = -score @ step - step @ information @ step / 2 - np.sum(information * covariance)
        surface = replace(self, parameters=parameters, covariance=covariance, datum_m=records.datum_m)
        return surface, float(gain)

    def _recorded(self, recorded: Recorded) -> _Records:
        """The information of the records on the path."""
        size = len(self.parameters)
        frame = np.unique(np.linspace(0, len(self.paths.place) - 1, _MOST_RECORDED).astype(np.int64))
        height, slope = recorded.at(self.paths.position_map[frame])
        ahead = self.paths.heading[frame]
        station = self.paths.station_m[self.paths.place[frame]]
        forwards = np.einsum("fi,fi->f", slope, ahead)
        sideways = cross(ahead, slope)
        datum_m = float(height.mean())
        distance_m = np.abs(station[:, None] - station)
        information = np.zeros((size, size))
        vector = np.zeros(size)
        values = (height - datum_m, forwards, sideways)
        noises = (recorded.heights, recorded.slopes, (*recorded.slopes, LEAN))
        for columns, value, noise in zip(self._footprints(), values, noises, strict=True):
            covariance = 1e-6 * np.eye(len(frame))
            for sigma, over_m in noise:
                covariance += sigma**2 * np.exp(-distance_m / over_m)
            jacobian = columns[frame].toarray()
            weighted = np.linalg.solve(covariance, jacobian).T
            information += weighted @ jacobian
            vector += weighted @ value
        return _Records(information, vector, datum_m)

    def _meet(
        self, view: _View, frame: IntArray, pixels: FloatArray, seen_height_m: Heights
    ) -> tuple[FloatArray, BoolArray]:
        """Ground points (K, 2), for ground of these heights, at pixels (K, 2), and whether (K,) they exist.

        Rays that miss the ground, or meet it far away, keep their point of the plane.
        """
        rays = view.rays(pixels)
        centre_map = view.centre
        with np.errstate(all="ignore"):
            plane = centre_map[:, :2] - (centre_map[:, 2:] / rays[:, 2:]) * rays[:, :2]
            is_met = (rays[:, 2] < 0) & (np.linalg.norm(plane - centre_map[:, :2], axis=1) < _REACH_M)
        down = np.where(is_met, rays[:, 2], -1.0)
        points_map = np.zeros_like(plane)
        far_before = np.where(is_met, -centre_map[:, 2] / down, 0.0)

        def on_map(along_ray: FloatArray) -> FloatArray:
            points = centre_map + along_ray[:, None] * rays
            return points[:, :2] - self._leaning(points[:, :2], points[:, 2], frame)

        def above(far: FloatArray) -> FloatArray:
            return np.asarray(centre_map[:, 2] + far * rays[:, 2] - seen_height_m(on_map(far)))

        above_before = above(far_before)
        far = far_before - above_before / down
        for _ in range(_STEPS):
            off = above(far)
            if (np.abs(off[is_met]) < _SURE_M).all():
                break
            with np.errstate(all="ignore"):
                fall = np.where(
                    np.abs(far - far_before) > 1e-12, (off - above_before) / (far - far_before), down
                )
            far_before = far
            above_before = off
            far = far - off / np.where(fall < 0, fall, down)
        else:
            off = above(far)
        is_met &= (np.abs(off) < _SURE_M) & (far > 0)
        points_map[is_met] = on_map(far)[is_met]
        return np.where(is_met[:, None], points_map, plane), is_met

    def flattened_px(
        self, intrinsic: FloatArray, cam_from_map: FloatArray, frame: IntArray, pixels: FloatArray
    ) -> FloatArray:
        """Pinhole ``pixels`` (K, 2), each with its camera and frame, as if their ground were z = 0."""
        return self._flat_px(_View(intrinsic, cam_from_map), frame, pixels)

    def _flat_px(self, view: _View, frame: IntArray, pixels: FloatArray) -> FloatArray:
        """``pixels`` (K, 2) as if their ground were z = 0; those without ground stay."""
        points, is_met = self._shown(view, frame, pixels)
        return np.where(is_met[:, None], view.on_plane_px(points, is_met), pixels)

    def _shown(self, view: _View, frame: IntArray, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Ground points (K, 2) at pixels (K, 2), and whether (K,) they exist."""
        return self._meet(view, frame, pixels, partial(self.seen_height_m, frame=frame))

    def _flat_with_jacobian(self, view: _View, frame: IntArray, pixels: FloatArray) -> FloatArray:
        """Rows (K, 3, 2) of :meth:`flattened_px` and its Jacobian, for planes tangent to the ground."""
        points, is_met = self._shown(view, frame, pixels)
        flat = np.where(is_met[:, None], view.on_plane_px(points, is_met), pixels)
        height_m = self.seen_height_m(points, frame)
        slope = np.empty_like(points)
        for axis, step in enumerate(_TOUCH_M * np.eye(2)):
            rise_m = self.seen_height_m(points + step, frame) - self.seen_height_m(points - step, frame)
            slope[:, axis] = rise_m / (2 * _TOUCH_M)

        def touching(at_map: FloatArray) -> FloatArray:
            return np.asarray(height_m + np.einsum("ki,ki->k", slope, at_map - points))

        def moved(to_px: FloatArray) -> FloatArray:
            touched, is_touched = self._meet(view, frame, to_px, touching)
            return np.where((is_met & is_touched)[:, None], view.on_plane_px(touched, is_touched), to_px)

        columns = [moved(pixels + step) - moved(pixels - step) for step in _STEP_PX * np.eye(2)]
        return np.concatenate([flat[:, None], np.stack(columns, axis=2) / (2 * _STEP_PX)], axis=1)

    def flattened(self, sightings: Sightings, rig: Rig) -> Sightings:
        """``sightings`` as if all paint lay on the plane z = 0, under the cameras of ``rig``."""
        pixels = sightings.corners_pinhole_px.reshape(-1, 2)

        def of_finite(
            camera: IntArray, frame: IntArray, pixels: FloatArray, of: Callable[..., FloatArray]
        ) -> FloatArray:
            """``of`` the finite pixels (N, 2), nan for others."""
            is_finite = np.isfinite(pixels).all(axis=1)
            camera = camera[is_finite]
            frame = frame[is_finite]
            values = of(
                _View(rig.intrinsic[camera], rig.cam_from_map(camera, frame)), frame, pixels[is_finite]
            )
            values_of_all = np.full((len(pixels), *values.shape[1:]), np.nan)
            values_of_all[is_finite] = values
            return values_of_all

        camera = np.repeat(sightings.camera, 4)
        frame = np.repeat(sightings.frame, 4)
        flat = of_finite(camera, frame, pixels, self._flat_with_jacobian).reshape(-1, 4, 3, 2)
        jacobian = flat[..., 1:, :]

        def moved(symbols: Symbols) -> Symbols:
            if not len(symbols.camera):
                return symbols
            of_point = symbols.symbol_of_point
            points_px = np.concatenate(symbols.outlines_pinhole_px)
            flat_px = of_finite(symbols.camera[of_point], symbols.frame[of_point], points_px, self._flat_px)
            return replace(symbols, outlines_pinhole_px=tuple(symbols.by_symbol(flat_px)))

        return replace(
            sightings,
            corners_pinhole_px=flat[..., 0, :],
            covariance_px=jacobian @ sightings.covariance_px @ np.swapaxes(jacobian, -1, -2),
            symbols=moved(sightings.symbols),
            lines=moved(sightings.lines),
        )


class _View:
    """Cameras ``intrinsic`` (K, 3, 3) at ``cam_from_map`` (K, 4, 4)."""

    def __init__(self, intrinsic: FloatArray, cam_from_map: FloatArray) -> None:
        self._map_from_px = np.swapaxes(cam_from_map[:, :3, :3], 1, 2) @ np.linalg.inv(intrinsic)
        self._px_from_plane = pinhole_px_from_ground(intrinsic, cam_from_map)
        self.centre = camera_centre(cam_from_map)

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Directions (K, 3) in the map of pinhole pixels (K, 2)."""
        homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
        return np.asarray((self._map_from_px @ homogeneous[..., None])[..., 0])

    def on_plane_px(self, points_map: FloatArray, is_met: BoolArray) -> FloatArray:
        """Pixels (K, 2) of points (K, 2) of the plane; meaningless unless ``found``."""
        points_on_ground = np.where(is_met[:, None], points_map, 0.0)
        return np.asarray(apply_homography(self._px_from_plane, points_on_ground[:, None])[:, 0])
