"""Ends of dashes that are visible and called hidden, and ends that boxes hide and that pass as true.

    python -m tests.benchmarks.hidden_ends [--seeds 0 8] [--known 0.0]
                                           [--drive DRIVE --reference FILE [--camera NAME]]

Two errors, of which less of one is more of the other.

*Boxes* (``--seeds``): made drives past boxes, each of which hides the far end of a dash
(:mod:`tests.benchmarks.made.boxes`). The detector finds what is left in view, and knows in a share
``--known`` of the images that more is hidden; images are rendered where the mapping looks at what stands
beyond an end. A dash counts if the map holds it and a box hides more than 0.25 m of it. Its end passes as
true if a corner of it is more than 8 cm and more than 4 stated sigmas from where it is painted.

*A real drive* (``--drive``): the dashes of a reference (:mod:`tests.benchmarks.real_reference`) are placed in
every image as :mod:`tests.benchmarks.real_drive` does. An end counts if its dash lies wholly inside the
image, within 20 m and not behind what the reference says to hide it, and was found. It is called hidden if
the detection leaves it open along the dash by more than half of what an open end has.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from tests.benchmarks.ablation import WRONG_M, WRONG_SIGMAS, rendered_once
from tests.benchmarks.made.boxes import detect_pieces, make_boxes
from tests.benchmarks.made.draw import draw
from tests.benchmarks.made.world import drive_of, truth_of
from tests.benchmarks.real_drive import MAX_RANGE_M, _overlap, _touches_box, views_of_images
from tests.benchmarks.real_reference import Painted, Reference, centre_of_area, read_reference
from tests.benchmarks.real_view import View
from tests.benchmarks.standing_ends import LEAST_HIDDEN_M, shown_outlines
from tests.benchmarks.uncertainty import corner_errors, in_order_of
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.quads.fit import OPEN_SIGMA
from v2hdm.io.drive import ReadOptions
from v2hdm.mapping.methods import run_methods
from v2hdm.pipeline.map_drive import map_drive
from v2hdm.pipeline.result import Result
from v2hdm.records import BEST, LANE_DASH, FloatArray, MarkingDetection
from v2hdm.report.metrics import match_markings

_CAMERA = "front"
_OPEN_SHARE = 0.5  # of the sigma of an open end, from which an end is called hidden


class BoxEnds(NamedTuple):
    """The dashes of one drive of which a box hides an end."""

    hidden: int  # dashes with such an end
    mapped: int  # of these, in the map
    passing: int  # of these, with an end that passes as true


def ends_behind_boxes(seed: int, share_known: float) -> BoxEnds:
    """Map a made drive past boxes, and judge the ends that these hide."""
    world = make_boxes(draw(seed, "straight"))
    drive = drive_of(world)
    detections, visibility = detect_pieces(world, drive, share_known)
    truth = truth_of(world, drive, visibility)
    mapped = run_methods(drive, detections, (_CAMERA,), grey=rendered_once(world), naive=False)[BEST]
    dashes = [number for number, marking in enumerate(truth.map.markings) if marking.kind == LANE_DASH]
    hidden_m = dict(zip(dashes, (lengths_m for _, lengths_m in shown_outlines(world)), strict=True))
    hidden = {number for number, lengths_m in hidden_m.items() if lengths_m.max() > LEAST_HIDDEN_M}
    rows, columns = match_markings(mapped.hd_map.markings, truth.map.markings)
    pairs = [(row, column) for row, column in zip(rows, columns, strict=True) if column in hidden]
    passing = 0
    for row, column in pairs:
        marking = mapped.hd_map.markings[row]
        true = in_order_of(marking.corners_map, truth.map.markings[column].corners_map)
        off_m = np.linalg.norm(marking.corners_map - true, axis=1)
        sigmas2 = corner_errors([marking], true[None])
        passing += bool(((off_m > WRONG_M) & (sigmas2 > WRONG_SIGMAS**2)).any())
    return BoxEnds(len(hidden), len(pairs), passing)


def called_hidden(detection: MarkingDetection) -> tuple[bool, bool]:
    """Whether each of the two ends of a dash's detection is left open along the dash."""
    corners = detection.corners_px
    sides = np.roll(corners, -1, axis=0) - corners
    lengths_px = np.linalg.norm(sides, axis=1)
    first = int((lengths_px + np.roll(lengths_px, -2))[:2].argmin())  # the end from corner ``first`` on
    along = sides[first + 1] / lengths_px[first + 1]
    variance = np.array(
        [along @ detection.covariance_px[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] @ along for k in range(4)]
    )
    is_open = np.sqrt(variance) > _OPEN_SHARE * OPEN_SIGMA * lengths_px.max()
    ends = [(first, first + 1), (first + 2, (first + 3) % 4)]
    return bool(is_open[list(ends[0])].any()), bool(is_open[list(ends[1])].any())


def found_on(
    view: View, painted: Painted, hidden: Sequence[FloatArray], dashes: Sequence[MarkingDetection]
) -> MarkingDetection | None:
    """The detection of a dash that an image shows whole; None if it does not, or the dash was missed."""
    polygon_px = view.project(painted.polygon_map)
    if not view.holds(polygon_px) or any(_touches_box(polygon_px, box) for box in hidden):
        return None
    hit = None
    largest = 0.0
    for detection in dashes:
        centre_map = centre_of_area(view.ground(detection.corners_px))
        overlap = _overlap(detection.corners_px, polygon_px)
        if overlap > largest and np.linalg.norm(centre_map - painted.centre_map) <= painted.tolerance_m:
            hit = detection
            largest = overlap
    return hit


def visible_ends(
    view: View, reference: Reference, hidden: Sequence[FloatArray], detections: Sequence[MarkingDetection]
) -> Iterator[bool]:
    """Whether the ends of mapped dashes that an image shows are called hidden, end by end."""
    dashes = [detection for detection in detections if detection.kind == LANE_DASH]
    for painted in reference.markings:
        if painted.kind != LANE_DASH or view.range_m(painted.centre_map) > MAX_RANGE_M:
            continue
        detection = found_on(view, painted, hidden, dashes)
        if detection is not None:
            yield from called_hidden(detection)


def ends_of_drive(result: Result, reference: Reference) -> list[bool]:
    """Whether the visible ends of a drive's mapped dashes are called hidden, end by end."""
    ends: list[bool] = []
    for index, view in enumerate(views_of_images(result)):
        placed = replace(view, cam_from_map=reference.cam_from_map.get(index, view.cam_from_map))
        hidden = reference.hidden.get(index, [])
        ends += visible_ends(placed, reference, hidden, result.detections[index].markings)
    return ends


def main() -> None:
    """Print both shares."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", nargs=2, type=int, default=(0, 8), metavar=("FIRST", "LAST"))
    parser.add_argument("--known", type=float, default=0.0, help="share of images that know of a hidden end")
    parser.add_argument("--drive", type=Path, help="a real drive")
    parser.add_argument("--camera", help="the camera to look through, if the drive has several")
    parser.add_argument("--reference", type=Path, help="file of what is painted there")
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    total = np.zeros(3, dtype=int)
    for seed in range(*parsed.seeds):
        counts = ends_behind_boxes(seed, parsed.known)
        total += counts
        print(
            f"boxes {seed}: {counts.hidden} hidden, {counts.mapped} mapped, {counts.passing} pass", flush=True
        )
    if total[1]:
        share = 100 * total[2] / total[1]
        print(f"boxes: {total[2]} of {total[1]} mapped ends behind boxes pass as true ({share:.0f} %)")
    if parsed.drive:
        reading = ReadOptions(cameras=[parsed.camera] if parsed.camera else [])
        result = map_drive(parsed.drive, detector=DetectorOptions.for_mapping(), reading=reading)
        ends = ends_of_drive(result, read_reference(parsed.reference, result.drive.route_map))
        share = 100 * sum(ends) / max(len(ends), 1)
        print(f"real drive: {sum(ends)} of {len(ends)} visible ends are called hidden ({share:.1f} %)")


if __name__ == "__main__":
    main()
