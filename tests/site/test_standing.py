"""Whether images tell what stands at an end of a dash from ground that goes on."""

import cv2
import numpy as np
import pytest

from tests.detection.pictures import extrinsic, make_camera
from v2hdm.association.ground import Views
from v2hdm.association.sightings import Rig
from v2hdm.simulate.render.renderer import Renderer
from v2hdm.simulate.render.scene import Box, Paint, Scene
from v2hdm.site.standing import Watch, _log_grey

DASH = np.array([[12.0, -0.075], [15.0, -0.075], [15.0, 0.075], [12.0, 0.075]])
FAR_END = 1  # the side of DASH at x = 15 m
DRIVEN_M = (0.0, 2.0, 4.0, 6.0, 8.0)
BOX = Box(centre_map=(16.0, 0.0), size_m=(2.0, 2.4, 1.2), albedo_bgr=(0.3, 0.3, 0.32))


def watch(boxes=(), heights_m=0.0):
    """A camera that drives towards DASH, five images, and what stands at its end."""
    camera = make_camera("pinhole")
    poses = np.tile(np.eye(4), (len(DRIVEN_M), 1, 1))
    poses[:, 0, 3] = DRIVEN_M
    rig = Rig(camera.info.intrinsic[None], extrinsic()[None], poses)
    renderer = Renderer(Scene(paints=(Paint(kind="lane_dash", polygon_map=DASH),), boxes=boxes))
    read = []

    def grey(index):
        read.append(index)
        cam_from_map = extrinsic() @ np.linalg.inv(poses[index])
        image = renderer.render(camera.info, cam_from_map, np.random.default_rng(index)).image
        return image.astype(np.float32).mean(axis=2)

    number = np.arange(len(DRIVEN_M))
    views = Views(number, np.zeros_like(number), number)
    return Watch(views, rig, (camera,), grey), read


def odds_at_far_end(boxes=()):
    looked, _ = watch(boxes)
    is_end = np.zeros((1, 4), dtype=bool)
    is_end[0, FAR_END] = True
    return looked.standing_odds(DASH[None], is_end)


def test_ground_that_goes_on_beyond_an_end_hides_nothing():
    odds = odds_at_far_end()
    assert odds[0, FAR_END] < -1


def test_a_box_at_an_end_may_hide_more_paint():
    odds = odds_at_far_end((BOX,))
    assert odds[0, FAR_END] > 1


def test_sides_that_are_not_asked_for_tell_nothing_and_no_image_is_read():
    looked, read = watch()
    np.testing.assert_array_equal(looked.standing_odds(DASH[None], np.zeros((1, 4), dtype=bool)), 0.0)
    assert not read


@pytest.mark.parametrize("side", [0, 2, 3])
def test_ends_that_no_camera_sees_over_their_paint_stay_unknown(side):
    looked, _ = watch((BOX,))
    is_end = np.zeros((1, 4), dtype=bool)
    is_end[0, side] = True
    backwards = DASH - np.array([40.0, 0.0])
    np.testing.assert_array_equal(looked.standing_odds(backwards[None], is_end), 0.0)


def test_the_part_of_an_image_around_some_points_says_what_the_whole_image_does():
    rng = np.random.default_rng(0)
    grey = rng.uniform(0, 255, (120, 200)).astype(np.float32)
    points_px = np.column_stack([rng.uniform(2, 60, 50), rng.uniform(70, 117, 50)])
    blurred = cv2.GaussianBlur(np.log(grey + np.float32(3)), (0, 0), 1.7)
    u, v = points_px.astype(np.float32).T
    expected = cv2.remap(blurred, u[None], v[None], cv2.INTER_LINEAR)[0]
    np.testing.assert_allclose(_log_grey(grey, [points_px], 1.7)[0], expected, atol=1e-5)


def test_of_colours_their_mean_is_looked_at():
    rng = np.random.default_rng(1)
    colours = rng.integers(0, 256, (90, 200, 3), dtype=np.uint8)
    points_px = np.column_stack([rng.uniform(2, 60, 50), rng.uniform(20, 87, 50)])
    of_mean = _log_grey(colours.astype(np.float32).mean(axis=2), [points_px])[0]
    np.testing.assert_allclose(_log_grey(colours, [points_px])[0], of_mean, atol=1e-5)
