"""How well the shipped detector sees on labelled photographs that no training ever showed.

    python -m tests.benchmarks.photographs LABELS.json IMAGES [--mounting 1.3 -12 90] [--model FILE]
        [--stop-lines LIST.json]

With ``--shuffled`` the folder's photographs are in any order, with ``--alone`` each is a source of its own.
The files are those of ROAD MARK, see ``docs/labels.md``; judged are the blocks of places that the recipe
keeps apart for it (:func:`train.labels.held_out`). Printed, for diamonds and arrows by their height in px of
1280 x 720: the share that is found (overlap above .3 with a detection of any class) and named. Then, an
image, the symbols where no label is near; and how paint below the horizon agrees with all labels at
256 x 256, where an outline of a whole crosswalk, of writing or of a box counts as filled, as in
RoadMarkResUNet's published .628 / .747. That is said of the network's paint as it is, and of its outlines
drawn as the labels are (:func:`regions`): what a class's pieces enclose counts as theirs, by the network's
classes alone.

Crosswalks, words and boxes are found where the hull of neighbouring detections of their class overlaps the
label by more than .3. That joins words that stand side by side in several lanes. So it is printed, too, how
many are found where the outline of a single detection counts as well, of crosswalks that of a whole one; and
how many such areas lie where nothing is labelled.
"""

from __future__ import annotations

import argparse
import json
import random
import tempfile
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components

from train.examples import polygon_overlap
from train.labels import JUDGING, held_out
from v2hdm.catalogue import AREA, OTHER, SHIPPED, SYMBOL
from v2hdm.detection.detector import Detector, Looked
from v2hdm.detection.network import NetworkOutput
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.steps import Steps
from v2hdm.pipeline.detect_images import detect_images
from v2hdm.records import (
    BOX,
    CROSSWALK,
    CROSSWALK_BAR,
    DIAMOND,
    STOP_LINE,
    TEXT,
    Camera,
    FloatArray,
    MarkingDetection,
)

WIDTH, HEIGHT = 1280, 720
FOUND_IOU = 0.3
NEAR_PX = 12
"""A symbol this near to a label may be part of what that is about."""

ROUGH_RANGE_M = 40.0  # as of ``detect_images`` where nothing is stated

TALL_PX = ((24.0, np.inf), (12.0, 24.0))
SMALL = 256
PUBLISHED = ".628 / .747"

OF_PIECES = frozenset({"crosswalk_outline", "bus_lane", "yellow_box", "slow", "bicycle"})
"""Labels that outline many pieces of paint and the bare ground between them."""

OUTLINED_TOGETHER = (CROSSWALK_BAR, *SHIPPED.of_family(OTHER, AREA))
"""Classes whose neighbouring pieces the label set encloses by one outline: crosswalks, writing, boxes."""

_APART = 1.0
"""Neighbouring pieces are at most so far apart, in sizes of the larger one along each side of the image."""

CLASS_OF = {"crosswalk_outline": CROSSWALK_BAR, "slow": TEXT, "bus_lane": TEXT, "yellow_box": BOX}
"""Classes of the pieces that labels of many pieces show."""

WHOLE_OF = {**CLASS_OF, "crosswalk_outline": CROSSWALK}
"""Classes of the detections that outline these labels whole."""

STOP_LINE_PX = 11.0  # height of a stop line's outline from which it is no thin one
COVERED_SHARE = 0.5  # of a stop line's length is covered where it is found

_SYMBOLS = ("diamond", *SHIPPED.of_family(SYMBOL))


class Labels:
    """The labels of one image: names and polygons (N, 2), px of 1280 x 720."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.polygons: list[FloatArray] = []

    def near(self) -> np.ndarray:
        """Pixels (H, W) uint8 that are labelled, or near to it."""
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        for polygon in self.polygons:
            cv2.fillPoly(mask, [np.round(polygon).astype(np.int32)], 1)
        return np.asarray(cv2.dilate(mask, np.ones((2 * NEAR_PX + 1,) * 2, np.uint8)))

    def small(self) -> tuple[np.ndarray, np.ndarray]:
        """The labelled area, and what outlines of many pieces enclose, (256, 256) bool each."""
        masks = np.zeros((2, SMALL, SMALL), np.uint8)
        for name, polygon in zip(self.names, self.polygons, strict=True):
            ring = np.round(polygon * (SMALL / WIDTH, SMALL / HEIGHT)).astype(np.int32)
            for mask in masks[: 1 + (name in OF_PIECES)]:
                cv2.fillPoly(mask, [ring], 1)
        return masks[0] > 0, masks[1] > 0


def small_outlines(
    mask: np.ndarray, scale: FloatArray, top_px: int, gap_in_sizes: float | None
) -> list[np.ndarray]:
    """Outlines in px of 256 x 256 of the pieces of a mask that begins at the row ``top_px`` of an image.

    They are convex hulls of neighbouring pieces where ``apart`` is a number, see :data:`_APART`.
    """
    mode = cv2.RETR_CCOMP if gap_in_sizes is None else cv2.RETR_EXTERNAL
    pieces = list(cv2.findContours(mask.astype(np.uint8), mode, cv2.CHAIN_APPROX_SIMPLE)[0])
    if gap_in_sizes is not None and pieces:
        box = np.array([cv2.boundingRect(piece) for piece in pieces], dtype=np.float64)
        low, high = box[:, :2], box[:, :2] + box[:, 2:]
        gap = np.maximum(low[:, None] - high, low - high[:, None])
        is_near = (gap <= gap_in_sizes * np.maximum(box[:, None, 2:], box[:, 2:])).all(axis=2)
        count, group = connected_components(is_near)
        together = (
            np.vstack([pieces[k] for k in np.flatnonzero(group == number)]) for number in range(count)
        )
        pieces = [cv2.convexHull(points) for points in together]
    moved = ((piece[:, 0] + 0.5) * scale - 0.5 + (0, top_px * SMALL / HEIGHT) for piece in pieces)
    return [np.round(ring).astype(np.int32) for ring in moved]


def regions(output: NetworkOutput) -> np.ndarray:
    """The network's paint (256, 256) bool as the label set draws it, by outlines.

    A hollow diamond is filled, and what neighbouring pieces of :data:`OUTLINED_TOGETHER` enclose.
    """
    scale = output.stride * np.array([SMALL / WIDTH, SMALL / HEIGHT])
    kinds = cv2.resize(
        output.kinds.argmax(axis=0).astype(np.uint8),
        output.paint.shape[::-1],
        interpolation=cv2.INTER_NEAREST,
    )
    painted, drawn = output.paint > 0, np.zeros((SMALL, SMALL), np.uint8)
    enclosed = {DIAMOND: 0.0, **dict.fromkeys(OUTLINED_TOGETHER, _APART)}
    of_its_own = painted.copy()
    for name, gap_in_sizes in enclosed.items():
        if name not in output.classes:
            continue
        of_class = painted & (kinds == output.classes.index(name))
        of_its_own &= ~of_class
        for ring in small_outlines(of_class, scale, output.top, gap_in_sizes):
            cv2.fillPoly(drawn, [ring], 1)
    cv2.fillPoly(drawn, small_outlines(of_its_own, scale, output.top, None), 1)
    return drawn > 0


def as_it_is(output: NetworkOutput) -> np.ndarray:
    """The network's paint (256, 256) bool, pixel by pixel."""
    height = round(len(output.paint) * output.stride * SMALL / HEIGHT)
    paint = cv2.resize(output.paint, (SMALL, height), interpolation=cv2.INTER_AREA) > 0
    return np.vstack([np.zeros((SMALL, SMALL), np.bool_), paint])[-SMALL:]


class Listening(Detector):
    """A detector that keeps the network's output on the image that it searched last."""

    output: NetworkOutput

    def steps_in(
        self, output: NetworkOutput, image_bgr: np.ndarray, camera: Camera, has_boundaries: bool = True
    ) -> Steps[Looked]:
        """Search one image."""
        self.output = output
        return (yield from super().steps_in(output, image_bgr, camera, has_boundaries))


def read(labels: Path, roles: tuple[str, ...], stop_lines: Collection[int] = ()) -> dict[str, Labels]:
    """The labels of the images of some roles, by file name; ``stop_lines`` are ids of annotations."""
    content = json.loads(labels.read_text())
    names = {category["id"]: category["name"] for category in content["categories"]}
    files = {image["id"]: image["file_name"] for image in content["images"]}
    its = dict(zip(files, held_out([Path(name).stem for name in files.values()]), strict=True))
    out = {files[key]: Labels() for key, role in its.items() if role in roles}
    for annotation in content["annotations"]:
        if its[annotation["image_id"]] in roles:
            labels_of_file = out[files[annotation["image_id"]]]
            for ring in annotation["segmentation"]:
                is_stop_line = annotation["id"] in stop_lines
                labels_of_file.names.append(STOP_LINE if is_stop_line else names[annotation["category_id"]])
                labels_of_file.polygons.append(np.reshape(ring, (-1, 2)) * (WIDTH / 640, HEIGHT / 640) - 0.5)
    return out


def joined(pieces: Sequence[FloatArray], gap_in_sizes: float) -> list[FloatArray]:
    """Convex hulls (N, 2) of neighbouring pieces (N, 2), px, ``apart`` as of :data:`_APART`."""
    if not pieces:
        return []
    low, high = (np.array([end(piece, axis=0) for piece in pieces]) for end in (np.min, np.max))
    size = high - low + 1
    gap = np.maximum(low[:, None] - high, low - high[:, None])
    is_near = (gap <= gap_in_sizes * np.maximum(size[:, None], size)).all(axis=2)
    count, group = connected_components(is_near)
    together = (np.vstack([pieces[k] for k in np.flatnonzero(group == number)]) for number in range(count))
    return [
        np.asarray(cv2.convexHull(points.astype(np.float32))[:, 0], dtype=np.float64) for points in together
    ]


def covered(polygon: FloatArray, pieces: Sequence[FloatArray]) -> float:
    """Share of the columns of an outline in which pieces lie inside."""
    inside, painted = np.zeros((2, HEIGHT, WIDTH), np.uint8)
    cv2.fillPoly(inside, [np.round(polygon).astype(np.int32)], 1)
    cv2.fillPoly(painted, [np.round(piece).astype(np.int32) for piece in pieces], 1)
    return float((inside & painted).any(axis=0).sum() / max(inside.any(axis=0).sum(), 1))


class Tally:
    """Counts over images, added up one by one."""

    def __init__(self) -> None:
        self.areas: Counter[str] = Counter()
        self.areas_found: Counter[str] = Counter()
        self.areas_outlined: Counter[str] = Counter()
        self.count: Counter[tuple[str, int]] = Counter()
        self.found: Counter[tuple[str, int]] = Counter()
        self.named: Counter[tuple[str, int]] = Counter()
        self.taken_for: dict[str, Counter[str]] = defaultdict(Counter)
        self.given: Counter[str] = Counter()
        self.false: Counter[str] = Counter()
        self.false_areas: Counter[str] = Counter()
        self.images = 0

    def add(self, labels: Labels, detections: tuple[MarkingDetection, ...]) -> None:
        """Count one image."""
        self.images += 1
        outlines = [d.outline_px if len(d.outline_px) else d.corners_px for d in detections]
        near_mask = labels.near()
        for detection, outline in zip(detections, outlines, strict=True):
            self.given[detection.kind] += 1
            mask = np.zeros((HEIGHT, WIDTH), np.uint8)
            cv2.fillPoly(mask, [np.round(outline).astype(np.int32)], 1)
            alone = not (mask & near_mask).any()
            self.false[detection.kind] += alone and detection.kind in _SYMBOLS
            self.false_areas[detection.kind] += alone and detection.kind in WHOLE_OF.values()
        for name, polygon in zip(labels.names, labels.polygons, strict=True):
            kind = "diamond" if name == "diamond_outline" else name.split("_")[0]
            if kind not in ("diamond", "arrow"):
                continue
            tall = float(np.ptp(polygon[:, 1]))
            size = next((k for k, (low, high) in enumerate(TALL_PX) if low <= tall < high), None)
            if size is None:
                continue
            self.count[kind, size] += 1
            overlap = [polygon_overlap(outline, polygon) for outline in outlines]
            over = [k for k, share in enumerate(overlap) if share > FOUND_IOU]
            self.found[kind, size] += bool(over)
            self.named[kind, size] += any(detections[k].kind == kind for k in over)
            if over and not any(detections[k].kind == kind for k in over):
                self.taken_for[kind][detections[max(over, key=overlap.__getitem__)].kind] += 1

    def add_areas(self, labels: Labels, detections: tuple[MarkingDetection, ...]) -> None:
        """Count the stop lines, crosswalks, words and boxes of one image."""
        outlines = [(d.kind, d.outline_px if len(d.outline_px) else d.corners_px) for d in detections]
        stop_lines = [outline for kind, outline in outlines if kind == STOP_LINE]
        for name, polygon in zip(labels.names, labels.polygons, strict=True):
            if name == STOP_LINE:
                size = f"{name} of {STOP_LINE_PX:g} px or more"
                if np.ptp(polygon[:, 1]) < STOP_LINE_PX:
                    size = f"{name} of less"
                self.areas[size] += 1
                self.areas_found[size] += covered(polygon, stop_lines) >= COVERED_SHARE
            elif name in CLASS_OF:
                hulls = joined([o for kind, o in outlines if kind == CLASS_OF[name]], _APART)
                whole = [outline for kind, outline in outlines if kind == WHOLE_OF[name]]
                joined_share = max((polygon_overlap(hull, polygon) for hull in hulls), default=0.0)
                whole_share = max((polygon_overlap(outline, polygon) for outline in whole), default=0.0)
                self.areas[name] += 1
                self.areas_found[name] += joined_share > FOUND_IOU
                self.areas_outlined[name] += max(joined_share, whole_share) > FOUND_IOU

    def print(self) -> None:
        """Say it."""
        for name, count in sorted(self.areas.items()):
            outlined = f", {self.areas_outlined[name]} with single outlines" if name in WHOLE_OF else ""
            print(f"{name}: {self.areas_found[name]} of {count} found as what they are{outlined}")
        alone = {kind: self.false_areas[kind] for kind in sorted(set(WHOLE_OF.values()))}
        print(f"areas where no label is near: {alone}")
        for (kind, size), count in sorted(self.count.items()):
            low, high = TALL_PX[size]
            found_share, named = self.found[kind, size] / count, self.named[kind, size] / count
            print(f"{kind:8s} {low:g} to {high:g} px: {count:4d}, found {found_share:.2f}, named {named:.2f}")
        print(f"taken for: { {kind: dict(other) for kind, other in self.taken_for.items()} }")
        print(
            f"symbols where no label is near, an image: {self.false.total() / self.images:.3f} "
            f"{dict(self.false)}; given in all: {dict(self.given)}"
        )


def _ordered(names: Iterable[str], seed: int | None) -> list[str]:
    """Names as they are, or shuffled."""
    in_order = list(names)
    if seed is not None:
        random.Random(seed).shuffle(in_order)
    return in_order


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("labels", type=Path)
    parser.add_argument("images", type=Path)
    parser.add_argument("--mounting", type=float, nargs=3)
    parser.add_argument("--model")
    parser.add_argument("--role", nargs="+", default=[JUDGING])
    parser.add_argument("--limit", type=int)
    parser.add_argument("--shuffled", type=int, metavar="SEED", help="one folder, its places in any order")
    parser.add_argument("--alone", action="store_true", help="image by image, not as one folder")
    parser.add_argument("--stop-lines", type=Path)
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    stop_lines = json.loads(parsed.stop_lines.read_text())["annotations"] if parsed.stop_lines else ()
    labelled = dict(list(read(parsed.labels, tuple(parsed.role), stop_lines).items())[: parsed.limit])
    options = DetectorOptions(model=parsed.model, max_range_m=ROUGH_RANGE_M)
    detector = Listening.load(options=options)
    tally, areas = Tally(), np.zeros((3, 4), dtype=np.int64)
    with tempfile.TemporaryDirectory() as folder:
        for number, name in enumerate(_ordered(labelled, parsed.shuffled)):
            image = cv2.imread(str(parsed.images / name))
            assert image is not None, name
            image = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
            path = Path(folder, f"{number:04d}_{Path(name).stem}.png")
            cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        sources = sorted(Path(folder).iterdir()) if parsed.alone else [Path(folder)]
        for in_image in (
            detected
            for source in sources
            for detected in detect_images(source, mounting=parsed.mounting, detector=detector)
        ):
            labels = labelled[Path(in_image.frame.name).stem[5:] + ".jpg"]
            detections = tuple(marking.image for marking in in_image.road.markings)
            tally.add(labels, detections)
            tally.add_areas(labels, detections)
            truth, of_pieces = labels.small()
            paint, drawn = as_it_is(detector.output), regions(detector.output)
            for row, (said, is_labelled) in enumerate(((paint, True), (paint, ~of_pieces), (drawn, True))):
                true, said = truth & is_labelled, said & is_labelled
                areas[row] += [pixels.sum() for pixels in (true & said, true | said, true, said)]
    print(f"{tally.images} images, mounting {parsed.mounting or 'not stated'}")
    tally.print()
    hows = "paint as it is", "paint outside of outlines of pieces", "paint drawn as the labels are"
    for (overlap, either, true, said), how in zip(areas, hows, strict=True):
        print(f"{how}: IoU / F1 {overlap / either:.3f} / {2 * overlap / (true + said):.3f}")
    print(f"published, all pixels of other images of the set: {PUBLISHED}")


if __name__ == "__main__":
    main()
