"""The stripe that most of a slim outline is of, whatever sticks to it here and there.

A fleck of sun on the side of a dash, a seam that goes on from its end: the hull of what the network takes for
paint spans them all, and no rectangle around it is the dash. But most of its length shows two straight sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.geometry.ipm import apply_homography
from v2hdm.geometry.quadrilateral import order_corners
from v2hdm.records import FloatArray

_BINS = 24
_LEAST_BINS = 9
_TOLERANCE_PX, _TOLERANCE_SHARE = 1.5, 0.2
"""A side is seen where the outline comes as near to it as that, or as this share of the stripe's width."""

_ACROSS_M = 0.05
_PAIRS = np.argwhere(~np.eye(_BINS, dtype=np.bool_)).T
"""All pairs of bins, by the first."""


def stripe_of(outline_pinhole_px: FloatArray, view: CameraView) -> tuple[FloatArray, float] | None:
    """Corners (4, 2), pinhole px, of the stripe in an outline (N, 2), and how much of it shows its sides.

    Its ends are square on the ground. None where there is none.
    """
    middle = outline_pinhole_px.mean(axis=0)
    points = outline_pinhole_px - middle
    longest = np.linalg.eigh(np.cov(points.T))[1][:, 1]
    # The first axis is that of all points; across the stripe's own its ends are no longer aslant.
    stripe = _Stripe.along(longest, points)
    stripe = stripe and _Stripe.along(stripe.axis, points)
    if stripe is None:
        return None
    ends = np.array([stripe.own[:, 0].min(), stripe.own[:, 0].max()])
    leans = _leans(stripe.points(np.column_stack([ends, stripe.centre.at(ends)])) + middle, stripe, view)
    if leans is None:
        return None
    offset = stripe.own[:, 1] - stripe.centre.at(stripe.own[:, 0])
    square = stripe.own[:, 0] - leans[:, None] * offset
    reach = (square[0].min(), leans[0]), (square[1].max(), leans[1])
    corners = np.array([stripe.corner(end, lean, side) for end, lean in reach for side in stripe.sides])
    quad = order_corners(stripe.points(corners) + middle)
    return (quad, stripe.seen) if np.isfinite(quad).all() else None


@dataclass(frozen=True)
class _Line:
    """Its offset across the axis at the axis' origin, and its slope."""

    offset: float
    slope: float

    @classmethod
    def about(cls, x: FloatArray, y: FloatArray) -> _Line:
        """The line that the larger half of points lie on: repeated medians (Siegel, Biometrika 69, 1982)."""
        first, second = _PAIRS[:, _PAIRS.max(axis=0) < len(x)]
        slopes = (y[first] - y[second]) / (x[first] - x[second])
        slope = float(np.median(np.median(slopes.reshape(len(x), -1), axis=1)))
        return cls(float(np.median(y - slope * x)), slope)

    def at(self, along: FloatArray) -> FloatArray:
        """Offsets across at places along."""
        return self.offset + self.slope * along


@dataclass(frozen=True)
class _Stripe:
    """Two lines along the ``axes`` (2, 2), and points ``own`` (K, 2), along and across, between them.

    ``seen`` is the share of its length in which the outline lies on both.
    """

    axes: FloatArray
    sides: tuple[_Line, _Line]
    own: FloatArray
    seen: float

    @classmethod
    def along(cls, axis: FloatArray, points: FloatArray) -> _Stripe | None:
        """The one that most of the points (N, 2) are of, about along the axis (2,); None for none."""
        axes = np.array([axis, [-axis[1], axis[0]]])
        along, across = axes @ points.T
        at, low, high = _extents(along, across)
        if len(at) < _LEAST_BINS:
            return None
        sides = _Line.about(at, low), _Line.about(at, high)
        width = sides[1].at(at) - sides[0].at(at)
        tolerance = np.maximum(_TOLERANCE_PX, _TOLERANCE_SHARE * width)
        seen = (np.abs(low - sides[0].at(at)) < tolerance) & (np.abs(high - sides[1].at(at)) < tolerance)
        spare = float(np.median(tolerance))
        own = (across > sides[0].at(along) - spare) & (across < sides[1].at(along) + spare)
        if not width.min() > 0 or not own.any():
            return None
        return cls(axes, sides, np.column_stack([along, across])[own], float(seen.mean()))

    @property
    def centre(self) -> _Line:
        """The line half way between its sides."""
        first, second = self.sides
        return _Line((first.offset + second.offset) / 2, (first.slope + second.slope) / 2)

    @property
    def axis(self) -> FloatArray:
        """Unit vector (2,) along its centre."""
        way = self.axes[0] + self.centre.slope * self.axes[1]
        return np.asarray(way / np.linalg.norm(way))

    def points(self, places: FloatArray) -> FloatArray:
        """Points (N, 2) at places (N, 2) along and across."""
        return places @ self.axes

    def corner(self, end: float, lean: float, side: _Line) -> tuple[float, float]:
        """Where a line that crosses the centre at ``end`` and leans by so much meets a side."""
        centre = self.centre
        along = (end + lean * (side.offset - centre.offset)) / (1 - lean * (side.slope - centre.slope))
        return along, side.offset + side.slope * along


def _extents(along: FloatArray, across: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Middles of the bins (B,) along an outline, and how far it reaches across the axis there, low and high.

    The first and the last bin, which ends may cross aslant, are left out.
    """
    first, last = along.min(), along.max()
    step = max(float(last - first), 1e-9) / _BINS
    place = np.minimum((along - first) / step, _BINS - 1).astype(np.intp)
    order = np.argsort(place, kind="stable")
    held, begin = np.unique(place[order], return_index=True)
    low, high = (extreme.reduceat(across[order], begin) for extreme in (np.minimum, np.maximum))
    inner = (held > 0) & (held < _BINS - 1)
    return (first + (held[inner] + 0.5) * step), low[inner], high[inner]


def _leans(ends_px: FloatArray, stripe: _Stripe, view: CameraView) -> FloatArray | None:
    """How far (2,) a line square to the stripe on the ground runs along the axis per px across, at its ends.

    None where they show no ground.
    """
    ends = view.ground(ends_px)
    way = ends[1] - ends[0]
    length = float(np.hypot(*way))
    if not length > 0:
        return None
    square = np.array([-way[1], way[0]]) / length * _ACROSS_M
    beside_px = apply_homography(view.pinhole_px_from_vehicle, ends + square)
    along, across = stripe.axes @ (beside_px - ends_px).T
    with np.errstate(divide="ignore", invalid="ignore"):
        leans = along / across
    return leans if np.isfinite(leans).all() else None
