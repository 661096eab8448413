"""How probable it is that a quadrilateral is a whole marking, and which of its sides to trust.

The network in ``judge.onnx`` takes each reading alone: numbers about a fitted quadrilateral, and a picture of
it in its own frame, where every marking of a class looks alike (as Faster R-CNN's region of interest, Ren et
al., NeurIPS 2015): what sets a worn marking off from a fleck of sun is left. It gives log odds, and how far
each side may be off for reasons that the fit's residuals do not show: worn ends, seams along a side, shadows,
something in front. Then a logistic function, whose weights are in ``confidence.json``, takes each among the
others of its image (:mod:`.company`). Both files belong to the paint network.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v2hdm.catalogue import Catalogue
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.company import COMPANY, company
from v2hdm.detection.crosswalks import LEAST_NAMED, in_rows
from v2hdm.detection.evidence import FEATURES, gather, rectified_views
from v2hdm.detection.hidden import hidden_ends
from v2hdm.detection.network import as_probability, open_session
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.quads.fit import OPEN_SIGMA, TYPICAL_BLUR_PX, Fit, fit_quadrilaterals
from v2hdm.detection.quads.patch import ImageQuads, Patches
from v2hdm.detection.quads.propose import Proposal, Proposals, open_sides
from v2hdm.detection.steps import Steps
from v2hdm.detection.weights import CONFIDENCE_FILE, JUDGE_FILE
from v2hdm.geometry.planar import Quad
from v2hdm.records import (
    CROSSWALK_BAR,
    DIAMOND,
    LANE_DASH,
    STOP_LINE,
    BoolArray,
    FloatArray,
    IntArray,
    MarkingDetection,
)

JUDGE_INPUTS = ("views", "evidence", "shape")
JUDGE_OUTPUTS = ("odds", "log_side_sigma")

AMONG = ("alone", *COMPANY)  # features of a reading among others: its own log odds, and their company

SHAPES = (DIAMOND, LANE_DASH, "bar")  # diamonds, lane dashes, and whatever else has four corners

COMPANIES = (STOP_LINE, *SHAPES)
"""Whose company is weighed apart: the bars of a crosswalk are many and alike, a stop line keeps none."""

_POINT_SHARE = 0.125
"""Largest standard deviation of a point, in parts of its marking's longer diagonal: two of these are a
deviation at which sightings are no longer taken for one shape (`association.shape_tolerance`)."""


@dataclass(frozen=True)
class Readings:
    """R readings of M fitted quadrilaterals, each of one as one class: the input of the classifier."""

    fit: Fit
    quadrilateral: np.ndarray  # (R,) index of each
    kinds: list[str]  # its class
    evidence: FloatArray  # (R, F) for the network
    views: np.ndarray  # (R, C, S, S) for the network
    ground: FloatArray  # (R, 4, 2) corners, m
    first_side: np.ndarray  # (R,) the quadrilateral's side that is the first in a view
    hidden_ends: BoolArray  # (M, 4) ends of what is seen of it rather than of its paint
    # by quadrilateral around a piece, those around its parts: one or the others are markings
    parts: Mapping[int, Sequence[int]]


def reading_steps(
    image_bgr: np.ndarray, proposals: Proposals, catalogue: Catalogue, blur_px: float | None
) -> Steps[Readings | None]:
    """Fit the proposals with four corners, then gather the evidence for their classes; None for none."""
    camera = proposals.camera
    output = proposals.output
    kinds_of_piece = [proposal.kinds(catalogue) for proposal in proposals.pieces]
    pieces = [piece for piece, kinds in zip(proposals.pieces, kinds_of_piece, strict=True) if kinds]
    if not pieces:
        return None
    readings = [(m, kind) for m, kinds in enumerate(filter(None, kinds_of_piece)) for kind in kinds]
    start = np.stack([p.corners_pinhole_px for p in pieces if p.corners_pinhole_px is not None])
    start_px = camera.distort(start.reshape(-1, 2)).reshape(start.shape)
    first_and_last = np.array([(p.index, p.index + p.blob.parts) for p in pieces])
    patches = Patches(image_bgr, camera, output, proposals.owner, first_and_last)
    cut_sides = open_sides(start_px, camera)
    fit = fit_quadrilaterals(patches, camera, start_px, cut_sides, blur_px or TYPICAL_BLUR_PX)
    yield
    quads = ImageQuads.of(camera, fit.corners_px)
    ground = Quad(camera.unproject(fit.corners_px))
    evidence = gather(fit, output, quads, ground, pieces, readings, catalogue)
    views, first_side = rectified_views(patches, quads, ground, readings, catalogue)
    quadrilateral = np.array([m for m, _ in readings], dtype=np.intp)
    return Readings(
        fit=fit,
        quadrilateral=quadrilateral,
        kinds=[kind for _, kind in readings],
        evidence=evidence,
        views=views,
        ground=ground.corners[quadrilateral],
        first_side=first_side,
        hidden_ends=hidden_ends(patches, quads, ground),
        parts=_parts(pieces),
    )


def _parts(pieces: Sequence[Proposal]) -> dict[int, list[int]]:
    """By piece that is there with some of its parts, the indices of those."""
    place_of = {piece.index: m for m, piece in enumerate(pieces)}
    parts = {}
    for m, piece in enumerate(pieces):
        indices = range(piece.index + 1, piece.index + 1 + piece.blob.parts)
        if places := [place_of[index] for index in indices if index in place_of]:
            parts[m] = places
    return parts


def find_markings(
    readings: Readings | None, camera: RoadCamera, options: DetectorOptions
) -> list[MarkingDetection]:
    """The quadrilaterals that are likely enough to be whole markings, each as its likeliest class."""
    if readings is None:
        return []
    likeliest = likeliest_readings(readings)
    best = likeliest.reading
    score = in_rows(likeliest.score, readings.ground[best], likeliest.may_be_bar)
    turned = (np.arange(4) - readings.first_side[best, None]) % 4
    corners_px = readings.fit.corners_px
    side_sigma_px = np.take_along_axis(likeliest.side_sigma_px, turned, axis=1)
    # Its paint may go on behind the thing for any length.
    length_px = readings.fit.quad.length.max(axis=1)[:, None]
    side_sigma_px = np.where(readings.hidden_ends, OPEN_SIGMA * length_px, side_sigma_px)
    covariance = readings.fit.covariance_px(side_sigma_px)
    valid = _are_points(covariance, corners_px, camera) & camera.inside(corners_px, options.border_px)
    return [
        MarkingDetection(readings.kinds[row], float(score[m]), corners_px[m], covariance[m], valid[m])
        for m, row in enumerate(best.tolist())
        if score[m] >= options.min_confidence and not likeliest.is_left_out[m]
    ]


class Likeliest(NamedTuple):
    """The likeliest reading of each of M quadrilaterals."""

    reading: IntArray  # (M,)
    score: FloatArray  # (M,) its probability
    side_sigma_px: FloatArray  # (M, 4) how far each side in its view may be off
    is_left_out: BoolArray  # (M,) for the sake of its parts, or of what it is a part of
    may_be_bar: BoolArray  # (M,) of a crosswalk


def likeliest_readings(readings: Readings) -> Likeliest:
    """The likeliest reading of each quadrilateral of one image, before rows of bars are looked for."""
    odds, side_sigma_px = classify_alone(readings.evidence, readings.views, readings.kinds)
    score = classify_among(odds, readings.ground, readings.kinds)
    # The reading of each quadrilateral with the highest score; of equals the likelier.
    order = np.lexsort((-np.arange(len(score)), score))
    best = np.zeros(int(readings.quadrilateral.max()) + 1, dtype=np.intp)
    best[readings.quadrilateral[order]] = order
    is_left_out = np.zeros(len(best), dtype=np.bool_)
    is_left_out[list(_left_out(readings.parts, score[best]))] = True
    is_bar = np.array([kind == CROSSWALK_BAR for kind in readings.kinds])[best]
    is_named = readings.evidence[best, FEATURES.index("share")] >= LEAST_NAMED
    return Likeliest(best, score[best], side_sigma_px[best], is_left_out, is_bar & is_named & ~is_left_out)


def _left_out(parts_of: Mapping[int, Sequence[int]], score: FloatArray) -> set[int]:
    """Quadrilaterals, of scores (M,), that are no markings: parts of surer ones, wholes with a surer part."""
    left_out: set[int] = set()
    for whole, parts in parts_of.items():
        if whole not in left_out:
            surest_part = max(score[m] for m in parts)
            left_out.update(parts if score[whole] >= surest_part else [whole])
    return left_out


def _are_points(covariance_px: FloatArray, corners_px: FloatArray, camera: RoadCamera) -> BoolArray:
    """Which corners (M, 4, 2) lie at a place and not just on a line, for the marking's size on the ground."""
    pinhole_px = camera.undistort(corners_px.reshape(-1, 2))
    ground = camera.ground(pinhole_px).reshape(corners_px.shape)
    # What the lens does to a pixel's size is little beside the share.
    by_px = camera.ground_jacobian(pinhole_px).reshape(-1, 4, 2, 2)
    corner = np.arange(4)
    of_corner_px2 = covariance_px.reshape(-1, 4, 2, 4, 2)[:, corner, :, corner].swapaxes(0, 1)
    variance_m2 = np.trace(by_px @ of_corner_px2 @ by_px.swapaxes(2, 3), axis1=2, axis2=3)
    largest_m2 = ((ground[:, :2] - ground[:, 2:]) ** 2).sum(axis=2).max(axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(variance_m2 <= _POINT_SHARE**2 * largest_m2[:, None])


def classify_alone(
    evidence: FloatArray, views: np.ndarray, kinds: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Log odds (R,) of each reading alone, and how far each side in its view may be off, px, (R, 4)."""
    arrays = (views, evidence.astype(np.float32), one_hot(kinds))
    inputs = dict(zip(JUDGE_INPUTS, arrays, strict=True))
    odds, log_sigma = _session(JUDGE_FILE).run(list(JUDGE_OUTPUTS), inputs)
    return odds.astype(np.float64), np.exp(log_sigma.astype(np.float64))


def classify_among(odds: FloatArray, ground: FloatArray, kinds: Sequence[str]) -> FloatArray:
    """Probability (R,) of all readings of an image, whose log odds alone are (R,), corners (R, 4, 2), m."""
    functions = _confidence(CONFIDENCE_FILE)
    of_reading = [functions[shape_of(kind, COMPANIES)] for kind in kinds]
    weights = np.array([weights for weights, _ in of_reading])
    bias = np.array([bias for _, bias in of_reading])
    features = features_among(odds, ground, kinds)
    return as_probability((features * weights).sum(axis=1) + bias)


def features_among(odds: FloatArray, ground: FloatArray, kinds: Sequence[str]) -> FloatArray:
    """The features (R, 6) :data:`AMONG` of readings, of the log odds (R,) that each has alone."""
    return np.column_stack([odds, company(ground, kinds, as_probability(odds))])


def shape_of(kind: str, shapes: Sequence[str] = SHAPES) -> str:
    """The one of ``shapes`` that a class with four corners has."""
    return kind if kind in shapes else shapes[-1]


def one_hot(kinds: Sequence[str]) -> np.ndarray:
    """Which of the :data:`SHAPES` each class has: (R, 3) float32, 1 there and else 0."""
    return np.eye(len(SHAPES), dtype=np.float32)[[SHAPES.index(shape_of(kind)) for kind in kinds]]


_session = cache(partial(open_session, threads=1))


@cache
def _confidence(path: Path) -> dict[str, tuple[FloatArray, float]]:
    """Weights (F,) and bias of the logistic function of each of :data:`COMPANIES`."""
    functions = json.loads(path.read_text(encoding="utf-8"))
    return {
        shape: (np.array([function["weights"][name] for name in AMONG]), float(function["bias"]))
        for shape, function in functions.items()
    }
