"""Lines of lanes as curves in the image: what a circular arc on flat ground looks like.

Below the horizon such an arc is u = a + b v + c / v, u along the horizon and v the distance below it, in
pinhole px: the image of a straight line (a, b) and, to second order, of its curvature (c); see A. Guiducci,
"Parametric model of the perspective projection of a road with applications to lane keeping and 3D road
reconstruction", CVIU 73 (1999). It is linear in a, b and c: what points say of it adds up, and whether two
groups of points are one line has a closed answer. Lines along one road share a, their vanishing point, and c.

Crossings are linked from row to row into chains, near ones first, where lines are far apart. Chains and
pieces of paint are then joined as long as they are more likely one line than two, the likeliest pair first
(Bayesian hierarchical clustering); a far dash by the curve that both suggest and the road that they lie
along.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from v2hdm.detection.camera import Horizon, RoadCamera
from v2hdm.detection.network import AnchorRow, NetworkOutput
from v2hdm.records import BoolArray, FloatArray, IntArray, LaneDetection

NEIGHBOURS = 3.0  # points of one line err together: that many are worth as much as one

_MODEL_SIGMA_M = 0.02  # by how much painted lines leave the curve


@dataclass(frozen=True)
class LaneImage:
    """One image in which lines of lanes are looked for."""

    camera: RoadCamera
    # anchors, near to far, ``row_step_px`` apart, twice as far at half the resolution
    rows: Sequence[AnchorRow]
    paint: Sequence[LaneDetection] = ()  # centre lines of its lane paint, points ``paint_step_m`` apart
    output: NetworkOutput | None = None  # the network's, if it is known
    paint_step_m: float = 0.5
    row_step_px: float = 8.0
    # weights and biases of lines, if not the shipped ones
    score: Mapping[str, tuple[FloatArray, float]] | None = None

    @property
    def horizon(self) -> Horizon:
        """The camera's horizon."""
        return self.camera.horizon


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of a line's a (from ``centre_px``), b and c; of P at once (P, 1, ...)."""

    mean: FloatArray  # (3,)
    information: FloatArray  # (3, 3)

    @classmethod
    def several(cls, priors: Sequence[Prior]) -> Prior:
        """P of them at once."""
        mean, information = (np.array([getattr(p, name) for p in priors]) for name in ("mean", "information"))
        return cls(mean[:, None], information[:, None])

    @cached_property
    def log_determinant(self) -> FloatArray:
        """The log determinant of the information: (), of several (P, 1)."""
        return np.asarray(np.linalg.slogdet(self.information)[1])


@dataclass(frozen=True)
class Evidence:
    """The evidence of N groups of points for their lines, as weighted sums: that of the same line adds."""

    information: FloatArray  # (N, 3, 3) of outer products of the basis
    moment: FloatArray  # (N, 3) of basis times u
    square: FloatArray  # (N,) of u squared

    @classmethod
    def of(cls, phi: FloatArray, u: FloatArray, sigma: FloatArray, ends: Sequence[int]) -> Evidence:
        """Groups of points, one after the other; group n ends at ``ends[n]``, none is empty.

        ``phi`` (M, 3) is the basis there, ``u`` (M,) their place along the horizon from its centre, ``sigma``
        (M,) px.
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
        """Where the line is along the horizon (N,), px, where the :meth:`Horizon.basis` is ``phi`` (N, 3)."""
        return np.asarray(phi @ self.parameters)

    def sigma(self, phi: FloatArray) -> FloatArray:
        """Standard deviation (N,) of :meth:`along`, px."""
        return np.asarray(np.sqrt(((phi @ self.covariance) * phi).sum(axis=1)))


def _completed_square(information: FloatArray, moment: FloatArray) -> tuple[FloatArray, FloatArray]:
    """M' inv(A) m and log det A of A (..., 3, 3), m (..., 3), by hand: LAPACK takes ten times as long."""
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
    """N points of an image that lines may run through."""

    points_px: FloatArray  # (N, 2) recorded px
    along: FloatArray  # (N,) place along the horizon
    below: FloatArray  # (N,) and below it
    phi: FloatArray  # (N, 3) the basis of curves there
    sigma_px: FloatArray  # (N,) along the horizon
    odds: FloatArray  # (N,) log odds
    ground: FloatArray  # (N, 2), vehicle frame
    is_paint: BoolArray  # (N,) on the centre line of a piece of paint, not a crossing of a row anchor

    @classmethod
    def of(
        cls, image: LaneImage, points_px: FloatArray, odds: FloatArray, sigma_px: FloatArray, *, paint: bool
    ) -> LinePoints:
        """Points (N, 2) with standard deviations (N,): of ``paint``, or crossings of row anchors."""
        horizon, pinhole_px = image.horizon, image.camera.undistort(points_px)
        along, below = horizon.coordinates(pinhole_px)
        sigma = np.hypot(sigma_px, _MODEL_SIGMA_M * horizon.px_per_m * np.maximum(below, 0))
        ground, is_paint = image.camera.ground(pinhole_px), np.full(len(odds), paint)
        return cls(points_px, along, below, horizon.basis(below), sigma, odds, ground, is_paint)

    @classmethod
    def joined(cls, parts: Sequence[LinePoints]) -> LinePoints:
        """All points of several, in order."""
        names = vars(parts[0])
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})

    def where(self, kept: BoolArray) -> LinePoints:
        """Some of the points."""
        return LinePoints(**{name: value[kept] for name, value in vars(self).items()})

    def slopes(self, groups: list[IntArray]) -> FloatArray:
        """Px along the horizon per px down (N,) of groups of points that are roughly a line each."""
        members, ends = np.concatenate(groups), np.cumsum([len(group) for group in groups])
        count, begins = np.diff(ends, prepend=0), [0, *ends[:-1]]
        along, below = self.along[members], self.below[members]
        down = below - np.repeat(np.add.reduceat(below, begins) / count, count)
        squared = np.add.reduceat(down**2, begins)
        return np.asarray(np.add.reduceat(down * along, begins) / np.maximum(squared, 1))

    def evidence(self, horizon: Horizon, groups: list[IntArray]) -> Evidence:
        """The evidence of each of N groups of points, roughly a line each."""
        members, count = np.concatenate(groups), [len(group) for group in groups]
        across = np.hypot(1, self.slopes(groups))
        sigma = self.sigma_px[members] * np.repeat(across, count) * np.sqrt(NEIGHBOURS)
        u = self.along[members] - horizon.centre_px
        return Evidence.of(self.phi[members], u, sigma, np.cumsum(count).tolist())


@dataclass(frozen=True)
class Span:
    """A line on T rows of the image, from far to near."""

    below: FloatArray  # (T,) px below the horizon
    present: FloatArray  # (T,) probability that it has not ended
    painted: FloatArray  # (T,) and that it shows paint there
    length_m: FloatArray  # (T,) the ground that each row stands for
    log_likelihood: float  # over that of ground without a line


@dataclass(frozen=True)
class Line:
    """A line by its curve."""

    curve: Curve
    members: IntArray  # indices among the points
    paint_m: float  # the paint on it
    log_ratio: float  # of its probabilities along the road and anyhow
    log_odds: float = 0.0
    span: Span | None = None
    strand: Line | None = None  # the other line of a double one


_MIN_CHAIN = 3
_CHAIN_ODDS = 0.0  # chains are made of crossings more likely than not
_MAX_GAP_PX = 40.0
_SLOPE_POINTS = 6  # over how many of its last points a chain's direction is taken
_MAX_SLOPE = 4.5
_GATE_PX = 12.0

_FREE_SIGMAS = (0.5, 8.0, 0.008)
"""Lines of any kind: direction about the camera's, rad, place beside it, m, and curvature, 1/m."""

_PARALLEL_SIGMAS = (0.012, 0.0, 0.001)
"""By how much lines of one road differ in direction, rad, and curvature, 1/m.

An error of half a degree in the camera's pitch turns lines 2 m to the side of a low camera by as much.
"""

_SHARE = 0.85  # so many lines keep to the road; kerbs and strokes of letters need not
_FREE_KEPT = np.diag([0.04, 0.04, 1.0])
_ALONG_KEPT = np.array([[1.0, 0.0, 1.0], [0.0, 0.04, 0.0], [1.0, 0.0, 1.0]])
"""Where lines tend to be says what is one line, not where that one is: so much of the prior is kept there."""

_CANDIDATES = 4  # so many of the groups known best are tried as the road's direction
_SHARED = [0, 2]
_SHARED_BLOCK = np.ix_(_SHARED, _SHARED)


@dataclass
class _Chain:
    """A line so far: rows and columns, px, and indices of its crossings, from near to far."""

    v_px: list[float]
    u_px: list[float]
    index: list[int]
    slope: float | None = None
    """Columns per row over the last points; None as long as there is one only."""

    def add(self, v_px: float, u_px: float, index: int) -> None:
        self.v_px.append(v_px)
        self.u_px.append(u_px)
        self.index.append(index)
        first = max(-len(self.v_px), -_SLOPE_POINTS)
        self.slope = (u_px - self.u_px[first]) / (self.v_px[first] - v_px)

    def expected(self, v_px: float) -> tuple[float, float]:
        """Where the line should cross a row farther on, px, and how far off it may be."""
        ahead = self.v_px[-1] - v_px
        if self.slope is None:
            return self.u_px[-1], _MAX_SLOPE * ahead
        young = 1.5 if len(self.v_px) < _SLOPE_POINTS else 1.0
        return self.u_px[-1] + self.slope * ahead, _GATE_PX * young * (1 + 0.04 * (ahead - 8))


def find_chains(points_px: FloatArray, odds: FloatArray) -> list[IntArray]:
    """Likely crossings (N, 2), in order from near to far, linked from row to row; ``odds`` (N,) are log."""
    likely = np.flatnonzero(odds > _CHAIN_ODDS)
    u_px, v_px = points_px[likely].T
    if not len(likely):
        return []
    begins = np.flatnonzero(np.diff(v_px, prepend=np.nan)).tolist()  # nan differs from any row
    columns, indices, row_px = u_px.tolist(), likely.tolist(), v_px[begins].tolist()
    open_chains: list[_Chain] = []
    done: list[_Chain] = []
    for begin, end, row in zip(begins, [*begins[1:], len(likely)], row_px, strict=True):
        done += [chain for chain in open_chains if chain.v_px[-1] - row > _MAX_GAP_PX]
        open_chains = [chain for chain in open_chains if chain.v_px[-1] - row <= _MAX_GAP_PX]
        open_chains += _extend(open_chains, row, columns[begin:end], indices[begin:end])
    return [np.array(chain.index) for chain in done + open_chains if len(chain.index) >= _MIN_CHAIN]


def _extend(chains: list[_Chain], row_px: float, columns: list[float], indices: list[int]) -> list[_Chain]:
    """Give each crossing of a row to the chain that it suits best; what is left over starts chains."""
    pairs = []
    for c, chain in enumerate(chains):
        expected, gate = chain.expected(row_px)
        pairs += [(off / gate, c, p) for p, u in enumerate(columns) if (off := abs(u - expected)) <= gate]
    taken: set[int] = set()
    extended: set[int] = set()
    for _, c, p in sorted(pairs):
        if c not in extended and p not in taken:
            chains[c].add(row_px, columns[p], indices[p])
            extended.add(c)
            taken.add(p)
    return [_Chain([row_px], [columns[p]], [indices[p]]) for p in range(len(columns)) if p not in taken]


@dataclass(frozen=True)
class Road:
    """A road: the priors of lines ``along`` it and of ``free`` ones."""

    along: Prior
    free: Prior

    @cached_property
    def _both(self) -> Prior:
        return Prior.several([self.along, self.free])

    def weigh(self, evidence: Evidence) -> tuple[FloatArray, FloatArray]:
        """Log probability (N,) of each group as one line, and how much likelier (N,) it is along the road.

        The first is up to a constant per point, the second a log ratio that leaves out how common each is.
        """
        along, free = evidence.log_evidence(self._both)
        return np.logaddexp(along + np.log(_SHARE), free + np.log1p(-_SHARE)), along - free

    def drawn_by(self, log_ratio: float) -> Prior:
        """The gain of drawing a line with such a log ratio of :meth:`weigh`."""
        keeps = log_ratio + np.log(_SHARE) > np.log1p(-_SHARE)
        prior, kept = (self.along, _ALONG_KEPT) if keeps else (self.free, _FREE_KEPT)
        return Prior(prior.mean, prior.information * kept)


def find_road(evidence: Evidence, horizon: Horizon) -> Road:
    """The road that N groups of points, each roughly a line, agree on best."""
    free = Prior(np.zeros(3), np.diag(horizon.parameters(*_FREE_SIGMAS) ** -2.0))
    covariance = np.linalg.inv(evidence.information + free.information)
    mean = np.einsum("nij,nj->ni", covariance, evidence.moment)[:, _SHARED]
    spread = np.diag(horizon.parameters(*_PARALLEL_SIGMAS)[_SHARED] ** 2)
    # By how much the road may differ from what each line says.
    doubt = covariance[:, [[0], [2]], _SHARED] + spread
    certain = np.argsort((np.diagonal(doubt, axis1=1, axis2=2) / np.diag(spread)).sum(axis=1))[:_CANDIDATES]
    candidates = [_along(mean[k], doubt[k], free) for k in certain]
    *along, alone = evidence.log_evidence(Prior.several([*candidates, free]))
    gains = np.array(along) - alone
    agreement = np.logaddexp(np.log(_SHARE) + gains, np.log1p(-_SHARE)).sum(axis=1)
    best = gains[agreement.argmax()]
    # The mean of what all say of the road, each as far as it keeps to it.
    weight = 1 / (1 + (1 - _SHARE) / _SHARE * np.exp(-np.clip(best, -50, 50)))
    each = np.linalg.inv(doubt) * weight[:, None, None]
    shared = np.linalg.inv(each.sum(axis=0) + free.information[_SHARED_BLOCK])
    return Road(_along(shared @ np.einsum("nij,nj->i", each, mean), shared + spread, free), free)


def _along(shared: FloatArray, covariance: FloatArray, free: Prior) -> Prior:
    """Lines of known a and c (2,), with their covariance (2, 2), anywhere beside the camera."""
    information = free.information.copy()
    information[_SHARED_BLOCK] = np.linalg.inv(covariance)
    return Prior(np.array([shared[0], 0.0, shared[1]]), information)


def find_lines(points: LinePoints, groups: list[IntArray], image: LaneImage) -> list[Line]:
    """The lines through ``groups`` of points."""
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
    return [Line(*parts) for parts in zip(curves, groups, paint_m, along, strict=True)]


def _join(evidence: Evidence, groups: list[IntArray], road: Road) -> list[IntArray]:
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
        gain[b], gain[:, b] = -np.inf, -np.inf
        # With that of b, which is nought now, comes what the two are together.
        together = road.weigh(evidence[np.full(count, a)] + evidence)[0]
        alone[a] = together[b]
        left[a] = False
        others = np.flatnonzero(left)
        left[a] = True
        low, high = np.minimum(others, a), np.maximum(others, a)
        gain[low, high] = together[others] - alone[a] - alone[others]
    return [groups[k] for k in np.flatnonzero(left)]
