"""Closed forms for pairs and priors, which are few: an evaluation is no slower for them.

With ``A = [r1 r2 t]`` of a pair's ``cam_from_map`` a corner l lies at p = A (l_x, l_y, 1) in the camera. A
gradient of the cost by p is a force, so that of a pair by its left tangent is a *wrench*: the sums of the
forces and of their moments p x force. Extrinsics, frame states and clock offsets act through pairs:

- a left perturbation of ``cam_from_vehicle`` is one of every pair of the camera;
- ds in ``exp(-s)`` perturbs the pair by -Ad(cam_from_vehicle exp(-q v)) J_l(-s) ds;
- dq in ``exp(-q v)`` perturbs the pair by -Ad(cam_from_vehicle) v dq; so does a read-out time, its v by row.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.engines.numba.motion import compose
from v2hdm.adjust.model import (
    Estimate,
    Gradient,
    clock_residual,
    frame_tangent,
    moved,
    state_residual,
)
from v2hdm.adjust.reduced import PriorBlocks, Spread
from v2hdm.geometry import rigid
from v2hdm.records import FloatArray


def _exp(tangent: Tensor) -> Tensor:
    return torch.from_numpy(rigid.exp(tangent.numpy()))


def _adjoint(dst_from_src: Tensor) -> Tensor:
    return torch.from_numpy(rigid.adjoint(dst_from_src.numpy()))


def _cam_from_vehicle_then(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Cameras from where the vehicle is at each frame's stated time, (C, M or 1, 4, 4)."""
    cam_from_vehicle = estimate.cam_from_vehicle[:, None]
    return cam_from_vehicle @ _exp(-moved(arrays, estimate.clock_s)) if arrays.moves else cam_from_vehicle


def cam_from_map(arrays: Arrays, estimate: Estimate) -> Tensor:
    """Poses of every pair, (C, M, 4, 4)."""
    vehicle_from_map = arrays.vehicle_from_map
    if arrays.states:
        vehicle_from_map = _exp(-frame_tangent(arrays, estimate.frame_state)) @ vehicle_from_map
    vehicle_from_map = arrays.at_moments(vehicle_from_map)
    cameras = _cam_from_vehicle_then(arrays, estimate)
    return torch.from_numpy(compose(cameras.numpy(), vehicle_from_map.numpy()))


def spread_of(arrays: Arrays, estimate: Estimate) -> Spread:
    """How pairs move with frame states and clock offsets."""
    state = clock = arrays.centre.new_zeros(arrays.camera_count, arrays.moment_count, 6, 0)
    if arrays.states:
        tangent = -frame_tangent(arrays, estimate.frame_state)
        by_tangent = torch.from_numpy(rigid.left_jacobian(tangent.numpy())[..., list(arrays.states)])
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
    """The cost by name and its gradient; by corners, where it is whitened already, (0, 2).

    ``costs`` (3,) are of observations, survey and known lengths, ``wrench`` (C, M, 6) the observations'
    gradient by the pairs' left tangents.
    """
    cameras, centre_root = estimate.cam_from_vehicle.numpy(), arrays.centre_information_root.numpy()
    centre = (rigid.camera_centre(cameras) - arrays.centre.numpy()) * centre_root
    state = state_residual(arrays, estimate.frame_state) if arrays.states else estimate.frame_state
    clock = clock_residual(arrays, estimate.clock_s) if arrays.camera_unknowns > 6 else estimate.clock_s
    terms = {
        "observations": float(costs[0]),
        "camera_centre": float(np.vdot(centre, centre)) / 2,
        "frame_states": _half_square(state),
        "clock_offsets": _half_square(clock),
        "control_points": float(costs[1]),
        "known_lengths": float(costs[2]),
    }
    gathered = spread.gather(wrench)
    by_corner = state.new_empty(0, 2)
    gradient = Gradient(gathered.camera[:, :6], gathered.frame_state, by_corner, gathered.camera[:, 6:])
    # A left perturbation moves the centre by minus its translation part, turned into the vehicle.
    by_centre = (centre * centre_root)[..., None]
    gradient.extrinsic.numpy()[:, :3] -= (cameras[:, :3, :3] @ by_centre)[..., 0]
    if arrays.states:
        innovation = state * arrays.state_information_root
        gradient.frame_state.add_(innovation)
        gradient.frame_state[:-1] -= (arrays.state_transition.mT @ innovation[..., None])[1:, :, 0]
    if clock.numel():
        gradient.clock_s.add_(clock * arrays.clock_information_root)
    return terms, gradient


def prior_blocks_of(arrays: Arrays, estimate: Estimate) -> PriorBlocks:
    """The priors' part of the Gauss-Newton Hessian of the reduced unknowns."""
    count, each = arrays.camera_count, arrays.camera_unknowns
    by_camera = np.zeros((count, each, count, each))
    root, clock_root = arrays.centre_information_root.numpy(), arrays.clock_information_root.numpy()
    for c, turn in enumerate(estimate.cam_from_vehicle.numpy()[:, :3, :3]):
        by_camera[c, :3, c, :3] = turn * root[c] ** 2 @ turn.T
        by_camera[c, 6:, c, 6:] = np.diag(clock_root**2)
    cameras = torch.from_numpy(by_camera).view(count * each, -1)
    if not arrays.states:
        none = cameras.new_zeros(arrays.frame_count, 0, 0)
        return PriorBlocks(cameras, none, none)
    carried = arrays.state_information_root[..., None] * arrays.state_transition
    frame = torch.diag_embed(arrays.state_information_root.square())
    frame[:-1] += (carried.mT @ carried)[1:]
    return PriorBlocks(cameras, frame, -arrays.state_information_root[..., None] * carried)
