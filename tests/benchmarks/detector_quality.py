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
from dataclasses import dataclass, field

import cv2
import numpy as np

from tests.benchmarks.tusimple import TuSimple, judge
from v2hdm.detection.camera.ground import apply_homography, ipm_from_extrinsic
from v2hdm.detection.camera.lens import distort_points
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.mapping.shapes import signed_area
from v2hdm.planar import clip_convex, clip_half
from v2hdm.records import (
    CORNERED_CLASSES,
    LANE_BOUNDARY,
    LANE_CLASSES,
    OUTLINED_CLASSES,
    PAINT_CLASSES,
    Camera,
    FloatArray,
    MarkingDetection,
)
from v2hdm.simulate.render.renderer import Rendered, Renderer
from v2hdm.simulate.render.scene import Scene
from v2hdm.simulate.training.scenes import image_line, image_points, random_scene
from v2hdm.simulate.training.views import TrainingView, random_view

SEED = 771_000_003
"""No training or validation seed, whatever their index: those start from single-digit seeds."""

WIDTH, HEIGHT = 1280, 720
MAX_RANGE_M = 20.0
CORNER_RANGE_M = 15.0
WHOLE_SHARE = 0.97
"""A marking counts as wholly seen when this share of its area is; others may be found or not."""

TOUCHING_PX = 2
TOUCHED_SHARE = 0.05
"""Other paint touches a marking if it holds more than this share of a seam of so many px around it."""

ANY_CONFIDENCE = 0.05
NEAREST_M = 0.3
_FRAME_PX = np.array([[-1.0, -1.0], [2.0, -1.0], [2.0, 2.0], [-1.0, 2.0]]) * (WIDTH, HEIGHT)
"""Markings are known to be there as far as they lie before the camera and about the image."""

MIN_HEIGHT_PX = 4.0
LANE_TOLERANCE_PX = 20.0
LANE_MATCH = 0.85
LEAST_SHOWN_M = 1.0
"""A line shows if so much of its paint is in the image and in front of what stands there; who labels images
cannot know of others. Those parts of such a line that are hidden or between its dashes are asked for."""

_STATION_M = 0.5
_BESIDE_M = np.linspace(-0.5, 0.5, 21)
"""Paint this far beside a line's middle is its own: those of double lines are."""


@dataclass(frozen=True)
class TrueMarking:
    """One painted quadrilateral or symbol in an image; ``fair`` if it must be found, else it may be."""

    kind: str
    polygon_px: FloatArray
    range_m: float
    fair: bool


@dataclass(frozen=True)
class Example:
    """An image with its camera and truth."""

    image: np.ndarray
    camera: Camera
    markings: list[TrueMarking]
    lanes_px: list[FloatArray]
    lanes_shown: list[bool] = field(default_factory=list)


def example(index: int, difficulty: float = 1.0, seed: int = SEED) -> Example:
    """Example ``index`` of the fixed set, or of that of another ``seed``."""
    rng = np.random.default_rng([seed, index])
    scene, lanes = random_scene(rng, difficulty)
    view = random_view(rng, WIDTH, HEIGHT)
    rendered = Renderer(scene).render(view.info, view.cam_from_map, rng, view.optics, view.motion)
    return example_of(scene, lanes, view, rendered, _camera(view))


def example_of(
    scene: Scene, lanes_map: list[FloatArray], view: TrainingView, rendered: Rendered, camera: Camera
) -> Example:
    """What there is to be found in an image of a scene, whose lines (N, 2) have a point every half metre."""
    lines_px = [image_line(view, lane) for lane in lanes_map]
    seen = [lane for lane, line_px in zip(lanes_map, lines_px, strict=True) if len(line_px) > 1]
    lanes_px = [line_px for line_px in lines_px if len(line_px) > 1]
    lanes_shown = [_shows(lane, view, rendered) for lane in seen]
    return Example(rendered.image, camera, _markings(scene, view, rendered), lanes_px, lanes_shown)


def _shows(lane_map: FloatArray, view: TrainingView, rendered: Rendered) -> bool:
    """Whether enough paint of a line (N, 2), a point every half metre, is to be seen in the image."""
    ahead = np.gradient(lane_map, axis=0)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.linalg.norm(ahead, axis=1, keepdims=True)
    kinds = [PAINT_CLASSES.index(kind) + 1 for kind in LANE_CLASSES]
    shown = 0
    for point, across in zip(lane_map, left, strict=True):
        u, v = np.round(image_points(view, point + _BESIDE_M[:, None] * across)).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < WIDTH) & (v < HEIGHT)
        shown += bool(np.isin(rendered.labels[v[inside], u[inside]], kinds).any())
    return shown * _STATION_M >= LEAST_SHOWN_M


def _camera(view: TrainingView) -> Camera:
    ipm = ipm_from_extrinsic(view.info, view.cam_from_map)
    middle = apply_homography(ipm, np.array([[WIDTH / 2, HEIGHT - 1.0]]))
    square = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
    return Camera(view.info, {"true": ipm}, "true", middle + square)


def _markings(scene: Scene, view: TrainingView, rendered: Rendered) -> list[TrueMarking]:
    """The scene's paint by piece; pieces that belong together (arrows, chevrons) are judged as one."""
    centre = -view.cam_from_map[:3, :3].T @ view.cam_from_map[:3, 3]
    out = []
    for paint in scene.paints:
        if paint.kind not in CORNERED_CLASSES + OUTLINED_CLASSES:
            continue
        polygon = np.asarray(paint.polygon_map, dtype=np.float64)
        polygon = _before_camera(polygon, view)
        cam = polygon @ view.cam_from_map[:3, :2].T + view.cam_from_map[:3, 3]
        pinhole = (cam @ view.info.intrinsic.T)[:, :2] / cam[:, 2:]
        pinhole = clip_convex(pinhole, _FRAME_PX) if len(polygon) else pinhole
        if len(pinhole) < 3:
            continue
        polygon_px = distort_points(view.info, pinhole)
        range_m = float(np.linalg.norm(polygon.mean(axis=0) - centre[:2]))
        whole = _seen_alone(polygon_px, PAINT_CLASSES.index(paint.kind) + 1, rendered)
        tall = float(np.ptp(polygon_px[:, 1])) >= MIN_HEIGHT_PX
        fair = whole and tall and range_m <= MAX_RANGE_M and paint.wear <= 0.4
        out.append(TrueMarking(paint.kind, polygon_px, range_m, fair and paint.kind in CORNERED_CLASSES))
    return out


def _before_camera(polygon_map: FloatArray, view: TrainingView) -> FloatArray:
    """The part of a ground polygon (N, 2) that lies before the camera."""
    depth = polygon_map @ view.cam_from_map[2, :2] + view.cam_from_map[2, 3]
    return clip_half(polygon_map, depth - NEAREST_M)


def _seen_alone(polygon_px: FloatArray, label: int, rendered: Rendered) -> bool:
    """Whether a polygon is wholly seen, border of the image included, and no other paint touches it.

    Where paint runs into other paint there is no outline to be found.
    """
    low = np.floor(polygon_px.min(axis=0)).astype(int) - TOUCHING_PX
    high = np.ceil(polygon_px.max(axis=0)).astype(int) + 1 + TOUCHING_PX
    size = high - low
    mask = np.zeros((size[1], size[0]), dtype=np.uint8)
    cv2.fillConvexPoly(mask, np.round((polygon_px - low) * 16).astype(np.int32), 1, shift=4)
    around = cv2.dilate(mask, np.ones((2 * TOUCHING_PX + 1,) * 2, np.uint8)) - mask
    mask = cv2.erode(mask, np.ones((3, 3), np.uint8), borderValue=0) if mask.sum() > 200 else mask
    return _share(mask, low, rendered, (label,)) >= WHOLE_SHARE and (
        _share(around, low, rendered, range(1, len(PAINT_CLASSES) + 1)) <= TOUCHED_SHARE
    )


def _share(mask: np.ndarray, low: np.ndarray, rendered: Rendered, labels: Iterable[int]) -> float:
    """Share of a mask's pixels, placed at ``low``, that show one of the labels; 0 if some are outside."""
    v, u = np.nonzero(mask)
    u, v = u + low[0], v + low[1]
    inside = (u >= 0) & (v >= 0) & (u < WIDTH) & (v < HEIGHT)
    if not len(u) or not inside.all():
        return 0.0
    return float(np.isin(rendered.labels[v, u], list(labels)).mean())


class Tally:
    """What has been counted so far."""

    def __init__(self) -> None:
        self.scored: dict[str, list[tuple[float, bool]]] = defaultdict(list)
        self.fair: Counter[str] = Counter()
        self.found: Counter[str] = Counter()
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

    def add_markings(self, truth: list[TrueMarking], given: tuple[MarkingDetection, ...]) -> None:
        """Match by overlap, best score first, each truth once."""
        for true in truth:
            self.fair[true.kind] += true.fair
        free = set(range(len(truth)))
        for detection in sorted(given, key=lambda d: -d.score):
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
                        self._add_corners(truth[best], detection)
                continue
            near = max(overlap.values(), default=0.0)
            if near > 0.05:
                k = max(overlap, key=overlap.__getitem__)
                if truth[k].kind != detection.kind and truth[k].fair:
                    self.taken_for[truth[k].kind, detection.kind] += sure
                    self.scored[detection.kind].append((detection.score, False))
                continue
            self.false += sure and detection.kind in CORNERED_CLASSES
            self.scored[detection.kind].append((detection.score, False))

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
        self, truth: list[FloatArray], shown: list[bool], given: list[FloatArray], first_row: float
    ) -> None:
        """Points within 20 px (widened by the line's slope) on every tenth row are right.

        A line given is false if fewer than 85 % of its points lie on any true line.
        """
        official = judge([lane for lane, show in zip(truth, shown, strict=True) if show], given)
        self.tusimple += [official] if official else []
        rows = np.arange(np.ceil(first_row / 10) * 10, HEIGHT, 10.0)
        lines = [_at_rows(line, rows) for line in given]
        self.lanes_given += len(lines)
        for lane, show in zip(truth, shown, strict=True):
            u = _at_rows(lane, rows)
            seen = (u >= 0) & (u < WIDTH)
            if seen.sum() < 5:
                continue
            slope = np.abs(np.polyfit(rows[seen], u[seen], 1)[0])
            tolerance = LANE_TOLERANCE_PX * np.hypot(1, slope)
            right = [(np.abs(line - u)[seen] < tolerance).sum() for line in lines]
            self.lane_points += int(seen.sum())
            self.lane_right += int(max(right, default=0))
            self.shown_points += int(seen.sum()) if show else 0
            self.shown_right += int(max(right, default=0)) if show else 0
        for line in lines:
            known = np.isfinite(line)
            near = [
                (np.abs(_at_rows(lane, rows) - line)[known] < 2 * LANE_TOLERANCE_PX).mean() for lane in truth
            ]
            self.lane_false += max(near, default=0.0) < LANE_MATCH


def _at_rows(line: FloatArray, rows: FloatArray) -> FloatArray:
    """Columns of a line (N, 2) on image rows; nan where it does not reach."""
    order = np.argsort(line[:, 1])
    return np.interp(rows, line[order, 1], line[order, 0], left=np.nan, right=np.nan)


def polygon_overlap(first: FloatArray, second: FloatArray) -> float:
    """Intersection over union of the hulls of two polygons."""
    a, b = (cv2.convexHull(p.astype(np.float32))[:, 0].astype(np.float64) for p in (first, second))
    common, first_area, second_area = (abs(float(signed_area(p))) for p in (clip_convex(a, b), a, b))
    return common / max(first_area + second_area - common, 1e-6)


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
    """What a detector with a network (None: the shipped one) makes of examples."""
    options = DetectorOptions(model=model, max_range_m=24.0, min_confidence=ANY_CONFIDENCE)
    detector = Detector.load(options=options)
    tally = Tally()
    for shown in examples:
        markings, lanes = detector.detect(shown.image, shown.camera)
        tally.add_markings(shown.markings, markings)
        curves = [lane.points_px for lane in lanes if lane.kind == LANE_BOUNDARY]
        tally.add_lanes(shown.lanes_px, shown.lanes_shown, curves, detector.view(shown.camera).top)
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
    lines += [_corner_line(tally), _lane_line(tally)]
    return "\n".join(lines)


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
