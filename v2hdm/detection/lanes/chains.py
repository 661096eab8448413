"""Chains: crossings of lines linked from row to row, beginning near the camera, where lines are far apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.native import kernels
from v2hdm.records import FloatArray, IntArray

_MIN_CHAIN = 3  # least number of crossings of a chain
_CHAIN_ODDS = 0.0  # least log odds of a chain's crossings
_MAX_GAP_PX = 40.0  # most rows between crossings of a chain
_SLOPE_POINTS = 6  # last points of a chain that give its direction
_MAX_SLOPE = 4.5  # most columns per row from a chain's first crossing to its second
_GATE_PX = 12.0  # largest distance of a crossing from a chain's continuation, px, one row anchor farther
_YOUNG = 1.5  # factor on that distance for a chain of fewer points than give its direction
_WIDENING = 0.04  # growth of that distance per row
_ROW_STEP_PX = 8  # rows between neighbouring row anchors in full resolution

_RULES = {
    "min_chain": _MIN_CHAIN,
    "max_gap_px": _MAX_GAP_PX,
    "slope_points": _SLOPE_POINTS,
    "max_slope": _MAX_SLOPE,
    "gate_px": _GATE_PX,
    "young": _YOUNG,
    "widening": _WIDENING,
    "row_step_px": _ROW_STEP_PX,
}
"""The constants of this module, for the compiled kernel."""


@dataclass
class _Chain:
    """An unfinished line: rows and columns, px, and indices of its crossings, from near to far."""

    v_px: list[float]
    u_px: list[float]
    index: list[int]
    slope: float | None = None  # columns per row over the last points; None with a single one

    def add(self, v_px: float, u_px: float, index: int) -> None:
        self.v_px.append(v_px)
        self.u_px.append(u_px)
        self.index.append(index)
        first = max(-len(self.v_px), -_SLOPE_POINTS)
        self.slope = (u_px - self.u_px[first]) / (self.v_px[first] - v_px)

    def expected(self, v_px: float) -> tuple[float, float]:
        """Expected column, px, of the line's crossing of a farther row, and the gate about it, px."""
        ahead = self.v_px[-1] - v_px
        if self.slope is None:
            return self.u_px[-1], _MAX_SLOPE * ahead
        young = _YOUNG if len(self.v_px) < _SLOPE_POINTS else 1.0
        gate_px = _GATE_PX * young * (1 + _WIDENING * (ahead - _ROW_STEP_PX))
        return self.u_px[-1] + self.slope * ahead, gate_px


def find_chains(points_px: FloatArray, odds: FloatArray) -> list[IntArray]:
    """Link likely crossings (N, 2), from near to far, from row to row; ``odds`` (N,) are log odds."""
    likely = np.flatnonzero(odds > _CHAIN_ODDS)
    u_px, v_px = points_px[likely].T
    if not len(likely):
        return []
    compiled = kernels()
    if compiled is not None:
        return [likely[members] for members in compiled.find_chains(u_px, v_px, _RULES)]
    begins = np.flatnonzero(np.diff(v_px, prepend=np.nan)).tolist()  # nan differs from any row
    columns = u_px.tolist()
    indices = likely.tolist()
    row_px = v_px[begins].tolist()
    open_chains: list[_Chain] = []
    done: list[_Chain] = []
    for begin, end, row in zip(begins, [*begins[1:], len(likely)], row_px, strict=True):
        done += [chain for chain in open_chains if chain.v_px[-1] - row > _MAX_GAP_PX]
        open_chains = [chain for chain in open_chains if chain.v_px[-1] - row <= _MAX_GAP_PX]
        open_chains += _extend(open_chains, row, columns[begin:end], indices[begin:end])
    return [np.array(chain.index) for chain in done + open_chains if len(chain.index) >= _MIN_CHAIN]


def _extend(chains: list[_Chain], row_px: float, columns: list[float], indices: list[int]) -> list[_Chain]:
    """Give each crossing of a row to the chain that it fits best; the rest start new chains."""
    pairs = []
    for c, chain in enumerate(chains):
        expected, gate = chain.expected(row_px)
        pairs += [(off / gate, c, p) for p, u in enumerate(columns) if (off := abs(u - expected)) <= gate]
    linked: set[int] = set()
    extended: set[int] = set()
    for _, c, p in sorted(pairs):
        if c not in extended and p not in linked:
            chains[c].add(row_px, columns[p], indices[p])
            extended.add(c)
            linked.add(p)
    return [_Chain([row_px], [columns[p]], [indices[p]]) for p in range(len(columns)) if p not in linked]
