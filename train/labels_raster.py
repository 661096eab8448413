"""Polygons to areas of pixels without a drawing routine's bias.

OpenCV's fillPoly takes every pixel that the outline touches, which makes paint half a pixel fatter all
around; a network trained on that places edges there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from v2hdm.records import FloatArray

_ROWS_PER_PX = 17
"""Odd, so that no pixel is found to be covered by exactly one half when it is not."""


def coverage(ring_px: FloatArray, left: int, top: int, width: int, height: int) -> NDArray[np.float32]:
    """How much (height, width) of each pixel of a window a polygon covers.

    Exact along the rows, which are sampled 17 times a pixel. Where the outline crosses itself, the even-odd
    rule holds.

    Args:
        ring_px: vertices (N, 2) of the outline; the centre of the top-left pixel is (0, 0).
        left: the window's first column.
        top: the window's first row.
        width: the window's columns.
        height: the window's rows.
    """
    covered = np.zeros((height, width), dtype=np.float32)
    low = np.floor(ring_px[:, 1].min() + 0.5) - top
    high = np.floor(ring_px[:, 1].max() + 0.5) - top
    first = int(np.clip(low, 0, height))
    last = int(np.clip(high + 1, 0, height))
    if last > first:
        rows = last - first
        v = top + first - 0.5 + (np.arange(rows * _ROWS_PER_PX) + 0.5) / _ROWS_PER_PX
        scan = _scan(ring_px - [left - 0.5, 0.0], v, width)
        covered[first:last] = scan.reshape(rows, _ROWS_PER_PX, width).mean(axis=1)
    return covered


def _scan(ring: FloatArray, v: FloatArray, width: int) -> FloatArray:
    """The length of the lines ``v`` (S,) within the polygon, in each cell (S, width) from u = 0 on."""
    start = ring
    end = np.roll(ring, -1, axis=0)
    line, edge = np.nonzero((start[:, 1] <= v[:, None]) != (end[:, 1] <= v[:, None]))
    slope = (end[edge, 0] - start[edge, 0]) / (end[edge, 1] - start[edge, 1])
    u = np.clip(start[edge, 0] + slope * (v[line] - start[edge, 1]), 0.0, width)
    order = np.lexsort((u, line))
    line = line[order]
    u = u[order]
    entering = np.where(np.arange(len(u)) % 2 == 0, 1.0, -1.0)  # every line crosses an even number of edges
    cell = np.floor(u).astype(np.intp)
    change = np.zeros((len(v), width + 2))
    np.add.at(change, (line, cell), entering * (1 - (u - cell)))
    np.add.at(change, (line, cell + 1), entering * (u - cell))
    return np.asarray(np.cumsum(change, axis=1)[:, :width])
