"""Polygons from outlines in images: the vertices of symbols, and the templates of their classes.

The outline in an image is a polygon on the ground, plus noise correlated along it, plus a shift of the whole
image by jitter of the viewing direction. Each piece lies along an edge, or along none: a rounded corner, the
cut of a shadow or the border. That mixture provides the robustness (expectation maximisation: Dempster, Laird
and Rubin, JRSS B 1977); the vertices follow by Gauss-Newton.

Symbols of one class are painted with one stencil: the template, moved, turned and stretched, with paint error
of the vertices, all Gaussian. The template is thus the prior of a symbol's vertices, learned with its
variances from the other members (empirical Bayes, as in :mod:`v2hdm.site.shapes`). The marginal likelihood
decides whether a symbol has a template, and how many vertices a new one has (Laplace's approximation: MacKay,
Neural Computation 4, 1992). Mirror images have templates of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.geometry.ipm import apply_in_front, homography_jacobian
from v2hdm.geometry.planar import cross, is_simple, length_along, points_along, signed_area
from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.site.shapes import EDGE_SIGMA_M, SHAPE_SIGMA_M, learn_paint_error

_SPACING_PX = 4.0  # length, px, of an outline's pieces: an element of the network's output
_CORRELATED_PX = 20.0
"""Correlation length of an outline, px: twice the integral of its autocorrelation in renders."""

_SIGMA_PX = 0.5
_SIGMA_WEIGHT = 10.0
"""Prior sigma of an outline about the paint's edge, px, and the number of independent points it is worth."""

_TURN_SIGMA_RAD = 0.25  # of a piece of outline against its edge
_ROUND_PX = 3.0  # distance from a corner, px, that the network rounds
_STRAY = 0.2
_STRAY_PX = 25.0  # fraction of an outline along no edge, and its range, px
LEAST_EXPLAINED = 1 - 2 * _STRAY  # least fraction of the outlines along their polygon's edges
_ANYWHERE_M = 0.5  # sigma, m, of vertices about the outline common to sightings
UNSEEN_M = _ANYWHERE_M / 2  # sigma, m, of vertices on which images add little to that prior
_SIZE_SIGMA = 0.02
_FREEDOM = 4.0
"""Prior sigma of the logarithm of a symbol's sizes about its template's; and the number of symbols that this
prior, and that of the vertices' own deviations, are worth."""

_MOST_VERTICES = 18
_STEP_M = 0.1  # largest motion of a vertex in a step: beyond, other edges explain the pieces
_STEPS = 15
_FEW_STEPS = 4
_ROUNDS = 3  # of a fit, of one after removing a vertex, of learning a template


@dataclass(frozen=True)
class Traces:
    """P pieces of one symbol's outlines in I images.

    ``px_from_map`` (I, 3, 3) are ground homographies, ``shift_px`` (I,) the sigmas of the images' shifts. A
    piece of ``image`` (P,) lies at ``points_px`` (P, 2), in direction ``along_px`` (P, 2), counter-clockwise
    from above; ``weight`` (P,) is in independent observations.
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
        """Pieces of outlines (K, 2), each of an ``image`` (S,), along the sides (K,) that were ``seen``."""
        pieces = []
        for outline, sides, number in zip(outlines_px, seen, image, strict=True):
            clockwise = signed_area(outline) < 0
            ring, lit = (outline, sides) if clockwise else (outline[::-1], np.roll(sides[::-1], -1))
            side = np.roll(ring, -1, axis=0) - ring
            length = np.linalg.norm(side, axis=1) * lit
            count = np.ceil(length / _SPACING_PX).astype(np.int64)
            own = np.repeat(np.arange(len(ring)), count)
            share = (np.arange(len(own)) - (np.cumsum(count) - count)[own] + 0.5) / count[own]
            along = side[own] / length[own, None]
            weight = length[own] / count[own] / _CORRELATED_PX
            pieces.append((np.full(len(own), number), ring[own] + share[:, None] * side[own], along, weight))
        return cls(px_from_map, shift_px, *(np.concatenate(one) for one in zip(*pieces, strict=True)))


@dataclass(frozen=True)
class Polygon:
    """The ``vertices`` (N, 2), m, of a symbol, counter-clockwise, in the order of its template.

    ``covariance`` (2N, 2N), m^2, is of the stacked vertices, ``data`` the information from images alone,
    ``pull`` (2N,) the gradient of the log prior; ``evidence`` is the log marginal likelihood, ``explained``
    the fraction of the outlines along its edges.
    """

    vertices: FloatArray
    covariance: FloatArray
    data: FloatArray
    pull: FloatArray
    evidence: float
    explained: float


Prior = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Prior mean (2N,) and covariance (2N, 2N) of vertices near (N, 2)."""


def find_polygons(
    kinds: Sequence[str], traces: Sequence[Traces], outlines: Sequence[FloatArray]
) -> list[Polygon]:
    """Polygons of symbols of classes ``kinds``, from their traces, started from ``outlines`` (K, 2)."""
    own = [_own_polygon(trace, outline) for trace, outline in zip(traces, outlines, strict=True)]
    found = list(own)
    classes = list[tuple[_Template, list[int]]]()
    for k in np.argsort([-trace.weight.sum() for trace in traces]).tolist():
        best = own[k]
        home = None
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
        shown = [traces[k] for k in members]
        polygons = [found[k] for k in members]
        if len(members) > 1:
            template, polygons = _of_template(template, shown, polygons)
        for k, one, error in zip(members, polygons, template.edge_errors(polygons), strict=True):
            found[k] = replace(one, covariance=one.covariance + error)
    return found


def _of_template(
    template: _Template, traces: Sequence[Traces], polygons: list[Polygon]
) -> tuple[_Template, list[Polygon]]:
    """Symbols as polygons of their template, re-learned without vertices that only its first symbol had."""
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
    """The template learned from all symbols, and each symbol under that of the others."""
    template, others = template.learnt(polygons)
    each = zip(traces, polygons, others, strict=True)
    return template, [_fit(trace, one.vertices, other.prior, _FEW_STEPS) for trace, one, other in each]


def _own_polygon(traces: Traces, outline: FloatArray) -> Polygon:
    """Most likely polygon of its own shape about an outline; vertices go while that is likelier."""
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
    """The vertices (N,) of a polygon except that of the smallest area (Visvalingam and Whyatt, 1993)."""
    before = np.roll(vertices, 1, axis=0)
    after = np.roll(vertices, -1, axis=0)
    area = np.abs(signed_area(np.stack([before, vertices, after], axis=1)))
    return np.asarray(np.arange(len(vertices)) != area.argmin())


@dataclass(frozen=True)
class _Template:
    """Vertices (N, 2) about their centre, long side along x, and covariance (2N, 2N), m^2.

    Symbols deviate by ``paint_m`` per coordinate and ``sizes`` (2,), sigmas of the logarithms of length and
    width.
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
        """Covariance (2N, 2N) of a symbol's vertices about the template, up to pose."""
        turning = (self.vertices @ [[0.0, 1.0], [-1.0, 0.0]]).ravel()
        basis = np.linalg.qr(np.column_stack([np.tile(np.eye(2), (len(self.vertices), 1)), turning]))[0]
        sized = self.stretch * self.sizes
        own = self.paint_m**2 * np.eye(len(basis)) + sized @ sized.T
        return np.asarray(own + _ANYWHERE_M**2 * len(self.vertices) * basis @ basis.T)

    def pose(self, vertices: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotation (2, 2) and translation (2,) that align the template with vertices (N, 2)."""
        middle = vertices.mean(axis=0)
        cross = (vertices - middle) @ [1, 1j] @ (self.vertices @ [1, -1j])
        c, s = np.array([cross.real, cross.imag]) / max(abs(cross), 1e-12)
        rotation = np.array([[c, -s], [s, c]])
        return rotation, middle - rotation @ self.vertices.mean(axis=0)

    def prior(self, vertices: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Prior mean (2N,) and covariance (2N, 2N) of a symbol's vertices near (N, 2)."""
        rotation, place = self.pose(vertices)
        turn = np.kron(np.eye(len(vertices)), rotation)
        return (self.vertices @ rotation.T + place).ravel(), turn @ (self.covariance + self.spread) @ turn.T

    def laid_about(self, outline: FloatArray) -> list[FloatArray]:
        """The template placed on an outline (K, 2): along it, across it, and both reversed."""
        points = _evenly(outline)
        axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
        own = (self.vertices - _evenly(self.vertices).mean(axis=0)) @ [1, 1j] * (axes[0] @ [1, 1j])
        turned = [own * turn for turn in (1, 1j, -1, -1j)]
        return [np.column_stack([one.real, one.imag]) + points.mean(axis=0) for one in turned]

    def learnt(self, members: Sequence[Polygon]) -> tuple[_Template, list[_Template]]:
        """The template of all members, and for each member that of the others."""
        mean = self.vertices.ravel()
        spread = np.linalg.inv(self.spread)
        paint2 = _FREEDOM * SHAPE_SIGMA_M**2
        sizes2 = _FREEDOM * np.full(2, _SIZE_SIGMA**2)
        information = []
        pulls = []
        for one in members:
            rotation, place = self.pose(one.vertices)
            turn = np.kron(np.eye(len(one.vertices)), rotation)
            data = turn.T @ one.data @ turn
            here = ((one.vertices - place) @ rotation).ravel()
            # Information of the images on the template, the symbol's own deviations marginalised.
            gain = spread @ np.linalg.inv(data + spread)
            known = gain @ data
            pull = gain @ (data @ here - turn.T @ one.pull)
            information.append(known)
            pulls.append(pull)
            # Second moments of those deviations given the images (expectation maximisation).
            off = pull - known @ mean
            own2 = np.square(self.sizes)
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
        """Covariances (2N, 2N), m^2, of errors common to all images, from each member's deviation."""
        if len(members) < 2:
            return [EDGE_SIGMA_M**2 * np.eye(self.vertices.size)]
        off = []
        formal = []
        for one, other in zip(members, self.learnt(members)[1], strict=True):
            off += list(one.vertices - other.prior(one.vertices)[0].reshape(-1, 2))
            formal += [one.covariance[n : n + 2, n : n + 2] for n in range(0, one.vertices.size, 2)]
        error = learn_paint_error(off, formal)
        own = [error.variance_m2(*pair) for pair in zip(off, formal, strict=True)]
        return [np.diag(np.repeat(part, 2)) for part in np.split(np.array(own), len(members))]


def _evenly(ring: FloatArray) -> FloatArray:
    """Points (100, 2), evenly spaced along a closed polygon (N, 2)."""
    closed = np.vstack([ring, ring[:1]])
    return points_along(closed, np.linspace(0, length_along(closed)[-1], 100, endpoint=False))


def _fit(traces: Traces, start: FloatArray, prior: Prior, steps: int = _STEPS) -> Polygon:
    """The maximum a posteriori polygon, from vertices ``start`` (N, 2)."""
    vertices: FloatArray = start
    shift_px = np.zeros((len(traces.px_from_map), 2))
    sigma_px = 2 * _SIGMA_PX
    for _ in range(steps):
        weight, off_px, normal, jacobian, log_likelihood = _explained(traces, vertices, shift_px, sigma_px)
        squared = _SIGMA_WEIGHT * _SIGMA_PX**2 + weight @ off_px**2
        count = _SIGMA_WEIGHT + weight.sum()
        sigma_px = float(np.sqrt(squared / count))
        off_px += (normal * shift_px[traces.image]).sum(axis=1)
        data, gradient, follow = _normal(traces, weight / sigma_px**2, off_px, normal, jacobian)
        mean, covariance = prior(vertices)
        precision = np.linalg.inv(covariance)
        step = np.linalg.solve(data + precision, gradient + precision @ (mean - vertices.ravel()))
        step = step * min(1.0, _STEP_M / float(np.abs(step).max()))
        vertices = np.asarray(vertices + step.reshape(-1, 2))
        shift_px = follow(np.asarray(step))
    mean, covariance = prior(vertices)
    precision = np.linalg.inv(covariance)
    off = mean - vertices.ravel()
    evidence = log_likelihood - 0.5 * off @ precision @ off
    evidence -= 0.5 * (np.linalg.slogdet(data + precision)[1] + np.linalg.slogdet(covariance)[1])
    explained = float(weight.sum() / max(traces.weight.sum(), 1e-9))
    return Polygon(
        vertices, np.linalg.inv(data + precision), data, precision @ off, float(evidence), explained
    )


def _explained(
    traces: Traces, vertices: FloatArray, shift_px: FloatArray, sigma_px: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]:
    """Effective observations (P,) and offset, px, (P,) of each piece from its most likely edge.

    Then the edge's outer normal (P, 2), the Jacobian (P, 2N) of the edge by the vertices, and the
    log-likelihood of all pieces.
    """
    rows = np.arange(len(traces.image))
    image = traces.image
    pixel = apply_in_front(traces.px_from_map, vertices)
    side = np.roll(pixel, -1, axis=1) - pixel
    length = np.maximum(np.linalg.norm(side, axis=2), 1e-6)
    along = (side / length[..., None])[image]
    apart = (traces.points_px - shift_px[image])[:, None] - pixel[image]
    at = (apart * along).sum(axis=2)
    off = cross(along, apart)
    end = np.nan_to_num(np.minimum(at, length[image] - at))
    turn = np.arccos(np.clip((along * traces.along_px[:, None]).sum(axis=2), -1, 1))
    squared = (off**2 + np.minimum(end, 0.0) ** 2) / sigma_px**2 + (turn / _TURN_SIGMA_RAD) ** 2
    squared = np.where(np.isfinite(squared), squared, np.inf)
    edge = squared.argmin(axis=1)
    sharp = -np.expm1(-0.5 * (np.maximum(end[rows, edge], 0.0) / _ROUND_PX) ** 2) + 1e-3
    inlier = (
        np.log((1 - _STRAY) * sharp / (2 * np.pi * sigma_px * _TURN_SIGMA_RAD)) - 0.5 * squared[rows, edge]
    )
    # Pieces are uniform along the polygon: of two that explain them, the shorter is likelier.
    perimeter = np.maximum(np.nansum(length, axis=1), 1.0)
    inlier += np.log(
        _CORRELATED_PX * np.bincount(image, traces.weight, len(perimeter))[image] / perimeter[image]
    )
    total = np.logaddexp(inlier, np.log(_STRAY / (2 * _STRAY_PX * 2 * np.pi)))
    weight = traces.weight * np.exp(inlier - total)
    normal = np.stack([-along[rows, edge, 1], along[rows, edge, 0]], axis=-1)
    share = np.clip(at[rows, edge] / length[image, edge], 0.0, 1.0)
    slope = homography_jacobian(traces.px_from_map, vertices)
    jacobian = np.zeros((len(rows), *vertices.shape))
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
    """Information (2N, 2N) and gradient (2N,) of the vertices, image shifts marginalised.

    Then a function from a step (2N,) to the shifts (I, 2), px.
    """
    weighted = info[:, None] * jacobian
    images = len(traces.px_from_map)
    shifted = np.eye(2) / traces.shift_px[:, None, None] ** 2
    coupling = np.zeros((images, 2, jacobian.shape[1]))
    pull = np.zeros((images, 2))
    np.add.at(shifted, traces.image, info[:, None, None] * normal[:, :, None] * normal[:, None])
    np.add.at(coupling, traces.image, normal[:, :, None] * weighted[:, None])
    np.add.at(pull, traces.image, (info * off_px)[:, None] * normal)
    inverse = np.linalg.inv(shifted)
    gain = np.einsum("iju,ijk->iuk", coupling, inverse)
    information = weighted.T @ jacobian - np.einsum("iuk,ikv->uv", gain, coupling)
    gradient = weighted.T @ off_px - np.einsum("iuk,ik->u", gain, pull)
    return information, gradient, lambda step: np.einsum("ijk,ik->ij", inverse, pull - coupling @ step)
