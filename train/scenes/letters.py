"""Letters and figures as strokes, for words and numbers painted on the way."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from v2hdm.records import FloatArray

WORDS = (
    "STOP", "SLOW", "BUS", "LANE BUS", "TAXI", "SCHOOL", "CLEAR KEEP", "EXIT", "ENTRY NO", "LKW", "HALT",
    "30", "40", "50", "60", "70", "80", "100", "P", "R2", "A14", "B3",
)  # fmt: skip
"""Words one behind the other are read from near to far."""

_STROKES = {
    "A": "00 03 14 23 20,02 22", "B": "00 04 14 23 12 21 10 00,02 12", "C": "23 14 03 01 10 21",
    "D": "00 04 14 23 21 10 00", "E": "24 04 00 20,02 12", "H": "00 04,20 24,02 22", "I": "10 14",
    "K": "00 04,24 02 20", "L": "04 00 20", "N": "00 04 20 24", "O": "10 01 03 14 23 21 10",
    "P": "00 04 14 23 12 02", "R": "00 04 14 23 12 02,12 20", "S": "24 04 02 22 20 00", "T": "04 24,14 10",
    "U": "04 01 10 21 24", "W": "04 00 12 20 24", "X": "00 24,04 20", "Y": "04 12 24,12 10",
    "0": "10 01 03 14 23 21 10", "1": "03 14 10", "2": "04 24 22 02 00 20", "3": "04 24 20 00,02 22",
    "4": "04 02 22,24 20", "5": "24 04 02 22 20 00", "6": "24 04 00 20 22 02", "7": "04 24 10",
    "8": "00 04 24 20 00,02 22", "9": "00 20 24 04 02 22",
}  # fmt: skip
"""Corners of strokes as column (0 to 2) and row (0 to 4) from the lower left; commas part the strokes."""


def word(text: str, tall_m: float, wide_m: float, stroke_m: float) -> Iterator[FloatArray]:
    """The strokes (4, 2) of words one behind the other: along the way and left of their middle.

    Letters are ``tall_m`` x ``wide_m``, strokes ``stroke_m`` thick, convex and counter-clockwise.
    """
    for line, letters in enumerate(text.split()):
        for place, letter in enumerate(letters):
            left_m = ((len(letters) - 1) / 2 - place) * 1.35 * wide_m
            for stroke in _STROKES[letter].split(","):
                grid = np.array([[int(at[1]), int(at[0])] for at in stroke.split()])
                middle = np.array([line * 1.4 * tall_m, left_m])
                points = middle + (grid - (0, 1)) * (tall_m / 4, -wide_m / 2)
                for start, end in pairwise(points):
                    yield _stroke(start, end, stroke_m)


def _stroke(start: FloatArray, end: FloatArray, thick_m: float) -> FloatArray:
    """A bar (4, 2) from point to point and half its thickness beyond both."""
    ahead = (end - start) * (thick_m / 2 / np.linalg.norm(end - start))
    left = np.array([-ahead[1], ahead[0]])
    start = start - ahead
    end = end + ahead
    return np.array([start - left, end - left, end + left, start + left])
