"""Surveys by detections: the statistics that they are made of.

``python -m tests.benchmarks.survey --statistics DRIVE [--every 3]``: the shipped detector on a rendered port,
by distance: errors and stated sigmas of corners, the share of markings found, and of false detections. Those
of port 2 are the constants of :mod:`v2hdm.simulate.survey.sightings`.
"""

import argparse
from pathlib import Path

import numpy as np

from v2hdm.detection.batch import detect_image
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.geometry.lens import distort_points
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.records import Drive, FloatArray, MarkingDetection, Truth

_MATCH_PX = 12.0  # mean distance of known corners from a marking's, within which a detection is of it
_BORDER_PX = 4.0
_STEP_M = 2.0  # width of a class of distances
_FARTHEST_M = 26.0


def _projected(drive: Drive, truth: Truth, row: int) -> dict[int, FloatArray]:
    """Recorded px (4, 2) of the corners of the markings that an image shows, by marking."""
    image = drive.images[row]
    info = drive.cameras[image.camera].info
    cam_from_map = truth.cam_from_vehicle[image.camera] @ np.linalg.inv(truth.map_from_vehicle[row])
    shown = {}
    for j in np.flatnonzero(truth.visibility[row] > 0.05).tolist():
        corners = truth.map.markings[j].corners_map
        points = corners @ cam_from_map[:3, :2].T + cam_from_map[:3, 3]
        if points[:, 2].min() > 0.5:
            pinhole = points @ info.intrinsic.T
            shown[j] = distort_points(info, pinhole[:, :2] / pinhole[:, 2:])
    return shown


def _matched(
    detected: MarkingDetection, shown: dict[int, FloatArray], truth: Truth
) -> tuple[int, FloatArray] | None:
    """The marking that a detection is of, and the errors (4, 2) of its corners, px."""
    known = detected.corner_valid if detected.corner_valid.any() else np.ones(4, dtype=bool)
    candidates = [
        (j, detected.corners_px - np.roll(px, turn, axis=0))
        for j, px in shown.items()
        if truth.map.markings[j].kind == detected.kind
        for turn in range(4)
    ]
    if not candidates:
        return None
    best = min(candidates, key=lambda candidate: np.linalg.norm(candidate[1][known], axis=1).mean())
    return best if np.linalg.norm(best[1][known], axis=1).mean() < _MATCH_PX else None


def statistics(folder: Path, every: int) -> None:
    """Print what the detector does on a rendered drive, by distance."""
    drive = read_drive(folder)
    truth = read_truth(drive)
    detector = Detector.load(options=DetectorOptions.for_mapping())
    corners: list[tuple[float, ...]] = []  # distance, |error|, smaller and larger sigma, squared distance
    markings: list[tuple[float, bool]] = []  # distance, whether found; of those whole in the image
    detections = false = 0
    for row in range(0, len(drive.images), every):
        image = drive.images[row]
        camera_map = np.linalg.inv(
            truth.cam_from_vehicle[image.camera] @ np.linalg.inv(truth.map_from_vehicle[row])
        )[:2, 3]
        shown = _projected(drive, truth, row)
        found = set()
        for detected in detect_image(detector, drive, row).markings:
            if len(detected.outline_px):
                continue
            detections += 1
            match = _matched(detected, shown, truth)
            if match is None:
                false += 1
                continue
            j, off_px = match
            found.add(j)
            away_m = float(np.linalg.norm(truth.map.markings[j].corners_map.mean(axis=0) - camera_map))
            for k in np.flatnonzero(detected.corner_valid).tolist():
                covariance = detected.covariance_px[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]
                sigma = np.sqrt(np.linalg.eigvalsh(covariance))
                squared = float(off_px[k] @ np.linalg.solve(covariance, off_px[k]))
                corners.append((away_m, *np.abs(off_px[k]), *sigma, squared))
        size = np.array([drive.cameras[image.camera].info.width, drive.cameras[image.camera].info.height])
        for j, px in shown.items():
            inside = ((px > _BORDER_PX) & (px < size - 1 - _BORDER_PX)).all()
            if inside and truth.visibility[row, j] > 0.97:
                away_m = float(np.linalg.norm(truth.map.markings[j].corners_map.mean(axis=0) - camera_map))
                markings.append((away_m, j in found))
    _print(np.array(corners), np.array(markings, dtype=float))
    print(f"{detections} detections, {false} of no marking ({false / detections:.3f})")


def _print(corners: FloatArray, markings: FloatArray) -> None:
    print("distance  corners  |u| |v| px  stated px   spread  chi2: median/1.39  p95   p99   found")
    for low in np.arange(2.0, _FARTHEST_M, _STEP_M):
        rows = corners[(corners[:, 0] >= low) & (corners[:, 0] < low + _STEP_M)]
        shown = markings[(markings[:, 0] >= low) & (markings[:, 0] < low + _STEP_M)]
        if len(rows) < 20 or not len(shown):
            continue
        u, v, fine, coarse = np.median(rows[:, 1:5], axis=0)
        tail = np.percentile(rows[:, 5], [50, 95, 99])
        print(
            f"{low + 1:5.0f} m {len(rows):8d}   {1.48 * u:.2f} {1.48 * v:.2f}   {coarse:.3f} {fine:.3f}"
            f"  {np.log(rows[:, 4]).std():6.2f} {tail[0] / 1.386:12.2f} {tail[1]:10.1f} {tail[2]:5.1f}"
            f"   {shown[:, 1].mean():.3f}"
        )


def main() -> None:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--statistics", type=Path, metavar="DRIVE", required=True)
    parser.add_argument("--every", type=int, default=3, metavar="N", help="look at every N-th image")
    parsed = parser.parse_args()
    statistics(parsed.statistics, parsed.every)


if __name__ == "__main__":
    main()
