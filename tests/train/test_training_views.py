"""Random cameras for training: rotations, lenses, and cameras on the vehicle's side."""

import numpy as np
import pytest

from train.scenes import scenes
from train.scenes.hardships import Hardships
from train.scenes.paint import rectangle
from train.scenes.scenes import training_sample
from train.scenes.views import looking, random_view, turned_aside
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.detection.camera import ASIDE_RAD
from v2hdm.geometry.lens import undistort_points
from v2hdm.records import LANE_DASH, STOP_LINE
from v2hdm.simulate.render.scene import Paint, Scene


def test_a_camera_that_looks_along_x_sees_the_road_ahead_below_its_axis() -> None:
    cam_from_map = looking(np.array([0.0, 0.0, 2.0]), 0.0, 0.0, 0.0)
    np.testing.assert_allclose(cam_from_map @ [10.0, 3.0, 0.0, 1.0], [-3.0, 2.0, 10.0, 1.0], atol=1e-12)
    tilted = looking(np.array([0.0, 0.0, 2.0]), 0.0, np.arctan2(2.0, 10.0), 0.0)
    np.testing.assert_allclose((tilted @ [10.0, 0.0, 0.0, 1.0])[:2], 0.0, atol=1e-12)


def test_camera_rotations_are_rotations() -> None:
    for index in range(10):
        rotation = random_view(np.random.default_rng(index), 64, 32).cam_from_map[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)


def test_a_camera_on_the_side_looks_across_the_way_at_a_place_that_it_passes() -> None:
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
def test_a_camera_on_the_side_is_to_take_dashes_for_stop_lines(
    monkeypatch: pytest.MonkeyPatch, painted: str, answer: str
) -> None:
    paint = Paint(kind=painted, polygon_map=rectangle(np.array([12.0, 3.0]), 2.0, 0.3))
    monkeypatch.setattr(scenes, "random_scene", lambda *_: (Scene(paints=(paint,)), []))
    found = set()
    for index in range(6):
        found |= set(np.unique(training_sample(3, index, 320, 180, hardships=Hardships(aside=1.0)).labels))
    assert found == {0, 1 + PAINT_CLASSES.index(answer)}


def test_no_lens_folds_an_image_over_itself() -> None:
    u, v = np.meshgrid(np.linspace(0, 1279, 33), np.linspace(0, 719, 19))
    for index in range(200):
        info = random_view(np.random.default_rng(index), 1280, 720).info
        rays = undistort_points(info, np.column_stack([u.ravel(), v.ravel()])).reshape(*u.shape, 2)
        right, down = np.diff(rays, axis=1)[:-1], np.diff(rays, axis=0)[:, :-1]
        turn = right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]
        assert (turn > 0).all(), f"view {index}: neighbouring pixels change sides"
