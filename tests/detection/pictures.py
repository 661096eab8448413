"""Pictures of known markings, and detector models made by hand, for the tests of this folder.

``picture`` draws convex shapes on the ground by exact area coverage: 8 x 8 samples a pixel through the
lens, a Gaussian point spread, noise, sRGB coding. It shares no code with the package's renderer or fits.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from v2hdm.catalogue import PAINT_CLASSES, SHIPPED
from v2hdm.detection.camera import CameraView
from v2hdm.detection.evidence import rectified_views
from v2hdm.detection.network import Foreground
from v2hdm.detection.patch import Quads
from v2hdm.geometry.ipm import apply_homography, ipm_from_extrinsic
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.geometry.quadrilateral import order_corners
from v2hdm.records import DIAMOND, Camera, CameraInfo

HEIGHT, WIDTH = 360, 640
OPTICAL_FROM_LEVEL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
LENSES = {
    "pinhole": ("plumb_bob", (0.0, 0.0, 0.0, 0.0, 0.0)),
    "plumb_bob": ("plumb_bob", (-0.12, 0.03, 0.0005, -0.0004, 0.0)),
    "rational_polynomial": ("rational_polynomial", (0.2, -0.05, 0.0004, 0.0003, 0.01, 0.3, -0.02, 0.005)),
    "equidistant": ("equidistant", (0.02, -0.01, 0.004, -0.001)),
}


def extrinsic(height_m: float = 2.2, pitch_deg: float = 14.0, forward_m: float = 1.0) -> np.ndarray:
    """``cam_from_vehicle`` of a camera that looks ahead and down."""
    c, s = np.cos(np.deg2rad(pitch_deg)), np.sin(np.deg2rad(pitch_deg))
    rotation = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ OPTICAL_FROM_LEVEL
    cam_from_vehicle = np.eye(4)
    cam_from_vehicle[:3, :3] = rotation
    cam_from_vehicle[:3, 3] = -rotation @ [forward_m, 0.0, height_m]
    return cam_from_vehicle


def make_camera(lens: str = "plumb_bob", name: str = "front", **mounting: float) -> Camera:
    """A 640 x 360 camera, f = 520 px."""
    model, coefficients = LENSES[lens]
    intrinsic = np.array([[520.0, 0.0, 321.0], [0.0, 522.0, 179.0], [0.0, 0.0, 1.0]])
    info = CameraInfo(name, WIDTH, HEIGHT, intrinsic, model, coefficients)
    roi = np.array([[4.0, -3.0], [12.0, -3.0], [12.0, 3.0], [4.0, 3.0]])
    return Camera(info, {"calibrated": ipm_from_extrinsic(info, extrinsic(**mounting))}, "calibrated", roi)


def to_image(camera: Camera, points_vehicle: np.ndarray) -> np.ndarray:
    """Ground points (N, 2) as recorded pixels."""
    pinhole_px_from_vehicle = np.linalg.inv(camera.ipm[camera.initial_ipm])
    return distort_points(camera.info, apply_homography(pinhole_px_from_vehicle, points_vehicle))


def foreground_of(odds: np.ndarray, owner: np.ndarray, top: int) -> Foreground:
    """Log odds (h, w) of paint and its owners, 2 px apart; what class it is of nobody knows."""
    kinds = np.zeros((len(PAINT_CLASSES), odds.shape[0] // 2, odds.shape[1] // 2), dtype=np.float32)
    return Foreground(odds, owner, 2, top, kinds, tuple(PAINT_CLASSES))


def crisp_view(kind: str) -> np.ndarray:
    """A marking (C, 20, 20) as its own frame should show it: bright, of its class, and nothing about it."""
    camera = make_camera("pinhole")
    shape = diamond(6.0, 0.0) if kind == DIAMOND else bar(6.0, 0.0, 2.0, 0.4)
    corners_px = order_corners(to_image(camera, shape))[None]
    inside = np.zeros((HEIGHT // 2, WIDTH // 2), dtype=np.float32)
    cv2.fillConvexPoly(inside, np.round(corners_px[0] / 2).astype(np.int32), 1.0)
    blank = foreground_of(12 * inside - 6, inside.astype(np.int16), 0)
    kinds = np.zeros_like(blank.kinds)
    kinds[PAINT_CLASSES.index(kind)] = 8.0
    view = CameraView(camera, 16)
    ground = view.ground(view.undistort(corners_px[0]))[None]
    image = picture(camera, [shape])
    return rectified_views(
        image, view, replace(blank, kinds=kinds), Quads.seen(view, corners_px), ground, [kind], SHIPPED
    )[0][0]


def diamond(
    x: float, y: float, length: float = 1.2, breadth: float = 0.6, yaw_deg: float = 0.0
) -> np.ndarray:
    """A rhombus (4, 2) on the ground, counter-clockwise seen from above."""
    return _turned(np.array([[length, 0], [0, breadth], [-length, 0], [0, -breadth]]) / 2, x, y, yaw_deg)


def bar(x: float, y: float, length: float, breadth: float, yaw_deg: float = 0.0) -> np.ndarray:
    """A rectangle (4, 2) on the ground, counter-clockwise seen from above."""
    corners = np.array([[length, -breadth], [length, breadth], [-length, breadth], [-length, -breadth]]) / 2
    return _turned(corners, x, y, yaw_deg)


def _turned(points: np.ndarray, x: float, y: float, yaw_deg: float) -> np.ndarray:
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    return points @ np.array([[c, s], [-s, c]]) + [x, y]


def picture(
    camera: Camera,
    shapes: list[np.ndarray],
    blur_px: float = 0.7,
    noise: float = 0.004,
    seed: int = 0,
    linear: bool = False,
    ground: float = 0.12,
    paint: float = 0.5,
    holes: list[np.ndarray] | None = None,
) -> np.ndarray:
    """An image (H, W, 3) uint8 of convex ``shapes`` painted on the ground; ``holes`` are worn away."""
    coverage = sum(_coverage(camera, shape) for shape in shapes)
    for hole in holes or []:
        coverage = coverage * (1 - _coverage(camera, hole))
    # The pixel's own aperture is in the coverage, so the lens adds the rest of the point spread.
    lens_px = float(np.sqrt(max(blur_px**2 - 1 / 12, 1e-4)))
    radiance = ground + (paint - ground) * cv2.GaussianBlur(coverage, (0, 0), lens_px)
    radiance = np.clip(radiance + np.random.default_rng(seed).normal(0, noise, radiance.shape), 0, 1)
    coded = radiance if linear else _srgb(radiance)
    return np.repeat(np.round(255 * coded).astype(np.uint8)[..., None], 3, axis=2)


def _srgb(radiance: np.ndarray) -> np.ndarray:
    return np.where(
        radiance <= 0.0031308, 12.92 * radiance, 1.055 * np.maximum(radiance, 1e-9) ** (1 / 2.4) - 0.055
    )


def _coverage(camera: Camera, shape: np.ndarray, samples: int = 8) -> np.ndarray:
    corners_px = to_image(camera, shape)
    low = np.maximum(np.floor(corners_px.min(axis=0)).astype(int) - 3, 0)
    high = np.minimum(
        np.ceil(corners_px.max(axis=0)).astype(int) + 4, [camera.info.width, camera.info.height]
    )
    coverage = np.zeros((camera.info.height, camera.info.width))
    if (high <= low).any():
        return coverage
    grid_px = np.stack(np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])), axis=-1).astype(
        float
    )
    pinhole, right, below = (
        undistort_points(camera.info, (grid_px + step).reshape(-1, 2)).reshape(grid_px.shape)
        for step in ([0, 0], [1, 0], [0, 1])
    )
    corners = apply_homography(np.linalg.inv(camera.ipm[camera.initial_ipm]), shape)
    along = np.roll(corners, -1, axis=0) - corners
    normal = np.column_stack(
        [-along[:, 1], along[:, 0]]
    )  # outwards: the order is counter-clockwise on screen
    distance = pinhole @ normal.T - (normal * corners).sum(axis=1)
    by_u, by_v = (right - pinhole) @ normal.T, (below - pinhole) @ normal.T
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    inside = np.zeros(grid_px.shape[:2])
    for u in steps:
        for v in steps:
            inside += (distance + u * by_u + v * by_v <= 0).all(axis=-1)
    coverage[low[1] : high[1], low[0] : high[0]] = inside / samples**2
    return coverage


STRIDES = {"paint": 2, "kinds": 4, "lanes": 8}


@lru_cache
def brightness_model(folder: Path, kind: str = "diamond", threshold: int = 135) -> Path:
    """An ONNX model that calls everything brighter than ``threshold`` paint of class ``kind``."""
    path = folder / f"{kind}_{threshold}.onnx"
    kinds = np.full(len(PAINT_CLASSES), -40.0)
    kinds[PAINT_CLASSES.index(kind)] = 0.0
    save_model(path, (0.1, -0.1 * threshold), kinds)
    return path


def save_model(
    path: Path, paint: tuple[float, float], kinds: np.ndarray, metadata: dict[str, object] | None = None
) -> None:
    """An ONNX model: paint = slope * brightness of 2 x 2 px + offset, the same kinds all over, no lanes."""
    metadata = metadata or {"classes": list(PAINT_CLASSES), "multiple": 16, "strides": STRIDES}
    nodes = [
        helper.make_node("Cast", ["image"], ["real"], to=TensorProto.FLOAT),
        helper.make_node("Transpose", ["real"], ["planes"], perm=[0, 3, 1, 2]),
        helper.make_node("Conv", ["planes", "mean"], ["grey"], strides=[2, 2]),
        helper.make_node("Conv", ["grey", "slope", "offset"], ["paint"]),
        helper.make_node("AveragePool", ["grey"], ["grey4"], kernel_shape=[2, 2], strides=[2, 2]),
        helper.make_node("Conv", ["grey4", "none4", "kind_offset"], ["kinds"]),
        helper.make_node("AveragePool", ["grey4"], ["grey8"], kernel_shape=[2, 2], strides=[2, 2]),
        helper.make_node("Conv", ["grey8", "none8", "lane_offset"], ["lanes"]),
    ]
    weights = {
        "mean": np.full((1, 3, 2, 2), 1 / 12),
        "slope": np.full((1, 1, 1, 1), paint[0]),
        "offset": np.array([paint[1]]),
        "none4": np.zeros((len(kinds), 1, 1, 1)),
        "kind_offset": kinds,
        "none8": np.zeros((2, 1, 1, 1)),
        "lane_offset": np.array([-40.0, 0.0]),
    }
    outputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, channels, f"h_{name}", f"w_{name}"])
        for name, channels in (("paint", 1), ("kinds", len(kinds)), ("lanes", 2))
    ]
    graph = helper.make_graph(
        nodes,
        "brightness",
        [helper.make_tensor_value_info("image", TensorProto.UINT8, [1, "H", "W", 3])],
        outputs,
        [numpy_helper.from_array(value.astype(np.float32), name) for name, value in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, {"v2hdm": json.dumps(metadata)})
    onnx.save(model, path)
