"""Fits what a row says of the bars in it, and of paint beside it, in :mod:`v2hdm.detection.crosswalks`.

    python -m train.fit_crosswalks LABELS.json IMAGES [--photographs 500] [--renders 60]

LABELS.json and IMAGES are those of ROAD MARK. The images of it that are learnt from, and rendered scenes, are
shown to the shipped network, every second photograph as if nobody stated its mounting. A bar that stands in a
row is true if it overlaps a rendered bar by half, or its middle lies in the outline of a photographed
crosswalk; it is false where nothing like it is labelled. Paint near a row that the network names a bar is of
the row's crosswalk if most of its outline lies in that of the photographed crosswalk that most of the row's
bars are in. Printed is what belongs into ``FITTED`` and ``CONTINUING_FITTED``, and how many are kept.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from train.config import DataConfig
from train.examples import Example, example, photograph, polygon_overlap
from train.fit_arguments import fit_arguments
from train.fit_arrows import RANGE_M, SEED, config_of
from train.fit_judge import HARDSHIPS, HARDSHIPS_EVERY
from train.labels import labelled_images
from train.labels_image import LabelledImage
from train.logistic import likeliest_weights
from train.scenes.hardships import NONE
from v2hdm.detection import crosswalks
from v2hdm.detection.classifier import likeliest_readings
from v2hdm.detection.detector import Detector
from v2hdm.detection.network import as_probability
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.quads.propose import Proposal
from v2hdm.geometry.rows import IN_IMAGE, rows_of_bars
from v2hdm.records import CROSSWALK_BAR, FloatArray

OVERLAP = 0.5  # of a true bar with a rendered one, intersection over union
APART = 0.05  # of a false bar with any label, at most
MOST = 0.5  # share of a row's bars, and of a piece's outline, that lie in a crosswalk's outline
RIDGE = 0.2  # information of the prior that weights are 0
NOT_STATED = (1.6, -6.1, 60.0)
"""Height, m, pitch, deg down, and field of view, deg, that `v2hdm detect` takes these photographs to have."""
LEAST_KEPT = 0.7  # probability from which a bar is detected
CROSSED = replace(HARDSHIPS, words=0.4, boxes=0.4)
"""Renders with much that is no crosswalk but has strokes beside each other."""


def photographs(labels: Path, images: Path, count: int) -> Iterator[Example]:
    """Labelled photographs that networks learn from, over two cameras in turn."""
    rng = np.random.default_rng(SEED)
    stated = config_of(labels, images)
    for image, config in configs_in_turn(labelled_images(stated)[:count], stated):
        yield photograph(image, config, rng)


def configs_in_turn(
    images: Iterable[LabelledImage], stated: DataConfig
) -> Iterator[tuple[LabelledImage, DataConfig]]:
    """Photographs, every second one with the settings of a camera of which nobody states the mounting."""
    configs = (stated, replace(stated, coco_camera=list(NOT_STATED)))
    for number, image in enumerate(images):
        yield image, configs[number % len(configs)]


def renders(count: int) -> Iterator[Example]:
    """Rendered scenes, two of three with hardships."""
    for number in range(count):
        yield example(number, 1.0, SEED, CROSSED if number % HARDSHIPS_EVERY else NONE)


class Row(NamedTuple):
    """A row of N bars that an image shows."""

    features: FloatArray  # (N, F) of its bars
    corners_px: FloatArray  # (N, 4, 2)
    ground: FloatArray  # (N, 4, 2) m


class Rows(NamedTuple):
    """The rows of an image, and its pieces of paint that the network names bars."""

    rows: Sequence[Row]
    pieces: Sequence[Proposal]


def rows_in(shown: Example, detector: Detector) -> Rows:
    """The rows that an image shows, with their likeliest bars."""
    output = detector.run_network(shown.image, shown.camera)
    proposals = detector.propose(output, shown.camera)
    readings = detector.read(shown.image, proposals)
    if readings is None:
        return Rows((), ())
    likeliest = likeliest_readings(readings)
    ground = readings.ground[likeliest.reading]
    candidates = np.flatnonzero(likeliest.may_be_bar & np.isfinite(ground).all(axis=(1, 2)))
    rows = []
    for row in rows_of_bars(ground[candidates], IN_IMAGE):
        members = candidates[row]
        features = crosswalks.row_features(likeliest.score[members])
        rows.append(Row(features, readings.fit.corners_px[members], ground[members]))
    return Rows(rows, crosswalks.pieces_named_bars(proposals.pieces))


def bars_in(shown: Example, rows: Rows) -> Iterator[tuple[FloatArray, bool]]:
    """The features (F,) of the bars of an image that stand in a row, and whether they are bars."""
    for row in rows.rows:
        for features, corners_px in zip(row.features, row.corners_px, strict=True):
            is_bar = _is_bar(shown, corners_px)
            if is_bar is not None:
                yield features, is_bar


def pieces_in(shown: Example, rows: Rows) -> Iterator[tuple[FloatArray, bool]]:
    """The features (F,) of pieces near to rows of a photograph, and whether they are of their crosswalk."""
    outlines = [true.polygon_px.astype(np.float32) for true in shown.markings if true.kind == CROSSWALK_BAR]
    if shown.unknown is None or not outlines:
        return
    for row in rows.rows:
        middles_px = row.corners_px.mean(axis=1)
        bars_inside = [_share_inside(outline, middles_px) for outline in outlines]
        if max(bars_inside) < MOST:
            continue
        outline = outlines[int(np.argmax(bars_inside))]
        centres = row.ground.mean(axis=1)
        length_m = crosswalks.usual_length_m(row.ground)
        for piece in rows.pieces:
            features = crosswalks.continuing_features(centres, length_m, piece.outline_vehicle)
            if features[1] <= crosswalks.MOST_BEYOND:
                yield features, _share_inside(outline, piece.blob.outline_px) > MOST


def _share_inside(outline: np.ndarray, points_px: FloatArray) -> float:
    """The share of points (N, 2) that lie in an outline."""
    return float(np.mean([cv2.pointPolygonTest(outline, at, False) >= 0 for at in points_px.tolist()]))


def _is_bar(shown: Example, corners_px: FloatArray) -> bool | None:
    """Whether a quadrilateral (4, 2) is a bar of a crosswalk; None where labels do not tell."""
    overlaps = [(polygon_overlap(corners_px, true.polygon_px), true) for true in shown.markings]
    of_bars = [pair for pair in overlaps if pair[1].kind == CROSSWALK_BAR]
    if shown.unknown is None:
        is_bar = max((share for share, _ in of_bars), default=0.0) >= OVERLAP
    else:
        middle = corners_px.mean(axis=0).tolist()
        outlines = [true.polygon_px.astype(np.float32) for _, true in of_bars]
        is_bar = any(cv2.pointPolygonTest(outline, middle, False) > 0 for outline in outlines)
    if is_bar:
        return True
    return False if max((share for share, _ in overlaps), default=0.0) < APART else None


class Gathered(NamedTuple):
    """Features (N, F) and the truth (N,), 1 or 0."""

    features: FloatArray
    is_true: FloatArray

    @classmethod
    def of(cls, samples: Sequence[tuple[FloatArray, bool]], width: int) -> Gathered:
        """Of features (width,), each with its truth."""
        features = np.array([features for features, _ in samples]).reshape(-1, width)
        return cls(features, np.array([is_true for _, is_true in samples], dtype=np.float64))

    def fitted(self) -> tuple[float, ...]:
        """The likeliest weights of the features."""
        return likeliest_weights(self.features, np.zeros(len(self.features)), self.is_true, RIDGE)

    def say(self, name: str, odds: FloatArray, least: float) -> None:
        """Print how many have at least a probability, by log odds (N,)."""
        is_kept = as_probability(odds) >= least
        true_kept = int((is_kept & (self.is_true > 0)).sum())
        others = int((is_kept & (self.is_true == 0)).sum())
        true = int(self.is_true.sum())
        print(f"{name}: {true_kept} of {true}, {others} of {len(self.is_true) - true} others")


def main() -> None:
    """Print what was fitted."""
    parsed = fit_arguments(__doc__, photographs=500, renders=60)
    cv2.setNumThreads(1)
    detector = Detector.load(options=DetectorOptions(max_range_m=RANGE_M))
    shown = {
        "photographs": photographs(parsed.labels, parsed.images, parsed.photographs),
        "renders": renders(parsed.renders),
    }
    bars: dict[str, Gathered] = {}
    beside: list[tuple[FloatArray, bool]] = []
    for name, images in shown.items():
        of_bars: list[tuple[FloatArray, bool]] = []
        for image in images:
            rows = rows_in(image, detector)
            of_bars += bars_in(image, rows)
            beside += pieces_in(image, rows)
        bars[name] = Gathered.of(of_bars, len(crosswalks.FEATURES))
    weights = Gathered(*(np.concatenate(column) for column in zip(*bars.values(), strict=True))).fitted()
    print(f"FITTED = {weights}")
    for name, group in bars.items():
        group.say(f"{name}, bars alone", group.features[:, 1], LEAST_KEPT)
        group.say(f"{name}, bars in their row", group.features @ np.array(weights), LEAST_KEPT)
    pieces = Gathered.of(beside, len(crosswalks.CONTINUING))
    weights = pieces.fitted()
    print(f"CONTINUING_FITTED = {weights}")
    pieces.say("pieces near to rows", pieces.features @ np.array(weights), 0.5)


if __name__ == "__main__":
    main()
