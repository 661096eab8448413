"""A part's summary of its border, its marginal information and optimum there, and the way back.

With the whitened variables y of :mod:`v2hdm.adjust.whitening`, in which the Hessian is the identity, the
border is b = W'y for some columns W. By the part alone, b has the covariance W'W and the optimum -W'g. If all
parts together move the border by d instead, y follows as y = -g + W (W'W)^-1 (d + W'g); what covariances
follow is in :mod:`v2hdm.adjust.sections.joined`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from v2hdm.adjust.covariance import reduced_root
from v2hdm.adjust.descent import minimise
from v2hdm.adjust.kernels.tables import move
from v2hdm.adjust.model import Estimate
from v2hdm.adjust.whitening import Whitening
from v2hdm.geometry.rigid import log
from v2hdm.geometry.tensors import inverse
from v2hdm.records import FloatArray

_CORNERS_AT_ONCE = 256  # corners whose columns are computed together, to bound intermediate results
_MOST_STEPS = 12  # most steps of LBFGS with the border held, under one whitening: chosen


@dataclass(frozen=True)
class Border:
    """The border of a part in the order of its arrays: all cameras, then ``frames``, then ``corners``.

    ``corners`` (m,) are ascending and closed: with a corner, all that known lengths join to it.
    """

    frames: Tensor
    corners: Tensor


@dataclass(frozen=True)
class Values:
    """The border's value: extrinsics (C, 4, 4), clocks (C, Q), frame states (b, S) and corners (m, 2)."""

    cam_from_vehicle: Tensor
    clock_s: Tensor
    frame_state: Tensor
    corners_map: Tensor

    @classmethod
    def of(cls, estimate: Estimate, border: Border) -> Values:
        """The border's part of an estimate."""
        return cls(
            estimate.cam_from_vehicle,
            estimate.clock_s,
            estimate.frame_state[border.frames],
            estimate.corners_map[border.corners],
        )

    def step_from(self, base: Values) -> Tensor:
        """The step (n,) of the border that leads here from ``base``, in the border's order."""
        motion = self.cam_from_vehicle @ inverse(base.cam_from_vehicle)
        turned = torch.as_tensor(log(motion.cpu().numpy())).to(motion)
        by_camera = torch.cat([turned, self.clock_s - base.clock_s], dim=1)
        states = self.frame_state - base.frame_state
        corners = self.corners_map - base.corners_map
        return torch.cat([by_camera.flatten(), states.flatten(), corners.flatten()])


@dataclass(frozen=True)
class Columns:
    """Columns of W, zero but in these rows.

    ``reduced`` (T, n) are the last reduced variables, ``own`` (2 m, 2 m) the variables of the m corners that
    the last columns are of; it is empty where corners are themselves reduced variables.
    """

    reduced: Tensor
    own: Tensor

    def pushed(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """W weights, as the last reduced variables (T, ...) and the corners' own (m, 2, ...)."""
        of_corners = self.own @ weights[len(weights) - len(self.own) :]
        return self.reduced @ weights, of_corners.view(len(of_corners) // 2, 2, *weights.shape[1:])

    def pulled(self, reduced: Tensor, corners: Tensor) -> Tensor:
        """Inner products (n, ...) with all reduced (D, ...) and the corners' variables (m, 2, ...)."""
        out = self.reduced.mT @ reduced[len(reduced) - len(self.reduced) :]
        if len(self.own):
            out[len(out) - len(self.own) :] += self.own.mT @ corners.flatten(0, 1)
        return out

    @cached_property
    def covariance(self) -> Tensor:
        """W'W (n, n)."""
        out = self.reduced.mT @ self.reduced
        if len(self.own):
            out[-len(self.own) :, -len(self.own) :] += self.own.mT @ self.own
        return out


def border_columns(whitening: Whitening, border: Border) -> Columns:
    """The columns of a border."""
    arrays = whitening.engine.arrays
    plan = whitening.plan
    factor = whitening.reduced_factor
    are_last = plan.border_tiles > 0 and len(border.corners) == len(plan.kept_corners)
    if are_last:
        factor = factor.tail(plan.border_tiles)
    tip = len(factor.tip)
    whole = whitening.reduced_factor.size
    rows = [torch.arange(whole - tip, whole, device=factor.tip.device)]
    if arrays.states:
        rows.append(plan.frame_rows(border.frames, len(arrays.states)).flatten())
    if are_last:
        rows.append(plan.kept_rows(torch.arange(len(border.corners), device=rows[0].device)).flatten())
    at = torch.cat(rows) - (whole - factor.size)
    units = factor.tip.new_zeros(factor.size, len(at))
    units[at, torch.arange(len(at), device=at.device)] = 1.0
    reduced = factor.solve(units)
    if are_last:
        return Columns(reduced, units.new_zeros(0, 0))
    corners = corner_columns(whitening, border.corners)
    return Columns(torch.cat([reduced, corners.reduced], dim=1), corners.own)


def corner_columns(whitening: Whitening, corners: Tensor) -> Columns:
    """Columns of corners (m,), ascending and closed."""
    tip = whitening.reduced_factor.tip
    reduced = [tip.new_zeros(whitening.reduced_factor.size, 0)]
    of_corners = tip.new_zeros(2 * len(corners), 2 * len(corners))
    for begin, end in chunks_of(whitening, corners):
        chosen = corners[begin:end]
        factors = _factors(whitening, chosen)
        of_corners[2 * begin : 2 * end, 2 * begin : 2 * end] = factors.by_variable
        reduced.append(-reduced_root(whitening, chosen) @ factors.inverse)
    return Columns(torch.cat(reduced, dim=1), of_corners)


class _Factors(NamedTuple):
    """Factors of n corners: V^-1 (2 n, 2 n), and the columns (2 n, 2 n) of their own variables."""

    inverse: Tensor
    by_variable: Tensor


def _factors(whitening: Whitening, corners: Tensor) -> _Factors:
    tip = whitening.reduced_factor.tip
    unit = torch.eye(2 * len(corners), dtype=tip.dtype, device=tip.device).view(len(corners), 2, -1)
    factor = whitening.linearised.corner_factor.take(corners)
    lower = factor.solve(unit)
    inverse = factor.solve_transposed(lower).flatten(0, 1)
    by_variable = lower.flatten(0, 1)
    by_variable[torch.isin(corners, whitening.plan.kept_corners).repeat_interleave(2)] = 0.0
    return _Factors(inverse, by_variable)


def chunks_of(whitening: Whitening, corners: Tensor) -> list[tuple[int, int]]:
    """Ranges of corners (m,) whose columns are computed together; joined ones are never separated."""
    is_joined = whitening.engine.arrays.joined[corners].tolist()
    begins = [0]
    for at, joined in enumerate(is_joined):
        if at - begins[-1] >= _CORNERS_AT_ONCE and not joined:
            begins.append(at)
    ends = [*begins[1:], len(corners)]
    return [(begin, end) for begin, end in zip(begins, ends, strict=True) if end > begin]


@dataclass(frozen=True)
class Summary:
    """The cost of a part as a quadratic function of its border's step.

    Half of step' ``information`` step (n, n) plus ``slope`` (n,) times the step; ``terms`` is the cost at the
    point that the step is from, by name. ``slack`` is twice the decrease of the cost that is left with the
    border held, ``least_cost`` the cost at the part's own optimum, as predicted.
    """

    information: FloatArray
    slope: FloatArray
    terms: dict[str, float]
    slack: float
    least_cost: float


class Place(NamedTuple):
    """A point that a part has reached under its whitening: whitened variables, and what is there."""

    whitened: Tensor
    estimate: Estimate
    terms: dict[str, float]  # the cost, by name
    gradient: Tensor  # of the cost by the whitened variables

    @classmethod
    def base(cls, whitening: Whitening) -> Place:
        """The point where the whitening was made."""
        nowhere = torch.zeros_like(whitening.gradient)
        return cls(nowhere, whitening.estimate, whitening.terms, whitening.gradient)

    @classmethod
    def at(cls, whitening: Whitening, whitened: Tensor) -> Place:
        """The point of some whitened variables."""
        return cls(whitened, *whitening.reach(whitened))


@dataclass(frozen=True)
class Footing:
    """A part's whitening with the columns of its border, from which it follows the border round by round."""

    whitening: Whitening
    border: Border
    columns: Columns

    @classmethod
    def of(cls, whitening: Whitening, border: Border) -> Footing:
        """The footing that a whitening gives."""
        return cls(whitening, border, border_columns(whitening, border))

    @cached_property
    def factor(self) -> Tensor:
        """Lower factor of W'W (n, n)."""
        lower: Tensor = torch.linalg.cholesky(self.columns.covariance)
        return lower

    def in_border(self, whitened: Tensor) -> Tensor:
        """The border's step (n,) of whitened variables, W'y."""
        reduced = whitened[: self.whitening.reduced_factor.size]
        of_corners = whitened[len(reduced) :].view(-1, 2)[self.border.corners]
        return self.columns.pulled(reduced, of_corners)

    def moved(self, whitened: Tensor, step: Tensor) -> Tensor:
        """The variables nearest to ``whitened`` whose step of the border is larger by ``step`` (n,)."""
        weights = torch.cholesky_solve(step[:, None], self.factor)[:, 0]
        last, of_corners = self.columns.pushed(weights)
        out = whitened.clone()
        size = self.whitening.reduced_factor.size
        out[size - len(last) : size] += last
        if len(of_corners):
            out[size:].view(-1, 2)[self.border.corners] += of_corners
        return out

    def follow(self, place: Place, target: Values) -> Place:
        """Where a Newton step leads from ``place`` when the border moves to ``target``."""
        newton = place.whitened - place.gradient
        asked = target.step_from(Values.of(self.whitening.estimate, self.border))
        return Place.at(self.whitening, self.moved(newton, asked - self.in_border(newton)))

    def settle(self, place: Place, tolerance: float) -> Place:
        """The optimum, to a gap of ``tolerance``, with the border where it is at ``place``."""

        def along(gradient: Tensor) -> Tensor:
            return self.moved(gradient, -self.in_border(gradient))

        def objective(step: Tensor) -> tuple[float, Tensor]:
            reached = self.whitening.reach(place.whitened + step)
            return sum(reached.terms.values()), along(reached.gradient)

        cost = sum(place.terms.values())
        minimum = minimise(objective, cost, along(place.gradient), tolerance, _MOST_STEPS)
        if not bool(minimum.whitened.any()):
            return place
        return Place.at(self.whitening, place.whitened + minimum.whitened)


def summarise(footing: Footing, place: Place, held: Tensor, held_map: Tensor) -> Summary:
    """The summary of a part at a place, without what holds its border's corners.

    These were held at ``held_map`` (m, 2) with the information ``held`` (m,), 1 / m^2, in each direction.
    """
    border = footing.border
    information = torch.cholesky_inverse(footing.factor)
    gradient = place.gradient
    step = -footing.in_border(gradient)
    pulled = information @ step
    slack = gradient.square().sum() - step @ pulled
    slope = -pulled
    _to_place(footing.whitening, place, information, slope)
    count = 2 * len(border.corners)
    if count:
        weight = held.repeat_interleave(2)
        off_m = (place.estimate.corners_map[border.corners] - held_map).flatten()
        slope[-count:] -= weight * off_m
        information.diagonal()[-count:] -= weight
    terms = {name: cost for name, cost in place.terms.items() if name != "control_points"}
    return Summary(
        information.cpu().numpy(),
        slope.cpu().numpy(),
        terms,
        max(float(slack), 0.0),
        sum(terms.values()) - float(gradient.square().sum()) / 2,
    )


def _to_place(whitening: Whitening, place: Place, information: Tensor, slope: Tensor) -> None:
    """Carry information and slope from cameras' tangents at the whitening's estimate to those at a place."""
    if not bool(place.whitened.any()):
        return
    before = whitening.estimate.cam_from_vehicle
    tangents = log((place.estimate.cam_from_vehicle @ inverse(before)).cpu().numpy())
    unknowns = whitening.engine.arrays.camera_unknowns
    _, charts = move(tangents, before.cpu().numpy())
    for camera, chart in enumerate(charts):
        rows = slice(camera * unknowns, camera * unknowns + 6)
        turn = torch.as_tensor(np.linalg.inv(chart)).to(slope)
        slope[rows] = turn.mT @ slope[rows]
        information[rows] = turn.mT @ information[rows]
        information[:, rows] = information[:, rows] @ turn
