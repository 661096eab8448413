"""Where a solid line, or one of the two lines of a double one, ends towards the vehicle.

What is longer than any dash is a solid line and ends with its paint. Row by row, what the network says of
paint and of crossings makes it likelier that the line is still there or that it has ended: crossings alone
fade out so slowly beyond the end that they tell little. A dash is one of many, whatever it was taken for:
its line goes on in any case.
"""

from __future__ import annotations

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.lanes.curves import Horizon, basis
from v2hdm.detection.lanes.points import Line, LinePoints
from v2hdm.detection.markings.foreground import Foreground
from v2hdm.records import FloatArray, IntArray

_LONGEST_DASH_M = 6.5
_LEAST_GAP_M = 1.2
"""Paint of one piece has points nearer to each other than this."""

_EVEN_LOG_ODDS = -1.1
_NO_CROSSING = -3.0
"""Crossings surer than the first speak for a line, less sure ones against it; a row without any shows one
that is no surer than the second."""

_EVEN_PAINT = -1.0
_MOST_PAINT = 4.0
_PAINT_WEIGHT = 1.5
"""Paint surer than the first speaks for a line, by so much at most and so much more than crossings do."""

_HALF_WIDTH_M = 0.15
_HALF_WIDTH_OF_DOUBLE_M = 0.4
_HALF_STRAND_M = 0.06
"""The other strand may be no more than .2 m away."""

_LEAST_HALF_WIDTH_PX = 6.0
_ACROSS = np.linspace(-1.0, 1.0, 7)
"""Paint is looked for so far to either side of where the line is drawn, and at so many places."""

_LEAST_AGAINST = 10.0
"""So much must speak against what lies farther on. Rows err together: it is as much as two or three."""


def solid_end(
    points: LinePoints,
    line: Line,
    below: FloatArray,
    drawn_px: FloatArray,
    view: CameraView,
    horizon: Horizon,
    foreground: Foreground | None,
    row_step_px: float,
) -> float | None:
    """The row, px below the horizon, at which a solid line ends near the vehicle; None of any other line.

    Args:
        points: Those of the image.
        line: One of its lines.
        below: Rows (N,) from near to far, px below the horizon, on which it may be drawn.
        drawn_px: Where in the image that is (N, 2).
        view: The camera.
        horizon: Its horizon.
        foreground: What the network says of paint, if that is known.
        row_step_px: How far apart row anchors are, twice as far where half the resolution is looked at.
    """
    painted = _nearest_piece(points, line, view)
    if not len(painted) or float(np.hypot(*np.ptp(points.ground[painted], axis=0))) < _LONGEST_DASH_M:
        return None
    paint_ends = float(points.below[painted].max())
    beyond = np.flatnonzero((below > paint_ends) & view.inside(drawn_px, 0))[::-1]
    if not len(beyond):
        return paint_ends
    rows = below[beyond]
    reach_px = np.where(view.coarse(drawn_px[beyond, 1]), row_step_px, row_step_px / 2)
    speaks = _crossings(points, line, rows, reach_px) - _EVEN_LOG_ODDS
    if foreground is not None:
        half_m = _HALF_WIDTH_OF_DOUBLE_M if line.double else _HALF_WIDTH_M
        half_px = np.maximum(half_m * horizon.px_per_m * rows, _LEAST_HALF_WIDTH_PX)
        paint = _most_paint(foreground, drawn_px[beyond], half_px)
        speaks += _PAINT_WEIGHT * np.clip(paint - _EVEN_PAINT, -_MOST_PAINT, _MOST_PAINT)
    total = np.cumsum(speaks)
    carried = float(rows[np.argmax(total)]) if total.max() > 0 else paint_ends
    if max(total.max(), 0.0) - total[-1] < _LEAST_AGAINST:
        return max(carried, float(points.below[line.members].max()))
    return carried


def _nearest_piece(points: LinePoints, line: Line, view: CameraView) -> IntArray:
    """The points of the nearest piece of paint on a line, from near to far."""
    painted = line.certain[points.is_paint[line.certain]]
    range_m = view.range_m(points.ground[painted])
    order = np.argsort(range_m)
    gaps = np.flatnonzero(np.diff(range_m[order]) > _LEAST_GAP_M)
    return painted[order[: gaps[0] + 1 if len(gaps) else None]]


def _crossings(points: LinePoints, line: Line, rows: FloatArray, reach_px: FloatArray) -> FloatArray:
    """Log odds (N,) of the surest crossing of a line within ``reach_px`` (N,) of each of its rows."""
    own = line.members[~points.is_paint[line.members]]
    off = np.abs(rows[:, None] - points.below[own])
    odds = np.where(off <= reach_px[:, None], points.odds[own], _NO_CROSSING)
    return np.asarray(odds.max(axis=1, initial=_NO_CROSSING))


def _most_paint(foreground: Foreground, points_px: FloatArray, half_px: FloatArray) -> FloatArray:
    """Log odds (N,) of the surest paint within ``half_px`` (N,) to either side of points (N, 2)."""
    u = points_px[:, :1] + half_px[:, None] * _ACROSS
    places = np.stack([u, np.broadcast_to(points_px[:, 1:], u.shape)], axis=-1)
    return np.asarray(foreground.odds_at(places).max(axis=1))


def alone_from(
    line: Line, below: FloatArray, view: CameraView, horizon: Horizon, foreground: Foreground | None
) -> float | None:
    """The row, px below the horizon, from which on one strand of a double line goes on alone, if one does.

    It does where the image shows no paint on the other; ``below`` (N,) as for :func:`solid_end`.
    """
    strands = line.strands
    if strands is None or foreground is None:
        return None
    rows = below[(below > strands.shorter_to) & (below <= strands.longer_to)][::-1]
    px = view.distort(horizon.pinhole_px(strands.shorter.along(basis(rows)), rows))
    inside = view.inside(px, 0)
    rows, px = rows[inside], px[inside]
    if not len(rows):
        return None
    half_px = _HALF_STRAND_M * horizon.px_per_m * rows
    speaks = np.clip(_most_paint(foreground, px, half_px) - _EVEN_PAINT, -_MOST_PAINT, _MOST_PAINT)
    total = np.cumsum(speaks) * _PAINT_WEIGHT
    if max(total.max(), 0.0) - total[-1] < _LEAST_AGAINST:
        return None
    return float(rows[np.argmax(total)]) if total.max() > 0 else strands.shorter_to
