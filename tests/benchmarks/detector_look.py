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
from v2hdm.detection.road import _COLOUR_BGR, _OTHER_BGR
from v2hdm.records import Camera

_TILE = (426, 240)  # width and height of a picture, px
_ACROSS = 3  # pictures in a row
_RENDERS = 9
_THICK_PX = 2  # width of outlines and lane lines
_LEGEND_PX = 34  # height of the line that names the colours
_BETWEEN_PX = 26  # room between the names


def _colour(kind: str) -> tuple[int, int, int]:
    return _COLOUR_BGR.get(kind, _OTHER_BGR)


def _pixels(points_px: np.ndarray, scale: np.ndarray) -> np.ndarray:
    return np.round((points_px + 0.5) * scale - 0.5).astype(np.int32)


def _drawn(detector: Detector, image: np.ndarray, camera: Camera, kinds: set[str]) -> np.ndarray:
    """A small picture with its detections, whose ``kinds`` are added."""
    markings, lanes = detector.detect(image, camera)
    canvas = np.asarray(cv2.resize(image, _TILE, interpolation=cv2.INTER_AREA))
    scale = np.array(_TILE) / image.shape[1::-1]
    for lane in lanes:
        cv2.polylines(
            canvas, [_pixels(lane.points_px, scale)], False, _colour(lane.kind), _THICK_PX, cv2.LINE_AA
        )
    for marking in markings:
        shape_px = marking.outline_px if len(marking.outline_px) else marking.corners_px
        cv2.polylines(canvas, [_pixels(shape_px, scale)], True, _colour(marking.kind), _THICK_PX, cv2.LINE_AA)
    kinds |= {detection.kind for detection in (*markings, *lanes)}
    return canvas


def _legend(kinds: set[str], width: int) -> np.ndarray:
    """A line with the name of each class beside its colour."""
    canvas = np.full((_LEGEND_PX, width, 3), 255, np.uint8)
    middle = _LEGEND_PX // 2
    u = 10
    for kind in sorted(kinds):
        cv2.line(canvas, (u, middle), (u + 24, middle), _colour(kind), 3)
        text = kind.replace("_", " ")
        cv2.putText(
            canvas, text, (u + 30, middle + 5), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (30, 30, 30), 1, cv2.LINE_AA
        )
        u += 30 + cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0] + _BETWEEN_PX
    return canvas


def main() -> None:
    """Draw it."""
    detector = Detector.load()
    shown = [example(index) for index in range(_RENDERS)]
    kinds: set[str] = set()
    tiles = [_drawn(detector, render.image, render.camera, kinds) for render in shown]
    rough = camera_from_calibration(rough_calibration("ground", WIDTH, HEIGHT, 1.6, 20.0, 70.0))
    for ground in (data.gravel(), data.grass(), data.brick()):
        grey = cv2.resize(ground[: 512 * HEIGHT // WIDTH], (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
        tiles.append(_drawn(detector, cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), rough, kinds))
    rows = [np.hstack(tiles[k : k + _ACROSS]) for k in range(0, len(tiles), _ACROSS)]
    rows.append(_legend(kinds, rows[0].shape[1]))
    cv2.imwrite(str(Path(sys.argv[1])), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 82])


if __name__ == "__main__":
    main()
