"""Draws what the shipped detector sees: ``docs/detector_look.jpg`` of the detector's page.

    python -m tests.benchmarks.detector_look OUT.jpg

Nine renders of full difficulty that training never shows, in order of their numbers, none left out, and three
photographs of bare ground (scikit-image's gravel, grass and brick, CC0) on which nothing is to be found.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from skimage import data

from train.examples import HEIGHT, WIDTH, example
from v2hdm.detection.camera import camera_from_calibration, rough_calibration
from v2hdm.detection.detector import Detector
from v2hdm.detection.road import draw_detections
from v2hdm.records import Camera

_TILE = (426, 240)
_ACROSS = 3
_RENDERS = 9


def _drawn(detector: Detector, image: np.ndarray, camera: Camera) -> np.ndarray:
    markings, lanes = detector.detect(image, camera)
    return np.asarray(
        cv2.resize(draw_detections(image, markings, lanes), _TILE, interpolation=cv2.INTER_AREA)
    )


def main() -> None:
    """Draw it."""
    detector = Detector.load()
    shown = [example(index) for index in range(_RENDERS)]
    tiles = [_drawn(detector, one.image, one.camera) for one in shown]
    rough = camera_from_calibration(rough_calibration("ground", WIDTH, HEIGHT, 1.6, 20.0, 70.0))
    for ground in (data.gravel(), data.grass(), data.brick()):
        grey = cv2.resize(ground[: 512 * HEIGHT // WIDTH], (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        tiles.append(_drawn(detector, cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), rough))
    rows = [np.hstack(tiles[k : k + _ACROSS]) for k in range(0, len(tiles), _ACROSS)]
    cv2.imwrite(str(Path(sys.argv[1])), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 82])


if __name__ == "__main__":
    main()
