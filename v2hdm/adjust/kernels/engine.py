"""The engine ``native``: torch's, its passes over the observations replaced by compiled kernels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_array, triu
from torch import Tensor

from v2hdm.adjust.arrays import Arrays, Run
from v2hdm.adjust.engine import Evaluated, Factorised, Linearised, Reached, Report, TorchEngine
from v2hdm.adjust.kernels import evaluate, linearise, rig
from v2hdm.adjust.kernels.evaluate import Evaluation
from v2hdm.adjust.kernels.layout import LOSS_CODES, Base, Layout, Scratch, make_layout
from v2hdm.adjust.kernels.rig import make_rig
from v2hdm.adjust.kernels.tables import cam_from_map, move, spread_of, with_priors
from v2hdm.adjust.model import Estimate, Gradient, Loss
from v2hdm.adjust.reduced import (
    INSEPARABLE,
    CornerFactor,
    Coupled,
    Joint,
    Plan,
    ReducedSystem,
    Spread,
    frames_per_tile,
)
from v2hdm.adjust.threads import share
from v2hdm.adjust.tiles import find_pattern
from v2hdm.compiled import kernel, twin
from v2hdm.errors import AdjustError
from v2hdm.records import FloatArray, IntArray

_COLUMN_RANGES = 8  # ranges of columns shared among threads
# Multiplications of a factorisation above which other elimination orders are tried.
_WORTH_ANOTHER_ORDER = 1e9
_CLEARLY_LESS = 0.5  # fraction of the multiplications below which another order pays
_PAIR_BLOCK = torch.triu_indices(6, 6)  # rows and columns of the upper triangle of a pair's block


class KernelEngine(TorchEngine):
    """The model over one problem's arrays: linearised, evaluated, carried and pulled back by kernels."""

    def __init__(self, arrays: Arrays, border: tuple[Tensor, Tensor] | None = None) -> None:
        """``border`` are frames and corners to eliminate last, if any."""
        super().__init__(arrays)
        self._border = border

    def over(self, arrays: Arrays) -> KernelEngine:
        """The same engine over another problem; what it knows of the same observations is not found anew."""
        engine = KernelEngine(arrays)
        before = self.arrays
        if arrays.pair is before.pair and arrays.corner is before.corner and self._border is None:
            if arrays.root_information is before.root_information and "_whole" in vars(self):
                vars(engine)["_whole"] = self._whole
            if arrays.states == before.states and "_plan" in vars(self):
                vars(engine)["_plan"] = self._plan
        return engine

    def keeping(self, frames: Tensor, corners: Tensor) -> KernelEngine:
        """The same engine, which eliminates a border of ``frames`` and ``corners`` last."""
        return KernelEngine(self.arrays, (frames, corners))

    @cached_property
    def _whole(self) -> Layout:
        return make_layout(self.arrays)

    @cached_property
    def layout(self) -> Layout:
        """The problem as kernels read it, with the corners that the plan keeps marked."""
        return self._with_kept(self._plan.kept_corners)

    def share(self, work: Callable[[int, int], None]) -> None:
        """Call ``work(begin, end)`` for ranges that partition the chunks."""
        share(work, len(self._whole.chunk) - 1, len(self._whole.pair))

    def plan(self) -> Plan:
        """The division of the reduced system into tiles."""
        return self._plan

    @cached_property
    def _plan(self) -> Plan:
        """The cheapest: all corners eliminated first, in either order, or those of several drives kept."""
        arrays = self.arrays
        per_tile = frames_per_tile(arrays)
        none = arrays.corner_order[:0]
        states = len(arrays.states)
        if not states:
            return Plan(per_tile, 0, 0, find_pattern(0, []), none)
        count = -(-arrays.frame_count // per_tile)
        size = per_tile * states
        tip = arrays.camera_count * arrays.camera_unknowns
        along = list(pairwise(range(count))) if bool(arrays.state_transition.any()) else []
        if self._border is not None:
            return self._plan_of_border(*self._border, along)
        edges, most = self._coupled_tiles(self._whole, per_tile, count)
        best = Plan(per_tile, size, count, find_pattern(count, [*edges, *along]), none, most)
        least = best.pattern.multiplications(size, tip)
        if least < _WORTH_ANOTHER_ORDER:
            return best
        for kept_corners in (none, self._shared_corners()):
            edges, most = self._coupled_tiles(self._with_kept(kept_corners), per_tile, count)
            corner_tiles = _kept_tiles(arrays, kept_corners, size // 2, count, per_tile)
            total = count + -(-len(kept_corners) // (size // 2))
            pattern = find_pattern(total, [*edges, *along, *corner_tiles], least_degree=True)
            cost = pattern.multiplications(size, tip)
            if cost < _CLEARLY_LESS * least:
                best = Plan(per_tile, size, count, pattern, kept_corners, most)
                least = cost
        return best

    def _plan_of_border(self, frames: Tensor, corners: Tensor, along: Sequence[tuple[int, int]]) -> Plan:
        """The cheaper order of two in which a border's tiles come last; ``along`` couples frames' tiles."""
        arrays = self.arrays
        per_tile = frames_per_tile(arrays)
        size = per_tile * len(arrays.states)
        count = -(-arrays.frame_count // per_tile)
        kept_corners = corners[self._fits_a_tile(size // 2)[corners]]
        edges, most = self._coupled_tiles(self._with_kept(kept_corners), per_tile, count)
        corner_tiles = _kept_tiles(arrays, kept_corners, size // 2, count, per_tile)
        total = count + -(-len(kept_corners) // (size // 2))
        last = [*torch.unique(frames // per_tile).tolist(), *range(count, total)]
        cliques = [*edges, *along, *corner_tiles, last]
        tip = arrays.camera_count * arrays.camera_unknowns
        patterns = [find_pattern(total, cliques, least_degree, last) for least_degree in (False, True)]
        pattern = min(patterns, key=lambda pattern: pattern.multiplications(size, tip))
        return Plan(per_tile, size, count, pattern, kept_corners, most, len(last))

    def _fits_a_tile(self, most: int) -> Tensor:
        """Whether each corner (N,) is joined to so few that a tile of ``most`` corners holds them.

        A larger unit would reach beyond the next tile.
        """
        size = np.diff(self._whole.unit)
        return torch.from_numpy(np.repeat(size <= most, size))

    def _with_kept(self, kept_corners: Tensor) -> Layout:
        if not len(kept_corners):
            return self._whole
        mask = np.zeros(self.arrays.corner_count, dtype=np.bool_)
        mask[kept_corners.numpy()] = True
        return self._whole._replace(is_kept=mask[self._whole.unit[:-1]])

    def _shared_corners(self) -> Tensor:
        """Corners (n,) that several drives observed, and all that known lengths join to them."""
        arrays = self.arrays
        layout = self._whole
        session = arrays.session[arrays.frame_of(arrays.pair).long()].numpy()
        begin = layout.begin[layout.unit[:-1]]
        shared = np.minimum.reduceat(session, begin) < np.maximum.reduceat(session, begin)
        fits = self._fits_a_tile(frames_per_tile(arrays) * len(arrays.states) // 2)
        is_shared = torch.from_numpy(np.repeat(shared, np.diff(layout.unit)))
        return (fits & is_shared).nonzero()[:, 0]

    def _coupled_tiles(self, layout: Layout, per_tile: int, tile_count: int) -> tuple[list[list[int]], int]:
        """Pairs of tiles coupled by eliminated corners, and the largest number of tiles of a unit."""
        tile = layout.frame[layout.pair % layout.moments] // per_tile
        units = len(layout.is_kept)
        first_observation = layout.begin[layout.unit]
        touched = csr_array(
            (np.ones(len(tile), dtype=np.int32), tile, first_observation), shape=(units, tile_count)
        )
        touched.sum_duplicates()
        touched = touched[~layout.is_kept]
        touched.data[:] = 1
        edges = np.stack(triu(touched.T @ touched, 1).nonzero(), axis=1)
        return edges.tolist(), int(np.diff(touched.indptr).max(initial=0))

    def poses(self, estimate: Estimate) -> Tensor:
        """``cam_from_map`` of every pair, (C, M, 4, 4)."""
        return cam_from_map(self.arrays, estimate)

    def meet_ground(self, ground_from_ray: Tensor) -> tuple[Tensor, Tensor]:
        """:meth:`back_project` by the inverse homographies (P, 3, 3) of all pairs."""
        corners = np.empty((self.arrays.corner_count, 2))
        determined = np.empty(len(corners), dtype=np.bool_)
        homographies = _rows(ground_from_ray.flatten(1))
        self.share(lambda b, e: evaluate.meet_ground(b, e, self._whole, homographies, corners, determined))
        return torch.from_numpy(corners), torch.from_numpy(determined)

    def residuals(self, cam_from_map: Tensor, corners_map: Tensor) -> Tensor:
        """Whitened residuals (2, K) of the observations."""
        table = _table(cam_from_map)
        corners = _rows(corners_map)
        out = np.empty((2, len(self._whole.pair)))
        self.share(lambda b, e: evaluate.residuals(b, e, self._whole, table, corners, out))
        return torch.from_numpy(out)

    def report(self, estimate: Estimate, focal_px: FloatArray) -> Report:
        """The observations at an estimate, under focal lengths (C, 2), px."""
        table = _table(self.poses(estimate))
        corners = _rows(estimate.corners_map)
        count = len(self._whole.pair)
        out = Report(np.empty((count, 2)), np.empty(count), np.empty(count, dtype=np.bool_))
        order = self.arrays.order.numpy()
        focal = np.ascontiguousarray(focal_px)
        self.share(lambda b, e: evaluate.report(b, e, self._whole, table, corners, order, focal, out))
        return out

    def pull(self, estimate: Estimate, spread: Spread, by_residual: Tensor) -> Gradient:
        """Gradient of a scalar from that by the whitened residuals (2, K)."""
        table = _table(self.poses(estimate))
        corners = _rows(estimate.corners_map)
        wrench = np.zeros((len(table), 6))
        by_corner = np.zeros_like(corners)
        evaluate.pull(self._whole, table, corners, _rows(by_residual), np.empty(16), wrench, by_corner)
        gathered = spread.gather(torch.from_numpy(wrench).view(self.arrays.camera_count, -1, 6))
        camera = gathered.camera
        return Gradient(camera[:, :6], gathered.frame_state, torch.from_numpy(by_corner), camera[:, 6:])

    def spread(self, estimate: Estimate) -> Spread:
        """Jacobians of the pairs by frame states and clock offsets."""
        return spread_of(self.arrays, estimate)

    def eliminate(self, system: ReducedSystem, estimate: Estimate, robust: Loss) -> KernelLinearised:
        """Linearise and eliminate the corners; raises AdjustError if a block of joined ones is singular."""
        arrays = self.arrays
        layout = self.layout
        spread = system.spread
        clock = _by_pair(spread.clock)
        width = system.tip
        pairs = arrays.pair_count
        chunks = len(layout.chunk) - 1
        base = self._base(estimate, robust, width)
        by_pair = system.by_pair
        out = self._linearisation(width, by_pair)

        def work(begin: int, end: int) -> None:
            room = Scratch.of(layout, pairs, width)
            linearise.linearise(begin, end, layout, base, clock, by_pair, room, out)

        self.share(work)
        if out.failed.any():
            raise AdjustError(INSEPARABLE)
        of_pairs = self.gather(out.squares) if by_pair else out.squares.reshape(chunks, -1, 21).sum(0)
        tip = torch.from_numpy(out.tip.sum(0))
        system.add(_symmetric(torch.from_numpy(of_pairs), arrays.camera_count), tip + tip.tril(-1).mT)
        if len(system.plan.kept_corners):
            self._keep(system, base)
        if arrays.states:
            self._subtract_frames(base, system)
        terms, gradient = with_priors(arrays, estimate, spread, out.costs.sum(0), self.pairs(out.wrench))
        return KernelLinearised(
            engine=self,
            estimate=estimate,
            robust=robust,
            spread=spread,
            terms=terms,
            gradient=gradient,
            corner_factor=_corner_factor(arrays, base),
            whitened=torch.from_numpy(out.whitened).view(-1, 2),
            coupled=self.coupled(out.coupled, out.carried, spread),
            couplings=gradient.extrinsic.new_empty(2, 6, 0),
            base=base,
        )

    @cached_property
    def _rig(self) -> Any:
        if self._border is not None:  # whose whitenings are kept in files, which C++ does not write
            return None
        return make_rig(self.arrays, self.layout)

    @cached_property
    def _still(self) -> Spread:
        """The spread of pairs that move with their camera alone."""
        no_states = self.arrays.centre.new_zeros(self.arrays.camera_count, self.arrays.moment_count, 6, 0)
        return Spread(self.arrays, no_states, no_states)

    def factorised(self, estimate: Estimate, robust: Loss, hold_cameras: bool) -> Factorised | None:
        """The whitening at an estimate at once, if cameras alone move and its Hessian is definite."""
        if self._rig is None:
            return None
        corners = _rows(estimate.corners_map)
        code = LOSS_CODES[robust.name]
        scale = float(robust.scale)
        whitening = self._rig.linearise(_rows(estimate.cam_from_vehicle), corners, code, scale)
        self.share(whitening.eliminate)
        if not whitening.is_separable():
            raise AdjustError(INSEPARABLE)
        if not whitening.factorise(hold_cameras):
            return None
        arrays = self.arrays
        lower = whitening.lower.reshape(3, -1)
        base = Base(
            whitening.table.reshape(-1, 16),
            corners,
            code,
            scale,
            lower,
            whitening.joint,
            whitening.rows.reshape(-1, 6 * arrays.camera_count),
        )
        factor = rig.factor_of(whitening)
        gradient = torch.from_numpy(whitening.gradient)
        by_camera = torch.from_numpy(whitening.by_camera).view(-1, 6)
        no_tangents = estimate.corners_map[:0]
        linearised = KernelLinearised(
            engine=self,
            estimate=estimate,
            robust=robust,
            spread=self._still,
            terms=rig.terms_of(whitening.costs),
            gradient=Gradient(by_camera, estimate.frame_state, no_tangents, estimate.clock_s),
            corner_factor=_corner_factor(arrays, base),
            whitened=gradient[factor.size :].view(-1, 2),
            coupled=Coupled(estimate.frame_state, torch.from_numpy(whitening.coupled).view(-1, 6)),
            couplings=by_camera.new_empty(2, 6, 0),
            base=base,
            rig=whitening,
        )
        return Factorised(linearised, factor, whitening.smallest_pivot, gradient)

    def _base(self, estimate: Estimate, robust: Loss, width: int) -> Base:
        """The estimate as kernels read it, with room for factors; all cameras have ``width`` unknowns."""
        arrays = self.arrays
        joined = np.diff(self.layout.unit)
        carried_rows = 0 if arrays.states else 2 * arrays.corner_count
        return Base(
            table=_table(self.poses(estimate)),
            corners=_rows(estimate.corners_map),
            code=LOSS_CODES[robust.name],
            scale=float(robust.scale),
            lower=np.empty((3, arrays.corner_count)),
            joint=np.empty(int(4 * np.square(joined[joined > 1]).sum())),
            rows=np.empty((carried_rows, width)),
        )

    def _linearisation(self, width: int, by_pair: bool) -> linearise.Linearisation:
        """Zeroed sums of the chunks; ``by_pair`` keeps squares of each touched pair, else of each camera."""
        arrays = self.arrays
        touched = len(self.layout.touched)
        chunks = len(self.layout.chunk) - 1
        return linearise.Linearisation(
            costs=np.zeros((chunks, 3)),
            wrench=np.zeros((touched, 6)),
            coupled=np.zeros((touched if arrays.states else 0, 6)),
            carried=np.zeros((chunks, width)),
            whitened=np.empty(2 * arrays.corner_count),
            squares=np.zeros((touched if by_pair else chunks * arrays.camera_count, 21)),
            tip=np.zeros((chunks, width, width)),
            failed=np.zeros(chunks),
        )

    def _keep(self, system: ReducedSystem, base: Base) -> None:
        """Add the kept corners' blocks, stored as factors, to the system; sets those factors to 1."""
        layout = self.layout
        kept_corners = system.plan.kept_corners
        number = np.full(self.arrays.corner_count, -1)
        number[kept_corners.numpy()] = np.arange(len(kept_corners))
        index = []
        blocks = []
        for u in np.flatnonzero(layout.is_kept):
            first = layout.unit[u]
            size = layout.unit[u + 1] - layout.unit[u]
            if size == 1:
                index.append((number[first], number[first]))
                xx, yx, yy = base.lower[:, first]
                blocks.append(np.array([[xx, 0.0], [yx, yy]]))
                base.lower[:, first] = 1.0, 0.0, 1.0
                continue
            begin = layout.joint_at[u]
            joint = base.joint[begin : begin + 4 * size * size].reshape(size, 2, size, 2)
            for low in range(size):
                for high in range(low, size):
                    index.append((number[first + high], number[first + low]))
                    blocks.append(joint[high, :, low].copy())
            joint.reshape(2 * size, -1)[:] = np.eye(2 * size)
        run = self.arrays.gather(kept_corners)
        coupling = self.coupling(run, base._replace(corners=base.corners[kept_corners.numpy()]))
        system.add_kept(run, coupling, torch.tensor(np.array(index).T), torch.from_numpy(np.array(blocks)))

    def coupling(self, run: Run, base: Base) -> Tensor:
        """W' (k, 2, 6) of a run's observations of the base's corners (n, 2)."""
        layout = self._whole._replace(
            pair=run.pair.to(torch.int32).numpy(),
            measured=_rows(run.measured),
            root=_rows(run.root_information),
        )
        out = np.empty((len(run.pair), 12))
        evaluate.couplings(layout, base, run.corner.numpy(), np.empty(16), out)
        return torch.from_numpy(out).view(-1, 2, 6)

    def _subtract_frames(self, base: Base, system: ReducedSystem) -> None:
        plan = system.plan
        matrix = system.matrix
        spread = system.spread
        layout = self.layout
        column, row = np.divmod(matrix.keys, plan.tile_count + 1)
        tiles = linearise.TileMap(
            per_tile=plan.frames_per_tile,
            size=plan.size,
            position=plan.position.numpy(),
            begin=np.searchsorted(column, np.arange(plan.tile_count)),
            row=row,
            at=matrix.at,
        )
        by_state = _by_pair(spread.state)
        clock = _by_pair(spread.clock)
        unknowns = self.arrays.camera_unknowns
        values = matrix.values.numpy()
        cuts = np.linspace(0, plan.tile_count, min(_COLUMN_RANGES, plan.tile_count) + 1).astype(int)

        def work(begin: int, end: int) -> None:
            marks = np.full((5, plan.tile_count + 1), -1)
            room = Scratch.of(layout, 0, plan.most_tiles * plan.size + system.tip)
            linearise.subtract_frames(
                cuts[begin], cuts[end], layout, base, tiles, by_state, clock, unknowns, marks, room, values
            )

        share(work, len(cuts) - 1, len(layout.pair))

    def coupled(self, by_pair: FloatArray, carried: FloatArray, spread: Spread) -> Coupled:
        """W V^-1 g, from the chunks' sums by pair (R, 6) or by the cameras' unknowns (Q, D)."""
        if self.arrays.states:
            return spread.gather(self.pairs(by_pair))
        cameras = torch.from_numpy(carried.sum(0)).view(self.arrays.camera_count, -1)
        return Coupled(cameras.new_zeros(self.arrays.frame_count, 0), cameras)

    def pairs(self, parts: FloatArray) -> Tensor:
        """Sums (C, J, n) of the chunks' (R, n)."""
        return torch.from_numpy(self.gather(parts)).view(self.arrays.camera_count, -1, 6)

    def gather(self, parts: FloatArray) -> FloatArray:
        """Sums (P, n) of the chunks' (R, n) by the pairs that they touch."""
        out = np.zeros((self.arrays.pair_count, parts.shape[1]))
        _gather(self._whole.touched, parts, out)
        return out


@dataclass(frozen=True)
class KernelLinearised(Linearised):
    """A problem linearised by kernels, its corners eliminated."""

    engine: KernelEngine
    base: Base
    rig: Any = None  # the same as C++ made it, if at once

    def reach(self, whitened: Tensor) -> Reached | None:
        """The estimate, cost and gradient at variables of the whitening, if the engine made it at once."""
        if self.rig is None:
            return None
        evaluation = self.rig.evaluate(_rows(whitened))
        self.engine.share(evaluation.look)
        done = rig.Evaluated(*evaluation.finish())
        estimate = Estimate(
            torch.from_numpy(done.cam_from_vehicle),
            self.estimate.frame_state,
            torch.from_numpy(done.corners_map),
            self.estimate.clock_s,
        )
        return Reached(estimate, rig.terms_of(done.costs), torch.from_numpy(done.gradient))

    def camera_step(self, whitened: Tensor) -> Tensor | None:
        """The step (C, 6) of the cameras by variables of the whitening, if the engine made it at once."""
        if self.rig is None:
            return None
        return torch.from_numpy(self.rig.camera_step(_rows(whitened))).view(-1, 6)

    def evaluate(self, step: Gradient, tangents: Tensor, whitened_corners: Tensor) -> Evaluated:
        """Evaluate after a step of the reduced unknowns, in one pass over the observations."""
        engine, base, before, arrays = self.engine, self.base, self.estimate, self.engine.arrays
        cameras, chart = move(_rows(step.extrinsic), _rows(before.cam_from_vehicle))
        state = before.frame_state + step.frame_state
        clock = before.clock_s + step.clock_s
        at = Estimate(torch.from_numpy(cameras), state, before.corners_map, clock)
        table = _table(engine.poses(at))
        whitened = _rows(whitened_corners.reshape(-1))
        moved = _rows(tangents.reshape(-1, 6)) if arrays.states else np.empty((0, 6))
        by_camera = _rows(torch.cat([step.extrinsic, step.clock_s], dim=1).ravel())
        layout = engine.layout
        out = self._room()
        pairs = len(table)

        def work(begin: int, end: int) -> None:
            room = Scratch.of(layout, pairs)
            evaluate.evaluate(begin, end, layout, base, table, moved, by_camera, whitened, room, out)

        engine.share(work)
        costs = out.costs.sum(0)
        wrench = engine.pairs(out.wrench)
        terms, gradient = with_priors(arrays, at, engine.spread(at), costs, wrench)
        by_tangent = (torch.from_numpy(chart).mT @ gradient.extrinsic[..., None])[..., 0]
        at = replace(at, corners_map=torch.from_numpy(out.corners))
        return Evaluated(at, terms, replace(gradient, extrinsic=by_tangent), *self._carried(out))

    def by_cameras(self) -> Tensor | None:
        """L^-1 W' (N, 2, D) of all corners, if frames have no states."""
        rows = self.base.rows
        return torch.from_numpy(rows).view(-1, 2, rows.shape[1]) if len(rows) else None

    def carry(self, by_corner: Tensor) -> tuple[Tensor, Coupled]:
        """L^-1 g (N, 2) and W V^-1 g of a gradient g (N, 2) by the corners."""
        layout = self.engine.layout
        base = self.base
        rows = _rows(by_corner)
        out = self._room()

        def work(begin: int, end: int) -> None:
            evaluate.carry(begin, end, layout, base, rows, Scratch.of(layout, len(base.table)), out)

        self.engine.share(work)
        return self._carried(out)

    def coupling(self, run: Run, corners_map: Tensor) -> Tensor:
        """W' (k, 2, 6) of a run's observations."""
        return self.engine.coupling(run, self.base._replace(corners=_rows(corners_map)))

    def _carried(self, out: Evaluation) -> tuple[Tensor, Coupled]:
        coupled = self.engine.coupled(out.coupled, out.carried, self.spread)
        return torch.from_numpy(out.whitened).view(-1, 2), coupled

    def _room(self) -> Evaluation:
        chunks = len(self.engine.layout.chunk) - 1
        touched = len(self.engine.layout.touched)
        return Evaluation(
            costs=np.zeros((chunks, 3)),
            wrench=np.zeros((touched, 6)),
            coupled=np.zeros((touched if self.engine.arrays.states else 0, 6)),
            carried=np.zeros((chunks, self.base.rows.shape[1])),
            corners=np.empty_like(self.base.corners),
            whitened=np.empty(self.base.corners.size),
        )


def _kept_tiles(
    arrays: Arrays, kept_corners: Tensor, per_corner_tile: int, first: int, per_tile: int
) -> list[Sequence[int]]:
    """Pairs of tiles coupled by observations of kept corners, or by corners joined to them."""
    run = arrays.gather(kept_corners)
    tile = first + run.corner // per_corner_tile
    of_frame = arrays.frame_of(run.pair).long() // per_tile
    count = int(tile.max()) + 1 if len(tile) else 1
    # As one number each: unique columns would take a hundred times as long.
    coupled = torch.unique(of_frame * count + tile)
    pairs = torch.stack([coupled // count, coupled % count], dim=1).tolist()
    # Joined corners are adjacent: a unit may reach into the next tile.
    return [*pairs, *pairwise(torch.unique(tile).tolist())]


@twin("adjust.gather")
@kernel
def _gather(touched: IntArray, parts: FloatArray, out: FloatArray) -> None:
    for i in range(len(touched)):
        for p in range(parts.shape[1]):
            out[touched[i], p] += parts[i, p]


def _corner_factor(arrays: Arrays, base: Base) -> CornerFactor:
    """The kernels' factors of V for torch, sharing memory."""
    if not len(base.joint):
        return CornerFactor(torch.from_numpy(base.lower), ())
    joint = []
    begin = 0
    values = torch.from_numpy(base.joint)
    units = arrays.units
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
    """Jacobians (C, J, 6, n) as rows (P, 6 n)."""
    cameras, frames, tangent, unknowns = spread.shape
    return _rows(spread.reshape(cameras * frames, tangent * unknowns))


def _symmetric(entries: Tensor, cameras: int) -> Tensor:
    """Full blocks (C, J or 1, 6, 6) from their 21 entries (n, 21)."""
    row, column = _PAIR_BLOCK
    blocks = entries.new_empty(len(entries), 6, 6)
    blocks[:, row, column] = entries
    blocks[:, column, row] = entries
    return blocks.view(cameras, -1, 6, 6)
