r"""Errors common to a map's markings, the relative shift of two maps that they cause, and lines carried over.

Besides its own error a corner has one in common with its surroundings: GNSS drift, which decorrelates along
the route, and a survey's. It is a Gaussian process over the ground, with the covariance :math:`\sigma_a
\sigma_b \exp(-d / l)` of two markings at the distance d: common markings show how two maps are shifted near
them, and averaging many does not remove it. Lane lines and symbols of an earlier map stay where the new drive
has none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from v2hdm.geometry.planar import length_along, points_along
from v2hdm.records import UNSTATED_SIGMA_M, FloatArray, IntArray, Lane, Marking, Symbol

_LEAST_SIGMA_M = 1e-4  # floor of the sigmas of a marking's own error, m: the rounding of a survey
SHIFT = np.tile(np.eye(2), (4, 1))  # derivative of the stacked corners (8,) by a shift (2,)


@dataclass(frozen=True)
class Errors:
    """The errors of M markings, decomposed."""

    centres_map: FloatArray  # (M, 2) m
    own_m2: FloatArray  # (M, 8, 8) each marking's own
    shared_m2: FloatArray  # (M,) per coordinate, of the shift common with its surroundings
    over_m: float  # correlation length of that

    @classmethod
    def of(cls, markings: Sequence[Marking], over_m: float) -> Errors:
        """The stated errors of ``markings``: own ones from the relative sigma, common ones from the rest."""
        centres = np.array([marking.corners_map.mean(axis=0) for marking in markings]).reshape(-1, 2)
        unstated = np.eye(8) * UNSTATED_SIGMA_M**2
        stated = [
            unstated if marking.covariance_m2 is None else marking.covariance_m2 for marking in markings
        ]
        relative_m = [
            np.nan if marking.relative_sigma_m is None else marking.relative_sigma_m for marking in markings
        ]
        whole = np.array(stated).reshape(-1, 8, 8)
        own_m2 = np.array(relative_m) ** 2
        centre_m2 = np.einsum("miaja->m", whole.reshape(-1, 4, 2, 4, 2)) / 32
        shared_m2 = np.maximum(centre_m2 - own_m2, 0.0)
        # A marking without neighbours has no relative sigma: its common error is the others'.
        usual_m2 = float(np.nanmedian(shared_m2)) if np.isfinite(shared_m2).any() else 0.0
        shared_m2 = np.where(np.isfinite(shared_m2), shared_m2, np.minimum(usual_m2, centre_m2))
        own_corners_m2 = whole - shared_m2[:, None, None] * (SHIFT @ SHIFT.T)
        return cls(centres, _positive(own_corners_m2), shared_m2, over_m)

    def __len__(self) -> int:
        return len(self.centres_map)

    def at(self, points_map: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (N, 2) of the process, with the variance (N,) typical of the map."""
        return points_map, np.full(len(points_map), float(np.median(self.shared_m2)) if len(self) else 0.0)

    def kernel(self, rows: IntArray, points_map: FloatArray, variance_m2: FloatArray) -> FloatArray:
        """Covariances (R, N), m^2 per coordinate, of the shifts of markings ``rows`` and of other points."""
        apart_m = np.linalg.norm(self.centres_map[rows][:, None] - points_map[None], axis=2)
        sigma = np.sqrt(self.shared_m2[rows][:, None] * variance_m2[None])
        return np.asarray(sigma * np.exp(-apart_m / self.over_m))

    def between(self, rows: IntArray, columns: IntArray) -> FloatArray:
        """Covariances (R, N) of the shifts of markings ``rows`` and ``columns``."""
        return self.kernel(rows, self.centres_map[columns], self.shared_m2[columns])


def _positive(covariance: FloatArray) -> FloatArray:
    """The nearest covariances with no standard deviation below the floor."""
    values, vectors = np.linalg.eigh((covariance + np.swapaxes(covariance, 1, 2)) / 2)
    values = np.maximum(values, _LEAST_SIGMA_M**2)
    return np.asarray((vectors * values[:, None]) @ np.swapaxes(vectors, 1, 2))


@dataclass(frozen=True)
class Shift:
    """Relative shift of a new map to an old one, from P pairs of common markings."""

    of_old: Errors
    of_new: Errors
    old: IntArray  # (P,)
    new: IntArray  # (P,)
    off_map: FloatArray  # (P, 2) new minus old
    noise_m2: FloatArray  # (P, 2, 2) of that, from the markings' own errors

    @cached_property
    def _inverse(self) -> FloatArray:
        """Inverse joint covariance (2 P, 2 P) of all differences."""
        shared = self.of_old.between(self.old, self.old) + self.of_new.between(self.new, self.new)
        total = np.kron(shared, np.eye(2))
        for k in range(len(self.old)):
            total[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += self.noise_m2[k]
        return np.asarray(np.linalg.inv(total))

    @cached_property
    def _weighed(self) -> FloatArray:
        """The differences (P, 2) times the inverse of their covariance."""
        return np.asarray((self._inverse @ self.off_map.ravel()).reshape(-1, 2))

    def without_itself(self, pair: int) -> tuple[FloatArray, FloatArray]:
        """Mean (2,) and covariance (2, 2) of the shift at a pair, from all others (leave one out)."""
        rows = slice(2 * pair, 2 * pair + 2)
        spread = np.linalg.inv(self._inverse[rows, rows])
        mean = self.off_map[pair] - spread @ self._weighed[pair]
        return mean, _positive((spread - self.noise_m2[pair])[None])[0]

    def at(self, old: int, new: int) -> tuple[FloatArray, FloatArray]:
        """Mean (2,) and covariance (2, 2) of the maps' shift between an old and a new marking."""
        of_old = np.array([old])
        of_new = np.array([new])
        prior_m2 = self.of_old.shared_m2[old] + self.of_new.shared_m2[new]
        if not len(self.old):
            return np.zeros(2), prior_m2 * np.eye(2)
        between_m2 = self.of_old.between(self.old, of_old) + self.of_new.between(self.new, of_new)
        gain = np.kron(between_m2.T, np.eye(2)) @ self._inverse
        covariance = prior_m2 * np.eye(2) - gain @ np.kron(between_m2, np.eye(2))
        return gain @ self.off_map.ravel(), _positive(covariance[None])[0]

    def of_old_at(self, points_map: FloatArray, variance_m2: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Common errors of the old map at points: means (N, 2) and covariances (N, 2, 2)."""
        return self._of_map(-self.of_old.kernel(self.old, points_map, variance_m2), variance_m2)

    def of_new_at(self, points_map: FloatArray, variance_m2: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Common errors of the new map at points: means (N, 2) and covariances (N, 2, 2)."""
        return self._of_map(self.of_new.kernel(self.new, points_map, variance_m2), variance_m2)

    def _of_map(self, between_m2: FloatArray, variance_m2: FloatArray) -> tuple[FloatArray, FloatArray]:
        """From covariances (P, N) of one map's common errors at points with the differences."""
        count, places = between_m2.shape
        prior = variance_m2[:, None, None] * np.eye(2)
        if not count:
            return np.zeros((places, 2)), prior
        blocks = self._inverse.reshape(count, 2, count, 2)
        explained = np.einsum("pn,piqj,qn->nij", between_m2, blocks, between_m2, optimize=True)
        return between_m2.T @ self._weighed, _positive(prior - explained)

    def of_both(self, pair: int) -> tuple[FloatArray, FloatArray]:
        """Common errors of the old and the new map at a pair: mean (4,) and covariance (4, 4)."""
        of_old = np.array([self.old[pair]])
        of_new = np.array([self.new[pair]])
        between_m2 = [
            -self.of_old.between(self.old, of_old)[:, 0],
            self.of_new.between(self.new, of_new)[:, 0],
        ]
        gain = np.concatenate([np.kron(with_pairs_m2[None], np.eye(2)) for with_pairs_m2 in between_m2])
        prior = [self.of_old.shared_m2[of_old[0]], self.of_new.shared_m2[of_new[0]]]
        covariance = np.kron(np.diag(prior), np.eye(2)) - gain @ self._inverse @ gain.T
        return gain @ self._weighed.ravel(), (covariance + covariance.T) / 2


_SAME_LINE_M = 0.3  # largest distance of one line in two maps, m: parallel lines are twice as far apart
_LEAST_SHARED = 0.5  # least fraction of a new line's vertices on an earlier line for it to be that line


def updated_lanes(
    old: Sequence[Lane], new: Sequence[Lane], shift: Shift, number: Callable[[], int]
) -> tuple[Lane, ...]:
    """The lines of both maps: an earlier one keeps its id, and its course where the new drive has none."""
    before = [replace(lane, points_map=_moved(lane.points_map, shift, of_old=True)) for lane in old]
    pieces: list[list[Lane]] = [[] for _ in before]
    added = []
    for drive_lane in new:
        lane = replace(drive_lane, points_map=_moved(drive_lane.points_map, shift, of_old=False))
        owner = _owner(lane, before)
        if owner is None:
            added.append(replace(lane, id=number()))
        else:
            pieces[owner].append(lane)
    renewed = [_renewed(lane, parts) for lane, parts in zip(before, pieces, strict=True)]
    return (*renewed, *added)


def updated_symbols(
    old: Sequence[Symbol], new: Sequence[Symbol], shift: Shift, number: Callable[[], int]
) -> tuple[Symbol, ...]:
    """The symbols of both maps; of overlapping ones the new outline with the earlier id."""
    updated = [replace(symbol, outline_map=_moved(symbol.outline_map, shift, of_old=True)) for symbol in old]
    centres = np.array([symbol.outline_map.mean(axis=0) for symbol in updated]).reshape(-1, 2)
    used: set[int] = set()
    for drive_symbol in new:
        symbol = replace(drive_symbol, outline_map=_moved(drive_symbol.outline_map, shift, of_old=False))
        off_m = np.linalg.norm(centres - symbol.outline_map.mean(axis=0), axis=1)
        within = 0.5 * float(np.ptp(symbol.outline_map, axis=0).max())
        in_reach = [k for k in np.argsort(off_m).tolist() if k < len(old) and off_m[k] < within]
        same = next((k for k in in_reach if k not in used and old[k].kind == drive_symbol.kind), None)
        if same is None:
            updated.append(replace(symbol, id=number()))
        else:
            used.add(same)
            sightings = old[same].sightings + drive_symbol.sightings
            updated[same] = replace(symbol, id=old[same].id, sightings=sightings, heights_m=None)
    return tuple(updated)


def _moved(points_map: FloatArray, shift: Shift, of_old: bool) -> FloatArray:
    """Points without the error common with the markings around them."""
    errors = shift.of_old if of_old else shift.of_new
    estimate_at = shift.of_old_at if of_old else shift.of_new_at
    places, variance_m2 = errors.at(points_map)
    shift_m, _ = estimate_at(places, variance_m2)
    return points_map - shift_m


def _owner(lane: Lane, lanes: Sequence[Lane]) -> int | None:
    """The earlier line of the same class that contains most of a new line."""
    shares = []
    for earlier_lane in lanes:
        foot = points_along(earlier_lane.points_map, _stations(lane.points_map, earlier_lane.points_map))
        is_on_line = np.linalg.norm(lane.points_map - foot, axis=1) <= _SAME_LINE_M
        shares.append(is_on_line.mean() * (earlier_lane.kind == lane.kind))
    best = int(np.argmax(shares)) if shares else 0
    return best if shares and shares[best] >= _LEAST_SHARED else None


def _stations(points: FloatArray, line: FloatArray) -> FloatArray:
    """Arc lengths, m, along a polyline (M, 2) of the feet of points (N, 2), beside the nearest vertex."""
    along = length_along(line)
    nearest = cKDTree(line).query(points)[1]
    best = np.full(len(points), np.inf)
    station = np.asarray(along[nearest], dtype=np.float64)
    for first in (nearest - 1, nearest):
        begin = np.clip(first, 0, len(line) - 2)
        side = line[begin + 1] - line[begin]
        length2 = np.maximum((side**2).sum(axis=1), 1e-12)
        share = np.clip(((points - line[begin]) * side).sum(axis=1) / length2, 0.0, 1.0)
        off = np.linalg.norm(points - line[begin] - share[:, None] * side, axis=1)
        nearer = off < best
        station[nearer] = along[begin[nearer]] + share[nearer] * np.sqrt(length2[nearer])
        best = np.minimum(best, off)
    return station


def _renewed(lane: Lane, pieces: Sequence[Lane]) -> Lane:
    """The earlier line, with its course replaced by new lines where they coincide."""
    if not pieces:
        return lane
    along = length_along(lane.points_map)
    heights = lane.heights_m
    points: list[FloatArray] = []
    renewed_heights: list[FloatArray] = []
    reached = -1.0
    placed = [(_stations(piece.points_map, lane.points_map), piece.points_map) for piece in pieces]
    placed.sort(key=lambda placed_piece: float(placed_piece[0].min()))
    for station, course in placed:
        if station[-1] < station[0]:
            station = station[::-1]
            course = course[::-1]
        is_before = (along > reached) & (along < station.min())
        # Of two overlapping new pieces, the later begins where the earlier ends.
        is_beyond = (station > reached) | (reached < 0)
        points += [lane.points_map[is_before], course[is_beyond]]
        if heights is not None:
            renewed_heights += [heights[is_before], np.interp(station[is_beyond], along, heights)]
        reached = max(reached, float(station.max()))
    is_after = along > reached
    sightings = lane.sightings + max(piece.sightings for piece in pieces)
    course = np.concatenate([*points, lane.points_map[is_after]])
    heights = None if heights is None else np.concatenate([*renewed_heights, heights[is_after]])
    return replace(lane, points_map=course, heights_m=heights, sightings=sightings)
