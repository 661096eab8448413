"""Where the corner fit starts."""

import cv2
import numpy as np
import pytest

from tests.detection.pictures import bar, diamond, make_camera, to_image
from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.paint.starts import starting_corners
from v2hdm.records import DIAMOND, LANE_DASH, STOP_LINE

VIEW = CameraView(make_camera("pinhole"))


def outline_of(shape: np.ndarray, noise_px: float) -> np.ndarray:
    """Points on the outline of a shape on the ground, in pixels, each a little off."""
    along = np.linspace(0, 1, 60, endpoint=False)[:, None]
    ground = np.concatenate([shape[e] * (1 - along) + shape[(e + 1) % 4] * along for e in range(4)])
    return to_image(VIEW.camera, ground) + np.random.default_rng(1).normal(0, noise_px, ground.shape)


def area_px2(shape: np.ndarray) -> float:
    """What a shape on the ground covers of the image."""
    return cv2.contourArea(to_image(VIEW.camera, shape).astype(np.float32))


@pytest.mark.parametrize(
    ("kind", "shape"),
    [
        (LANE_DASH, bar(8.0, 1.8, 3.0, 0.15)),
        (LANE_DASH, bar(12.0, -3.0, 4.0, 0.12, 10.0)),
        (STOP_LINE, bar(7.0, 0.0, 0.4, 3.0)),
        (DIAMOND, diamond(7.0, 1.0)),
    ],
)
def test_the_start_is_within_the_reach_of_the_fit(kind, shape):
    outline = outline_of(shape, 0.3)
    corners, cover = starting_corners(kind, outline, VIEW.ground(outline), area_px2(shape), VIEW)
    apart = np.linalg.norm(corners[:, None] - to_image(VIEW.camera, shape), axis=2).min(axis=1)
    assert apart.max() < 5.0
    assert cover > 0.7


def with_fleck(outline: np.ndarray, shape: np.ndarray, wide_m: float) -> tuple[np.ndarray, float]:
    """The outline with a patch of light on its second side, an eighth of it, and the area of both, px^2."""
    start, end, inner = shape[0], shape[1], shape[2]
    out = (end - inner) / np.linalg.norm(end - inner) * wide_m
    patch = np.array([start + 0.3 * (end - start), start + 0.42 * (end - start)])
    patch = np.concatenate([patch, patch[::-1] + out])
    covered = cv2.pointPolygonTest
    patch_px = to_image(VIEW.camera, patch).astype(np.float32)
    kept = [p for p in outline if covered(patch_px, tuple(map(float, p)), False) < 0]
    edge = outline_of(patch, 0.1)
    bar_px = to_image(VIEW.camera, shape).astype(np.float32)
    edge = [p for p in edge if covered(bar_px, tuple(map(float, p)), False) < 0]
    return np.array(kept + edge), cv2.contourArea(patch_px) + area_px2(shape)


@pytest.mark.parametrize(
    ("kind", "shape"),
    [(LANE_DASH, bar(8.0, 1.0, 4.0, 0.15, 15.0)), (STOP_LINE, bar(7.0, 0.0, 0.3, 3.0, 5.0))],
)
def test_what_sticks_to_a_stripe_does_not_widen_its_start(kind, shape):
    shape = np.roll(shape, -1, axis=0) if kind == LANE_DASH else shape
    outline, paint_px2 = with_fleck(outline_of(shape, 0.2), shape, 0.4)
    corners, cover = starting_corners(kind, outline, VIEW.ground(outline), paint_px2, VIEW)
    apart = np.linalg.norm(corners[:, None] - to_image(VIEW.camera, shape), axis=2).min(axis=1)
    assert apart.max() < 4.0
    assert cover > 0.6


def test_points_on_a_line_start_nothing():
    line = np.column_stack([np.linspace(100, 200, 20), np.full(20, 300.0)])
    assert starting_corners(DIAMOND, line, VIEW.ground(line), 0.0, VIEW) is None
