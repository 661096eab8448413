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
from functools import cache

import numpy as np

from v2hdm.detection.camera import FARTHEST_M
from v2hdm.detection.lanes.curves import NEIGHBOURS, LaneImage, Line, LinePoints, Span
from v2hdm.detection.network import as_probability
from v2hdm.records import LANE_BOUNDARY, BoolArray, FloatArray, LaneDetection

_DRAWN_STEP_PX = 8.0  # rows from one point of a drawn line to the next, px
_ENDED, _GAP, _SOLID, _DASH = range(4)
_DASH_STAGES = 3  # of a dash: its length is Erlang distributed, with a deviation of 58 % of the mean

_STATES = _DASH + _DASH_STAGES
_DASH_M = 3.6
_GAP_M = 5.1
"""Mean lengths of dashes and of the gaps between them, m, in the renders (train/scenes/paint)."""

_SOLID_M = 100.0
_DASHED_M = 120.0
_ENDED_M = 60.0
"""Mean lengths, m, of solid lines, of rows of dashes, and of bare ground between lines on one curve; fitted
to renders. After bare ground, a solid line is as likely as a row of dashes."""

_CROSSING_WEIGHT = 0.05
_CROSSING_EVEN = -2.7
_CROSSING_RANGE = (-3.0, 6.7)
"""A crossing of log odds x, clipped to the range, adds weight * (x - even) to a line's log likelihood. The
weight is small since rows err together. Fitted to renders, as are those of paint."""

_PAINT_WEIGHT = 0.3
_PAINT_EVEN = -1.0
_PAINT_RANGE = (-4.0, 4.0)
"""The same for paint and the log likelihoods of *solid* and *dash*."""

_HALF_WIDTH_M = 0.06
_LEAST_HALF_WIDTH_PX = 4.0
_ACROSS = np.linspace(-1.0, 1.0, 7)
"""Half width, m and at least px, and relative places across a curve at which its paint is sought."""

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
    crossing = _crossings(lines, points, image, below)
    likelihood[..., _GAP:] = _evidence(crossing, _CROSSING_WEIGHT, _CROSSING_EVEN, _CROSSING_RANGE)[..., None]
    if image.output is not None:
        paint = image.output.odds_at(places_px).max(axis=2)
        paint = _evidence(paint, _PAINT_WEIGHT, _PAINT_EVEN, _PAINT_RANGE)
        likelihood[..., _SOLID:] += paint[..., None]
    middle_px = places_px[:, :, len(_ACROSS) // 2]
    likelihood *= camera.inside(middle_px, 0)[..., None]
    states, total = _forward_backward(likelihood, step_m)
    length_m = (np.pad(step_m, [(0, 0), (0, 1)]) + np.pad(step_m, [(0, 0), (1, 0)])) / 2
    present = 1 - states[..., _ENDED]
    painted = states[..., _SOLID:].sum(axis=2)
    each = zip(lines, present, painted, length_m, total.tolist(), strict=True)
    return [replace(line, span=Span(below, *rest)) for line, *rest in each]


def _evidence(odds: FloatArray, weight: float, even: float, bounds: tuple[float, float]) -> FloatArray:
    return np.asarray(weight * (np.clip(odds, *bounds) - even))


def _crossings(lines: Sequence[Line], points: LinePoints, image: LaneImage, below: FloatArray) -> FloatArray:
    """Log odds (N, T) of the best crossing of each line near each row; -inf without one."""
    out = np.full((len(lines), len(below)), -np.inf)
    for k, line in enumerate(lines):
        own = line.members[~points.is_paint[line.members]]
        coarse = image.camera.coarse(points.points_px[own, 1])
        reach_px = np.where(coarse, image.row_step_px, image.row_step_px / 2)
        near = np.abs(below[:, None] - points.below[own]) <= reach_px + 1
        out[k] = np.where(near, points.odds[own], -np.inf).max(axis=1, initial=-np.inf)
    return out


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


@cache
def _modes() -> tuple[np.ndarray, np.ndarray, np.ndarray, FloatArray]:
    """Eigenvalues (S,), right and left eigenvectors (S, S) of the rates; stationary distribution (S,)."""
    values, right = np.linalg.eig(_rates())
    left = np.linalg.inv(right)
    shares = left[np.argmax(values.real)].real
    return values, right, left, shares / shares.sum()


def _forward_backward(likelihood: FloatArray, step_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Probabilities (N, T, S) of the states, and log likelihood (N,), from those of rows ``step_m`` apart."""
    values, right, left, shares = _modes()
    move = np.maximum(((right * np.exp(values * step_m[..., None])[..., None, :]) @ left).real, 0.0)
    evidence = np.exp(likelihood)
    forward = np.empty_like(evidence)
    scale = np.empty(evidence.shape[:2])
    state = np.broadcast_to(shares, evidence[:, 0].shape)
    for t in range(evidence.shape[1]):
        state = (state if t == 0 else (state[:, None] @ move[:, t - 1])[:, 0]) * evidence[:, t]
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
    kept: list[Line] = []
    for line in lines:
        for k, other in enumerate(kept):
            relation = _relation(line, other, points, image)
            if relation == _DOUBLES and other.strand is None:
                kept[k] = replace(other, strand=line)
            if relation != _APART:
                break
        else:
            kept.append(line)
    return kept


_APART, _REPEATS, _DOUBLES = range(3)


def _relation(line: Line, other: Line, points: LinePoints, image: LaneImage) -> int:
    """Whether a line is apart from another, repeats or crosses it, or is its second strand."""
    assert line.span is not None
    assert other.span is not None
    phi = image.horizon.basis(line.span.below)
    px_per_m = image.horizon.px_per_m * line.span.below
    sigma_m, other_sigma_m = (each.curve.sigma(phi) / px_per_m for each in (line, other))
    offset_m = (line.curve.along(phi) - other.curve.along(phi)) / px_per_m
    known = np.maximum(sigma_m, other_sigma_m) < _CERTAIN_SIGMA_M
    shown, other_shown = (_shown(each, points, line.span.below) for each in (line, other))
    from_row = max(int(np.argmax(shown)), int(np.argmax(other_shown)))
    crossed = offset_m[from_row:][(known & (shown | other_shown))[from_row:]]
    if (crossed < -_CROSSING_M).any() and (crossed > _CROSSING_M).any():
        return _REPEATS
    there = shown & other_shown if (shown & other_shown).any() else shown
    there = there & (other_sigma_m < _CERTAIN_SIGMA_M)
    if not there.any() or np.abs(offset_m[there]).max() > _DOUBLE_M:
        return _APART
    abreast_m = float((line.span.length_m * line.span.painted) @ other.span.painted)
    abreast_m = min(abreast_m, line.paint_m, other.paint_m)
    is_double = abreast_m >= _LEAST_ABREAST_M and abs(np.median(offset_m[there])) > _ONE_LINE_M
    return _DOUBLES if is_double else _REPEATS


def _shown(line: Line, points: LinePoints, below: FloatArray) -> BoolArray:
    """Flags (T,) of the rows between the nearest and the farthest point of a line; at least one."""
    own = points.below[line.members]
    rows = np.arange(len(below))
    first, last = np.searchsorted(below, (own.min(), own.max()))
    return np.asarray((rows >= min(first, len(below) - 1)) & (rows <= last), dtype=np.bool_)


def draw(line: Line, points: LinePoints, image: LaneImage) -> LaneDetection | None:
    """A line's points in the image, near to far, with their standard deviations; None if fewer than two."""
    assert line.span is not None
    camera = image.camera
    below = line.span.below
    present = line.span.present
    along, sigma = _followed(points, line, image, below)
    if line.strand is not None and line.strand.span is not None:
        other = line.strand.span.present
        beside, beside_sigma = _followed(points, line.strand, image, below)
        share = other / np.maximum(present + other, 1e-9)
        along = along + share * (beside - along)
        sigma = sigma + share * (beside_sigma - sigma)
        present = np.maximum(present, other)
    rows = np.arange(len(below))
    drawn = np.flatnonzero(present > _EVEN)
    if not len(drawn):
        return None
    points_px = camera.distort(image.horizon.pinhole_px(along, below))
    own = points.below[line.members]
    kept = (rows >= drawn[0]) & (rows <= drawn[-1]) & camera.inside(points_px, -_DRAWN_STEP_PX)
    kept &= (sigma < _EXTENSION_SIGMA * camera.info.width) | ((below >= own.min()) & (below <= own.max()))
    if kept.sum() < 2:
        return None
    score = float(as_probability(np.array(line.log_odds)))
    return LaneDetection(LANE_BOUNDARY, score, points_px[kept][::-1], sigma_px=sigma[kept][::-1])


def _followed(
    points: LinePoints, line: Line, image: LaneImage, at: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Position of a line along the horizon and its sigma (N,), px, ``at`` (N,) px below it."""
    phi = image.horizon.basis(at)
    curve_sigma = line.curve.sigma(phi)
    along = line.curve.along(phi)
    members = line.members
    off = points.along[members] - line.curve.along(points.phi[members])
    near = np.maximum(1 - np.abs(at[:, None] - points.below[members]) / _SMOOTH_PX, 0)
    weight = near / (NEIGHBOURS * points.sigma_px[members] ** 2)
    own = 1 / (curve_sigma**2 + (_FREEDOM_M * image.horizon.px_per_m * at) ** 2)
    total = weight.sum(axis=1) + own
    return along + weight @ off / total, np.sqrt(1 / total)
