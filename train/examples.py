"""Rendered images with what there is to be found in them, which no training ever showed.

Full 1280 x 720 images of ports and streets, in any light and state of wear, with their true markings and
lanes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from train.config import DataConfig
from train.labels import Place, paint_labels
from train.labels_image import ANY, LabelledImage
from train.labels_tone import paint_rectangle
from train.scenes.hardships import NONE, Hardships
from train.scenes.scenes import drawn_scene, image_line, image_points
from train.scenes.views import TrainingView
from v2hdm.catalogue import CORNERED_CLASSES, NOT_PAINT, PAINT_CLASSES, SHIPPED, SYMBOL
from v2hdm.detection.camera import camera_from_calibration, rough_calibration
from v2hdm.errors import ConfigError
from v2hdm.geometry.ipm import apply_homography, ipm_from_extrinsic
from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.planar import clip_convex, clip_half, inside_convex, signed_area
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import BoolArray, Camera, FloatArray
from v2hdm.simulate.render.renderer import Rendered
from v2hdm.simulate.render.scene import Paint, Scene

SEED = 771_000_003
"""No training or validation seed, whatever their index: those start from single-digit seeds."""

WIDTH = 1280  # columns of a rendered image
HEIGHT = 720  # rows of a rendered image
MAX_RANGE_M = 20.0  # distance, m, beyond which a marking need not be found
WHOLE_SHARE = 0.97
"""A marking counts as wholly seen when this share of its area is; others may be found or not."""

TOUCHING_PX = 2  # width of the seam around a marking in which other paint touches it, px
TOUCHED_SHARE = 0.05
"""Other paint touches a marking if it holds more than this share of a seam of so many px around it."""

NEAREST_M = 0.3  # least depth, m, of ground whose markings are known
_FRAME_PX = np.array([[-1.0, -1.0], [2.0, -1.0], [2.0, 2.0], [-1.0, 2.0]]) * (WIDTH, HEIGHT)
"""Markings are known to be there as far as they lie before the camera and about the image."""

MIN_HEIGHT_PX = 4.0  # least height in the image, px, of a marking that is to be found
LEAST_SHOWN_M = 1.0
"""A line shows if so much of its paint is in the image and in front of what stands there; who labels images
cannot know of others. Those parts of such a line that are hidden or between its dashes are asked for."""

LANE_TOLERANCE_PX = 20.0
"""A point of a line is on a true line within this, across it."""

_MOUNTING_SIGMA = 0.1  # standard deviation of a photograph's camera height, as a share of it
_PITCH_SIGMA_DEG = 0.7
"""How well the mounting of a photograph's camera is taken to be known: share of its height, and pitch."""

_STATION_M = 0.5  # distance between the places on a line at which its paint is looked for, m
_BESIDE_M = np.linspace(-0.5, 0.5, 21)
"""Paint this far beside a line's middle is its own: those of double lines are."""


@dataclass(frozen=True)
class TrueMarking:
    """One painted quadrilateral or symbol in an image; ``fair`` if it must be found, else it may be."""

    kind: str
    polygon_px: FloatArray
    range_m: float
    fair: bool

    @property
    def narrow_px(self) -> float:
        """The narrow side of the smallest rectangle around it."""
        return float(min(cv2.minAreaRect(self.polygon_px.astype(np.float32))[1]))


@dataclass(frozen=True)
class Example:
    """An image with its camera and truth.

    Of a photograph not all is known: ``unknown`` (H, W) bool is where nobody knows of paint, and markings of
    ``silent`` classes may be missing.
    """

    image: np.ndarray
    camera: Camera
    markings: list[TrueMarking]
    lanes_px: list[FloatArray]
    lanes_shown: list[bool] = field(default_factory=list)
    unknown: BoolArray | None = None
    silent: tuple[str, ...] = ()


def example(index: int, difficulty: float = 1.0, seed: int = SEED, hardships: Hardships = NONE) -> Example:
    """Example ``index`` of the fixed set, or of that of another ``seed`` or with ``hardships``."""
    drawn = drawn_scene(np.random.default_rng([seed, index]), WIDTH, HEIGHT, difficulty, hardships)
    return example_of(drawn.scene, drawn.lanes_map, drawn.view, drawn.rendered, camera_of(drawn.view))


def photograph(image: LabelledImage, config: DataConfig, rng: np.random.Generator) -> Example:
    """The truth of a labelled photograph, over a camera mounted about as ``config.coco_camera`` says.

    Raises:
        DriveError: the image cannot be read.
        ConfigError: nobody says how the camera is mounted.
    """
    if config.coco_camera is None:
        raise ConfigError("data.coco_camera: say how the camera of the labelled images is mounted, about")
    pixels = image.pixels()
    height, width = pixels.shape[:2]
    up_m, pitch_deg, fov_deg = config.coco_camera
    up_m *= float(np.exp(rng.normal(0, _MOUNTING_SIGMA)))
    pitch_deg += rng.normal(0, _PITCH_SIGMA_DEG)
    camera = camera_from_calibration(rough_calibration("photo", width, height, up_m, pitch_deg, fov_deg))
    labels, unknown = paint_labels(image, Place.whole(width, height))
    names = (*CORNERED_CLASSES, *SHIPPED.of_family(SYMBOL))
    silent = [k for k in PAINT_CLASSES if config.coco_complete is not None and k not in config.coco_complete]
    markings = []
    for shape in image.shapes or ():
        if NOT_PAINT in shape.kinds:
            continue
        kind = shape.kinds[0] if shape.kinds[0] in names else ANY
        thin_px = paint_rectangle(shape.tone) if shape.tone is not None and kind != ANY else None
        for ring_px in shape.rings_px if thin_px is None else (thin_px,):
            # Where labels are silent on a class they do not tell it from others either.
            markings.append(TrueMarking(kind, ring_px, np.nan, kind != ANY and kind not in silent))
    return Example(pixels, camera, markings, [], [], unknown & (labels == 0), tuple(silent))


def example_of(
    scene: Scene, lanes_map: list[FloatArray], view: TrainingView, rendered: Rendered, camera: Camera
) -> Example:
    """The ground truth of an image of a scene, whose lines (N, 2) have a point every half metre."""
    lines_px = [image_line(view, lane) for lane in lanes_map]
    visible_lanes = [lane for lane, line_px in zip(lanes_map, lines_px, strict=True) if len(line_px) > 1]
    lanes_px = [line_px for line_px in lines_px if len(line_px) > 1]
    lanes_shown = [_shows(lane, view, rendered) for lane in visible_lanes]
    return Example(rendered.image, camera, _markings(scene, view, rendered), lanes_px, lanes_shown)


def _shows(lane_map: FloatArray, view: TrainingView, rendered: Rendered) -> bool:
    """Whether enough paint of a line (N, 2), a point every half metre, is to be seen in the image."""
    ahead = np.gradient(lane_map, axis=0)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.linalg.norm(ahead, axis=1, keepdims=True)
    kinds = [PAINT_CLASSES.index(kind) + 1 for kind in SHIPPED.lane_paint]
    shown = 0
    for point, across in zip(lane_map, left, strict=True):
        u, v = np.round(image_points(view, point + _BESIDE_M[:, None] * across)).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < WIDTH) & (v < HEIGHT)
        shown += bool(np.isin(rendered.labels[v[inside], u[inside]], kinds).any())
    return shown * _STATION_M >= LEAST_SHOWN_M


def camera_of(view: TrainingView) -> Camera:
    """The true camera of a rendered view."""
    ipm = ipm_from_extrinsic(view.info, view.cam_from_map)
    middle = apply_homography(ipm, np.array([[WIDTH / 2, HEIGHT - 1.0]]))
    square = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
    return Camera(view.info, {"true": ipm}, "true", middle + square)


def _markings(scene: Scene, view: TrainingView, rendered: Rendered) -> list[TrueMarking]:
    """The scene's paint by piece; pieces that belong together (arrows, chevrons) are judged as one."""
    centre = camera_centre(view.cam_from_map)
    out = []
    for paint in whole_ones(scene.paints):
        if paint.kind not in CORNERED_CLASSES + SHIPPED.of_family(SYMBOL):
            continue
        polygon = np.asarray(paint.polygon_map, dtype=np.float64)
        polygon = _before_camera(polygon, view)
        cam = polygon @ view.cam_from_map[:3, :2].T + view.cam_from_map[:3, 3]
        pinhole = (cam @ view.info.intrinsic.T)[:, :2] / cam[:, 2:]
        pinhole = clip_convex(pinhole, _FRAME_PX) if len(polygon) else pinhole
        if len(pinhole) < 3:
            continue
        polygon_px = distort_points(view.info, pinhole)
        range_m = float(np.linalg.norm(polygon.mean(axis=0) - centre[:2]))
        whole = _seen_alone(polygon_px, PAINT_CLASSES.index(paint.kind) + 1, rendered)
        tall = float(np.ptp(polygon_px[:, 1])) >= MIN_HEIGHT_PX
        fair = whole and tall and range_m <= MAX_RANGE_M and paint.wear <= 0.4
        out.append(TrueMarking(paint.kind, polygon_px, range_m, fair and paint.kind in CORNERED_CLASSES))
    return out


def whole_ones(paints: Sequence[Paint]) -> list[Paint]:
    """These paints, of hollow markings their outlines alone, as worn as the most worn of their strokes."""
    out: list[Paint] = []
    hollow = None
    for paint in paints:
        if hollow and paint.kind == hollow.kind and inside_convex(hollow.polygon_map, _middle(paint)):
            worst = paint.wear if out[-1] is hollow else max(paint.wear, out[-1].wear)
            out[-1] = replace(hollow, wear=worst)
            continue
        out.append(paint)
        hollow = paint if paint.wear == 1.0 else None
    return out


def _middle(paint: Paint) -> FloatArray:
    return np.asarray(paint.polygon_map.mean(axis=0))


def _before_camera(polygon_map: FloatArray, view: TrainingView) -> FloatArray:
    """The part of a ground polygon (N, 2) that lies before the camera."""
    depth = polygon_map @ view.cam_from_map[2, :2] + view.cam_from_map[2, 3]
    return clip_half(polygon_map, depth - NEAREST_M)


def _seen_alone(polygon_px: FloatArray, label: int, rendered: Rendered) -> bool:
    """Whether a polygon is wholly seen, border of the image included, and no other paint touches it.

    Where paint runs into other paint there is no outline to be found.
    """
    low = np.floor(polygon_px.min(axis=0)).astype(int) - TOUCHING_PX
    high = np.ceil(polygon_px.max(axis=0)).astype(int) + 1 + TOUCHING_PX
    size = high - low
    mask = np.zeros((size[1], size[0]), dtype=np.uint8)
    cv2.fillConvexPoly(mask, np.round((polygon_px - low) * 16).astype(np.int32), 1, shift=4)
    around = cv2.dilate(mask, np.ones((2 * TOUCHING_PX + 1,) * 2, np.uint8)) - mask
    mask = cv2.erode(mask, np.ones((3, 3), np.uint8), borderValue=0) if mask.sum() > 200 else mask
    return _share(mask, low, rendered, (label,)) >= WHOLE_SHARE and (
        _share(around, low, rendered, range(1, len(PAINT_CLASSES) + 1)) <= TOUCHED_SHARE
    )


def _share(mask: np.ndarray, low: np.ndarray, rendered: Rendered, labels: Iterable[int]) -> float:
    """Share of a mask's pixels, placed at ``low``, that show one of the labels; 0 if some are outside."""
    v, u = np.nonzero(mask)
    u = u + low[0]
    v = v + low[1]
    inside = (u >= 0) & (v >= 0) & (u < WIDTH) & (v < HEIGHT)
    if not len(u) or not inside.all():
        return 0.0
    return float(np.isin(rendered.labels[v, u], list(labels)).mean())


def polygon_overlap(first: FloatArray, second: FloatArray) -> float:
    """Intersection over union of the hulls of two polygons."""
    if (first.max(axis=0) < second.min(axis=0)).any() or (second.max(axis=0) < first.min(axis=0)).any():
        return 0.0
    a, b = (cv2.convexHull(p.astype(np.float32))[:, 0].astype(np.float64) for p in (first, second))
    common, first_area, second_area = (abs(float(signed_area(p))) for p in (clip_convex(a, b), a, b))
    return common / max(first_area + second_area - common, 1e-6)
