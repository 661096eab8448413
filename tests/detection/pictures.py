"""Pictures of known markings, and detector models made by hand, for the tests of this folder.

``picture`` draws convex shapes on the ground by exact area coverage: 8 x 8 samples a pixel through the
lens, a Gaussian point spread, noise, sRGB coding. It shares no code with the package's renderer or fits.
"""

import json
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from tests.cameras import mounted
from v2hdm.catalogue import PAINT_CLASSES, SHIPPED
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.evidence import rectified_views
from v2hdm.detection.lanes.curves import LaneImage
from v2hdm.detection.lanes.lines import find_boundaries
from v2hdm.detection.network import AnchorRow, NetworkOutput
from v2hdm.detection.quads.patch import ImageQuads, Patches
from v2hdm.geometry.ipm import apply_homography, ipm_from_extrinsic
from v2hdm.geometry.lens import distort_points, undistort_points
from v2hdm.geometry.planar import Quad, order_corners
from v2hdm.records import DIAMOND, LANE_DASH, Camera, CameraInfo, LaneDetection

HEIGHT, WIDTH = 360, 640
LENSES = {
    "pinhole": ("plumb_bob", (0.0, 0.0, 0.0, 0.0, 0.0)),
    "plumb_bob": ("plumb_bob", (-0.12, 0.03, 0.0005, -0.0004, 0.0)),
    "rational_polynomial": ("rational_polynomial", (0.2, -0.05, 0.0004, 0.0003, 0.01, 0.3, -0.02, 0.005)),
    "equidistant": ("equidistant", (0.02, -0.01, 0.004, -0.001)),
}


def extrinsic(height_m: float = 2.2, pitch_deg: float = 14.0, forward_m: float = 1.0) -> np.ndarray:
    """``cam_from_vehicle`` of a camera that looks ahead and down."""
    return mounted([forward_m, 0.0, height_m], pitch_deg)


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


def output_of(odds: np.ndarray, kinds: np.ndarray | None = None) -> NetworkOutput:
    """Log odds (h, w) of paint all over an image, 2 px apart; nobody knows its classes unless told."""
    if kinds is None:
        kinds = np.zeros((len(PAINT_CLASSES), odds.shape[0] // 2, odds.shape[1] // 2), dtype=np.float32)
    return NetworkOutput.of(odds, kinds, [], tuple(PAINT_CLASSES), 2, 0)


def patches_of(
    image: np.ndarray, camera: RoadCamera, output: NetworkOutput, corners_px: np.ndarray
) -> Patches:
    """The pixels about markings (M, 4, 2), none of which is other markings' paint."""
    none = np.zeros((len(corners_px), 2), dtype=np.intp)
    return Patches(image, camera, output, np.zeros(output.paint.shape, np.int16), none)


def view_of(
    image: np.ndarray, camera: RoadCamera, output: NetworkOutput, corners_px: np.ndarray, kind: str
) -> np.ndarray:
    """The view (C, 20, 20) of a quadrilateral (4, 2) as one class."""
    corners_px = corners_px[None]
    quads, ground = ImageQuads.of(camera, corners_px), Quad(camera.unproject(corners_px))
    patches = patches_of(image, camera, output, corners_px)
    return rectified_views(patches, quads, ground, [(0, kind)], SHIPPED)[0][0]


def crisp_view(kind: str) -> np.ndarray:
    """A marking (C, 20, 20) as its own frame should show it: bright, of its class, and nothing about it."""
    camera = make_camera("pinhole")
    shape = diamond(6.0, 0.0) if kind == DIAMOND else bar(6.0, 0.0, 2.0, 0.4)
    corners_px = order_corners(to_image(camera, shape))
    inside = np.zeros((HEIGHT // 2, WIDTH // 2), dtype=np.float32)
    cv2.fillConvexPoly(inside, np.round(corners_px / 2).astype(np.int32), 1.0)
    kinds = np.zeros((len(PAINT_CLASSES), HEIGHT // 4, WIDTH // 4), dtype=np.float32)
    kinds[PAINT_CLASSES.index(kind)] = 8.0
    output = output_of(12 * inside - 6, kinds)
    return view_of(picture(camera, [shape]), RoadCamera(camera, 16), output, corners_px, kind)


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


def boundaries_of(
    rows: list[AnchorRow],
    view: RoadCamera,
    paint: Sequence[LaneDetection] = (),
    output: NetworkOutput | None = None,
) -> list[LaneDetection]:
    """The boundaries of lanes found from row anchors, paint and, if it is known, the network's output."""
    return find_boundaries(LaneImage(view, rows, paint, output))


def anchors_of(view: RoadCamera, lines_px: list[np.ndarray], hidden: slice = slice(0, 0)) -> list[AnchorRow]:
    """A perfect network's anchors of lines (N, 2), near to far, except the ``hidden`` ones."""
    rows = []
    for v in np.arange(view.info.height - 4.5, view.top, -STRIDES["lanes"]):
        u = []
        for line in lines_px:
            order = np.argsort(line[:, 1])
            u.append(np.interp(v, line[order, 1], line[order, 0], left=np.nan, right=np.nan))
        columns = np.array([x for x in u if 0 <= x < view.info.width])
        if len(columns):
            rows.append(AnchorRow(float(v), columns, np.full(len(columns), 4.0)))
    del rows[hidden]
    return rows


def straight(view: RoadCamera, left_m: float, curvature: float = 0.0) -> np.ndarray:
    along = np.arange(4.0, 40.0, 0.25)
    points = np.column_stack([along, left_m + 0.5 * curvature * along**2])
    return to_image(view.camera, points)


def painted(line_px: np.ndarray, view: RoadCamera, near_m: float, far_m: float) -> LaneDetection:
    """The centre line of a line's paint (N, 2) between two distances, a point every half a metre."""
    x = view.ground(view.undistort(line_px))[:, 0]
    is_visible = (x >= near_m) & (x <= far_m) & view.inside(line_px, 0)
    return LaneDetection(LANE_DASH, 0.9, line_px[is_visible][::2])


def off_px(lane: LaneDetection, line_px: np.ndarray) -> np.ndarray:
    """How far the points of a lane are from a true line along their rows, as far as that goes."""
    order = np.argsort(line_px[:, 1])
    u, v = lane.points_px.T
    off = np.interp(v, line_px[order, 1], line_px[order, 0], left=np.nan, right=np.nan) - u
    return off[np.isfinite(off)]


def painted_on(view: RoadCamera, lines_px: list[np.ndarray]) -> NetworkOutput:
    """Log odds of paint of 5 on lines (N, 2) and of -5 elsewhere."""
    odds = np.full((view.info.height // 2, view.info.width // 2), -5.0, dtype=np.float32)
    for line_px in lines_px:
        at = np.linspace(0, len(line_px) - 1, 16 * len(line_px))
        for u, v in zip(
            *(np.interp(at, np.arange(len(line_px)), line_px[:, k]) for k in (0, 1)), strict=True
        ):
            if 0 <= u < view.info.width and 0 <= v < view.info.height:
                odds[int(v / 2), max(int(u / 2) - 2, 0) : int(u / 2) + 3] = 5.0
    return output_of(odds)
