"""The IPM and the extrinsic, polygons and quadrilaterals of image and ground."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.cameras import mounted
from v2hdm.geometry.ipm import (
    apply_homography,
    apply_in_front,
    direction_covariance,
    extrinsic_from_ipm,
    facing_ipm,
    flat_motion,
    ground_from_pinhole_px,
    homography_jacobian,
    ipm_from_extrinsic,
    project_ground,
)
from v2hdm.geometry.planar import (
    Quad,
    align,
    clip_convex,
    diameters,
    inside_convex,
    is_convex,
    is_convex_px,
    order_corners,
    quad_from_hull,
    side_frames,
    signed_area,
)
from v2hdm.geometry.rigid import camera_centre, exp, ground_in_vehicle
from v2hdm.records import CameraInfo

INFO = CameraInfo("front", 1280, 720, np.array([[900.0, 0, 639.5], [0, 880, 359.5], [0, 0, 1]]))
MOUNTS = np.stack([mounted((1.5, 0, 2.4), 18), mounted((-1, 0, 2.6), 40, 180), mounted((2, 0, 1.7), 1)])
ROI = np.array([[4.0, -2], [4, 2], [12, 4], [12, -4], [8, 0]])


@pytest.mark.parametrize("factor", [1.0, -1.0, 250.0, -1e-3])
@pytest.mark.parametrize("mount", range(3))
def test_the_extrinsic_comes_back_from_its_ipm_whatever_its_scale_and_sign(factor, mount):
    ipm = factor * ipm_from_extrinsic(INFO, MOUNTS[mount])
    np.testing.assert_allclose(extrinsic_from_ipm(INFO, ipm), MOUNTS[mount], atol=1e-9)


def test_an_inexact_ipm_yields_the_rigid_camera_above_the_ground_whose_columns_are_nearest():
    rng = np.random.default_rng(0)
    ipm = ipm_from_extrinsic(INFO, MOUNTS[0]) * (1 + 0.02 * rng.normal(size=(3, 3)))
    cam_from_vehicle = extrinsic_from_ipm(INFO, ipm)
    np.testing.assert_allclose(cam_from_vehicle[:3, :3] @ cam_from_vehicle[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(cam_from_vehicle[:3, :3]) == pytest.approx(1)
    assert camera_centre(cam_from_vehicle)[2] > 0
    columns = np.linalg.solve(INFO.intrinsic, np.linalg.inv(ipm))
    scale = (columns[:, 2] @ cam_from_vehicle[:3, 3]) / (cam_from_vehicle[:3, 3] @ cam_from_vehicle[:3, 3])

    def misfit(matrix, scale):
        return np.linalg.norm(columns[:, :2] / scale - matrix[:3, :2])

    nearest = misfit(cam_from_vehicle, scale)
    for tangent in rng.normal(0, 1e-3, (20, 6)):
        assert misfit(exp(tangent * [0, 0, 0, 1, 1, 1]) @ cam_from_vehicle, scale) > nearest
    assert all(
        np.linalg.norm(columns[:, :2] - f * scale * cam_from_vehicle[:3, :2])
        > np.linalg.norm(columns[:, :2] - scale * cam_from_vehicle[:3, :2])
        for f in (0.99, 1.01)
    )


@pytest.mark.parametrize("mount", range(3))
@pytest.mark.parametrize("tangent", [np.zeros(6), np.array([12.0, -5.0, 0.02, -0.01, 0.02, 0.7])])
def test_ground_points_return_from_their_pixels_under_a_tilted_pose_too(mount, tangent):
    pose = exp(tangent)
    cam_from_map = MOUNTS[mount] @ np.linalg.inv(pose)
    back = ground_from_pinhole_px(INFO.intrinsic, cam_from_map)
    ahead = (ROI * [-1, 1] if mount == 1 else ROI) @ pose[:2, :2].T + pose[:2, 3]
    pixels, depth_m = project_ground(INFO.intrinsic, cam_from_map, ahead)
    assert (depth_m > 0).all()
    np.testing.assert_allclose(apply_in_front(back, pixels), ahead, atol=1e-9)


def test_for_a_level_vehicle_the_plain_route_is_the_posed_one():
    pose, pixels = exp(np.array([3.0, 4.0, 0, 0, 0, 1.1])), np.array([[500.0, 500.0], [800.0, 420.0]])
    posed = ground_from_pinhole_px(INFO.intrinsic, MOUNTS[0] @ np.linalg.inv(pose))
    plain = flat_motion(pose) @ facing_ipm(-ipm_from_extrinsic(INFO, MOUNTS[0]), np.array([8.0, 0.0]))
    np.testing.assert_allclose(apply_in_front(plain, pixels), apply_in_front(posed, pixels), atol=1e-9)


def test_a_pitch_error_moves_a_point_along_its_ray_as_the_formula_says():
    """At h = 2.4 m and r = 10 m, one milliradian of pitch is (100 + 5.76) / 2.4 mm = 44 mm."""
    covariance = direction_covariance(np.array([10.0, 0.0]), np.array(2.4), 1e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [0.04407, 0.010], rtol=1e-3)


def test_a_batch_of_cameras_projects_as_each_of_them_does():
    points = np.stack([ROI, ROI * [-1, 1], ROI])
    pixels, depth_m = project_ground(INFO.intrinsic, MOUNTS, points)
    for mount, points_of_camera, at, depth in zip(MOUNTS, points, pixels, depth_m, strict=True):
        single_px, single_m = project_ground(INFO.intrinsic, mount, points_of_camera)
        np.testing.assert_allclose(at, single_px, rtol=1e-13)
        np.testing.assert_allclose(depth, single_m, rtol=1e-13)


def test_an_ipm_of_either_sign_faces_the_ground_that_the_camera_sees():
    ipm, below = ipm_from_extrinsic(INFO, MOUNTS[0]), np.array([[639.5, 700.0], [639.5, 0.0]])
    for sign in (1.0, -1.0):
        ground = apply_in_front(facing_ipm(sign * ipm, np.array([8.0, 0.0])), below)
        np.testing.assert_allclose(ground[0], apply_homography(ipm, below)[0], rtol=1e-13)
        assert np.isnan(ground[1]).all()


def test_the_homography_jacobian_is_the_slope_of_the_homography_and_nan_above_the_horizon():
    ipm, step = facing_ipm(ipm_from_extrinsic(INFO, MOUNTS[0]), np.array([8.0, 0.0])), 1e-4
    points = np.array([[300.0, 450.0], [500.0, 640.0]])
    slopes = [
        (apply_homography(ipm, points + d) - apply_homography(ipm, points - d)) / (2 * step)
        for d in step * np.eye(2)
    ]
    numeric = np.stack(slopes, axis=2)
    np.testing.assert_allclose(homography_jacobian(ipm, points), numeric, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(
        homography_jacobian(np.stack([ipm, ipm]), points)[1], numeric, rtol=1e-6, atol=1e-9
    )
    assert np.isnan(homography_jacobian(ipm, np.array([[640.0, 0.0]]))).all()


def test_a_motion_in_the_plane_is_the_homography_of_that_plane():
    motion = exp(np.array([3.0, -2.0, 0, 0, 0, 0.7]))
    moved = (np.column_stack([ROI, np.zeros(5), np.ones(5)]) @ motion.T)[:, :2]
    np.testing.assert_allclose(apply_homography(flat_motion(motion), ROI), moved, atol=1e-12)


def area(polygon):
    return abs(float(signed_area(polygon)))


@pytest.mark.parametrize("order", [1, -1])
def test_inside_a_polygon_of_either_sense(order):
    square = np.array([[0.0, 0], [2, 0], [2, 2], [0, 2]])[::order]
    points = np.array([[1.0, 1.0], [3.0, 1.0], [np.nan, 1.0]])
    assert inside_convex(square, points).tolist() == [True, False, False]


def test_a_ground_point_ahead_is_on_the_vehicles_x_axis():
    map_from_vehicle = np.eye(4)
    map_from_vehicle[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    map_from_vehicle[:2, 3] = [10.0, 5.0]
    points = ground_in_vehicle(map_from_vehicle, np.array([[10.0, 8.0], [9.0, 5.0]]))
    assert points == pytest.approx(np.array([[3.0, 0.0], [0.0, 1.0]]), abs=1e-12)


@pytest.mark.parametrize("order", [1, -1])
def test_what_two_squares_share(order):
    square = np.array([[0.0, 0], [2, 0], [2, 2], [0, 2]])
    assert area(clip_convex(square, square[::order] + 1.0)) == pytest.approx(1.0)
    assert area(clip_convex(square, square[::order] + 1e-7)) == pytest.approx(4.0, abs=1e-5)
    assert len(clip_convex(square, square[::order] + 3.0)) == 0


def test_nearly_equal_polygons_share_nearly_all():
    """OpenCV's intersection of some such pairs is empty."""
    rng = np.random.default_rng(3)
    for _ in range(200):
        turn = rng.uniform(0, 2 * np.pi)
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        diamond = np.array([[0.6, 0], [0, 0.3], [-0.6, 0], [0, -0.3]]) @ rotation.T + rng.uniform(-50, 50, 2)
        other = diamond + rng.normal(0, 1e-3, (4, 2))
        assert area(clip_convex(diamond, other)) > 0.95 * area(diamond)


DIAMOND = np.array([[0.6, 0.0], [0.0, 0.3], [-0.6, 0.0], [0.0, -0.3]])
KITE = order_corners(np.array([[20.3, 10.2], [40.1, 14.9], [19.4, 19.3], [3.2, 15.5]]))
OFFSET = np.array([0.1, -0.05])
ALL = np.ones(4, dtype=bool)


@pytest.mark.parametrize("shift", range(4))
def test_a_cyclic_shift_is_found_and_undone(shift):
    turned = np.roll(DIAMOND, shift, axis=0) + OFFSET
    aligned = align(DIAMOND, ALL, turned, ALL)
    assert aligned.shift == shift
    np.testing.assert_allclose(aligned.offset, OFFSET)
    np.testing.assert_allclose(turned[(np.arange(4) + aligned.shift) % 4], DIAMOND + OFFSET)
    assert aligned.deformation_m == pytest.approx(0.0, abs=1e-12)


def test_corners_that_are_not_valid_take_no_part_and_another_shape_shows_as_deformation():
    broken = DIAMOND.copy()
    broken[2] = np.nan
    aligned = align(DIAMOND, ALL, broken, np.array([True, True, False, True]))
    assert aligned.shift == 0
    assert aligned.deformation_m == pytest.approx(0.0, abs=1e-12)
    assert np.isinf(align(DIAMOND, ALL, DIAMOND, np.array([True, False, False, False])).deformation_m)
    assert align(DIAMOND, ALL, 1.5 * DIAMOND, ALL).deformation_m == pytest.approx(0.3)


def test_alignment_broadcasts_over_tracks_and_detections():
    tracks = np.stack([DIAMOND, DIAMOND + 5.0, DIAMOND - 3.0])[:, None]
    aligned = align(tracks, np.ones((3, 1, 4), bool), np.stack([DIAMOND] * 2), np.ones((2, 4), bool))
    assert aligned.shift.shape == (3, 2)
    np.testing.assert_allclose(aligned.offset[:, 0, 0], [0.0, -5.0, 3.0], atol=1e-12)


def test_area_sense_and_diameter_of_a_diamond_and_of_its_image_whose_second_axis_turns_down():
    in_image = DIAMOND * [1, -1]
    assert signed_area(DIAMOND) == pytest.approx(0.36) == -signed_area(in_image)
    assert diameters(DIAMOND, ALL) == pytest.approx(1.2)
    assert is_convex(DIAMOND)
    assert is_convex_px(in_image)
    assert not any([is_convex(DIAMOND[::-1]), is_convex_px(DIAMOND), is_convex(in_image)])


def test_ordered_corners_run_counter_clockwise_on_the_screen():
    assert signed_area(KITE) < 0
    assert is_convex_px(KITE)
    assert not is_convex_px(KITE[::-1])


@pytest.mark.parametrize(("corners", "outwards"), [(KITE, 1), (DIAMOND, -1)], ids=["image", "map"])
def test_normals_of_image_corners_point_outwards_and_of_map_corners_inwards(corners, outwards):
    normal = side_frames(corners).normal
    middle = (corners + np.roll(corners, -1, axis=0)) / 2
    assert (outwards * ((middle - corners.mean(axis=0)) * normal).sum(axis=1) > 0).all()


def test_the_width_of_a_bar_is_its_breadth():
    assert Quad(order_corners(np.array([[0, 0], [30, 0], [30, 4], [0, 4.0]]))).width == pytest.approx(4.0)


def test_a_quadrilateral_is_found_again_from_points_on_its_outline():
    along = np.linspace(0, 1, 40, endpoint=False)[:, None]
    outline = np.concatenate([KITE[e] * (1 - along) + KITE[(e + 1) % 4] * along for e in range(4)])
    quad = quad_from_hull(cv2.convexHull(outline.astype(np.float32)))
    distance = np.linalg.norm(quad[:, None] - KITE, axis=-1).min(axis=1)
    assert distance.max() < 0.05


@pytest.mark.parametrize("outline", [np.zeros((3, 2)), np.zeros((9, 2)), np.arange(18.0).reshape(9, 2)])
def test_points_that_enclose_nothing_give_no_quadrilateral(outline):
    assert quad_from_hull(cv2.convexHull(outline.astype(np.float32))) is None
