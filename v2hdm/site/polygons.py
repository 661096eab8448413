"""Polygons that images draw: the vertices of symbols, and the templates that the symbols of a class share.

An image's outline of a symbol is that of a polygon on the ground, plus noise that neighbouring points have in
common, plus a shift of the whole image, whose viewing direction jitters. Each piece of it lies along an edge,
or is of none: a rounded corner, the cut of a shadow or of the border. That mixture is all that is robust here
(expectation maximisation: Dempster, Laird and Rubin, JRSS B 1977); the vertices follow by Gauss-Newton steps.

Symbols of one class are painted with one stencil: each is the template, moved, turned, made longer or wider,
its vertices off by some paint, all of that normal. So the template of a symbol is the prior of its vertices.
It is learnt from the others of its class, and how far they deviate with it (empirical Bayes, as
:mod:`v2hdm.site.shapes` has it). Whether a symbol is of a template, and how many vertices a new one has, the
marginal likelihood decides (Laplace's approximation: MacKay, Neural Computation 4, 1992). Mirror twins have
templates of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.geometry.ipm import apply_in_front, homography_jacobian
from v2hdm.geometry.planar import is_simple, signed_area
from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.site.shapes import EDGE_SIGMA_M, SHAPE_SIGMA_M, learn_paint_error

_SPACING_PX = 4.0  # length of the pieces, px, that an outline is taken as: an element of the network's output
_CORRELATED_PX = 20.0
"""Length, px, of an outline that errs as one: twice the integral of its autocorrelation in renders."""

_SIGMA_PX, _SIGMA_WEIGHT = 0.5, 10.0
"""How far an outline is from the paint's edge, px, and how many independent points that guess is worth."""

_TURN_SIGMA_RAD = 0.25  # by how much a piece of outline is turned against its edge
_ROUND_PX = 3.0  # how far from a corner, px, the network rounds it
_STRAY, _STRAY_PX = 0.2, 25.0  # share of an outline that lies along no edge, and how far off it may be, px
LEAST_EXPLAINED = 1 - 2 * _STRAY  # least share of the outlines that lies along the edges of their polygon

_ANYWHERE_M = 0.5  # sigma, m, of vertices about the outline that sightings share
UNSEEN_M = _ANYWHERE_M / 2  # sigma, m, of vertices of which images say little beside that guess
_SIZE_SIGMA, _FREEDOM = 0.02, 4.0
"""Sigma of the logarithm of a symbol's sizes about its template's, before any is known; and how many symbols
that guess, and the one of the vertices' own deviations, are worth."""

_MOST_VERTICES = 18
_STEP_M = 0.1  # a step moves no vertex farther: beyond, other edges explain the pieces
_STEPS, _FEW_STEPS, _ROUNDS = 15, 4, 3  # of a fit, of one after a vertex has gone, of learning a template


@dataclass(frozen=True)
class Traces:
    """P pieces of the outlines of one symbol that I images show.

    ``px_from_map`` (I, 3, 3) are the homographies of the ground, ``shift_px`` (I,) standard deviations of the
    images' shifts. A piece is of an ``image`` (P,), at ``points_px`` (P, 2) in the direction ``along_px``
    (P, 2), counter-clockwise as seen from above, and ``weight`` (P,) independent observations.
    """

    px_from_map: FloatArray
    shift_px: FloatArray
    image: IntArray
    points_px: FloatArray
    along_px: FloatArray
    weight: FloatArray

    @classmethod
    def of(
        cls,
        outlines_px: Sequence[FloatArray],
        seen: Sequence[BoolArray],
        image: IntArray,
        px_from_map: FloatArray,
        shift_px: FloatArray,
    ) -> Traces:
        """The pieces of outlines (K, 2), each of an ``image`` (S,), along sides (K,) that were ``seen``."""
        pieces = []
        for outline, sides, number in zip(outlines_px, seen, image, strict=True):
            clockwise = signed_area(outline) < 0
            ring, lit = (outline, sides) if clockwise else (outline[::-1], np.roll(sides[::-1], -1))
            side = np.roll(ring, -1, axis=0) - ring
            length = np.linalg.norm(side, axis=1) * lit
            count = np.ceil(length / _SPACING_PX).astype(np.int64)
            own = np.repeat(np.arange(len(ring)), count)
            share = (np.arange(len(own)) - (np.cumsum(count) - count)[own] + 0.5) / count[own]
            along, weight = side[own] / length[own, None], length[own] / count[own] / _CORRELATED_PX
            pieces.append((np.full(len(own), number), ring[own] + share[:, None] * side[own], along, weight))
        return cls(px_from_map, shift_px, *(np.concatenate(one) for one in zip(*pieces, strict=True)))


@dataclass(frozen=True)
class Polygon:
    """The ``vertices`` (N, 2), m, of a symbol, counter-clockwise, in the order of its template.

    ``covariance`` (2N, 2N), m^2, is that of the stacked vertices, ``data`` the information that the images
    alone have of them, ``pull`` (2N,) the derivative of the log prior; ``evidence`` is the log marginal
    likelihood, ``explained`` the share of the images' outlines that lie along its edges.
    """

    vertices: FloatArray
    covariance: FloatArray
    data: FloatArray
    pull: FloatArray
    evidence: float
    explained: float


Prior = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Mean (2N,) and covariance (2N, 2N) of the vertices, by where they are (N, 2)."""


def find_polygons(
    kinds: Sequence[str], traces: Sequence[Traces], outlines: Sequence[FloatArray]
) -> list[Polygon]:
    """The polygons of symbols by class, what images show of each, and an outline (K, 2) to start from."""
    own = [_own_polygon(trace, outline) for trace, outline in zip(traces, outlines, strict=True)]
    found, classes = list(own), list[tuple[_Template, list[int]]]()
    for k in np.argsort([-trace.weight.sum() for trace in traces]).tolist():
        best, home = own[k], None
        for template, members in classes:
            if kinds[members[0]] == kinds[k]:
                for start in template.laid_about(outlines[k]):
                    one = _fit(traces[k], start, template.prior)
                    better = one.evidence > best.evidence and is_simple(one.vertices)
                    best, home = (one, members) if better else (best, home)
        found[k] = best
        if home is not None:
            home.append(k)
        elif is_simple(best.vertices):
            classes.append((_Template.of(best), [k]))
    for template, members in classes:
        shown, polygons = [traces[k] for k in members], [found[k] for k in members]
        if len(members) > 1:
            template, polygons = _of_template(template, shown, polygons)
        for k, one, error in zip(members, polygons, template.edge_errors(polygons), strict=True):
            found[k] = replace(one, covariance=one.covariance + error)
    return found


def _of_template(
    template: _Template, traces: Sequence[Traces], polygons: list[Polygon]
) -> tuple[_Template, list[Polygon]]:
    """Symbols as polygons of the template that they teach, without vertices that only its first one had."""
    for _ in range(_ROUNDS):
        template, polygons = _taught(template, traces, polygons)
    while len(template.vertices) > 3:
        kept = _but_flattest(template.vertices)
        known = template.covariance[np.ix_(*2 * [np.repeat(kept, 2)])]
        fewer = replace(template, vertices=template.vertices[kept], covariance=known)
        pairs = zip(traces, polygons, strict=True)
        tried = [_fit(trace, one.vertices[kept], fewer.prior, _FEW_STEPS) for trace, one in pairs]
        fewer, tried = _taught(fewer, traces, tried)
        if sum(one.evidence for one in tried) < sum(one.evidence for one in polygons):
            break
        template, polygons = _taught(fewer, traces, tried)
    return template, polygons


def _taught(
    template: _Template, traces: Sequence[Traces], polygons: Sequence[Polygon]
) -> tuple[_Template, list[Polygon]]:
    """The template that symbols teach, and each of them by what the others do."""
    template, others = template.learnt(polygons)
    each = zip(traces, polygons, others, strict=True)
    return template, [_fit(trace, one.vertices, other.prior, _FEW_STEPS) for trace, one, other in each]


def _own_polygon(traces: Traces, outline: FloatArray) -> Polygon:
    """The likeliest polygon about an outline, of a shape of its own: vertices go while that is likelier."""
    vertices = outline
    while len(vertices) > _MOST_VERTICES:
        vertices = vertices[_but_flattest(vertices)]
    now = _fit(traces, vertices, _anywhere(vertices))
    tried = [now]
    while len(now.vertices) > 3:
        vertices = now.vertices[_but_flattest(now.vertices)]
        now = _fit(traces, vertices, _anywhere(vertices), _FEW_STEPS)
        tried.append(now)
    best = max(tried, key=lambda one: (is_simple(one.vertices), one.evidence))
    refined = _fit(traces, best.vertices, _anywhere(best.vertices))
    return refined if is_simple(refined.vertices) else best


def _anywhere(start: FloatArray) -> Prior:
    return lambda vertices: (start.ravel(), _ANYWHERE_M**2 * np.eye(start.size))


def _but_flattest(vertices: FloatArray) -> BoolArray:
    """The vertices (N,) of a polygon but that with least of its area (Visvalingam and Whyatt, 1993)."""
    before, after = np.roll(vertices, 1, axis=0), np.roll(vertices, -1, axis=0)
    area = np.abs(signed_area(np.stack([before, vertices, after], axis=1)))
    return np.asarray(np.arange(len(vertices)) != area.argmin())


@dataclass(frozen=True)
class _Template:
    """Vertices (N, 2) about their middle, the long side along x, and their covariance (2N, 2N), m^2.

    Symbols deviate from it by ``paint_m`` a coordinate and by ``sizes`` (2,), sigmas of the logarithms of
    length and width.
    """

    vertices: FloatArray
    covariance: FloatArray
    paint_m: float = SHAPE_SIGMA_M
    sizes: tuple[float, float] = (_SIZE_SIGMA, _SIZE_SIGMA)

    @classmethod
    def of(cls, polygon: Polygon) -> _Template:
        arms = polygon.vertices - polygon.vertices.mean(axis=0)
        axes = np.linalg.svd(arms)[2]
        axes[1] *= np.linalg.det(axes)
        turn = np.kron(np.eye(len(arms)), axes)
        return cls(arms @ axes.T, turn @ polygon.covariance @ turn.T)

    @property
    def stretch(self) -> FloatArray:
        """Derivative (2N, 2) of the vertices by the logarithms of length and width."""
        return np.asarray((self.vertices[:, :, None] * np.eye(2)).reshape(-1, 2))

    @property
    def spread(self) -> FloatArray:
        """Covariance (2N, 2N) of a symbol's vertices about the template's, but for its pose."""
        turning = (self.vertices @ [[0.0, 1.0], [-1.0, 0.0]]).ravel()
        basis = np.linalg.qr(np.column_stack([np.tile(np.eye(2), (len(self.vertices), 1)), turning]))[0]
        sized = self.stretch * self.sizes
        own = self.paint_m**2 * np.eye(len(basis)) + sized @ sized.T
        return np.asarray(own + _ANYWHERE_M**2 * len(self.vertices) * basis @ basis.T)

    def pose(self, vertices: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotation (2, 2) and place (2,) that bring the template to vertices (N, 2)."""
        middle = vertices.mean(axis=0)
        cross = (vertices - middle) @ [1, 1j] @ (self.vertices @ [1, -1j])
        c, s = np.array([cross.real, cross.imag]) / max(abs(cross), 1e-12)
        rotation = np.array([[c, -s], [s, c]])
        return rotation, middle - rotation @ self.vertices.mean(axis=0)

    def prior(self, vertices: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (2N,) and covariance (2N, 2N) of a symbol's vertices that lie about (N, 2)."""
        rotation, place = self.pose(vertices)
        turn = np.kron(np.eye(len(vertices)), rotation)
        return (self.vertices @ rotation.T + place).ravel(), turn @ (self.covariance + self.spread) @ turn.T

    def laid_about(self, outline: FloatArray) -> list[FloatArray]:
        """The template on an outline (K, 2): along it, across it, and both turned around."""
        points = _evenly(outline)
        axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
        own = (self.vertices - _evenly(self.vertices).mean(axis=0)) @ [1, 1j] * (axes[0] @ [1, 1j])
        turned = [own * turn for turn in (1, 1j, -1, -1j)]
        return [np.column_stack([one.real, one.imag]) + points.mean(axis=0) for one in turned]

    def learnt(self, members: Sequence[Polygon]) -> tuple[_Template, list[_Template]]:
        """The template of all members, and for each that of the others."""
        mean, spread = self.vertices.ravel(), np.linalg.inv(self.spread)
        paint2, sizes2 = _FREEDOM * SHAPE_SIGMA_M**2, _FREEDOM * np.full(2, _SIZE_SIGMA**2)
        information, pulls = [], []
        for one in members:
            rotation, place = self.pose(one.vertices)
            turn = np.kron(np.eye(len(one.vertices)), rotation)
            data, here = turn.T @ one.data @ turn, ((one.vertices - place) @ rotation).ravel()
            # What the images say of the template, the symbol's own deviations marginalised.
            gain = spread @ np.linalg.inv(data + spread)
            known, pull = gain @ data, gain @ (data @ here - turn.T @ one.pull)
            information.append(known)
            pulls.append(pull)
            # Second moments of those deviations, given the images (expectation maximisation).
            off, own2 = pull - known @ mean, np.square(self.sizes)
            paint2 += self.paint_m**2 * (1 + self.paint_m**2 * (off @ off - np.trace(known)) / len(off))
            by_size = self.stretch.T @ known @ self.stretch
            sizes2 += own2 * (1 + own2 * ((self.stretch.T @ off) ** 2 - np.diag(by_size)))
        count = _FREEDOM + len(members)
        freedom = float(np.sqrt(paint2 / count)), tuple(np.sqrt(sizes2 / count).tolist())

        def of(rows: Sequence[int]) -> _Template:
            about = np.eye(mean.size) / _ANYWHERE_M**2
            covariance = np.linalg.inv(sum((information[k] for k in rows), about))
            vertices = covariance @ sum((pulls[k] for k in rows), about @ mean)
            return _Template(vertices.reshape(-1, 2), (covariance + covariance.T) / 2, *freedom)

        everyone = range(len(members))
        return of(everyone), [of([k for k in everyone if k != own]) for own in everyone]

    def edge_errors(self, members: Sequence[Polygon]) -> list[FloatArray]:
        """Covariances (2N, 2N), m^2, of what all images misplace alike, by how each member deviates."""
        if len(members) < 2:
            return [EDGE_SIGMA_M**2 * np.eye(self.vertices.size)]
        off, formal = [], []
        for one, other in zip(members, self.learnt(members)[1], strict=True):
            off += list(one.vertices - other.prior(one.vertices)[0].reshape(-1, 2))
            formal += [one.covariance[n : n + 2, n : n + 2] for n in range(0, one.vertices.size, 2)]
        error = learn_paint_error(off, formal)
        own = [error.variance_m2(*pair) for pair in zip(off, formal, strict=True)]
        return [np.diag(np.repeat(part, 2)) for part in np.split(np.array(own), len(members))]


def _evenly(ring: FloatArray) -> FloatArray:
    """A hundred points (100, 2) evenly along a closed polygon (N, 2)."""
    closed = np.vstack([ring, ring[:1]])
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    wanted = np.linspace(0, at[-1], 100, endpoint=False)
    return np.column_stack([np.interp(wanted, at, axis) for axis in closed.T])


def _fit(traces: Traces, start: FloatArray, prior: Prior, steps: int = _STEPS) -> Polygon:
    """The likeliest polygon from vertices ``start`` (N, 2)."""
    vertices: FloatArray = start
    shift_px, sigma_px = np.zeros((len(traces.px_from_map), 2)), 2 * _SIGMA_PX
    for _ in range(steps):
        weight, off_px, normal, jacobian, log_likelihood = _explained(traces, vertices, shift_px, sigma_px)
        squared, count = _SIGMA_WEIGHT * _SIGMA_PX**2 + weight @ off_px**2, _SIGMA_WEIGHT + weight.sum()
        sigma_px = float(np.sqrt(squared / count))
        off_px += (normal * shift_px[traces.image]).sum(axis=1)
        data, gradient, follow = _normal(traces, weight / sigma_px**2, off_px, normal, jacobian)
        mean, covariance = prior(vertices)
        precision = np.linalg.inv(covariance)
        step = np.linalg.solve(data + precision, gradient + precision @ (mean - vertices.ravel()))
        step = step * min(1.0, _STEP_M / float(np.abs(step).max()))
        vertices, shift_px = np.asarray(vertices + step.reshape(-1, 2)), follow(np.asarray(step))
    mean, covariance = prior(vertices)
    precision, off = np.linalg.inv(covariance), mean - vertices.ravel()
    evidence = log_likelihood - 0.5 * off @ precision @ off
    evidence -= 0.5 * (np.linalg.slogdet(data + precision)[1] + np.linalg.slogdet(covariance)[1])
    explained = float(weight.sum() / max(traces.weight.sum(), 1e-9))
    return Polygon(
        vertices, np.linalg.inv(data + precision), data, precision @ off, float(evidence), explained
    )


def _explained(
    traces: Traces, vertices: FloatArray, shift_px: FloatArray, sigma_px: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]:
    """Each piece beside its likeliest edge: observations that it is worth (P,), px that it is off (P,).

    Then the edge's outer normal (P, 2), the derivative (P, 2N) of the edge's place by the vertices, and the
    log likelihood of all pieces.
    """
    rows, image = np.arange(len(traces.image)), traces.image
    pixel = apply_in_front(traces.px_from_map, vertices)
    side = np.roll(pixel, -1, axis=1) - pixel
    length = np.maximum(np.linalg.norm(side, axis=2), 1e-6)
    along = (side / length[..., None])[image]
    apart = (traces.points_px - shift_px[image])[:, None] - pixel[image]
    at = (apart * along).sum(axis=2)
    off = apart[..., 1] * along[..., 0] - apart[..., 0] * along[..., 1]
    end = np.nan_to_num(np.minimum(at, length[image] - at))
    turn = np.arccos(np.clip((along * traces.along_px[:, None]).sum(axis=2), -1, 1))
    squared = (off**2 + np.minimum(end, 0.0) ** 2) / sigma_px**2 + (turn / _TURN_SIGMA_RAD) ** 2
    squared = np.where(np.isfinite(squared), squared, np.inf)
    edge = squared.argmin(axis=1)
    sharp = -np.expm1(-0.5 * (np.maximum(end[rows, edge], 0.0) / _ROUND_PX) ** 2) + 1e-3
    inlier = (
        np.log((1 - _STRAY) * sharp / (2 * np.pi * sigma_px * _TURN_SIGMA_RAD)) - 0.5 * squared[rows, edge]
    )
    # Pieces lie anywhere along the polygon: of two that explain them, the shorter one is likelier.
    perimeter = np.maximum(np.nansum(length, axis=1), 1.0)
    inlier += np.log(
        _CORRELATED_PX * np.bincount(image, traces.weight, len(perimeter))[image] / perimeter[image]
    )
    total = np.logaddexp(inlier, np.log(_STRAY / (2 * _STRAY_PX * 2 * np.pi)))
    weight = traces.weight * np.exp(inlier - total)
    normal = np.stack([-along[rows, edge, 1], along[rows, edge, 0]], axis=-1)
    share = np.clip(at[rows, edge] / length[image, edge], 0.0, 1.0)
    slope, jacobian = (
        homography_jacobian(traces.px_from_map, vertices),
        np.zeros((len(rows), *vertices.shape)),
    )
    for corner, part in ((edge, 1 - share), ((edge + 1) % len(vertices), share)):
        jacobian[rows, corner] = part[:, None] * np.einsum("pi,pij->pj", normal, slope[image, corner])
    known = weight > 0
    off_px, normal, jacobian = (
        np.where(known.reshape(-1, *(1,) * (one.ndim - 1)), one, 0.0)
        for one in (off[rows, edge], normal, jacobian)
    )
    return weight, off_px, normal, jacobian.reshape(len(rows), -1), float(traces.weight @ total)


def _normal(
    traces: Traces, info: FloatArray, off_px: FloatArray, normal: FloatArray, jacobian: FloatArray
) -> tuple[FloatArray, FloatArray, Callable[[FloatArray], FloatArray]]:
    """Information (2N, 2N) and gradient (2N,) of the vertices, the images' shifts marginalised.

    Lastly the shifts (I, 2), px, that follow a step (2N,).
    """
    weighted, images = info[:, None] * jacobian, len(traces.px_from_map)
    shifted = np.eye(2) / traces.shift_px[:, None, None] ** 2
    coupling, pull = np.zeros((images, 2, jacobian.shape[1])), np.zeros((images, 2))
    np.add.at(shifted, traces.image, info[:, None, None] * normal[:, :, None] * normal[:, None])
    np.add.at(coupling, traces.image, normal[:, :, None] * weighted[:, None])
    np.add.at(pull, traces.image, (info * off_px)[:, None] * normal)
    inverse = np.linalg.inv(shifted)
    gain = np.einsum("iju,ijk->iuk", coupling, inverse)
    information = weighted.T @ jacobian - np.einsum("iuk,ikv->uv", gain, coupling)
    gradient = weighted.T @ off_px - np.einsum("iuk,ik->u", gain, pull)
    return information, gradient, lambda step: np.einsum("ijk,ik->ij", inverse, pull - coupling @ step)
