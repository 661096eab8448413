"""Where the corner fit starts."""

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
    corners, cover = starting_corners(kind, outline, VIEW.ground(outline), VIEW)
    apart = np.linalg.norm(corners[:, None] - to_image(VIEW.camera, shape), axis=2).min(axis=1)
    assert apart.max() < 5.0
    assert cover > 0.7


def test_points_on_a_line_start_nothing():
    line = np.column_stack([np.linspace(100, 200, 20), np.full(20, 300.0)])
    assert starting_corners(DIAMOND, line, VIEW.ground(line), VIEW) is None
