"""The probability that paint is a hatched box and no writing: by the network's names and by its meshes.

From afar the network takes the lines of a small box for strokes of letters. But the lines of a box cross, or
end at its frame, and enclose ground, mesh beside mesh; letters enclose little, and few do. Ground that paint
encloses adds to the log odds of the network's names. Its absence says nothing: worn lines have gaps.
"""

from __future__ import annotations

import cv2
import numpy as np

from v2hdm.records import BoolArray, IntArray

FITTED = 5.04
"""Weight of the meshes, fitted to photographs and renders by ``python -m train.fit_hatching``."""

_LEAST_CELLS = 3  # elements of ground of a mesh: fewer are wear
_PRIOR_CELLS = 0.5  # elements of either class that are added to both, for the log odds


def meshes(rows: IntArray, columns: IntArray, is_painted: BoolArray) -> float:
    """How much a piece of paint is a net: the share of ground in it, times the log of its number of meshes.

    Its N elements lie at ``rows`` and ``columns`` (N,) of ``is_painted`` (h, w), the paint of any class: what
    lies in the hull of the piece adds to it.
    """
    top = int(rows.min())
    left = int(columns.min())
    painted = is_painted[top : int(rows.max()) + 1, left : int(columns.max()) + 1]
    hull = np.zeros(painted.shape, dtype=np.uint8)
    cells = np.column_stack([columns - left, rows - top]).astype(np.int32)
    cv2.fillConvexPoly(hull, cv2.convexHull(cells), 1)
    painted = painted & (hull > 0)
    ground = np.pad(~painted, 1, constant_values=True).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(ground, connectivity=4)
    cells_of_mesh = stats[1:, cv2.CC_STAT_AREA]
    is_mesh = (np.arange(1, len(stats)) != labels[0, 0]) & (cells_of_mesh >= _LEAST_CELLS)
    enclosed = int(cells_of_mesh[is_mesh].sum())
    share = enclosed / max(enclosed + int(painted.sum()), 1)
    return float(np.log1p(is_mesh.sum()) * share)


def box_probability(text_cells: float, box_cells: float, netted: float, weight: float = FITTED) -> float:
    """The probability that paint belongs to a box, from both classes' summed probability and its meshes."""
    named = np.log((box_cells + _PRIOR_CELLS) / (text_cells + _PRIOR_CELLS))
    return float(1.0 / (1.0 + np.exp(-named - weight * netted)))
