"""Whether the stated uncertainty holds: the share of errors inside their 95 % regions, over whole drives.

``python -m tests.benchmarks.uncertainty [--runs port1 port2] [--seeds 11 12 13 14] [--workers 2]`` renders
ports, maps each with all cameras, and compares with the truth: corners (an ellipse each), side lengths,
distances of markings about ten metres apart, and each camera's height, roll, pitch and yaw. ``--bare`` takes
the statement of the poses' noise out of the drives, so that the defaults must hold. Detections are kept
beside the drives.
"""

from __future__ import annotations

import argparse
import pickle
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from tests.benchmarks.adjust_ports import port_config
from v2hdm.detection.batch import detect_all
from v2hdm.detection.options import DetectorOptions
from v2hdm.drive import read_drive
from v2hdm.drive.truth import read_truth
from v2hdm.mapping.methods import run_methods
from v2hdm.mapping.results import MethodResult
from v2hdm.records import Drive, FloatArray, ImageDetections, Marking, PoseNoise, Truth
from v2hdm.report.metrics import match_markings
from v2hdm.simulate import rendered_drive

NORMAL_95 = 1.96
ELLIPSE_95 = float(chi2.ppf(0.95, 2))
APART_M = 10.0

Inside = dict[str, list[bool]]


def detections_of(drive: Drive, workers: int) -> list[ImageDetections]:
    """The detections of a rendered drive, kept beside it."""
    kept = drive.root.with_suffix(".detections")
    if not kept.is_file():
        kept.write_bytes(pickle.dumps(detect_all(drive, DetectorOptions.for_mapping(), workers)))
    found: list[ImageDetections] = pickle.loads(kept.read_bytes())
    return found


def paired(markings: Sequence[Marking], truth: Truth) -> list[tuple[Marking, FloatArray]]:
    """Mapped markings, each with the true corners (4, 2) in its own order."""
    rows, columns = match_markings(markings, truth.map.markings)
    pairs = []
    for row, column in zip(rows, columns, strict=True):
        own, true = markings[row].corners_map, truth.map.markings[column].corners_map
        turns = [np.roll(true, shift, axis=0) for shift in range(4)]
        pairs.append((markings[row], min(turns, key=lambda turned: float(((turned - own) ** 2).sum()))))
    return pairs


def of_markings(pairs: Sequence[tuple[Marking, FloatArray]], inside: Inside) -> None:
    """Corners and side lengths."""
    for marking, true in pairs:
        covariance = marking.covariance_m2
        assert covariance is not None
        error = marking.corners_map - true
        for k in range(4):
            here, after = slice(2 * k, 2 * k + 2), (k + 1) % 4
            squared = error[k] @ np.linalg.solve(covariance[here, here], error[k])
            inside["corners"].append(bool(squared < ELLIPSE_95))
            along = marking.corners_map[after] - marking.corners_map[k]
            length_m = float(np.linalg.norm(along))
            gradient = np.zeros((4, 2))
            gradient[after], gradient[k] = along / length_m, -along / length_m
            sigma_m = float(np.sqrt(gradient.ravel() @ covariance @ gradient.ravel()))
            off_m = length_m - float(np.linalg.norm(true[after] - true[k]))
            inside["side lengths"].append(abs(off_m) < NORMAL_95 * sigma_m)


def of_distances(pairs: Sequence[tuple[Marking, FloatArray]], inside: Inside) -> None:
    """Distances between the centres of markings about ten metres apart."""
    centres = np.array([marking.corners_map.mean(axis=0) for marking, _ in pairs])
    errors = np.array([(marking.corners_map - true).mean(axis=0) for marking, true in pairs])
    for m, (marking, _) in enumerate(pairs):
        if marking.relative_sigma_m is None:
            continue
        distance_m = np.linalg.norm(centres - centres[m], axis=1)
        distance_m[m] = np.inf
        other = int(np.argmin(np.abs(distance_m - APART_M)))
        along = (centres[other] - centres[m]) / distance_m[other]
        off_m = float((errors[other] - errors[m]) @ along)
        inside["distances of 10 m"].append(abs(off_m) < NORMAL_95 * marking.relative_sigma_m)


def of_cameras(result: MethodResult, truth: Truth, inside: Inside) -> None:
    """Height, roll, pitch and yaw of each camera, about the vehicle's axes."""
    for name, calibration in result.calibrations.items():
        if calibration.covariance is None:
            continue
        rotation, true = calibration.cam_from_vehicle[:3, :3], truth.cam_from_vehicle[name]
        centres = [-t[:3, :3].T @ t[:3, 3] for t in (calibration.cam_from_vehicle, true)]
        turn = Rotation.from_matrix(rotation.T @ true[:3, :3]).as_rotvec()
        covariance = calibration.covariance
        turn_sigma = np.sqrt(np.diag(rotation.T @ covariance[3:, 3:] @ rotation))
        height_sigma_m = np.sqrt((rotation.T @ covariance[:3, :3] @ rotation)[2, 2])
        inside["camera height"].append(abs(centres[0][2] - centres[1][2]) < NORMAL_95 * height_sigma_m)
        for axis, label in enumerate(("camera roll", "camera pitch", "camera yaw")):
            inside[label].append(abs(turn[axis]) < NORMAL_95 * turn_sigma[axis])


def measure(folder: Path, workers: int, bare: bool) -> Inside:
    """Map one drive with all cameras; which errors are inside their regions."""
    drive = read_drive(folder)
    truth, detections = read_truth(drive), detections_of(drive, workers)
    if bare:
        drive = replace(drive, pose_noise=PoseNoise.as_far_as_stated())
    result = run_methods(drive, detections, tuple(drive.cameras))["Opt"]
    inside: Inside = defaultdict(list)
    pairs = paired(result.hd_map.markings, truth)
    of_markings(pairs, inside)
    of_distances(pairs, inside)
    of_cameras(result, truth, inside)
    return inside


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--runs", nargs="+", default=["port1", "port2"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[11, 12, 13, 14])
    parser.add_argument("--drives", nargs="+", type=Path, default=[], help="rendered drives, instead")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=Path("cache"))
    parser.add_argument("--bare", action="store_true", help="without the statement of the poses' noise")
    parsed = parser.parse_args()
    torch.set_num_threads(1)
    folders = parsed.drives or [
        rendered_drive(
            replace(port_config(run), seed=seed), parsed.cache, parsed.workers, lambda done, total: None
        )
        for run in parsed.runs
        for seed in parsed.seeds
    ]
    everything: Inside = defaultdict(list)
    for folder in folders:
        inside = measure(folder.resolve(), parsed.workers, parsed.bare)
        print(f"{folder.name}: " + ", ".join(f"{k} {np.mean(v):.3f}" for k, v in inside.items()), flush=True)
        for name, flags in inside.items():
            everything[name] += flags
    print(f"\n{len(folders)} drives, share inside the 95 % region:")
    for name, flags in everything.items():
        print(f"  {name:20} {np.mean(flags):.3f} of {len(flags)}")


if __name__ == "__main__":
    main()
