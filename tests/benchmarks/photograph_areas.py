"""Stop lines, crosswalks, words and boxes on labelled photographs, as far as the network sees them.

    python -m tests.benchmarks.photograph_areas LABELS.json IMAGES --stop-lines LIST.json [--model FILE]
        [--role validation]

The files are those of ROAD MARK, see ``docs/labels.md``; LIST.json names the annotations that are stop
lines. No training showed these images: those for validation chose among trainings, those for judging (the
default) did not. Of stop lines it counts those over half of whose length paint of their class is seen inside
the outline, by the outline's height in px of 1280 x 720. Crosswalks, words and boxes are found where the hull
of neighbouring pieces of their class overlaps the outline by more than .3. Printed, too: hulls where nothing
is labelled.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path

import cv2
import numpy as np

from tests.benchmarks.photographs import (
    CLASS_OF,
    FOUND_IOU,
    HEIGHT,
    STOP_LINE_PX,
    WIDTH,
    Labels,
    joined,
    read,
)
from train.examples import polygon_overlap
from train.labels import JUDGING
from v2hdm.detection.network import Network, RawOutput
from v2hdm.records import BOX, CROSSWALK_BAR, STOP_LINE, TEXT, FloatArray

SEEN_SHARE = 0.5
APART = {CROSSWALK_BAR: 1.5, TEXT: 1.5, BOX: 1.0}
"""Neighbouring pieces of one marking are at most so far apart, in sizes of the larger one along each side."""

GROUND_PX = 260  # first row of 720 that shows ground: the camera stamps the time in the sky
CELL_PX = 2.0
LEAST_CELLS = 6  # cells that a marking has at least, its width and height added up


def kinds_of(output: RawOutput) -> np.ndarray:
    """1 + class of each cell of 2 px that shows paint, 0 elsewhere."""
    kinds = (output.kinds.argmax(axis=0) + 1).astype(np.uint8)
    kinds = cv2.resize(kinds, output.paint.shape[::-1], interpolation=cv2.INTER_NEAREST)
    kinds[: int(GROUND_PX / CELL_PX)] = 0
    return np.where(output.paint > 0, kinds, 0).astype(np.uint8)


def hulls_of(mask: np.ndarray, gap_in_sizes: float) -> list[FloatArray]:
    """Convex hulls (N, 2), px, of neighbouring pieces of a mask of cells of 2 px."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    pieces = [piece for piece in contours if len(piece) >= 3]
    if not pieces:
        return []
    long_enough = (hull for hull in joined([piece[:, 0] for piece in pieces], gap_in_sizes) if len(hull) > 2)
    return [hull * CELL_PX + 0.5 for hull in long_enough if np.ptp(hull, axis=0).sum() >= LEAST_CELLS]


def seen_along(mask: np.ndarray, polygon: FloatArray) -> float:
    """Share of the columns of an outline in which cells of a mask lie inside."""
    inside = np.zeros(mask.shape, np.uint8)
    cv2.fillPoly(inside, [np.round((polygon - 0.5) / CELL_PX).astype(np.int32)], 1)
    inside = cv2.dilate(inside, np.ones((3, 1), np.uint8))
    columns = inside.any(axis=0)
    return float((inside & mask).any(axis=0).sum() / max(columns.sum(), 1))


class Counts:
    """Counts over images."""

    def __init__(self) -> None:
        self.all: Counter[str] = Counter()
        self.seen: Counter[str] = Counter()
        self.alone: Counter[str] = Counter()
        self.taken_for: Counter[tuple[str, str]] = Counter()
        self.images = 0

    def add(self, labels: Labels, output: RawOutput, classes: tuple[str, ...]) -> None:
        """Count one image."""
        self.images += 1
        kinds = kinds_of(output)
        near_mask = labels.near()
        masks = {name: (kinds == 1 + k).astype(np.uint8) for k, name in enumerate(classes)}
        hulls = {name: hulls_of(masks[name], APART[name]) for name in APART if name in masks}
        for name, of_class in hulls.items():
            for hull in of_class:
                mask = np.zeros((HEIGHT, WIDTH), np.uint8)
                cv2.fillPoly(mask, [np.round(hull).astype(np.int32)], 1)
                self.alone[name] += not (mask & near_mask).any()
        for label, polygon in zip(labels.names, labels.polygons, strict=True):
            if label == STOP_LINE:
                size = "stop_line >= 11 px" if np.ptp(polygon[:, 1]) >= STOP_LINE_PX else "stop_line < 11 px"
                self.all[size] += 1
                share = {name: seen_along(mask, polygon) for name, mask in masks.items()}
                self.seen[size] += share[STOP_LINE] >= SEEN_SHARE
                self.taken_for[
                    size, max(share, key=share.__getitem__) if max(share.values()) else "none"
                ] += 1
            elif label in CLASS_OF:
                name = CLASS_OF[label]
                overlap = [polygon_overlap(hull, polygon) for hull in hulls.get(name, ())]
                self.all[label] += 1
                self.seen[label] += max(overlap, default=0.0) > FOUND_IOU

    def print(self) -> None:
        """Say it."""
        for name, count in sorted(self.all.items()):
            print(f"{name:20s} {self.seen[name]:3d} of {count:3d} {self.seen[name] / count:.2f}")
        print(f"hulls where nothing is labelled, in {self.images} images: {dict(self.alone)}")
        print(f"stop lines by the class seen most: {dict(self.taken_for)}")


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("labels", type=Path)
    parser.add_argument("images", type=Path)
    parser.add_argument("--stop-lines", type=Path)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--role", nargs="+", default=[JUDGING])
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    stop_lines = json.loads(parsed.stop_lines.read_text())["annotations"] if parsed.stop_lines else ()
    network = Network(parsed.model)
    counts = Counts()
    for name, labels in read(parsed.labels, tuple(parsed.role), stop_lines).items():
        image = cv2.imread(str(parsed.images / name))
        assert image is not None, name
        image = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        counts.add(labels, network.run(image), network.info.classes)
    counts.print()


if __name__ == "__main__":
    main()
