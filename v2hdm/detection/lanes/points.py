"""The points of an image that lines of lanes may run through, and lines made of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.lanes.curves import Curve, Evidence, Horizon, Prior, basis
from v2hdm.records import BoolArray, FloatArray, IntArray

NEIGHBOURS = 3.0
"""Points of one line err together: that many tell as much as one."""

_MODEL_SIGMA_M = 0.02
"""By how much painted lines leave the curve."""


@dataclass(frozen=True)
class LinePoints:
    """N points of an image that lines may run through.

    ``points_px`` (N, 2) recorded px; ``along`` and ``below`` (N,) their place about the horizon and ``phi``
    (N, 3) the basis of curves there;
    ``sigma_px`` (N,) of each along the horizon; ``odds`` (N,) log odds; ``ground`` (N, 2), vehicle frame;
    ``is_paint`` (N,): on the centre line of a piece of paint, not a crossing of a row anchor; ``is_solid``
    (N,): and that piece is no dash.
    """

    points_px: FloatArray
    along: FloatArray
    below: FloatArray
    phi: FloatArray
    sigma_px: FloatArray
    odds: FloatArray
    ground: FloatArray
    is_paint: BoolArray
    is_solid: BoolArray

    @classmethod
    def of(
        cls, view: CameraView, horizon: Horizon, points_px: FloatArray, odds: FloatArray, sigma_px: FloatArray
    ) -> LinePoints:
        """Crossings of row anchors (N, 2) with standard deviations (N,)."""
        pinhole_px = view.undistort(points_px)
        along, below = horizon.coordinates(pinhole_px)
        sigma = np.hypot(sigma_px, _MODEL_SIGMA_M * horizon.px_per_m * np.maximum(below, 0))
        none = np.zeros(len(odds), dtype=np.bool_)
        return cls(points_px, along, below, basis(below), sigma, odds, view.ground(pinhole_px), none, none)

    def where(self, kept: BoolArray) -> LinePoints:
        """Some of the points."""
        return LinePoints(**{name: value[kept] for name, value in vars(self).items()})

    def slopes(self, groups: list[IntArray]) -> FloatArray:
        """Px along the horizon per px down (N,) of groups of points that are roughly a line each."""
        members, ends = np.concatenate(groups), np.cumsum([len(group) for group in groups])
        count, begins = np.diff(ends, prepend=0), [0, *ends[:-1]]
        along, below = self.along[members], self.below[members]
        down = below - np.repeat(np.add.reduceat(below, begins) / count, count)
        return np.asarray(
            np.add.reduceat(down * along, begins) / np.maximum(np.add.reduceat(down**2, begins), 1)
        )

    def evidence(self, horizon: Horizon, groups: list[IntArray], slopes: FloatArray) -> Evidence:
        """What each of N groups of points, on lines of such ``slopes`` (N,), says of its line."""
        members, count = np.concatenate(groups), [len(group) for group in groups]
        sigma = self.sigma_px[members] * np.repeat(np.hypot(1, slopes), count) * np.sqrt(NEIGHBOURS)
        u = self.along[members] - horizon.centre_px
        return Evidence.of(self.phi[members], u, sigma, np.cumsum(count).tolist())


@dataclass(frozen=True)
class Strands:
    """The two lines of a double one, one of which may end before the other towards the vehicle.

    Each is a curve and the row, px below the horizon, down to which it is seen: infinite for dashes.
    """

    longer: Curve
    longer_to: float
    shorter: Curve
    shorter_to: float


@dataclass(frozen=True)
class Line:
    """A line: its curve and the indices of the points that ``certain``ly and ``perhaps`` are on it.

    ``prior`` is what the curve was drawn with, ``log_ratio`` how much likelier the line is along the road
    than anyhow; there is ``paint_m`` of paint on it. ``double`` lines are the middle of two, which are its
    ``strands`` where they are not seen equally far.
    """

    curve: Curve
    certain: IntArray
    perhaps: IntArray
    paint_m: float
    prior: Prior
    log_ratio: float
    log_odds: float = 0.0
    double: bool = False
    strands: Strands | None = None

    @property
    def members(self) -> IntArray:
        """All its points."""
        return np.concatenate([self.certain, self.perhaps])

    @classmethod
    def through(
        cls,
        certain: IntArray,
        evidence: Evidence,
        horizon: Horizon,
        prior: Prior,
        paint_m: float,
        log_ratio: float,
    ) -> Line:
        """The line that a group of points, of such evidence, suggests."""
        none = np.empty(0, dtype=np.int64)
        return cls(evidence.curve(prior, horizon.centre_px), certain, none, paint_m, prior, log_ratio)
