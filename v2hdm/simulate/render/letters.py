"""Letters and figures as strokes, in many hands, as they are painted on the ground."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from v2hdm.geometry.planar import turned_left
from v2hdm.records import FloatArray

_STROKES = {
    "A": "00 03 14 23 20,02 22", "B": "00 04 14 23 12 21 10 00,02 12", "C": "23 14 03 01 10 21",
    "D": "00 04 14 23 21 10 00", "E": "24 04 00 20,02 12", "F": "24 04 00,02 12",
    "G": "23 14 03 01 10 21 22 12", "H": "00 04,20 24,02 22", "I": "10 14", "J": "24 21 10 01",
    "K": "00 04,24 02 20", "L": "04 00 20", "M": "00 04 12 24 20", "N": "00 04 20 24",
    "O": "10 01 03 14 23 21 10", "P": "00 04 14 23 12 02", "Q": "10 01 03 14 23 21 10,11 20",
    "R": "00 04 14 23 12 02,12 20", "S": "24 04 02 22 20 00", "T": "04 24,14 10", "U": "04 01 10 21 24",
    "V": "04 10 24", "W": "04 00 12 20 24", "X": "00 24,04 20", "Y": "04 12 24,12 10", "Z": "04 24 00 20",
    "0": "10 01 03 14 23 21 10", "1": "03 14 10", "2": "04 24 22 02 00 20", "3": "04 24 20 00,02 22",
    "4": "04 02 22,24 20", "5": "24 04 02 22 20 00", "6": "24 04 00 20 22 02", "7": "04 24 10",
    "8": "00 04 24 20 00,02 22", "9": "00 20 24 04 02 22", "-": "02 22",
}  # fmt: skip
"""Corners of strokes as column (0 to 2) and row (0 to 4) from the lower left; commas part the strokes."""

LETTERS = tuple(_STROKES)
"""Characters that can be written, beside spaces between words one behind the other."""

_GAP = 1.35  # distance of two letters' middles, widths of a letter
_LINE_GAP = 1.4  # distance of two lines' feet, heights of a letter
_BRIDGE = 0.12  # gap that a stencil leaves in the middle of a long stroke, of its length
_BRIDGED = 0.3  # least length of a stroke with such a gap, in a letter of unit size


@dataclass(frozen=True)
class Hand:
    """How letters are drawn.

    ``rounds`` is how often corners are cut, ``stretch`` by how much letters are drawn out along the way,
    their level strokes with them, ``slant`` how far they lean to the right a metre; a ``stencil`` leaves
    bridges.
    """

    rounds: int = 0
    stretch: float = 1.0
    slant: float = 0.0
    stencil: bool = False


PLAIN = Hand()


def word(
    text: str, tall_m: float, wide_m: float, stroke_m: float, hand: Hand = PLAIN
) -> Iterator[FloatArray]:
    """The strokes (4, 2) of words one behind the other: along the way and left of their middle.

    Letters are ``tall_m`` x ``wide_m``, strokes ``stroke_m`` thick, convex and counter-clockwise.
    """
    low_m = tall_m / hand.stretch
    drawn_out = np.array([[hand.stretch, -hand.slant * hand.stretch], [0.0, 1.0]])
    for line, letters in enumerate(text.split()):
        for place, letter in enumerate(letters):
            left_m = ((len(letters) - 1) / 2 - place) * _GAP * wide_m
            foot = np.array([line * _LINE_GAP * tall_m, left_m])
            for start, end in _pen(letter, hand):
                scale = np.array([low_m, wide_m])
                yield foot + stroke(start * scale, end * scale, stroke_m) @ drawn_out


def _pen(letter: str, hand: Hand) -> Iterator[tuple[FloatArray, FloatArray]]:
    """From where to where a pen goes, up and to the left, for a letter of unit height and width."""
    for line in _STROKES[letter].split(","):
        grid = np.array([[int(at[1]), int(at[0])] for at in line.split()])
        points = (grid - (0, 1)) * (0.25, -0.5)
        for _ in range(hand.rounds):
            points = _rounder(points)
        for start, end in pairwise(points):
            if not hand.stencil or np.linalg.norm(end - start) < _BRIDGED:
                yield start, end
            else:
                yield start, start + (0.5 - _BRIDGE) * (end - start)
                yield start + (0.5 + _BRIDGE) * (end - start), end


def _rounder(points: FloatArray) -> FloatArray:
    """A line (N, 2) whose corners are cut at a quarter of its sides; a closed one stays closed."""
    sides = np.diff(points, axis=0)
    cut = np.stack([points[:-1] + 0.25 * sides, points[1:] - 0.25 * sides], axis=1).reshape(-1, 2)
    is_closed = bool(np.allclose(points[0], points[-1]))
    return np.vstack([cut, cut[:1]] if is_closed else [points[:1], cut[1:-1], points[-1:]])


def stroke(start: FloatArray, end: FloatArray, thick_m: float) -> FloatArray:
    """A bar (4, 2) from point to point and half its thickness beyond both, counter-clockwise."""
    ahead = (end - start) * (thick_m / 2 / np.linalg.norm(end - start))
    left = turned_left(ahead)
    start = start - ahead
    end = end + ahead
    return np.array([start - left, end - left, end + left, start + left])
