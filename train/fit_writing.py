"""Fits what words of one image say of each other, in :mod:`v2hdm.detection.writing`.

    python -m train.fit_writing LABELS.json IMAGES [--photographs 240] [--renders 12]

LABELS.json and IMAGES are those of ROAD MARK. Photographs of it that networks learn from, every second of
them as if nobody stated its mounting, and rendered scenes are shown to the shipped network. An area that it
names writing is some if labels of words cover most of it, and none if they cover hardly anything of it.
Printed is what belongs into ``FITTED``, and how many of either it keeps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from train.examples import HEIGHT, WIDTH, camera_of, photograph
from train.fit_arguments import fit_arguments
from train.fit_arrows import RANGE_M, SEED, config_of
from train.fit_crosswalks import configs_in_turn
from train.fit_hatching import DIFFICULTIES, WRITTEN
from train.labels import labelled_images
from train.logistic import likeliest_weights
from train.scenes.scenes import drawn_scene
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.detection.areas import find_areas
from v2hdm.detection.detector import Detector
from v2hdm.detection.network import as_log_odds
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.writing import company_of_words, writing_probability
from v2hdm.records import TEXT, BoolArray, Camera, FloatArray

MOST = 0.5  # share of an area that labels of words cover from which it is writing
HARDLY = 0.1  # share below which it is none
RIDGE = 0.2  # information of the prior that weights are 0
LEAST_KEPT = 0.5  # probability from which an area is detected


class Shown(NamedTuple):
    """An image with its camera, and where (H, W) it shows writing."""

    image: np.ndarray
    camera: Camera
    is_written: BoolArray


def photographs(labels: Path, images: Path, count: int) -> Iterator[Shown]:
    """Labelled photographs that networks learn from."""
    stated = config_of(labels, images)
    rng = np.random.default_rng(SEED)
    for image, config in configs_in_turn(labelled_images(stated)[:count], stated):
        example = photograph(image, config, rng)
        scale = np.array(example.image.shape[1::-1]) / image.pixels().shape[1::-1]
        written = np.zeros(example.image.shape[:2], dtype=np.uint8)
        for shape in image.shapes or ():
            if TEXT in shape.kinds:
                for ring_px in shape.rings_px:
                    cv2.fillPoly(written, [np.round(ring_px * scale).astype(np.int32)], 1)
        yield Shown(example.image, example.camera, written > 0)


def renders(count: int) -> Iterator[Shown]:
    """Rendered scenes, of two difficulties in turn, with the hulls of their letters."""
    text = PAINT_CLASSES.index(TEXT) + 1
    for number in range(count):
        rng = np.random.default_rng([SEED, number])
        drawn = drawn_scene(rng, WIDTH, HEIGHT, DIFFICULTIES[number % len(DIFFICULTIES)], WRITTEN)
        strokes = (np.asarray(drawn.rendered.labels) == text).astype(np.uint8)
        written = cv2.morphologyEx(strokes, cv2.MORPH_CLOSE, np.ones((15, 15), np.uint8))
        yield Shown(drawn.rendered.image, camera_of(drawn.view), written > 0)


class Word(NamedTuple):
    """An area that the network names writing: its probability alone, its company, and whether it is some."""

    score: float
    company: float
    is_word: bool


def words_in(shown: Shown, detector: Detector) -> Iterator[Word]:
    """The areas of an image that are named writing, as far as labels tell what they are."""
    road = detector.road_camera(shown.camera)
    output = detector.run_network(shown.image, shown.camera)
    areas = find_areas(output, road, detector.catalogue, 0, 0.0, RANGE_M, has_company=False)
    words = [area for area in areas if area.kind == TEXT]
    hulls = [road.unproject(word.outline_px) for word in words]
    company = company_of_words(np.array([word.score for word in words]), hulls)
    for word, beside in zip(words, company.tolist(), strict=True):
        is_word = _is_written(word.outline_px, shown.is_written)
        if is_word is not None:
            yield Word(word.score, beside, is_word)


def _is_written(outline_px: FloatArray, is_written: BoolArray) -> bool | None:
    mask = np.zeros(is_written.shape, dtype=np.uint8)
    cv2.fillPoly(mask, [np.round(outline_px).astype(np.int32)], 1)
    share = float(is_written[mask > 0].mean())
    if HARDLY <= share <= MOST:
        return None
    return share > MOST


def fitted(words: Sequence[Word]) -> float:
    """The likeliest weight of the company, added to the log odds of each word alone."""
    company = np.array([[word.company] for word in words])
    is_word = np.array([word.is_word for word in words], dtype=np.float64)
    (weight,) = likeliest_weights(
        company, as_log_odds(np.array([word.score for word in words])), is_word, RIDGE
    )
    return weight


def main() -> None:
    """Print what was fitted."""
    parsed = fit_arguments(__doc__, photographs=240, renders=12)
    cv2.setNumThreads(1)
    detector = Detector.load(options=DetectorOptions(max_range_m=RANGE_M))
    shown = {
        "photographs": photographs(parsed.labels, parsed.images, parsed.photographs),
        "renders": renders(parsed.renders),
    }
    groups = {
        name: [word for image in images for word in words_in(image, detector)]
        for name, images in shown.items()
    }
    weight = fitted([word for group in groups.values() for word in group])
    print(f"FITTED = {weight}")
    for name, group in groups.items():
        score = np.array([word.score for word in group])
        company = np.array([word.company for word in group])
        is_word = np.array([word.is_word for word in group], dtype=np.bool_)
        for how, probability in (
            ("alone", score),
            ("in company", writing_probability(score, company, weight)),
        ):
            is_kept = probability >= LEAST_KEPT
            words_kept = int((is_kept & is_word).sum())
            others = int((is_kept & ~is_word).sum())
            print(
                f"{name}, {how}: {words_kept} of {is_word.sum()} words, {others} of {(~is_word).sum()} others"
            )


if __name__ == "__main__":
    main()
