"""Where the corners start: back-projection, weighted by how well each ray fixes its ground point."""

from __future__ import annotations

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays, Run
from v2hdm.adjust.corner_factor import CornerFactor, cholesky_2x2
from v2hdm.adjust.linear import corner_blocks, jacobians
from v2hdm.adjust.residuals import Estimate, of_each, pair_table, project
from v2hdm.geometry.tensors import inverse

MIN_DEPRESSION_SINE = 0.01
"""Below this sine of the depression a ray meets the ground too far away to say where."""


def ray_table(arrays: Arrays, cam_from_vehicle: Tensor) -> Tensor:
    """``map_from_cam`` of every pair, row by row, (12, P)."""
    map_from_vehicle = inverse(arrays.vehicle_from_map)
    map_from_cam = map_from_vehicle[None] @ inverse(cam_from_vehicle)[:, None]
    return map_from_cam[:, :, :3].permute(2, 3, 0, 1).reshape(12, arrays.pair_count)


def ground_hits(run: Run, table: Tensor) -> tuple[Tensor, Tensor]:
    """Where the rays of a run meet the ground; ``table`` is the :func:`ray_table`.

    Returns the points (2, k) of the map, and the sine (k,) of the ray's depression below the horizon;
    where that is not positive, the ray misses the ground and the point means nothing.
    """
    columns = of_each(table, run.pair).view(3, 4, -1)
    ray = columns[:, 0] * run.measured[0] + columns[:, 1] * run.measured[1] + columns[:, 2]
    centre = columns[:, 3]
    sine = -ray[2] / ray.norm(dim=0)
    usable = torch.where(sine > MIN_DEPRESSION_SINE, ray[2], -1.0)
    return torch.addcmul(centre[:2], ray[:2], -centre[2] / usable), sine


def back_project(arrays: Arrays, cam_from_vehicle: Tensor) -> tuple[Tensor, Tensor]:
    """Start (N, 2) of every corner under the extrinsics, the recorded poses and z = 0.

    l_i = (sum J'J)^-1 sum J'J g_k, with g_k the ray's ground point and J the derivative of the
    projection there. A plain mean would be ruined by a single ray near the horizon.

    Returns the corners, and which of them (N,) at least one ray fixes.
    """
    corners = arrays.centre.new_empty(arrays.corner_count, 2)
    state = torch.zeros_like(arrays.state_information_root)
    estimate = Estimate(cam_from_vehicle, state, corners, arrays.no_clock())
    if arrays.passes is not None:
        return arrays.passes.back_project(estimate)
    table = pair_table(arrays, estimate)
    rays = ray_table(arrays, cam_from_vehicle)
    fixed = torch.empty_like(arrays.joined)
    for run in arrays.runs():
        ground, sine = ground_hits(run, rays)
        usable = sine > MIN_DEPRESSION_SINE
        ground = torch.where(usable, ground, 0.0)
        _, by_corner = jacobians(run, project(run, table, ground))
        xx, yx, yy = torch.where(usable, corner_blocks(by_corner), 0.0)
        x, y = ground
        sums = run.sum_by_corner(torch.stack([xx, yx, yy, xx * x + yx * y, yx * x + yy * y]))
        some = sums[:, 0] > 0
        sums[~some] = sums.new_tensor([1.0, 0.0, 1.0, 0.0, 0.0])
        factor = CornerFactor(cholesky_2x2(*sums[:, :3].T), ())
        corners[run.corners] = factor.solve_transposed(factor.solve(sums[:, 3:]))
        fixed[run.corners] = some
    return corners, fixed
