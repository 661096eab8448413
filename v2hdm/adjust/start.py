"""Where the corners start: back-projection, weighted by how well each ray fixes its ground point.

A first look at steep rays of part of the route: leads home from ten degrees away.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays, Run
from v2hdm.adjust.corner_factor import CornerFactor, cholesky_2x2
from v2hdm.adjust.descent import descend, open_descent
from v2hdm.adjust.linear import corner_blocks, jacobians
from v2hdm.adjust.residuals import Estimate, Loss, of_each, pair_table, project
from v2hdm.adjust.whitening import Whitening
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


# Sines of the depression below which rays are left out, in turn; from nearby the last of them will do.
_MIN_DEPRESSION_SINES = (0.2, 0.1)
# Rotation of a camera, rad, up to which every start led to the optimum without steep rays: 3 degrees, of the
# 5 that were tried. What a first Newton step predicts errs by a twentieth at ten degrees.
_NEAR_RAD = 0.052
# With more corners than this a look at some of them saves more evaluations of all than it costs.
_WORTH_CORNERS = 10_000
_CORNERS = 400
_BLOCKS = 10
# Below this many observations a camera's six unknowns are not worth estimating from the subset.
_MIN_OBSERVATIONS = 24
_LOSS = Loss("huber", 1.0)
_GAP_TOLERANCE = 1e-4
_MAX_REFRESHES = 10
_MAX_EVALUATIONS = 200


def is_worth_a_look(arrays: Arrays) -> bool:
    """Whether a coarse stage pays whatever the start: it leaves most of the descent to a few corners."""
    return arrays.corner_count > _WORTH_CORNERS


def is_near(whitening: Whitening) -> bool:
    """Whether the Newton step from a start turns no camera by more than the descent can do by itself."""
    step, _ = whitening.reduced_step(-whitening.gradient)
    return float(step.extrinsic[:, 3:].norm(dim=1).max()) <= _NEAR_RAD


def coarse_extrinsics(arrays: Arrays, cam_from_vehicle: Tensor) -> tuple[Tensor, int]:
    """Improved extrinsics (C, 4, 4), and the evaluations spent.

    Rays near the horizon turn a small error of pitch into tens of metres; steep ones do not, and a few
    hundred corners fix an extrinsic. The poses are taken as recorded: what they are off is small
    here. The loss is convex, and wide enough for the residuals that are found.
    """
    arrays = _papers_model(arrays)
    evaluations = 0
    for min_sine in _MIN_DEPRESSION_SINES:
        _, sine = ground_hits(arrays.whole(), ray_table(arrays, cam_from_vehicle))
        part = _seen_twice(arrays, sine > min_sine)
        if part is None:
            continue
        corners, _ = back_project(part, cam_from_vehicle)
        start = Estimate(cam_from_vehicle, part.state_information_root, corners, part.no_clock())
        opening = open_descent(part, start, _LOSS)
        if min_sine > _MIN_DEPRESSION_SINES[-1] and is_near(opening):
            continue
        descent = descend(
            part, start, _LOSS, "lbfgs", _GAP_TOLERANCE, _MAX_REFRESHES, _MAX_EVALUATIONS, opening
        )
        cam_from_vehicle = descent.estimate.cam_from_vehicle
        evaluations += descent.evaluations
    return cam_from_vehicle, evaluations


def _papers_model(arrays: Arrays) -> Arrays:
    """The problem of some corners and the frames that saw them, no states and no clocks."""
    if arrays.corner_count > _CORNERS:
        arrays, _ = arrays.take(_route_blocks(arrays))
    frames, frame = torch.unique(arrays.pair % arrays.frame_count, return_inverse=True)
    camera, frames = arrays.pair // arrays.frame_count, frames.long()
    return replace(
        arrays,
        pair=camera * len(frames) + frame.to(camera.dtype),
        vehicle_from_map=arrays.vehicle_from_map[frames],
        states=(),
        state_transition=arrays.state_transition[frames, :0, :0],
        state_information_root=arrays.state_information_root[frames, :0],
        clock_twist=arrays.clock_twist[frames, :, :0],
    )


def _route_blocks(arrays: Arrays) -> Tensor:
    """The observations (k,) of corners in contiguous blocks spread over the route."""
    first = torch.arange(_BLOCKS, device=arrays.corner.device) * arrays.corner_count // _BLOCKS
    bounds = torch.stack([first, first + _CORNERS // _BLOCKS]).to(arrays.corner.dtype)
    begin, end = torch.searchsorted(arrays.corner, bounds).tolist()
    parts = (torch.arange(*block, device=first.device) for block in zip(begin, end, strict=True))
    return torch.cat(list(parts))


def _seen_twice(arrays: Arrays, keep: Tensor) -> Arrays | None:
    """The problem of the corners that ``keep`` leaves at least two observations, if these are enough."""
    sightings = torch.bincount(arrays.corner[keep], minlength=arrays.corner_count)
    keep = keep & (sightings >= 2)[arrays.corner]
    camera = arrays.pair[keep] // arrays.frame_count
    if int(torch.bincount(camera, minlength=arrays.camera_count).min()) < _MIN_OBSERVATIONS:
        return None
    part, _ = arrays.take(keep)
    return part
