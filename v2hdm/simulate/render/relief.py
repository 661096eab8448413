"""Ground that is no plane: its heights, and where rays meet it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from v2hdm.compiled import exact_kernel, exactly_inlined
from v2hdm.records import BoolArray, FloatArray

_MOST_STEPS = 200  # largest number of steps that follow a ray

# Height at which a ray has met the ground, m: 0.1 mm along a ray whose camera is 100 times as far as high.
_SURE_M = 1e-6

# A step along a ray is at most this share of the way behind it and the first step's length, m, beside that.
_STEP = 0.2
_FIRST_STEP_M = 0.5  # largest first step along a ray

# A ray begins at this share of the way of the ray below it: the two are not quite in one upright plane.
_BACK = 0.98

# Shares of a line of sight at which the ground may rise above it.
_ALONG_SIGHT = np.linspace(0.02, 0.98, 33)[:, None, None]


class GroundPlane(NamedTuple):
    """A plane on the ground: its height, m, at a place, and its slopes there along x and y."""

    height_m: float
    by_x: float
    by_y: float


LEVEL = GroundPlane(0.0, 0.0, 0.0)  # the ground of a scene without relief


@dataclass(frozen=True, kw_only=True)
class Relief:
    """Heights as a bicubic B-spline: ``knots`` (R, C) m, the first at ``origin_map``, ``step_m`` apart.

    Beyond its edges the ground goes on as high as there.
    """

    knots: FloatArray
    origin_map: tuple[float, float]
    step_m: float

    @property
    def placed(self) -> tuple[FloatArray, float, float, float]:
        """The knots, x and y of the first, m, and knots a metre: what kernels take."""
        return self.knots, *self.origin_map, 1.0 / self.step_m

    def with_slopes(self, points_map: FloatArray) -> FloatArray:
        """Height, m, and slopes by x and y (..., 3) at points (..., 2)."""
        points = np.ascontiguousarray(points_map, dtype=np.float64).reshape(-1, 2)
        out = np.empty((len(points), 3))
        _heights(self.placed, points, out)
        return out.reshape((*np.shape(points_map)[:-1], 3))

    def height_m(self, points_map: FloatArray) -> FloatArray:
        """Heights (...) at points (..., 2)."""
        return self.with_slopes(points_map)[..., 0]

    def plane_of(self, corners_map: FloatArray) -> GroundPlane:
        """The plane nearest to the ground at corners (N, 2), its height that at their middle."""
        off = np.column_stack([np.ones(len(corners_map)), corners_map - corners_map.mean(axis=0)])
        height, by_x, by_y = np.linalg.lstsq(off, self.height_m(corners_map))[0].tolist()
        return GroundPlane(height, by_x, by_y)

    def hides(self, centre_map: FloatArray, points_map: FloatArray) -> BoolArray:
        """Whether the ground hides points of it (N, 3) from ``centre_map`` (3,)."""
        sight = centre_map + _ALONG_SIGHT * (points_map - centre_map)
        return np.asarray((self.height_m(sight[..., :2]) > sight[..., 2]).any(axis=0))


@exactly_inlined
def _cubic(a: Any, b: Any, c: Any, d: Any, t: Any) -> Any:
    """A uniform cubic B-spline of four knots and its slope, ``t`` between the second and the third."""
    second = (c - a) / 2
    third = (a - 2 * b + c) / 2
    last = (d - 3 * c + 3 * b - a) / 6
    value = (a + 4 * b + c) / 6 + t * (second + t * (third + t * last))
    return value, second + t * (2 * third + t * 3 * last)


@exactly_inlined
def _ground_at(placed: Any, x_m: Any, y_m: Any) -> Any:
    """Height and slopes by x and y at a point."""
    knots, x0_m, y0_m, per_metre = placed
    x = min(max((x_m - x0_m) * per_metre, 1.0), knots.shape[1] - 2.001)
    y = min(max((y_m - y0_m) * per_metre, 1.0), knots.shape[0] - 2.001)
    i = int(x) - 1
    j = int(y) - 1
    s = x - i - 1
    t = y - j - 1
    a, a_x = _cubic(knots[j, i], knots[j, i + 1], knots[j, i + 2], knots[j, i + 3], s)
    b, b_x = _cubic(knots[j + 1, i], knots[j + 1, i + 1], knots[j + 1, i + 2], knots[j + 1, i + 3], s)
    c, c_x = _cubic(knots[j + 2, i], knots[j + 2, i + 1], knots[j + 2, i + 2], knots[j + 2, i + 3], s)
    d, d_x = _cubic(knots[j + 3, i], knots[j + 3, i + 1], knots[j + 3, i + 2], knots[j + 3, i + 3], s)
    height, by_y = _cubic(a, b, c, d, t)
    by_x, _ = _cubic(a_x, b_x, c_x, d_x, t)
    return height, by_x * per_metre, by_y * per_metre


@exact_kernel
def _heights(placed: Any, points_map: FloatArray, out: FloatArray) -> None:
    for k in range(len(points_map)):
        out[k, 0], out[k, 1], out[k, 2] = _ground_at(placed, points_map[k, 0], points_map[k, 1])


@exact_kernel
def meet_ground(
    placed: Any, rays: Any, map_from_ray: FloatArray, centre: FloatArray, farthest_m: float, per_focal: float,
    out: NDArray[np.float32], below: BoolArray,
) -> None:  # fmt: skip
    """Follow every pixel's ray from ``centre`` (3,) to the ground that it meets first.

    Writes x, y, depth, footprint and slopes by x and y there (6, H, W), and into ``below`` (H, W) whether
    it meets any before ``farthest_m``. Newton's steps, each a share of the way at most so that no crest is
    missed, begin where the ray of the row below ended: as far as that, no ground reaches up to this one.
    """
    u, v = rays
    m = map_from_ray
    last = u.shape[0] - 1
    for rank in range(last + 1):
        row, following = (last - rank, last - rank + 1) if m[2, 1] < 0 else (rank, rank - 1)
        for column in range(u.shape[1]):
            x = m[0, 0] * u[row, column] + m[0, 1] * v[row, column] + m[0, 2]
            y = m[1, 0] * u[row, column] + m[1, 1] * v[row, column] + m[1, 2]
            z = m[2, 0] * u[row, column] + m[2, 1] * v[row, column] + m[2, 2]
            depth = _BACK * out[2, following, column] if rank else 0.0
            hit = False
            height, by_x, by_y = _ground_at(placed, centre[0] + depth * x, centre[1] + depth * y)
            for _ in range(_MOST_STEPS):
                above = centre[2] + depth * z - height
                falls = z - by_x * x - by_y * y
                if abs(above) < _SURE_M or depth > farthest_m:
                    hit = depth <= farthest_m
                    break
                longest = _STEP * depth + _FIRST_STEP_M
                step = -above / falls if falls < 0 else np.copysign(longest, above)
                depth += min(max(step, -longest), longest)
                height, by_x, by_y = _ground_at(placed, centre[0] + depth * x, centre[1] + depth * y)
            below[row, column] = hit
            depth = depth if hit else farthest_m
            out[0, row, column] = centre[0] + depth * x
            out[1, row, column] = centre[1] + depth * y
            out[2, row, column] = depth
            out[3, row, column] = depth * per_focal / max(by_x * x + by_y * y - z, 1e-3)
            out[4, row, column] = by_x
            out[5, row, column] = by_y
