"""Fits the weights of the score of lanes' lines, ``v2hdm/detection/lanes/score.json``, to the network.

    python -m tests.benchmarks.detector_lanes --images 450 --write

Run it after another network was put in place. The lines that the detector proposes on rendered scenes,
sure or not, two thirds of them of full difficulty and a third easy ones, are true if four fifths of the
points that they were made of lie on one true line, by the tolerance of the quality benchmark; how far a line
was drawn on from there does not count. A logistic regression with a weak ridge tells them apart. Which lines
are proposed depends a little on the score itself, so that the fit is made twice. Its seed is neither that of
the quality benchmark nor one of training. Printed: what each feature adds to the log odds per standard
deviation, the log loss on the images of each fifth by weights that were fitted to the others, and how many
lines given are true and false.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from unittest.mock import patch

import cv2
import numpy as np

from tests.benchmarks.detector_confidence import FOLDS, fit, log_loss, renders_to_fit
from tests.benchmarks.detector_quality import LANE_TOLERANCE_PX, Example
from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.detector import Detector
from v2hdm.detection.lanes import anchors, score
from v2hdm.detection.lanes.points import Line, LinePoints
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.sight import AnchorRow
from v2hdm.records import BoolArray, FloatArray, LaneDetection

SEED = 921
ROUNDS = 2
LEAST_SHARE = 0.8
_MOST_SLOPE = 10.0


@dataclass(frozen=True)
class Seen:
    """What the lanes of one image are made of, and the truth."""

    rows: list[AnchorRow]
    paint: list[LaneDetection]
    view: CameraView
    lanes_px: list[FloatArray]


def seen(shown: Example, detector: Detector) -> Seen:
    """What the network and the paint of an image say of its lanes."""
    kept: list[Seen] = []

    def spy(
        rows: list[AnchorRow], view: CameraView, paint: list[LaneDetection], *_: object, **__: object
    ) -> list[LaneDetection]:
        kept.append(Seen(rows, list(paint), view, shown.lanes_px))
        return []

    with patch("v2hdm.detection.detector.link_anchors", spy):
        detector.detect(shown.image, shown.camera)
    return kept[0]


def proposed(image: Seen, paint_step_m: float) -> Iterator[tuple[FloatArray, bool]]:
    """Evidence (F,) of each line that is proposed, and whether it is true."""
    lines: list[tuple[LinePoints, Line]] = []
    find_lines = anchors.find_lines

    def spy(points: LinePoints, *rest: object) -> list[Line]:
        found = find_lines(points, *rest[:-1], -np.inf)
        lines.extend((points, line) for line in found)
        return found

    with patch.object(anchors, "find_lines", spy):
        anchors.link_anchors(image.rows, image.view, image.paint, paint_step_m)
    for points, line in lines:
        at_px = points.points_px[line.certain]
        share = max((share_on(lane, at_px) for lane in image.lanes_px), default=0.0)
        yield score.evidence([line], points, image.view)[0], share >= LEAST_SHARE


def share_on(lane_px: FloatArray, points_px: FloatArray) -> float:
    """The share of points (N, 2) that lie on a line (M, 2), within 20 px widened by its slope there."""
    order = np.argsort(lane_px[:, 1])
    v, u = lane_px[order, 1], lane_px[order, 0]
    slope = np.clip(np.gradient(u) / np.maximum(np.gradient(v), 1e-6), -_MOST_SLOPE, _MOST_SLOPE)
    at = points_px[:, 1]
    off = np.abs(np.interp(at, v, u, left=np.nan, right=np.nan) - points_px[:, 0])
    return float((off < LANE_TOLERANCE_PX * np.hypot(1, np.interp(at, v, slope))).mean())


@dataclass(frozen=True)
class Gathered:
    """Evidence (N, F) of proposed lines, which of them are true (N,), and their images (N,)."""

    evidence: FloatArray
    true: BoolArray
    image: np.ndarray

    @classmethod
    def of(cls, images: list[Seen], paint_step_m: float) -> Gathered:
        """Those of all images, by the weights that there are."""
        found = [(k, *line) for k, image in enumerate(images) for line in proposed(image, paint_step_m)]
        index, evidence, true = (np.array(column) for column in zip(*found, strict=True))
        return cls(evidence, true, index)

    def log_loss(self, weights: FloatArray, bias: float) -> float:
        """Mean of minus the log probability of what is the case."""
        return log_loss(self.evidence @ weights + bias, self.true)

    def left_out(self) -> float:
        """Log loss on the images of each fifth of weights that were fitted to the others."""
        fold = self.image % FOLDS
        parts = [(self._where(fold == k), self._where(fold != k)) for k in range(FOLDS)]
        return float(np.mean([out.log_loss(*fit(kept.evidence, kept.true)) for out, kept in parts]))

    def _where(self, kept: BoolArray) -> Gathered:
        return Gathered(self.evidence[kept], self.true[kept], self.image[kept])


def main() -> None:
    """Gather, fit, print, and write if asked to."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--images", type=int, default=450)
    parser.add_argument("--model")
    parser.add_argument("--write", action="store_true")
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    options = DetectorOptions(model=parsed.model, max_range_m=24.0)
    detector = Detector.load(options=options)
    images = [seen(shown, detector) for _, shown in renders_to_fit(parsed.images, SEED)]
    gathered = Gathered.of(images, options.lane_step_m)
    weights, bias = score.fitted()
    print(f"{gathered.true.sum()} true, {(~gathered.true).sum()} false lines in {parsed.images} images")
    print(f"log loss of the weights so far {gathered.log_loss(weights, bias):.3f}")
    for _ in range(ROUNDS):
        weights, bias = fit(gathered.evidence, gathered.true)
        with patch.object(score, "fitted", lambda fitted=(weights, bias): fitted):
            gathered = Gathered.of(images, options.lane_step_m)
    for name, weight, deviation in zip(score.FEATURES, weights, gathered.evidence.std(axis=0), strict=True):
        print(f"{name:16s} {weight * deviation:+.2f}")
    print(f"log loss of images left out {gathered.left_out():.3f}")
    given = gathered.evidence @ weights + bias > anchors.LEAST_LOG_ODDS
    print(f"given: {(given & gathered.true).sum()} true, {(given & ~gathered.true).sum()} false")
    if parsed.write:
        written = dict(zip(score.FEATURES, weights.round(4).tolist(), strict=True))
        score.SCORE_FILE.write_text(json.dumps({"bias": round(bias, 4), "weights": written}, indent=1) + "\n")


if __name__ == "__main__":
    main()
