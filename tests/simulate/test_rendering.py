"""The 50 % point of a painted edge must lie where the polygon's projection says."""

from dataclasses import replace

import numpy as np
import pytest

from tests.simulate.conftest import tiny_port
from v2hdm.errors import DriveError
from v2hdm.executor import HERE, open_executor
from v2hdm.geometry.lens import distort_points
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.records import DIAMOND, CameraInfo
from v2hdm.simulate.port.drive import render_drive
from v2hdm.simulate.render.renderer import Motion, Optics, Renderer
from v2hdm.simulate.render.scene import Box, Ground, Light, Paint, Scene
from v2hdm.simulate.render.view import camera_rays


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def ignore(done, total):
    pass


def test_two_workers_write_the_same_bytes_as_one(tiny_drive, tmp_path):
    with open_executor(2) as executor:
        render_drive(tiny_port(), tmp_path / "tiny", executor, ignore)
    assert contents(tmp_path / "tiny") == contents(tiny_drive)


def test_a_stopped_render_is_no_drive_and_goes_on_where_it_was(tiny_drive, tmp_path):
    folder = tmp_path / "tiny"

    def stop(done, total):
        if done == 7:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        render_drive(tiny_port(), folder, HERE, stop)
    with pytest.raises(DriveError):
        read_drive(folder)
    stamps = {path: path.stat().st_mtime_ns for path in folder.rglob("*.jpg")}
    assert len(stamps) == 7
    counts: list[int] = []
    render_drive(tiny_port(), folder, HERE, lambda done, total: counts.append(done))
    assert counts[0] == 7
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in stamps.items())
    assert contents(folder) == contents(tiny_drive)


def test_recorded_poses_err_by_what_is_configured_and_images_lie_between_them(tiny_drive):
    drive = read_drive(tiny_drive)
    truth = read_truth(drive)
    recorded = np.array([i.map_from_vehicle for i in drive.images])
    error = np.linalg.norm(recorded[:, :2, 3] - truth.map_from_vehicle[:, :2, 3], axis=1)
    assert 0.001 < np.sqrt((error**2).mean()) < 0.05
    assert truth.disturbances["roll_pitch_deg"] >= 0.1


def test_truth_says_which_markings_an_image_shows(tiny_drive):
    """A marking straight ahead of the first front image is seen whole, one behind it not at all."""
    drive = read_drive(tiny_drive)
    truth = read_truth(drive)
    first = next(k for k, image in enumerate(drive.images) if image.camera == "front")
    vehicle_from_map = np.linalg.inv(truth.map_from_vehicle[first])
    centres = np.array([m.corners_map.mean(axis=0) for m in truth.map.markings])
    ahead = (np.column_stack([centres, np.zeros(len(centres)), np.ones(len(centres))]) @ vehicle_from_map.T)[
        :, :2
    ]
    in_lane = (ahead[:, 0] > 9) & (ahead[:, 0] < 14) & (np.abs(ahead[:, 1]) < 1)
    assert truth.visibility[first][in_lane].max() == 1.0
    assert truth.visibility[first][ahead[:, 0] < 3].max(initial=0.0) == 0.0
    assert any(flags.any() for flags in truth.lane_visible)


INFO = CameraInfo(
    "front", 640, 360, np.array([[450.0, 0, 322.0], [0, 450.0, 178.0], [0, 0, 1]]), "plumb_bob",
    (-0.12, 0.03, 0.0005, -0.0004, 0.0),
)  # fmt: skip
# A camera 2.4 m above the map's origin that looks along x, 18 degrees down.
SIN, COS = np.sin(np.deg2rad(18.0)), np.cos(np.deg2rad(18.0))
CAM_FROM_MAP = np.array(
    [[0, -1, 0, 0], [-SIN, 0, -COS, 2.4 * COS], [COS, 0, -SIN, 2.4 * SIN], [0, 0, 0, 1.0]]
)
BARE = Ground(contrast=0.0, stains=0.0)
CLEAN = Optics(psf_sigma_px=0.7, vignetting=0.0, read_noise=0.0, full_well_electrons=1e12, mean_level=0.2)


def picture(scene, motion=None):
    return Renderer(scene).render(INFO, CAM_FROM_MAP, np.random.default_rng(0), CLEAN, motion)


def pinhole(points_map):
    cam = (
        np.column_stack([points_map, np.zeros(len(points_map)), np.ones(len(points_map))])
        @ CAM_FROM_MAP[:3].T
    )
    px = cam @ INFO.intrinsic.T
    return px[:, :2] / px[:, 2:]


def linear(image):
    level = image[..., 1] / 255.0
    return np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)


def edge_offset_px(rendered, a, b):
    """How far outside the pinhole edge a-b (inside on its left, y up) the 50 % crossing lies on average."""
    rays = camera_rays(INFO)
    along = (b - a) / np.linalg.norm(b - a)
    p = np.dstack([rays.u_pinhole_px, rays.v_pinhole_px]) - a
    position = p @ along
    # v points down, so the outside of a counter-clockwise polygon is on this side.
    outside = -(p[..., 0] * -along[1] + p[..., 1] * along[0]) * -1.0
    reach = 3.0
    is_near = (np.abs(outside) < reach) & (position > 6) & (position < np.linalg.norm(b - a) - 6)
    values, distance = linear(rendered.image)[is_near], outside[is_near]
    bins = np.floor((distance + reach) * 4).astype(int)
    profile = np.array([values[bins == k].mean() for k in range(24)])
    share = (profile - profile[-3:].mean()) / (profile[:3].mean() - profile[-3:].mean())
    return float((share.mean() - 0.5) * 2 * reach)


@pytest.mark.parametrize("centre", [(5.5, 0.3), (6.0, -1.4), (8.0, 1.2)])
@pytest.mark.parametrize("motion", [None, Motion(velocity_cam=(0.0, 1.5, 4.7), exposure_s=0.003)])
def test_a_painted_edge_lies_within_a_twentieth_of_a_pixel(centre, motion):
    half = np.array([[1.2, 0.0], [0.0, 0.9], [-1.2, 0.0], [0.0, -0.9]])
    diamond = half + centre
    rendered = picture(
        Scene(ground=BARE, paints=(Paint(kind=DIAMOND, polygon_map=diamond, wear=0.0, dirt=0.0),)), motion
    )
    corners = pinhole(diamond)
    offsets = [edge_offset_px(rendered, corners[k], corners[(k + 1) % 4]) for k in range(4)]
    assert np.abs(offsets).max() < 0.05


def test_an_image_may_have_any_size():
    size = {"width": 203, "height": 131}
    motion = Motion(velocity_cam=(0.0, 1.5, 4.7), exposure_s=0.003)
    rendered = Renderer(Scene()).render(
        replace(INFO, **size), CAM_FROM_MAP, np.random.default_rng(0), CLEAN, motion
    )
    assert rendered.image.shape == (131, 203, 3)


def test_labels_cover_the_polygon_and_nothing_else():
    square = np.array([[5.0, -1.0], [7.0, -1.0], [7.0, 1.0], [5.0, 1.0]])
    rendered = picture(Scene(ground=BARE, paints=(Paint(kind=DIAMOND, polygon_map=square),)))
    rows, columns = np.nonzero(rendered.labels == 1)
    corners = distort_points(INFO, pinhole(square))
    u, v = corners.T
    area = 0.5 * abs(float(u @ np.roll(v, -1) - v @ np.roll(u, -1)))
    # The lens bends the sides by some tenths of a pixel over their length, hence the tolerance.
    assert len(rows) == pytest.approx(area, rel=0.01)
    assert (columns.min(), rows.min()) == pytest.approx((u.min(), v.min()), abs=1.5)


def test_a_box_hides_paint_and_takes_its_label():
    square = np.array([[8.0, -1.0], [10.0, -1.0], [10.0, 1.0], [8.0, 1.0]])
    paint = (Paint(kind=DIAMOND, polygon_map=square),)
    wall = Box(centre_map=(6.0, 0.0), size_m=(0.3, 4.0, 2.0))
    assert (picture(Scene(ground=BARE, paints=paint)).labels > 0).any()
    hidden = picture(Scene(ground=BARE, paints=paint, boxes=(wall,)))
    assert not hidden.labels.any()
    assert hidden.hidden.any()


def test_a_shadow_falls_away_from_the_sun():
    """The sun stands on the left (+y); a post's shadow darkens the ground on its right."""
    post = Box(centre_map=(7.0, 0.0), size_m=(0.3, 0.3, 1.0))
    light = Light(sun_direction_map=(0.0, 0.7, 0.7))
    bare, shaded = (
        picture(Scene(ground=BARE, boxes=b, light=light)).image.astype(int) for b in ((), (post,))
    )
    left, right = distort_points(INFO, pinhole(np.array([[7.0, 0.6], [7.0, -0.6]]))).round().astype(int)
    assert abs(shaded[left[1], left[0]] - bare[left[1], left[0]]).max() < 8
    assert (bare[right[1], right[0]] - shaded[right[1], right[0]]).min() > 20


def test_a_picture_is_a_function_of_scene_place_and_random_state():
    scene = Scene(ground=Ground(texture="asphalt", wet_fraction=0.2))
    noisy = Optics()
    renderer = Renderer(scene)
    picture, two, other = (
        renderer.render(INFO, CAM_FROM_MAP, np.random.default_rng(seed), noisy).image for seed in (3, 3, 4)
    )
    assert np.array_equal(picture, two)
    assert not np.array_equal(picture, other)


def test_a_camera_that_looks_up_sees_only_sky():
    turned = CAM_FROM_MAP.copy()
    turned[1, :3], turned[2, :3] = CAM_FROM_MAP[2, :3], -CAM_FROM_MAP[1, :3]
    turned[:3, 3] = -turned[:3, :3] @ np.array([0, 0, 2.4])
    rendered = Renderer(Scene()).render(INFO, turned, np.random.default_rng(0))
    assert rendered.image.min() > 0
