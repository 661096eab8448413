"""The mosaic shows the ground as it is, however large, and its edges as sharp as they are."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.mosaic import scene
from v2hdm.errors import DriveError
from v2hdm.geometry.ipm import apply_homography
from v2hdm.geometry.lens import distort_points
from v2hdm.geometry.rigid import camera_centre, inverse
from v2hdm.mosaic import blend, warp
from v2hdm.mosaic.blend import whole
from v2hdm.mosaic.consensus import Consensus
from v2hdm.mosaic.views import FEATHER, REACH_M, Canvas, Shot, adjusted_shots, lens_of, recorded_shots
from v2hdm.records import Calibration


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return scene.drive_of(tmp_path_factory.mktemp("drive"), scene.waves)


def lenses(drive):
    return {"front": lens_of(drive.cameras["front"], scene.cam_from_vehicle())}


def points_of(canvas):
    at = np.stack(np.meshgrid(np.arange(canvas.columns), np.arange(canvas.rows)), axis=-1).astype(float)
    return apply_homography(canvas.map_from_canvas, at.reshape(-1, 2)).reshape(at.shape)


@pytest.mark.parametrize("right", [(1.0, 0.0), (0.6, -0.8)])
def test_a_mosaic_shows_the_ground_where_it_lies(drive, right):
    """Lens, mounting, pose, axes and weights in one: images made from the ground give that ground back."""
    canvas = Canvas(np.array([6.5, 2.5]), 0.02, 220, 240, right)
    rgba = whole(canvas, recorded_shots(drive), lenses(drive))
    is_shown = rgba[..., 3] == 255
    assert is_shown.mean() > 0.5
    off = np.abs(rgba[..., 0].astype(float) - scene.waves(points_of(canvas)))[is_shown]
    assert np.median(off) < 1.0
    assert off.max() < 6.0


def test_ground_that_rises_is_shown_where_it_lies(tmp_path):
    """A grade of 5 % from 5 m on, seen as on the plane: what its image shows is back in its place."""
    rise, pose = 0.05, scene.true_poses()[0]
    centre = camera_centre(scene.cam_from_vehicle() @ inverse(pose))
    height = centre[2] - rise * (centre[0] - 5.0)

    def on_ground(plane_map):
        share = height / (centre[2] + rise * (plane_map[..., :1] - centre[0]))
        return centre[:2] + share * (plane_map - centre[:2])

    def on_plane(points_map):
        above = rise * (points_map[:, :1] - 5.0)
        return points_map + above / (centre[2] - above) * (points_map - centre[:2])

    cv2.imwrite(str(tmp_path / "rises.png"), scene.picture(lambda at: scene.waves(on_ground(at)), pose))
    drive = scene.drive_of(tmp_path, scene.waves)
    flat = recorded_shots(drive)[0]
    canvas, off = Canvas(np.array([6.5, 1.5]), 0.02, 150, 200), []
    for lift in (on_plane, None):
        shot = replace(flat, path=tmp_path / "rises.png", on_plane=lift)
        rgba = whole(canvas, [shot], lenses(drive))
        is_shown = rgba[..., 3] == 255
        assert is_shown.mean() > 0.3
        off.append(np.abs(rgba[..., 0].astype(float) - scene.waves(points_of(canvas)))[is_shown].max())
    assert off[0] < 6.0 < 20.0 < off[1]


def test_the_result_does_not_depend_on_the_size_of_sheets(drive, monkeypatch):
    canvas = Canvas(np.array([5.0, 3.0]), 0.02, 300, 400)
    at_once = whole(canvas, recorded_shots(drive), lenses(drive))
    monkeypatch.setattr(blend, "SHEET_PX", 128)
    monkeypatch.setattr(warp, "_KEPT_BYTES", 1)
    in_sheets = whole(canvas, recorded_shots(drive), lenses(drive))
    assert np.abs(at_once.astype(int) - in_sheets).max() <= 1


def test_images_count_with_the_square_of_the_number_of_pixels_that_they_show_ground_with(tmp_path):
    """Two images of one grey each, one from nearer: the density by finite differences gives the mixture."""
    drive = scene.drive_of(tmp_path, lambda points: np.full(points.shape[:-1], 100.0))
    cv2.imwrite(str(drive.images[4].path), np.full((270, 480, 3), 200, np.uint8))
    two = [recorded_shots(drive)[k] for k in (0, 4)]
    lens = lenses(drive)
    place = np.array([8.0, 0.2])
    canvas = Canvas(place - [0.01, -0.01], 0.02, 1, 1)
    shares = []
    for shot in two:
        step = 1e-5
        corners = apply_homography(
            shot.pinhole_px_from_map, place + step * np.array([[0, 0], [1, 0], [0, 1]])
        )
        density = abs(np.linalg.det((corners[1:] - corners[0]) / step))
        u, v = np.round(distort_points(scene.INFO, corners[:1])[0]).astype(int)
        assert lens["front"].trust[v, u] == 1
        shares.append(density**2)
    expected = (100 * shares[0] + 200 * shares[1]) / sum(shares)
    assert whole(canvas, two, lens)[0, 0, 0] == pytest.approx(expected, abs=1)


def test_the_own_vehicle_and_what_lies_too_far_away_are_left_out(drive):
    mask = np.zeros((270, 480), dtype=bool)
    mask[:, :240] = True
    camera = replace(drive.cameras["front"], own_vehicle=mask)
    lens = lens_of(camera, scene.cam_from_vehicle())
    shot = recorded_shots(drive)[0]
    canvas = Canvas(np.array([2.0, 8.0]), 0.05, 320, 450)
    rgba, points = whole(canvas, [shot], {"front": lens}), points_of(canvas)
    is_shown = rgba[..., 3] > 0
    assert is_shown.any()
    assert points[is_shown][:, 1].max() < 0.15
    away_m = np.linalg.norm(points[is_shown] - camera_centre(scene.cam_from_vehicle())[:2], axis=1)
    assert REACH_M - 3.0 < away_m.max() < REACH_M + 0.5


def test_trust_rises_from_the_edge_of_what_is_near_over_the_feather(drive):
    trust = lenses(drive)["front"].trust
    edge = np.flatnonzero(trust[:, 240])
    feather_px = round(FEATHER * 270)
    rise = np.diff(trust[edge[0] : edge[0] + feather_px // 2, 240])
    np.testing.assert_allclose(rise, 1 / feather_px, rtol=0.05)


def test_a_sloping_road_is_undone_and_clocks_are_kept(drive):
    """Poses written in the recorded frame come back to the flat one, at the time that the image was taken."""
    up = np.eye(4)
    up[2, 3] = 3.0
    sloped = replace(drive.recorded, map_from_vehicle=up @ drive.trajectory.map_from_vehicle)
    calibrations = {"front": Calibration(scene.INFO, scene.cam_from_vehicle())}
    on_slope = replace(drive, recorded=sloped)
    flat = adjusted_shots(drive, calibrations, {"front": 0.0}, drive.trajectory)
    same = adjusted_shots(on_slope, calibrations, {"front": 0.0}, sloped)
    later = adjusted_shots(drive, calibrations, {"front": 0.1}, drive.trajectory)
    for k in range(len(flat) - 1):
        np.testing.assert_allclose(same[k].pinhole_px_from_map, flat[k].pinhole_px_from_map, atol=1e-6)
        np.testing.assert_allclose(later[k].pinhole_px_from_map, flat[k + 1].pinhole_px_from_map, atol=1e-6)


def test_where_no_image_shows_the_ground_nothing_is_shown(drive):
    canvas = Canvas(np.array([6.5, 2.5]), 0.02, 220, 240)
    nowhere = Consensus(canvas, np.zeros((1, 1), dtype=np.uint8), {})
    assert not whole(canvas, recorded_shots(drive), lenses(drive), nowhere).any()


def test_an_image_of_another_size_is_named(drive, tmp_path):
    path = tmp_path / "small.png"
    cv2.imwrite(str(path), np.zeros((20, 30, 3), np.uint8))
    shot = Shot(path, "front", recorded_shots(drive)[0].pinhole_px_from_map)
    with pytest.raises(DriveError, match=r"small.png: the image is 30x20"):
        whole(Canvas(np.array([6.0, 1.0]), 0.02, 50, 50), [shot], lenses(drive))
