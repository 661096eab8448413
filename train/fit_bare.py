"""Fits what tells paint from bare ground across a traced piece, in :mod:`v2hdm.detection.lanes.bare`.

    python -m train.fit_bare [--images 160]

Rendered scenes that are shown nowhere else are looked at with a network that takes everything for paint
{CREDULITY:g} nats too much: as on a road that it was not trained on, where seams and edges become pieces. A
piece is paint where the labels of the render are. Printed are the log losses of the pieces by several
correlations, and what belongs into ``FITTED``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from train.examples import HEIGHT, WIDTH, camera_of
from train.fit_judge import HARDSHIPS, HARDSHIPS_EVERY, fit, log_loss
from train.scenes.hardships import NONE
from train.scenes.scenes import drawn_scene
from v2hdm.detection.detector import Detector
from v2hdm.detection.lanes import bare
from v2hdm.detection.options import DetectorOptions
from v2hdm.records import LANE_LINE, FloatArray

SEED = 931  # seed of the rendered scenes, not that of a benchmark nor of a training
CREDULITY = 3.0  # log odds that are added to paint
NEAR_PX = (3, 5)  # rows and columns about a point of a piece in which labels count as its own
PAINT_SHARE = 0.5  # share of a piece's points on paint from which it is paint
BARE_SHARE = 0.2  # share up to which it is bare
CORRELATIONS = (0.0, 0.1, 0.3, 0.5, 0.8, 1.0)  # that are tried


class Piece(NamedTuple):
    """The features (S, F) of a piece's sections, the network's score, and whether it is paint."""

    features: FloatArray
    score: float
    is_paint: bool


def pieces_of(number: int, detector: Detector) -> list[Piece]:
    """The pieces named lines in one rendered scene."""
    rng = np.random.default_rng([SEED, number])
    hardships = HARDSHIPS if number % HARDSHIPS_EVERY else NONE
    drawn = drawn_scene(rng, WIDTH, HEIGHT, 1.0, hardships)
    camera = camera_of(drawn.view)
    output = detector.run_network(drawn.rendered.image, camera)
    credulous = replace(output, paint=output.paint + np.float32(CREDULITY))
    traced = detector.lane_pieces(detector.propose(credulous, camera))
    lines = [piece for piece in traced if piece.kind == LANE_LINE]
    sections = bare.sections_of(lines, drawn.rendered.image, detector.road_camera(camera))
    features = bare.features(sections)
    painted = cv2.dilate((drawn.rendered.labels > 0).astype(np.uint8), np.ones(NEAR_PX, np.uint8))
    pieces = []
    for index, line in enumerate(lines):
        is_of_piece = sections.piece == index
        u, v = np.round(np.clip(line.points_px, 0, [WIDTH - 1, HEIGHT - 1])).astype(int).T
        share = float((painted[v, u] > 0).mean())
        if is_of_piece.any() and not BARE_SHARE < share < PAINT_SHARE:
            pieces.append(Piece(features[is_of_piece], line.score, share >= PAINT_SHARE))
    return pieces


def fitted(pieces: Sequence[Piece]) -> bare.Contrast:
    """Weights that tell paint from bare ground: of sections first, then of the pieces that they form."""
    sections = np.concatenate([piece.features for piece in pieces])
    is_paint = np.array([piece.is_paint for piece in pieces])
    of_section = np.repeat(is_paint, [len(piece.features) for piece in pieces])
    weights, section = fit(sections, of_section)
    section -= float(np.log(of_section.mean() / (1.0 - of_section.mean())))
    named = np.log([piece.score / (1.0 - piece.score) for piece in pieces])
    models = []
    losses = []
    for correlation in CORRELATIONS:
        ratio = [bare.shared(piece.features @ weights + section, correlation) for piece in pieces]
        columns = np.column_stack([ratio, named])
        (scale, of_named), bias = fit(columns, is_paint)
        losses.append(log_loss(columns @ [scale, of_named] + bias, is_paint))
        models.append(
            bare.Contrast(
                tuple(np.round(scale * weights, 2).tolist()),
                round(float(scale * section), 2),
                correlation,
                round(float(of_named), 2),
                round(float(bias), 2),
            )
        )
        print(f"correlation {correlation}: log loss {losses[-1]:.3f}")
    weight, bias = fit(named[:, None], is_paint)
    print(f"by the network alone: log loss {log_loss(named * weight[0] + bias, is_paint):.3f}")
    return models[int(np.argmin(losses))]


def main() -> None:
    """Print what was fitted."""
    about = (__doc__ or "").format(CREDULITY=CREDULITY)
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--images", type=int, default=160)
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    detector = Detector.load(options=DetectorOptions(max_range_m=24.0))
    pieces = [piece for number in range(parsed.images) for piece in pieces_of(number, detector)]
    print(f"{len(pieces)} pieces, {sum(piece.is_paint for piece in pieces)} of them paint")
    model = fitted(pieces)
    right = sum((bare.paint_log_odds(p.features, p.score, model) > 0.0) == p.is_paint for p in pieces)
    print(f"{model}: right of {right} pieces")


if __name__ == "__main__":
    main()
