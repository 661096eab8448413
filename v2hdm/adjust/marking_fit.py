"""One marking's observations: its corners, and what it says about the extrinsics.

Everything is small and dense. The errors of the poses are marginalised out of the residuals, frame by
frame: with r(s) linearised at the frame's estimated state s, the observations' residual is r(s) - G s and
they share the covariance G Sigma_s G', G their derivative by the state. That is the Schur complement of the
joint problem, so iterating it ends in the joint optimum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from v2hdm.adjust.problem import IntArray
from v2hdm.adjust.rigid import adjoints, exp, hat, left_jacobians
from v2hdm.records import FloatArray

# A point nearer than this to the plane of the camera cannot be projected, m.
_MIN_DEPTH_M = 0.05
# Below this weight an observation is as good as absent; the floor keeps its covariance finite.
_MIN_WEIGHT = 1e-4


@dataclass(frozen=True)
class MarkingObservations:
    """K sightings of the corners of one marking.

    ``camera`` (K,) and ``corner`` (K,), 0 to n - 1; ``frame`` (K,) numbers images taken at one time alike;
    ``vehicle_from_map`` (K, 4, 4) are the recorded poses, inverted; ``pinhole_px`` (K, 2) and
    ``covariance_px`` (K, 2, 2).
    """

    camera: IntArray
    corner: IntArray
    frame: IntArray
    vehicle_from_map: FloatArray
    pinhole_px: FloatArray
    covariance_px: FloatArray

    @property
    def frame_rank(self) -> IntArray:
        """Which of the marking's own frames (K,) each observation belongs to, 0 to F - 1."""
        return np.asarray(np.unique(self.frame, return_inverse=True)[1])

    def joined(self, more: MarkingObservations) -> MarkingObservations:
        """These and ``more`` of the same marking."""
        parts = zip(vars(self).values(), vars(more).values(), strict=True)
        return MarkingObservations(*(np.concatenate(pair) for pair in parts))


@dataclass(frozen=True)
class Noise:
    """How the observations err beyond their covariances.

    ``pose_sigma`` (6,) of the frames' tangents (0 where a state does not err); ``cauchy_scale`` is the
    residual, in standard deviations, from which an observation loses weight (infinite: never).
    """

    pose_sigma: FloatArray
    cauchy_scale: float


@dataclass(frozen=True)
class Normal:
    """The normal equations of one marking at one estimate, pose errors marginalised out.

    With d the left tangents of all C extrinsics, stacked, and x the step of the corners: ``V`` (2n, 2n),
    ``W`` (6C, 2n), ``U`` (6C, 6C) and the gradients ``by_corner`` (2n,), ``by_extrinsic`` (6C,) of half the
    squared, reweighted residuals. ``frame_state`` (F, 6) is where the frames' states come to lie.
    """

    V: FloatArray
    W: FloatArray
    U: FloatArray
    by_corner: FloatArray
    by_extrinsic: FloatArray
    frame_state: FloatArray


def normal_equations(
    seen: MarkingObservations,
    intrinsic: FloatArray,
    cam_from_vehicle: FloatArray,
    corners_map: FloatArray,
    frame_state: FloatArray,
    noise: Noise,
) -> Normal:
    """Linearise ``seen`` at extrinsics (C, 4, 4), corners (n, 2) and the frames' states (F, 6)."""
    count, cameras, each = len(seen.camera), len(cam_from_vehicle), 2 * len(corners_map)
    rank = seen.frame_rank
    state = frame_state[rank]
    residual, by_pair, by_corner = _linearise(seen, intrinsic, cam_from_vehicle, corners_map, state)
    by_state = -by_pair @ adjoints(cam_from_vehicle)[seen.camera] @ left_jacobians(-state)
    residual = residual - (by_state @ state[..., None])[..., 0]
    wide = np.zeros((count, 2, cameras, 6))
    wide[np.arange(count), :, seen.camera] = by_pair
    narrow = np.zeros((count, 2, each // 2, 2))
    narrow[np.arange(count), :, seen.corner] = by_corner
    flat = np.column_stack(
        [wide.reshape(2 * count, -1), narrow.reshape(2 * count, -1), residual.reshape(2 * count)]
    )
    spread = (by_state * noise.pose_sigma).reshape(2 * count, 6)
    factor = cho_factor(_covariance(seen, residual, spread, rank, noise), lower=True)
    solved = cho_solve(factor, flat)
    product, size = flat.T @ solved, 6 * cameras
    moved = np.zeros_like(frame_state)
    np.add.at(moved, np.repeat(rank, 2), -spread * solved[:, -1:] * noise.pose_sigma)
    return Normal(
        V=product[size:-1, size:-1],
        W=product[:size, size:-1],
        U=product[:size, :size],
        by_corner=product[size:-1, -1],
        by_extrinsic=product[:size, -1],
        frame_state=moved,
    )


def _covariance(
    seen: MarkingObservations, residual: FloatArray, spread: FloatArray, rank: IntArray, noise: Noise
) -> FloatArray:
    """Covariance (2K, 2K) of the residuals (K, 2): what frames share, and pixels by robust weights."""
    count = len(residual)
    shared = spread @ spread.T * np.repeat(np.repeat(rank[:, None] == rank, 2, axis=0), 2, axis=1)
    blocks, index = shared.reshape(count, 2, count, 2), np.arange(count)
    own = blocks[index, :, index] + seen.covariance_px
    squared = np.sum(residual * np.linalg.solve(own, residual[..., None])[..., 0], axis=1)
    # While the fit is poor, all observations look like outliers.
    cut = max(noise.cauchy_scale, 2 * float(np.sqrt(np.median(squared)))) ** 2
    weight = np.maximum(1 / (1 + squared / cut), _MIN_WEIGHT)
    blocks[index, :, index] += seen.covariance_px / weight[:, None, None]
    return np.asarray(shared)


def back_projected(
    seen: MarkingObservations, intrinsic: FloatArray, cam_from_vehicle: FloatArray
) -> FloatArray:
    """Where to start the corners (n, 2): the ground points of their rays, the steep ones foremost."""
    map_from_cam = np.linalg.inv(cam_from_vehicle[seen.camera] @ seen.vehicle_from_map)
    k = intrinsic[seen.camera]
    ray = np.column_stack([(seen.pinhole_px - k[:, 2:]) / k[:, :2], np.ones(len(k))])
    ray = (map_from_cam[:, :3, :3] @ ray[..., None])[..., 0]
    centre = map_from_cam[:, :3, 3]
    sine = -ray[:, 2] / np.linalg.norm(ray, axis=1)
    steep = np.maximum(sine, 0.01)
    reach = centre[:, 2] / (steep * np.linalg.norm(ray, axis=1))
    points = (centre + reach[:, None] * ray)[:, :2]
    # A direction error moves the point by range^2 / height, and so with the inverse square of the sine.
    weight = np.where(sine > 0.01, steep**4 / centre[:, 2] ** 2, 1e-12)
    total = np.bincount(seen.corner, weights=weight)
    sums = [np.bincount(seen.corner, weights=weight * points[:, axis]) for axis in (0, 1)]
    return np.column_stack(sums) / total[:, None]


def _linearise(
    seen: MarkingObservations,
    intrinsic: FloatArray,
    cam_from_vehicle: FloatArray,
    corners_map: FloatArray,
    state: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (K, 2), px, and derivatives by the cameras' left tangents (K, 2, 6) and corners (K, 2, 2)."""
    cam_from_map = cam_from_vehicle[seen.camera] @ exp(-state) @ seen.vehicle_from_map
    plane = cam_from_map[:, :3][..., [0, 1, 3]]
    corners = corners_map[seen.corner]
    point = (plane @ np.column_stack([corners, np.ones(len(corners))])[..., None])[..., 0]
    depth = np.maximum(point[:, 2], _MIN_DEPTH_M)
    focal, principal = intrinsic[seen.camera, :2], intrinsic[seen.camera, 2:]
    pixel = focal * point[:, :2] / depth[:, None] + principal
    by_point = np.zeros((len(point), 2, 3))
    by_point[:, 0, 0], by_point[:, 1, 1] = (focal / depth[:, None]).T
    by_point[:, :, 2] = -(pixel - principal) / depth[:, None]
    by_pair = np.concatenate([by_point, -by_point @ hat(point)], axis=2)
    return pixel - seen.pinhole_px, by_pair, by_point @ plane[..., :2]
