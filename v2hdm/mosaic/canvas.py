"""A raster on the ground: which point of the map each of its pixels shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.records import FloatArray


@dataclass(frozen=True)
class Canvas:
    """``rows`` x ``columns`` square pixels of ``cell_m`` on the ground, seen from above.

    ``corner_map`` (2,) m is the outer corner of the first pixel, ``right_map`` (2,) the unit vector along
    which columns rise; rows rise at a right angle to it, clockwise. A canvas whose columns rise to the east
    has north above.
    """

    corner_map: FloatArray
    cell_m: float
    rows: int
    columns: int
    right_map: tuple[float, float] = (1.0, 0.0)

    @property
    def canvas_from_map(self) -> FloatArray:
        """The inverse of :attr:`map_from_canvas`."""
        return np.asarray(np.linalg.inv(self.map_from_canvas), dtype=np.float64)

    @property
    def map_from_canvas(self) -> FloatArray:
        """The homography (3, 3) to the map of (column, row); (0, 0) is the centre of the first pixel."""
        x, y = self.right_map
        axes = self.cell_m * np.array([[x, y], [y, -x]])
        out = np.eye(3)
        out[:2, :2] = axes
        out[:2, 2] = self.corner_map + axes @ [0.5, 0.5]
        return out

    def window(self, row: int, column: int, rows: int, columns: int) -> Canvas:
        """A part of the canvas."""
        x, y = self.right_map
        corner = self.corner_map + self.cell_m * (column * np.array([x, y]) + row * np.array([y, -x]))
        return Canvas(corner, self.cell_m, rows, columns, self.right_map)

    @classmethod
    def around(cls, points_map: FloatArray, cell_m: float, multiple_px: int = 1) -> Canvas:
        """The smallest one, north above, around points (N, 2) m; its edges are multiples of its pixels.

        Rows and columns are filled up to a multiple of ``multiple_px``.
        """
        low = np.floor(points_map.min(axis=0) / cell_m)
        high = np.ceil(points_map.max(axis=0) / cell_m)
        columns, rows = (np.ceil((high - low) / multiple_px) * multiple_px).astype(int).tolist()
        corner = np.array([low[0], high[1]]) * cell_m
        return cls(corner, cell_m, rows, columns)

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """West, south, east and north edge, m, of a canvas with north above."""
        west, north = (float(value) for value in self.corner_map)
        return west, north - self.rows * self.cell_m, west + self.columns * self.cell_m, north
