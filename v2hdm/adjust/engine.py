"""The interface of engines: they evaluate and linearise a problem and eliminate its corners.

The solver knows no observation. It asks an :class:`Engine` made for one problem
(:func:`v2hdm.adjust.engines.make_engine`), either ``torch``, which differentiates :mod:`v2hdm.adjust.model`,
or ``numba``, whose compiled kernels do the same in closed form.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from torch import Tensor

from v2hdm.adjust.arrays import Arrays, Run
from v2hdm.adjust.model import Estimate, Gradient, Loss
from v2hdm.adjust.reduced import CornerFactor, Coupled, Plan, PriorBlocks, ReducedSystem, Spread
from v2hdm.records import BoolArray, FloatArray

WEIGHT_FLOOR = 1e-6  # least weight of an observation in the Hessian: a corner of outliers stays factorable


@dataclass(frozen=True)
class Evaluated:
    """Cost and gradient after a step."""

    estimate: Estimate  # where the step led
    terms: dict[str, float]  # the cost there, by name
    gradient: Gradient  # by the step
    # what :meth:`Linearised.carry` makes of the corners' part
    whitened: Tensor
    coupled: Coupled


@dataclass(frozen=True)
class Linearised(ABC):
    """A problem linearised at an estimate, its corners eliminated."""

    # the cost at the estimate, by name, and its gradient
    terms: dict[str, float]
    gradient: Gradient
    corner_factor: CornerFactor  # L, the factor of the corners' own block
    # what :meth:`carry` makes of the gradient's corner part
    whitened: Tensor
    coupled: Coupled

    @abstractmethod
    def evaluate(self, step: Gradient, tangents: Tensor, own: Tensor) -> Evaluated:
        """Evaluate after a step of the reduced unknowns, with which the corners move.

        ``tangents`` (C, M, 6) are those of the pairs under the step, ``own`` (N, 2) whitened variables of
        corners.
        """

    @abstractmethod
    def carry(self, by_corner: Tensor) -> tuple[Tensor, Coupled]:
        """L^-1 g (N, 2) and W V^-1 g of a gradient g (N, 2) by the corners."""

    @abstractmethod
    def coupling(self, run: Run, corners_map: Tensor) -> Tensor:
        """W' (k, 2, 6) of a run's observations, of corners (n, 2), by the left tangents of their pairs."""


class Engine(ABC):
    """The model over the ``arrays`` of one problem."""

    def __init__(self, arrays: Arrays) -> None:
        self.arrays = arrays

    def over(self, arrays: Arrays) -> Engine:
        """The same engine over another problem."""
        return type(self)(arrays)

    @abstractmethod
    def plan(self) -> Plan:
        """How the reduced system is cut into tiles."""

    @abstractmethod
    def back_project(self, cam_from_vehicle: Tensor) -> tuple[Tensor, Tensor]:
        """Corners (N, 2) by weighted back-projection from recorded poses, and which (N,) a ray fixes."""

    @abstractmethod
    def residuals(self, cam_from_map: Tensor, corners_map: Tensor) -> Tensor:
        """Whitened residuals (2, K) of the observations, for pairs (C, M, 4, 4)."""

    @abstractmethod
    def poses(self, estimate: Estimate) -> Tensor:
        """``cam_from_map`` of every pair, (C, M, 4, 4)."""

    @abstractmethod
    def report(self, estimate: Estimate, focal_px: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """In the problem's order: residuals (K, 2) px, their squares in sigmas, who lies behind."""

    @abstractmethod
    def terms(self, estimate: Estimate, robust: Loss) -> dict[str, float]:
        """The cost, by name."""

    @abstractmethod
    def pull(self, estimate: Estimate, spread: Spread, by_residual: Tensor) -> Gradient:
        """The gradient of a scalar whose gradient by the whitened residuals is ``by_residual`` (2, K).

        ``spread`` is that of :meth:`spread` at the estimate.
        """

    @abstractmethod
    def spread(self, estimate: Estimate) -> Spread:
        """How pairs move with frame states and clock offsets."""

    @abstractmethod
    def prior_blocks(self, estimate: Estimate) -> PriorBlocks:
        """The priors' part of the Gauss-Newton Hessian of the reduced unknowns."""

    @abstractmethod
    def eliminate(self, system: ReducedSystem, estimate: Estimate, robust: Loss) -> Linearised:
        """Linearise and eliminate the corners; raises AdjustError where joined ones cannot be solved for."""
