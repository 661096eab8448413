"""The residuals of a run, linearised: their derivatives, and products with them that store no matrix.

A Jacobian by pair and corner is 16 numbers an observation, more than all else that is known of it. What the
solver asks for is only ever its products with vectors, and these follow from the pair and the corner.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from v2hdm.adjust.arrays import Run
from v2hdm.adjust.residuals import View, of_each

PAIR_BLOCK = torch.triu_indices(6, 6)
"""Rows and columns of the 21 entries in which a symmetric 6 x 6 block is summed up."""


def jacobians(run: Run, view: View) -> tuple[Tensor, Tensor]:
    """Derivatives of the whitened residuals by pair (2, 6, k) and by corner (2, 2, k)."""
    a, b, c = run.root_information
    x, y, z = view.point
    direct, across = view.inverse_depth, view.slope
    ad, bd, cd = a * direct, b * direct, c * direct
    g, h = a * x * across, torch.addcmul(b * x, c, y) * across
    # Row by row [a, p x a]; the first row of a has no middle entry.
    by_pair = torch.stack(
        [
            *(ad, torch.zeros_like(ad), g, y * g, z * ad - x * g, -y * ad),
            *(bd, cd, h, y * h - z * cd, z * bd - x * h, x * cd - y * bd),
        ]
    ).view(2, 6, -1)
    by_corner = torch.stack([(by_pair[row, :3] * axis).sum(0) for row in (0, 1) for axis in view.axes])
    return by_pair, by_corner.view(2, 2, -1)


def pair_blocks(by_pair: Tensor) -> Tensor:
    """J'J by pair, the entries (21, k) of :data:`PAIR_BLOCK`."""
    top, low = by_pair
    out: Tensor = top.new_empty(21, top.shape[1])
    begin = 0
    for row in range(6):
        part = out[begin : begin + 6 - row]
        torch.mul(top[row], top[row:], out=part)
        part.addcmul_(low[row], low[row:])
        begin += 6 - row
    return out


def corner_blocks(by_corner: Tensor) -> Tensor:
    """J'J by corner, (3, k): xx, yx, yy."""
    top, low = by_corner
    return torch.cat([top[:1] * top + low[:1] * low, top[1:].square() + low[1:].square()])


def coupling(by_pair: Tensor, by_corner: Tensor) -> Tensor:
    """W' = J_corner' J_pair, (2, 6, k)."""
    (top, low), (top_corner, low_corner) = by_pair, by_corner
    return torch.addcmul(top_corner[:, None] * top, low_corner[:, None], low)


@dataclass(frozen=True)
class Linear:
    """What motions of pairs and corners do to each other through a run's observations: W and W'.

    ``information`` (3, k), xx, yx, yy, is that of each observation at depth 1, times its weight.
    """

    run: Run
    view: View
    information: Tensor

    @classmethod
    def at(cls, run: Run, view: View, weight: Tensor) -> Linear:
        """Linearise where the run is seen as ``view``; ``weight`` (k,) is that of the observations."""
        a, b, c = run.root_information
        return cls(run, view, torch.stack([torch.addcmul(a * a, b, b), b * c, c * c]) * weight)

    def corners_from_pairs(self, moved: Tensor) -> Tensor:
        """W' v, (n, 2), of motions v of the pairs, given by how their columns move (9, P)."""
        first, second, origin = of_each(moved, self.run.pair).chunk(3)
        x, y = self.view.ground
        along = torch.addcmul(torch.addcmul(origin, first, x), second, y)
        return self.run.sum_by_corner(self.view.along_axes(self._force(along)))

    def pairs_from_corners(self, step: Tensor) -> Tensor:
        """W x by observation, as gradients (9, k) by the pairs' columns, of steps x (n, 2) of the corners."""
        x, y = of_each(step.T, self.run.corner)
        moved = torch.addcmul(self.view.axes[0] * x, self.view.axes[1], y)
        return self.view.by_table(self._force(moved))

    def _force(self, moved: Tensor) -> Tensor:
        """The forces (3, k) with which the observations oppose motions of their points (3, k)."""
        view, (xx, yx, yy) = self.view, self.information
        along = view.slope * moved[2]
        x, y = torch.addcmul(moved[:2] * view.inverse_depth, view.point[:2], along)
        return view.force(torch.stack([torch.addcmul(xx * x, yx, y), torch.addcmul(yx * x, yy, y)]))
