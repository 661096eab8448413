"""Lines on photographs: seen on any ground, told apart without colour, and a legend that hides nothing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from v2hdm.records import FloatArray

_SUBPIXELS = 4
"""Bits of a pixel's fraction in which OpenCV takes coordinates."""

_LARGEST_PX = 1e4
"""Farther out nothing is drawn, and OpenCV's integers would overflow."""

_HALO_BGR = (25, 25, 25)
_STRIP_BGR = (250, 250, 250)
_TEXT_BGR = (35, 35, 35)
_FONT = cv2.FONT_HERSHEY_DUPLEX


@dataclass(frozen=True)
class Pen:
    """How a line is drawn: ``colour`` as #rrggbb; ``dash_px``, length of dash and gap, None for solid."""

    colour: str
    dash_px: tuple[float, float] | None = None
    width: int = 2

    @property
    def bgr(self) -> tuple[int, int, int]:
        """The colour as OpenCV takes it."""
        value = int(self.colour[1:], 16)
        return value & 255, value >> 8 & 255, value >> 16


def draw_lines(canvas: np.ndarray, lines: Iterable[FloatArray], pen: Pen) -> None:
    """Draw polylines (N, 2) px, with a dark edge, so that they are seen on paint and on asphalt."""
    pieces = [piece for line in lines for piece in (_dashes(line, *pen.dash_px) if pen.dash_px else [line])]
    fixed = [
        np.round(np.clip(piece, -_LARGEST_PX, _LARGEST_PX) * (1 << _SUBPIXELS)).astype(np.int32)
        for piece in pieces
    ]
    for colour, width in ((_HALO_BGR, 2 * pen.width), (pen.bgr, pen.width)):
        cv2.polylines(canvas, fixed, False, colour, width, cv2.LINE_AA, shift=_SUBPIXELS)


def _dashes(line: FloatArray, dash_px: float, gap_px: float) -> list[FloatArray]:
    """The dashes of a polyline: pieces of it that are ``dash_px`` long."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    out = []
    for start in np.arange(0.0, way[-1], dash_px + gap_px):
        end = min(start + dash_px, way[-1])
        between = (way > start) & (way < end)
        ends = np.column_stack([np.interp([start, end], way, line[:, axis]) for axis in (0, 1)])
        out.append(np.vstack([ends[:1], line[between], ends[1:]]))
    return out


def with_legend(canvas: np.ndarray, entries: Sequence[tuple[Pen | None, str]]) -> np.ndarray:
    """The picture (H, W, 3) with a strip below it that names each pen; text alone has none."""
    width = canvas.shape[1]
    size = float(np.clip(width / 1900, 0.4, 0.75))
    row_px, sample_px = round(44 * size), round(64 * size)
    rows: list[list[tuple[Pen | None, str, int]]] = [[]]
    used = 0
    for pen, text in entries:
        needed = (sample_px + 12 if pen else 0) + cv2.getTextSize(text, _FONT, size, 1)[0][0] + 28
        if rows[-1] and used + needed > width - 16:
            rows.append([])
            used = 0
        rows[-1].append((pen, text, used + 16))
        used += needed
    strip = np.full((row_px * len(rows) + 8, width, 3), _STRIP_BGR, np.uint8)
    for number, row in enumerate(rows):
        middle = 4 + row_px * number + row_px // 2
        for pen, text, left in row:
            if pen is not None:
                draw_lines(strip, [np.array([[left, middle], [left + sample_px, middle]], float)], pen)
                left += sample_px + 12
            cv2.putText(strip, text, (left, middle + round(9 * size)), _FONT, size, _TEXT_BGR, 1, cv2.LINE_AA)
    return np.vstack([canvas, strip])
