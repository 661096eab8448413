"""Fits what tells arrows from what is named so, in :mod:`v2hdm.detection.arrows`.

    python -m train.fit_arrows LABELS.json IMAGES [--photographs 350] [--renders 70]

LABELS.json and IMAGES are those of ROAD MARK. The images of it that are learnt from, and rendered scenes, are
shown to the shipped network. What it names an arrow is one if it overlaps a label of that class by
{OVERLAP:g}, and none if it overlaps nothing by {APART:g}; the rest teaches nothing. Printed is what belongs
into ``FITTED``, and how many of either it keeps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from train.config import DataConfig
from train.examples import Example, example, photograph, polygon_overlap
from train.fit_arguments import fit_arguments
from train.fit_judge import HARDSHIPS, HARDSHIPS_EVERY
from train.labels import labelled_images
from train.logistic import likeliest_weights
from train.scenes.hardships import NONE
from v2hdm.catalogue import SYMBOL
from v2hdm.detection import arrows
from v2hdm.detection.detector import Detector
from v2hdm.detection.network import as_log_odds
from v2hdm.detection.options import DetectorOptions
from v2hdm.records import ARROW, BOX, CROSSWALK_BAR, DIAMOND, LANE_DASH, TEXT, FloatArray

SEED = 931  # seed of the rendered scenes, not that of a benchmark nor of a training
OVERLAP = 0.3  # of what is an arrow with a label, intersection over union
APART = 0.05  # of what is none with any label, at most
RIDGE = 0.2  # information of the prior that weights are 0
LEAST_NAMED = 0.05  # share named an arrow from which a piece is looked at
RANGE_M = 40.0  # as of photographs of which nothing is stated


class Named(NamedTuple):
    """The features (F,) of a piece that is named an arrow by a share, and whether it is one."""

    share: float
    features: FloatArray
    is_arrow: bool


CLASSES = {
    "line": LANE_DASH, "diamond_outline": DIAMOND, "crosswalk_outline": CROSSWALK_BAR, "bus_lane": TEXT,
    "slow": TEXT, "yellow_box": BOX, "bicycle": "bicycle",
    **{f"arrow_{way}": ARROW for way in ("ahead", "left", "right", "ahead_left", "ahead_right")},
}  # fmt: skip
"""The class of each label: here all but arrows are alike."""


def config_of(labels: Path, images: Path) -> DataConfig:
    """The settings of the photographs of ROAD MARK."""
    return DataConfig(
        coco=str(labels), coco_images=str(images), coco_size=[1280, 720], coco_camera=[1.3, -12.0, 90.0],
        coco_held_out=True, coco_classes=CLASSES,
    )  # fmt: skip


def photographs(labels: Path, images: Path, count: int) -> Iterator[Example]:
    """Labelled photographs that networks learn from."""
    config = config_of(labels, images)
    rng = np.random.default_rng(SEED)
    for image in labelled_images(config)[:count]:
        yield photograph(image, config, rng)


def renders(count: int) -> Iterator[Example]:
    """Rendered scenes, two of three with hardships."""
    for number in range(count):
        yield example(number, 1.0, SEED, HARDSHIPS if number % HARDSHIPS_EVERY else NONE)


def named_in(shown: Example, detector: Detector) -> list[Named]:
    """Pieces that the network names arrows in an image, as far as labels tell whether they are arrows."""
    output = detector.run_network(shown.image, shown.camera)
    proposals = detector.propose(output, shown.camera)
    symbols = detector.catalogue.of_family(SYMBOL)
    named = []
    for piece in proposals.pieces:
        score = piece.symbol_score(ARROW) if piece.symbol_kind(symbols) == ARROW else 0.0
        if score < LEAST_NAMED or not np.isfinite(piece.outline_vehicle).all():
            continue
        overlaps = [
            (polygon_overlap(piece.blob.outline_px, true.polygon_px), true.kind) for true in shown.markings
        ]
        is_arrow = max((share for share, kind in overlaps if kind == ARROW), default=0.0) >= OVERLAP
        if is_arrow or max((share for share, _ in overlaps), default=0.0) < APART:
            features = arrows.features_of(piece, proposals.camera)
            named.append(Named(score, features, is_arrow))
    return named


def fitted(named: Sequence[Named]) -> tuple[float, ...]:
    """The likeliest weights of the features, added to the log odds of the name."""
    features = np.array([piece.features for piece in named])
    offset = as_log_odds(np.array([piece.share for piece in named]))
    is_arrow = np.array([piece.is_arrow for piece in named], dtype=np.float64)
    return likeliest_weights(features, offset, is_arrow, RIDGE)


def main() -> None:
    """Print what was fitted."""
    about = (__doc__ or "").format(OVERLAP=OVERLAP, APART=APART)
    parsed = fit_arguments(about, photographs=350, renders=70)
    cv2.setNumThreads(1)
    detector = Detector.load(options=DetectorOptions(max_range_m=RANGE_M))
    named = [
        piece
        for images in (photographs(parsed.labels, parsed.images, parsed.photographs), renders(parsed.renders))
        for image in images
        for piece in named_in(image, detector)
    ]
    weights = fitted(named)
    is_arrow = np.array([piece.is_arrow for piece in named])
    keeps = np.array([arrows.arrow_probability(p.share, p.features, weights) >= 0.5 for p in named])
    print(f"{weights}: keeps {(keeps & is_arrow).sum()} of {is_arrow.sum()} arrows, ", end="")
    print(f"{(keeps & ~is_arrow).sum()} of {(~is_arrow).sum()} others")


if __name__ == "__main__":
    main()
