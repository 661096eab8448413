"""A scene: the ground, the paint on it, what stands on it, the light; and the endless textures of them all.

Everything lies in the ``map`` frame of :mod:`v2hdm.records` (metres, z up, ground at z = 0 or on a relief).
Colours are linear reflectances or radiances in blue, green, red order, as OpenCV stores them.

Textures are seamless tiles of noise, sampled in metres and faded out where they would alias. A tile is
band-limited, so a pixel that covers more ground than the tile's finest wavelength would turn it into shimmer;
its amplitude therefore fades with the pixel's footprint (frequency clamping, Norton, Rockwood and Skolmoski
1982).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from v2hdm.compiled import exactly_inlined
from v2hdm.records import FloatArray
from v2hdm.simulate.render.relief import LEVEL, GroundPlane, Relief

Float32 = NDArray[np.float32]

TILE_PX = 512  # side of a tile


@dataclass(frozen=True)
class Tile:
    """A seamless square texture of mean 0 and standard deviation 1, ``side_m`` wide on the ground."""

    values: Float32
    side_m: float

    @cached_property
    def padded(self) -> Float32:
        """The values with their first rows and columns repeated behind the last, for interpolation."""
        return np.pad(self.values, ((0, 2), (0, 2)), mode="wrap")


@cache
def noise_tile(seed: int, side_m: float, slope: float, finest_px: float = 2.0, skew: float = 0.0) -> Tile:
    """Noise of amplitude 1 / frequency^slope from ``finest_px`` upwards; ``skew`` > 0: bright specks."""
    rng = np.random.default_rng([seed, 77])
    frequency = np.hypot(np.fft.fftfreq(TILE_PX)[:, None], np.fft.rfftfreq(TILE_PX)[None])
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((TILE_PX, TILE_PX)))
    spectrum *= frequency**-slope * np.exp(-0.5 * (frequency * finest_px) ** 2)
    values = np.fft.irfft2(spectrum, s=(TILE_PX, TILE_PX))
    values /= values.std()
    if skew:
        values = np.exp(skew * values)
        values = (values - values.mean()) / values.std()
    return Tile(np.ascontiguousarray(values, dtype=np.float32), side_m)


def sample(tile: Tile, x_m: Float32, y_m: Float32, offset_m: tuple[float, float] = (0.0, 0.0)) -> Float32:
    """The tile's values at ground points (H, W), bilinear, repeated endlessly.

    Coordinates are wrapped here: OpenCV's own wrapping border is four times slower and saturates at 32767.
    """
    columns = _wrapped(x_m, tile.side_m, offset_m[0])
    rows = _wrapped(y_m, tile.side_m, offset_m[1])
    return np.asarray(cv2.remap(tile.padded, columns, rows, cv2.INTER_LINEAR), dtype=np.float32)


def _wrapped(metres: Float32, side_m: float, offset_m: float) -> Float32:
    turns = metres * np.float32(1.0 / side_m)
    turns += np.float32(offset_m / side_m)
    turns -= np.floor(turns)
    turns *= np.float32(TILE_PX)
    return turns


def scale_of(tile: Tile, shift_m: tuple[float, float], finest_px: float = 4.0) -> list[float]:
    """A tile's turns a metre, turns at 0 across and along, and its finest waves a metre, for kernels."""
    per_wave = 1.0 / (finest_px * tile.side_m / tile.values.shape[0])
    return [1.0 / tile.side_m, shift_m[0] / tile.side_m, shift_m[1] / tile.side_m, per_wave]


def smoothstep(values: Float32, low: float, high: float) -> Float32:
    """Cubic step from 0 at ``low`` to 1 at ``high``."""
    return np.asarray(cubic_step(np.clip((values - np.float32(low)) * np.float32(1.0 / (high - low)), 0, 1)))


@exactly_inlined
def cubic_step(share: Any) -> Any:
    """Cubic step from 0 to 1 by shares from 0 to 1, of numpy or of kernels."""
    return share * share * (np.float32(3.0) - np.float32(2.0) * share)


Bgr = tuple[float, float, float]

Shade = Callable[[Any, Any, NDArray[np.float32]], None]
"""Lowers the sun's visibility (H, W) on the ground, of which a view and its ground field are given."""

Picture = Callable[[FloatArray, Float32, Float32, Float32], Float32]
"""Reflectance (3, h, w) in blue, green and red of pixels on a side of a box: of that side's length and height
(2,), and of each pixel's place (h, w) along and up it and the length that it covers; all m."""

WHITE_PAINT: Bgr = (0.70, 0.74, 0.75)  # reflectance of fresh white paint, chosen
YELLOW_PAINT: Bgr = (0.07, 0.42, 0.62)  # reflectance of fresh yellow paint, chosen

RECTANGLE = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
"""Corners of the square from -1 to 1, counter-clockwise."""


@dataclass(frozen=True, kw_only=True)
class GroundMarks:
    """Tyre marks, patches and kerbs that are too soft or too many for polygons, as a raster.

    ``factor`` (H, W) uint8 multiplies the reflectance, 128 standing for 1; the centre of its element
    (row, column) lies at ``origin_map + resolution_m * (column, row)``. Outside, the factor is 1.
    """

    factor: NDArray[np.uint8]
    origin_map: tuple[float, float]
    resolution_m: float


@dataclass(frozen=True, kw_only=True)
class Ground:
    """The bare surface: a texture, large stains, slab joints, wet areas, and marks drawn upon it.

    ``contrast`` and ``stains`` are relative standard deviations of the fine grain and of the
    metre-sized tone. ``slab_m`` is the length and width of concrete slabs, or None. ``wet_fraction``
    is the part of the ground under a film of water.
    """

    albedo_bgr: Bgr = (0.29, 0.30, 0.31)
    texture: str | Tile = "concrete"
    contrast: float = 0.12
    stains: float = 0.12
    slab_m: tuple[float, float] | None = None
    slab_yaw_rad: float = 0.0
    joint_width_m: float = 0.015
    joint_factor: float = 0.35
    wet_fraction: float = 0.0
    marks: GroundMarks | None = None
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Paint:
    """One convex painted polygon.

    ``kind`` is one of the renderer's classes; ``polygon_map`` (N, 2). ``wear`` from 0 (fresh)
    to 1 (gone) is the fraction of paint worn off down to the ground, ``dirt`` the fraction of the
    remaining contrast lost under dirt. Pieces of one marking share a ``seed``.
    """

    kind: str
    polygon_map: FloatArray
    albedo_bgr: Bgr = WHITE_PAINT
    wear: float = 0.1
    dirt: float = 0.15
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Box:
    """An upright cuboid that hides what lies behind it and casts a shadow: container, truck, wall, pole.

    ``centre_map`` is the centre of its footprint, ``size_m`` its length, width and height,
    ``base_m`` the height of its lower side above the ground, whose height beneath the centre and slopes by x
    and y are ``beneath``: on a slope it is sheared. ``pictures`` are of its left, rear, right and front side
    and its top, as seen from outside, in place of the colour; None leaves that.
    """

    centre_map: tuple[float, float]
    size_m: tuple[float, float, float]
    yaw_rad: float = 0.0
    albedo_bgr: Bgr = (0.3, 0.3, 0.3)
    base_m: float = 0.0
    beneath: GroundPlane = LEVEL
    corrugated: bool = False
    pictures: tuple[Picture | None, ...] = ()
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Shadow:
    """A convex shadow on the ground: ``transmission`` of the sun's light, penumbra ``softness_m`` wide."""

    polygon_map: FloatArray
    transmission: float = 0.0
    softness_m: float = 0.05


@dataclass(frozen=True, kw_only=True)
class Light:
    """Sun and sky: ``sun_direction_map`` points to the sun, irradiances are relative."""

    sun_direction_map: tuple[float, float, float] = (0.4, 0.5, 0.77)
    sun_bgr: Bgr = (0.92, 1.0, 1.06)
    sky_bgr: Bgr = (0.38, 0.33, 0.30)
    zenith_bgr: Bgr = (0.75, 0.50, 0.34)
    horizon_bgr: Bgr = (0.92, 0.90, 0.86)


@dataclass(frozen=True, kw_only=True)
class Backdrop:
    """A skyline up to ``height_rad`` high behind the boxes, and haze, which leaves 37 % after ``haze_m``."""

    height_rad: float = 0.06
    block_rad: float = 0.08
    albedo_bgr: Bgr = (0.22, 0.21, 0.20)
    haze_m: float = 400.0
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Everything that the renderer draws; paint later in the list lies upon paint before it."""

    ground: Ground = field(default_factory=Ground)
    paints: tuple[Paint, ...] = ()
    boxes: tuple[Box, ...] = ()
    shadows: tuple[Shadow, ...] = ()
    shades: tuple[Shade, ...] = ()
    light: Light = field(default_factory=Light)
    backdrop: Backdrop = field(default_factory=Backdrop)
    relief: Relief | None = None


def convex_hull(points: FloatArray) -> FloatArray:
    """Convex hull (M, 2) of points (N, 2), counter-clockwise from the one of least x."""
    hull = np.asarray(points, dtype=np.float64)[ConvexHull(points).vertices]
    return np.roll(hull, -np.lexsort((hull[:, 1], hull[:, 0]))[0], axis=0)


def placed(shape: FloatArray, centre_map: FloatArray | tuple[float, float], yaw_rad: float) -> FloatArray:
    """A shape (N, 2) turned by ``yaw_rad`` about its origin, which comes to lie at ``centre_map``."""
    cos = np.cos(yaw_rad)
    sin = np.sin(yaw_rad)
    return np.asarray(shape @ np.array([[cos, sin], [-sin, cos]]) + centre_map)


def box_footprint(box: Box) -> FloatArray:
    """The four corners (4, 2) of a box's base in the map, counter-clockwise."""
    return placed(RECTANGLE * (box.size_m[0] / 2, box.size_m[1] / 2), box.centre_map, box.yaw_rad)


def ground_under(box: Box, points_map: FloatArray) -> FloatArray:
    """Heights (N,) at points (N, 2) of the plane on which a box stands."""
    plane = box.beneath
    return np.asarray(plane.height_m + (points_map - box.centre_map) @ (plane.by_x, plane.by_y))


def box_faces(box: Box) -> FloatArray:
    """The corners (2, 4, 3) of a box's lower and upper face, counter-clockwise from above."""
    faces = np.empty((2, 4, 3))
    footprint = box_footprint(box)
    faces[..., :2] = footprint
    faces[0, :, 2] = box.base_m
    faces[1, :, 2] = box.base_m + box.size_m[2]
    if any(box.beneath):
        faces[..., 2] += ground_under(box, footprint)
    return faces


def standing(box: Box, relief: Relief | None) -> Box:
    """The box on the ground of a relief."""
    return box if relief is None else replace(box, beneath=relief.plane_of(box_footprint(box)))


def box_shadow(box: Box, light: Light, softness_m: float = 0.08) -> Shadow:
    """The shadow that a box throws on the ground: hull of its lower and upper face along the sun's rays."""
    sun = np.array(light.sun_direction_map)
    per_metre = -sun[:2] / max(sun[2], 0.1)
    footprint = box_footprint(box)
    faces = [footprint + height * per_metre for height in (box.base_m, box.base_m + box.size_m[2])]
    return Shadow(polygon_map=convex_hull(np.vstack(faces)), softness_m=softness_m)
