"""A first look at steep rays of part of the route: leads home from ten degrees away."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.descent import descend
from v2hdm.adjust.residuals import Estimate, Loss
from v2hdm.adjust.start import back_project, ground_hits, ray_table

# Sines of the depression below which rays are left out, in turn.
_MIN_DEPRESSION_SINES = (0.2, 0.1)
_CORNERS = 400
_BLOCKS = 10
# Below this many observations a camera's six unknowns are not worth estimating from the subset.
_MIN_OBSERVATIONS = 24
_GAP_TOLERANCE = 1e-4
_MAX_REFRESHES = 10
_MAX_EVALUATIONS = 200


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
        descent = descend(
            part, start, Loss("huber", 1.0), "lbfgs", _GAP_TOLERANCE, _MAX_REFRESHES, _MAX_EVALUATIONS
        )
        cam_from_vehicle = descent.whitening.estimate.cam_from_vehicle
        evaluations += descent.evaluations
    return cam_from_vehicle, evaluations


def _papers_model(arrays: Arrays) -> Arrays:
    """The problem of some corners and the frames that saw them, no states and no clocks."""
    subset = _route_blocks(arrays)
    if not bool(subset.all()):
        arrays, _ = arrays.take(subset[arrays.corner.long()])
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
    """Mask (N,) of corners in contiguous blocks spread over the route."""
    count = arrays.corner_count
    index = torch.arange(count, device=arrays.corner.device)
    if count <= _CORNERS:
        return torch.ones_like(index, dtype=torch.bool)
    block = index * _BLOCKS // count
    first = torch.searchsorted(block, block)
    return index - first < _CORNERS // _BLOCKS


def _seen_twice(arrays: Arrays, keep: Tensor) -> Arrays | None:
    """The problem of the corners that ``keep`` leaves at least two observations, if these are enough."""
    sightings = torch.bincount(arrays.corner[keep], minlength=arrays.corner_count)
    keep = keep & (sightings >= 2)[arrays.corner]
    camera = arrays.pair[keep] // arrays.frame_count
    if int(torch.bincount(camera, minlength=arrays.camera_count).min()) < _MIN_OBSERVATIONS:
        return None
    part, _ = arrays.take(keep)
    return part
