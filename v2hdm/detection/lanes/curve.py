"""Lines of lanes as curves in the image: what a circular arc on flat ground looks like.

Below the horizon such an arc is u = a + b v + c / v, u along the horizon and v the distance below it, in
pinhole px: the image of a straight line (a, b) and, to second order, of its curvature (c); see A. Guiducci,
"Parametric model of the perspective projection of a road with applications to lane keeping and 3D road
reconstruction", CVIU 73 (1999). It is linear in a, b and c: what points say of it adds up, and whether two
groups of points are one line has a closed answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.records import BoolArray, FloatArray, IntArray

NEIGHBOURS = 3.0
"""Points of one line err together: that many tell as much as one."""

_MODEL_SIGMA_M = 0.02
"""By how much painted lines leave the curve."""

_LEAST_BELOW_PX = 4.0
"""Nearer to the horizon than this nothing is known of the ground."""

_UNIT_PX = 100.0
"""Unit of v within the basis, which keeps a, b and c of a size."""

_PROBE_PX = 50.0


class Horizon:
    """Pinhole pixels of one camera in axes along and below its horizon.

    ``centre_px`` is where along the horizon the camera looks. ``px_per_m`` is how many px along the horizon a
    metre of ground is wide at one px below it; it grows in proportion.
    """

    def __init__(self, view: CameraView):
        row = view.vehicle_from_pinhole_px[2]
        lowest = np.array([[(view.info.width - 1) / 2, view.info.height - 1.0]])
        sign = np.sign(float(row[:2] @ lowest[0] + row[2]))
        sign = sign if np.isfinite(view.ground(lowest)).all() else -sign
        size = max(float(np.linalg.norm(row[:2])), 1e-12)
        self._down = sign * row[:2] / size
        self._along = np.array([self._down[1], -self._down[0]])
        self._shift = float(sign * row[2] / size)
        intrinsic = view.info.intrinsic
        self.centre_px = float(self.coordinates(intrinsic[None, :2, 2])[0][0])
        beside = self.pinhole_px(self.centre_px + np.array([-0.5, 0.5]), np.full(2, _PROBE_PX))
        ground = view.ground(beside)
        probe_px_per_m = 1.0 / max(float(np.linalg.norm(ground[1] - ground[0])), 1e-9)
        self.px_per_m = probe_px_per_m / _PROBE_PX
        range_m = float(view.range_m(ground.mean(axis=0)))
        self._units = np.array(
            [
                float(intrinsic[0, 0]),
                self.px_per_m * _UNIT_PX,
                0.5 * range_m**2 * probe_px_per_m * _PROBE_PX / _UNIT_PX,
            ]
        )

    def parameters(self, direction_rad: float, beside_m: float, curvature: float) -> FloatArray:
        """What a, b and c (3,) are for a line's direction, place beside the camera and curvature, 1/m.

        To first order, about the camera's own direction.
        """
        return self._units * (direction_rad, beside_m, curvature)

    def depth_m(self, below: FloatArray) -> FloatArray:
        """How far ahead of the camera the ground is (N,), m, at distances (N,) below the horizon, px."""
        return np.asarray(self._units[0] / (self.px_per_m * np.maximum(below, _LEAST_BELOW_PX)))

    def below_px(self, depth_m: float) -> float:
        """How far below the horizon, px, the ground at a depth is: the inverse of :meth:`depth_m`."""
        return float(self._units[0] / (self.px_per_m * depth_m))

    def coordinates(self, pinhole_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Position along (N,) and below (N,) the horizon, px, of pinhole pixels (N, 2)."""
        return pinhole_px @ self._along, pinhole_px @ self._down + self._shift

    def pinhole_px(self, along: FloatArray, below: FloatArray) -> FloatArray:
        """The pinhole pixels (N, 2) of :meth:`coordinates`."""
        return np.asarray(along[:, None] * self._along + (below - self._shift)[:, None] * self._down)


@dataclass(frozen=True)
class Prior:
    """What is known of a line before it is seen: ``mean`` (3,) and ``information`` (3, 3) of a, b and c.

    Here and in :class:`Evidence` a counts from the horizon's ``centre_px``. Several at once are (P, 1, 3) and
    (P, 1, 3, 3).
    """

    mean: FloatArray
    information: FloatArray

    @classmethod
    def several(cls, priors: Sequence[Prior]) -> Prior:
        """P of them at once."""
        mean, information = (np.array([getattr(p, name) for p in priors]) for name in ("mean", "information"))
        return cls(mean[:, None], information[:, None])

    @cached_property
    def log_determinant(self) -> FloatArray:
        """That of the information: (), of several (P, 1)."""
        return np.asarray(np.linalg.slogdet(self.information)[1])


@dataclass(frozen=True)
class Evidence:
    """What N groups of points say of their lines, each summed up.

    ``information`` (N, 3, 3), ``moment`` (N, 3) and ``square`` (N,) are the weighted sums of the outer
    products of the basis, of basis times u, and of u squared. That of the same line adds.
    """

    information: FloatArray
    moment: FloatArray
    square: FloatArray

    @classmethod
    def of(cls, phi: FloatArray, u: FloatArray, sigma: FloatArray, ends: Sequence[int]) -> Evidence:
        """Groups of points, one after the other.

        Args:
            phi: :func:`basis` of the points (M, 3).
            u: Their place along the horizon from its ``centre_px``, px (M,).
            sigma: Standard deviations of that (M,).
            ends: Where in these arrays each group ends, N indices; none is empty.
        """
        weighted = phi * (sigma**-2.0)[:, None]
        terms = np.column_stack(
            [(phi[:, :, None] * weighted[:, None, :]).reshape(-1, 9), weighted * u[:, None], (u / sigma) ** 2]
        )
        sums = np.add.reduceat(terms, [0, *ends[:-1]], axis=0)
        return cls(sums[:, :9].reshape(-1, 3, 3), sums[:, 9:12], sums[:, 12])

    def __getitem__(self, index: np.ndarray | slice) -> Evidence:
        return Evidence(self.information[index], self.moment[index], self.square[index])

    def __add__(self, other: Evidence) -> Evidence:
        return Evidence(
            self.information + other.information, self.moment + other.moment, self.square + other.square
        )

    def log_evidence(self, prior: Prior) -> FloatArray:
        """Log probability (N,) of each group as one line of that prior, up to a constant per point.

        Of several priors it is (P, N).
        """
        moment = self.moment - (self.information @ prior.mean[..., None])[..., 0]
        square = self.square - ((self.moment + moment) * prior.mean).sum(axis=-1)
        gain, log_determinant = _completed_square(self.information + prior.information, moment)
        return np.asarray(-0.5 * (square - gain + log_determinant - prior.log_determinant))

    def curve(self, prior: Prior, centre_px: float) -> Curve:
        """The line that the first group's points and the prior suggest."""
        return self[:1].curves([prior], centre_px)[0]

    def curves(self, priors: Sequence[Prior], centre_px: float) -> list[Curve]:
        """The lines that each of N groups of points and its prior suggest."""
        information = np.array([prior.information for prior in priors])
        expected = np.array([prior.mean for prior in priors])
        covariance = np.linalg.inv(self.information + information)
        moment = self.moment + (information @ expected[..., None])[..., 0]
        mean = (covariance @ moment[..., None])[..., 0] + (centre_px, 0.0, 0.0)
        return [Curve(*curve) for curve in zip(mean, covariance, strict=True)]


@dataclass(frozen=True)
class Curve:
    """A line: ``parameters`` (3,) a, b, c and their ``covariance`` (3, 3)."""

    parameters: FloatArray
    covariance: FloatArray

    def along(self, phi: FloatArray) -> FloatArray:
        """Where the line is along the horizon (N,), px, where the :func:`basis` is ``phi`` (N, 3)."""
        return np.asarray(phi @ self.parameters)

    def sigma(self, phi: FloatArray) -> FloatArray:
        """Standard deviation (N,) of :meth:`along`, px."""
        return np.asarray(np.sqrt(((phi @ self.covariance) * phi).sum(axis=1)))


def basis(below: FloatArray) -> FloatArray:
    """What (a, b, c) are multiplied by (N, 3) at distances (N,) below the horizon, px."""
    v = np.maximum(below, _LEAST_BELOW_PX) / _UNIT_PX
    phi = np.ones((len(v), 3))
    phi[:, 1], phi[:, 2] = v, 1.0 / v
    return phi


def _completed_square(information: FloatArray, moment: FloatArray) -> tuple[FloatArray, FloatArray]:
    """For positive matrices A (..., 3, 3) and vectors m (..., 3): m' inv(A) m (...) and log det A (...).

    By Cholesky written out: LAPACK takes ten times as long for as many small matrices.
    """
    pivot0, below10, below20 = (information[..., k, 0] for k in range(3))
    l10, l20 = below10 / pivot0, below20 / pivot0
    pivot1 = information[..., 1, 1] - l10 * below10
    l21 = (information[..., 2, 1] - l20 * below10) / pivot1
    pivot2 = information[..., 2, 2] - l20 * below20 - l21**2 * pivot1
    m0 = moment[..., 0]
    m1 = moment[..., 1] - l10 * m0
    m2 = moment[..., 2] - l20 * m0 - l21 * m1
    return m0**2 / pivot0 + m1**2 / pivot1 + m2**2 / pivot2, np.log(pivot0 * pivot1 * pivot2)


@dataclass(frozen=True)
class LinePoints:
    """N points of an image that lines may run through.

    ``points_px`` (N, 2) recorded px; ``along`` and ``below`` (N,) their place about the horizon and ``phi``
    (N, 3) the basis of curves there; ``sigma_px`` (N,) of each along the horizon; ``odds`` (N,) log odds;
    ``ground`` (N, 2), vehicle frame; ``is_paint`` (N,): on the centre line of a piece of paint, not a
    crossing of a row anchor.
    """

    points_px: FloatArray
    along: FloatArray
    below: FloatArray
    phi: FloatArray
    sigma_px: FloatArray
    odds: FloatArray
    ground: FloatArray
    is_paint: BoolArray

    @classmethod
    def of(
        cls, view: CameraView, horizon: Horizon, points_px: FloatArray, odds: FloatArray, sigma_px: FloatArray
    ) -> LinePoints:
        """Crossings of row anchors (N, 2) with standard deviations (N,)."""
        pinhole_px = view.undistort(points_px)
        along, below = horizon.coordinates(pinhole_px)
        sigma = np.hypot(sigma_px, _MODEL_SIGMA_M * horizon.px_per_m * np.maximum(below, 0))
        none = np.zeros(len(odds), dtype=np.bool_)
        return cls(points_px, along, below, basis(below), sigma, odds, view.ground(pinhole_px), none)

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
class Span:
    """A line on T rows of the image, ``below`` (T,) px below the horizon, from far to near.

    ``present`` and ``painted`` (T,) are probabilities that it has not ended and that it shows paint there,
    ``length_m`` (T,) is the ground that each row stands for and ``log_likelihood`` that of the line over that
    of ground without one.
    """

    below: FloatArray
    present: FloatArray
    painted: FloatArray
    length_m: FloatArray
    log_likelihood: float


@dataclass(frozen=True)
class Line:
    """A line: its curve and the indices of its ``members`` among the points.

    ``paint_m`` is the paint on it, ``log_ratio`` that of its probabilities along the road and anyhow, and
    ``strand`` the other line of a double one.
    """

    curve: Curve
    members: IntArray
    paint_m: float
    log_ratio: float
    log_odds: float = 0.0
    span: Span | None = None
    strand: Line | None = None
