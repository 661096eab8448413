"""The interface of engines, which evaluate and linearise a problem and eliminate its corners.

An :class:`Engine` is made for one problem (:func:`v2hdm.adjust.engines.make_engine`): ``torch``
differentiates :mod:`v2hdm.adjust.model`, ``numba`` computes the same in compiled closed forms.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from torch import Tensor

from v2hdm.adjust.arrays import Arrays, Run
from v2hdm.adjust.model import Estimate, Gradient, Loss
from v2hdm.adjust.reduced import CornerFactor, Coupled, Plan, PriorBlocks, ReducedSystem, Spread
from v2hdm.records import BoolArray, FloatArray

WEIGHT_FLOOR = 1e-6  # least weight of an observation in the Hessian: keeps a corner of outliers definite


@dataclass(frozen=True)
class Evaluated:
    """Cost and gradient after a step."""

    estimate: Estimate  # after the step
    terms: dict[str, float]  # its cost, by name
    gradient: Gradient  # with respect to the step
    whitened: Tensor  # L^-1 g of the corners, see :meth:`Linearised.carry`
    coupled: Coupled


@dataclass(frozen=True)
class Linearised(ABC):
    """A problem linearised at an estimate, its corners eliminated."""

    terms: dict[str, float]  # the cost at the estimate, by name
    gradient: Gradient
    corner_factor: CornerFactor  # L, the factor of the corners' own block
    whitened: Tensor  # L^-1 g of the corners, see :meth:`carry`
    coupled: Coupled

    @abstractmethod
    def evaluate(self, step: Gradient, tangents: Tensor, own: Tensor) -> Evaluated:
        """Evaluate after a step of the reduced unknowns, the corners following.

        ``tangents`` (C, M, 6) are the pairs' under the step, ``own`` (N, 2) the corners' whitened variables.
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
        """The division of the reduced system into tiles."""

    @abstractmethod
    def back_project(self, cam_from_vehicle: Tensor) -> tuple[Tensor, Tensor]:
        """Corners (N, 2) by weighted back-projection from recorded poses, and which (N,) are determined."""

    @abstractmethod
    def residuals(self, cam_from_map: Tensor, corners_map: Tensor) -> Tensor:
        """Whitened residuals (2, K) of the observations, for pairs (C, M, 4, 4)."""

    @abstractmethod
    def poses(self, estimate: Estimate) -> Tensor:
        """``cam_from_map`` of every pair, (C, M, 4, 4)."""

    @abstractmethod
    def report(self, estimate: Estimate, focal_px: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """In problem order: residuals (K, 2), px, squared Mahalanobis distances, points behind."""

    @abstractmethod
    def terms(self, estimate: Estimate, robust: Loss) -> dict[str, float]:
        """The cost by name."""

    @abstractmethod
    def pull(self, estimate: Estimate, spread: Spread, by_residual: Tensor) -> Gradient:
        """Gradient of a scalar from that by the whitened residuals (2, K); :meth:`spread` at the estimate."""

    @abstractmethod
    def spread(self, estimate: Estimate) -> Spread:
        """Jacobians of the pairs by frame states and clock offsets."""

    @abstractmethod
    def prior_blocks(self, estimate: Estimate) -> PriorBlocks:
        """Gauss-Newton Hessian of the priors by the reduced unknowns."""

    @abstractmethod
    def eliminate(self, system: ReducedSystem, estimate: Estimate, robust: Loss) -> Linearised:
        """Linearise and eliminate the corners; raises AdjustError if a block of joined ones is singular."""
