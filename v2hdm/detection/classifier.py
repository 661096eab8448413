"""What the other quadrilaterals of an image say of one.

A site's markings are painted from few stencils: the diamonds of a field are of one size and lie one way, the
dashes of a line are as long as each other and follow one another in a row. Where the way bends, directions
turn with it, by an angle that grows with the distance, and a row is an arc. Flecks of sun do nothing of the
kind.

The judge: how probable it is that a quadrilateral is a whole marking, and which of its sides to trust.

It is asked twice. First of each reading alone: the network in ``judge.onnx`` gets the :mod:`.evidence` and
the view of the quadrilateral in its own frame (:mod:`.rectified`). It answers with log odds, and with how far
each side may be off for reasons that the fit's residuals do not show: worn ends, seams along a side, shadows,
something in front. Then of each among the others of its image: a logistic function of :mod:`.context`, whose
weights are in ``confidence.json``. Both files belong to the paint network beside them.

The markings of one image: propose, fit, judge.
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
from v2hdm.detection.camera import CameraView
from v2hdm.detection.evidence import gather, rectified_views
from v2hdm.detection.fit import TYPICAL_BLUR_PX, Fit, fit_quadrilaterals
from v2hdm.detection.lattice import Scene
from v2hdm.detection.network import Foreground, as_probability, open_session
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.patch import Quads
from v2hdm.detection.propose import Proposal, open_sides
from v2hdm.detection.weights import CONFIDENCE_FILE, JUDGE_FILE
from v2hdm.geometry.quadrilateral import side_frames
from v2hdm.records import DIAMOND, LANE_DASH, FloatArray, MarkingDetection

COMPANY = ("alike", "most_alike", "unlike", "surest_other", "in_line")
"""Names of the columns of :func:`company`, in order.

Of the others of its class, weighed by their probability: how many are like it, how much so is the likest, how
many are not, and how probable is the surest. Of dashes also: how probable is the surest one that follows in
its line after a gap; 0 for other classes.
"""

_LOG_SIZE_SIGMA = 0.2
_DIRECTION_SIGMA = 0.15
"""Markings of one stencil, as a single image shows them, differ by so much in log size and by so many rad."""

_BEND_RADIUS_M = 20.0
"""And by the angle that a bend of this radius turns by between them."""

_MOST = 3.0
"""More company than this adds nothing."""

_APART_M = 0.3
"""What is nearer is another reading of the same paint."""

_LEAST_GAP = 0.5
_LONGEST_GAP_M = 15.0
"""Dashes of a line are at least so many times their own length apart, and at most so far."""

_BESIDE_M = 0.3
_BESIDE_SHARE = 0.02
"""A line's dashes are so far at most beside an arc between them, and so much of their distance."""

_TURNED_RAD = 0.15
_SHARPEST_RADIUS_M = 12.0
_MOST_TURNED_RAD = 0.9
"""They differ by so much in direction at most, where the way is straight, where it bends, and altogether."""


def company(ground: FloatArray, kinds: Sequence[str], probability: FloatArray) -> FloatArray:
    """The :data:`COMPANY` (M, 5) of quadrilaterals.

    Args:
        ground: corners (M, 4, 2) on the ground, m; NaN above the horizon.
        kinds: their classes.
        probability: (M,) of each one's being a marking, as far as it shows on its own.
    """
    kind = np.array(kinds)
    size, axis, centre = _shapes(ground, kind)
    apart = centre[None] - centre[:, None]
    same = (kind[:, None] == kind) & (np.hypot(apart[..., 0], apart[..., 1]) > _APART_M)
    weight = np.where(same, probability, 0.0)
    log_size = np.log(size)
    misfit = ((log_size[:, None] - log_size) ** 2).sum(axis=2) / _LOG_SIZE_SIGMA**2
    turned = _turned(axis)
    may_turn = np.hypot(_DIRECTION_SIGMA, np.hypot(apart[..., 0], apart[..., 1]) / _BEND_RADIUS_M)
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
    tangent, _, length = side_frames(ground)
    sides = (tangent * length[..., None])[:, :2] - (tangent * length[..., None])[:, 2:]
    extents = np.where((kind == DIAMOND)[:, None, None], diagonals, sides / 2)
    size = np.hypot(extents[..., 0], extents[..., 1])
    longer = extents[np.arange(len(extents)), size.argmax(axis=1)]
    axis = longer / np.maximum(size.max(axis=1), 1e-9)[:, None]
    return np.clip(np.sort(size, axis=1), 0.01, 100.0), axis, ground.mean(axis=1)


def _turned(axis: FloatArray) -> FloatArray:
    """Angle (M, M), rad, between axes (M, 2) of no sense of direction."""
    return np.asarray(np.arccos(np.clip(np.abs(axis @ axis.T), 0.0, 1.0)))


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


JUDGE_INPUTS = ("views", "evidence", "shape")
JUDGE_OUTPUTS = ("odds", "log_side_sigma")

_Fit = tuple[FloatArray, float]
"""Weights (F,) and bias of a logistic function."""

TOLD = ("alone", *COMPANY)
"""What a quadrilateral is judged by among others: its own log odds, and what the others say."""

SHAPES = (DIAMOND, LANE_DASH, "bar")
"""Diamonds, lane dashes, and whatever else has four corners."""


def shape_of(kind: str) -> str:
    """The one of :data:`SHAPES` that a class with four corners has."""
    return kind if kind in SHAPES else SHAPES[-1]


def judge_alone(
    evidence: FloatArray, views: np.ndarray, kinds: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Log odds (R,) of each reading, and how far each of its sides may be off, px, (R, 4).

    Args:
        evidence: (R, F), in the order of :data:`~v2hdm.detection.evidence.FEATURES`.
        views: (R, C, S, S) float32 of :mod:`v2hdm.detection.evidence`; sides are in their order.
        kinds: the classes.
    """
    given = (views, evidence.astype(np.float32), one_hot(kinds))
    odds, log_sigma = _session(JUDGE_FILE).run(
        list(JUDGE_OUTPUTS), dict(zip(JUDGE_INPUTS, given, strict=True))
    )
    return odds.astype(np.float64), np.exp(log_sigma.astype(np.float64))


def judge_among(odds: FloatArray, ground: FloatArray, kinds: Sequence[str]) -> FloatArray:
    """Probability (R,) of readings that alone have such log odds (R,), all those of an image.

    Args:
        odds: (R,) of :func:`judge_alone`.
        ground: corners (R, 4, 2) on the ground, m.
        kinds: the classes.
    """
    fitted = _fitted(CONFIDENCE_FILE)
    weights, bias = zip(*(fitted[shape_of(kind)] for kind in kinds), strict=True)
    return as_probability((told(odds, ground, kinds) * np.array(weights)).sum(axis=1) + np.array(bias))


def one_hot(kinds: Sequence[str]) -> np.ndarray:
    """Which of the :data:`SHAPES` each class has: (R, 3) float32, 1 there and else 0."""
    return np.eye(len(SHAPES), dtype=np.float32)[[SHAPES.index(shape_of(kind)) for kind in kinds]]


def told(odds: FloatArray, ground: FloatArray, kinds: Sequence[str]) -> FloatArray:
    """The features (R, 6) :data:`TOLD` of readings, of the log odds (R,) that each has alone."""
    return np.column_stack([odds, company(ground, kinds, as_probability(odds))])


@cache
def _session(path: Path) -> Any:
    return open_session(path, threads=1)


@cache
def _fitted(path: Path) -> dict[str, _Fit]:
    """Weights and bias of each shape among others."""
    fitted = json.loads(path.read_text(encoding="utf-8"))
    return {
        shape: (np.array([part["weights"][name] for name in TOLD]), float(part["bias"]))
        for shape, part in fitted.items()
    }


@dataclass(frozen=True)
class Readings:
    """R readings of M fitted quadrilaterals, each of one as one class: what the judge is asked about.

    ``quadrilateral`` (R,) is the index of each, ``kinds`` its class; ``evidence`` (R, F) and ``views``
    (R, C, S, S) are what the judge sees, ``ground`` (R, 4, 2) the corners, m. The first side in a view is
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


def find_markings(
    readings: Readings | None, view: CameraView, options: DetectorOptions
) -> list[MarkingDetection]:
    """The quadrilaterals that are likely enough to be whole markings, each as its likeliest class."""
    if readings is None:
        return []
    odds, side_sigma_px = judge_alone(readings.evidence, readings.views, readings.kinds)
    score = judge_among(odds, readings.ground, readings.kinds)
    best = _best_of_each(readings.quadrilateral, score)
    turned = (np.arange(4) - readings.first_side[best, None]) % 4
    sigma_px = np.take_along_axis(side_sigma_px[best], turned, axis=1)
    corners_px, covariance = readings.fit.in_image(sigma_px)
    valid = largest_sigma(covariance) <= options.max_corner_sigma_px
    valid &= view.inside(corners_px, options.border_px)
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


def read_markings(
    image_bgr: np.ndarray,
    view: CameraView,
    proposals: Sequence[Proposal],
    foreground: Foreground,
    catalogue: Catalogue,
    blur_px: float | None,
) -> Readings | None:
    """Fit the proposals with four corners and gather the evidence for their classes; None for none."""
    tried = [(proposal, kinds) for proposal in proposals if (kinds := proposal.kinds(catalogue))]
    if not tried:
        return None
    chosen = [proposal for proposal, _ in tried]
    start = np.stack([p.corners_pinhole_px for p in chosen if p.corners_pinhole_px is not None])
    start_px = view.distort(start.reshape(-1, 2)).reshape(start.shape)
    blobs = np.array([p.index for p in chosen])
    scene = Scene(image_bgr, foreground, blobs, blobs + np.array([p.blob.parts for p in chosen]))
    fit = fit_quadrilaterals(scene, view, start_px, open_sides(start_px, view), blur_px or TYPICAL_BLUR_PX)
    corners_px, _ = fit.in_image()
    quads = Quads.seen(view, corners_px)
    ground = view.ground(view.undistort(corners_px.reshape(-1, 2))).reshape(corners_px.shape)
    rows = [(m, kind) for m, (_, kinds) in enumerate(tried) for kind in kinds]
    evidence = gather(fit, foreground, quads, ground, chosen, rows, catalogue)
    at = np.array([m for m, _ in rows], dtype=np.intp)
    kinds = [kind for _, kind in rows]
    views, first_side = rectified_views(
        image_bgr, view, foreground, quads.take(at), ground[at], kinds, catalogue
    )
    place = {p.index: m for m, p in enumerate(chosen)}
    parts = {
        m: [place[k] for k in range(p.index + 1, p.index + 1 + p.blob.parts) if k in place]
        for m, p in enumerate(chosen)
        if p.blob.parts
    }
    return Readings(
        fit, at, kinds, evidence, views, ground[at], first_side, {m: k for m, k in parts.items() if k}
    )


def _best_of_each(quadrilateral: np.ndarray, score: FloatArray) -> np.ndarray:
    """The reading (M,) of each quadrilateral with the highest score; of equals the likelier."""
    order = np.lexsort((-np.arange(len(score)), score))
    best = np.zeros(int(quadrilateral.max()) + 1, dtype=np.intp)
    best[quadrilateral[order]] = order
    return best


def largest_sigma(covariance: FloatArray) -> FloatArray:
    """Standard deviation (M, 4) of each corner in its least certain direction, from (M, 8, 8)."""
    u = np.arange(0, 8, 2)
    first, second, both = covariance[:, u, u], covariance[:, u + 1, u + 1], covariance[:, u, u + 1]
    return np.asarray(np.sqrt((first + second) / 2 + np.hypot((first - second) / 2, both)))
