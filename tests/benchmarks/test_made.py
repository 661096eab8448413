"""Drives that are made without pictures."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from tests.benchmarks.made.boards import CAMERA, make_short
from tests.benchmarks.made.boxes import _hidden, detect_pieces, largest, make_boxes
from tests.benchmarks.made.detect import detect
from tests.benchmarks.made.draw import Recipe, draw, draw_apart_s
from tests.benchmarks.made.faults import APART_S, SPOILS
from tests.benchmarks.made.queue import make_queue, rear_map
from tests.benchmarks.made.world import beside, drive_of, make, smooth_noise
from v2hdm.geometry.ground_plane import plane_in
from v2hdm.geometry.ipm import apply_homography, ground_from_pinhole_px
from v2hdm.geometry.lens import undistort_points
from v2hdm.geometry.planar import inside_convex
from v2hdm.records import LANE_DASH
from v2hdm.simulate.render.scene import box_footprint


def _exact(seed: int) -> Recipe:
    recipe = draw(seed, "straight").as_modelled()
    return replace(recipe, detector=replace(recipe.detector, sigma_px=1e-6))


def test_equal_seeds_draw_equal_drives() -> None:
    assert draw(3) == draw(3) != draw(4)


def test_exact_corners_lie_on_the_true_paint() -> None:
    world = make(_exact(3))
    drive = drive_of(world)
    detections, _ = detect(world, drive)
    true_map = world.corners_map[..., :2].reshape(-1, 2)
    off_m = []
    for in_image in detections[:20]:
        image = drive.images[in_image.image]
        frame, lens = world.frame_of(image), world.lenses[image.camera]
        pose = world.cam_from_vehicle[image.camera][frame] @ np.linalg.inv(world.map_from_vehicle[frame])
        for marking in in_image.markings:
            pinhole = undistort_points(lens, marking.corners_px[marking.corner_valid])
            ground = apply_homography(ground_from_pinhole_px(lens.intrinsic, pose), pinhole)
            off_m += [np.linalg.norm(true_map - corner, axis=1).min() for corner in ground]
    assert len(off_m) > 100
    assert max(off_m) < 1e-3


def test_smooth_noise_has_the_size_that_was_asked_for() -> None:
    drawn = smooth_noise(np.arange(0.0, 20_000.0, 1.0), 0.5, 5.0, np.random.default_rng(1), 2)
    assert drawn.std(axis=0) == pytest.approx(0.5, rel=0.05)


def test_cameras_that_fire_in_turn_do_so_between_the_poses_of_a_stream() -> None:
    drive = drive_of(make(_exact(5).in_turn(0.02)))
    assert drive.recorded is not None
    np.testing.assert_allclose(np.diff(drive.recorded.stamp_s), 0.05)
    front_s, rear_s = (
        np.array([image.stamp_s for image in drive.images if image.camera == name])
        for name in ("front", "rear")
    )
    np.testing.assert_allclose(rear_s - front_s[: len(rear_s)], 0.02)


def test_in_a_third_of_the_right_drives_the_cameras_fire_in_turn() -> None:
    assert np.mean([draw_apart_s(seed) > 0 for seed in range(200)]) == pytest.approx(1 / 3, abs=0.07)


@pytest.mark.parametrize("in_turn", [False, True], ids=["at once", "in turn"])
@pytest.mark.parametrize("name", list(SPOILS))
def test_every_fault_changes_the_drive_and_leaves_the_map_alone(name: str, in_turn: bool) -> None:
    recipe = _exact(5)
    world = make(recipe.in_turn(APART_S) if in_turn else recipe)
    spoilt = SPOILS[name].change(world)
    assert spoilt is not world
    assert spoilt.port.hd_map is world.port.hd_map
    assert len(drive_of(spoilt).images) > 0


def test_the_lorry_stays_ahead_of_the_vehicle_which_stands_behind_it_for_seconds() -> None:
    world = make_queue(draw(3, "straight"))
    route, station = world.port.route, world.station_m
    rear = np.array([rear_map(world, frame)[0, 0, :2] for frame in range(len(station))])
    ahead_m = np.linalg.norm(rear - route.points_at(station), axis=1)
    assert 4.0 < ahead_m.min() < 14.0
    assert np.count_nonzero(np.diff(station) == 0) >= 10
    assert (np.diff(station) >= 0).all()
    assert (np.diff(world.stamp_s["front"]) > 0).all()


def test_the_largest_part_in_view_is_the_larger_of_two_beside_what_hides_the_rest() -> None:
    visible = np.ones((9, 9), dtype=bool)
    visible[5:, 3:] = False
    corners, share = largest(visible)
    np.testing.assert_array_equal(corners, [[0, 0], [4, 0], [4, 8], [0, 8]])
    assert share == 4 / 8
    assert largest(~np.ones((9, 9), dtype=bool))[1] == 0.0


def test_behind_boxes_pieces_are_found_beside_all_else() -> None:
    world = make(draw(1))
    drive = drive_of(world)
    whole, (with_pieces, _) = detect(world, drive)[0], detect_pieces(world, drive)
    pieces = [b.markings[len(a.markings) :] for a, b in zip(whole, with_pieces, strict=True)]
    for a, b in zip(whole, with_pieces, strict=True):
        np.testing.assert_equal(
            [marking.corners_px for marking in a.markings],
            [marking.corners_px for marking in b.markings[: len(a.markings)]],
        )
    assert sum(map(len, pieces)) > 50


def test_a_box_stands_on_the_far_end_of_every_second_dash_at_the_right() -> None:
    world = make_boxes(draw(5, "straight"))
    route, stood_on = world.port.route, 0
    dashes = [marking.corners_map for marking in world.port.hd_map.markings if marking.kind == LANE_DASH]
    boxes = world.port.renderer.scene.boxes[len(make(draw(5, "straight")).port.renderer.scene.boxes) :]
    for dash in dashes:
        station_m, _ = beside(route, dash)
        for inside in (inside_convex(box_footprint(box), dash) for box in boxes):
            if inside.any():
                np.testing.assert_array_equal(inside, station_m > station_m.mean())
                stood_on += 1
    assert stood_on == len(boxes) == len(dashes) // 2


def test_what_is_hidden_of_a_piece_leaves_its_corners_free_along_the_sides_that_go_on() -> None:
    px = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 5.0], [0.0, 5.0]])
    covariance = _hidden(px, np.array([[0, 0], [6, 0], [6, 8], [0, 8]]))
    np.testing.assert_array_equal(covariance[[0, 3]], 0.0)
    np.testing.assert_array_equal(covariance[[1, 2]], 2 * [[[200.0**2, 0.0], [0.0, 0.0]]])


def test_running_boards_stand_above_dashes_whose_ground_is_measured_as_stated() -> None:
    """The ground's whitened errors over 20 drives are of unit variance; boards are seen, and are no paint."""
    squared = []
    for seed in range(20):
        short = make_short(draw(seed, "straight"))
        plane = short.drive.cameras[CAMERA].ground_plane
        assert plane is not None
        off = plane.root_information @ (plane_in(short.truth.cam_from_vehicle[CAMERA]) - plane.plane_cam)
        squared.append(off @ off)
        assert len(short.truth.map.markings) == 3
        assert sum(len(in_image.markings) for in_image in short.found) > 5
    low, high = chi2.ppf([0.001, 0.999], 60)
    assert low < sum(squared) < high
