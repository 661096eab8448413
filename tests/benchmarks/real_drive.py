"""How well the shipped detector sees on a real drive, which no training ever showed.

    python -m tests.benchmarks.real_drive --drive DRIVE --reference FILE [--accuracy C] [--overlays FOLDER]

The drive is mapped as ``v2hdm map`` maps it. The reference is a file of what is really painted there, see
:func:`tests.benchmarks.real_reference.read_reference`: never a map of our own. Two tables are printed.

*The map*: each marking of the reference is mapped if the map has one of its class whose centre lies within
half a metre (an arrow's: one metre). Those that are missing are listed with the reason that the map gives. A
marking of the map is false if nothing of the reference lies there and the reference is whole for its class.

*The images*: the calibration and poses of the map place the reference in every image. A marking counts in an
image if it lies wholly inside, is not hidden and its centre is within 20 m of the camera on the ground. It is
found by a detection of any class that overlaps it with its centre as near as above; the class is right if
that of the detection is. A detection (lane lines are none) is false if it has no part within half a metre of
anything painted. Dashes are in the sun or under the trees by the light on the road around them: see
:func:`tests.benchmarks.real_view.shaded_share`.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from tests.benchmarks.real_reference import TOLERANCE_M, Painted, Reference, centre_of_area, read_reference
from tests.benchmarks.real_view import View, shaded_share
from v2hdm.detection.frames import read_image
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.road import draw_detections
from v2hdm.errors import MapFileError
from v2hdm.io.drive import ReadOptions
from v2hdm.mapping.options import MappingOptions
from v2hdm.pipeline.map_drive import map_drive
from v2hdm.pipeline.result import Result
from v2hdm.records import (
    ACCURACIES,
    ARROW,
    LANE_DASH,
    LANE_LINE,
    Exclusion,
    FloatArray,
    MarkingDetection,
)
from v2hdm.site.options import AcceptanceOptions

MAX_RANGE_M = 20.0
"""Distance from the camera on the ground, m, up to which an image must show a marking."""

SHADED_SHARE = 0.25
"""A dash is under the trees if more than this share of the road around it is in shade."""

_LEFT_OUT_M = 1.5
"""Distance, m, between a marking and a candidate that the map left out, up to which that is its reason."""

_TARGETS = {"dashes in the sun": 0.98, "dashes under trees": 0.85}
_GREEN, _RED, _MAGENTA, _GREY = (0, 220, 0), (0, 0, 255), (255, 0, 255), (160, 160, 160)


@dataclass(frozen=True)
class Shown:
    """A marking of the reference, by index, that an image shows, and the class it was found as if it was."""

    marking: int
    range_m: float
    found_as: str | None


@dataclass
class ImageResult:
    """One image's result: ``on`` pairs markings of the reference with the class of a detection on them."""

    shown: list[Shown] = field(default_factory=list)
    on: list[tuple[int, str]] = field(default_factory=list)
    false: list[MarkingDetection] = field(default_factory=list)


def judge_image(
    view: View, reference: Reference, hidden: Sequence[FloatArray], detections: Sequence[MarkingDetection]
) -> ImageResult:
    """Match the detections of one image with what it must show, best overlap first."""
    result = ImageResult()
    polygons_px = [view.project(painted.polygon_map) for painted in reference.markings]
    pairs: list[tuple[float, int, int]] = []
    for d, detection in enumerate(detections):
        shape_px = outline(detection)
        ground = view.ground(shape_px)
        close_markings = [m for m, p in enumerate(reference.markings) if is_near(ground, p.polygon_map)]
        if not close_markings:
            if not reference.whole or detection.kind in reference.whole:
                result.false.append(detection)
            continue
        overlap = {m: _overlap(shape_px, polygons_px[m]) for m in close_markings}
        best = max(overlap, key=overlap.__getitem__)
        if overlap[best] > 0:
            result.on.append((best, detection.kind))
        centre = centre_of_area(ground) if np.isfinite(ground).all() else np.full(2, np.nan)
        for m, share in overlap.items():
            beside_m = float(np.linalg.norm(centre - reference.markings[m].centre_map))
            if share > 0 and beside_m <= reference.markings[m].tolerance_m:
                pairs.append((share, m, d))
    detection_of: dict[int, int] = {}
    for _, m, d in sorted(pairs, reverse=True):
        if m not in detection_of and d not in detection_of.values():
            detection_of[m] = d
    for m, painted in enumerate(reference.markings):
        range_m = view.range_m(painted.centre_map)
        if painted.optional or painted.kind == LANE_LINE:
            continue
        if range_m > MAX_RANGE_M or not view.holds(polygons_px[m]):
            continue
        if not any(_touches_box(polygons_px[m], box) for box in hidden):
            result.shown.append(
                Shown(m, range_m, detections[detection_of[m]].kind if m in detection_of else None)
            )
    return result


def outline(detection: MarkingDetection) -> FloatArray:
    """The polygon (N, 2) px of a detection of any class."""
    return detection.outline_px if len(detection.outline_px) else detection.corners_px


def is_near(points_map: FloatArray, polygon_map: FloatArray) -> bool:
    """Whether a polygon (N, 2), nan where it has no place, has a part within the tolerance of another."""
    finite_points = points_map[np.isfinite(points_map).all(axis=1)]
    if not len(finite_points):
        return False
    origin = polygon_map[0]
    return any(
        cv2.pointPolygonTest((inner - origin).astype(np.float32), (float(x), float(y)), True) >= -TOLERANCE_M
        for inner, outer in ((polygon_map, finite_points), (finite_points, polygon_map))
        for x, y in outer - origin
    )


def _overlap(first: FloatArray, second: FloatArray) -> float:
    """Intersection over union of two polygons of any shape, on a grid of an eighth of a pixel at least."""
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        return 0.0
    low = np.minimum(first.min(axis=0), second.min(axis=0))
    size = np.maximum(first.max(axis=0), second.max(axis=0)) - low
    scale = min(8.0, 1000.0 / max(float(size.max()), 1.0))
    masks = []
    for polygon in (first, second):
        mask = np.zeros((int(size[1] * scale) + 2, int(size[0] * scale) + 2), dtype=np.uint8)
        cv2.fillPoly(mask, [np.round((polygon - low) * scale * 16).astype(np.int32)], 1, shift=4)
        masks.append(mask.astype(bool))
    return float((masks[0] & masks[1]).sum() / max((masks[0] | masks[1]).sum(), 1))


def _touches_box(polygon_px: FloatArray, box: FloatArray) -> bool:
    low, high = polygon_px.min(axis=0), polygon_px.max(axis=0)
    return bool((low <= box[2:]).all() and (high >= box[:2]).all())


class Tally:
    """Counts by group of markings over all images."""

    def __init__(self, reference: Reference, shaded: FloatArray) -> None:
        self.groups = [group_of(p, s) for p, s in zip(reference.markings, shaded, strict=True)]
        self.kinds = [p.kind for p in reference.markings]
        self.optional = [p.optional for p in reference.markings]
        self.seen: Counter[str] = Counter()
        self.found: Counter[str] = Counter()
        self.right: Counter[str] = Counter()
        self.on: Counter[str] = Counter()
        self.on_right: Counter[str] = Counter()
        self.taken_for: Counter[tuple[str, str]] = Counter()
        self.false: Counter[str] = Counter()
        self.images = 0
        self.images_shown: Counter[int] = Counter()  # by marking, images that must show it
        self.images_found: Counter[int] = Counter()  # and those in which it was found

    def add(self, result: ImageResult) -> None:
        """Count one image."""
        self.images += 1
        for shown in result.shown:
            group = self.groups[shown.marking]
            self.images_shown[shown.marking] += 1
            self.images_found[shown.marking] += shown.found_as is not None
            self.seen[group] += 1
            self.found[group] += shown.found_as is not None
            self.right[group] += shown.found_as == self.kinds[shown.marking]
        for marking, kind in result.on:
            if not self.optional[marking]:
                right = kind == self.kinds[marking]
                self.on[self.groups[marking]] += 1
                self.on_right[self.groups[marking]] += right
                if not right:
                    self.taken_for[self.groups[marking], kind] += 1
        self.false.update(detection.kind for detection in result.false)


def group_of(painted: Painted, shaded: float) -> str:
    """The row of the table that a marking counts in."""
    if painted.other_road:
        return f"{painted.kind} of the other road"
    if painted.kind != LANE_DASH:
        return "arrows" if painted.kind == ARROW else painted.kind
    if np.isnan(shaded):
        return "dashes never seen near"
    return "dashes under trees" if shaded > SHADED_SHARE else "dashes in the sun"


def summary(tally: Tally, reference: Reference) -> str:
    """The table of what single images show."""
    lines = [f"{'':28s} {'shown':>6s} {'found':>6s} {'':>6s} {'class':>6s} {'of all on it':>12s}  target"]
    for group in sorted(set(tally.groups)):
        if not tally.seen[group]:
            continue
        target = f"found {_TARGETS[group]:.0%}, class 95 %" if group in _TARGETS else ""
        lines.append(
            f"{group:28s} {tally.seen[group]:6d} {tally.found[group]:6d} "
            f"{_share(tally.found[group], tally.seen[group]):>6s} "
            f"{_share(tally.right[group], tally.found[group]):>6s} "
            f"{_share(tally.on_right[group], tally.on[group]):>12s}  {target}"
        )
    found_count, right = sum(tally.found.values()), sum(tally.right.values())
    false = sum(tally.false.values())
    lines.append(f"class right: {_share(right, found_count)} of all found (target 95 %)")
    lines.append(f"taken for another class: {dict(tally.taken_for)}")
    lines.append(
        f"{_false_name(reference)}: {false} in {tally.images} images, {false / max(tally.images, 1):.2f} an "
        f"image (target 0.5): {dict(tally.false)}"
    )
    return "\n".join(lines)


def _false_name(reference: Reference) -> str:
    return "false" if reference.whole else "not in the reference (which is not said to be whole)"


def _share(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f} %" if whole else "-"


def draw(image: np.ndarray, view: View, reference: Reference, result: ImageResult) -> np.ndarray:
    """An image with the reference: green where found, red where missed, grey where not asked for.

    Detections that are false are magenta.
    """
    state = {shown.marking: _GREEN if shown.found_as else _RED for shown in result.shown}
    canvas = image.copy()
    for m, painted in enumerate(reference.markings):
        polygon = view.project(painted.polygon_map)
        if np.isfinite(polygon).all() and view.range_m(painted.centre_map) < 1.5 * MAX_RANGE_M:
            _draw_polygon(canvas, polygon, state.get(m, _GREY))
    for detection in result.false:
        _draw_polygon(canvas, outline(detection), _MAGENTA, 2)
    return canvas


def _draw_polygon(
    canvas: np.ndarray, polygon: FloatArray, colour: tuple[int, int, int], width: int = 1
) -> None:
    points = np.round(np.clip(polygon, -2000, 4000) * 16).astype(np.int32)
    cv2.polylines(canvas, [points], True, colour, width, cv2.LINE_AA, 4)


def views_of_images(result: Result) -> list[View]:
    """The view of every image under the optimised calibration and poses."""
    views = []
    surface = result.best.surface
    for image in result.drive.images:
        calibration = result.calibrations[image.camera]
        map_from_vehicle = result.trajectory.of_image(image)
        cam_from_map = calibration.cam_from_vehicle @ np.linalg.inv(map_from_vehicle)
        road = None if surface is None else surface.seen_from(map_from_vehicle[None])
        views.append(View(calibration.info, cam_from_map, road))
    return views


def report(result: Result, reference: Reference, overlays: Path | None) -> str:
    """Judge the map and every image, draw the images if asked to, and return the tables."""
    views = [
        replace(view, cam_from_map=reference.cam_from_map.get(index, view.cam_from_map))
        for index, view in enumerate(views_of_images(result))
    ]
    drive = result.drive
    tally = Tally(reference, shaded_share(drive, views, reference.markings))
    for index, (view, image) in enumerate(zip(views, drive.images, strict=True)):
        detections = result.detections[index]
        judged = judge_image(view, reference, reference.hidden.get(index, []), detections.markings)
        tally.add(judged)
        if overlays:
            pixels = read_image(image, drive.cameras[image.camera])
            marked = draw_detections(pixels, detections.markings, detections.lanes)
            overlays.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(overlays / f"{index:06d}.png"), draw(marked, view, reference, judged))
    hd_map = result.best.hd_map
    mapped = [(marking.kind, marking.corners_map) for marking in hd_map.markings]
    mapped += [(symbol.kind, symbol.outline_map) for symbol in hd_map.symbols]
    on_map = map_summary(mapped, result.best.excluded, reference, tally)
    return f"{result.verdict.lines[0]}\n\n{on_map}\n\n{summary(tally, reference)}"


def map_summary(
    mapped: Sequence[tuple[str, FloatArray]],
    excluded: Sequence[Exclusion],
    reference: Reference,
    tally: Tally,
) -> str:
    """Lines on the reference's markings that the map holds, those missing and why, and false markings.

    ``mapped`` are class and polygon (N, 2), m, of each marking and symbol of the map.
    """
    centres_map = np.array([centre_of_area(polygon) for _, polygon in mapped]).reshape(-1, 2)
    kinds = np.array([kind for kind, _ in mapped])
    lines = [f"{'':28s} {'painted':>8s} {'found':>6s} {'mapped':>7s}"]
    missing = []
    for kind in sorted({painted.kind for painted in reference.markings}):
        of_kind = [
            m
            for m, painted in enumerate(reference.markings)
            if painted.kind == kind and not (painted.optional or painted.other_road)
        ]
        lost = []
        for m in of_kind:
            painted = reference.markings[m]
            off_m = np.linalg.norm(centres_map[kinds == kind] - painted.centre_map, axis=1)
            if off_m.min(initial=np.inf) > painted.tolerance_m:
                lost.append(m)
        found_count = sum(tally.images_found[m] > 0 for m in of_kind)
        lines.append(f"{kind:28s} {len(of_kind):8d} {found_count:6d} {len(of_kind) - len(lost):7d}")
        missing += lost
    for m in missing:
        painted = reference.markings[m]
        images = f"found in {tally.images_found[m]} of the {tally.images_shown[m]} images that show it"
        lines.append(
            f"missing: {painted.kind} at {_place(painted.centre_map)}: {images}; {_reason(painted, excluded)}"
        )
    stray = [
        f"{kind} at {_place(centre_of_area(polygon))}"
        for kind, polygon in mapped
        if (not reference.whole or kind in reference.whole)
        and not any(is_near(polygon, painted.polygon_map) for painted in reference.markings)
    ]
    listed = f": {'; '.join(stray)}" if stray else ""
    lines.append(f"{_false_name(reference)}: {len(stray)} markings of the map (target none){listed}")
    return "\n".join(lines)


def _place(point_map: FloatArray) -> str:
    """A point (2,) in words."""
    return ", ".join(f"{coordinate_m:.1f}" for coordinate_m in point_map)


def _reason(painted: Painted, excluded: Sequence[Exclusion]) -> str:
    """Why the map left out the candidate that is nearest to a marking."""
    offsets_m = [np.linalg.norm(candidate.position_map - painted.centre_map) for candidate in excluded]
    if min(offsets_m, default=np.inf) > _LEFT_OUT_M:
        return "no candidate of the map lies there"
    nearest = excluded[int(np.argmin(offsets_m))]
    return f"left out as {nearest.kind} of {nearest.sightings} sightings: {nearest.reason}"


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--drive", type=Path, required=True)
    parser.add_argument("--camera", help="the camera to look through, if the drive has several")
    parser.add_argument("--reference", type=Path, required=True, help="file of what is painted there")
    worst = AcceptanceOptions().accuracy
    says = f"mapping.acceptance.accuracy, by default {worst}"
    parser.add_argument("--accuracy", choices=ACCURACIES, default=worst, help=says)
    parser.add_argument("--overlays", type=Path, help="folder for a picture of every image")
    parser.add_argument("--model")
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    result = map_drive(
        parsed.drive,
        options=MappingOptions(acceptance=AcceptanceOptions(accuracy=parsed.accuracy)),
        detector=replace(DetectorOptions.for_mapping(), model=parsed.model),
        reading=ReadOptions(cameras=[parsed.camera] if parsed.camera else []),
    )
    try:
        reference = read_reference(parsed.reference, result.drive.route_map)
    except MapFileError as error:
        parser.error(str(error))
    print(report(result, reference, parsed.overlays))


if __name__ == "__main__":
    main()
