"""Closed forms for pairs and priors, which are too few to matter for speed.

With ``A = [r1 r2 t]`` of a pair's ``cam_from_map`` a corner l lies at p = A (l_x, l_y, 1) in the camera. The
cost's gradient by p is a force; that by the pair's left tangent is a *wrench*, the sums of forces and of
moments p x force. Extrinsics, frame states and clock offsets act through pairs:

- a left perturbation of ``cam_from_vehicle`` is one of every pair of the camera;
- ds in ``exp(-s)`` perturbs the pair by -Ad(cam_from_vehicle exp(-q v)) J_l(-s) ds;
- dq in ``exp(-q v)`` perturbs the pair by -Ad(cam_from_vehicle) v dq; so does a read-out time, its v by row.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.model import (
    Estimate,
    Gradient,
    by_ground_planes,
    clock_residual,
    frame_tangent,
    ground_residual,
    moved,
    state_residual,
)
from v2hdm.adjust.reduced import Spread
from v2hdm.compiled import exact_kernel, inlined, kernel, twin
from v2hdm.geometry import rigid
from v2hdm.geometry.rigid import EXP_SERIES, LEFT_JACOBIAN_SERIES
from v2hdm.records import FloatArray

EXP_TERMS = np.ascontiguousarray(EXP_SERIES, dtype=np.float64)
LEFT_JACOBIAN_TERMS = np.ascontiguousarray(LEFT_JACOBIAN_SERIES, dtype=np.float64)


def move(tangents: FloatArray, dst_from_src: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``exp(tangents) @ dst_from_src`` (C, 4, 4) and the left Jacobian (C, 6, 6) of the tangents (C, 6)."""
    moved = np.zeros((len(tangents), 4, 4))
    jacobian = np.empty((len(tangents), 6, 6))
    _move(tangents, dst_from_src, EXP_TERMS, LEFT_JACOBIAN_TERMS, np.empty((5, 6, 6)), moved, jacobian)
    return moved, jacobian


def compose(cameras: FloatArray, vehicle_from_map: FloatArray) -> FloatArray:
    """Products (C, M, 4, 4) of cameras (C, M or 1, 4, 4) with transforms (M, 4, 4)."""
    out = np.empty((len(cameras), *vehicle_from_map.shape))
    _compose(np.ascontiguousarray(cameras), np.ascontiguousarray(vehicle_from_map), out)
    return out


@twin("adjust.compose")
@exact_kernel
def _compose(cameras: FloatArray, vehicle_from_map: FloatArray, out: FloatArray) -> None:
    for c in range(len(cameras)):
        for m in range(len(vehicle_from_map)):
            left = cameras[c, m if cameras.shape[1] > 1 else 0]
            for i in range(4):
                for j in range(4):
                    total = 0.0
                    for k in range(4):
                        total += left[i, k] * vehicle_from_map[m, k, j]
                    out[c, m, i, j] = total


@inlined
def _series(terms: FloatArray, column: int, x: float) -> float:
    """A power series by Horner's rule."""
    total = terms[len(terms) - 1, column]
    for n in range(len(terms) - 2, -1, -1):
        total = terms[n, column] + total * x
    return float(total)


@inlined
def _hat(out: FloatArray, i: int, j: int, x: float, y: float, z: float) -> None:
    """Write the skew matrix of a vector at row i and column j."""
    out[i, j] = 0.0
    out[i, j + 1] = -z
    out[i, j + 2] = y
    out[i + 1, j] = z
    out[i + 1, j + 1] = 0.0
    out[i + 1, j + 2] = -x
    out[i + 2, j] = -y
    out[i + 2, j + 1] = x
    out[i + 2, j + 2] = 0.0


@inlined
def _product(left: FloatArray, right: FloatArray, size: int, out: FloatArray) -> None:
    for i in range(size):
        for j in range(size):
            total = 0.0
            for k in range(size):
                total += left[i, k] * right[k, j]
            out[i, j] = total


@twin("adjust.move")
@kernel
def _move(
    tangents: FloatArray,
    dst_from_src: FloatArray,
    exp_series: FloatArray,
    jacobian_series: FloatArray,
    room: FloatArray,
    moved: FloatArray,
    jacobian: FloatArray,
) -> None:
    ad = room[0]
    inner = room[1]
    product = room[2]
    omega = room[3]
    square = room[4]
    for c in range(len(tangents)):
        wx = tangents[c, 3]
        wy = tangents[c, 4]
        wz = tangents[c, 5]
        x = -(wx * wx + wy * wy + wz * wz)
        sine = _series(exp_series, 0, x)
        cosine = _series(exp_series, 1, x)
        third = _series(exp_series, 2, x)
        _hat(omega, 0, 0, wx, wy, wz)
        _product(omega, omega, 3, square)
        for i in range(3):
            shift = tangents[c, i]
            for j in range(3):
                turned = cosine * omega[i, j] + third * square[i, j]
                shift += turned * tangents[c, j]
                rotation = sine * omega[i, j] + cosine * square[i, j] + (1.0 if i == j else 0.0)
                for k in range(4):
                    moved[c, i, k] += rotation * dst_from_src[c, j, k]
            moved[c, i, 3] += shift
        moved[c, 3, 3] = 1.0
        ad[:, :] = 0.0
        _hat(ad, 0, 0, wx, wy, wz)
        _hat(ad, 3, 3, wx, wy, wz)
        _hat(ad, 0, 3, tangents[c, 0], tangents[c, 1], tangents[c, 2])
        inner[:, :] = 0.0
        for i in range(6):
            inner[i, i] = _series(jacobian_series, 3, x)
        for n in range(3, -1, -1):
            _product(ad, inner, 6, product)
            last = 1.0 if n == 0 else _series(jacobian_series, n - 1, x)
            for i in range(6):
                for j in range(6):
                    inner[i, j] = product[i, j] + (last if i == j else 0.0)
        for i in range(6):
            for j in range(6):
                jacobian[c, i, j] = inner[i, j]


def _exp(tangent: Tensor) -> Tensor:
    return torch.from_numpy(rigid.exp(tangent.numpy()))


def _adjoint(dst_from_src: Tensor) -> Tensor:
    return torch.from_numpy(rigid.adjoint(dst_from_src.numpy()))


def _cam_from_vehicle_then(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Poses T exp(-q v) of the cameras from the vehicle at each frame's stamp, (C, M or 1, 4, 4)."""
    cam_from_vehicle = estimate.cam_from_vehicle[:, None]
    return cam_from_vehicle @ _exp(-moved(arrays, estimate.clock_s)) if arrays.moves else cam_from_vehicle


def _moved_frames(arrays: Arrays, estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Poses exp(-s) P^-1 (J, 4, 4) of the frames, and the left Jacobians (J, 6, 6) of -s."""
    tangent = -frame_tangent(arrays, estimate.frame_state)
    return move(np.ascontiguousarray(tangent.numpy()), np.ascontiguousarray(arrays.vehicle_from_map.numpy()))


def cam_from_map(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Poses of every pair, (C, M, 4, 4)."""
    vehicle_from_map = arrays.vehicle_from_map
    if arrays.states:
        vehicle_from_map = torch.from_numpy(_moved_frames(arrays, estimate)[0])
    vehicle_from_map = arrays.at_moments(vehicle_from_map)
    cameras = _cam_from_vehicle_then(arrays, estimate)
    return torch.from_numpy(compose(cameras.numpy(), vehicle_from_map.numpy()))


def spread_of(arrays: Arrays, estimate: Estimate) -> Spread:
    """Jacobians of the pairs by frame states and clock offsets."""
    state = clock = arrays.centre.new_zeros(arrays.camera_count, arrays.moment_count, 6, 0)
    if arrays.states:
        by_tangent = torch.from_numpy(_moved_frames(arrays, estimate)[1][..., list(arrays.states)])
        state = -_adjoint(_cam_from_vehicle_then(arrays, estimate)) @ arrays.at_moments(by_tangent)
    if arrays.clock_twist.shape[-1]:
        clock = -_adjoint(estimate.cam_from_vehicle)[:, None] @ arrays.clock_twist
    return Spread(arrays, state, clock)


def _half_square(residual: Tensor) -> float:
    flat = residual.flatten()
    return float(flat @ flat) / 2 if len(flat) else 0.0


def with_priors(
    arrays: Arrays, estimate: Estimate, spread: Spread, costs: FloatArray, wrench: Tensor
) -> tuple[dict[str, float], Gradient]:
    """The cost by name, and its gradient; that by corners, already whitened, is (0, 2).

    ``costs`` (3,) are of observations, survey and known lengths, ``wrench`` (C, M, 6) is the observations'
    gradient by the pairs' left tangents.
    """
    cameras = estimate.cam_from_vehicle.numpy()
    centre_root = arrays.centre_information_root.numpy()
    towards_origin = (cameras[:, None, :3, 3] @ cameras[:, :3, :3])[:, 0]
    centre = -(towards_origin + arrays.centre.numpy()) * centre_root
    ground = ground_residual(arrays, estimate.cam_from_vehicle)
    state = state_residual(arrays, estimate.frame_state) if arrays.states else estimate.frame_state
    clock = clock_residual(arrays, estimate.clock_s) if arrays.camera_unknowns > 6 else estimate.clock_s
    terms = {
        "observations": float(costs[0]),
        "camera_centre": float(np.vdot(centre, centre)) / 2,
        "ground_planes": _half_square(ground),
        "frame_states": _half_square(state),
        "clock_offsets": _half_square(clock),
        "control_points": float(costs[1]),
        "known_lengths": float(costs[2]),
    }
    gathered = spread.gather(wrench)
    by_corner = state.new_empty(0, 2)
    gradient = Gradient(gathered.camera[:, :6], gathered.frame_state, by_corner, gathered.camera[:, 6:])
    # A left perturbation moves the centre by minus its translation in vehicle axes.
    by_centre = (centre * centre_root)[..., None]
    gradient.extrinsic.numpy()[:, :3] -= (cameras[:, :3, :3] @ by_centre)[..., 0]
    if bool(arrays.ground_root.any()):
        by_ground = arrays.ground_root @ by_ground_planes(estimate.cam_from_vehicle)
        gradient.extrinsic.add_((by_ground.mT @ ground[..., None])[..., 0])
    if arrays.states:
        innovation = state * arrays.state_information_root
        gradient.frame_state.add_(innovation)
        gradient.frame_state[:-1] -= (arrays.state_transition.mT @ innovation[..., None])[1:, :, 0]
    if clock.numel():
        gradient.clock_s.add_(clock * arrays.clock_information_root)
    return terms, gradient
