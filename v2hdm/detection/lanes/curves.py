"""Lines of lanes as curves in the image: projections of circular arcs on flat ground.

Below the horizon such an arc is u = a + b v + c / v, u along the horizon and v the distance below it, in
pinhole px: the image of a straight line (a, b) and, to second order, of its curvature (c); see A. Guiducci,
"Parametric model of the perspective projection of a road with applications to lane keeping and 3D road
reconstruction", CVIU 73 (1999). It is linear in a, b and c: evidence of points adds up, and the likelihood of
two groups of points being one line has a closed form. Lines along one road share a, their vanishing point,
and c.

Groups of points, chains and pieces of paint, are joined while they are more likely one line than two, the
likeliest pair first (Bayesian hierarchical clustering).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from v2hdm.detection.camera import Horizon, RoadCamera
from v2hdm.detection.network import AnchorRow, NetworkOutput
from v2hdm.records import BoolArray, FloatArray, IntArray, LaneDetection

NEIGHBOURS = 3.0  # correlated points of a line that count as one independent point
_MODEL_SIGMA_M = 0.02  # sigma of painted lines about the curve


@dataclass(frozen=True)
class LaneImage:
    """One image in which lines of lanes are sought."""

    camera: RoadCamera
    # anchors, near to far, ``row_step_px`` apart, twice as far at half the resolution
    rows: Sequence[AnchorRow]
    paint: Sequence[LaneDetection] = ()  # centre lines of its lane paint, points ``paint_step_m`` apart
    output: NetworkOutput | None = None  # the network's, if known
    paint_step_m: float = 0.5
    row_step_px: float = 8.0
    score: Mapping[str, tuple[FloatArray, float]] | None = None  # weights and biases, if not the shipped ones

    @property
    def horizon(self) -> Horizon:
        """The camera's horizon."""
        return self.camera.horizon

    def places_px(self, along: FloatArray, below: FloatArray) -> FloatArray:
        """Recorded px (..., 2) of places along and below the horizon, px, which broadcast."""
        rows = np.broadcast_to(below, along.shape)
        pinhole_px = self.horizon.pinhole_px(along.ravel(), rows.ravel())
        return self.camera.distort(pinhole_px).reshape((*along.shape, 2))


@dataclass(frozen=True)
class Prior:
    """Prior of a line's a (from ``centre_px``), b and c; of P lines at once (P, 1, ...)."""

    mean: FloatArray  # (3,)
    information: FloatArray  # (3, 3)

    @classmethod
    def several(cls, priors: Sequence[Prior]) -> Prior:
        """P priors at once."""
        mean = np.array([prior.mean for prior in priors])
        information = np.array([prior.information for prior in priors])
        return cls(mean[:, None], information[:, None])

    @cached_property
    def log_determinant(self) -> FloatArray:
        """Log determinant of the information: (), of P priors (P, 1)."""
        return np.asarray(np.linalg.slogdet(self.information)[1])


@dataclass(frozen=True)
class Evidence:
    """Evidence of N groups of points for their lines, as weighted sums: for the same line it adds up."""

    information: FloatArray  # (N, 3, 3) of outer products of the basis
    moment: FloatArray  # (N, 3) of basis times u
    square: FloatArray  # (N,) of u squared

    @classmethod
    def of(cls, phi: FloatArray, u: FloatArray, sigma: FloatArray, ends: Sequence[int]) -> Evidence:
        """Evidence of groups of points, one after the other; group n, not empty, ends at ``ends[n]``.

        ``phi`` (M, 3) is the basis at the points, ``u`` (M,) their position along the horizon from its centre
        with deviations ``sigma`` (M,), px.
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
        """Log probability (N,), of P priors (P, N), of each group as one line, up to a constant per point."""
        moment = self.moment - (self.information @ prior.mean[..., None])[..., 0]
        square = self.square - ((self.moment + moment) * prior.mean).sum(axis=-1)
        gain, log_determinant = _completed_square(self.information + prior.information, moment)
        return np.asarray(-0.5 * (square - gain + log_determinant - prior.log_determinant))

    def curves(self, priors: Sequence[Prior], centre_px: float) -> list[Curve]:
        """The most likely line of each of N groups of points under its prior."""
        information = np.array([prior.information for prior in priors])
        expected = np.array([prior.mean for prior in priors])
        covariance = np.linalg.inv(self.information + information)
        moment = self.moment + (information @ expected[..., None])[..., 0]
        mean = (covariance @ moment[..., None])[..., 0] + (centre_px, 0.0, 0.0)
        return [Curve(mean[k], covariance[k]) for k in range(len(mean))]


@dataclass(frozen=True)
class Curve:
    """A line: ``parameters`` (3,) a, b, c and their ``covariance`` (3, 3)."""

    parameters: FloatArray
    covariance: FloatArray

    def along(self, phi: FloatArray) -> FloatArray:
        """Position (N,) along the horizon, px, for :meth:`Horizon.basis` ``phi`` (N, 3)."""
        return np.asarray(phi @ self.parameters)

    def sigma(self, phi: FloatArray) -> FloatArray:
        """Standard deviation (N,) of :meth:`along`, px."""
        return np.asarray(np.sqrt(((phi @ self.covariance) * phi).sum(axis=1)))


def _completed_square(information: FloatArray, moment: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Quadratic form m' inv(A) m and log det A of A (..., 3, 3), m (..., 3): ten times as fast as LAPACK."""
    pivot0, below10, below20 = (information[..., k, 0] for k in range(3))
    l10 = below10 / pivot0
    l20 = below20 / pivot0
    pivot1 = information[..., 1, 1] - l10 * below10
    l21 = (information[..., 2, 1] - l20 * below10) / pivot1
    pivot2 = information[..., 2, 2] - l20 * below20 - l21**2 * pivot1
    m0 = moment[..., 0]
    m1 = moment[..., 1] - l10 * m0
    m2 = moment[..., 2] - l20 * m0 - l21 * m1
    return m0**2 / pivot0 + m1**2 / pivot1 + m2**2 / pivot2, np.log(pivot0 * pivot1 * pivot2)


@dataclass(frozen=True)
class LinePoints:
    """N points of an image on possible lines."""

    points_px: FloatArray  # (N, 2) recorded px
    along: FloatArray  # (N,) px along the horizon
    below: FloatArray  # (N,) px below it
    phi: FloatArray  # (N, 3) basis of curves
    sigma_px: FloatArray  # (N,) along the horizon
    odds: FloatArray  # (N,) log odds
    ground: FloatArray  # (N, 2), vehicle frame
    is_paint: BoolArray  # (N,) on the centre line of a piece of paint, not a crossing of a row anchor

    @classmethod
    def of(
        cls, image: LaneImage, points_px: FloatArray, odds: FloatArray, sigma_px: FloatArray, *, paint: bool
    ) -> LinePoints:
        """Points (N, 2) with standard deviations (N,): of ``paint``, or crossings of row anchors."""
        horizon = image.horizon
        pinhole_px = image.camera.undistort(points_px)
        along, below = horizon.coordinates(pinhole_px)
        sigma = np.hypot(sigma_px, _MODEL_SIGMA_M * horizon.px_per_m * np.maximum(below, 0))
        ground = image.camera.ground(pinhole_px)
        is_paint = np.full(len(odds), paint)
        return cls(points_px, along, below, horizon.basis(below), sigma, odds, ground, is_paint)

    @classmethod
    def joined(cls, parts: Sequence[LinePoints]) -> LinePoints:
        """The points of all ``parts``, in order."""
        names = vars(parts[0])
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})

    def where(self, is_chosen: BoolArray) -> LinePoints:
        """Some of the points, by a mask (N,)."""
        return LinePoints(**{name: value[is_chosen] for name, value in vars(self).items()})

    def slopes(self, groups: list[IntArray]) -> FloatArray:
        """Px along the horizon per px down (N,) of groups of points, roughly one line each."""
        members = np.concatenate(groups)
        ends = np.cumsum([len(group) for group in groups])
        count = np.diff(ends, prepend=0)
        begins = [0, *ends[:-1]]
        along = self.along[members]
        below = self.below[members]
        down = below - np.repeat(np.add.reduceat(below, begins) / count, count)
        squared = np.add.reduceat(down**2, begins)
        return np.asarray(np.add.reduceat(down * along, begins) / np.maximum(squared, 1))

    def evidence(self, horizon: Horizon, groups: list[IntArray]) -> Evidence:
        """Evidence of N groups of points, roughly one line each."""
        members = np.concatenate(groups)
        count = [len(group) for group in groups]
        across = np.hypot(1, self.slopes(groups))
        sigma = self.sigma_px[members] * np.repeat(across, count) * np.sqrt(NEIGHBOURS)
        u = self.along[members] - horizon.centre_px
        return Evidence.of(self.phi[members], u, sigma, np.cumsum(count).tolist())


@dataclass(frozen=True)
class Span:
    """A line on T rows of the image, from far to near."""

    below: FloatArray  # (T,) px below the horizon
    present: FloatArray  # (T,) probability that it has not ended
    painted: FloatArray  # (T,) probability that it shows paint
    length_m: FloatArray  # (T,) ground per row
    log_likelihood: float  # relative to ground without a line


@dataclass(frozen=True)
class Line:
    """A line through points of an image."""

    curve: Curve
    members: IntArray  # indices of its points
    paint_m: float  # length of the paint on it
    log_ratio: float  # log likelihood ratio of a line along the road to a free one
    log_odds: float = 0.0
    span: Span | None = None
    strand: Line | None = None  # the other line of a double line


_FREE_SIGMAS = (0.5, 8.0, 0.008)
"""Sigmas of a free line: direction about the camera's, rad, offset from it, m, and curvature, 1/m."""

_PARALLEL_SIGMAS = (0.012, 0.0, 0.001)
"""Sigmas of one road's lines about each other: direction, rad, offset, m, and curvature, 1/m.

An error of half a degree in the camera's pitch turns lines 2 m to the side of a low camera as much.
"""

_SHARE = 0.85  # fraction of lines along the road; kerbs and strokes of letters need not be

# Factors on a prior's information when a line is drawn: it tells which points are one line, not where.
_FREE_FACTORS = np.diag([0.04, 0.04, 1.0])  # of a free line
_ALONG_FACTORS = np.array([[1.0, 0.0, 1.0], [0.0, 0.04, 0.0], [1.0, 0.0, 1.0]])  # of a line along the road

_CANDIDATES = 4  # best known groups that are tried as the road's direction
_SHARED = [0, 2]  # places of a and c, which lines along one road share, among a line's parameters
_SHARED_BLOCK = np.ix_(_SHARED, _SHARED)


@dataclass(frozen=True)
class Road:
    """A road: the priors of lines ``along`` it and of ``free`` ones."""

    along: Prior
    free: Prior

    @cached_property
    def _both(self) -> Prior:
        return Prior.several([self.along, self.free])

    def weigh(self, evidence: Evidence) -> tuple[FloatArray, FloatArray]:
        """Log probability (N,) of each group as one line, and log likelihood ratio (N,) of the road's.

        The first is up to a constant per point; the second is without prior odds.
        """
        along, free = evidence.log_evidence(self._both)
        return np.logaddexp(along + np.log(_SHARE), free + np.log1p(-_SHARE)), along - free

    def drawn_by(self, log_ratio: float) -> Prior:
        """The prior under which to draw a line with this log likelihood ratio of :meth:`weigh`."""
        is_along = log_ratio + np.log(_SHARE) > np.log1p(-_SHARE)
        prior = self.along if is_along else self.free
        factors = _ALONG_FACTORS if is_along else _FREE_FACTORS
        return Prior(prior.mean, prior.information * factors)


def find_road(evidence: Evidence, horizon: Horizon) -> Road:
    """The road on which most of N groups of points, roughly one line each, agree."""
    free = Prior(np.zeros(3), np.diag(horizon.parameters(_FREE_SIGMAS) ** -2.0))
    covariance = np.linalg.inv(evidence.information + free.information)
    mean = np.einsum("nij,nj->ni", covariance, evidence.moment)[:, _SHARED]
    spread = np.diag(horizon.parameters(_PARALLEL_SIGMAS)[_SHARED] ** 2)
    # Covariance of the road about each line.
    doubt = covariance[:, [[0], [2]], _SHARED] + spread
    certain = np.argsort((np.diagonal(doubt, axis1=1, axis2=2) / np.diag(spread)).sum(axis=1))[:_CANDIDATES]
    candidates = [_along(mean[k], doubt[k], free) for k in certain]
    *along, alone = evidence.log_evidence(Prior.several([*candidates, free]))
    gains = np.array(along) - alone
    agreement = np.logaddexp(np.log(_SHARE) + gains, np.log1p(-_SHARE)).sum(axis=1)
    best = gains[agreement.argmax()]
    # The mean over all lines, each weighted by its probability of running along the road.
    weight = 1 / (1 + (1 - _SHARE) / _SHARE * np.exp(-np.clip(best, -50, 50)))
    weighted = np.linalg.inv(doubt) * weight[:, None, None]
    shared = np.linalg.inv(weighted.sum(axis=0) + free.information[_SHARED_BLOCK])
    along_prior = _along(shared @ np.einsum("nij,nj->i", weighted, mean), shared + spread, free)
    return Road(along_prior, free)


def _along(shared: FloatArray, covariance: FloatArray, free: Prior) -> Prior:
    """Prior of lines with a and c (2,), of this covariance (2, 2), at any offset from the camera."""
    information = free.information.copy()
    information[_SHARED_BLOCK] = np.linalg.inv(covariance)
    return Prior(np.array([shared[0], 0.0, shared[1]]), information)


def find_lines(points: LinePoints, groups: list[IntArray], image: LaneImage) -> list[Line]:
    """The lines through ``groups`` of points, those of one line joined."""
    horizon = image.horizon
    if not groups:
        return []
    evidence = points.evidence(horizon, groups)
    road = find_road(evidence, horizon)
    groups = _join(evidence, groups, road)
    evidence = points.evidence(horizon, groups)
    along = road.weigh(evidence)[1].tolist()
    priors = [road.drawn_by(log_ratio) for log_ratio in along]
    curves = evidence.curves(priors, horizon.centre_px)
    paint_m = [image.paint_step_m * float(points.is_paint[group].sum()) for group in groups]
    return [Line(curves[k], groups[k], paint_m[k], along[k]) for k in range(len(groups))]


def _join(evidence: Evidence, groups: list[IntArray], road: Road) -> list[IntArray]:
    """The groups of points, those joined that are more likely one line than two."""
    groups = list(groups)
    alone = road.weigh(evidence)[0]
    count = len(groups)
    first, second = np.triu_indices(count, 1)
    gain = np.full((count, count), -np.inf)
    gain[first, second] = road.weigh(evidence[first] + evidence[second])[0] - (alone[first] + alone[second])
    left = np.ones(count, dtype=np.bool_)
    while left.sum() > 1:
        a, b = divmod(int(np.argmax(gain)), count)
        if not gain[a, b] > 0:
            break
        groups[a] = np.concatenate([groups[a], groups[b]])
        for total in (evidence.information, evidence.moment, evidence.square):
            total[a] += total[b]
            total[b] = 0
        left[b] = False
        gain[b] = -np.inf
        gain[:, b] = -np.inf
        # The evidence of b is zero now: its entry is that of the joined group alone.
        together = road.weigh(evidence[np.full(count, a)] + evidence)[0]
        alone[a] = together[b]
        left[a] = False
        others = np.flatnonzero(left)
        left[a] = True
        low = np.minimum(others, a)
        high = np.maximum(others, a)
        gain[low, high] = together[others] - alone[a] - alone[others]
    return [groups[k] for k in np.flatnonzero(left)]
