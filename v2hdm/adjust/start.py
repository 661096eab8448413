"""A first look at steep rays of part of the route, which leads home from ten degrees away."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.descent import descend, open_descent
from v2hdm.adjust.engine import Engine
from v2hdm.adjust.model import Estimate, Loss, depression_sine
from v2hdm.adjust.whitening import Whitening

# Sines of the depression below which rays are left out: from nearby the first will do, else the rest in turn.
_MIN_DEPRESSION_SINES = (0.1, 0.2, 0.1)
# Rotation of a camera, rad, up to which every start led to the optimum without steep rays: 3 degrees, of the
# 5 that were tried. What a first Newton step predicts errs by a twentieth at ten degrees.
_NEAR_RAD = 0.052
# With more corners than this a look at some of them saves more evaluations of all than it costs.
_WORTH_CORNERS = 1000
# Corners of the first look, and of those from far away.
_NEARBY_CORNERS = 100
_CORNERS = 400
_BLOCKS = 10
# Below this many observations a camera's six unknowns are not worth estimating from the subset.
_MIN_OBSERVATIONS = 24
_LOSS = Loss("huber", 1.0)
_GAP_TOLERANCE = 1e-3
_MAX_REFRESHES = 10
_MAX_EVALUATIONS = 200


def is_worth_a_look(arrays: Arrays) -> bool:
    """Whether a coarse stage pays whatever the start: it leaves most of the descent to a few corners."""
    return arrays.corner_count > _WORTH_CORNERS


def is_near(whitening: Whitening) -> bool:
    """Whether the Newton step from a start turns no camera by more than the descent can do by itself."""
    step, _, _ = whitening.step(-whitening.gradient)
    return float(step.extrinsic[:, 3:].norm(dim=1).max()) <= _NEAR_RAD


def coarse_extrinsics(engine: Engine, cam_from_vehicle: Tensor) -> tuple[Tensor, int]:
    """Improved extrinsics (C, 4, 4), and the evaluations spent.

    Rays near the horizon turn a small error of pitch into tens of metres; steep ones do not, and a few
    hundred corners fix an extrinsic. The poses are taken as recorded: what they are off is small
    here. The loss is convex, and wide enough for the residuals that are found.
    """
    evaluations = 0
    # Whether the start of a small problem is far off has been seen before.
    for stage in range(0 if is_worth_a_look(engine.arrays) else 1, len(_MIN_DEPRESSION_SINES)):
        arrays = _papers_model(engine.arrays, _CORNERS if stage else _NEARBY_CORNERS)
        whole = arrays.whole()
        poses = (cam_from_vehicle[:, None] @ arrays.vehicle_from_map).flatten(0, 1)
        chosen = _seen_twice(
            arrays, depression_sine(poses[whole.pair], whole.measured) > _MIN_DEPRESSION_SINES[stage]
        )
        if chosen is None:
            continue
        part = engine.over(chosen)
        corners, _ = part.back_project(cam_from_vehicle)
        start = Estimate(cam_from_vehicle, chosen.state_information_root, corners, chosen.no_clock())
        opening = open_descent(part, start, _LOSS)
        if stage == 0 and not is_near(opening):
            continue
        descent = descend(part, start, _LOSS, _GAP_TOLERANCE, _MAX_REFRESHES, _MAX_EVALUATIONS, opening)
        cam_from_vehicle = descent.estimate.cam_from_vehicle
        evaluations += descent.evaluations
        if stage == 0:
            break
    return cam_from_vehicle, evaluations


def _papers_model(arrays: Arrays, corners: int) -> Arrays:
    """The problem of so many corners and the frames that saw them, no states and no clocks."""
    if arrays.corner_count > corners:
        arrays, _ = arrays.take(_route_blocks(arrays, corners))
    # Without states a moment is a frame of its own.
    moments, moment = torch.unique(arrays.pair % arrays.moment_count, return_inverse=True)
    camera, moments = arrays.camera_of(arrays.pair), moments.long()
    frames = arrays.frame_of(moments)
    return replace(
        arrays,
        pair=camera * len(moments) + moment.to(camera.dtype),
        vehicle_from_map=arrays.vehicle_from_map[frames],
        states=(),
        state_transition=arrays.state_transition[frames, :0, :0],
        state_information_root=arrays.state_information_root[frames, :0],
        clock_twist=arrays.clock_twist[moments, :, :0],
        clock_information_root=arrays.clock_information_root[:0],
        frame_of_moment=None,
        read_out=None if arrays.read_out is None else arrays.read_out[:, moments],
    )


def _route_blocks(arrays: Arrays, corners: int) -> Tensor:
    """The observations (k,) of corners in contiguous blocks spread over the route."""
    first = torch.arange(_BLOCKS, device=arrays.corner.device) * arrays.corner_count // _BLOCKS
    bounds = torch.stack([first, first + corners // _BLOCKS]).to(arrays.corner.dtype)
    begin, end = torch.searchsorted(arrays.corner, bounds).tolist()
    parts = (torch.arange(*block, device=first.device) for block in zip(begin, end, strict=True))
    return torch.cat(list(parts))


def _seen_twice(arrays: Arrays, keep: Tensor) -> Arrays | None:
    """The problem of the corners that ``keep`` leaves at least two observations, if these are enough."""
    sightings = torch.bincount(arrays.corner[keep], minlength=arrays.corner_count)
    keep = keep & (sightings >= 2)[arrays.corner]
    camera = arrays.camera_of(arrays.pair[keep])
    if int(torch.bincount(camera, minlength=arrays.camera_count).min()) < _MIN_OBSERVATIONS:
        return None
    part, _ = arrays.take(keep)
    return part
