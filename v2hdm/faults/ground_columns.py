"""Derivatives, by errors of inputs, of what bare ground tells of the mountings.

The ground's estimate took the same inputs. Under a wrong one it saw another plane, which no residual of the
markings repeats: without these columns it would testify to inputs that it rests on.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust.model import by_ground_planes, ground_planes
from v2hdm.adjust.problem import Problem
from v2hdm.faults.sensitivity import Rows, Sensitivity
from v2hdm.records import BoolArray

_HEIGHT = 3  # place of the height in a plane of the ground


def _rows(planes: Tensor, solved: Sensitivity) -> Rows:
    """Whitened changes of the planes (C, 4) that the inputs let the ground show."""
    return {"ground_planes": (solved.arrays.ground_root @ planes[..., None])[..., 0]}


def _knows_ground(solved: Sensitivity) -> bool:
    return bool(solved.arrays.ground_root.any())


def seen_by_lens(problem: Problem, camera: int, parameter: int, solved: Sensitivity) -> Rows:
    """An error of the focal length or of k1, by its row ``parameter`` in the planes' changes."""
    if problem.ground is None:
        return {}
    changes = problem.ground.by_lens[:, parameter] * _is_of(camera, problem)[:, None]
    return _rows(-solved.arrays.centre.new_tensor(changes), solved)


def seen_by_shifted_image(problem: Problem, camera: int, axis: int, solved: Sensitivity) -> Rows:
    """A principal point one pixel farther right, or down: near it, the camera turned by as much."""
    if problem.ground is None:
        return {}
    turn_rad = _is_of(camera, problem) / problem.intrinsic[:, axis]
    turn = np.zeros((len(turn_rad), 6))
    turn[:, 4 if axis == 0 else 3] = turn_rad if axis == 0 else -turn_rad
    return _rows(_turned(solved.arrays.centre.new_tensor(turn), solved), solved)


def seen_by_moved_vehicle(of_frames: Tensor, solved: Sensitivity) -> Rows:
    """Errors of the recorded poses, tangents (C, J, 6) of the vehicle.

    Texture shows the mounting under the poses' mean, and its height by the distances between them.
    """
    if not _knows_ground(solved):
        return {}
    extrinsic = solved.whitening.estimate.cam_from_vehicle
    mean = of_frames.mean(dim=1)
    shift = (extrinsic[:, :3, :3] @ mean[:, :3, None])[..., 0]
    turn = (extrinsic[:, :3, :3] @ mean[:, 3:, None])[..., 0]
    shift = shift + torch.linalg.cross(extrinsic[:, :3, 3], turn)
    planes = _turned(-torch.cat([shift, turn], dim=1), solved)
    planes[:, _HEIGHT] -= ground_planes(extrinsic)[:, _HEIGHT] * _stretch(of_frames[..., 0], solved)
    return _rows(planes, solved)


def seen_over_tilted_ground(tilt: float, solved: Sensitivity) -> Rows:
    """Ground that falls to the left by ``tilt``, m per m, for each unit of the error."""
    if not _knows_ground(solved):
        return {}
    left = solved.whitening.estimate.cam_from_vehicle[:, :3, 1]
    return _rows(torch.nn.functional.pad(tilt * left, (0, 1)), solved)


def _is_of(camera: int, problem: Problem) -> BoolArray:
    return np.asarray((np.arange(len(problem.intrinsic)) == camera) | (camera < 0))


def _turned(tangents: Tensor, solved: Sensitivity) -> Tensor:
    """Changes of the planes (C, 4) for left tangents (C, 6) of the extrinsics."""
    by_tangent = by_ground_planes(solved.whitening.estimate.cam_from_vehicle)
    changes: Tensor = (by_tangent @ tangents[..., None])[..., 0]
    return changes


def _stretch(forward_m: Tensor, solved: Sensitivity) -> Tensor:
    """By how much (C,) the way is longer than recorded, for errors ahead (C, J): their slope over the way."""
    way_m = solved.way_m
    return (forward_m @ way_m) / way_m.square().sum().clamp(min=1e-9)
