"""Cameras of training's scenes look as real ones do, and lines and crops follow their images."""

import numpy as np
import pytest

from train.augment import random_crop
from train.scenes import scenes
from train.scenes.hardships import (
    Hardships,
)
from train.scenes.paint import (
    rectangle,
)
from train.scenes.scenes import TrainingSample, image_line, image_points, training_sample
from train.scenes.views import TrainingView, looking, mounted_otherwise, random_view, turned_aside
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.detection.camera import ASIDE_RAD
from v2hdm.geometry.lens import undistort_points
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import (
    LANE_DASH,
    STOP_LINE,
    CameraInfo,
)
from v2hdm.simulate.render.renderer import Motion, Optics
from v2hdm.simulate.render.scene import Paint, Scene


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("plumb_bob", (-0.16, 0.024, 0.0, 0.0, 0.0)), ("plumb_bob", (0.0,) * 5), ("equidistant", (0.0,) * 4)],
)
def test_a_line_is_followed_to_the_borders_of_the_image(model, coefficients):
    """Points of a strong lens's image that a pinhole would see far outside of it belong to it, too."""
    intrinsic = np.array([[500.0, 0.0, 640.0], [0.0, 500.0, 260.0], [0.0, 0.0, 1.0]])
    info = CameraInfo("wide", 1280, 720, intrinsic, model, coefficients)
    cam_from_map = looking(np.array([0.0, 0.0, 1.4]), 0.0, 0.1, 0.0)
    view = TrainingView(info, cam_from_map, Optics(), Motion())
    along = np.arange(-4.0, 50.0, 0.5)
    for left in (-1.2, 0.0, 0.9):
        line = image_line(view, np.column_stack([along, np.full(len(along), left)]))
        assert line[:, 1].max() > 719
        inside = line[line[:, 1] < 720]
        assert np.abs(np.diff(inside, axis=0)).max() < 110, "half a metre would be most of the image"
        u, v = (undistort_points(info, line) - intrinsic[:2, 2]).T / 500
        on_ground = np.column_stack([u, v, np.ones(len(u))]) @ cam_from_map[:3, :3]
        on_ground *= 1.4 / -on_ground[:, 2:]
        np.testing.assert_allclose(on_ground[:, 1], left, atol=0.02)


def test_what_a_folding_lens_would_show_twice_is_not_in_the_image():
    intrinsic = np.array([[300.0, 0.0, 320.0], [0.0, 300.0, 100.0], [0.0, 0.0, 1.0]])
    info = CameraInfo("folding", 640, 360, intrinsic, "plumb_bob", (-0.3, 0.0, 0.0, 0.0, 0.0))
    view = TrainingView(info, looking(np.array([0.0, 0.0, 1.4]), 0.0, 0.0, 0.0), Optics(), Motion())
    points = np.column_stack([np.linspace(0.4, 30, 200), np.full(200, 0.3)])
    pixels = image_points(view, points)
    assert 0 < len(pixels) < 200
    assert (np.diff(pixels[:, 1]) < 0).all(), "farther along a line is farther up"


def test_a_camera_on_the_side_looks_across_the_way_at_a_place_that_it_passes():
    place = np.array([12.0, 3.0])
    for index in range(40):
        rng = np.random.default_rng(index)
        straight = random_view(rng, 128, 72)
        assert turned_aside(rng, straight, [place], 0.0) is straight
        assert turned_aside(rng, straight, [], 1.0) is straight
        view = turned_aside(rng, straight, [place], 1.0)
        forward, centre = view.cam_from_map[2, :3], -view.cam_from_map[:3, :3].T @ view.cam_from_map[:3, 3]
        assert abs(forward[1]) > np.tan(ASIDE_RAD) * abs(forward[0])
        before = -straight.cam_from_map[:3, :3].T @ straight.cam_from_map[:3, 3]
        assert centre[2] == pytest.approx(before[2])
        np.testing.assert_allclose(forward[2], straight.cam_from_map[2, 2], atol=1e-12)
        assert (view.cam_from_map @ [*place, 0.0, 1.0])[2] > 0.5, "the place lies before the camera"
        moved_map = view.cam_from_map[:3, :3].T @ view.motion.velocity_cam
        np.testing.assert_allclose(moved_map[1:], 0.0, atol=1e-9)
        assert np.linalg.norm(moved_map) == pytest.approx(np.linalg.norm(straight.motion.velocity_cam))


@pytest.mark.parametrize(("painted", "answer"), [(LANE_DASH, STOP_LINE), (STOP_LINE, LANE_DASH)])
def test_a_camera_on_the_side_is_to_take_dashes_for_stop_lines(monkeypatch, painted, answer):
    paint = Paint(kind=painted, polygon_map=rectangle(np.array([12.0, 3.0]), 2.0, 0.3))
    monkeypatch.setattr(scenes, "random_scene", lambda *_: (Scene(paints=(paint,)), []))
    classes = set()
    for index in range(6):
        classes |= set(np.unique(training_sample(3, index, 320, 180, hardships=Hardships(aside=1.0)).labels))
    assert classes == {0, 1 + PAINT_CLASSES.index(answer)}


def test_no_lens_folds_an_image_over_itself():
    u, v = np.meshgrid(np.linspace(0, 1279, 33), np.linspace(0, 719, 19))
    for index in range(200):
        info = random_view(np.random.default_rng(index), 1280, 720).info
        rays = undistort_points(info, np.column_stack([u.ravel(), v.ravel()])).reshape(*u.shape, 2)
        right, down = np.diff(rays, axis=1)[:-1], np.diff(rays, axis=0)[:, :-1]
        turn = right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]
        assert (turn > 0).all(), f"view {index}: neighbouring pixels change sides"


def test_cameras_mounted_otherwise_keep_their_place_and_look_from_low_or_high():
    heights = []
    for seed in range(40):
        view = random_view(np.random.default_rng(seed), 160, 96)
        other = mounted_otherwise(np.random.default_rng(seed), view, 1.0)
        before, after = camera_centre(view.cam_from_map), camera_centre(other.cam_from_map)
        np.testing.assert_allclose(after[:2], before[:2], atol=1e-9)
        np.testing.assert_array_equal(other.cam_from_map[:3, :3], view.cam_from_map[:3, :3])
        heights.append(after[2])
    low = [height for height in heights if height < 2]
    assert 8 < len(low) < 32
    assert 0.5 <= min(low) < max(low) <= 1.1
    assert all(3.6 <= height <= 5 for height in heights if height >= 2)
    view = random_view(np.random.default_rng(0), 160, 96)
    assert mounted_otherwise(np.random.default_rng(0), view, 0.0) is view


def test_crops_keep_image_labels_hidden_and_lanes_together():
    labels = np.random.default_rng(0).integers(0, 5, (40, 60)).astype(np.uint8)
    image = np.repeat(labels[..., None], 3, axis=2)
    image[20, 30] = 250
    whole = TrainingSample(image, labels, labels > 2, (np.array([[30.0, 20.0], [31.0, 10.0]]),))
    rng = np.random.default_rng(1)
    count = 0
    for _ in range(40):
        crop = random_crop(rng, whole, 32, 16)
        assert crop.image.shape == (16, 32, 3)
        bright = crop.image[..., 1] == 250
        np.testing.assert_array_equal(crop.image[..., 1][~bright], crop.labels[~bright])
        np.testing.assert_array_equal(crop.hidden, crop.labels > 2)
        for row, column in np.argwhere(bright):
            np.testing.assert_array_equal(crop.lanes_px[0][0], [column, row])
            count += 1
    assert count > 3
