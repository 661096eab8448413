"""Corners against truth, on pictures drawn by exact coverage."""

import numpy as np
import pytest

from tests.detection.pictures import bar, brightness_model, diamond, make_camera, picture, to_image
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import ConfigError
from v2hdm.geometry.planar import signed_area

NEAR = [diamond(5.4, y, 1.2, 0.7, yaw) for y, yaw in ((-1.1, 12.0), (0.1, -7.0), (1.2, 20.0))]
FAR = [diamond(x, y, 1.2, 0.7, 9.0 * y) for x in (8.0, 10.0, 12.5, 15.0) for y in (-2.3, -0.4, 1.6)]


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    return tmp_path_factory.mktemp("models")


def detect(models, image, camera, kind="diamond", **options):
    detector = Detector.load(brightness_model(models, kind), DetectorOptions(**options))
    return detector.detect(image, camera)


def errors_px(markings, truth_px):
    """Errors of valid corners (n, 2) with their covariances, each against the nearest true marking."""
    errors, covariances = [], []
    for marking in markings:
        true = min(truth_px, key=lambda t: np.linalg.norm(t.mean(axis=0) - marking.corners_px.mean(axis=0)))
        shift = min(range(4), key=lambda s: np.abs(np.roll(true, s, axis=0) - marking.corners_px).sum())
        for corner in np.flatnonzero(marking.corner_valid):
            block = slice(2 * corner, 2 * corner + 2)
            errors.append(marking.corners_px[corner] - np.roll(true, shift, axis=0)[corner])
            covariances.append(marking.covariance_px[block, block])
    return np.array(errors), np.array(covariances)


def run(models, shapes, lens="plumb_bob", seeds=(0,), kind="diamond", blur_px=0.7, linear=False, **options):
    camera = make_camera(lens)
    camera = camera if not linear else type(camera)(**{**vars(camera), "linear_response": True})
    truth_px = [to_image(camera, shape) for shape in shapes]
    parts, found = [], 0
    for seed in seeds:
        image = picture(
            camera, shapes, blur_px=blur_px, seed=seed, linear=linear, paint=0.9 if linear else 0.5
        )
        markings, _ = detect(models, image, camera, kind, **options)
        found += len(markings)
        parts.append(errors_px(markings, truth_px))
    return *(np.concatenate(part) for part in zip(*parts, strict=True)), found / len(seeds)


def normalised(errors, covariances):
    """Squared errors in units of their stated covariance: 2 on average if that is honest."""
    return np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)


@pytest.mark.parametrize("lens", ["pinhole", "plumb_bob", "equidistant"])
def test_near_corners_are_found_to_a_tenth_of_a_pixel(models, lens):
    errors, _, found = run(models, NEAR, lens)
    assert found == len(NEAR)
    assert len(errors) == 4 * len(NEAR)
    assert np.quantile(np.linalg.norm(errors, axis=1), 0.9) < 0.12


@pytest.mark.parametrize("lens", ["pinhole", "plumb_bob", "rational_polynomial"])
def test_far_corners_are_found_to_a_fifth_of_a_pixel(models, lens):
    errors, _, found = run(models, FAR, lens)
    assert found == len(FAR)
    distance = np.linalg.norm(errors, axis=1)
    assert np.median(distance) < 0.12
    assert np.quantile(distance, 0.9) < 0.35


def test_far_corners_are_not_pushed_outwards(models):
    """A gamma-coded fit widens far markings by some tenths of a px; a linear one must not."""
    errors, _, _ = run(models, FAR, "pinhole", seeds=(1, 2))
    assert np.abs(errors.mean(axis=0)).max() < 0.03


def test_a_camera_with_linear_response_is_taken_at_its_word(models):
    errors, _, found = run(models, NEAR + FAR[:6], linear=True)
    assert found >= len(NEAR) + 5
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.12


@pytest.mark.parametrize(("shapes", "least"), [(NEAR, 0.05), (FAR, 0.2)])
def test_stated_covariances_fit_the_errors(models, shapes, least):
    """On such a clean picture near errors (.01 px) stay far below the floor of .03 px that is stated."""
    errors, covariances, _ = run(models, shapes, seeds=range(3), blur_px=0.75)
    assert least < normalised(errors, covariances).mean() < 4.0


def test_telling_the_blur_does_as_well_as_measuring_it(models):
    camera = make_camera()
    image = picture(camera, NEAR + FAR, blur_px=1.0)
    truth_px = [to_image(camera, shape) for shape in NEAR + FAR]
    medians = [
        np.median(np.linalg.norm(errors_px(detect(models, image, camera, **options)[0], truth_px)[0], axis=1))
        for options in ({}, {"blur_px": 1.0})
    ]
    assert medians[0] < medians[1] + 0.03


def test_corners_run_counter_clockwise_on_the_screen(models):
    camera = make_camera()
    markings, _ = detect(models, picture(camera, NEAR + FAR), camera)
    assert all(signed_area(marking.corners_px) < 0 for marking in markings)


def test_worn_gaps_in_the_sides_do_not_move_near_corners(models):
    camera = make_camera()
    shape = diamond(5.4, 0.0, 1.4, 0.9)
    gaps = [bar(5.75, 0.22, 0.10, 0.10), bar(5.05, -0.24, 0.12, 0.08), bar(5.7, -0.3, 0.08, 0.12)]
    markings, _ = detect(models, picture(camera, [shape], holes=gaps), camera)
    errors, _ = errors_px(markings, [to_image(camera, shape)])
    assert len(errors) == 4
    assert np.linalg.norm(errors, axis=1).max() < 0.4


def test_corners_cut_off_by_the_image_border_are_no_points(models):
    camera = make_camera("pinhole")
    shape = diamond(3.35, 0.0, 1.2, 0.8)
    corners_px = to_image(camera, shape)
    assert (corners_px[:, 1] > camera.info.height).any(), "the scene should cut this marking"
    markings, _ = detect(models, picture(camera, [shape]), camera)
    for marking in markings:
        below = marking.corners_px[:, 1] > camera.info.height - 5
        assert not marking.corner_valid[below].any()
        errors, _ = errors_px([marking], [corners_px])
        assert np.linalg.norm(errors, axis=1).max() < 0.5


def test_a_side_hidden_by_an_occluder_gives_no_valid_corners(models):
    """A dark, straight-edged thing lies over one half: its edge is sharp, and not the marking's."""
    camera = make_camera("pinhole")
    shape = bar(5.4, 0.0, 1.0, 0.8)
    image = picture(camera, [shape])
    middle = int(to_image(camera, np.array([[5.4, 0.0]]))[0, 0])
    image[:, middle:] = 4
    markings, _ = detect(models, image, camera)
    for marking in markings:
        cut = marking.corners_px[:, 0] > middle - 3
        assert not marking.corner_valid[cut].any()


@pytest.mark.parametrize("x", [6.0, 9.0])
def test_a_marking_cut_by_a_straight_edge_like_the_ground_is_not_believed(models, x):
    """Nothing but its shape on the ground tells: the edge's corners are as clean as the others."""
    camera = make_camera("pinhole")
    shape = bar(x, 1.5, 2.0, 1.0)
    image = picture(camera, [shape])
    whole = detect(models, image, camera, min_confidence=0.0)[0]
    assert len(whole) == 1
    middle = int(to_image(camera, np.array([[x, 1.5]]))[0, 0])
    image[:, middle:] = image[0, 0]
    cut = detect(models, image, camera, min_confidence=0.0)[0]
    assert whole[0].score > 0.7
    assert all(marking.score < DetectorOptions.for_mapping().min_confidence for marking in cut)


def test_narrow_far_dashes_are_fitted_as_a_whole(models):
    shapes = [bar(x, y, 3.0, 0.15) for x in (8.0, 12.0) for y in (-1.7, 1.7)]
    errors, _, found = run(models, shapes, kind="lane_dash")
    assert found == len(shapes)
    across = np.median(np.abs(errors[:, 0]))
    assert across < 0.15


def test_markings_beyond_the_range_are_left_out(models):
    camera = make_camera("pinhole")
    image = picture(camera, [diamond(6.0, 0.0), diamond(14.0, 0.0)])
    markings, _ = detect(models, image, camera, max_range_m=10.0)
    assert len(markings) == 1


def test_a_picture_without_paint_gives_nothing(models):
    camera = make_camera()
    assert detect(models, picture(camera, [np.full((4, 2), -50.0)]), camera) == ((), ())


@pytest.mark.parametrize(
    "wrong",
    [{"threads": 0}, {"blur_px": 9.0}, {"max_range_m": 0.0}, {"min_score": 1.5}, {"lane_step_m": -1.0}],
)
def test_options_that_cannot_work_are_refused_by_name(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        DetectorOptions(**wrong)
