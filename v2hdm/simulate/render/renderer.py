"""The renderer: a scene, a camera and its place in; an image and its class labels out.

Everything is computed per pixel in linear light: the ray meets the ground, textures and paint are looked
up there, sun and shadow multiply them, boxes are drawn over it, then lens and sensor do their work. Shapes
are anti-aliased by their exact signed distance, so that the 50 % point of an edge is where truth puts it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.records import CameraInfo, FloatArray
from v2hdm.simulate.render.box_layer import draw_boxes
from v2hdm.simulate.render.ground_layer import GroundField, intersect_ground, sun_visibility, tone, wetness
from v2hdm.simulate.render.optics import Motion, Optics, expose
from v2hdm.simulate.render.paint_layer import PaintLayer
from v2hdm.simulate.render.scene import Box, Light, Scene, Shadow, box_shadow
from v2hdm.simulate.render.sky_layer import draw_background
from v2hdm.simulate.render.textures import Float32
from v2hdm.simulate.render.view import View, camera_rays

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
    _shadows: tuple[Shadow, ...] = field(init=False)

    def __post_init__(self) -> None:
        self._paint = PaintLayer(self.scene.paints, self.classes)
        cast = tuple(box_shadow(box, self.scene.light) for box in self.scene.boxes)
        self._shadows = self.scene.shadows + cast

    def render(
        self,
        info: CameraInfo,
        cam_from_map: FloatArray,
        rng: np.random.Generator,
        optics: Optics | None = None,
        motion: Motion | None = None,
        moving_boxes: tuple[Box, ...] = (),
    ) -> Rendered:
        """Render one image.

        Args:
            info: The camera, lens distortion included; any size.
            cam_from_map: Where it is, at the middle of the exposure.
            rng: Source of the sensor noise; the picture is a function of its state.
            optics: Lens and sensor.
            motion: Motion during the exposure.
            moving_boxes: What stands in the scene for this image only.
        """
        view = View(camera_rays(info), np.asarray(cam_from_map, dtype=np.float64))
        labels = np.zeros((info.height, info.width), dtype=np.uint8)
        hidden = np.zeros((info.height, info.width), dtype=np.bool_)
        boxes = self.scene.boxes + moving_boxes
        shadows = self._shadows + tuple(box_shadow(box, self.scene.light) for box in moving_boxes)
        radiance = self._surroundings(view, shadows, labels)
        draw_boxes(boxes, self.scene.light, view, radiance, hidden)
        labels[hidden] = 0
        image = expose(radiance, view, optics or Optics(), motion or Motion(), rng)
        return Rendered(image, labels, hidden)

    def _surroundings(self, view: View, shadows: tuple[Shadow, ...], labels: NDArray[np.uint8]) -> Float32:
        """Radiance (H, W, 3) of sky and ground."""
        scene = self.scene
        height, width = labels.shape
        ground = intersect_ground(view)
        if ground is None:
            return draw_background(view, scene.light, scene.backdrop, height)
        sky_rows = np.flatnonzero(~ground.below.all(axis=1))
        last_row = ground.first_row + (int(sky_rows[-1]) + 1 if len(sky_rows) else 0)
        radiance = np.empty((height, width, 3), dtype=np.float32)
        radiance[ground.first_row :] = self._ground(view, ground, shadows, labels)
        if last_row:
            background = draw_background(view, scene.light, scene.backdrop, last_row)
            radiance[: ground.first_row] = background[: ground.first_row]
            _haze(radiance, background, ground, last_row, scene.backdrop.haze_m)
        return radiance

    def _ground(
        self, view: View, ground: GroundField, shadows: tuple[Shadow, ...], labels: NDArray[np.uint8]
    ) -> Float32:
        scene = self.scene
        bare = tone(scene.ground, ground)
        albedo = [bare * np.float32(c) for c in scene.ground.albedo_bgr]
        self._paint.draw(view, ground, albedo, labels)
        sun = sun_visibility(shadows, scene.dapples, view, ground)
        return _lit(albedo, sun, wetness(scene.ground, ground), ground, view, scene.light)


def render(
    scene: Scene,
    info: CameraInfo,
    cam_from_map: FloatArray,
    rng: np.random.Generator,
    optics: Optics | None = None,
    motion: Motion | None = None,
) -> Rendered:
    """Render one image of a scene; see :meth:`Renderer.render`."""
    return Renderer(scene).render(info, cam_from_map, rng, optics, motion)


def _lit(
    albedo: list[Float32], sun: Float32, wet: Float32 | None, ground: GroundField, view: View, light: Light
) -> Float32:
    """Ground radiance (H', W, 3): Lambert's law under sun and sky; water darkens and mirrors the sky."""
    height = max(light.sun_direction_map[2], 0.0)
    mirror = None if wet is None else wet * _fresnel(ground, view)
    for plane, s, d, horizon in zip(albedo, light.sun_bgr, light.sky_bgr, light.horizon_bgr, strict=True):
        plane *= sun * np.float32(s * height) + np.float32(d)
        if wet is not None and mirror is not None:
            plane *= np.float32(1.0) - np.float32(0.45) * wet
            plane += mirror * np.float32(horizon)
    return np.asarray(cv2.merge(albedo), dtype=np.float32)


def _fresnel(ground: GroundField, view: View) -> Float32:
    """Part (H', W) of the sky's light that a rough film of water mirrors (after Schlick 1994)."""
    centre = view.centre_map.astype(np.float32)
    range_squared = (ground.x_m - centre[0]) ** 2 + (ground.y_m - centre[1]) ** 2
    sine = centre[2] / np.sqrt(range_squared + centre[2] ** 2)
    grazing = np.float32(1.0) - np.maximum(sine, np.float32(0.12))
    squared = grazing * grazing
    return np.asarray(np.float32(0.02) + np.float32(0.45) * squared * squared * grazing)


def _haze(radiance: Float32, background: Float32, ground: GroundField, last_row: int, haze_m: float) -> None:
    """Let the ground's far rows fade into the background of the same pixels."""
    rows = slice(ground.first_row, last_row)
    part = slice(0, last_row - ground.first_row)
    clear = np.exp(ground.depth_m[part] * np.float32(-1.0 / haze_m))
    clear = np.where(ground.below[part], clear, 0)[..., None]
    radiance[rows] = background[rows] + clear * (radiance[rows] - background[rows])
