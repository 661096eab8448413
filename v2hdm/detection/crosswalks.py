"""Crosswalks in an image: rows of bars, which make each other likelier, and paint that continues a row.

From afar, and over a camera whose mounting is known about, a bar by itself shows little. But hardly anything
other than a crosswalk shows paint that the network names so in an even row of alike quadrilaterals. Beyond
such a row even paint that has the shape of no bar, worn or blurred, belongs to the crosswalk.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.network import as_log_odds, as_probability
from v2hdm.detection.quads.propose import Proposal
from v2hdm.geometry.planar import following, turned_left
from v2hdm.geometry.rows import IN_IMAGE, LEAST_BARS, rows_of_bars
from v2hdm.records import CROSSWALK, CROSSWALK_BAR, BoolArray, FloatArray, MarkingDetection

FEATURES = ("row", "alone", "bars")
"""Features of a bar in a row: 1; its log odds alone; log of the row's number of bars over the least."""

FITTED = (1.87, 0.19, 3.04)
"""Weights of the features, fitted to photographs and renders by ``python -m train.fit_crosswalks``."""

LEAST_NAMED = 0.5  # least share of a bar's paint that the network names so, for a place in a row

CONTINUING = ("named", "beyond", "aside")
"""Features of a piece of paint that the network names a bar: 1; its distance beyond the row, in steps of the
row's last bars; log of its reach aside from the line through the bars, in half their lengths, 0 for a bar."""

CONTINUING_FITTED = (1.99, -0.56, -1.31)
"""Weights of the features :data:`CONTINUING`, fitted by ``python -m train.fit_crosswalks``."""

MOST_BEYOND = 3.0  # steps beyond a row at most: two bars may be missing, as inside a row
_NEXT_PLACE = 0.5  # steps beyond a row from which paint takes the place of its last bar


def row_features(score: FloatArray) -> FloatArray:
    """The :data:`FEATURES` (N, F) of the bars of a row, whose probability alone is ``score`` (N,)."""
    alone = as_log_odds(score)
    bars = np.full(len(alone), np.log(len(alone) / LEAST_BARS))
    return np.column_stack([np.ones(len(alone)), alone, bars])


def in_rows(score: FloatArray, ground: FloatArray, is_bar: BoolArray) -> FloatArray:
    """The probabilities ``score`` (N,) of quadrilaterals, given the rows that some of them are in.

    ``ground`` (N, 4, 2) are corners, m, NaN above the horizon; ``is_bar`` (N,) tells which may be bars.
    """
    candidates = np.flatnonzero(is_bar & np.isfinite(ground).all(axis=(1, 2)))
    raised = score.copy()
    for row in rows_of_bars(ground[candidates], IN_IMAGE):
        members = candidates[row]
        raised[members] = as_probability(row_features(score[members]) @ np.array(FITTED))
    return raised


def pieces_named_bars(pieces: Sequence[Proposal]) -> list[Proposal]:
    """The pieces of paint that the network names bars of crosswalks, with their outlines on the ground."""
    return [
        piece
        for piece in pieces
        if piece.score_of([CROSSWALK_BAR]) >= LEAST_NAMED * piece.certainty
        and np.isfinite(piece.outline_vehicle).all()
    ]


def continuing_features(centres: FloatArray, length_m: float, outline: FloatArray) -> FloatArray:
    """The features :data:`CONTINUING` (3,) of a piece with an ``outline`` (K, 2), m, beside a row.

    ``centres`` (N, 2), m, are those of its bars in order, and ``length_m`` is their usual length.
    """
    way = np.diff(centres, axis=0)
    step = np.maximum(np.linalg.norm(way, axis=1), 1e-9)
    offset = outline.mean(axis=0) - centres[:-1]
    along = (offset * way).sum(axis=1) / step**2
    beyond = np.maximum(np.maximum(-along, along - 1.0), 0.0)
    aside_m = np.abs((offset * turned_left(way)).sum(axis=1)) / step
    nearest = int(np.lexsort((aside_m, beyond))[0])
    reach_m = np.abs((outline - centres[nearest]) @ turned_left(way[nearest])).max() / step[nearest]
    return np.array([1.0, beyond[nearest], np.log(max(2.0 * reach_m / length_m, 1.0))])


def _continuing(corners: FloatArray, pieces: Sequence[Proposal]) -> list[Proposal]:
    """The pieces that continue a row of bars (N, 4, 2) in order, m, on the ground, the likeliest first."""
    centres = corners.mean(axis=1)
    length_m = usual_length_m(corners)
    left = list(pieces)
    continuing = []
    while left:
        features = np.array([continuing_features(centres, length_m, piece.outline_vehicle) for piece in left])
        odds = np.where(features[:, 1] <= MOST_BEYOND, features @ np.array(CONTINUING_FITTED), -np.inf)
        likeliest = int(odds.argmax())
        if odds[likeliest] <= 0:
            break
        continuing.append(left.pop(likeliest))
        if features[likeliest, 1] > _NEXT_PLACE:
            middle = continuing[-1].outline_vehicle.mean(axis=0)
            distance = np.linalg.norm(centres[[0, -1]] - middle, axis=1)
            place = 0 if distance[0] < distance[1] else len(centres)
            centres = np.insert(centres, place, middle, axis=0)
    return continuing


def usual_length_m(corners: FloatArray) -> float:
    """The median length of bars (N, 4, 2), m."""
    sides = (corners + following(corners)) / 2
    sizes = np.linalg.norm(sides[:, 2:] - sides[:, :2], axis=2)
    return max(float(np.median(sizes.max(axis=1))), 1e-9)


def find_crosswalks(
    markings: Sequence[MarkingDetection], camera: RoadCamera, pieces: Sequence[Proposal] = ()
) -> list[tuple[MarkingDetection, tuple[int, ...]]]:
    """The crosswalks of an image's bars, each with the hull ``outline_px`` and the indices of its bars.

    Of ``pieces`` of the image's paint, those that continue a row are in its hull, too.
    """
    bars = [k for k, marking in enumerate(markings) if marking.kind == CROSSWALK_BAR]
    ground = camera.unproject(np.array([markings[k].corners_px for k in bars]).reshape(-1, 4, 2))
    on_ground = np.flatnonzero(np.isfinite(ground).all(axis=(1, 2)))
    named = pieces_named_bars(pieces) if len(on_ground) >= LEAST_BARS else []
    crosswalks = []
    for row in rows_of_bars(ground[on_ground], IN_IMAGE):
        members = on_ground[row]
        parts = tuple(bars[k] for k in members.tolist())
        shapes_px = [markings[k].corners_px for k in parts]
        shapes_px += [piece.blob.outline_px for piece in _continuing(ground[members], named)]
        points_px = np.concatenate(shapes_px)
        outline_px = points_px[cv2.convexHull(points_px.astype(np.float32), returnPoints=False).ravel()]
        crosswalk = MarkingDetection(
            kind=CROSSWALK,
            score=float(np.mean([markings[k].score for k in parts])),
            corners_px=np.full((4, 2), np.nan),
            covariance_px=np.full((8, 8), np.nan),
            corner_valid=np.zeros(4, dtype=np.bool_),
            outline_px=outline_px,
            outline_seen=np.ones(len(outline_px), dtype=np.bool_),
        )
        crosswalks.append((crosswalk, parts))
    return crosswalks
