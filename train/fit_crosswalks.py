"""Fits what a row says of the bars in it, in :mod:`v2hdm.detection.crosswalks`.

    python -m train.fit_crosswalks LABELS.json IMAGES [--photographs 500] [--renders 60]

LABELS.json and IMAGES are those of ROAD MARK. The images of it that are learnt from, and rendered scenes, are
shown to the shipped network, every second photograph as if nobody stated its mounting. A bar that stands in a
row is true if it overlaps a rendered bar by half, or its middle lies in the outline of a photographed
crosswalk; it is false where nothing like it is labelled. Printed is what belongs into ``FITTED``, and how
many of either it keeps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

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
from v2hdm.geometry.rows import IN_IMAGE, rows_of_bars
from v2hdm.records import CROSSWALK_BAR, FloatArray

OVERLAP = 0.5  # of a true bar with a rendered one, intersection over union
APART = 0.05  # of a false bar with any label, at most
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


def bars_in(shown: Example, detector: Detector) -> Iterator[tuple[FloatArray, bool]]:
    """The features (F,) of the bars of an image that stand in a row, and whether they are bars."""
    output = detector.run_network(shown.image, shown.camera)
    readings = detector.read(shown.image, detector.propose(output, shown.camera))
    if readings is None:
        return
    likeliest = likeliest_readings(readings)
    ground = readings.ground[likeliest.reading]
    candidates = np.flatnonzero(likeliest.may_be_bar & np.isfinite(ground).all(axis=(1, 2)))
    for row in rows_of_bars(ground[candidates], IN_IMAGE):
        members = candidates[row]
        features = crosswalks.row_features(likeliest.score[members])
        for number, m in enumerate(members.tolist()):
            is_bar = _is_bar(shown, readings.fit.corners_px[m])
            if is_bar is not None:
                yield features[number], is_bar


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


def gathered(images: Iterable[Example], detector: Detector) -> tuple[FloatArray, FloatArray]:
    """The features (N, F) and the truth (N,), 1 or 0, of all bars in rows."""
    bars = [bar for image in images for bar in bars_in(image, detector)]
    features = np.array([features for features, _ in bars]).reshape(-1, len(crosswalks.FEATURES))
    return features, np.array([is_bar for _, is_bar in bars], dtype=np.float64)


def main() -> None:
    """Print what was fitted."""
    parsed = fit_arguments(__doc__, photographs=500, renders=60)
    cv2.setNumThreads(1)
    detector = Detector.load(options=DetectorOptions(max_range_m=RANGE_M))
    shown = {
        "photographs": photographs(parsed.labels, parsed.images, parsed.photographs),
        "renders": renders(parsed.renders),
    }
    groups = {name: gathered(images, detector) for name, images in shown.items()}
    features = np.concatenate([features for features, _ in groups.values()])
    is_bar = np.concatenate([is_bar for _, is_bar in groups.values()])
    weights = likeliest_weights(features, np.zeros(len(features)), is_bar, RIDGE)
    print(f"FITTED = {weights}")
    for name, (columns, truth) in groups.items():
        is_bar = truth > 0
        bars = int(is_bar.sum())
        for how, values in (("alone", columns[:, 1]), ("in its row", columns @ np.array(weights))):
            is_kept = as_probability(values) >= LEAST_KEPT
            kept = int((is_kept & is_bar).sum())
            others = int((is_kept & ~is_bar).sum())
            print(f"{name}, {how}: {kept} of {bars} bars, {others} of {len(truth) - bars} others")


if __name__ == "__main__":
    main()
