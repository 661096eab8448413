"""Fits the weights of the score of lanes' lines, ``lane_score.json``, to the network.

``python -m train.ship`` runs it. The lines that the detector proposes on rendered scenes, sure or not, two
thirds of them of full difficulty and a third easy ones, are true if four fifths of the rows that they were
seen on lie on one true line, by the tolerance of the quality benchmark; how far a line was drawn on from
there does not count. A logistic regression with a weak ridge separates them by the features of each alone;
a second one scores each by its log odds, by weights that its own image had no part in, from its span and
from the others. Which lines are proposed depends a little on the score itself, so the fit is made twice. The
seed is neither that of the quality benchmark nor one of training. Printed: by how much each feature changes
the log odds per standard deviation, the log loss on the images of each fifth by weights that were fitted to
the others, alone and among the others, and how many lines given are true and false.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from train.examples import LANE_TOLERANCE_PX, Example
from train.fit_judge import FOLDS, fit, log_loss, render_to_fit
from v2hdm.detection.detector import Detector
from v2hdm.detection.lanes import lines as lane_lines
from v2hdm.detection.lanes import score
from v2hdm.detection.lanes.boundaries import draw
from v2hdm.detection.lanes.curves import LaneImage, Line, LinePoints
from v2hdm.detection.network import Network
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.weights import LANE_SCORE_FILE
from v2hdm.records import BoolArray, FloatArray
from v2hdm.store.files import replace_text

SEED = 921  # seed of the rendered scenes, not that of the benchmark nor of a training
ROUNDS = 2  # rounds of proposing lines by the weights fitted before
LEAST_SHARE = 0.8  # share of a line's points that must lie on a true one
_MOST_SLOPE = 10.0  # most columns a row of a line, by which the tolerance about it is widened

KEYS = {"alone": score.ALONE, "among": score.AMONG}

Weights = dict[str, tuple[FloatArray, float]]
"""The weights of :func:`v2hdm.detection.lanes.score.fitted`."""


@dataclass(frozen=True)
class Seen:
    """The evidence for the lanes of one image, and the truth."""

    image: LaneImage
    lanes_px: list[FloatArray]


def seen(shown: Example, detector: Detector) -> Seen:
    """The evidence for lanes in the network's output and the paint of an image."""
    proposals = detector.propose(detector.run_network(shown.image, shown.camera), shown.camera)
    return Seen(detector.lane_image(proposals, shown.image), shown.lanes_px)


@dataclass
class Proposed:
    """The lines that are proposed in one image, and which of them (N,) are true."""

    image: Seen
    points: LinePoints
    lines: list[Line]
    alone: FloatArray = field(init=False)
    true: BoolArray = field(init=False)

    def __post_init__(self) -> None:
        self.alone = score.features_alone(self.lines, self.points, self.image.image)
        self.true = np.array([self._is_true(line) for line in self.lines], dtype=np.bool_)

    def among(self, odds: FloatArray) -> FloatArray:
        """The features (N, F) of the lines among each other, of such log odds (N,) alone."""
        lines = [replace(line, log_odds=float(o)) for line, o in zip(self.lines, odds, strict=True)]
        return score.features_among(lines, self.points, self.image.image)

    def _is_true(self, line: Line) -> bool:
        drawn = draw(line, self.points, self.image.image)
        if drawn is None:
            return False
        rows_px = self.points.points_px[line.members, 1]
        within = (drawn.points_px[:, 1] >= rows_px.min()) & (drawn.points_px[:, 1] <= rows_px.max())
        line_px = drawn.points_px[within] if within.any() else drawn.points_px
        return max((share_on(lane, line_px) for lane in self.image.lanes_px), default=0.0) >= LEAST_SHARE


def proposed(image: Seen) -> Proposed | None:
    """The lines that are proposed in an image; None where there is nothing to make any of."""
    points, lines = lane_lines.propose(image.image, -np.inf)
    return Proposed(image, points, lines) if lines else None


def share_on(lane_px: FloatArray, points_px: FloatArray) -> float:
    """The share of points (N, 2) that lie on a line (M, 2), within 20 px widened by its slope there."""
    order = np.argsort(lane_px[:, 1])
    v = lane_px[order, 1]
    u = lane_px[order, 0]
    slope = np.clip(np.gradient(u) / np.maximum(np.gradient(v), 1e-6), -_MOST_SLOPE, _MOST_SLOPE)
    at = points_px[:, 1]
    off = np.abs(np.interp(at, v, u, left=np.nan, right=np.nan) - points_px[:, 0])
    return float((off < LANE_TOLERANCE_PX * np.hypot(1, np.interp(at, v, slope))).mean())


class Gathered:
    """The lines proposed in all images, by the weights that there are."""

    def __init__(self, images: Sequence[Seen]):
        self._images = [lines_of_image for image in images if (lines_of_image := proposed(image)) is not None]
        self._alone = np.concatenate([image.alone for image in self._images])
        self._count = [len(image.lines) for image in self._images]
        self._fold = np.repeat(np.arange(len(self._count)) % FOLDS, self._count)
        self.true = np.concatenate([image.true for image in self._images])

    def odds(self, weights: Weights) -> FloatArray:
        """Log odds (N,) by such weights, among the others."""
        among = self._among(self._alone @ weights["alone"][0] + weights["alone"][1])
        return np.asarray(among @ weights["among"][0] + weights["among"][1])

    def fit(self) -> tuple[Weights, FloatArray, FloatArray]:
        """Weights, and the log odds (N,) alone and among others by those of the other images."""
        alone = self._left_out(self._alone)
        among = self._among(alone)
        weights = {"alone": fit(self._alone, self.true), "among": fit(among, self.true)}
        return weights, alone, self._left_out(among)

    def effects(self, weights: Weights) -> Weights:
        """The change of the log odds per standard deviation of each feature."""
        among = self._among(self._alone @ weights["alone"][0] + weights["alone"][1])
        columns = {"alone": self._alone, "among": among}
        return {name: (weights[name][0] * columns[name].std(axis=0), 0.0) for name in weights}

    def _among(self, alone: FloatArray) -> FloatArray:
        parts = np.split(alone, np.cumsum(self._count)[:-1])
        return np.concatenate([image.among(part) for image, part in zip(self._images, parts, strict=True)])

    def _left_out(self, features: FloatArray) -> FloatArray:
        """Log odds (N,) of the lines of each fifth of the images, by a fit to the others."""
        odds = np.empty(len(features))
        for k in range(FOLDS):
            out = self._fold == k
            weights, bias = fit(features[~out], self.true[~out])
            odds[out] = features[out] @ weights + bias
        return odds


@dataclass(frozen=True)
class Part:
    """Scenes ``numbers`` of ``images``, to be seen with the network ``model``."""

    numbers: range
    images: int
    model: Path


def see(part: Part) -> list[Seen]:
    """The evidence for lanes in a part of the scenes."""
    detector = Detector(Network(part.model), DetectorOptions(max_range_m=24.0))
    return [seen(render_to_fit(number, part.images, SEED)[1], detector) for number in part.numbers]


def write(weights: Weights, folder: Path) -> None:
    """Write the weights to a folder."""
    named = {name: _named(*weights[name], keys) for name, keys in KEYS.items()}
    replace_text(folder / LANE_SCORE_FILE.name, json.dumps(named, indent=1) + "\n")


def fit_to(images: Sequence[Seen]) -> Weights:
    """The weights fitted to images; prints what they do."""
    gathered = Gathered(images)
    print(f"{gathered.true.sum()} true, {(~gathered.true).sum()} false lines in {len(images)} images")
    before = gathered.odds(score.fitted())
    print(f"log loss of the weights so far {log_loss(before, gathered.true):.3f}")
    for _ in range(ROUNDS):
        weights, _, _ = gathered.fit()
        gathered = Gathered(
            [
                replace(proposed_image, image=replace(proposed_image.image, score=weights))
                for proposed_image in images
            ]
        )
    for name, (effect, _) in gathered.effects(weights).items():
        for key, value in zip(KEYS[name], effect, strict=True):
            print(f"{name:6s} {key:16s} {value:+.2f}")
    _, alone, among = gathered.fit()
    losses = [log_loss(odds, gathered.true) for odds in (alone, among)]
    print(f"log loss of images left out: alone {losses[0]:.3f}, among the others {losses[1]:.3f}")
    reported = gathered.odds(weights) > lane_lines.LEAST_LOG_ODDS
    print(f"given: {(reported & gathered.true).sum()} true, {(reported & ~gathered.true).sum()} false")
    return weights


def _named(weights: FloatArray, bias: float, keys: Sequence[str]) -> dict[str, object]:
    """Weights and bias as ``lane_score.json`` holds them."""
    return {"bias": round(bias, 4), "weights": dict(zip(keys, weights.round(4).tolist(), strict=True))}
