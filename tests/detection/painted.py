"""The output of a network that knows all classes for shapes on the ground, drawn from the truth."""

import cv2
import numpy as np

from tests.detection.pictures import to_image
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.detection.network import NetworkOutput

_FINE = 4  # samples of the drawing per element of the paint, in each direction

# Bars (x0, x1, y0, y1) of letters on a pocket calculator, in heights, upright as one drives along x.
_BARS = {
    "top": (0.88, 1.0, 0.0, 0.5),
    "middle": (0.44, 0.56, 0.0, 0.5),
    "foot": (0.0, 0.12, 0.0, 0.5),
    "left": (0.0, 1.0, 0.38, 0.5),
    "right": (0.0, 1.0, 0.0, 0.12),
}
LETTERS = {
    "E": ("top", "middle", "foot", "left"),
    "B": ("top", "middle", "foot", "left", "right"),
    "H": ("middle", "left", "right"),
    "O": ("top", "foot", "left", "right"),
    "L": ("foot", "left"),
    "I": ("right",),
}


def word(text, at=(0.0, 0.0), height_m=1.2, gap=0.2, yaw_deg=0.0):
    """Quadrilaterals (N, 4, 2) of a word that begins at a place, left to right as one drives along x."""
    bars = []
    left_m = 0.0
    for letter in text:
        for name in LETTERS.get(letter, ()):
            x0, x1, y0, y1 = (value * height_m for value in _BARS[name])
            bars.append([[x0, y0 - left_m], [x1, y0 - left_m], [x1, y1 - left_m], [x0, y1 - left_m]])
        left_m += (0.5 + gap) * height_m
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    return np.array(bars) @ np.array([[c, s], [-s, c]]) + np.array(at)


def framed(at, length_m, width_m, line_m=0.12, pitch_m=0.6):
    """Quadrilaterals of a frame and of lines across it from side to side."""
    x = np.arange(pitch_m, length_m - 0.1, pitch_m)
    lines = [((0, 0), (length_m, 0)), ((0, width_m), (length_m, width_m)), ((0, 0), (0, width_m))]
    lines += [((length_m, 0), (length_m, width_m)), *(((k, 0), (k, width_m)) for k in x)]
    return bars_of(lines, line_m) + np.array(at)


def hatched(at, length_m=4.0, width_m=3.0, line_m=0.15):
    """Quadrilaterals of a frame and the bars across it."""
    x, y = at
    lines = [((0, 0), (length_m, 0)), ((0, width_m), (length_m, width_m)), ((0, 0), (0, width_m))]
    lines += [((length_m, 0), (length_m, width_m))]
    lines += [((k, 0.3), (k + 0.8, width_m - 0.3)) for k in np.arange(0.5, length_m - 1.0, 0.8)]
    return bars_of(lines, line_m) + np.array([x, y])


def bars_of(lines, line_m):
    """Quadrilaterals (N, 4, 2) along lines from point to point, so thick."""
    out = []
    for first, last in lines:
        first, last = np.array(first, float), np.array(last, float)
        ahead = (last - first) / np.linalg.norm(last - first)
        left = np.array([-ahead[1], ahead[0]]) * line_m / 2
        out.append([first - left, last - left, last + left, first + left])
    return np.array(out)


def network_output(camera, paints, stride=2, doubt=0.0, rng=None):
    """The output of images of a camera for ``paints``, pairs of a class and polygons (N, K, 2), m."""
    width, height = -(-camera.info.width // stride), -(-camera.info.height // stride)
    covered = {}
    for kind, polygons in paints:
        fine = np.zeros((height * _FINE, width * _FINE), dtype=np.uint8)
        for polygon in polygons:
            x = polygon[:, 0]
            if x.min() < 0.5:
                continue
            dense = np.concatenate(
                [np.linspace(a, b, 20) for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True)]
            )
            px = (to_image(camera, dense) + 0.5) * _FINE / stride
            cv2.fillPoly(fine, [np.round(px * 16).astype(np.int32)], 1, shift=4)
        coverage = fine.reshape(height, _FINE, width, _FINE).mean(axis=(1, 3))
        covered[kind] = np.maximum(covered.get(kind, 0.0), coverage)
    total = np.maximum.reduce(list(covered.values()))
    noise = 0.0 if rng is None else rng.normal(0.0, doubt, total.shape)
    paint = (12 * total - 6 + noise).astype(np.float32)
    rows, columns = -(-height // 2), -(-width // 2)
    kinds = np.full((len(PAINT_CLASSES), rows, columns), -4.0, dtype=np.float32)
    for kind, coverage in covered.items():
        padded = np.zeros((2 * rows, 2 * columns))
        padded[:height, :width] = coverage
        coarse = padded.reshape(rows, 2, columns, 2).max(axis=(1, 3))
        spread = cv2.dilate(coarse, np.ones((3, 3)))
        kinds[PAINT_CLASSES.index(kind)] += 8 * spread
    return NetworkOutput.of(paint, kinds, [], tuple(PAINT_CLASSES), stride, 0)
