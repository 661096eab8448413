"""What is done to every observation, by kernels: tensors in, tensors out."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.corner_factor import INSEPARABLE, CornerFactor, Joint
from v2hdm.adjust.engines.numba import evaluate, frames, linearise, look, motion
from v2hdm.adjust.engines.numba.build import kernel
from v2hdm.adjust.engines.numba.layout import LOSS_CODES, Layout, make_layout
from v2hdm.adjust.engines.numba.pool import share
from v2hdm.adjust.reduced import Coupled, ReducedSystem, Spread
from v2hdm.adjust.residuals import Estimate, Gradient, Loss, Sums, cam_from_map
from v2hdm.adjust.whitening import Elimination, Evaluated, Whitening
from v2hdm.errors import AdjustError
from v2hdm.records import BoolArray, FloatArray, IntArray


class Passes:
    """The kernels over one problem's arrays."""

    def __init__(self, arrays: Arrays) -> None:
        self._arrays = arrays
        self._shape = (arrays.camera_count, arrays.frame_count, 6)

    @cached_property
    def _layout(self) -> Layout:
        return make_layout(self._arrays)

    def _share(self, work: Callable[[int, int], None]) -> None:
        share(work, len(self._layout.chunk) - 1, len(self._layout.pair))

    def back_project(self, estimate: Estimate) -> tuple[Tensor, Tensor]:
        """The corners' start (N, 2) under an estimate that has none yet, and which a ray fixes (N,)."""
        count = self._arrays.corner_count
        corners, fixed = np.empty((count, 2)), np.empty(count, dtype=np.bool_)
        table = _table(cam_from_map(self._arrays, estimate))
        self._share(lambda b, e: look.back_project(b, e, self._layout, table, corners, fixed))
        return torch.from_numpy(corners), torch.from_numpy(fixed)

    def move(self, extrinsic: Tensor, cam_from_vehicle: Tensor) -> tuple[Tensor, Tensor]:
        """Extrinsics (C, 4, 4) moved by left tangents (C, 6), and the left Jacobians (C, 6, 6) of these."""
        moved, jacobian = motion.move(_rows(extrinsic), _rows(cam_from_vehicle))
        return torch.from_numpy(moved), torch.from_numpy(jacobian)

    def squared_residuals(self, estimate: Estimate) -> Tensor:
        """Squared Mahalanobis distances (K,)."""
        table, corners = _table(cam_from_map(self._arrays, estimate)), _rows(estimate.corners_map)
        out = np.empty(len(self._layout.pair))
        self._share(lambda b, e: look.squared_residuals(b, e, self._layout, table, corners, out))
        return torch.from_numpy(out)

    def report(self, estimate: Estimate, focal: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Residuals (K, 2) px, squared distances (K,) and who lies behind (K,), in the problem's order."""
        table, corners = _table(cam_from_map(self._arrays, estimate)), _rows(estimate.corners_map)
        count = len(self._layout.pair)
        out = look.Report(np.empty((count, 2)), np.empty(count), np.empty(count, dtype=np.bool_))
        order, focal = self._arrays.order.numpy(), np.ascontiguousarray(focal)
        self._share(lambda b, e: look.report(b, e, self._layout, table, corners, order, focal, out))
        return out

    def eliminate(
        self, system: ReducedSystem, estimate: Estimate, robust: Loss, damping: float
    ) -> Elimination:
        """Linearise, and take the eliminated corners off the reduced system.

        Raises:
            AdjustError: corners that lengths join cannot be solved for together.
        """
        arrays, layout, spread = self._arrays, self._layout, system.spread
        table, corners = _table(cam_from_map(arrays, estimate)), _rows(estimate.corners_map)
        clock = _by_pair(spread.clock)
        code, scale = LOSS_CODES[robust.name], float(robust.scale)
        touched, chunks = len(layout.touched), len(layout.chunk) - 1
        width = arrays.camera_count * arrays.camera_unknowns
        owners = touched if system.by_pair else chunks * arrays.camera_count
        joined, states = np.diff(layout.unit), bool(arrays.states)
        out = linearise.Linearisation(
            costs=np.zeros((chunks, 3)),
            wrench=np.zeros((touched, 6)),
            coupled=np.zeros((touched if states else 0, 6)),
            carried=np.zeros((chunks, width)),
            rows=np.empty((0 if states else 2 * arrays.corner_count, width)),
            whitened=np.empty((arrays.corner_count, 2)),
            lower=np.empty((3, arrays.corner_count)),
            joint=np.empty(int(4 * np.square(joined[joined > 1]).sum())),
            own=np.zeros((owners, 21)),
            tip=np.zeros((chunks, width, width)),
            failed=np.zeros(chunks),
        )
        growth, by_pair = 1.0 + damping, system.by_pair

        def room() -> linearise.Scratch:
            return linearise.Scratch.of(layout, len(table), width)

        self._share(
            lambda b, e: linearise.linearise(
                b, e, layout, table, clock, corners, code, scale, growth, by_pair, states, room(), out
            )
        )
        if out.failed.any():
            raise AdjustError(INSEPARABLE)
        own = self._gather(out.own) if by_pair else out.own.reshape(chunks, -1, 21).sum(0)
        system.add_all(torch.from_numpy(own.T), torch.from_numpy(out.tip.sum(0)))
        base = evaluate.Base(table, corners, out.lower, out.joint, out.rows)
        if arrays.states:
            self._subtract_frames(base, code, scale, system)
        return Elimination(
            sums=self._sums(out.costs, out.wrench),
            coupled=self._coupled(out.coupled, out.carried, spread),
            whitened=torch.from_numpy(out.whitened),
            corner_factor=_corner_factor(arrays, base),
            base=base,
        )

    def _subtract_frames(self, base: evaluate.Base, code: int, scale: float, system: ReducedSystem) -> None:
        plan, matrix, spread = system.plan, system.matrix, system.spread
        pattern = plan.pattern
        below_at = np.zeros(plan.tile_count + 1, dtype=np.int64)
        np.cumsum([len(rows) for rows in pattern.below], out=below_at[1:])
        tiles = frames.TileMap(
            per_tile=plan.frames_per_tile,
            size=plan.frames_per_tile * len(self._arrays.states),
            position=np.array(pattern.position, dtype=np.int64),
            diagonal_at=np.array(matrix.diagonal_at, dtype=np.int64),
            panel_at=np.array(matrix.panel_at, dtype=np.int64),
            below=np.array([row for rows in pattern.below for row in rows], dtype=np.int64),
            below_at=below_at,
        )
        by_state, clock = _by_pair(spread.state), _by_pair(spread.clock)
        each, values = self._arrays.camera_unknowns, matrix.values.numpy()
        cuts = np.linspace(0, plan.tile_count, min(_COLUMN_RANGES, plan.tile_count) + 1).astype(int)

        width = plan.most_tiles * tiles.size + self._arrays.camera_count * each
        layout = self._layout

        def work(begin: int, end: int) -> None:
            room = frames.Scratch.of(layout, plan.tile_count, plan.most_tiles, width)
            frames.subtract_frames(
                cuts[begin], cuts[end], layout, base, tiles, by_state, clock, each, code, scale, room, values
            )

        share(work, len(cuts) - 1, len(layout.pair))

    def evaluate(
        self, whitening: Whitening, estimate: Estimate, step: Gradient, tangents: Tensor, own: Tensor
    ) -> Evaluated:
        """Evaluate a step from a whitening of these kernels: see :func:`v2hdm.adjust.descent.evaluate`."""
        base, layout, states = whitening.base, self._layout, bool(self._arrays.states)
        assert base is not None
        chunks, touched = len(layout.chunk) - 1, len(layout.touched)
        table, whitened = _table(cam_from_map(self._arrays, estimate)), _rows(own)
        moved = _rows(tangents.reshape(-1, 6)) if states else np.empty((0, 6))
        cameras = _rows(torch.cat([step.extrinsic, step.clock_s], dim=1)).ravel()
        code, scale = LOSS_CODES[whitening.robust.name], float(whitening.robust.scale)
        out = evaluate.Evaluation(
            costs=np.zeros((chunks, 3)),
            wrench=np.zeros((touched, 6)),
            coupled=np.zeros((touched if states else 0, 6)),
            carried=np.zeros((chunks, len(cameras))),
            corners=np.empty_like(base.corners),
            whitened=np.empty_like(base.corners),
        )

        def work(begin: int, end: int) -> None:
            room = evaluate.Scratch.of(layout, len(table))
            evaluate.evaluate(
                begin, end, layout, base, table, moved, cameras, whitened, code, scale, room, out
            )

        self._share(work)
        return Evaluated(
            self._sums(out.costs, out.wrench),
            self._coupled(out.coupled, out.carried, whitening.spread),
            torch.from_numpy(out.whitened),
            torch.from_numpy(out.corners),
        )

    def coupled_tiles(self, per_tile: int, tile_count: int) -> tuple[list[list[int]], int]:
        """The pairs of tiles that corners couple, and how many tiles a unit touches at most."""
        counts = np.zeros(2, dtype=np.int64)
        room = frames.Scratch.of(self._layout, tile_count, 0, 0)
        frames.count_edges(self._layout, per_tile, room, counts)
        edges = np.empty(counts[0], dtype=np.int64)
        room.mark.fill(-1)
        frames.list_edges(self._layout, per_tile, room, edges)
        low, high = np.divmod(np.unique(edges), tile_count)
        return np.stack([low, high], axis=1).tolist(), int(counts[1])

    def _sums(self, costs: FloatArray, wrench: FloatArray) -> Sums:
        observed, control, lengths = torch.from_numpy(costs.sum(0))
        nothing = torch.empty(0, 2, dtype=torch.float64)
        return Sums(observed, control, lengths, self._pairs(wrench), nothing)

    def _coupled(self, by_pair: FloatArray, carried: FloatArray, spread: Spread) -> Coupled:
        if self._arrays.states:
            return spread.gather(self._pairs(by_pair))
        cameras = torch.from_numpy(carried.sum(0)).view(self._arrays.camera_count, -1)
        return Coupled(cameras.new_zeros(self._arrays.frame_count, 0), cameras)

    def _pairs(self, parts: FloatArray) -> Tensor:
        return torch.from_numpy(self._gather(parts)).view(self._shape)

    def _gather(self, parts: FloatArray) -> FloatArray:
        """Sums (P, n) of what the chunks say (R, n) of the pairs that they touch."""
        out = np.zeros((self._arrays.pair_count, parts.shape[1]))
        _gather(self._layout.touched, parts, out)
        return out


# Ranges of columns that threads take in turn.
_COLUMN_RANGES = 8


@kernel
def _gather(touched: IntArray, parts: FloatArray, out: FloatArray) -> None:
    for i in range(len(touched)):
        for p in range(parts.shape[1]):
            out[touched[i], p] += parts[i, p]


def _corner_factor(arrays: Arrays, base: evaluate.Base) -> CornerFactor:
    """The kernels' factors of V for torch, on the same memory."""
    if not len(base.joint):
        return CornerFactor(torch.from_numpy(base.lower), ())
    joint, begin = [], 0
    values, units = torch.from_numpy(base.joint), arrays.unit_bounds[0]
    joined = torch.diff(units)
    for size in torch.unique(joined[joined > 1]).tolist():
        first = units[:-1][joined == size]
        end = begin + 4 * size * size * len(first)
        joint.append(Joint(first, size, values[begin:end].view(len(first), 2 * size, 2 * size)))
        begin = end
    return CornerFactor(torch.from_numpy(base.lower), tuple(joint))


def _rows(values: Tensor) -> FloatArray:
    return np.asarray(values.contiguous().numpy())


def _table(transforms: Tensor) -> FloatArray:
    """Transforms (C, J, 4, 4) as the kernels' table (P, 16)."""
    return np.asarray(transforms.reshape(-1, 16).numpy())


def _by_pair(spread: Tensor) -> FloatArray:
    """Derivatives (C, J, 6, n) as rows (P, 6 n)."""
    cameras, frames, tangent, unknowns = spread.shape
    return _rows(spread.reshape(cameras * frames, tangent * unknowns))
