"""Fits how sure a reading is a stop line, in ``confidence.json`` of the shipped detector.

    python -m train.fit_stop_lines LABELS.json IMAGES [--renders 180]

Stop lines are one in two hundred true readings, so that :mod:`train.fit_judge` sees few, and those that its
judge has learnt. Here the judge meets rendered scenes that it has not seen, half of them junctions, and the
photographs of ROAD MARK that are for validation. Of a stop line nothing counts but what the judge says of it
alone. The file and its manifest are written; printed are the log loss before and after, and how many stop
lines and others have at least the probability that ``v2hdm detect`` asks for.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from export.manifest import record
from train.examples import Example, example, photograph
from train.fit_arrows import SEED, config_of
from train.fit_judge import AT_JUNCTIONS, EASY, HARDSHIPS, Gathered, fit, log_loss
from train.labels import VALIDATION, labelled_images
from train.scenes.hardships import NONE
from v2hdm.detection.classifier import AMONG, classify_alone
from v2hdm.detection.detector import Detector
from v2hdm.detection.network import as_probability
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.weights import CONFIDENCE_FILE
from v2hdm.records import STOP_LINE, BoolArray, FloatArray
from v2hdm.store.files import replace_text

SCENES = ((1.0, AT_JUNCTIONS), (0.3, AT_JUNCTIONS), (1.0, HARDSHIPS), (EASY, NONE))
"""Difficulty and hardships of the renders, in turn."""


class Readings(NamedTuple):
    """N readings of stop lines: the judge's log odds (N,) of each alone, and whether it is one (N,)."""

    odds: FloatArray
    true: BoolArray


def images(labels: Path, folder: Path, renders: int) -> Iterator[Example]:
    """Rendered scenes and photographs that the judge has not learnt from."""
    for number in range(renders):
        difficulty, hardships = SCENES[number % len(SCENES)]
        yield example(number, difficulty, SEED, hardships)
    config = config_of(labels, folder)
    rng = np.random.default_rng(SEED)
    for image in labelled_images(config, role=VALIDATION):
        yield photograph(image, config, rng)


def readings_in(shown: Example, detector: Detector) -> Readings:
    """The readings of one image as a stop line, as far as it is known whether they are."""
    gathered = Gathered()
    gathered.add(0, shown, detector)
    rows = [
        row
        for row, (kind, true) in enumerate(zip(gathered.kind, gathered.true, strict=True))
        if kind == STOP_LINE and true is not None
    ]
    if not rows:
        return Readings(np.empty(0), np.empty(0, dtype=np.bool_))
    evidence = np.array([gathered.evidence[row] for row in rows])
    views = np.array([gathered.views[row] for row in rows], dtype=np.float32)
    odds, _ = classify_alone(evidence, views, [STOP_LINE] * len(rows))
    return Readings(odds, np.array([gathered.true[row] is True for row in rows]))


def fitted(readings: Readings) -> dict[str, object]:
    """What ``confidence.json`` is to hold of stop lines."""
    weights, bias = fit(readings.odds[:, None], readings.true, np.ones(1))
    by_name = dict.fromkeys(AMONG, 0.0) | {"alone": round(float(weights[0]), 4)}
    return {"bias": round(bias, 4), "weights": by_name}


def _told(name: str, function: dict[str, object], readings: Readings, least: float) -> None:
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
    parser.add_argument("--renders", type=int, default=180)
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    least = DetectorOptions().min_confidence
    detector = Detector.load(options=DetectorOptions(max_range_m=24.0, min_confidence=0.0))
    parts = [readings_in(shown, detector) for shown in images(parsed.labels, parsed.images, parsed.renders)]
    readings = Readings(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    functions = json.loads(CONFIDENCE_FILE.read_text(encoding="utf-8"))
    _told("before", functions[STOP_LINE], readings, least)
    functions[STOP_LINE] = fitted(readings)
    _told("after", functions[STOP_LINE], readings, least)
    replace_text(CONFIDENCE_FILE, json.dumps(functions, indent=1) + "\n")
    command = f"python -m train.fit_stop_lines {parsed.labels.name} IMAGES --renders {parsed.renders}"
    record([CONFIDENCE_FILE.name], command)


if __name__ == "__main__":
    main()
