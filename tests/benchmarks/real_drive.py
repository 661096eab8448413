"""How well the shipped detector sees on a real drive, which no training ever showed.

    python -m tests.benchmarks.real_drive --drive DRIVE [--reference FILE] [--overlays FOLDER]

The drive is detected in with the mapping's own settings and mapped once; the calibration and poses found
place the reference, what is really painted there, in every image. Without a file it is the dashes of the map
and those that must lie between them, see :func:`tests.benchmarks.real_reference.make_reference`.

A marking counts in an image if it lies wholly inside, is not hidden and its centre is within 20 m of the
camera on the ground. It is found by a detection of any class that overlaps it with its centre within half a
metre; the class is right if that of the detection is. A detection (lane lines are none) is false if it has no
part within half a metre of anything painted. Dashes are in the sun or under the trees by the light on the
road around them: see :func:`tests.benchmarks.real_view.shaded_share`.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from tests.benchmarks.real_reference import Painted, Reference, centre_of_area, make_reference
from tests.benchmarks.real_view import View, shaded_share
from v2hdm.association.ground import views_of
from v2hdm.association.sightings import collect_sightings, frames_of
from v2hdm.detection.batch import detect_all, read_image
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.road import draw_detections
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.mapping.conclusion import Optimised
from v2hdm.mapping.optimise import Optimiser
from v2hdm.mapping.options import MappingOptions
from v2hdm.records import (
    ARROW,
    LANE_DASH,
    LANE_LINE,
    Drive,
    FloatArray,
    ImageDetections,
    Marking,
    MarkingDetection,
)

MAX_RANGE_M = 20.0
TOLERANCE_M = 0.5
SHADED_SHARE = 0.25
"""A dash is under the trees if more than this share of the road around it is in shade."""

_TARGETS = {"dashes in the sun": 0.98, "dashes under trees": 0.85}
_GREEN, _RED, _MAGENTA, _GREY = (0, 220, 0), (0, 0, 255), (255, 0, 255), (160, 160, 160)


@dataclass(frozen=True)
class Seen:
    """A marking of the reference, by index, that an image shows, and the class it was found as if it was."""

    marking: int
    range_m: float
    found_as: str | None


@dataclass
class ImageResult:
    """What one image says: ``on`` pairs markings of the reference with the class of a detection on them."""

    seen: list[Seen] = field(default_factory=list)
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
        near = [m for m, p in enumerate(reference.markings) if is_near(ground, p.polygon_map)]
        if not near:
            result.false.append(detection)
            continue
        overlap = {m: _overlap(shape_px, polygons_px[m]) for m in near}
        best = max(overlap, key=overlap.__getitem__)
        if overlap[best] > 0:
            result.on.append((best, detection.kind))
        centre = centre_of_area(ground) if np.isfinite(ground).all() else np.full(2, np.nan)
        for m, share in overlap.items():
            beside_m = float(np.linalg.norm(centre - reference.markings[m].centre_map))
            if share > 0 and beside_m <= TOLERANCE_M:
                pairs.append((share, m, d))
    found: dict[int, int] = {}
    for _, m, d in sorted(pairs, reverse=True):
        if m not in found and d not in found.values():
            found[m] = d
    for m, painted in enumerate(reference.markings):
        range_m = view.range_m(painted.centre_map)
        if painted.optional or painted.kind == LANE_LINE:
            continue
        if range_m > MAX_RANGE_M or not view.holds(polygons_px[m]):
            continue
        if not any(_touches_box(polygons_px[m], box) for box in hidden):
            result.seen.append(Seen(m, range_m, detections[found[m]].kind if m in found else None))
    return result


def outline(detection: MarkingDetection) -> FloatArray:
    """The polygon (N, 2) px of a detection of any class."""
    return detection.outline_px if len(detection.outline_px) else detection.corners_px


def is_near(points_map: FloatArray, polygon_map: FloatArray) -> bool:
    """Whether a polygon (N, 2), nan where it has no place, has a part within the tolerance of another."""
    known = points_map[np.isfinite(points_map).all(axis=1)]
    if not len(known):
        return False
    origin = polygon_map[0]
    return any(
        cv2.pointPolygonTest((inner - origin).astype(np.float32), (float(x), float(y)), True) >= -TOLERANCE_M
        for inner, outer in ((polygon_map, known), (known, polygon_map))
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
        self.markings_seen: set[int] = set()

    def add(self, result: ImageResult) -> None:
        """Count one image."""
        self.images += 1
        for seen in result.seen:
            group = self.groups[seen.marking]
            self.markings_seen.add(seen.marking)
            self.seen[group] += 1
            self.found[group] += seen.found_as is not None
            self.right[group] += seen.found_as == self.kinds[seen.marking]
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
    found, right = sum(tally.found.values()), sum(tally.right.values())
    false = sum(tally.false.values())
    lines.append(f"class right: {_share(right, found)} of all found (target 95 %)")
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
    state = {seen.marking: _GREEN if seen.found_as else _RED for seen in result.seen}
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


def optimise(drive: Drive, detections: Sequence[ImageDetections]) -> Optimised:
    """Map a drive with all its cameras together."""
    cameras = tuple(drive.cameras)
    sightings = collect_sightings(drive, detections, cameras)
    views = views_of(drive, cameras)
    optimiser = Optimiser(sightings, views, drive.cameras, drive.noises, MappingOptions())
    return optimiser.finish(optimiser.settle(optimiser.initial_tracks()))


def views_of_images(drive: Drive, optimised: Optimised) -> list[View]:
    """The view of every image under the optimised calibration and poses."""
    vehicle_from_map = np.linalg.inv(optimised.bundle.rig.map_from_vehicle)
    frame = frames_of(drive).frame_of_image
    views = []
    for index, image in enumerate(drive.images):
        calibration = optimised.calibrations[image.camera]
        views.append(View(calibration.info, calibration.cam_from_vehicle @ vehicle_from_map[frame[index]]))
    return views


def report(
    drive: Drive,
    detections: Sequence[ImageDetections],
    optimised: Optimised,
    reference_path: Path | None,
    overlays: Path | None,
) -> str:
    """Judge every image, draw it if asked to, and return the table."""
    views = views_of_images(drive, optimised)
    route = np.array([image.map_from_vehicle[:2, 3] for image in drive.images])
    reference = make_reference(optimised.markings, route, reference_path)
    views = [
        replace(view, cam_from_map=reference.cam_from_map.get(index, view.cam_from_map))
        for index, view in enumerate(views)
    ]
    tally = Tally(reference, shaded_share(drive, views, reference.markings))
    for index, (view, image) in enumerate(zip(views, drive.images, strict=True)):
        found = detections[index]
        result = judge_image(view, reference, reference.hidden.get(index, []), found.markings)
        tally.add(result)
        if overlays:
            pixels = read_image(image, drive.cameras[image.camera])
            shown = draw(draw_detections(pixels, found.markings, found.lanes), view, reference, result)
            overlays.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(overlays / f"{index:06d}.png"), shown)
    return summary(tally, reference) + "\n" + map_summary(optimised.markings, reference, tally)


def map_summary(mapped: Sequence[Marking], reference: Reference, tally: Tally) -> str:
    """What became of the detections in the map: markings of nothing painted, and dashes that it holds."""
    stray = [
        f"{marking.kind} at {np.round(marking.corners_map.mean(axis=0), 1)}"
        for marking in mapped
        if not any(is_near(marking.corners_map, p.polygon_map) for p in reference.markings)
    ]
    centres = np.array([m.corners_map.mean(axis=0) for m in mapped if m.kind == LANE_DASH]).reshape(-1, 2)
    dashes = [m for m in tally.markings_seen if tally.groups[m].startswith("dashes")]
    held = sum(
        float(np.linalg.norm(centres - reference.markings[m].centre_map, axis=1).min(initial=np.inf))
        <= TOLERANCE_M
        for m in dashes
    )
    return (
        f"map: {len(stray)} markings {_false_name(reference)} (target none) {stray}; "
        f"{held} of the {len(dashes)} dashes of the road that images showed are in it"
    )


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--drive", type=Path, required=True)
    parser.add_argument("--camera", help="the camera to look through, if the drive has several")
    parser.add_argument("--reference", type=Path)
    parser.add_argument("--overlays", type=Path, help="folder for a picture of every image")
    parser.add_argument("--model")
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    drive = read_drive(parsed.drive, ReadOptions(cameras=[parsed.camera] if parsed.camera else []))
    detections = detect_all(drive, replace(DetectorOptions.for_mapping(), model=parsed.model))
    optimised = optimise(drive, detections)
    print(report(drive, detections, optimised, parsed.reference, parsed.overlays))


if __name__ == "__main__":
    main()
