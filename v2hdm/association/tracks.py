"""Sightings of one marking, linked from image to image of one camera.

A wrong IPM displaces every marking, by metres at range, but nearly equally in consecutive images. Sightings
are therefore linked along the drive first, with a gate that grows with the motion between images, and
compared across gaps, laps and cameras later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np
from scipy.optimize import linear_sum_assignment

from v2hdm.association.ground import Located
from v2hdm.association.groups import GATE_SIGMAS, LEAST_TOLERANCE_M, MAX_GATE_M, SHAPE_TOLERANCE, Association
from v2hdm.association.sightings import Rig, Sightings
from v2hdm.geometry.ipm import ray_covariance
from v2hdm.geometry.planar import SHIFTS, align, diameters, length_along, mean_corners
from v2hdm.geometry.rigid import heading_rad
from v2hdm.records import BoolArray, FloatArray, IntArray, PoseNoise

IPM_SIGMA_RAD = 0.015  # direction error of an initial IPM: markings may seem to move between images
REFINED_SIGMA_RAD = 0.002  # direction error of an IPM once the extrinsic has been optimised

LEAST_SIGHTINGS = 3
"""Sightings required of a marking by the naive methods, and of a track by the incremental map."""

_MAX_GAP_M = 4.0  # largest travel without a sighting within a track
_REFUSED = 1e9  # cost of a forbidden pair in the assignment
_POSITION_FLOOR_M = 0.02  # floor of a sighting's sigma, m: keeps the gate open where the stated noise is nil


@dataclass
class _Track:
    """Latest state of a track: ``row`` of its last sighting, corners in the track's order."""

    number: int
    row: int
    corners_map: FloatArray
    valid: BoolArray

    def extend(self, row: int, shift: int, located: Located) -> None:
        """Append the sighting at ``row``, whose corners are ``shift`` behind the track's."""
        valid = located.valid[row][SHIFTS[shift]]
        self.corners_map[valid] = located.corners_map[row][SHIFTS[shift]][valid]
        self.valid |= valid
        self.row = row


def build_tracks(
    sightings: Sightings, located: Located, rig: Rig, direction_rad: float, noise: PoseNoise
) -> Association:
    """Link the ``sightings``, in image order and ``located`` under ``rig``, by camera and session.

    ``direction_rad`` is the extrinsic's error, ``noise`` that of poses. Tracks and sightings of an image are
    assigned one to one; sightings need two valid corners.
    """
    group = np.full(len(sightings), -1, dtype=np.int64)
    shift = np.zeros(len(sightings), dtype=np.int64)
    linker = _Linker(sightings, located, rig.map_from_vehicle, direction_rad, noise)
    count = 0
    for camera in range(len(sightings.cameras)):
        rows_of_camera = np.flatnonzero((sightings.camera == camera) & (located.valid.sum(axis=1) >= 2))
        images = np.flatnonzero(np.diff(sightings.image[rows_of_camera], prepend=-1) != 0)
        active: list[_Track] = []
        for rows in np.split(rows_of_camera, images[1:]):
            if not len(rows):
                continue
            active = linker.alive(active, rows[0])
            continued = linker.match(active, rows)
            for row in rows.tolist():
                if row in continued:
                    track, shift[row] = continued[row]
                    track.extend(row, int(shift[row]), located)
                else:
                    track = _Track(count, row, located.corners_map[row].copy(), located.valid[row].copy())
                    active.append(track)
                    count += 1
                group[row] = track.number
    return Association(group, shift, count)


class _Linker:
    """Matches the sightings of one image with the tracks that are alive."""

    def __init__(
        self,
        sightings: Sightings,
        located: Located,
        map_from_vehicle: FloatArray,
        direction_rad: float,
        noise: PoseNoise,
    ) -> None:
        self._sightings = sightings
        self._located = located
        self._direction_rad = direction_rad
        self._odometer_m = length_along(map_from_vehicle[:, :2, 3])
        self._heading_rad = np.unwrap(heading_rad(map_from_vehicle))
        self._ray_map = mean_corners(located.ray_map, located.valid)
        self._range_m = np.linalg.norm(self._ray_map, axis=1)
        self._noise_m2 = _noise_covariances(located, self._ray_map, noise)
        self._centre_map = mean_corners(located.corners_map, located.valid)
        self._size_m = diameters(located.corners_map, located.valid)

    def alive(self, tracks: Sequence[_Track], row: int) -> list[_Track]:
        """The tracks that may still be continued by the sighting at ``row``."""
        now = self._sightings.frame[row]
        last = self._sightings.frame[[track.row for track in tracks]]
        is_near = self._odometer_m[now] - self._odometer_m[last] <= _MAX_GAP_M
        is_alive = is_near & (self._sightings.session[last] == self._sightings.session[now])
        return list(compress(tracks, is_alive.tolist()))

    def match(self, tracks: list[_Track], rows: IntArray) -> dict[int, tuple[_Track, int]]:
        """Track and corner shift of each row that continues a track."""
        if not tracks:
            return {}
        last = np.array([track.row for track in tracks])
        corners = np.stack([track.corners_map for track in tracks])
        valid = np.stack([track.valid for track in tracks])
        size_m = diameters(corners, valid)
        # Pairs of one class no farther apart than their sizes.
        apart_m = mean_corners(corners, valid)[:, None] - self._centre_map[rows]
        distance_m = np.hypot(apart_m[..., 0], apart_m[..., 1])
        reach_m = MAX_GATE_M + size_m[:, None] + self._size_m[rows]
        alike = self._sightings.kind[last][:, None] == self._sightings.kind[rows]
        t, d = np.argwhere(alike & (distance_m <= reach_m)).T
        pair_rows = rows[d]
        pair_last = last[t]
        aligned = align(
            corners[t], valid[t], self._located.corners_map[pair_rows], self._located.valid[pair_rows]
        )
        noise_m2 = self._noise_m2[pair_last] + self._noise_m2[pair_rows]
        covariance = noise_m2 + self._drift_covariance(pair_last, pair_rows)
        cost = _squared_distance(aligned.offset, covariance)
        shape = aligned.deformation_m / np.maximum(SHAPE_TOLERANCE * size_m[t], LEAST_TOLERANCE_M)
        accepted = (cost <= GATE_SIGMAS**2) & (shape <= 1.0)
        accepted &= np.hypot(aligned.offset[:, 0], aligned.offset[:, 1]) <= MAX_GATE_M
        costs = np.full((len(tracks), len(rows)), _REFUSED)
        costs[t, d] = np.where(accepted, cost + shape**2, _REFUSED)
        shift = np.zeros(costs.shape, dtype=np.int64)
        shift[t, d] = aligned.shift
        track_index, row_index = linear_sum_assignment(costs)
        return {
            int(rows[d]): (tracks[t], int(shift[t, d]))
            for t, d in zip(track_index, row_index, strict=True)
            if costs[t, d] < _REFUSED
        }

    def _drift_covariance(self, last: IntArray, rows: IntArray) -> FloatArray:
        """Covariance (P, 2, 2) that a wrong extrinsic adds between the images of two sightings.

        The error along the ray is r^2 / h * d, across it r * d: both change by their derivative times the
        motion, and the vehicle's turn rotates the first.
        """
        frame = self._sightings.frame
        moved_m = np.abs(self._odometer_m[frame[rows]] - self._odometer_m[frame[last]])
        turned = np.abs(self._heading_rad[frame[rows]] - self._heading_rad[frame[last]])
        height_m = self._located.height_m[rows]
        range_m = self._range_m[rows]
        direction = self._direction_rad
        along_m = direction * (1.0 + 2.0 * range_m / height_m) * (moved_m + range_m * turned)
        across_m = direction * (moved_m + range_m * turned + range_m**2 / height_m * turned)
        return ray_covariance(self._ray_map[rows], along_m, across_m)


def _squared_distance(offset: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared Mahalanobis distances (P,) of offsets (P, 2), by Cramer's rule, which is faster than LAPACK."""
    x, y = offset.T
    variance_x = covariance[:, 0, 0]
    variance_y = covariance[:, 1, 1]
    product = covariance[:, 0, 1]
    determinant = variance_x * variance_y - product**2
    return np.asarray((variance_y * x**2 - 2 * product * x * y + variance_x * y**2) / determinant)


def _noise_covariances(located: Located, ray: FloatArray, noise: PoseNoise) -> FloatArray:
    """Covariance (S, 2, 2) of the mean position, at the end of ``ray``: pixels, attitude, position."""
    range_m = np.linalg.norm(ray, axis=1)
    height_m = located.height_m
    jitter_m = noise.roll_pitch_rad * (range_m**2 + height_m**2) / height_m
    weight = located.valid / np.maximum(located.valid.sum(axis=1, keepdims=True), 1)
    pixels = np.sum(
        np.where(located.valid[..., None, None], located.covariance_m2, 0.0) * weight[..., None, None], axis=1
    )
    spread = ray_covariance(ray, jitter_m, noise.roll_pitch_rad * range_m)
    position_m2 = noise.position_m**2 + _POSITION_FLOOR_M**2
    return np.asarray(pixels + spread + position_m2 * np.eye(2))
