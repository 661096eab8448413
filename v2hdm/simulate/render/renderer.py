"""The renderer: a scene, a camera and its place in; an image and its class labels out.

Everything is computed per pixel in linear light: the ray meets the ground, textures and paint are looked
up there, sun and shadow multiply them, boxes are drawn over it, then lens and sensor do their work. Shapes
are anti-aliased by their exact signed distance, so that the 50 % point of an edge is where truth puts it.

From radiance to a recorded image: blur of lens and motion, exposure, noise, sRGB coding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.records import CameraInfo, FloatArray, IntArray
from v2hdm.simulate.render import drawing, kernels
from v2hdm.simulate.render import ground as on_ground
from v2hdm.simulate.render.ground import GroundField, PaintLayer, ShadowLayer
from v2hdm.simulate.render.scene import (
    Backdrop,
    Bgr,
    Box,
    Float32,
    Light,
    Picture,
    Scene,
    box_faces,
    box_shadow,
    noise_tile,
    scale_of,
)
from v2hdm.simulate.render.view import (
    Outlines,
    View,
    bands_of,
    begins,
    camera_rays,
    edges_of,
    in_view,
    outlines,
)

_CORRUGATION_M = 0.28  # length of a wave of a container's corrugated side
_DIRT_TILE = noise_tile(17, 6.0, 1.2)  # dirt on boxes, repeating after 6 m
_FARTHEST_M = 250.0  # largest depth of boxes that are drawn


@dataclass(frozen=True)
class _Face:
    """A rectangle of a box: its corners (4, 3), its normal, and whether it is a side."""

    box: Box
    corners_map: FloatArray
    normal: FloatArray
    upright: bool
    lit_bgr: Bgr
    picture: Picture | None = None

    @cached_property
    def axes(self) -> FloatArray:
        """Unit vectors (3, 2) from the first corner to the second and to the last."""
        sides = self.corners_map[[1, 3]] - self.corners_map[0]
        return np.column_stack([side / max(float(np.linalg.norm(side)), 1e-9) for side in sides])

    @property
    def sides_m(self) -> FloatArray:
        """Lengths (2,) of the edges from the first corner to the second and to the last."""
        return np.asarray(np.linalg.norm(self.corners_map[[1, 3]] - self.corners_map[0], axis=1))

    @cached_property
    def look(self) -> FloatArray:
        """Radiance of its box's colour, and whether it is corrugated, upright, and has a picture (6,)."""
        flags = (self.box.corrugated and self.upright, self.upright, self.picture is not None)
        return np.array([*np.multiply(self.box.albedo_bgr, self.lit_bgr), *flags])

    @cached_property
    def dirt_scale(self) -> Float32:
        """Where the dirt's texture lies on it, as kernels take it."""
        offset = (float(self.box.seed % 101) * 0.37, float(self.box.seed % 71) * 0.29)
        return np.array(scale_of(_DIRT_TILE, offset), dtype=np.float32)


@dataclass(frozen=True)
class _Standing:
    """Boxes in a light, prepared once; the faces of each when it first comes into view."""

    boxes: tuple[Box, ...]
    corners_map: FloatArray  # (B, 8, 3)
    light: Light
    faces: dict[int, list[_Face]]

    @classmethod
    def of(cls, boxes: tuple[Box, ...], light: Light) -> _Standing:
        """All that does not depend on the camera."""
        corners_map = np.array([box_faces(box).reshape(8, 3) for box in boxes]).reshape(-1, 8, 3)
        return cls(boxes, corners_map, light, {})

    def visible(self, view: View) -> list[tuple[Box, list[_Face]]]:
        """The boxes that may reach into the image."""
        chosen = in_view(view, view.homogeneous_px(self.corners_map), _FARTHEST_M).tolist()
        for number in chosen:
            if number not in self.faces:
                self.faces[number] = _faces(self.boxes[number], self.light)
        return [(self.boxes[number], self.faces[number]) for number in chosen]


def draw_boxes(
    standing: Sequence[_Standing], view: View, radiance: Float32, hidden: NDArray[np.bool_]
) -> None:
    """Draw boxes over ``radiance`` (H, W, 3) and mark in ``hidden`` (H, W) what lies behind them."""
    centre = view.centre_map
    visible = [box for boxes in standing for box in boxes.visible(view)]

    def distance(box: Box) -> float:
        offset_map = np.array(box.centre_map) - centre[:2]
        return float(np.hypot(offset_map[0], offset_map[1]))

    # Of stacked boxes the upper comes first: its underside lies behind the one below.
    ordered = sorted(visible, key=lambda b: (distance(b[0]), b[0].base_m), reverse=True)
    faces = [face for _, faces in ordered for face in faces]
    offset_map = centre - np.array([face.corners_map[0] for face in faces]).reshape(-1, 3)
    normals = np.array([face.normal for face in faces]).reshape(-1, 3)
    turned = [faces[number] for number in np.flatnonzero((offset_map * normals).sum(axis=1) > 1e-3)]
    shapes = outlines(view, [view.homogeneous_px(face.corners_map) for face in turned])
    if shapes is not None:
        _draw_faces([turned[number] for number in shapes.numbers], shapes, view, radiance, hidden)


def _faces(box: Box, light: Light) -> list[_Face]:
    low, high = box_faces(box)
    faces = []
    pictures = (*box.pictures, *(None,) * 6)
    for k in range(4):
        after = (k + 1) % 4
        a = low[k, :2]
        b = low[after, :2]
        along = (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
        corners = np.array([low[k], low[after], high[after], high[k]])
        normal = np.array([along[1], -along[0], 0.0])
        faces.append(_Face(box, corners, normal, True, _light_on(normal, light), pictures[k]))
    for corners, up, picture in ((high, 1.0, pictures[4]), (low, -1.0, None)):
        normal = np.array([0.0, 0.0, up])
        faces.append(_Face(box, corners, normal, False, _light_on(normal, light), picture))
    return faces


def _light_on(normal: FloatArray, light: Light) -> Bgr:
    """The light of sun and sky that falls on a face."""
    sun = max(float(normal @ np.array(light.sun_direction_map)), 0.0)
    sky = 0.55 + 0.45 * normal[2] if normal[2] >= 0 else 0.35
    blue, green, red = (sun * s + sky * d for s, d in zip(light.sun_bgr, light.sky_bgr, strict=True))
    return blue, green, red


_TOGETHER_PX = 1 << 16  # pixels of windows up to which faces are drawn together: what stays in a cache


def _draw_faces(
    faces: Sequence[_Face], shapes: Outlines, view: View, radiance: Float32, hidden: NDArray[np.bool_]
) -> None:
    """Draw faces one over the other, those behind first."""
    bands = bands_of(view, shapes)
    heights, widths = (bands.windows[:, 1::2] - bands.windows[:, ::2]).T
    places = begins(heights * widths)
    edges = edges_of(shapes, grown_px=0.5)
    rays = (view.rays.u_pinhole_px, view.rays.v_pinhole_px)
    planes = _planes_of(faces, view)
    per_focal = np.float32(1.0 / view.rays.info.intrinsic[0, 0])
    covers = np.empty(len(places), dtype=np.bool_)
    scales = np.array([face.dirt_scale for face in faces])
    looks = np.array([face.look for face in faces], dtype=np.float32)
    for span in _groups(places[bands.rows]):
        first, end = places[bands.rows[list(span)]]
        patches = np.empty((4, end - first), dtype=np.float32)
        drawing.look_at_faces(
            bands, span, edges, shapes.edge_rows, rays, planes, per_focal, places, patches, covers
        )
        waves = np.sin(patches[1:2] * np.float32(2 * np.pi / _CORRUGATION_M))
        pictures = np.empty((3, end - first if looks[slice(*span), 5].any() else 0), dtype=np.float32)
        pictured = [number for number in range(*span) if faces[number].picture is not None]
        for number in pictured:
            for k in range(*bands.rows[number : number + 2]):
                part = slice(places[k] - first, places[k + 1] - first)
                pixels = patches[1:, part].reshape(3, heights[k], widths[k])
                pictures[:, part] = _pictured(faces[number], pixels)
        drawing.draw_faces(
            bands, span, places, covers, patches, waves, pictures, _DIRT_TILE.padded, scales, looks,
            _rows(radiance), hidden.view(np.uint8),
        )  # fmt: skip


def _pictured(face: _Face, pixels: Float32) -> Float32:
    """Radiance (3, N) of a face's picture at pixels (3, h, w): metres along both sides, and size."""
    assert face.picture is not None
    reflected = face.picture(face.sides_m, *pixels)
    lit = [np.asarray(part * light, np.float32) for part, light in zip(reflected, face.lit_bgr, strict=True)]
    return np.stack(lit).reshape(3, -1)


def _groups(places: IntArray) -> Iterator[tuple[int, int]]:
    """The first and end of faces that are drawn together, by where each one's pixels begin (F + 1,)."""
    first = 0
    while first < len(places) - 1:
        within = int(np.searchsorted(places, places[first] + _TOGETHER_PX, side="right")) - 1
        end = max(within, first + 1)
        yield first, end
        first = end


def _planes_of(faces: Sequence[_Face], view: View) -> Float32:
    """Metres along faces' first and last edges, and the inverse depth, from pinhole pixels (F, 3, 3)."""
    origins = np.array([face.corners_map[0] for face in faces])
    axes = np.array([face.axes for face in faces])
    rotation = view.cam_from_map[:3, :3]
    cam_from_origin = rotation @ origins[..., None] + view.cam_from_map[:3, 3:]
    cam_from_face = np.concatenate([rotation @ axes, cam_from_origin], axis=2)
    return np.linalg.inv(view.rays.info.intrinsic @ cam_from_face).astype(np.float32)


_CLOUD_TILE = noise_tile(18, 3.0, 1.5)  # clouds by azimuth and elevation, repeating after 3 rad


@cache
def _skyline(seed: int, blocks: int) -> Float32:
    """Heights relative to the tallest, and tones, (2, blocks) of the blocks around the horizon."""
    rng = np.random.default_rng([seed, 41])
    heights = rng.choice([0.15, 0.3, 0.5, 0.7, 1.0], blocks) * rng.uniform(0.85, 1.0, blocks)
    return np.stack([heights, rng.uniform(0.5, 1.6, blocks)]).astype(np.float32)


def draw_background(view: View, light: Light, backdrop: Backdrop, last_row: int) -> Float32:
    """Radiance (last_row, W, 3) of sky and skyline for the image rows above ``last_row``."""
    rotation = (view.cam_from_map[:3, :3].T @ np.linalg.inv(view.rays.info.intrinsic)).astype(np.float32)
    u = view.rays.u_pinhole_px[:last_row]
    v = view.rays.v_pinhole_px[:last_row]
    x, y, z = (row[0] * u + row[1] * v + row[2] for row in rotation)
    elevation = np.arctan2(z, np.hypot(x, y))
    azimuth = np.arctan2(y, x)
    horizon, zenith, wall = np.array([light.horizon_bgr, light.zenith_bgr, backdrop.albedo_bgr], np.float32)
    blocks = max(int(2 * np.pi / backdrop.block_rad), 8)
    out = np.empty((*azimuth.shape, 3), dtype=np.float32)
    kernels.draw_sky(
        azimuth,
        elevation,
        _CLOUD_TILE.padded,
        np.array(scale_of(_CLOUD_TILE, (0.0, 0.0)), dtype=np.float32),
        np.stack([horizon, zenith - horizon, wall]),
        _skyline(backdrop.seed, blocks),
        np.float32(blocks / (2 * np.pi)),
        np.float32(backdrop.height_rad),
        np.float32(1.0 / view.rays.info.intrinsic[0, 0]),
        out,
    )
    return out


RENDERER_VERSION = 2
"""Raised whenever a scene comes out as another picture or truth: cached drives are made afresh then."""


@dataclass(frozen=True)
class Rendered:
    """One picture and what it shows.

    ``image`` (H, W, 3) uint8 BGR sRGB; ``labels`` (H, W) uint8, 0 for no paint and otherwise 1 + the index
    among the renderer's classes (the painted shape, worn or not, where nothing stands in front
    of it); ``hidden`` (H, W) bool where a box is in front of the ground.
    """

    image: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    hidden: NDArray[np.bool_]


@dataclass
class Renderer:
    """Draws one scene from any number of places; labels are those of ``classes``, in this order."""

    scene: Scene
    classes: tuple[str, ...] = PAINT_CLASSES
    _paint: PaintLayer = field(init=False)
    _shadows: ShadowLayer = field(init=False)
    _standing: _Standing = field(init=False)

    def __post_init__(self) -> None:
        self._paint = PaintLayer(self.scene.paints, self.classes)
        cast = tuple(box_shadow(box, self.scene.light) for box in self.scene.boxes)
        self._shadows = ShadowLayer(self.scene.shadows + cast)
        self._standing = _Standing.of(self.scene.boxes, self.scene.light)

    def render(
        self,
        info: CameraInfo,
        cam_from_map: FloatArray,
        rng: np.random.Generator,
        optics: Optics | None = None,
        motion: Motion | None = None,
        moving_boxes: tuple[Box, ...] = (),
        before_lens: Callable[[View, Float32, NDArray[np.bool_]], None] | None = None,
    ) -> Rendered:
        """Render one image of a camera of any size, at ``cam_from_map`` in the middle of the exposure.

        The sensor noise is drawn from ``rng``: the picture is a function of its state. ``moving_boxes`` stand
        in the scene for this image only. ``before_lens`` draws on the radiance (H, W, 3) what moves with the
        camera, and sets ``hidden`` (H, W) where that is opaque.
        """
        view = View(camera_rays(info), np.asarray(cam_from_map, dtype=np.float64), self.scene.relief)
        labels = np.zeros((info.height, info.width), dtype=np.uint8)
        hidden = np.zeros((info.height, info.width), dtype=np.bool_)
        light = self.scene.light
        casting = [box for box in moving_boxes if on_ground.may_cast(box, light, view)]
        moving_shadows = ShadowLayer([box_shadow(box, light) for box in casting])
        standing = (self._standing, _Standing.of(moving_boxes, light))
        radiance = self._surroundings(view, (self._shadows, moving_shadows), labels)
        draw_boxes(standing, view, radiance, hidden)
        radiance = _motion_blur(radiance, view, motion or Motion())
        if before_lens is not None:
            before_lens(view, radiance, hidden)
        labels[hidden] = 0
        return Rendered(expose(radiance, optics or Optics(), rng), labels, hidden)

    def _surroundings(self, view: View, shadows: Sequence[ShadowLayer], labels: NDArray[np.uint8]) -> Float32:
        """Radiance (H, W, 3) of sky and ground."""
        scene = self.scene
        height, width = labels.shape
        ground = on_ground.intersect_ground(view)
        if ground is None:
            return draw_background(view, scene.light, scene.backdrop, height)
        sky_rows = np.flatnonzero(~ground.below.all(axis=1))
        last_row = ground.first_row + (int(sky_rows[-1]) + 1 if len(sky_rows) else 0)
        radiance = np.empty((height, width, 3), dtype=np.float32)
        self._draw_ground(view, ground, shadows, radiance[ground.first_row :], labels)
        if last_row:
            background = draw_background(view, scene.light, scene.backdrop, last_row)
            radiance[: ground.first_row] = background[: ground.first_row]
            # The ground's far rows fade into the background of the same pixels.
            rows = slice(ground.first_row, last_row)
            part = slice(0, last_row - ground.first_row)
            clear = np.exp(ground.depth_m[part] * np.float32(-1.0 / scene.backdrop.haze_m))
            clear = np.where(ground.below[part], clear, 0)[..., None]
            radiance[rows] = background[rows] + clear * (radiance[rows] - background[rows])
        return radiance

    def _draw_ground(
        self,
        view: View,
        ground: GroundField,
        shadows: Sequence[ShadowLayer],
        albedo: Float32,
        labels: NDArray[np.uint8],
    ) -> None:
        """Write the ground's radiance to ``albedo`` (H', W, 3), which is its reflectance on the way there."""
        scene = self.scene
        bare = on_ground.tone(scene.ground, ground)
        kernels.spread(bare, on_ground.float32s(np.array(scene.ground.albedo_bgr)), _rows(albedo))
        self._paint.draw(view, ground, _rows(albedo), labels)
        sun = on_ground.sun_visibility(shadows, scene.shades, view, ground)
        wet = on_ground.wetness(scene.ground, ground)
        centre = on_ground.float32s(np.append(view.centre_map[:2], view.height_m))
        if ground.slope is not None:
            east, north, up = scene.light.sun_direction_map
            sun *= np.maximum(1 - (ground.slope[0] * east + ground.slope[1] * north) / max(up, 0.1), 0)
        light = scene.light
        height = max(light.sun_direction_map[2], 0.0)
        lights = np.array([[s * height for s in light.sun_bgr], light.sky_bgr, light.horizon_bgr])
        places = ground.x_m, ground.y_m
        kernels.light_ground(_rows(albedo), sun, *wet, places, centre, on_ground.float32s(lights))


_CODE_STEPS = 16384  # number of levels of linear light that the table of sRGB codes tells apart
_FLOW_STEP_PX = 16  # distance of the pixels at which image flow is evaluated
_NOISE_SHIFT_PX = 256  # largest shift of the window that cuts an image's noise out of the field of noise


@dataclass(frozen=True, kw_only=True)
class Optics:
    """Lens and sensor. Levels are fractions of the sensor's saturation.

    ``psf_sigma_px`` is the lens blur, ``vignetting`` the loss of light at the image corners, ``mean_level``
    what the automatic exposure aims at for the mean of the ground, ``full_well_electrons`` sets the shot
    noise, ``read_noise`` the noise in the dark. ``white_balance_bgr`` multiplies the channels.
    """

    psf_sigma_px: float = 0.65
    vignetting: float = 0.2
    mean_level: float = 0.24
    full_well_electrons: float = 9000.0
    read_noise: float = 0.0015
    white_balance_bgr: tuple[float, float, float] = (1.0, 1.0, 1.0)
    grey: bool = False


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The camera's motion in its own frame: m/s, rad/s, s; its pose is of the middle of the exposure."""

    velocity_cam: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angular_velocity_cam: tuple[float, float, float] = (0.0, 0.0, 0.0)
    exposure_s: float = 0.0


def expose(image: Float32, optics: Optics, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The recorded image (H, W, 3) uint8 of the radiance (H, W, 3) that reaches the lens."""
    if optics.psf_sigma_px > 0:
        image = _float32(cv2.GaussianBlur(image, (0, 0), optics.psf_sigma_px))
    height, width = image.shape[:2]
    gain = optics.mean_level / max(float(image[height // 3 :: 4, ::4].mean()), 1e-6)
    balance = (gain * np.array(optics.white_balance_bgr)).astype(np.float32)
    falloff = _vignette(height, width, optics.vignetting)
    if optics.grey:
        grey = cv2.cvtColor(image * balance * falloff[..., None], cv2.COLOR_BGR2GRAY)
        image = np.repeat(grey[..., None], 3, axis=2)
        balance = np.ones_like(balance)
        falloff = np.ones_like(falloff)
    out = np.empty(image.shape, dtype=np.uint8)
    row, column = (int(n) for n in rng.integers(0, _NOISE_SHIFT_PX, 2))
    field = _normal_field(height + _NOISE_SHIFT_PX, width + _NOISE_SHIFT_PX)
    levels = np.empty((1, 3 * width), dtype=np.int32)
    per_electron = np.float32(1.0 / optics.full_well_electrons)
    dark = np.float32(optics.read_noise**2)
    noise = (_rows(field), row, column)
    kernels.record(
        _rows(image), balance, falloff, noise, per_electron, dark, _srgb_codes(), levels, _rows(out)
    )
    return out


def _float32(array: NDArray[Any]) -> Float32:
    """OpenCV's result under the type it has."""
    return np.asarray(array, dtype=np.float32)


def _motion_blur(radiance: Float32, view: View, motion: Motion) -> Float32:
    """Mean of three images displaced along the image flow over the exposure, symmetric about its middle."""
    if motion.exposure_s <= 0:
        return radiance
    flow = _flow(view, motion)
    share = np.float32(motion.exposure_s / 3.0)
    if cv2.norm(flow, cv2.NORM_INF) * share < 0.02:
        return radiance
    out = np.empty_like(radiance)
    moved = np.empty((4, flow.shape[1]), dtype=np.int32)
    kernels.blur_along(_rows(radiance), _rows(flow), share, moved, _rows(out))
    return out


def _rows(image: NDArray[Any]) -> NDArray[Any]:
    """An image (H, W, channels) as a plane (H, channels W)."""
    return image.reshape(len(image), -1)


def _flow(view: View, motion: Motion) -> Float32:
    """Image flow (H, W, 2) in px/s of ground and sky (Longuet-Higgins and Prazdny 1980), by coarse grid.

    Distortion is taken as locally constant; blur lengths of a few pixels do not see the difference.
    """
    rays = view.rays
    k = rays.info.intrinsic
    step = _FLOW_STEP_PX
    x = (rays.u_pinhole_px[::step, ::step] - k[0, 2]) / k[0, 0]
    y = (rays.v_pinhole_px[::step, ::step] - k[1, 2]) / k[1, 1]
    _, by_x, by_y = view.beneath
    up_cam = view.cam_from_map[:3, :3] @ [-by_x, -by_y, 1.0]
    inverse_depth = np.maximum(-(up_cam[0] * x + up_cam[1] * y + up_cam[2]) / view.height_m, 0.0)
    vx, vy, vz = motion.velocity_cam
    wx, wy, wz = motion.angular_velocity_cam
    flow_x = (x * vz - vx) * inverse_depth + x * y * wx - (1 + x * x) * wy + y * wz
    flow_y = (y * vz - vy) * inverse_depth + (1 + y * y) * wx - x * y * wy - x * wz
    coarse = np.stack([flow_x * k[0, 0], flow_y * k[1, 1]], axis=-1).astype(np.float32)
    height, width = rays.u_pinhole_px.shape
    rows, columns = coarse.shape[:2]
    full = cv2.resize(coarse, (columns * step, rows * step), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(full[:height, :width], dtype=np.float32)


@lru_cache(maxsize=4)
def _normal_field(height: int, width: int) -> Float32:
    """Normal numbers, of which a window placed at random is the noise of an image."""
    return np.random.default_rng(20).standard_normal((height, width, 3), dtype=np.float32)


@lru_cache(maxsize=4)
def _vignette(height: int, width: int, loss: float) -> Float32:
    v, u = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    return np.asarray(1.0 - loss * 0.5 * (u * u + v * v), dtype=np.float32)


@cache
def _srgb_codes() -> NDArray[np.uint8]:
    """The 8-bit sRGB code (IEC 61966-2-1) of each step of linear level."""
    level = np.linspace(0.0, 1.0, _CODE_STEPS)
    coded = np.where(level <= 0.0031308, 12.92 * level, 1.055 * level ** (1 / 2.4) - 0.055)
    return np.asarray(np.round(coded * 255), dtype=np.uint8)
