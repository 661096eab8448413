"""Quadrilaterals in their own frame: the same whatever the place, the light and the first corner."""

import numpy as np
import pytest

from tests.detection.pictures import bar, diamond, make_camera, output_of, picture, to_image, view_of
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.evidence import CHANNELS, SIZE
from v2hdm.geometry.quadrilateral import order_corners
from v2hdm.records import DIAMOND, LANE_DASH

CAMERA = make_camera("plumb_bob")
VIEW = RoadCamera(CAMERA, 16)
GREY, OUTSIDE = CHANNELS.index("log_grey"), CHANNELS.index("outside")


def seen(image: np.ndarray, corners_px: np.ndarray, kind: str) -> np.ndarray:
    """The view (C, 20, 20) of a quadrilateral in an image of which the network says nothing."""
    blank = output_of(np.zeros((CAMERA.info.height // 2, CAMERA.info.width // 2), np.float32))
    return view_of(image, VIEW, blank, corners_px, kind)


def corners_of(shape: np.ndarray) -> np.ndarray:
    return order_corners(to_image(CAMERA, shape))


def inside(kind: str) -> np.ndarray:
    """Elements (20, 20) well within the marking, as the module's margins put it."""
    step = (np.arange(SIZE) + 0.5) / SIZE
    along, across = (
        np.abs((1 + 2 * margin) * (step - 0.5)) < 0.4
        for margin in ((0.6, 0.6) if kind == DIAMOND else (0.3, 1.0))
    )
    return across[:, None] & along


def outside(kind: str) -> np.ndarray:
    step = (np.arange(SIZE) + 0.5) / SIZE
    along, across = (
        np.abs((1 + 2 * margin) * (step - 0.5)) > 0.65
        for margin in ((0.6, 0.6) if kind == DIAMOND else (0.3, 1.0))
    )
    return across[:, None] | along


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        (diamond(6.0, 0.4, 1.4, 0.9), DIAMOND),
        (diamond(8.0, -1.0, 1.4, 0.9, 20.0), DIAMOND),
        (bar(7.5, 0.5, 2.5, 0.4), LANE_DASH),
        (bar(7.5, 0.5, 2.5, 0.4, 90.0), LANE_DASH),
    ],
)
def test_paint_fills_the_middle_wherever_a_marking_lies(shape, kind):
    corners = corners_of(shape)
    for first in range(4):
        view = seen(picture(CAMERA, [shape], ground=0.1, paint=0.5), np.roll(corners, first, axis=0), kind)
        grey = view[GREY]
        bright, dark = grey[inside(kind)], grey[outside(kind)]
        assert bright.min() > dark.max() + np.log(2)
        assert not view[OUTSIDE].any()


def test_light_changes_nothing():
    shape = diamond(6.0, 0.0, 1.4, 0.9)
    bright, dim = (
        seen(picture(CAMERA, [shape], ground=0.3 * light, paint=0.9 * light), corners_of(shape), DIAMOND)
        for light in (1.0, 0.5)
    )
    assert np.abs(bright[GREY] - dim[GREY]).mean() < 0.1


def test_what_lies_beyond_the_image_is_told_and_all_is_finite():
    shape = diamond(5.0, 3.2, 1.6, 1.2)
    corners = corners_of(shape)
    image = picture(CAMERA, [shape])
    assert seen(image, corners, DIAMOND)[OUTSIDE].any()
    above = np.array([[300.0, 2.0], [310.0, 1.0], [312.0, 9.0], [301.0, 10.0]])
    assert np.isfinite(seen(image, order_corners(above), DIAMOND)).all()
