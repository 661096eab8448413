"""The observations of a marking, or of a few that share images: corners, and what they say of the extrinsics.

Everything is small. The errors of the poses are eliminated frame by frame: with r(s) linearised at the
frame's estimated state s, the observations' residual is r(s) - G s where the state is 0, G their derivative
by it. That is the Schur complement of the joint problem, so iterating it ends in the joint optimum.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.adjust.gating import as_of_point
from v2hdm.adjust.pose_errors import Frames, Noise
from v2hdm.adjust.problem import on_line
from v2hdm.geometry.rigid import adjoint, exp, hat, left_jacobian
from v2hdm.records import FloatArray, IntArray

# A point nearer than this to the plane of the camera cannot be projected, m.
_MIN_DEPTH_M = 0.05
# Below this weight an observation is as good as absent; the floor keeps its covariance finite.
_MIN_WEIGHT = 1e-4


@dataclass(frozen=True)
class MarkingObservations:
    """K sightings of the corners of one marking, or of several that are to share their frames' errors.

    ``camera`` (K,) and ``corner`` (K,), 0 to n - 1; ``frame`` (K,) numbers images taken at one time alike,
    and ``travelled_m`` (K,) is how far the vehicle had driven by then; ``vehicle_from_map`` (K, 4, 4) are the
    recorded poses, inverted; ``pinhole_px`` (K, 2) and ``covariance_px`` (K, 2, 2).
    """

    camera: IntArray
    corner: IntArray
    frame: IntArray
    travelled_m: FloatArray
    vehicle_from_map: FloatArray
    pinhole_px: FloatArray
    covariance_px: FloatArray

    @property
    def frame_rank(self) -> IntArray:
        """Which of the marking's own frames (K,) each observation belongs to, 0 to F - 1."""
        return np.asarray(np.unique(self.frame, return_inverse=True)[1])

    @property
    def frames(self) -> Frames:
        """The marking's own frames, by number."""
        number, first = np.unique(self.frame, return_index=True)
        return Frames(number, self.travelled_m[first], self.vehicle_from_map[first])

    def joined(self, more: MarkingObservations) -> MarkingObservations:
        """These and ``more`` of the same marking."""
        parts = zip(vars(self).values(), vars(more).values(), strict=True)
        return MarkingObservations(*(np.concatenate(pair) for pair in parts))


@dataclass(frozen=True)
class Normal:
    """The normal equations of some corners at one estimate, pose errors marginalised out.

    With d the left tangents of all C extrinsics, stacked, and x the step of the corners: ``V`` (2n, 2n),
    ``W`` (6C, 2n), ``U`` (6C, 6C) and the gradients ``by_corner`` (2n,), ``by_extrinsic`` (6C,) of half the
    squared, reweighted residuals. ``frame_state`` (F, 6) is where the frames' states come to lie, which costs
    ``state_squared`` standard deviations squared. An error e of the frames' states adds ``influence``
    (6C + 2n, 6F) times e to the gradients.
    """

    V: FloatArray
    W: FloatArray
    U: FloatArray
    by_corner: FloatArray
    by_extrinsic: FloatArray
    frame_state: FloatArray
    state_squared: float
    influence: FloatArray


def normal_equations(
    seen: MarkingObservations,
    intrinsic: FloatArray,
    cam_from_vehicle: FloatArray,
    corners_map: FloatArray,
    frame_state: FloatArray,
    noise: Noise,
) -> Normal:
    """Linearise ``seen`` at extrinsics (C, 4, 4), corners (n, 2) and the frames' states (F, 6)."""
    cameras, corners, frames = len(cam_from_vehicle), len(corners_map), len(frame_state)
    camera, corner, rank = seen.camera, seen.corner, seen.frame_rank
    residual, by_pair, by_corner = _linearise(seen, intrinsic, cam_from_vehicle, corners_map, frame_state)
    by_state = -by_pair @ adjoint(cam_from_vehicle)[camera] @ left_jacobian(-frame_state)[rank]
    at_rest = residual[..., None] - by_state @ frame_state[rank][..., None]
    root = _root_information(seen, residual, noise)
    pair, place, unit, rest = (root @ j for j in (by_pair, by_corner, by_state, at_rest))
    no_row = np.zeros_like(camera)
    own = np.block(
        [
            [
                _gram((cameras, cameras), (camera, camera), pair, pair),
                _gram((cameras, corners), (camera, corner), pair, place),
                _gram((cameras, 1), (camera, no_row), pair, rest),
            ],
            [
                _gram((corners, cameras), (corner, camera), place, pair),
                _gram((corners, corners), (corner, corner), place, place),
                _gram((corners, 1), (corner, no_row), place, rest),
            ],
        ]
    )
    across = np.hstack(
        [
            _gram((frames, cameras), (rank, camera), unit, pair),
            _gram((frames, corners), (rank, corner), unit, place),
            _gram((frames, 1), (rank, no_row), unit, rest),
        ]
    )
    held = _summed((frames,), (rank,), np.swapaxes(unit, 1, 2) @ unit)
    covariance = noise.covariance(seen.frames, seen.frames)
    # (P^-1 + H)^-1 = P (I + H P)^-1, which a state that does not err leaves regular.
    times = np.einsum("fab,fbk->fak", held, covariance.reshape(frames, 6, -1)).reshape(6 * frames, -1)
    solved = np.linalg.solve(np.eye(6 * frames) + times, across)
    own -= across[:, :-1].T @ covariance @ solved
    size, force = 6 * cameras, -solved[:, -1]
    state = covariance @ force
    return Normal(
        V=own[size:, size:-1],
        W=own[:size, size:-1],
        U=own[:size, :size],
        by_corner=own[size:, -1],
        by_extrinsic=own[:size, -1],
        frame_state=state.reshape(frames, 6),
        state_squared=float(force @ state),
        influence=solved[:, :-1].T,
    )


def squared_residuals(
    seen: MarkingObservations,
    intrinsic: FloatArray,
    cam_from_vehicle: FloatArray,
    corners_map: FloatArray,
    frame_state: FloatArray,
) -> FloatArray:
    """Squared residuals (K,) of ``seen`` in standard deviations; of lines scaled to those of points."""
    residual = _linearise(seen, intrinsic, cam_from_vehicle, corners_map, frame_state)[0]
    white = np.linalg.solve(seen.covariance_px, residual[..., None])[..., 0]
    squared = np.asarray(np.sum(residual * white, axis=1))
    line = on_line(seen.covariance_px)
    squared[line] = as_of_point(squared[line])
    return squared


def _root_information(seen: MarkingObservations, residual: FloatArray, noise: Noise) -> FloatArray:
    """Roots (K, 2, 2) of the observations' information, robust weights included."""
    root = np.linalg.inv(np.linalg.cholesky(seen.covariance_px))
    squared = np.sum((root @ residual[..., None])[..., 0] ** 2, axis=1)
    # While the fit is poor, all observations look like outliers.
    cut = max(noise.cauchy_scale, 2 * float(np.sqrt(np.median(squared)))) ** 2
    weight = np.maximum(1 / (1 + squared / cut), _MIN_WEIGHT)
    return np.asarray(np.sqrt(weight)[:, None, None] * root)


def _gram(
    shape: tuple[int, int], index: tuple[IntArray, IntArray], left: FloatArray, right: FloatArray
) -> FloatArray:
    """A matrix of ``shape`` blocks: sums over K rows of left' right, put where ``index`` says."""
    blocks = _summed(shape, index, np.swapaxes(left, 1, 2) @ right)
    return blocks.transpose(0, 2, 1, 3).reshape(shape[0] * blocks.shape[2], -1)


def _summed(shape: tuple[int, ...], index: tuple[IntArray, ...], values: FloatArray) -> FloatArray:
    """Values (K, ...) summed by index."""
    flat = np.ravel_multi_index(index, shape)
    out = np.zeros((int(np.prod(shape)), *values.shape[1:]))
    order = np.argsort(flat, kind="stable")
    begins = np.flatnonzero(np.diff(flat[order], prepend=-1))
    out[flat[order][begins]] = np.add.reduceat(values[order], begins, axis=0)
    return out.reshape(*shape, *values.shape[1:])


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
    frame_state: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residuals (K, 2), px, and derivatives by the cameras' left tangents (K, 2, 6) and corners (K, 2, 2)."""
    moved = exp(-frame_state)[seen.frame_rank]
    cam_from_map = cam_from_vehicle[seen.camera] @ moved @ seen.vehicle_from_map
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
