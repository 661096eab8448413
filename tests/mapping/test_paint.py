"""Errors of paint, and whether paint is still there."""

import numpy as np
import pytest

from tests.cameras import level
from tests.mapping.scene import MOUNTS
from v2hdm.association.ground import Views
from v2hdm.association.sightings import Rig, Sightings
from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.lens import distort_points
from v2hdm.records import Camera, CameraInfo, Marking
from v2hdm.site.living.looks import Observer, learn_paint
from v2hdm.site.shapes import PaintError, learn_paint_error

FORMAL = (0.001**2) * np.eye(5)


def test_the_scale_and_tails_of_the_deviations_are_found_again():
    rng = np.random.default_rng(0)
    scale = 0.003 * np.sqrt(4.0 / rng.chisquare(4.0, 2000))
    deviations = [rng.normal(0.0, np.hypot(sigma, 0.001), 5) for sigma in scale]
    paint_error = learn_paint_error(deviations, [FORMAL] * len(deviations))
    assert paint_error.sigma_m == pytest.approx(0.003, rel=0.15)
    assert 3.0 < paint_error.freedom < 7.0


def test_paint_without_errors_of_its_own_adds_hardly_anything():
    rng = np.random.default_rng(1)
    deviations = [rng.normal(0.0, 0.001, 5) for _ in range(500)]
    paint_error = learn_paint_error(deviations, [FORMAL] * 500)
    assert paint_error.sigma_m < 0.0005


def test_a_marking_far_from_its_class_is_known_as_badly_as_it_deviates():
    paint = PaintError(0.001, 2.0)
    alike, far = (paint.variance_m2(off * np.ones(5), FORMAL) for off in (0.001, 0.03))
    assert np.sqrt(alike) == pytest.approx(np.sqrt(2 / 7) * 0.001)  # its formal sigma explains the deviation
    assert np.sqrt(far) == pytest.approx(0.03 * np.sqrt(5 / 7), rel=0.02)


def test_without_any_deviation_there_is_still_a_paint_error():
    assert learn_paint_error([], []).sigma_m > 0


def test_the_scatter_of_a_class_that_was_painted_by_hand_is_no_error_of_the_map():
    by_hand = PaintError(0.015, 30.0)
    typical = by_hand.variance_m2(0.015 * np.ones(5), FORMAL)
    assert np.sqrt(typical) < 0.006


INTRINSIC = np.array([[900.0, 0, 640], [0, 900, 350], [0, 0, 1]])
INFO = CameraInfo("front", 1280, 720, INTRINSIC, "plumb_bob", (-0.1, 0.02, 1e-4, -2e-4, 0.0))
CAMERA = Camera(INFO, {"estimated": np.eye(3)}, "estimated", np.array([[4.0, -4], [16, -4], [16, 4], [4, 4]]))
MOUNT = MOUNTS["front"]
DIAMOND = np.array([[0.6, 0.0], [0.0, 0.3], [-0.6, 0.0], [0.0, -0.3]])
PLACES = np.array([[6.0 + 3.0 * k, 2.5 * (-1) ** k] for k in range(12)])
GONE, HIDDEN = 4, 7


def poses():
    return level(1.5 * np.arange(20))


def image(pose, rng):
    """Asphalt with all diamonds but one; a box with a sharp edge stands before another."""
    v, u = np.mgrid[0:720, 0:1280]
    grid = np.column_stack([u.ravel(), v.ravel()]).astype(float)
    grey = rng.normal(60.0, 3.0, 720 * 1280)
    cam_from_map = MOUNT @ np.linalg.inv(pose)
    for number, place in enumerate(PLACES):
        pixel, depth = project_ground(INTRINSIC, cam_from_map, DIAMOND + place)
        if (depth < 1.0).any():
            continue
        corners = distort_points(INFO, pixel)
        if number == HIDDEN:
            low, high = corners.min(axis=0) - 60.0, corners.max(axis=0) + 60.0
            within = ((grid > low) & (grid < high)).all(axis=1)
            left = grid[:, 0] < corners[:, 0].mean() + 3.0 * rng.normal()
            grey[within & left], grey[within & ~left] = 140.0, 40.0
        elif number != GONE:
            low, high = corners.min(axis=0) - 1.0, corners.max(axis=0) + 1.0
            near_pixels = np.flatnonzero(((grid > low) & (grid < high)).all(axis=1))
            sides = np.roll(corners, -1, axis=0) - corners
            off = grid[near_pixels][:, None] - corners
            inside = (sides[:, 0] * off[..., 1] - sides[:, 1] * off[..., 0] < 0).all(axis=1)
            grey[near_pixels[inside]] = rng.normal(130.0, 5.0, int(inside.sum()))
    return np.asarray(grey.reshape(720, 1280), dtype=np.float32)


@pytest.fixture(scope="module")
def observer():
    rng, route = np.random.default_rng(0), poses()
    grey_images = {k: image(route[k], rng) for k in range(len(route))}
    frames, none = np.arange(len(route)), np.zeros(0, dtype=np.int64)
    pixel_fields = (
        none,
        none,
        none,
        none,
        np.zeros((0, 4, 2)),
        np.zeros((0, 4, 2, 2)),
        np.zeros((0, 4), dtype=bool),
    )
    other_fields = ("diamond",), np.zeros_like(frames), np.zeros((0, 4)), np.zeros(0)
    sightings = Sightings(("front",), 0.1 * frames, route, *pixel_fields, *other_fields)
    views, rig = Views(frames, np.zeros_like(frames), frames), Rig(INTRINSIC[None], MOUNT[None], route)
    return Observer(sightings, views, (CAMERA,), rig, 0.0, grey_images.__getitem__)


def contrasts_of(observer):
    outlines = DIAMOND + PLACES[:, None]
    mapped = [Marking("diamond", c, 9) for k, c in enumerate(outlines) if k not in (GONE, HIDDEN)]
    return learn_paint(observer, mapped, PLACES)["diamond"], observer.contrasts(outlines)


def test_paint_stands_out_and_bare_ground_does_not(observer):
    paint, contrast = contrasts_of(observer)
    assert paint.painted[0] == pytest.approx(np.log(130 / 60), abs=0.15)
    assert paint.bare[0] == pytest.approx(0.0, abs=0.03)
    assert contrast[GONE] == pytest.approx(0.0, abs=0.05)


def test_a_gone_marking_is_told_from_a_hidden_and_from_a_worn_one(observer):
    paint, contrast = contrasts_of(observer)
    odds = paint.log_bare(contrast) - paint.log_painted(contrast)
    assert odds[GONE] > 1.5
    assert odds[HIDDEN] < 0.0
    worn = np.array([0.4 * paint.painted[0]])
    assert paint.log_bare(worn) - paint.log_painted(worn) < -1.5


def test_too_few_markings_say_nothing_of_paint(observer):
    few = [Marking("diamond", DIAMOND + place, 9) for place in PLACES[:3]]
    assert learn_paint(observer, few, PLACES) == {}
