"""Maps of ground that is not level: copies of a rendered drive, mapped and judged.

``python -m tests.benchmarks.sloped_drives DRIVE [--copies FOLDER] [--only NAME ...]`` maps a rendered drive
folder as it is and in copies with the same images: its world tilted as a whole, raised, with noisy heights,
with a crown under the vehicle's side of the road, with ramps. Poses are recorded as a receiver would. Each
copy's corner RMSE is to stay within 1.2 times that of the level drive.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from v2hdm.detection.batch import detect_all
from v2hdm.detection.options import DetectorOptions
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.io.trajectory import read_tum, write_tum
from v2hdm.mapping.methods import run_methods
from v2hdm.records import Drive, FloatArray, ImageDetections, Trajectory, Truth
from v2hdm.report.metrics import driven_past, marking_metrics

Change = Callable[[FloatArray], FloatArray]
"""Recorded poses (P, 4, 4) to those of the changed world."""


def rotation_to_slope(by_x: float, by_y: float) -> FloatArray:
    """The least rotation (3, 3) that lays the plane z = 0 onto one with these slopes."""
    up = np.array([-by_x, -by_y, 1.0]) / np.sqrt(1.0 + by_x**2 + by_y**2)
    cross = np.array([[0.0, 0.0, up[0]], [0.0, 0.0, up[1]], [-up[0], -up[1], 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + up[2])


def tilted(by_x: float, by_y: float, up_m: float = 0.0, height_noise_m: float = 0.0) -> Change:
    """The world turned as a whole, raised, and heights with white noise."""

    def change(poses: FloatArray) -> FloatArray:
        turn = np.eye(4)
        turn[:3, :3], turn[2, 3] = rotation_to_slope(by_x, by_y), up_m
        turned = turn @ poses
        turned[:, 2, 3] += np.random.default_rng(1).normal(scale=height_noise_m, size=len(poses))
        return np.asarray(turned)

    return change


def crowned(cross_fall: float) -> Change:
    """The vehicle's side of a road with a crown falls to the right by this slope, wherever the road turns.

    The road's middle lies beyond what the vehicle maps; along the road heights stay the same.
    """

    def change(poses: FloatArray) -> FloatArray:
        roll = np.full(len(poses), np.arctan(cross_fall))
        zero = np.zeros(len(poses))
        changed = poses.copy()
        changed[:, :3, :3] = poses[:, :3, :3] @ rotation_from_euler(roll, zero, zero)
        changed[:, 2, 3] += 3.0 + np.random.default_rng(1).normal(scale=0.02, size=len(poses))
        return changed

    return change


def ramped(height_m: float, wave_m: float) -> Change:
    """Ramps up and down along x, a sine of this height and length, which the vehicle's attitude follows."""

    def change(poses: FloatArray) -> FloatArray:
        changed = poses.copy()
        phase = 2.0 * np.pi / wave_m * poses[:, 0, 3]
        changed[:, 2, 3] = height_m * np.sin(phase)
        slope = 2.0 * np.pi / wave_m * height_m * np.cos(phase)
        for k, by_x in enumerate(slope):
            changed[k, :3, :3] = rotation_to_slope(by_x, 0.0) @ poses[k, :3, :3]
        return changed

    return change


CHANGES: Mapping[str, Change] = {
    "level": tilted(0.0, 0.0),
    "raised by 46.2 m": tilted(0.0, 0.0, up_m=46.2),
    "tilted by .3 %": tilted(0.003, 0.0),
    "tilted by 1 %": tilted(0.01, 0.003),
    "tilted by 1 %, heights to 2 cm": tilted(0.01, 0.003, height_noise_m=0.02),
    "tilted by 3 %": tilted(0.03, -0.01),
    "crown of 2 %, heights to 2 cm": crowned(0.02),
    "ramps of .5 m, 100 m": ramped(0.5, 100.0),
}


def copy_with_poses(source: Path, target: Path, change: Change) -> Path:
    """A drive folder that shares all with ``source`` but its recorded poses."""
    target.mkdir(parents=True)
    for entry in source.iterdir():
        if entry.name != "poses.tum":
            (target / entry.name).symlink_to(entry.resolve())
    recorded = read_tum(source / "poses.tum")
    write_tum(Trajectory(recorded.stamp_s, change(recorded.map_from_vehicle)), target / "poses.tum")
    return target


def tilted_truth(truth: Truth, rotation: FloatArray) -> Truth:
    """``truth`` with its markings where the tilted ground has them, seen from above."""
    markings = tuple(replace(m, corners_map=m.corners_map @ rotation[:2, :2].T) for m in truth.map.markings)
    return replace(truth, map=replace(truth.map, markings=markings))


def judge(drive: Drive, detections: list[ImageDetections], rotation: FloatArray) -> str:
    """One line: what the map of all cameras is worth."""
    cameras = tuple(drive.cameras)
    truth = read_truth(drive)
    expected = driven_past(drive, truth, cameras)
    optimum = run_methods(drive, detections, cameras)["Opt"]
    figures = marking_metrics(optimum.hd_map, tilted_truth(truth, rotation), expected)
    tilt_deg = np.degrees(np.arccos([image.map_from_vehicle[2, 2] for image in drive.images]))
    return (
        f"{100 * figures.corner_rmse_m:6.2f} cm  {figures.markings:4d} markings, {figures.false_markings} "
        f"false, recall {figures.recall:.3f}, left of the tilt {np.sqrt(np.mean(tilt_deg**2)):.4f} deg"
    )


def main() -> None:
    """Map every copy and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("drive", type=Path)
    parser.add_argument("--copies", type=Path, help="folder for the copies (default: a temporary one)")
    parser.add_argument("--only", nargs="+", choices=CHANGES, default=list(CHANGES))
    parsed = parser.parse_args()
    detections = detect_all(read_drive(parsed.drive), DetectorOptions.for_mapping())
    with tempfile.TemporaryDirectory() as temporary:
        for name in parsed.only:
            folder = (parsed.copies or Path(temporary)) / name.replace(" ", "_").replace("%", "percent")
            drive = read_drive(copy_with_poses(parsed.drive, folder, CHANGES[name]))
            origin = CHANGES[name](np.eye(4)[None])[0] if name.startswith("tilted") else np.eye(4)
            print(f"{name:32s}{judge(drive, detections, origin[:3, :3])}", flush=True)


if __name__ == "__main__":
    main()
