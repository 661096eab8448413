"""Whether a guess of the camera's mounting decides what the detector finds.

    python -m tests.benchmarks.detector_mounting --images 100

Rendered images of ports and streets are looked at with the camera's true mounting and with guesses of it that
are 2 degrees of pitch or 20 % of height off. Printed for each guess: the recall and the false markings as
``detector_quality`` counts them, and of the true markings within 15 m found with the true mounting, symbols
among them, the share that is found again as the same class.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from tests.benchmarks.detector_quality import Tally
from train.examples import Example, example, polygon_overlap
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.geometry.ipm import extrinsic_from_ipm, ipm_from_extrinsic
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import Camera, FloatArray, MarkingDetection

RANGE_M = 15.0
GUESSES = {
    "as it is": (0.0, 1.0),
    "pitch +2 deg": (2.0, 1.0),
    "pitch -2 deg": (-2.0, 1.0),
    "height +20 %": (0.0, 1.2),
    "height -20 %": (0.0, 0.8),
}
"""Error of the pitch, deg, and of the height, as a factor."""

_SAME_OVERLAP = 0.5
"""Two outlines of one marking share this much of their union."""


@dataclass
class Guess:
    """What is counted of one guess: quality, and of ``base`` markings how many were found ``again``."""

    quality: Tally = field(default_factory=Tally)
    base: int = 0
    again: int = 0


def guessed(camera: Camera, pitch_deg: float, height_factor: float) -> Camera:
    """A camera whose initial IPM is that of a wrong mounting."""
    cam_from_vehicle = extrinsic_from_ipm(camera.info, camera.ipm[camera.initial_ipm])
    c, s = np.cos(np.deg2rad(pitch_deg)), np.sin(np.deg2rad(pitch_deg))
    wrong = np.eye(4)
    wrong[:3, :3] = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ cam_from_vehicle[:3, :3]
    wrong[:3, 3] = -wrong[:3, :3] @ (camera_centre(cam_from_vehicle) * [1.0, 1.0, height_factor])
    return replace(camera, ipm={"guess": ipm_from_extrinsic(camera.info, wrong)}, initial_ipm="guess")


def count(one: Example, detector: Detector, guesses: dict[str, Guess]) -> None:
    """Look at one image with every guess; the first is the true mounting."""
    found = {
        name: detector.detect(one.image, guessed(one.camera, *error))[0] for name, error in GUESSES.items()
    }
    base = [
        marking
        for marking in found[next(iter(GUESSES))]
        if any(t.range_m <= RANGE_M and _same(marking, t.kind, t.polygon_px) for t in one.markings)
    ]
    for name, guess in guesses.items():
        guess.quality.add_markings(one.markings, found[name])
        guess.base += len(base)
        guess.again += sum(any(_same(m, b.kind, _shape_px(b)) for m in found[name]) for b in base)


def summary(guesses: dict[str, Guess]) -> str:
    """The table that is printed."""
    rows = [f"{'guess':14s} {'recall':>7s} {'false':>6s} {'again':>6s}"]
    for name, guess in guesses.items():
        recall = guess.quality.found.total() / max(guess.quality.fair.total(), 1)
        again = guess.again / max(guess.base, 1)
        rows.append(f"{name:14s} {recall:7.3f} {guess.quality.false:6d} {again:6.3f}")
    return "\n".join(rows)


def _shape_px(marking: MarkingDetection) -> FloatArray:
    return marking.outline_px if len(marking.outline_px) else marking.corners_px


def _same(marking: MarkingDetection, kind: str, polygon_px: FloatArray) -> bool:
    return marking.kind == kind and polygon_overlap(_shape_px(marking), polygon_px) >= _SAME_OVERLAP


def main() -> None:
    """Run the benchmark and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--images", type=int, default=100)
    images: Sequence[int] = range(parser.parse_args().images)
    cv2.setNumThreads(1)
    detector = Detector.load(options=DetectorOptions())
    guesses = {name: Guess() for name in GUESSES}
    for index in images:
        count(example(index), detector, guesses)
    print(summary(guesses))


if __name__ == "__main__":
    main()
