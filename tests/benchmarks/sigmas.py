"""Whether sigmas hold with both cameras and with each alone, on made drives whose drift is stated as it is.

``python -m tests.benchmarks.sigmas [--seeds 0 16] [--route turning] [--in-turn]`` prints a line a drive and
set of cameras, and the share of corners inside their 95 % regions over all. The corners of a drive share the
errors of its survey and its drift, so that often all of them or none lie inside: only many drives together
mean much. ``left`` is what remains of the error after the best common shift, stretch and turn. ``--in-turn``:
cameras fire 37 ms after each other, under poses at 20 Hz.
"""

from __future__ import annotations

import argparse

import numpy as np

from tests.benchmarks.made.detect import detect
from tests.benchmarks.made.draw import ROUTES, draw
from tests.benchmarks.made.faults import RELIEFS
from tests.benchmarks.made.world import drive_of, make, truth_of
from tests.benchmarks.uncertainty import INSIDE, in_order_of, squared_errors
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.options import MappingOptions
from v2hdm.mapping.results import MethodResult
from v2hdm.records import FloatArray, Truth
from v2hdm.report.metrics import match_markings


def corner_pairs(result: MethodResult, truth: Truth) -> tuple[FloatArray, FloatArray]:
    """Mapped and true corners (N, 2), m, of the markings that are found."""
    rows, columns = match_markings(result.hd_map.markings, truth.map.markings)
    mapped = [result.hd_map.markings[row].corners_map for row in rows]
    true = [
        in_order_of(corners, truth.map.markings[column].corners_map)
        for corners, column in zip(mapped, columns, strict=True)
    ]
    return np.reshape(mapped, (-1, 2)), np.reshape(true, (-1, 2))


def left_m(mapped: FloatArray, true: FloatArray) -> float:
    """RMS error, m, of corners (N, 2) after the best common affine motion."""
    basis = np.column_stack([true - true.mean(axis=0), np.ones(len(true))])
    off = mapped - true
    common = basis @ np.linalg.lstsq(basis, off, rcond=None)[0]
    return float(np.sqrt(np.mean(np.sum((off - common) ** 2, axis=1))))


def main() -> None:
    """Print the lines and the shares."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 16])
    parser.add_argument("--route", choices=ROUTES)
    parser.add_argument("--in-turn", action="store_true")
    arguments = parser.parse_args()
    squared: dict[str, list[FloatArray]] = {}
    for seed in range(*arguments.seeds):
        world = make(draw(seed, arguments.route).as_modelled())
        if arguments.in_turn:
            world = RELIEFS["cameras in turn"].change(world)
        drive = drive_of(world)
        detections, visibility = detect(world, drive)
        truth = truth_of(world, drive, visibility)
        for name, cameras in {
            "both": list(drive.cameras),
            **{camera: [camera] for camera in drive.cameras},
        }.items():
            result = run_methods(drive, detections, cameras, MappingOptions())["Opt"]
            errors = squared_errors(result, truth)["corners"]
            squared.setdefault(name, []).append(errors)
            mapped, true = corner_pairs(result, truth)
            rmse_m = float(np.sqrt(np.mean(np.sum((mapped - true) ** 2, axis=1))))
            print(
                f"{world.recipe.name:24s} {name:6s} {100 * rmse_m:5.2f} cm, "
                f"left {100 * left_m(mapped, true):.2f}, inside {np.mean(errors <= INSIDE):.2f}",
                flush=True,
            )
    for name, of_drives in squared.items():
        print(f"{name:6s} inside {np.mean(np.concatenate(of_drives) <= INSIDE):.3f}")


if __name__ == "__main__":
    main()
