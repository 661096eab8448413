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

from v2hdm.adjust.arrays import Arrays, CameraQuadratic
from v2hdm.adjust.model import (
    Estimate,
    Gradient,
    centre_residual,
    clock_residual,
    frame_tangent,
    moved,
    state_residual,
)
from v2hdm.adjust.reduced import PriorBlocks, Spread
from v2hdm.geometry import rigid
from v2hdm.geometry.tensors import inverse


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
    if cameras.shape[1] > 1:
        return cameras @ vehicle_from_map
    # One product of two matrices, instead of many of four rows each.
    product = cameras.reshape(-1, 4) @ vehicle_from_map.transpose(0, 1).reshape(4, -1)
    return product.view(len(cameras), 4, -1, 4).transpose(1, 2).contiguous()


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


def with_priors(
    arrays: Arrays, estimate: Estimate, spread: Spread, costs: Tensor, wrench: Tensor
) -> tuple[dict[str, Tensor], Gradient]:
    """The cost by name and its gradient; by corners, where it is whitened already, (0, 2).

    Args:
        arrays: the problem.
        estimate: where.
        spread: how pairs move there.
        costs: (3,) of the observations, the survey and the known lengths.
        wrench: (C, M, 6) the observations' gradient by the pairs' left tangents.
    """
    centre = centre_residual(arrays, estimate.cam_from_vehicle)
    state = state_residual(arrays, estimate.frame_state) if arrays.states else estimate.frame_state
    clock = clock_residual(arrays, estimate.clock_s)
    terms = {
        "observations": costs[0],
        "camera_centre": centre.square().sum() / 2,
        "frame_states": state.square().sum() / 2,
        "clock_offsets": clock.square().sum() / 2,
        "control_points": costs[1],
        "known_lengths": costs[2],
    }
    gathered = spread.gather(wrench)
    by_corner = state.new_empty(0, 2)
    gradient = Gradient(gathered.camera[:, :6], gathered.frame_state, by_corner, gathered.camera[:, 6:])
    # A left perturbation moves the centre by minus its translation part, turned into the vehicle.
    rotation = estimate.cam_from_vehicle[:, :3, :3]
    gradient.extrinsic[:, :3] -= (rotation @ (centre * arrays.centre_information_root)[..., None])[..., 0]
    if arrays.states:
        innovation = state * arrays.state_information_root
        gradient.frame_state.add_(innovation)
        gradient.frame_state[:-1] -= (arrays.state_transition.mT @ innovation[..., None])[1:, :, 0]
    if clock.numel():
        gradient.clock_s.add_(clock * arrays.clock_information_root)
    if arrays.camera_prior is not None:
        terms["earlier_markings"], by_camera, _ = _earlier(arrays, estimate, arrays.camera_prior)
        gradient.extrinsic.add_(by_camera[:, :6])
        gradient.clock_s.add_(by_camera[:, 6:])
    return terms, gradient


def prior_blocks_of(arrays: Arrays, estimate: Estimate) -> PriorBlocks:
    """The priors' part of the Gauss-Newton Hessian of the reduced unknowns."""
    rotation, root = estimate.cam_from_vehicle[:, :3, :3], arrays.centre_information_root
    each = arrays.camera_unknowns
    by_camera = rotation.new_zeros(arrays.camera_count, each, each)
    by_camera[:, :3, :3] += rotation * root.square()[:, None] @ rotation.mT
    by_camera.diagonal(dim1=1, dim2=2)[:, 6:] += arrays.clock_information_root**2
    cameras = torch.block_diag(*by_camera)  # type: ignore[no-untyped-call]
    if arrays.camera_prior is not None:
        cameras = cameras + _earlier(arrays, estimate, arrays.camera_prior)[2]
    carried = arrays.state_information_root[..., None] * arrays.state_transition
    frame = torch.diag_embed(arrays.state_information_root.square())
    frame[:-1] += (carried.mT @ carried)[1:]
    return PriorBlocks(cameras, frame, -arrays.state_information_root[..., None] * carried)


def _earlier(arrays: Arrays, estimate: Estimate, prior: CameraQuadratic) -> tuple[Tensor, Tensor, Tensor]:
    """Cost of the prior by earlier markings, its gradient (C, 6 + Q) and Gauss-Newton Hessian."""
    each, like = arrays.camera_unknowns, prior.mean
    tangent = rigid.log((estimate.cam_from_vehicle @ inverse(prior.base)).numpy())
    turned = np.eye(like.numel())
    for camera, jacobian in enumerate(np.linalg.inv(rigid.left_jacobian(tangent))):
        part = slice(each * camera, each * camera + 6)
        turned[part, part] = jacobian
    chart = torch.as_tensor(turned, dtype=like.dtype)
    off = (torch.cat([torch.as_tensor(tangent, dtype=like.dtype), estimate.clock_s], dim=1) - like).flatten()
    pulled = prior.information @ off
    hessian = chart.mT @ prior.information @ chart
    return off @ pulled / 2, (chart.mT @ pulled).view(-1, each), hessian
