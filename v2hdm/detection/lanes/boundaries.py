"""Boundaries of lanes: the rows on which each line is painted, in a gap or has ended.

A hidden Markov model runs over the image's rows from far to near. Its states are *ended*, *gap*, *solid* and
*dash*, with transition rates per metre of ground. A row's evidence is two of the network's log odds: those of
the best crossing on the line and of the best paint about it. The forward-backward algorithm (L. Rabiner, "A
tutorial on hidden Markov models", Proc. IEEE 77, 1989) gives the probability of each state on each row, and
the likelihood ratio of the line to ground without one. Two lines side by side may be the strands of a double
line, which runs along the middle of the strands present.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum, auto
from functools import cache
from typing import NamedTuple

import numpy as np

from v2hdm.detection.camera import FARTHEST_M
from v2hdm.detection.lanes.curves import NEIGHBOURS, LaneImage, Line, LinePoints, Span
from v2hdm.detection.network import as_probability
from v2hdm.native import kernels
from v2hdm.records import LANE_BOUNDARY, BoolArray, FloatArray, LaneDetection

_DRAWN_STEP_PX = 8.0  # rows from one point of a drawn line to the next, px

# Places of the states in the chain's arrays; a dash has several, its stages.
_ENDED, _GAP, _SOLID, _DASH = range(4)
_DASH_STAGES = 3  # stages of a dash: its length is Erlang distributed, with a deviation of 58 % of the mean
_STATES = _DASH + _DASH_STAGES  # number of states

# Mean lengths of what lies on one curve; those of dashes and gaps are in the renders (train/scenes/paint),
# the others fitted to renders.
_DASH_M = 3.6  # mean length of a dash, m
_GAP_M = 5.1  # mean length of the gap between two dashes, m
_SOLID_M = 100.0  # mean length of a solid line, m
_DASHED_M = 120.0  # mean length of a row of dashes, m
_ENDED_M = 60.0  # mean length of bare ground between lines, m; a solid line or a row of dashes may follow it


class _Weighing(NamedTuple):
    """How log odds x, clipped to a range, add ``weight * (x - even)`` to a log likelihood.

    The two below are fitted to renders.
    """

    weight: float
    even: float
    least: float
    most: float

    def log_likelihood(self, odds: FloatArray) -> FloatArray:
        """The log likelihood that log odds (...) add."""
        return np.asarray(self.weight * (np.clip(odds, self.least, self.most) - self.even))


_CROSSING = _Weighing(weight=0.05, even=-2.7, least=-3.0, most=6.7)
"""Evidence of a crossing for any state of a line; the weight is small since rows err together."""

_PAINT = _Weighing(weight=0.3, even=-1.0, least=-4.0, most=4.0)
"""Evidence of paint for *solid* and *dash*."""

_HALF_WIDTH_M = 0.06  # half width, m, of the strip about a curve in which its paint is sought
_LEAST_HALF_WIDTH_PX = 4.0  # least half width of that strip, px
_ACROSS = np.linspace(-1.0, 1.0, 7)  # places across that strip, in half widths

_CROSSING_M = 0.3  # lines cross if one lies this far to the left of the other and, elsewhere, to its right
_DOUBLE_M = 0.75  # lines nearer than this are one boundary: two strands if both show paint abreast, else one
_LEAST_ABREAST_M = 1.0  # ground on which both strands of a double line show paint
_ONE_LINE_M = 0.12  # lines nearer to each other than this are one
_CERTAIN_SIGMA_M = 0.3  # largest sigma of a line on rows that locate it beside others
_EVEN = 0.5  # probability of presence from which a line is drawn
_SMOOTH_PX = 24.0  # half width of the triangular window over a line's points
_FREEDOM_M = 0.03  # sigma of a line about its curve
_EXTENSION_SIGMA = 0.03  # largest sigma of a line beyond its points, relative to the image's width


def with_spans(lines: Sequence[Line], points: LinePoints, image: LaneImage) -> list[Line]:
    """The lines through an image's points, each with its :class:`Span`."""
    if not lines:
        return []
    camera = image.camera
    horizon = image.horizon
    corners = (camera.info.height - 1.0) * np.array([[0.0, 1.0], [0.0, 1.0]])
    corners[1, 0] = camera.info.width - 1.0
    lowest = float(horizon.coordinates(camera.undistort(corners))[1].max())
    below = np.arange(horizon.below_px(FARTHEST_M), lowest + _DRAWN_STEP_PX, _DRAWN_STEP_PX)
    along = np.array([line.curve.parameters for line in lines]) @ horizon.basis(below).T
    beside_m = (along - horizon.centre_px) / (horizon.px_per_m * below)
    step_m = np.hypot(np.diff(horizon.depth_m(below)), np.diff(beside_m, axis=1))
    half_px = np.maximum(_HALF_WIDTH_M * horizon.px_per_m * below, _LEAST_HALF_WIDTH_PX)
    across = along[..., None] + half_px[:, None] * _ACROSS
    places_px = image.places_px(across, below[:, None])
    likelihood = np.zeros((*along.shape, _STATES))
    crossing_odds = _crossings(lines, points, image, below)
    likelihood[..., _GAP:] = _CROSSING.log_likelihood(crossing_odds)[..., None]
    if image.output is not None:
        paint_odds = image.output.odds_at(places_px).max(axis=2)
        likelihood[..., _SOLID:] += _PAINT.log_likelihood(paint_odds)[..., None]
    middle_px = places_px[:, :, len(_ACROSS) // 2]
    likelihood *= camera.inside(middle_px, 0)[..., None]
    states, total = _forward_backward(likelihood, step_m)
    length_m = (np.pad(step_m, [(0, 0), (0, 1)]) + np.pad(step_m, [(0, 0), (1, 0)])) / 2
    present = 1 - states[..., _ENDED]
    painted = states[..., _SOLID:].sum(axis=2)
    spans = [
        Span(below, present[k], painted[k], length_m[k], log_likelihood)
        for k, log_likelihood in enumerate(total.tolist())
    ]
    return [replace(line, span=span) for line, span in zip(lines, spans, strict=True)]


def _crossings(lines: Sequence[Line], points: LinePoints, image: LaneImage, below: FloatArray) -> FloatArray:
    """Log odds (N, T) of the best crossing of each line near each row; -inf without one."""
    best = np.full((len(lines), len(below)), -np.inf)
    for k, line in enumerate(lines):
        crossings = line.members[~points.is_paint[line.members]]
        is_coarse = image.camera.coarse(points.points_px[crossings, 1])
        reach_px = np.where(is_coarse, image.row_step_px, image.row_step_px / 2)
        in_reach = np.abs(below[:, None] - points.below[crossings]) <= reach_px + 1
        best[k] = np.where(in_reach, points.odds[crossings], -np.inf).max(axis=1, initial=-np.inf)
    return best


def _rates() -> FloatArray:
    """Transition rates (S, S) of the states per metre of ground; rows sum to zero."""
    rates = np.zeros((_STATES, _STATES))
    rates[_ENDED, _SOLID] = rates[_ENDED, _GAP] = 0.5 / _ENDED_M
    rates[_GAP:, _ENDED] = 1 / _DASHED_M
    rates[_SOLID, _ENDED] = 1 / _SOLID_M
    rates[_GAP, _DASH] = 1 / _GAP_M
    stages = [*range(_DASH, _STATES), _GAP]
    rates[stages[:-1], stages[1:]] = _DASH_STAGES / _DASH_M
    return np.asarray(rates - np.diag(rates.sum(axis=1)))


class _Modes(NamedTuple):
    """The modes in which the states of a line go over into each other."""

    values: np.ndarray  # (S,) eigenvalues of the rates, 1/m
    right: np.ndarray  # (S, S) right eigenvectors, as columns
    left: np.ndarray  # (S, S) left eigenvectors, as rows
    stationary: FloatArray  # (S,) shares of the states far along

    def move(self, step_m: FloatArray) -> FloatArray:
        """Probabilities (..., S, S) of going from one state to another within ``step_m`` (...)."""
        decay = np.exp(self.values * step_m[..., None])[..., None, :]
        return np.asarray(np.maximum(((self.right * decay) @ self.left).real, 0.0))


@cache
def _modes() -> _Modes:
    """The modes of the rates."""
    values, right = np.linalg.eig(_rates())
    left = np.linalg.inv(right)
    shares = left[np.argmax(values.real)].real
    return _Modes(values, right, left, shares / shares.sum())


def _forward_backward(likelihood: FloatArray, step_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Probabilities (N, T, S) of the states, and log likelihood (N,), from those of rows ``step_m`` apart."""
    move = _modes().move(step_m)
    evidence = np.exp(likelihood)
    compiled = kernels()
    if compiled is not None:
        return evidence, compiled.forward_backward(evidence, move, _modes().stationary)
    forward = np.empty_like(evidence)
    scale = np.empty(evidence.shape[:2])
    state = np.broadcast_to(_modes().stationary, evidence[:, 0].shape)
    for t in range(evidence.shape[1]):
        if t > 0:
            state = (state[:, None] @ move[:, t - 1])[:, 0]
        state = state * evidence[:, t]
        scale[:, t] = state.sum(axis=1)
        state = state / scale[:, t, None]
        forward[:, t] = state
    after = np.ones_like(state)
    for t in range(evidence.shape[1] - 2, -1, -1):
        after = (move[:, t] @ (after * evidence[:, t + 1])[..., None])[..., 0] / scale[:, t + 1, None]
        forward[:, t] *= after
    return forward, np.log(scale).sum(axis=1)


def boundaries(lines: Sequence[Line], points: LinePoints, image: LaneImage) -> list[Line]:
    """The lines, best first, without repetitions and crossings of better ones; double lines get a strand."""
    separate: list[Line] = []
    for line in lines:
        for k, other in enumerate(separate):
            relation = _relation(line, other, points, image)
            if relation is _Relation.SECOND_STRAND and other.strand is None:
                separate[k] = replace(other, strand=line)
            if relation is not _Relation.SEPARATE:
                break
        else:
            separate.append(line)
    return separate


class _Relation(Enum):
    """Kinds of relation of a line to another."""

    SEPARATE = auto()
    REPETITION = auto()  # or it crosses the other
    SECOND_STRAND = auto()


def _relation(line: Line, other: Line, points: LinePoints, image: LaneImage) -> _Relation:
    """The relation of a line to another, on the rows of its span."""
    assert line.span is not None
    assert other.span is not None
    below = line.span.below
    phi = image.horizon.basis(below)
    px_per_m = image.horizon.px_per_m * below
    sigma_m = line.curve.sigma(phi) / px_per_m
    other_sigma_m = other.curve.sigma(phi) / px_per_m
    offset_m = (line.curve.along(phi) - other.curve.along(phi)) / px_per_m
    is_certain = np.maximum(sigma_m, other_sigma_m) < _CERTAIN_SIGMA_M
    shown = _shown(line, points, below)
    other_shown = _shown(other, points, below)
    from_row = max(int(np.argmax(shown)), int(np.argmax(other_shown)))
    certain_offset_m = offset_m[from_row:][(is_certain & (shown | other_shown))[from_row:]]
    if (certain_offset_m < -_CROSSING_M).any() and (certain_offset_m > _CROSSING_M).any():
        return _Relation.REPETITION
    compared = shown & other_shown if (shown & other_shown).any() else shown
    compared = compared & (other_sigma_m < _CERTAIN_SIGMA_M)
    if not compared.any() or np.abs(offset_m[compared]).max() > _DOUBLE_M:
        return _Relation.SEPARATE
    abreast_m = float((line.span.length_m * line.span.painted) @ other.span.painted)
    abreast_m = min(abreast_m, line.paint_m, other.paint_m)
    is_double = abreast_m >= _LEAST_ABREAST_M and abs(np.median(offset_m[compared])) > _ONE_LINE_M
    return _Relation.SECOND_STRAND if is_double else _Relation.REPETITION


def _shown(line: Line, points: LinePoints, below: FloatArray) -> BoolArray:
    """Flags (T,) of the rows between the nearest and the farthest point of a line; at least one."""
    points_below = points.below[line.members]
    rows = np.arange(len(below))
    first, last = np.searchsorted(below, (points_below.min(), points_below.max()))
    return np.asarray((rows >= min(first, len(below) - 1)) & (rows <= last), dtype=np.bool_)


def draw(line: Line, points: LinePoints, image: LaneImage) -> LaneDetection | None:
    """A line's points in the image, near to far, with their standard deviations; None if fewer than two."""
    assert line.span is not None
    camera = image.camera
    below = line.span.below
    present = line.span.present
    along, sigma = _followed(points, line, image, below)
    if line.strand is not None and line.strand.span is not None:
        strand_present = line.strand.span.present
        strand_along, strand_sigma = _followed(points, line.strand, image, below)
        share = strand_present / np.maximum(present + strand_present, 1e-9)
        along = along + share * (strand_along - along)
        sigma = sigma + share * (strand_sigma - sigma)
        present = np.maximum(present, strand_present)
    rows = np.arange(len(below))
    drawn = np.flatnonzero(present > _EVEN)
    if not len(drawn):
        return None
    points_px = camera.distort(image.horizon.pinhole_px(along, below))
    points_below = points.below[line.members]
    between = (below >= points_below.min()) & (below <= points_below.max())
    shown = (rows >= drawn[0]) & (rows <= drawn[-1]) & camera.inside(points_px, -_DRAWN_STEP_PX)
    shown &= (sigma < _EXTENSION_SIGMA * camera.info.width) | between
    if shown.sum() < 2:
        return None
    score = float(as_probability(np.array(line.log_odds)))
    return LaneDetection(LANE_BOUNDARY, score, points_px[shown][::-1], sigma_px=sigma[shown][::-1])


def _followed(
    points: LinePoints, line: Line, image: LaneImage, below: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Position of a line along the horizon and its sigma (N,), px, so far ``below`` (N,) it, px."""
    phi = image.horizon.basis(below)
    curve_sigma = line.curve.sigma(phi)
    along = line.curve.along(phi)
    members = line.members
    off = points.along[members] - line.curve.along(points.phi[members])
    window = np.maximum(1 - np.abs(below[:, None] - points.below[members]) / _SMOOTH_PX, 0)
    weight = window / (NEIGHBOURS * points.sigma_px[members] ** 2)
    curve_weight = 1 / (curve_sigma**2 + (_FREEDOM_M * image.horizon.px_per_m * below) ** 2)
    total = weight.sum(axis=1) + curve_weight
    return along + weight @ off / total, np.sqrt(1 / total)
