"""Where the corners start: back-projection, weighted by how well each ray fixes its ground point."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.residuals import Estimate, jacobians, observe
from v2hdm.adjust.whitening import cholesky_2x2, solve_lower, solve_lower_transposed
from v2hdm.geometry.transform import inverse

# Below this sine of the depression a ray meets the ground too far away to say where.
_MIN_DEPRESSION_SINE = 0.01


def ground_hits(arrays: Arrays, cam_from_vehicle: Tensor) -> tuple[Tensor, Tensor]:
    """Where each observation's ray meets the ground.

    Returns the points (K, 2) of the map, and the sine (K,) of the ray's depression below the horizon;
    where that is not positive, the ray misses the ground and the point means nothing.
    """
    map_from_vehicle = inverse(arrays.vehicle_from_map)
    map_from_cam = (map_from_vehicle[None] @ inverse(cam_from_vehicle)[:, None]).reshape(-1, 4, 4)
    rays_cam = torch.cat([arrays.measured, torch.ones_like(arrays.measured[:1])]).T
    rays_map = (map_from_cam[arrays.pair, :3, :3] @ rays_cam[..., None])[..., 0]
    centres_map = map_from_cam[arrays.pair, :3, 3]
    sine = -rays_map[:, 2] / rays_map.norm(dim=-1)
    usable = torch.where(sine > _MIN_DEPRESSION_SINE, rays_map[:, 2], -torch.ones_like(sine))
    reach = -centres_map[:, 2] / usable
    return (centres_map + reach[:, None] * rays_map)[:, :2], sine


def back_project(arrays: Arrays, cam_from_vehicle: Tensor) -> tuple[Tensor, Tensor]:
    """Start (N, 2) of every corner under the extrinsics, the recorded poses and z = 0.

    l_i = (sum J'J)^-1 sum J'J g_k, with g_k the ray's ground point and J the derivative of the
    projection there. A plain mean would be ruined by a single ray near the horizon.

    Returns the corners, and which of them (N,) at least one ray fixes.
    """
    points_map, sine = ground_hits(arrays, cam_from_vehicle)
    usable = sine > _MIN_DEPRESSION_SINE
    each = _one_corner_each(arrays)
    state = torch.zeros_like(arrays.state_information_root)
    estimate = Estimate(cam_from_vehicle, state, points_map, arrays.no_clock())
    _, by_corner = jacobians(each, observe(each, estimate))
    information = torch.where(usable[:, None, None], by_corner.mT @ by_corner, torch.zeros_like(by_corner))
    points_map = torch.where(usable[:, None], points_map, torch.zeros_like(points_map))
    total = information.new_zeros(arrays.corner_count, 2, 2).index_add_(0, arrays.corner, information)
    right = (information @ points_map[..., None])[..., 0]
    right = right.new_zeros(arrays.corner_count, 2).index_add_(0, arrays.corner, right)
    fixed = total[:, 0, 0] > 0
    total[~fixed] = torch.eye(2, dtype=total.dtype, device=total.device)
    factor = cholesky_2x2(total)
    return solve_lower_transposed(factor, solve_lower(factor, right)), fixed


def _one_corner_each(arrays: Arrays) -> Arrays:
    """The same observations, each of a corner of its own."""
    own = torch.arange(len(arrays.corner), device=arrays.corner.device)
    control, information = arrays.control[arrays.corner], arrays.control_information[arrays.corner]
    return replace(arrays, corner=own, corner_order=own, control=control, control_information=information)
