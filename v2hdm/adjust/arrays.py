"""A problem as tensors, laid out for speed: sorted by corner, corners in route order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from v2hdm.adjust.problem import POSE_STATES, Problem
from v2hdm.geometry.transform import inverse
from v2hdm.records import FloatArray

# Least step between frames, as a fraction of the correlation length.
_MIN_STEP = 1e-4
# Below this share of an error its white part is rounding left over from the drift.
_MIN_WHITE_SHARE = 1e-3
# Observations that are computed at once: a few megabytes of intermediate results, or a device's fill.
_RUN = 1 << 14
_RUN_ON_DEVICE = 1 << 22


@dataclass(frozen=True)
class Arrays:
    """The constants of a solve; K observations of N corners from P = C * J (camera, frame) pairs.

    Everything that an extrinsic and a frame do to an observation, they do through its pair. So the
    big arrays know only pairs and corners, and sums over pairs are carried on to extrinsics and
    frames on small tables (pair = camera * J + frame).

    Attributes:
        order: (K,) where each sorted observation stood in the problem.
        corner_order: (N,) which corner of the problem each one here is.
        pair: (K,) index of the (camera, frame) pair.
        corner: (K,) index of the corner, ascending.
        measured: (2, K) where it was seen, on the plane at depth 1.
        root_information: (3, K) a, b, c with whitened residual (a dx, b dx + c dy), dx at depth 1.
        vehicle_from_map: (J, 4, 4) as recorded.
        states: the column of the frame tangent that each state of a frame acts on. Where an error has a
            drift beside its white part, two states act on one column.
        centre, centre_information_root: (C, 3) prior on the camera centres, and 1 / sigma.
        state_transition: (J, S, S) what a frame's states are expected to be, given the frame's before.
        state_information_root: (J, S) 1 / sigma of what is new in it.
        clock_twist: (J, 6, Q) how the vehicle moves with a camera's clock offset; Q is 1, or 0 where no
            offset is estimated.
        clock_information_root: 1 / sigma of a clock offset.
        control, control_information: surveyed positions (N, 2) of the corners and 1 / sigma^2 (N,), 0 where
            there is no survey.
    """

    order: Tensor
    corner_order: Tensor
    pair: Tensor
    corner: Tensor
    measured: Tensor
    root_information: Tensor
    vehicle_from_map: Tensor
    states: tuple[int, ...]
    centre: Tensor
    centre_information_root: Tensor
    state_transition: Tensor
    state_information_root: Tensor
    clock_twist: Tensor
    clock_information_root: float
    control: Tensor
    control_information: Tensor

    @property
    def frame_count(self) -> int:
        """J."""
        return len(self.vehicle_from_map)

    @property
    def camera_count(self) -> int:
        """C."""
        return len(self.centre)

    @property
    def corner_count(self) -> int:
        """N."""
        return len(self.corner_order)

    @property
    def camera_unknowns(self) -> int:
        """6 + Q: a camera's extrinsic and, where it is estimated, its clock offset."""
        return 6 + self.clock_twist.shape[-1]

    @property
    def pair_count(self) -> int:
        """P."""
        return self.camera_count * self.frame_count

    def no_clock(self) -> Tensor:
        """Clock offsets (C, Q) of zero."""
        return self.centre.new_zeros(self.camera_count, self.clock_twist.shape[-1])

    def parts(self) -> Iterator[tuple[slice, Arrays]]:
        """Runs of observations, of the same corners and pairs, and where they are.

        What is computed of a run stays in the processor's cache, and beside the whole takes no memory.
        """
        run = _RUN if self.measured.device.type == "cpu" else _RUN_ON_DEVICE
        for begin in range(0, len(self.pair), run):
            part = slice(begin, begin + run)
            yield (
                part,
                replace(
                    self,
                    order=self.order[part],
                    pair=self.pair[part],
                    corner=self.corner[part],
                    measured=self.measured[:, part],
                    root_information=self.root_information[:, part],
                ),
            )

    def take(self, keep: Tensor) -> tuple[Arrays, Tensor]:
        """The problem restricted to the observations ``keep`` (K,) and to the corners they touch.

        Returns it with the indices here of the corners that are left.
        """
        corners, corner = torch.unique(self.corner[keep], return_inverse=True)
        part = replace(
            self,
            order=self.order[keep],
            corner_order=self.corner_order[corners],
            pair=self.pair[keep],
            corner=corner,
            measured=self.measured[:, keep],
            root_information=self.root_information[:, keep],
            control=self.control[corners],
            control_information=self.control_information[corners],
        )
        return part, corners


def make_arrays(
    problem: Problem, pose_states: tuple[str, ...], device: str, clock_offset: bool = False
) -> Arrays:
    """Lay a checked problem out for the solver."""
    seen = problem.observations
    first_frame = np.full(problem.corner_count, len(problem.map_from_vehicle))
    np.minimum.at(first_frame, seen.corner, seen.frame)
    corner_order = np.argsort(first_frame, kind="stable")
    rank = np.empty_like(corner_order)
    rank[corner_order] = np.arange(len(corner_order))
    order = np.lexsort((seen.frame, seen.camera, rank[seen.corner]))
    focal, principal = problem.intrinsic[seen.camera, :2], problem.intrinsic[seen.camera, 2:]
    measured = (seen.pinhole_px - principal) / focal
    root = _root_information(seen.covariance_px, focal)[:, order]
    components = _components(problem, pose_states)
    transition, information_root = _state_prior(problem, components)
    centre, centre_root = _centre_prior(problem)
    control, control_information = _control(problem)

    def real(values: FloatArray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(values), dtype=torch.float64, device=device)

    def index(values: NDArray[np.integer[Any]]) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(values), dtype=torch.int64, device=device)

    return Arrays(
        order=index(order),
        corner_order=index(corner_order),
        pair=index((seen.camera * len(problem.map_from_vehicle) + seen.frame)[order]),
        corner=index(rank[seen.corner][order]),
        measured=real(measured[order].T),
        root_information=real(root),
        vehicle_from_map=inverse(real(problem.map_from_vehicle)),
        states=tuple(component.column for component in components),
        centre=real(centre),
        centre_information_root=real(centre_root),
        state_transition=real(transition),
        state_information_root=real(information_root),
        clock_twist=real(_clock_twist(problem, clock_offset)),
        clock_information_root=1 / problem.clock_sigma_s,
        control=real(control[corner_order]),
        control_information=real(control_information[corner_order]),
    )


def _root_information(covariance_px: FloatArray, focal: FloatArray) -> FloatArray:
    """Inverse Cholesky factors (3, K) of covariances (K, 2, 2): a, b, c of :class:`Arrays`."""
    first = np.sqrt(covariance_px[:, 0, 0])
    below = covariance_px[:, 1, 0] / first
    last = np.sqrt(covariance_px[:, 1, 1] - below**2)
    return np.stack([focal[:, 0] / first, -below * focal[:, 0] / (first * last), focal[:, 1] / last])


def _control(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Surveyed positions (N, 2) and 1 / sigma^2 (N,) of the problem's corners."""
    points, information = np.zeros((problem.corner_count, 2)), np.zeros(problem.corner_count)
    if problem.control is not None:
        points[problem.control.corner] = problem.control.points_map
        information[problem.control.corner] = 1 / problem.control.sigma_m**2
    return points, information


def _clock_twist(problem: Problem, clock_offset: bool) -> FloatArray:
    """(J, 6, Q), Q = 1 if clock offsets are estimated."""
    if not clock_offset or problem.twist_vehicle is None:
        return np.zeros((len(problem.map_from_vehicle), 6, 0))
    return problem.twist_vehicle[:, :, None]


def _centre_prior(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Prior centres and inverse sigmas (C, 3); without a survey the latter are 0."""
    if problem.centre_vehicle is None or problem.centre_sigma_m is None:
        nothing = np.zeros((len(problem.intrinsic), 3))
        return nothing, nothing
    return problem.centre_vehicle, 1 / problem.centre_sigma_m


@dataclass(frozen=True)
class _Component:
    """One state of a frame: the tangent's column, its sigma, and how far it fades (0: white)."""

    column: int
    sigma: float
    over_m: float


def _components(problem: Problem, pose_states: tuple[str, ...]) -> list[_Component]:
    """The states of a frame: for each error its white part, then its drift, where there are any."""
    total, drifts = problem.pose_sigma.by_state(), problem.pose_sigma.drift_by_state()
    chosen = [k for k, name in enumerate(POSE_STATES) if name in pose_states]
    white = {k: float(np.sqrt(max(total[k] ** 2 - drifts[k].sigma ** 2, 0.0))) for k in chosen}
    components = [_Component(k, white[k], 0.0) for k in chosen if white[k] > _MIN_WHITE_SHARE * total[k]]
    return components + [_Component(k, drifts[k].sigma, drifts[k].over_m) for k in chosen if drifts[k].sigma]


def _state_prior(problem: Problem, components: list[_Component]) -> tuple[FloatArray, FloatArray]:
    """Transition (J, S, S) and inverse sigma (J, S) of the innovation of each frame's states.

    A drift is a first-order Gauss-Markov process along the driven distance d: memory m = exp(-d / over_m),
    innovation variance sigma^2 (1 - m^2) (Gelb, Applied Optimal Estimation, section 3.8).
    """
    poses = problem.map_from_vehicle
    step_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turn = np.tile(np.eye(6), (max(len(poses) - 1, 0), 1, 1))
    turn[:, :2, :2] = poses[1:, :2, :2].transpose(0, 2, 1) @ poses[:-1, :2, :2]
    transition = np.zeros((len(poses), len(components), len(components)))
    information_root = np.empty((len(poses), len(components)))
    for a, state in enumerate(components):
        memory = np.zeros(len(poses))
        if state.over_m:
            # A vehicle at rest repeats its error; a floor on the step keeps the innovation's sigma above 0.
            memory[1:] = np.exp(-np.maximum(step_m / state.over_m, _MIN_STEP))
            for b, before in enumerate(components):
                if before.over_m:
                    transition[1:, a, b] = memory[1:] * turn[:, state.column, before.column]
        information_root[:, a] = 1 / (state.sigma * np.sqrt(1 - memory**2))
    return transition, information_root
