"""How probable it is that a quadrilateral is a whole marking, and which of its sides to trust.

The classifier has two stages. The network in ``judge.onnx`` takes each reading alone: its :mod:`.evidence`
and picture. It gives log odds, and how far each side may be off for reasons that the fit's residuals do not
show: worn ends, seams along a side, shadows, something in front. Then a logistic function, whose weights are
in ``confidence.json``, takes each among the others of its image. Both files belong to the paint network.

A site's markings are painted from few stencils: the diamonds of a field are of one size and lie one way, the
dashes of a line are as long as each other and follow one another in a row. Where the way bends, directions
turn with it, by an angle that grows with the distance, and a row is an arc. Flecks of sun do nothing of the
kind.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from v2hdm.catalogue import Catalogue
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.evidence import gather, rectified_views
from v2hdm.detection.fit import TYPICAL_BLUR_PX, Fit, fit_quadrilaterals
from v2hdm.detection.network import as_probability, open_session
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.patch import ImageQuads, Patches
from v2hdm.detection.propose import Proposals, open_sides
from v2hdm.detection.weights import CONFIDENCE_FILE, JUDGE_FILE
from v2hdm.geometry.quadrilateral import Quad
from v2hdm.records import DIAMOND, LANE_DASH, STOP_LINE, BoolArray, FloatArray, MarkingDetection

JUDGE_INPUTS = ("views", "evidence", "shape")
JUDGE_OUTPUTS = ("odds", "log_side_sigma")

COMPANY = ("alike", "most_alike", "unlike", "surest_other", "in_line")
"""Names of the columns of :func:`company`, in order.

Of the others of its class, weighed by their probability: how many are like it, how much so is the likest, how
many are not, and how probable is the surest. Of dashes also: how probable is the surest one that follows in
its line after a gap; 0 for other classes.
"""

AMONG = ("alone", *COMPANY)
"""The features of a reading among others: its own log odds, and the company of the others."""

SHAPES = (DIAMOND, LANE_DASH, "bar")
"""Diamonds, lane dashes, and whatever else has four corners."""

COMPANIES = (STOP_LINE, *SHAPES)
"""Whose company is weighed apart: the bars of a crosswalk are many and alike, a stop line keeps none."""

_LOG_SIZE_SIGMA = 0.2
_DIRECTION_SIGMA = 0.15
"""Markings of one stencil, as a single image shows them, differ by so much in log size and by so many rad."""

_BEND_RADIUS_M = 20.0  # and by the angle that a bend of this radius turns by between them
_MOST = 3.0  # more company than this adds nothing
_APART_M = 0.3  # nearer quadrilaterals are readings of the same paint
_LEAST_GAP = 0.5
_LONGEST_GAP_M = 15.0
"""Dashes of a line are at least so many times their own length apart, and at most so far."""

_BESIDE_M = 0.3
_BESIDE_SHARE = 0.02
"""A line's dashes are so far at most beside an arc between them, and so much of their distance."""

_POINT_SHARE = 0.125
"""Largest standard deviation of a point, in parts of its marking's longer diagonal: two of these are a
deviation at which sightings are no longer taken for one shape (`association.shape_tolerance`)."""

_TURNED_RAD = 0.15
_SHARPEST_RADIUS_M = 12.0
_MOST_TURNED_RAD = 0.9
"""They differ by so much in direction at most, where the way is straight, where it bends, and altogether."""


@dataclass(frozen=True)
class Readings:
    """R readings of M fitted quadrilaterals, each of one as one class: the input of the classifier.

    ``quadrilateral`` (R,) is the index of each, ``kinds`` its class; ``evidence`` (R, F) and ``views``
    (R, C, S, S) are given to the network, ``ground`` (R, 4, 2) are corners, m. The first side in a view is
    side ``first_side`` (R,) of the quadrilateral. ``parts`` lists, by quadrilateral around a whole piece of
    paint, those around its parts: either the one or the others are markings.
    """

    fit: Fit
    quadrilateral: np.ndarray
    kinds: list[str]
    evidence: FloatArray
    views: np.ndarray
    ground: FloatArray
    first_side: np.ndarray
    parts: Mapping[int, Sequence[int]]


def read_markings(
    image_bgr: np.ndarray, found: Proposals, catalogue: Catalogue, blur_px: float | None
) -> Readings | None:
    """Fit the proposals with four corners and gather the evidence for their classes; None for none."""
    camera, output = found.camera, found.output
    tried = [(proposal, kinds) for proposal in found.pieces if (kinds := proposal.kinds(catalogue))]
    if not tried:
        return None
    chosen = [proposal for proposal, _ in tried]
    start = np.stack([p.corners_pinhole_px for p in chosen if p.corners_pinhole_px is not None])
    start_px = camera.distort(start.reshape(-1, 2)).reshape(start.shape)
    own = np.array([(p.index, p.index + p.blob.parts) for p in chosen])
    patches = Patches(image_bgr, camera, output, found.owner, start_px, own)
    cut = open_sides(start_px, camera)
    fit = fit_quadrilaterals(patches, camera, start_px, cut, blur_px or TYPICAL_BLUR_PX)
    quads, ground = ImageQuads.of(camera, fit.corners_px), Quad(camera.unproject(fit.corners_px))
    rows = [(m, kind) for m, (_, kinds) in enumerate(tried) for kind in kinds]
    evidence = gather(fit, output, quads, ground, chosen, rows, catalogue)
    views, first_side = rectified_views(patches, quads, ground, rows, catalogue)
    at, kinds = np.array([m for m, _ in rows], dtype=np.intp), [kind for _, kind in rows]
    place = {p.index: m for m, p in enumerate(chosen)}
    parts = {
        m: among
        for m, p in enumerate(chosen)
        if (among := [place[p.index + k] for k in range(1, 1 + p.blob.parts) if p.index + k in place])
    }
    return Readings(fit, at, kinds, evidence, views, ground.corners[at], first_side, parts)


def find_markings(
    readings: Readings | None, camera: RoadCamera, options: DetectorOptions
) -> list[MarkingDetection]:
    """The quadrilaterals that are likely enough to be whole markings, each as its likeliest class."""
    if readings is None:
        return []
    odds, side_sigma_px = classify_alone(readings.evidence, readings.views, readings.kinds)
    score = classify_among(odds, readings.ground, readings.kinds)
    # The reading of each quadrilateral with the highest score; of equals the likelier.
    order = np.lexsort((-np.arange(len(score)), score))
    best = np.zeros(int(readings.quadrilateral.max()) + 1, dtype=np.intp)
    best[readings.quadrilateral[order]] = order
    turned = (np.arange(4) - readings.first_side[best, None]) % 4
    corners_px = readings.fit.corners_px
    covariance = readings.fit.covariance_px(np.take_along_axis(side_sigma_px[best], turned, axis=1))
    valid = _are_points(covariance, corners_px, camera) & camera.inside(corners_px, options.border_px)
    left_out: set[int] = set()
    for whole, parts in readings.parts.items():
        if whole in left_out:
            continue
        surest = max(score[best[m]] for m in parts)
        left_out.update(parts if score[best[whole]] >= surest else [whole])
    return [
        MarkingDetection(readings.kinds[row], float(score[row]), corners_px[m], covariance[m], valid[m])
        for m, row in enumerate(best.tolist())
        if score[row] >= options.min_confidence and m not in left_out
    ]


def _are_points(covariance_px: FloatArray, corners_px: FloatArray, camera: RoadCamera) -> BoolArray:
    """Which corners (M, 4, 2) of covariances (M, 8, 8), px^2, lie at a place and not just on a line.

    The ground counts, and the marking's own size: a pixel is a millimetre here and half a metre there.
    """
    pinhole_px = camera.undistort(corners_px.reshape(-1, 2))
    ground = camera.ground(pinhole_px).reshape(corners_px.shape)
    # What the lens does to a pixel's size is little beside the share.
    by_px = camera.ground_jacobian(pinhole_px).reshape(-1, 4, 2, 2)
    corner = np.arange(4)
    own = covariance_px.reshape(-1, 4, 2, 4, 2)[:, corner, :, corner].swapaxes(0, 1)
    variance_m2 = np.trace(by_px @ own @ by_px.swapaxes(2, 3), axis1=2, axis2=3)
    largest_m2 = ((ground[:, :2] - ground[:, 2:]) ** 2).sum(axis=2).max(axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(variance_m2 <= _POINT_SHARE**2 * largest_m2[:, None])


def classify_alone(
    evidence: FloatArray, views: np.ndarray, kinds: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Log odds (R,) of each reading alone, and how far each of its sides may be off, px, (R, 4).

    ``evidence`` (R, F) and ``views`` (R, C, S, S) float32 are those of :mod:`.evidence`; sides are as in
    the views.
    """
    given = (views, evidence.astype(np.float32), one_hot(kinds))
    inputs = dict(zip(JUDGE_INPUTS, given, strict=True))
    odds, log_sigma = _session(JUDGE_FILE).run(list(JUDGE_OUTPUTS), inputs)
    return odds.astype(np.float64), np.exp(log_sigma.astype(np.float64))


def classify_among(odds: FloatArray, ground: FloatArray, kinds: Sequence[str]) -> FloatArray:
    """Probability (R,) of all readings of an image, whose log odds alone are (R,), corners (R, 4, 2), m."""
    fitted = _confidence(CONFIDENCE_FILE)
    weights, bias = zip(*(fitted[shape_of(kind, COMPANIES)] for kind in kinds), strict=True)
    features = features_among(odds, ground, kinds)
    return as_probability((features * np.array(weights)).sum(axis=1) + np.array(bias))


def features_among(odds: FloatArray, ground: FloatArray, kinds: Sequence[str]) -> FloatArray:
    """The features (R, 6) :data:`AMONG` of readings, of the log odds (R,) that each has alone."""
    return np.column_stack([odds, company(ground, kinds, as_probability(odds))])


def shape_of(kind: str, shapes: Sequence[str] = SHAPES) -> str:
    """The one of ``shapes`` that a class with four corners has."""
    return kind if kind in shapes else shapes[-1]


def one_hot(kinds: Sequence[str]) -> np.ndarray:
    """Which of the :data:`SHAPES` each class has: (R, 3) float32, 1 there and else 0."""
    return np.eye(len(SHAPES), dtype=np.float32)[[SHAPES.index(shape_of(kind)) for kind in kinds]]


@cache
def _session(path: Path) -> Any:
    return open_session(path, threads=1)


@cache
def _confidence(path: Path) -> dict[str, tuple[FloatArray, float]]:
    """Weights (F,) and bias of the logistic function of each of :data:`COMPANIES`."""
    fitted = json.loads(path.read_text(encoding="utf-8"))
    return {
        shape: (np.array([part["weights"][name] for name in AMONG]), float(part["bias"]))
        for shape, part in fitted.items()
    }


def company(ground: FloatArray, kinds: Sequence[str], probability: FloatArray) -> FloatArray:
    """The :data:`COMPANY` (M, 5) of quadrilaterals.

    ``ground`` (M, 4, 2) are corners, m, NaN above the horizon, ``probability`` (M,) is that of each one's
    being a marking, as far as it shows on its own.
    """
    kind = np.array(kinds)
    size, axis, centre = _shapes(ground, kind)
    apart = centre[None] - centre[:, None]
    distance = np.hypot(apart[..., 0], apart[..., 1])
    weight = np.where((kind[:, None] == kind) & (distance > _APART_M), probability, 0.0)
    weight[kind == STOP_LINE] = 0.0
    log_size = np.log(size)
    misfit = ((log_size[:, None] - log_size) ** 2).sum(axis=2) / _LOG_SIZE_SIGMA**2
    # Of axes that have no sense of direction.
    turned = np.arccos(np.clip(np.abs(axis @ axis.T), 0.0, 1.0))
    may_turn = np.hypot(_DIRECTION_SIGMA, distance / _BEND_RADIUS_M)
    alike = weight * np.exp(-0.5 * (misfit + (turned / may_turn) ** 2))
    in_line = (kind == LANE_DASH)[:, None] & _follows(apart, axis, size[:, 1], turned)
    columns = (
        np.minimum(alike.sum(axis=1), _MOST),
        alike.max(axis=1, initial=0.0),
        np.minimum((weight - alike).sum(axis=1), _MOST),
        weight.max(axis=1, initial=0.0),
        np.where(in_line, weight, 0.0).max(axis=1, initial=0.0),
    )
    return np.column_stack(columns)


def _shapes(ground: FloatArray, kind: np.ndarray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Short and long extent (M, 2), m, direction (M, 2) of the longer, and centre (M, 2).

    Diamonds extend along their diagonals, everything else along its sides.
    """
    ground = np.nan_to_num(ground)
    diagonals = ground[:, [2, 3]] - ground[:, [0, 1]]
    quad = Quad(ground)
    along = quad.tangent * quad.length[..., None]
    sides = along[:, :2] - along[:, 2:]
    extents = np.where((kind == DIAMOND)[:, None, None], diagonals, sides / 2)
    size = np.hypot(extents[..., 0], extents[..., 1])
    longer = extents[np.arange(len(extents)), size.argmax(axis=1)]
    axis = longer / np.maximum(size.max(axis=1), 1e-9)[:, None]
    return np.clip(np.sort(size, axis=1), 0.01, 100.0), axis, ground.mean(axis=1)


def _follows(apart: FloatArray, axis: FloatArray, length: FloatArray, turned: FloatArray) -> np.ndarray:
    """Which (M, M) others follow each along an arc, after a gap.

    The chord between two points of a circle makes equal and opposite angles with the tangents there.
    """
    distance = np.hypot(apart[..., 0], apart[..., 1])
    beside = 0.5 * distance * np.abs(_angle(axis[:, None], apart) + _angle(axis[None], apart))
    gap = distance - (length[:, None] + length) / 2
    sharpest = np.minimum(_TURNED_RAD + distance / _SHARPEST_RADIUS_M, _MOST_TURNED_RAD)
    on_arc = (beside < _BESIDE_M + _BESIDE_SHARE * distance) & (turned < sharpest)
    return np.asarray(on_arc & (gap >= _LEAST_GAP * length[:, None]) & (gap < _LONGEST_GAP_M))


def _angle(axis: FloatArray, chord: FloatArray) -> FloatArray:
    """From axes of no sense of direction to chords (..., 2), rad, at most a right angle either way."""
    across = axis[..., 0] * chord[..., 1] - axis[..., 1] * chord[..., 0]
    along = (axis * chord).sum(axis=-1)
    return np.asarray(np.arctan2(across * np.where(along < 0, -1.0, 1.0), np.abs(along)))
