"""How well the shipped detector sees, on rendered scenes that no training ever showed.

    python -m tests.benchmarks.detector_quality --images 300

Full 1280 x 720 images of ports and streets, in any light and state of wear, with their true markings and
lanes. Printed: by class within 20 m the average precision at an overlap of one half (AP50), which is of
markings of any confidence, and the recall of those that the detector is sure enough of by default; of these
also false markings, corner errors in px, and the normalised squared error of their covariance. Then the
accuracy of lanes: over the points of all lines there are, over those of lines that show paint somewhere in
the image, and by TuSimple's own formula, whose labels are of such lines only.
"""

from __future__ import annotations

import argparse
from collections import Counter, defaultdict
from collections.abc import Iterable
from itertools import pairwise

import cv2
import numpy as np

from tests.benchmarks.tusimple import TuSimple, judge
from train.examples import HEIGHT, LANE_TOLERANCE_PX, WIDTH, Example, TrueMarking, example, polygon_overlap
from v2hdm.catalogue import CORNERED_CLASSES
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.records import LANE_BOUNDARY, FloatArray, MarkingDetection

CORNER_RANGE_M = 15.0
ANY_CONFIDENCE = 0.05
LANE_MATCH = 0.85

_NARROW_PX = (0.0, 6.0, 14.0, np.inf)
"""Recall is also told by how many px the narrow side of the rectangle around a marking has: what it is for
some other camera depends on that."""


class Tally:
    """Counts of detections so far."""

    def __init__(self) -> None:
        self.scored: dict[str, list[tuple[float, bool]]] = defaultdict(list)
        self.fair: Counter[str] = Counter()
        self.found: Counter[str] = Counter()
        self.found_of_size: list[tuple[float, bool]] = []
        self.taken_for: Counter[tuple[str, str]] = Counter()
        self.corner_error_px: list[FloatArray] = []
        self.normalised: list[float] = []
        self.false = 0
        self.least_score = DetectorOptions().min_confidence
        self.lane_right = 0
        self.lane_points = 0
        self.shown_right = 0
        self.shown_points = 0
        self.tusimple: list[TuSimple] = []
        self.lane_false = 0
        self.lanes_given = 0

    def add_markings(self, truth: list[TrueMarking], detections: tuple[MarkingDetection, ...]) -> None:
        """Match by overlap, best score first, each truth once."""
        for true in truth:
            self.fair[true.kind] += true.fair
        free = set(range(len(truth)))
        matched = set()
        for detection in sorted(detections, key=lambda d: -d.score):
            sure = detection.score >= self.least_score
            quad = detection.outline_px if len(detection.outline_px) else detection.corners_px
            overlap = {k: polygon_overlap(quad, truth[k].polygon_px) for k in range(len(truth))}
            best = max(
                (k for k in free if truth[k].kind == detection.kind), key=overlap.__getitem__, default=-1
            )
            if best >= 0 and overlap[best] >= 0.5:
                free.discard(best)
                if truth[best].fair:
                    self.scored[detection.kind].append((detection.score, True))
                    self.found[detection.kind] += sure
                    if sure:
                        matched.add(best)
                        self._add_corners(truth[best], detection)
                continue
            largest_overlap = max(overlap.values(), default=0.0)
            if largest_overlap > 0.05:
                k = max(overlap, key=overlap.__getitem__)
                if truth[k].kind != detection.kind and truth[k].fair:
                    self.taken_for[truth[k].kind, detection.kind] += sure
                    self.scored[detection.kind].append((detection.score, False))
                continue
            self.false += sure and detection.kind in CORNERED_CLASSES
            self.scored[detection.kind].append((detection.score, False))
        self.found_of_size += [(true.narrow_px, k in matched) for k, true in enumerate(truth) if true.fair]

    def _add_corners(self, true: TrueMarking, detection: MarkingDetection) -> None:
        if true.range_m > CORNER_RANGE_M:
            return
        shifts = [np.roll(true.polygon_px[::order], s, axis=0) for s in range(4) for order in (1, -1)]
        nearest = min(shifts, key=lambda p: float(np.abs(p - detection.corners_px).sum()))
        valid = detection.corner_valid
        error = detection.corners_px - nearest
        self.corner_error_px.extend(error[valid])
        for corner in np.flatnonzero(valid):
            part = slice(2 * corner, 2 * corner + 2)
            covariance = detection.covariance_px[part, part]
            self.normalised.append(float(error[corner] @ np.linalg.solve(covariance, error[corner])))

    def add_lanes(
        self, truth: list[FloatArray], shown: list[bool], drawn: list[FloatArray], first_row: float
    ) -> None:
        """Points within 20 px (widened by the line's slope) on every tenth row are right.

        A line given is false if fewer than 85 % of its points lie on any true line.
        """
        official = judge([lane for lane, show in zip(truth, shown, strict=True) if show], drawn)
        self.tusimple += [official] if official else []
        rows = np.arange(np.ceil(first_row / 10) * 10, HEIGHT, 10.0)
        lines = [_at_rows(line, rows) for line in drawn]
        self.lanes_given += len(lines)
        for lane, show in zip(truth, shown, strict=True):
            u = _at_rows(lane, rows)
            in_image = (u >= 0) & (u < WIDTH)
            if in_image.sum() < 5:
                continue
            slope = np.abs(np.polyfit(rows[in_image], u[in_image], 1)[0])
            tolerance = LANE_TOLERANCE_PX * np.hypot(1, slope)
            right = [(np.abs(line - u)[in_image] < tolerance).sum() for line in lines]
            self.lane_points += int(in_image.sum())
            self.lane_right += int(max(right, default=0))
            self.shown_points += int(in_image.sum()) if show else 0
            self.shown_right += int(max(right, default=0)) if show else 0
        for line in lines:
            has_column = np.isfinite(line)
            overlaps = [
                (np.abs(_at_rows(lane, rows) - line)[has_column] < 2 * LANE_TOLERANCE_PX).mean()
                for lane in truth
            ]
            self.lane_false += max(overlaps, default=0.0) < LANE_MATCH


def _at_rows(line: FloatArray, rows: FloatArray) -> FloatArray:
    """Columns of a line (N, 2) on image rows; nan where it does not reach."""
    order = np.argsort(line[:, 1])
    return np.interp(rows, line[order, 1], line[order, 0], left=np.nan, right=np.nan)


def average_precision(scored: list[tuple[float, bool]], truths: int) -> float:
    """Area under the curve of precision over recall, precision made monotone (as COCO's)."""
    if not truths:
        return float("nan")
    right = np.array([hit for _, hit in sorted(scored, key=lambda s: -s[0])], dtype=bool)
    if not len(right):
        return 0.0
    hits = np.cumsum(right)
    precision = np.maximum.accumulate((hits / np.arange(1, len(right) + 1))[::-1])[::-1]
    return float((precision * right).sum() / truths)


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--images", type=int, default=300)
    parser.add_argument("--model")
    parser.add_argument("--difficulty", type=float, default=1.0)
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    shown = (example(index, parsed.difficulty) for index in range(parsed.images))
    print(summary(counted(shown, parsed.model), parsed.images))


def counted(examples: Iterable[Example], model: str | None) -> Tally:
    """The detections of a network (None: the shipped one) on examples, counted."""
    options = DetectorOptions(model=model, max_range_m=24.0, min_confidence=ANY_CONFIDENCE)
    detector = Detector.load(options=options)
    tally = Tally()
    for shown in examples:
        markings, lanes = detector.detect(shown.image, shown.camera)
        tally.add_markings(shown.markings, markings)
        curves = [lane.points_px for lane in lanes if lane.kind == LANE_BOUNDARY]
        tally.add_lanes(shown.lanes_px, shown.lanes_shown, curves, detector.road_camera(shown.camera).top)
    return tally


def summary(tally: Tally, images: int) -> str:
    """The table."""
    lines = [f"{'class':14s} {'true':>5s} {'AP50':>6s} {'recall':>7s}"]
    for kind in CORNERED_CLASSES:
        truths = tally.fair[kind]
        recall = tally.found[kind] / max(truths, 1)
        lines.append(
            f"{kind:14s} {truths:5d} {average_precision(tally.scored[kind], truths):6.3f} {recall:7.3f}"
        )
    total = sum(tally.fair.values())
    lines.append(f"{'all':14s} {total:5d} {'':6s} {sum(tally.found.values()) / max(total, 1):7.3f}")
    lines.append(
        f"false markings: {tally.false} in {images} images; taken for another: {dict(+tally.taken_for)}"
    )
    lines += [_size_line(tally), _corner_line(tally), _lane_line(tally)]
    return "\n".join(lines)


def _size_line(tally: Tally) -> str:
    narrow, is_found = np.array(tally.found_of_size, dtype=np.float64).reshape(-1, 2).T
    parts = []
    for low, high in pairwise(_NARROW_PX):
        of_size = (narrow >= low) & (narrow < high)
        share = is_found[of_size].sum() / max(of_size.sum(), 1)
        parts.append(f"{low:g} to {high:g} px {share:.3f} ({of_size.sum()})")
    return f"recall by narrow side: {', '.join(parts)}"


def _corner_line(tally: Tally) -> str:
    error = np.array(tally.corner_error_px).reshape(-1, 2)
    size = np.linalg.norm(error, axis=1)
    normalised = np.sort(tally.normalised)
    return (
        f"corners within {CORNER_RANGE_M:g} m: {len(error)}, median {np.median(size):.3f} px, 95 % below "
        f"{np.quantile(size, 0.95):.3f} px, bias ({error[:, 0].mean():+.3f}, {error[:, 1].mean():+.3f}) px; "
        f"normalised squared error median {np.median(normalised):.2f} (honest: 1.39), mean of the inner 95 % "
        f"{normalised[: int(0.95 * len(error))].mean():.2f} (honest: 1.60)"
    )


def _lane_line(tally: Tally) -> str:
    accuracy = tally.lane_right / max(tally.lane_points, 1)
    shown = tally.shown_right / max(tally.shown_points, 1)
    official = np.mean(tally.tusimple, axis=0) if tally.tusimple else np.full(3, np.nan)
    return (
        f"lanes: accuracy {accuracy:.3f} over {tally.lane_points} points, {shown:.3f} over the "
        f"{tally.shown_points} of lines that show; {tally.lane_false} of {tally.lanes_given} lines false; "
        f"TuSimple's formula over {len(tally.tusimple)} images: accuracy {official[0]:.3f}, "
        f"false positive {official[1]:.3f}, false negative {official[2]:.3f}"
    )


if __name__ == "__main__":
    main()
