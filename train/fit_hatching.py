"""Fits what tells hatched boxes from writing, in :mod:`v2hdm.detection.hatching`.

    python -m train.fit_hatching LABELS.json IMAGES [--photographs 110] [--renders 160]

LABELS.json and IMAGES are those of ROAD MARK. Photographs of it that networks learn from and that show words
or boxes, and rendered scenes with both, are shown to the shipped network. A piece that it takes for text or a
box is what most of its labels say. Printed is what belongs into ``FITTED``, and how many pieces are named
right by the network alone and with their meshes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from train.examples import HEIGHT, WIDTH, camera_of, photograph
from train.fit_arguments import fit_arguments
from train.fit_arrows import SEED, config_of
from train.fit_judge import HARDSHIPS
from train.labels import labelled_images
from train.logistic import likeliest_weights
from train.scenes.scenes import drawn_scene
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.detection.detector import Detector
from v2hdm.detection.hatching import box_probability, meshes
from v2hdm.detection.network import as_log_odds
from v2hdm.detection.options import DetectorOptions
from v2hdm.records import BOX, TEXT, Camera, IntArray

LEAST_CELLS = 30  # elements of paint of a piece that teaches something
LEAST_LABELLED = 0.5  # least share of a piece that its label covers
DIFFICULTIES = (1.0, 0.4)  # of the renders, in turn
WRITTEN = replace(HARDSHIPS, words=0.4, boxes=0.8)  # most scenes show a box, many a word
RIDGE = 0.1  # information of the prior that the weight is 0

_TEXT = PAINT_CLASSES.index(TEXT) + 1
_BOX = PAINT_CLASSES.index(BOX) + 1
_UNKNOWN = len(PAINT_CLASSES) + 1  # of labels of no class


class Shown(NamedTuple):
    """An image with its camera, and the label (H, W) of each pixel: 1 + a class, 0 for none."""

    image: np.ndarray
    camera: Camera
    labels: IntArray


class Piece(NamedTuple):
    """A piece of paint: the sums of either class's probability, its meshes, and whether it is of a box."""

    text_cells: float
    box_cells: float
    netted: float
    is_box: bool


def photographs(labels: Path, images: Path, count: int) -> Iterator[Shown]:
    """Labelled photographs that networks learn from, with words or boxes."""
    config = config_of(labels, images)
    rng = np.random.default_rng(SEED)
    written = [
        image
        for image in labelled_images(config)
        if any({TEXT, BOX} & set(shape.kinds) for shape in image.shapes or ())
    ]
    for image in written[:count]:
        example = photograph(image, config, rng)
        scale = np.array(example.image.shape[1::-1]) / image.pixels().shape[1::-1]
        drawn = np.zeros(example.image.shape[:2], dtype=np.int32)
        # Words and boxes lie over what else is labelled there.
        for shape in sorted(image.shapes or (), key=lambda shape: bool({TEXT, BOX} & set(shape.kinds))):
            names = [name for name in shape.kinds if name in PAINT_CLASSES]
            label = PAINT_CLASSES.index(names[0]) + 1 if names else _UNKNOWN
            for ring_px in shape.rings_px:
                cv2.fillPoly(drawn, [np.round(ring_px * scale).astype(np.int32)], label)
        yield Shown(example.image, example.camera, drawn.astype(np.int64))


def renders(count: int) -> Iterator[Shown]:
    """Rendered scenes, of two difficulties in turn."""
    for number in range(count):
        rng = np.random.default_rng([SEED, number])
        drawn = drawn_scene(rng, WIDTH, HEIGHT, DIFFICULTIES[number % len(DIFFICULTIES)], WRITTEN)
        labels = np.asarray(drawn.rendered.labels, dtype=np.int64)
        yield Shown(drawn.rendered.image, camera_of(drawn.view), labels)


def pieces_of(shown: Shown, detector: Detector) -> Iterator[Piece]:
    """The pieces that the network takes for text or a box, as far as labels tell what they are."""
    output = detector.run_network(shown.image, shown.camera)
    places = [output.area_classes.index(name) for name in (TEXT, BOX)]
    rows, columns = np.nonzero(output.paint > 0)
    probability = output.area_probability(rows, columns)
    is_written = np.isin(probability.argmax(axis=0), places)
    share = np.zeros((2, *output.paint.shape), dtype=np.float32)
    share[:, rows[is_written], columns[is_written]] = probability[np.ix_(places, is_written)]
    count, numbers = cv2.connectedComponents((share.sum(axis=0) > 0).astype(np.uint8))
    limits = np.array(shown.labels.shape) - 1
    for number in range(1, count):
        is_of_piece = numbers == number
        cells = np.argwhere(is_of_piece)
        if len(cells) < LEAST_CELLS:
            continue
        v, u = np.minimum(output.stride * cells + output.stride // 2 + [output.top, 0], limits).T
        labels = shown.labels[v, u]
        text_share, box_share = (float((labels == label).mean()) for label in (_TEXT, _BOX))
        if max(text_share, box_share) >= LEAST_LABELLED:
            text_cells, box_cells = share[:, is_of_piece].sum(axis=1).tolist()
            netted = meshes(*cells.T, output.paint > 0)
            yield Piece(text_cells, box_cells, netted, box_share > text_share)


def fitted(pieces: Sequence[Piece]) -> float:
    """The likeliest weight of the meshes, added to the log odds of the names."""
    netted = np.array([[piece.netted] for piece in pieces])
    by_name = as_log_odds(np.array([box_probability(*piece[:3], 0.0) for piece in pieces]))
    is_box = np.array([piece.is_box for piece in pieces], dtype=np.float64)
    (weight,) = likeliest_weights(netted, by_name, is_box, RIDGE)
    return weight


def main() -> None:
    """Print what was fitted."""
    parsed = fit_arguments(__doc__, photographs=110, renders=160)
    cv2.setNumThreads(1)
    detector = Detector.load(options=DetectorOptions())
    shown = {
        "photographs": photographs(parsed.labels, parsed.images, parsed.photographs),
        "renders": renders(parsed.renders),
    }
    pieces = {
        name: [p for image in images for p in pieces_of(image, detector)] for name, images in shown.items()
    }
    weight = fitted([piece for group in pieces.values() for piece in group])
    print(f"FITTED = {weight}")
    for name, group in pieces.items():
        for by, used in (("the network", 0.0), ("both", weight)):
            wrong = [p for p in group if (box_probability(*p[:3], used) > 0.5) != p.is_box]
            words = sum(not piece.is_box for piece in group)
            wrong_words = sum(not piece.is_box for piece in wrong)
            print(
                f"{name}, by {by}: {words - wrong_words} of {words} pieces of words right, "
                f"{len(group) - words - len(wrong) + wrong_words} of {len(group) - words} of boxes"
            )


if __name__ == "__main__":
    main()
