"""Sensitivity of a solution's residuals to parameters it holds fixed, with all estimated ones adapting."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice, pairwise
from typing import Any, TypeVar

import numpy as np
import torch
from scipy.sparse import vstack
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.covariance import Moves
from v2hdm.adjust.model import (
    Estimate,
    frame_tangent,
    points_in_camera,
    prior_residuals,
    rigid,
    robustified,
)
from v2hdm.adjust.solution import Solution
from v2hdm.adjust.whitening import Whitening
from v2hdm.faults.jacobians import Jacobians, Whitened
from v2hdm.geometry.tensors import NEAR_M
from v2hdm.records import FloatArray, IntArray

STRETCHES = 24  # segments of a session's route: metres each, longer than the correlation of most errors
_DRAWS = 16  # draws of the model's noise, which give the expected disagreement to a tenth
_ERRORS_OF_POSES = ((0, 1), (2,), (3, 4), (5,))
"""Axes of a frame's tangent with errors of a common size: position, height, roll and pitch, heading."""

NOISES = len(_ERRORS_OF_POSES) + 2
"""Kinds of noise: that of observations, the errors of poses, and that of all other priors."""

POSITION_NOISE = 1
"""The kind of position errors."""

_AT_ONCE = 64  # columns whose gradients are in memory at a time
_NUMBERS_AT_ONCE = 1 << 25  # most numbers, of 8 bytes, in columns that are solved for together

_Item = TypeVar("_Item")
Rows = dict[str, Tensor]
"""Whitened residuals, or their derivatives by one parameter, by kind: ``observations`` (2, K), and the
priors' of :func:`v2hdm.adjust.model.prior_residuals`; untouched kinds may be absent."""

Follow = Callable[[Whitened], Whitened]
"""Whitened steps of the unknowns under unit errors, from the errors' columns by the whitened unknowns."""


def to_optimum(columns: Whitened) -> Whitened:
    """The steps to the optimum of a solution that is a whole of its own."""
    return Whitened(-columns.reduced, -columns.corners)


@dataclass(frozen=True)
class Sensitivity:
    """A solution as weighted least squares, differentiable by further parameters."""

    whitening: Whitening  # the solution's Hessian
    root: Tensor  # (K,) square roots of the weights
    residuals: Rows  # of everything
    whitened_px: Tensor  # (2, K) unweighted residuals of the observations
    stretch: Tensor  # (J,) segment of the route of each frame, from 0
    stretch_count: int

    @classmethod
    def at(cls, whitening: Whitening) -> Sensitivity:
        """The sensitivity at a solution, from its Hessian."""
        engine = whitening.engine
        estimate = whitening.estimate
        whitened_px = engine.residuals(engine.poses(estimate), estimate.corners_map)
        _, weight = robustified(whitening.robust, whitened_px.square().sum(0))
        root = weight.sqrt()  # without the floor, which keeps corners definite but is no evidence
        rows = _rows(engine.arrays, estimate, whitened_px * root)
        stretch = stretches(engine.arrays)
        return cls(whitening, root, rows, whitened_px, stretch, int(stretch.max()) + 1)

    @property
    def arrays(self) -> Arrays:
        """The problem."""
        return self.whitening.engine.arrays

    @cached_property
    def noise(self) -> FloatArray:
        """Residuals (R, D) drawn from the model's noise."""
        generator = torch.Generator().manual_seed(0)

        def like(row: Tensor) -> Tensor:
            return torch.randn(row.shape, generator=generator, dtype=row.dtype).to(row.device)

        residuals = self.residuals.items()
        drawn = [{name: like(row) for name, row in residuals} for _ in range(_DRAWS)]
        return np.concatenate([self.efficient_columns(part) for part in self.in_parts(drawn)]).T

    @property
    def camera(self) -> Tensor:
        """Camera (K,) of each observation."""
        return self.arrays.camera_of(self.arrays.pair).long()

    def whiten(self, off: Tensor) -> Tensor:
        """Weighted residuals (2, K) of offsets (2, K) at depth 1."""
        a, b, c = self.arrays.root_information
        return torch.stack([a * off[0], b * off[0] + c * off[1]]) * self.root

    @property
    def projected(self) -> Tensor:
        """Projected corners (2, K), at depth 1."""
        a, b, c = self.arrays.root_information
        first = self.whitened_px[0] / a
        return self.arrays.measured + torch.stack([first, (self.whitened_px[1] - b * first) / c])

    @cached_property
    def map_from_vehicle(self) -> Tensor:
        """Adjusted poses (J, 4, 4)."""
        tangent = frame_tangent(self.arrays, self.whitening.estimate.frame_state)
        poses: Tensor = self.arrays.vehicle_from_map.inverse() @ rigid(tangent)
        return poses.detach()

    @cached_property
    def way_m(self) -> Tensor:
        """Way (J,), m, along the recorded positions up to each frame, minus its mean."""
        position = self.arrays.vehicle_from_map.inverse()[:, :3, 3]
        step_m = position.diff(dim=0).norm(dim=1)
        way_m = torch.nn.functional.pad(step_m.cumsum(dim=0), (1, 0))
        return way_m - way_m.mean()

    @cached_property
    def poses(self) -> Tensor:
        """``cam_from_map`` (K, 4, 4) of each observation."""
        pairs = self.whitening.engine.poses(self.whitening.estimate).flatten(0, 1)
        return pairs[self.arrays.pair.long()]

    @cached_property
    def points(self) -> Tensor:
        """Observed corners (K, 3) in camera coordinates."""
        return points_in_camera(self.poses, self.whitening.estimate.corners_map[self.arrays.corner.long()])

    def seen(self, moved_cam: Tensor) -> Tensor:
        """Derivatives (2, K) of the weighted residuals for motions (K, 3) of the points in the cameras."""
        depth = self.points[:, 2:].clamp(min=NEAR_M)
        off = (moved_cam[:, :2] - self.points[:, :2] / depth * moved_cam[:, 2:]) / depth
        return self.whiten(off.T)

    def turned(self, tangents: Tensor) -> Tensor:
        """Motions (K, 3) of the points in the cameras for left tangents (C, M, 6) of the pairs."""
        tangent = tangents.flatten(0, 1)[self.arrays.pair.long()]
        motion: Tensor = tangent[:, :3] + torch.linalg.cross(tangent[:, 3:], self.points)
        return motion

    @cached_property
    def jacobians(self) -> Jacobians:
        """The observations' derivatives by the unknowns."""
        return Jacobians.of(self.whitening, self.root, self.poses, self.points)

    def efficient(self, column: Rows) -> Rows:
        """A fault's column net of the estimated unknowns: z = J_p - J_y H^-1 J_y' J_p."""
        (flat,) = self.efficient_columns([column])
        return self.rows_of(flat)

    def rows_of(self, flat: FloatArray) -> Rows:
        """Residuals, or derivatives, (R,) as :meth:`flat` puts them, by kind."""
        return {
            name: torch.as_tensor(flat[place]).to(row).view_as(row)
            for (name, row), place in zip(self.residuals.items(), self.places.values(), strict=True)
        }

    def in_parts(self, columns: Iterable[_Item]) -> Iterator[list[_Item]]:
        """Columns, or what has one, in lists of as many as are in memory at a time."""
        most = max(min(_AT_ONCE, _NUMBERS_AT_ONCE // sum(row.numel() for row in self.residuals.values())), 1)
        iterator = iter(columns)
        while part := list(islice(iterator, most)):
            yield part

    def efficient_columns(self, columns: Sequence[Rows], follow: Follow = to_optimum) -> FloatArray:
        """Columns (n, R) as :meth:`flat` puts them, each net of the estimated unknowns.

        These ``follow`` the columns; by default, to the optimum of this solution.
        """
        flat = self._flat_columns(columns)
        steps = self.jacobians.steps(follow(self._whiten(flat)))
        observed = self.places["observations"]
        flat[:, observed] += self.jacobians.along(steps).T
        flat[:, observed.stop :] += self.jacobians.priors_along(steps).T
        return flat

    def whiten_columns(self, columns: Sequence[Rows]) -> Whitened:
        """Columns by the whitened unknowns."""
        return self._whiten(self._flat_columns(columns))

    def _whiten(self, flat: FloatArray) -> Whitened:
        """Columns (n, R) by the whitened unknowns."""
        observed = self.places["observations"]  # the first ones
        of_observations, of_priors = (
            np.ascontiguousarray(flat[:, place].T) for place in (observed, slice(observed.stop, None))
        )
        return self.jacobians.whiten(of_observations, of_priors)

    def _flat_columns(self, columns: Sequence[Rows]) -> FloatArray:
        """Columns (n, R) as :meth:`flat` puts them."""
        flat = np.zeros((len(columns), sum(row.numel() for row in self.residuals.values())))
        for number, column in enumerate(columns):
            for name, row in column.items():
                flat[number, self.places[name]] = row.detach().flatten().cpu().numpy()
        return flat

    @cached_property
    def places(self) -> dict[str, slice]:
        """Where each kind of residuals is in :meth:`flat`."""
        ends = np.cumsum([row.numel() for row in self.residuals.values()]).tolist()
        return {
            name: slice(end - row.numel(), end)
            for (name, row), end in zip(self.residuals.items(), ends, strict=True)
        }

    def moves(self, columns: FloatArray, follow: Follow = to_optimum) -> Moves:
        """Motion of the solution under unit errors with columns (2 K, B) of the observations' residuals.

        The unknowns ``follow`` them as in :meth:`efficient_columns`.
        """
        arrays = self.arrays
        whitened = self.jacobians.whiten(columns)
        steps = self.jacobians.steps(follow(whitened))
        of_corners = np.empty(tuple(steps.corners_map.shape))
        of_corners[arrays.corner_order.cpu().numpy()] = steps.corners_map.cpu().numpy()
        of_poses = np.zeros((arrays.frame_count, 6, columns.shape[1]))
        of_poses[:, list(arrays.states)] = steps.frame_state.cpu().numpy()
        return Moves(of_corners, steps.extrinsic.cpu().numpy(), of_poses)

    def flat(self, rows: Rows) -> FloatArray:
        """All residuals, or derivatives, concatenated, (R,)."""
        return np.concatenate([rows[name].detach().flatten().cpu().numpy() for name in self.residuals])

    @cached_property
    def _stretch_of(self) -> tuple[IntArray, IntArray]:
        """Indices of all residuals by segment, and the first position of each segment among them."""
        count = self.stretch_count
        by_kind = {name: torch.full_like(row, count) for name, row in self.residuals.items()}
        by_kind["observations"][:] = self.stretch[self.arrays.frame_of(self.arrays.pair).long()]
        by_kind["frame_states"][:] = self.stretch[:, None]
        stretch = self.flat(by_kind)
        order = np.argsort(stretch, kind="stable")
        return order, np.searchsorted(stretch[order], np.arange(count + 2))

    @cached_property
    def _noise_of(self) -> IntArray:
        """Kind of noise (R,) of each residual: of observations, of an error of the poses, of other priors."""
        kind_of_axis = [1 + number for number, axes in enumerate(_ERRORS_OF_POSES) for _ in axes]
        of_states = [kind_of_axis[axis] for axis in self.arrays.states]
        by_kind = {name: torch.full_like(row, NOISES - 1) for name, row in self.residuals.items()}
        by_kind["observations"][:] = 0
        by_kind["frame_states"][:] = self.arrays.centre.new_tensor(of_states)
        return self.flat(by_kind).astype(np.int64)

    def by_stretch(self, columns: FloatArray, others: FloatArray) -> FloatArray:
        """Products (n, G + 1, ...) of columns (n, R) and others (R, ...) by segment; last, priors of none."""
        order, begin = self._stretch_of
        columns = columns[:, order]
        others = others[order]
        parts = [slice(first, end) for first, end in pairwise(begin.tolist())]
        return np.stack([columns[:, part] @ others[part] for part in parts], axis=1)

    def information(self, columns: FloatArray) -> FloatArray:
        """Squared lengths (n, G + 1, N) of columns (n, R) by segment, last of none, and kind of noise."""
        order, begin = self._stretch_of
        stretch = np.empty(len(order), dtype=np.int64)
        stretch[order] = np.repeat(np.arange(len(begin) - 1), np.diff(begin))
        place = stretch * NOISES + self._noise_of
        sums = [np.bincount(place, np.square(column), NOISES * (len(begin) - 1)) for column in columns]
        return np.array(sums, dtype=np.float64).reshape(-1, len(begin) - 1, NOISES)


def _rows(arrays: Arrays, estimate: Estimate, observations: Tensor | None = None) -> Rows:
    """All residuals at an estimate, those of the ``observations`` given."""
    rows = {} if observations is None else {"observations": observations}
    return rows | prior_residuals(arrays, estimate)


def stretches(arrays: Arrays) -> Tensor:
    """Segment (J,) of the route of each frame; the segments of a session have equal lengths."""
    position_map = arrays.vehicle_from_map.inverse()[:, :2, 3].cpu().numpy()
    stretch = stretches_of_way(position_map, arrays.session.cpu().numpy())
    return torch.as_tensor(stretch, device=arrays.session.device)


def stretches_of_way(position_map: FloatArray, session: IntArray) -> IntArray:
    """Segment (J,) of the route of each frame at a position (J, 2), of sessions (J,)."""
    steps_m = np.linalg.norm(np.diff(position_map, axis=0, prepend=position_map[:1]), axis=1)
    path_m = np.cumsum(steps_m)
    out = np.zeros(len(session), dtype=np.int64)
    for number in range(int(session.max()) + 1):
        is_in_session = session == number
        if not is_in_session.any():
            continue
        along_m = path_m[is_in_session] - path_m[is_in_session].min()
        share = along_m / max(float(along_m.max()), 1e-9)
        part = np.minimum((share * STRETCHES).astype(np.int64), STRETCHES - 1)
        out[is_in_session] = number * STRETCHES + part
    return np.asarray(np.unique(out, return_inverse=True)[1], dtype=np.int64)


def raised(solved: Sensitivity, height: Tensor) -> Rows:
    """Column of corners that each observation (K,) sees raised by ``height``, m, per unit of the value."""
    return {"observations": solved.seen(height[:, None] * solved.poses[:, :3, 2])}


def height_information(solution: Solution, heights: Any) -> tuple[FloatArray, FloatArray]:
    """Information (B, B) on the ground's height parameters, and the cost's gradient (B,) by them.

    ``heights`` (K, B), sparse, is the Jacobian, m, of the height that each observation of the problem shows.
    """
    solved = Sensitivity.at(solution.covariance.whitening)
    unit = raised(solved, torch.ones_like(solved.root))["observations"]
    columns = heights[solved.arrays.order.cpu().numpy()]
    squared = unit.square().sum(0).cpu().numpy()
    information = (columns.T @ (columns.multiply(squared[:, None]))).toarray()
    observed = np.flatnonzero(information.diagonal() > 0)
    by_column = columns[:, observed].tocsc()
    coupled = solved.root.new_zeros(len(observed), solved.whitening.size)
    along_u, along_v = unit.cpu().numpy()[:, :, None]
    for begin in range(0, len(observed), _AT_ONCE):
        heights_m = by_column[:, begin : begin + _AT_ONCE]
        # Sparse: a height is seen in a few images.
        by_height = vstack([heights_m.multiply(along_u), heights_m.multiply(along_v)], format="csr")
        whitened = solved.jacobians.whiten(by_height)
        coupled[begin : begin + _AT_ONCE] = torch.cat([whitened.reduced, whitened.corners.flatten(0, 1)]).mT
    information[np.ix_(observed, observed)] -= (coupled @ coupled.mT).cpu().numpy()
    gradient = columns.T @ (unit * solved.residuals["observations"]).sum(0).cpu().numpy()
    gradient[observed] -= (coupled @ solved.whitening.gradient).cpu().numpy()
    return information, gradient


def moves_with_heights(solution: Solution, heights: FloatArray) -> Moves:
    """Motion of a solution under B errors of the observed ground's heights (K, B), m."""
    solved = Sensitivity.at(solution.covariance.whitening)
    unit = raised(solved, torch.ones_like(solved.root))["observations"].cpu().numpy()
    by_height = unit[:, :, None] * heights[solved.arrays.order.cpu().numpy()]
    return solved.moves(by_height.reshape(-1, heights.shape[1]))
