"""Drives that end in a queue behind a lorry: is anything on its rear mapped, and is paint kept?

``python -m tests.benchmarks.queues [--seeds 0 10]`` draws drives without pictures
(:mod:`tests.benchmarks.made.queue`): a port's paint, and in every image of the lorry its stripes, bumper,
window and wheels, taken for markings. It prints a line a drive: markings of the map that no paint explains,
recall, and why the candidates that were left out were.
"""

from __future__ import annotations

import argparse
from collections import Counter

import cv2
import torch

from tests.benchmarks.made.draw import draw
from tests.benchmarks.made.queue import detect_queue, make_queue
from tests.benchmarks.made.world import drive_of, truth_of
from v2hdm.errors import V2hdmError
from v2hdm.mapping.methods import run_methods
from v2hdm.records import BEST
from v2hdm.report.metrics import driven_past, marking_metrics

_CAMERA = "front"


def map_one(seed: int) -> tuple[int, str]:
    """How many markings a drive's map has where there is no paint, and its line."""
    world = make_queue(draw(seed, "straight"))
    drive = drive_of(world)
    detections, visibility = detect_queue(world, drive)
    truth = truth_of(world, drive, visibility)
    try:
        best = run_methods(drive, detections, (_CAMERA,))[BEST]
    except V2hdmError as refusal:
        return 0, f"{seed:4d} refused: {refusal}"
    figures = marking_metrics(best.hd_map, truth, driven_past(drive, truth, (_CAMERA,)))
    reasons = Counter(exclusion.reason for exclusion in best.excluded)
    why = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())
    return figures.false_markings, (
        f"{seed:4d} {figures.false_markings} false of {figures.markings:3d}, recall {figures.recall:.3f}, "
        f"{100 * figures.corner_rmse_m:.1f} cm | {why}"
    )


def main() -> None:
    """Print the lines and the sum."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 10], help="the first, and after the last")
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    false = 0
    for seed in range(*parsed.seeds):
        false_of_drive, line = map_one(seed)
        false += false_of_drive
        print(line, flush=True)
    print(f"{false} markings mapped where there is no paint")


if __name__ == "__main__":
    main()
