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
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array

from v2hdm.geometry.ipm import apply_in_front, homography_jacobian
from v2hdm.geometry.planar import is_simple, length_along, points_along, signed_area
from v2hdm.records import BoolArray, FloatArray, IntArray
from v2hdm.site.shapes import EDGE_SIGMA_M, SHAPE_SIGMA_M, learn_paint_error

_SPACING_PX = 4.0  # length, px, of an outline's pieces: an element of the network's output
_CORRELATED_PX = 20.0
"""Correlation length of an outline, px: twice the integral of its autocorrelation in renders."""

_SIGMA_PX = 0.5  # prior sigma, px, of an outline about the paint's edge
_SIGMA_WEIGHT = 10.0  # number of independent points that this prior is worth
_TURN_SIGMA_RAD = 0.25  # sigma, rad, of the direction of a piece of outline about its edge's
_ROUND_PX = 3.0  # distance from a corner, px, that the network rounds

_STRAY = 0.2  # fraction of an outline that lies along no edge
_STRAY_PX = 25.0  # range, px, on either side of the edges, in which such pieces lie
LEAST_EXPLAINED = 1 - 2 * _STRAY  # least fraction of the outlines along their polygon's edges

_ANYWHERE_M = 0.5  # sigma, m, of vertices about the outline common to sightings
UNSEEN_M = _ANYWHERE_M / 2  # sigma, m, of vertices on which images add little to that prior

_SIZE_SIGMA = 0.02  # prior sigma of the logarithm of a symbol's sizes about its template's
_FREEDOM = 4.0  # number of symbols that this prior, and that of the vertices' own deviations, are worth

_MOST_VERTICES = 18  # most vertices of a symbol
_STEP_M = 0.1  # largest motion of a vertex in a step: beyond, other edges explain the pieces
_STEPS = 15  # steps of a fit from an outline
_FEW_STEPS = 4  # steps of a fit from a polygon that had one more vertex or another prior
_ROUNDS = 3  # rounds of learning a template


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

    @cached_property
    def of_images(self) -> csr_array:
        """The matrix (I, P) that sums over the pieces of each image."""
        pieces = len(self.image)
        places = np.arange(pieces)
        return csr_array((np.ones(pieces), (self.image, places)), shape=(len(self.px_from_map), pieces))

    @classmethod
    def of(
        cls,
        outlines_px: Sequence[FloatArray],
        seen_sides: Sequence[BoolArray],
        image: IntArray,
        px_from_map: FloatArray,
        shift_px: FloatArray,
    ) -> Traces:
        """Pieces of outlines (K, 2), each of an ``image`` (S,), along those ``seen_sides`` (K,)."""
        images = []
        points_px = []
        along_px = []
        weights = []
        for outline, is_seen, number in zip(outlines_px, seen_sides, image, strict=True):
            is_clockwise = signed_area(outline) < 0
            ring = outline if is_clockwise else outline[::-1]
            is_seen_side = is_seen if is_clockwise else np.roll(is_seen[::-1], -1)
            side = np.roll(ring, -1, axis=0) - ring
            length = np.linalg.norm(side, axis=1) * is_seen_side
            count = np.ceil(length / _SPACING_PX).astype(np.int64)
            # Each side is cut into pieces of one length; ``of_side`` numbers the side of each piece.
            of_side = np.repeat(np.arange(len(ring)), count)
            piece_in_side = np.arange(len(of_side)) - (np.cumsum(count) - count)[of_side]
            share = (piece_in_side + 0.5) / count[of_side]
            images.append(np.full(len(of_side), number))
            points_px.append(ring[of_side] + share[:, None] * side[of_side])
            along_px.append(side[of_side] / length[of_side, None])
            weights.append(length[of_side] / count[of_side] / _CORRELATED_PX)
        return cls(
            px_from_map=px_from_map,
            shift_px=shift_px,
            image=np.concatenate(images),
            points_px=np.concatenate(points_px),
            along_px=np.concatenate(along_px),
            weight=np.concatenate(weights),
        )


@dataclass(frozen=True)
class Polygon:
    """The ``vertices`` (N, 2), m, of a symbol, counter-clockwise, in the order of its template.

    ``covariance`` (2N, 2N), m^2, is of the stacked vertices, ``data`` the information from images alone,
    ``gradient`` (2N,) that of their log-likelihood; ``evidence`` is the log marginal likelihood,
    ``explained`` the fraction of the outlines along its edges.
    """

    vertices: FloatArray
    covariance: FloatArray
    data: FloatArray
    gradient: FloatArray
    evidence: float
    explained: float


Prior = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Prior mean (2N,) and covariance (2N, 2N) of vertices near (N, 2)."""


def find_polygons(
    kinds: Sequence[str], traces: Sequence[Traces], outlines: Sequence[FloatArray]
) -> list[Polygon]:
    """Polygons of symbols of classes ``kinds``, from their traces, started from ``outlines`` (K, 2)."""
    own_polygons = [_own_polygon(trace, outline) for trace, outline in zip(traces, outlines, strict=True)]
    polygons = list(own_polygons)
    classes: list[tuple[_Template, list[int]]] = []
    for k in np.argsort([-trace.weight.sum() for trace in traces]).tolist():
        best = own_polygons[k]
        home = None
        for template, members in classes:
            if kinds[members[0]] == kinds[k]:
                for start in template.laid_about(outlines[k]):
                    polygon = _fit(traces[k], start, template.prior)
                    if polygon.evidence > best.evidence and is_simple(polygon.vertices):
                        best = polygon
                        home = members
        polygons[k] = best
        if home is not None:
            home.append(k)
        elif is_simple(best.vertices):
            classes.append((_Template.of(best), [k]))
    for template, members in classes:
        members_traces = [traces[k] for k in members]
        members_polygons = [polygons[k] for k in members]
        if len(members) > 1:
            template, members_polygons = _of_template(template, members_traces, members_polygons)
        edge_errors = template.edge_errors(members_polygons)
        for k, polygon, error in zip(members, members_polygons, edge_errors, strict=True):
            polygons[k] = replace(polygon, covariance=polygon.covariance + error)
    return polygons


def _of_template(
    template: _Template, traces: Sequence[Traces], polygons: list[Polygon]
) -> tuple[_Template, list[Polygon]]:
    """Symbols as polygons of their template, re-learned without vertices that only its first symbol had."""
    for _ in range(_ROUNDS):
        template, polygons = _taught(template, traces, polygons)
    while len(template.vertices) > 3:
        remaining = _but_flattest(template.vertices)
        coordinates = np.repeat(remaining, 2)
        covariance = template.covariance[np.ix_(coordinates, coordinates)]
        fewer = replace(template, vertices=template.vertices[remaining], covariance=covariance)
        refitted = [
            _fit(trace, polygon.vertices[remaining], fewer.prior, _FEW_STEPS)
            for trace, polygon in zip(traces, polygons, strict=True)
        ]
        fewer, refitted = _taught(fewer, traces, refitted)
        if sum(polygon.evidence for polygon in refitted) < sum(polygon.evidence for polygon in polygons):
            break
        template, polygons = _taught(fewer, traces, refitted)
    return template, polygons


def _taught(
    template: _Template, traces: Sequence[Traces], polygons: Sequence[Polygon]
) -> tuple[_Template, list[Polygon]]:
    """The template learned from all symbols, and each symbol under that of the others."""
    template, others = template.learnt(polygons)
    refitted = [
        _fit(trace, polygon.vertices, other.prior, _FEW_STEPS)
        for trace, polygon, other in zip(traces, polygons, others, strict=True)
    ]
    return template, refitted


def _own_polygon(traces: Traces, outline: FloatArray) -> Polygon:
    """Most likely polygon of its own shape about an outline; vertices go while that is likelier."""
    vertices = outline
    while len(vertices) > _MOST_VERTICES:
        vertices = vertices[_but_flattest(vertices)]
    now = _fit(traces, vertices, _anywhere(vertices))
    polygons = [now]
    while len(now.vertices) > 3:
        vertices = now.vertices[_but_flattest(now.vertices)]
        now = _fit(traces, vertices, _anywhere(vertices), _FEW_STEPS)
        polygons.append(now)
    best = max(polygons, key=lambda polygon: (is_simple(polygon.vertices), polygon.evidence))
    refined = _fit(traces, best.vertices, _anywhere(best.vertices))
    return refined if is_simple(refined.vertices) else best


def _anywhere(start: FloatArray) -> Prior:
    """The prior of vertices about an outline ``start`` (N, 2)."""
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
        deviations_m2 = self.paint_m**2 * np.eye(len(basis)) + sized @ sized.T
        return np.asarray(deviations_m2 + _ANYWHERE_M**2 * len(self.vertices) * basis @ basis.T)

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
        template = (self.vertices - _evenly(self.vertices).mean(axis=0)) @ [1, 1j] * (axes[0] @ [1, 1j])
        turned = [template * turn for turn in (1, 1j, -1, -1j)]
        return [np.column_stack([ring.real, ring.imag]) + points.mean(axis=0) for ring in turned]

    def learnt(self, members: Sequence[Polygon]) -> tuple[_Template, list[_Template]]:
        """The template of all members, and for each member that of the others."""
        mean = self.vertices.ravel()
        spread = np.linalg.inv(self.spread)
        paint_m2 = _FREEDOM * SHAPE_SIGMA_M**2
        sizes_squared = _FREEDOM * np.full(2, _SIZE_SIGMA**2)
        information = []
        pulls = []
        for member in members:
            rotation, place = self.pose(member.vertices)
            turn = np.kron(np.eye(len(member.vertices)), rotation)
            data = turn.T @ member.data @ turn
            vertices_of_template = ((member.vertices - place) @ rotation).ravel()
            # Information of the images on the template, the symbol's own deviations marginalised.
            gain = spread @ np.linalg.inv(data + spread)
            member_information = gain @ data
            pull = gain @ (data @ vertices_of_template + turn.T @ member.gradient)
            information.append(member_information)
            pulls.append(pull)
            # Second moments of those deviations given the images (expectation maximisation).
            deviation = pull - member_information @ mean
            size_variance = np.square(self.sizes)
            paint_m2 += self.paint_m**2 * (
                1 + self.paint_m**2 * (deviation @ deviation - np.trace(member_information)) / len(deviation)
            )
            by_size = self.stretch.T @ member_information @ self.stretch
            sizes_squared += size_variance * (
                1 + size_variance * ((self.stretch.T @ deviation) ** 2 - np.diag(by_size))
            )
        count = _FREEDOM + len(members)
        paint_m = float(np.sqrt(paint_m2 / count))
        sizes = tuple(np.sqrt(sizes_squared / count).tolist())

        def of(rows: Sequence[int]) -> _Template:
            about = np.eye(mean.size) / _ANYWHERE_M**2
            covariance = np.linalg.inv(sum((information[k] for k in rows), about))
            vertices = covariance @ sum((pulls[k] for k in rows), about @ mean)
            symmetric = (covariance + covariance.T) / 2
            return _Template(vertices.reshape(-1, 2), symmetric, paint_m, sizes)

        everyone = range(len(members))
        return of(everyone), [of([k for k in everyone if k != member]) for member in everyone]

    def edge_errors(self, members: Sequence[Polygon]) -> list[FloatArray]:
        """Covariances (2N, 2N), m^2, of errors common to all images, from each member's deviation."""
        if len(members) < 2:
            return [EDGE_SIGMA_M**2 * np.eye(self.vertices.size)]
        off = []
        formal = []
        for member, other in zip(members, self.learnt(members)[1], strict=True):
            off += list(member.vertices - other.prior(member.vertices)[0].reshape(-1, 2))
            formal += [member.covariance[n : n + 2, n : n + 2] for n in range(0, member.vertices.size, 2)]
        error = learn_paint_error(off, formal)
        edge_m2 = [
            error.variance_m2(deviation, formal_m2) for deviation, formal_m2 in zip(off, formal, strict=True)
        ]
        return [np.diag(np.repeat(variances, 2)) for variances in np.split(np.array(edge_m2), len(members))]


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
        pieces = _explained(traces, vertices, shift_px, sigma_px)
        squared = _SIGMA_WEIGHT * _SIGMA_PX**2 + pieces.weight @ pieces.off_px**2
        count = _SIGMA_WEIGHT + pieces.weight.sum()
        sigma_px = float(np.sqrt(squared / count))
        equations = _normal_equations(traces, pieces, shift_px, sigma_px)
        mean, covariance = prior(vertices)
        precision = np.linalg.inv(covariance)
        step = np.linalg.solve(
            equations.information + precision,
            equations.gradient + precision @ (mean - vertices.ravel()),
        )
        step = step * min(1.0, _STEP_M / float(np.abs(step).max()))
        vertices = np.asarray(vertices + step.reshape(-1, 2))
        shift_px = equations.shifts_after(np.asarray(step))
    mean, covariance = prior(vertices)
    precision = np.linalg.inv(covariance)
    off = mean - vertices.ravel()
    data = equations.information
    evidence = pieces.log_likelihood - 0.5 * off @ precision @ off
    evidence -= 0.5 * (np.linalg.slogdet(data + precision)[1] + np.linalg.slogdet(covariance)[1])
    return Polygon(
        vertices=vertices,
        covariance=np.linalg.inv(data + precision),
        data=data,
        # Linear in the last step: nothing pulls a vertex that no image shows, converged or not.
        gradient=equations.gradient - data @ step,
        evidence=float(evidence),
        explained=float(pieces.weight.sum() / max(traces.weight.sum(), 1e-9)),
    )


class _Explained(NamedTuple):
    """P pieces of outlines, each beside the most likely of a polygon's N edges."""

    weight: FloatArray  # (P,) effective number of independent observations
    off_px: FloatArray  # (P,) offset, px, from the edge
    normal: FloatArray  # (P, 2) outer normal of the edge
    jacobian: FloatArray  # (P, 2N) derivative of the edge, along its normal, by the vertices
    log_likelihood: float  # of all pieces


def _explained(traces: Traces, vertices: FloatArray, shift_px: FloatArray, sigma_px: float) -> _Explained:
    """The pieces of ``traces`` beside the edges of a polygon with ``vertices`` (N, 2).

    ``shift_px`` (I, 2) are the images' shifts, ``sigma_px`` is the outlines' standard deviation.
    """
    rows = np.arange(len(traces.image))
    image = traces.image
    pixel = apply_in_front(traces.px_from_map, vertices)
    side = np.roll(pixel, -1, axis=1) - pixel
    length = np.maximum(np.linalg.norm(side, axis=2), 1e-6)
    # By coordinate: sums over an axis of two are slow.
    along_u, along_v = np.moveaxis(side / length[..., None], -1, 0)[:, image]
    point_u, point_v = (traces.points_px - shift_px[image]).T[..., None]
    offset_u = point_u - pixel[image, :, 0]
    offset_v = point_v - pixel[image, :, 1]
    along_px = offset_u * along_u + offset_v * along_v
    off = along_u * offset_v - along_v * offset_u
    end = np.nan_to_num(np.minimum(along_px, length[image] - along_px))
    cosine = along_u * traces.along_px[:, :1] + along_v * traces.along_px[:, 1:]
    turn = np.arccos(np.clip(cosine, -1, 1))
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
    normal = np.stack([-along_v[rows, edge], along_u[rows, edge]], axis=-1)
    share = np.clip(along_px[rows, edge] / length[image, edge], 0.0, 1.0)
    slope = homography_jacobian(traces.px_from_map, vertices)
    jacobian = np.zeros((len(rows), *vertices.shape))
    for corner, part in ((edge, 1 - share), ((edge + 1) % len(vertices), share)):
        jacobian[rows, corner] = part[:, None] * np.einsum("pi,pij->pj", normal, slope[image, corner])
    is_near = weight > 0
    return _Explained(
        weight=weight,
        off_px=np.where(is_near, off[rows, edge], 0.0),
        normal=np.where(is_near[:, None], normal, 0.0),
        jacobian=np.where(is_near[:, None, None], jacobian, 0.0).reshape(len(rows), -1),
        log_likelihood=float(traces.weight @ total),
    )


class _NormalEquations(NamedTuple):
    """Normal equations of N vertices, with the shifts of I images marginalised."""

    information: FloatArray  # (2N, 2N)
    gradient: FloatArray  # (2N,)
    shifts_after: Callable[[FloatArray], FloatArray]  # shifts (I, 2), px, that follow a step (2N,)


def _normal_equations(
    traces: Traces, pieces: _Explained, shift_px: FloatArray, sigma_px: float
) -> _NormalEquations:
    """The normal equations from ``pieces``, which lie beside edges under ``shift_px`` (I, 2)."""
    info = pieces.weight / sigma_px**2
    normal = pieces.normal
    jacobian = pieces.jacobian
    off_px = pieces.off_px + (normal * shift_px[traces.image]).sum(axis=1)
    weighted = info[:, None] * jacobian
    by_shift = np.concatenate([normal, off_px[:, None], jacobian], axis=1)
    along_u, along_v = (traces.of_images @ (column[:, None] * by_shift) for column in (info * normal.T))
    sums = np.stack([along_u, along_v], axis=1)  # (I, 2, 3 + 2N) of the images' pieces
    shifted = np.eye(2) / traces.shift_px[:, None, None] ** 2 + sums[..., :2]
    pull = sums[..., 2]
    coupling = sums[..., 3:]
    inverse = np.linalg.inv(shifted)
    gain = coupling.swapaxes(1, 2) @ inverse
    information = weighted.T @ jacobian - np.tensordot(gain, coupling, axes=([0, 2], [0, 1]))
    gradient = weighted.T @ off_px - np.tensordot(gain, pull, axes=([0, 2], [0, 1]))
    return _NormalEquations(
        information, gradient, lambda step: np.einsum("ijk,ik->ij", inverse, pull - coupling @ step)
    )
