"""The shared unknowns: what is known of them beforehand, and their part of the whitening."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays, Lengths
from v2hdm.adjust.parts.split import said_of_shared
from v2hdm.adjust.problem import Problem
from v2hdm.adjust.residuals import (
    Estimate,
    Sums,
    by_corner_priors,
    corner_priors,
    length_residual,
    with_priors,
)
from v2hdm.geometry.tensors import exp, left_jacobian
from v2hdm.records import IntArray


@dataclass(frozen=True)
class Shared:
    """Extrinsics (C, 4, 4) and shared corners (M, 2) at a point."""

    cam_from_vehicle: Tensor
    corners_map: Tensor

    def moved(self, step: Tensor) -> Shared:
        """Moved by a step (6 C + 2 M,) of left tangents and corners."""
        tangents = step[: 6 * len(self.cam_from_vehicle)].view(-1, 6)
        corners = step[6 * len(self.cam_from_vehicle) :].view(-1, 2)
        return Shared(exp(tangents) @ self.cam_from_vehicle, self.corners_map + corners)


class SharedPriors:
    """What survey, known lengths and the cameras' surveyed centres say of the shared unknowns."""

    def __init__(self, problem: Problem, shared: IntArray) -> None:
        """``shared`` (M,) are the problem's shared corners."""
        self._arrays = _arrays(problem, shared)

    def cost_and_gradient(self, at: Shared, step: Tensor | None = None) -> tuple[dict[str, Tensor], Tensor]:
        """Cost by name, and the gradient (6 C + 2 M,) by the step that led to a point; None for no step."""
        arrays, estimate = self._arrays, self._estimate(at)
        control, lengths = corner_priors(arrays, at.corners_map)
        by_corner = by_corner_priors(arrays, estimate, slice(0, arrays.corner_count))
        wrench = at.corners_map.new_zeros(arrays.camera_count, 0, 6)
        sums = Sums(wrench.new_zeros(()), control, lengths, wrench, by_corner)
        terms, gradient = with_priors(arrays, estimate, sums)
        by_camera = gradient.extrinsic
        if step is not None:
            tangents = step[: 6 * arrays.camera_count].view(-1, 6)
            by_camera = (left_jacobian(tangents).mT @ by_camera[..., None])[..., 0]
        return terms, torch.cat([by_camera.flatten(), gradient.corners_map.flatten()])

    def information(self, at: Shared) -> Tensor:
        """The Gauss-Newton Hessian (6 C + 2 M) at a point."""
        arrays, cameras = self._arrays, 6 * self._arrays.camera_count
        out = at.corners_map.new_zeros(cameras + 2 * arrays.corner_count, cameras + 2 * arrays.corner_count)
        rotation, root = at.cam_from_vehicle[:, :3, :3], arrays.centre_information_root
        for camera, block in enumerate(rotation * root.square()[:, None] @ rotation.mT):
            part = slice(6 * camera, 6 * camera + 3)
            out[part, part] = block
        corners = out[cameras:, cameras:]
        corners.diagonal().add_(arrays.control_information.flatten())
        _, by_first = length_residual(arrays, at.corners_map)
        jacobian = out.new_zeros(len(by_first), arrays.corner_count, 2)
        rows = torch.arange(len(by_first))
        jacobian[rows, arrays.lengths.first] = by_first
        jacobian[rows, arrays.lengths.second] = -by_first
        corners.addmm_(jacobian.flatten(1).mT, jacobian.flatten(1))
        return out

    def _estimate(self, at: Shared) -> Estimate:
        none = at.corners_map.new_zeros(0, 0)
        return Estimate(
            at.cam_from_vehicle, none, at.corners_map, none.new_zeros(self._arrays.camera_count, 0)
        )


def _arrays(problem: Problem, shared: IntArray) -> Arrays:
    """A problem of the shared corners without a frame and without an observation."""

    def real(*shape: int) -> Tensor:
        return torch.zeros(shape, dtype=torch.float64)

    control, lengths = said_of_shared(problem, shared)
    cameras, count = len(problem.intrinsic), len(shared)
    index = torch.zeros(0, dtype=torch.int64)
    out = Arrays(
        order=index,
        corner_order=torch.arange(count),
        joined=torch.zeros(count, dtype=torch.bool),
        pair=index,
        corner=index,
        measured=real(2, 0),
        root_information=real(3, 0),
        vehicle_from_map=real(0, 4, 4),
        states=(),
        centre=real(cameras, 3),
        centre_information_root=real(cameras, 3),
        state_transition=real(0, 0, 0),
        state_information_root=real(0, 0),
        clock_twist=real(0, 6, 0),
        clock_information_root=0.0,
        control=real(count, 2),
        control_information=real(count, 2),
        lengths=Lengths(index, index, real(0), real(0)),
    )
    if problem.centre_vehicle is not None and problem.centre_sigma_m is not None:
        centre, root = torch.as_tensor(problem.centre_vehicle), torch.as_tensor(1 / problem.centre_sigma_m)
        out = replace(out, centre=centre, centre_information_root=root)
    if control is not None:
        out.control[control.corner] = torch.as_tensor(control.points_map)
        out.control_information[control.corner] = torch.as_tensor(1 / control.sigma_m**2)
    if lengths is not None and len(lengths.first):
        # Joined or not matters only to those who part corners: here they are all together.
        known = Lengths(*(torch.as_tensor(np.asarray(one)) for one in vars(lengths).values()))
        joined = torch.ones(count, dtype=torch.bool)
        out = replace(out, lengths=replace(known, information_root=1 / known.information_root), joined=joined)
    return out
