"""Things that stand are not shown as ground: in made patterns, and in images of a box on a painted plane."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from tests.mosaic import scene
from v2hdm.geometry.ipm import apply_homography, ground_from_pinhole_px
from v2hdm.geometry.lens import undistort_points
from v2hdm.geometry.rigid import camera_centre, inverse
from v2hdm.mosaic.blend import whole
from v2hdm.mosaic.consensus import CELL_M, GROUND, PLAIN, STANDING, UNSEEN, find_consensus, ground_of
from v2hdm.mosaic.views import Canvas, adjusted_shots, lens_of
from v2hdm.mosaic.warp import Area
from v2hdm.records import Calibration, Trajectory

FACE_X, FACE_Y, HEIGHT_M = 12.0, (1.0, 3.0), 2.0
"""A wall across the way, to its left: its place ahead, its ends aside, and its height, m."""


@cache
def noise(seed, size=4096):
    rng = np.random.default_rng(seed)
    return cv2.GaussianBlur(rng.uniform(40, 215, (size, size)).astype(np.float32), (0, 0), 1.2)


def ground_grey():
    return noise(1)


def wall_grey():
    return noise(2)


def grey_at(texture, points):
    """Grey values of a texture with cells of 5 cm at points (..., 2)."""
    at = (points / 0.05).astype(np.float32) + 1000
    return cv2.remap(texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR)


def picture(pose):
    """Ground with a wall on it."""
    cam_from_map = scene.cam_from_vehicle() @ inverse(pose)
    centre = camera_centre(cam_from_map)
    v, u = np.mgrid[: scene.INFO.height, : scene.INFO.width]
    pixels = undistort_points(scene.INFO, np.stack([u, v], axis=-1).reshape(-1, 2).astype(float))
    points = apply_homography(ground_from_pinhole_px(scene.INFO.intrinsic, cam_from_map), pixels)
    grey = grey_at(ground_grey(), points.reshape(*v.shape, 2)).ravel()
    share = (FACE_X - centre[0]) / (points[:, 0] - centre[0])
    y = centre[1] + share * (points[:, 1] - centre[1])
    z = centre[2] * (1 - share)
    on_wall = (share > 0) & (share < 1) & (y > FACE_Y[0]) & (y < FACE_Y[1]) & (z < HEIGHT_M)
    wall = grey_at(wall_grey(), np.column_stack([y, z]).reshape(*v.shape, 2)).ravel()
    grey[on_wall] = wall[on_wall]
    return np.repeat(grey.reshape(v.shape).astype(np.uint8)[..., None], 3, axis=2)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A drive of 10 m past the wall: its images' shots and lenses, and a canvas around the wall."""
    folder = tmp_path_factory.mktemp("wall")
    drive = scene.drive_of(folder, scene.waves)
    images, poses = [], []
    for k in range(41):
        pose = np.eye(4)
        pose[:2, 3] = 0.25 * k - 2.0, -0.02 * k
        path = folder / f"{k:02d}.png"
        cv2.imwrite(str(path), picture(pose))
        images.append(replace(drive.images[0], stamp_s=0.1 * k, path=path, map_from_vehicle=pose))
        poses.append(pose)
    route = Trajectory(np.array([image.stamp_s for image in images]), np.stack(poses))
    drive = replace(drive, images=images, trajectory=route, recorded=route)
    calibrations = {"front": Calibration(scene.INFO, scene.cam_from_vehicle())}
    shots = adjusted_shots(drive, calibrations, {"front": 0.0}, route)
    lenses = {"front": lens_of(drive.cameras["front"], scene.cam_from_vehicle())}
    return shots, lenses, Canvas(np.array([5.12, 5.12]), CELL_M, 256, 384)


def shown_in(rgba, canvas, x, y):
    """Share of a box that is shown."""
    columns = [round((value - canvas.corner_map[0]) / canvas.cell_m) for value in x]
    rows = [round((canvas.corner_map[1] - value) / canvas.cell_m) for value in y[::-1]]
    return (rgba[rows[0] : rows[1], columns[0] : columns[1], 3] >= 128).mean()


def test_a_wall_is_cut_out_and_the_ground_before_and_beside_it_is_shown(site):
    shots, lenses, canvas = site
    consensus = find_consensus(shots, lenses, canvas, "cpu")
    assert consensus is not None
    without = whole(canvas, shots, lenses)
    rgba = whole(canvas, shots, lenses, "cpu", consensus)
    behind = ((FACE_X + 0.5, FACE_X + 4.0), (1.6, 2.8))
    assert shown_in(without, canvas, *behind) > 0.9
    assert shown_in(rgba, canvas, *behind) < 0.05
    assert shown_in(rgba, canvas, (8.0, 11.0), (1.2, 2.8)) > 0.95
    assert shown_in(rgba, canvas, (8.0, 14.0), (-2.5, -0.5)) > 0.95
    shown = rgba[..., 3] == 255
    column, row = np.meshgrid(np.arange(canvas.columns), np.arange(canvas.rows))
    points = canvas.corner_map + CELL_M * np.stack([column + 0.5, -(row + 0.5)], axis=-1)
    off, aside = (
        np.abs(rgba[..., 0] - grey_at(ground_grey(), points + shift))[shown] for shift in (0.0, 0.5)
    )
    assert np.median(off) < 8.0
    assert np.median(aside) > 2 * np.median(off)


def test_images_from_one_place_tell_nothing_and_that_is_said(site, caplog):
    shots, lenses, canvas = site
    assert find_consensus(shots[20:22], lenses, canvas, "cpu") is None
    assert "the mosaic may show what stands" in caplog.text


def test_blocks_without_a_pattern_follow_their_neighbours():
    kinds = np.full((20, 40), PLAIN)
    kinds[:, :16] = GROUND
    kinds[:, 30:] = STANDING
    is_ground = ground_of(kinds)
    assert is_ground[:, :21].all()
    assert not is_ground[:, 24:].any()


def test_a_speck_amid_ground_is_ground_and_one_amid_what_stands_is_not():
    kinds = np.full((20, 40), GROUND)
    kinds[5, 5] = STANDING
    kinds[:, 20:] = STANDING
    kinds[10, 30] = GROUND
    is_ground = ground_of(kinds)
    assert is_ground[:, :17].all()
    assert not is_ground[:, 20:].any()


def test_what_no_image_shows_is_not_ground():
    kinds = np.full((20, 20), GROUND)
    kinds[:, 10:] = UNSEEN
    assert not ground_of(kinds)[:, 10:].any()
    assert not ground_of(np.full((5, 5), UNSEEN)).any()


def test_the_area_reaches_beyond_the_paint_all_along_a_row():
    way = np.column_stack([np.arange(0.0, 40.0), np.zeros(40)])
    paint = np.array([[5.0, 8.0], [14.0, 8.0], [20.0, -3.0]])
    area = Area.along(way, paint, 6.0, 1.6)
    inside = area.holds(np.array([[5.0, 9.5], [9.5, 9.0], [14.0, 9.5], [30.0, 5.9], [20.0, -5.9]]))
    assert inside.all()
    assert not area.holds(np.array([[5.0, 9.7], [30.0, 6.1], [35.0, -8.0]])).any()
