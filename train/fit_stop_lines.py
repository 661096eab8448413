"""Fits how sure a reading is a stop line, in ``confidence.json`` of the shipped detector.

    python -m train.fit_stop_lines LABELS.json IMAGES --stop-lines LIST.json [--renders 480]

Stop lines are the rarest class with corners: :mod:`train.fit_judge` sees few, and those that its judge has
learnt. Here the judge meets rendered scenes that it has not seen, half of them junctions, and the photographs
of ROAD MARK that are for validation; LIST.json names the annotations that are stop lines. The file and its
manifest are written. Printed are the log loss before and after, and how many stop lines and others have at
least the probability that ``v2hdm detect`` asks for.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from export.manifest import record
from train.examples import Example, example, photograph, polygon_overlap
from train.fit_arrows import CLASSES, SEED, config_of
from train.fit_judge import AT_JUNCTIONS, EASY, HARDSHIPS, is_true, log_loss
from train.labels import VALIDATION, labelled_images
from train.odds import worth_of
from train.scenes.hardships import NONE
from v2hdm.detection.classifier import AMONG, classify_alone
from v2hdm.detection.detector import Detector
from v2hdm.detection.network import as_probability
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.weights import CONFIDENCE_FILE
from v2hdm.records import ARROW, CROSSWALK_BAR, DIAMOND, STOP_LINE, BoolArray, FloatArray
from v2hdm.store.files import replace_text

SCENES = ((1.0, AT_JUNCTIONS), (0.3, AT_JUNCTIONS), (1.0, HARDSHIPS), (EASY, NONE))
"""Difficulty and hardships of the renders, in turn."""

RANGE_M = 24.0  # range of detections, m, as of the judge's lessons


class Readings(NamedTuple):
    """N readings of stop lines: the judge's log odds (N,) of each alone, and whether it is one (N,)."""

    odds: FloatArray
    true: BoolArray


def images(labels: Path, folder: Path, stop_lines: Path, renders: int) -> Iterator[Example]:
    """Rendered scenes and photographs that the judge has not learnt from."""
    for number in range(renders):
        difficulty, hardships = SCENES[number % len(SCENES)]
        yield example(number, difficulty, SEED, hardships)
    config = replace(
        config_of(labels, folder),
        coco_classes=CLASSES | {"line": "lane_dash|lane_line|stop_line"},
        coco_complete=[DIAMOND, ARROW, CROSSWALK_BAR, STOP_LINE],
        coco_relabel={STOP_LINE: str(stop_lines)},
    )
    rng = np.random.default_rng(SEED)
    for image in labelled_images(config, role=VALIDATION):
        yield photograph(image, config, rng)


def readings_in(shown: Example, detector: Detector) -> Readings:
    """The readings of one image as a stop line, as far as it is known whether they are."""
    proposals = detector.propose(detector.run_network(shown.image, shown.camera), shown.camera)
    readings = detector.read(shown.image, proposals)
    if readings is None:
        return Readings(np.empty(0), np.empty(0, dtype=np.bool_))
    answers = {
        row: is_stop_line(shown, readings.fit.corners_px[readings.quadrilateral[row]])
        for row, kind in enumerate(readings.kinds)
        if kind == STOP_LINE
    }
    rows = [row for row, answer in answers.items() if answer is not None]
    if not rows:
        return Readings(np.empty(0), np.empty(0, dtype=np.bool_))
    odds, _ = classify_alone(readings.evidence[rows], readings.views[rows], [STOP_LINE] * len(rows))
    return Readings(odds, np.array([answers[row] is True for row in rows]))


def is_stop_line(shown: Example, corners_px: FloatArray) -> bool | None:
    """Whether a quadrilateral (4, 2) is a stop line; None where nobody knows.

    A wide lens bends the outline of a line that leaves the image: what touches a stop line may be its part.
    """
    answer, _ = is_true(shown, STOP_LINE, corners_px)
    stop_lines = (marking.polygon_px for marking in shown.markings if marking.kind == STOP_LINE)
    touches = any(polygon_overlap(corners_px, polygon) > 0 for polygon in stop_lines)
    return None if answer is False and touches else answer


def fitted(readings: Readings) -> dict[str, object]:
    """The entry of ``confidence.json`` about stop lines, whose company says nothing of them."""
    worth = worth_of(readings.odds, readings.true)
    weights = dict.fromkeys(AMONG, 0.0) | {"alone": round(worth.weight, 4)}
    return {"bias": round(worth.bias, 4), "weights": weights}


def _say(name: str, function: dict[str, object], readings: Readings, least: float) -> None:
    weights = function["weights"]
    assert isinstance(weights, dict)
    odds = weights["alone"] * readings.odds + float(str(function["bias"]))
    is_sure = as_probability(odds) >= least
    print(
        f"{name}: log loss {log_loss(odds, readings.true):.4f}; of {least:g} and more are "
        f"{(is_sure & readings.true).sum()} of {readings.true.sum()} stop lines, "
        f"{(is_sure & ~readings.true).sum()} of {(~readings.true).sum()} others"
    )


def main() -> None:
    """Fit, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("labels", type=Path)
    parser.add_argument("images", type=Path)
    parser.add_argument("--stop-lines", type=Path, required=True)
    parser.add_argument("--renders", type=int, default=480)
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    least = DetectorOptions().min_confidence
    detector = Detector.load(options=DetectorOptions(max_range_m=RANGE_M, min_confidence=0.0))
    shown = images(parsed.labels, parsed.images, parsed.stop_lines, parsed.renders)
    parts = [readings_in(image, detector) for image in shown]
    readings = Readings(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    functions = json.loads(CONFIDENCE_FILE.read_text(encoding="utf-8"))
    _say("before", functions[STOP_LINE], readings, least)
    functions[STOP_LINE] = fitted(readings)
    _say("after", functions[STOP_LINE], readings, least)
    replace_text(CONFIDENCE_FILE, json.dumps(functions, indent=1) + "\n")
    options = f"--stop-lines {parsed.stop_lines.name} --renders {parsed.renders}"
    record([CONFIDENCE_FILE.name], f"python -m train.fit_stop_lines {parsed.labels.name} IMAGES {options}")


if __name__ == "__main__":
    main()
