"""Whole quadrilaterals: overexposed paint, unknown blur; the covariance of corners where lines meet."""

import numpy as np
import pytest

from tests.detection.pictures import LENSES, bar, brightness_model, diamond, make_camera, picture, to_image
from tests.detection.test_corners import errors_px, normalised
from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.corners.correlation import variance_inflation
from v2hdm.detection.corners.covariance import corner_covariance
from v2hdm.detection.corners.grey import linear_grey
from v2hdm.detection.corners.quad_fit import fit_quads
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.geometry.quadrilateral import intersect_sides, order_corners, side_frames
from v2hdm.records import STOP_LINE

SHAPES = [diamond(x, y, 1.2, 0.7, 9.0 * y) for x in (6.0, 8.0, 10.0) for y in (-1.9, -0.3, 1.4)]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return brightness_model(tmp_path_factory.mktemp("models"))


def fitted(model, **drawing):
    """Errors (n, 2) and covariances of the valid corners on three pictures, and how many should be there."""
    camera = make_camera()
    detector = Detector.load(model, DetectorOptions())
    truth_px = [to_image(camera, shape) for shape in SHAPES]
    parts = []
    for seed in range(3):
        markings, _ = detector.detect(picture(camera, SHAPES, seed=seed, **drawing), camera)
        parts.append(errors_px(markings, truth_px))
    errors, covariances = (np.concatenate(part) for part in zip(*parts, strict=True))
    return errors, covariances, 3 * 4 * len(SHAPES)


@pytest.mark.parametrize("paint", [1.6, 2.5])
def test_paint_that_is_brighter_than_the_sensor_can_say_is_not_drawn_larger(model, paint):
    """Where the paint is clipped, the visible edge lies outside the true one, by .3 px and more here."""
    errors, covariances, asked = fitted(model, paint=paint, blur_px=0.9)
    assert len(errors) > 0.8 * asked
    size = np.linalg.norm(errors, axis=1)
    assert np.median(size) < 0.12
    assert np.quantile(size, 0.95) < 0.5
    assert np.median(normalised(errors, covariances)) < 3.0


@pytest.mark.parametrize("blur_px", [0.6, 1.2])
def test_a_blur_that_is_not_the_usual_one_is_found(model, blur_px):
    errors, _, asked = fitted(model, blur_px=blur_px)
    assert len(errors) > 0.9 * asked
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.1


@pytest.mark.parametrize("kept", [0.7, 0.5])
def test_a_marking_that_the_network_draws_small_is_fitted_as_a_whole(kept):
    """Blur takes the thin ends of far markings: the start is that much of the diamond, the fit all of it."""
    true_px, fit, moved_px = fitted_from(
        diamond(12.0, 0.0, 0.7, 1.4), diamond(12.0, 0.0, 0.7 * kept, 1.4 * kept)
    )
    assert moved_px > 9
    assert fit.settled[0]
    error = (fit.corners_px[0] - true_px).ravel()
    assert np.abs(error).max() < 1.0
    assert error @ np.linalg.solve(fit.covariance[0], error) < 2 * 8, "as far off as it says"


@pytest.mark.parametrize("lens", sorted(LENSES))
@pytest.mark.parametrize(
    "shape", [bar(6.0, 0.0, 0.3, 2.4), bar(5.0, 0.3, 0.15, 3.2), bar(7.0, 0.0, 0.4, 4.0)]
)
def test_a_bar_across_the_view_is_found_from_end_to_end(tmp_path, lens, shape):
    """It is too slim for its ends to be located by themselves, and so long that the lens bows its sides."""
    camera = make_camera(lens)
    detector = Detector.load(brightness_model(tmp_path, STOP_LINE), DetectorOptions(min_confidence=0.0))
    truth_px = [to_image(camera, shape)]
    assert np.ptp(truth_px[0], axis=0)[0] > 200
    parts = []
    for seed in range(3):
        markings, _ = detector.detect(picture(camera, [shape], seed=seed, ground=0.2, paint=0.6), camera)
        parts.append(errors_px(markings, truth_px))
    errors, covariances = (np.concatenate(part) for part in zip(*parts, strict=True))
    assert len(errors) == 3 * 4
    assert np.linalg.norm(errors, axis=1).max() < 0.25
    assert np.median(normalised(errors, covariances)) < 4.0


def test_a_fit_that_leaves_its_start_behind_has_not_settled():
    """The start lies beside the only marking there is: to reach it the fit would have to wander off."""
    true_px, fit, _ = fitted_from(diamond(12.0, 0.0, 0.7, 1.4), diamond(12.0, 1.0, 0.7, 0.8))
    assert not (fit.settled[0] and np.abs(fit.corners_px[0] - true_px).max() < 5)


def fitted_from(shape, start):
    """True corners, the fit of a drawn shape from that of a start, and how far that was off at most."""
    camera = make_camera("pinhole")
    true_px, start_px = (order_corners(to_image(camera, s)) for s in (shape, start))
    box = np.array([[0, 0, camera.info.width, camera.info.height]])
    grey = linear_grey(picture(camera, [shape]), 0, camera.info.height, box, False)
    owner = np.zeros((camera.info.height // 2, camera.info.width // 2), dtype=np.int16)
    fit = fit_quads(grey, owner, 2, np.array([0]), CameraView(camera, 16), start_px[None], 0.75)
    return true_px, fit, np.abs(true_px - start_px).max()


def test_the_covariance_of_corners_is_that_of_scattered_lines():
    corners = order_corners(np.array([[0.0, 0.0], [40.0, 5.0], [37.0, 22.0], [-3.0, 16.0]]))[None]
    tangent, normal, _ = side_frames(corners)
    middle = (corners + np.roll(corners, -1, axis=1)) / 2
    rng = np.random.default_rng(0)
    root = np.array([[0.2, 0.0], [0.004, 0.006]]) * np.array([1.0, 0.5, 2.0, 1.5])[:, None, None]
    found = np.array([[True, True, True, False]])
    stated = corner_covariance(corners, middle, tangent, normal, (root @ root.swapaxes(1, 2))[None], found)[0]
    offset, slope = np.moveaxis((root @ rng.normal(size=(20000, 4, 2, 1)))[..., 0], -1, 0)
    moved = intersect_sides(middle + offset[..., None] * normal, normal - slope[..., None] * tangent)
    seen = np.cov(moved.reshape(-1, 8).T)
    assert not stated[6:].any()
    assert not stated[:, 6:].any()
    np.testing.assert_allclose(stated[:6, :6], seen[:6, :6], atol=0.03 * np.diag(seen).max())


def test_correlated_residuals_inflate_the_variance_as_they_do_that_of_a_mean():
    rng, rho = np.random.default_rng(1), 0.5
    noise = rng.normal(size=(4000, 200))
    for n in range(1, 200):
        noise[:, n] = rho * noise[:, n - 1] + np.sqrt(1 - rho**2) * noise[:, n]
    factor = variance_inflation(noise[:, 1:], noise[:, :-1], np.ones((4000, 199)), 0.9)
    assert np.median(factor) == pytest.approx(200 * noise.mean(axis=1).var(), rel=0.1)
