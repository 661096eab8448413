"""One fit: where the image tells, a tenth of a pixel; where it does not, a covariance that says so."""

import cv2
import numpy as np
import pytest

from tests.detection.pictures import (
    LENSES,
    bar,
    diamond,
    make_camera,
    output_of,
    patches_of,
    picture,
    to_image,
)
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.coverage import variance_inflation
from v2hdm.detection.fit import fit_quadrilaterals
from v2hdm.detection.propose import open_sides
from v2hdm.geometry.quadrilateral import order_corners, side_frames


def fitted(image, camera, shapes, off_px=1.0, seed=0):
    """The fit, true corners (M, 4, 2) and errors (M, 4, 2), started ``off_px`` away from the truth."""
    view = RoadCamera(camera, 16)
    true_px = np.stack([order_corners(to_image(camera, shape)) for shape in shapes])
    start = true_px + off_px * np.random.default_rng(seed).standard_normal(true_px.shape)
    fit = fit_quadrilaterals(patches_about(image, view, start), view, start, open_sides(start, view))
    corners_px, covariance = fit.corners_px, fit.covariance_px()
    return fit, corners_px, covariance, corners_px - true_px


def patches_about(image, view, outlines_px):
    """The pixels about outlines (M, 4, 2), of whose insides a network says that they are paint."""
    inside = np.zeros((image.shape[0] // 2, image.shape[1] // 2), dtype=np.float32)
    for outline in outlines_px:
        cv2.fillConvexPoly(inside, np.round(outline / 2).astype(np.int32), 1.0)
    return patches_of(image, view, output_of(8 * cv2.GaussianBlur(inside, (0, 0), 1.0) - 4), outlines_px)


def normalised(error, covariance):
    """Squared errors (M, 4) in units of the stated covariance of each corner."""
    blocks = np.stack([covariance[:, k : k + 2, k : k + 2] for k in range(0, 8, 2)], axis=1)
    return (error * np.linalg.solve(blocks, error[..., None])[..., 0]).sum(axis=-1)


def sigma_along(covariance, corner, direction):
    """Standard deviation of a corner along a direction (2,), px."""
    part = covariance[2 * corner : 2 * corner + 2, 2 * corner : 2 * corner + 2]
    unit = direction / np.linalg.norm(direction)
    return float(np.sqrt(unit @ part @ unit))


@pytest.mark.parametrize("lens", sorted(LENSES))
def test_near_and_far_corners_are_found_to_a_tenth_of_a_pixel_and_say_so(lens):
    camera = make_camera(lens)
    shapes = [diamond(x, y, 1.2, 0.7, 9.0 * y) for x in (5.5, 8.0, 11.0) for y in (-1.5, 0.0, 1.5)]
    errors, squares = [], []
    for seed in range(3):
        _, _, covariance, error = fitted(picture(camera, shapes, seed=seed), camera, shapes, seed=seed)
        errors.append(np.linalg.norm(error, axis=-1))
        squares.append(normalised(error, covariance))
    assert np.median(errors) < 0.1
    assert np.quantile(errors, 0.95) < 0.3
    assert 0.05 < np.median(squares) < 3.0


@pytest.mark.parametrize("paint", [1.2, 1.6])
def test_paint_brighter_than_the_sensor_can_say_is_not_drawn_larger(paint):
    """Where the paint is clipped, the visible edge lies outside the true one, by .3 px and more here."""
    camera = make_camera()
    shapes = [diamond(x, y, 1.2, 0.7, 9.0 * y) for x in (6.0, 8.0, 10.0) for y in (-1.9, -0.3, 1.4)]
    fit, _, _, error = fitted(picture(camera, shapes, paint=paint, blur_px=0.9), camera, shapes)
    _, normal, _ = side_frames(fit.quad.corners)
    outward = (error * normal).sum(axis=-1)
    assert abs(np.median(outward)) < 0.12
    assert np.median(np.linalg.norm(error, axis=-1)) < 0.25


@pytest.mark.parametrize("blur_px", [0.6, 1.2])
def test_an_unusual_blur_is_found(blur_px):
    camera = make_camera()
    shapes = [diamond(x, y, 1.2, 0.7) for x in (6.0, 8.0) for y in (-1.0, 0.6)]
    _, _, _, error = fitted(picture(camera, shapes, blur_px=blur_px), camera, shapes)
    assert np.median(np.linalg.norm(error, axis=-1)) < 0.1


@pytest.mark.parametrize("lens", sorted(LENSES))
def test_a_bar_across_the_view_is_found_from_end_to_end(lens):
    """The lens bows its sides by a pixel and more."""
    camera = make_camera(lens)
    shape = bar(6.0, 0.0, 0.3, 2.4)
    _, _, covariance, error = fitted(picture(camera, [shape], ground=0.2, paint=0.6), camera, [shape])
    assert np.linalg.norm(error, axis=-1).max() < 0.25
    assert np.median(normalised(error, covariance)) < 4.0


def test_the_border_of_a_shadow_across_a_dash_moves_no_side():
    camera = make_camera("pinhole")
    shape = bar(7.0, 0.3, 3.0, 0.2)
    image = picture(camera, [shape], ground=0.3, paint=0.8, linear=True).astype(np.float64)
    shade = np.ones(image.shape[:2])
    shade[: int(to_image(camera, shape)[:, 1].mean())] = 0.3
    image *= cv2.GaussianBlur(shade, (0, 0), 1.5)[..., None]
    linear = type(camera)(**{**vars(camera), "linear_response": True})
    _, _, covariance, error = fitted(np.round(image).astype(np.uint8), linear, [shape])
    assert np.linalg.norm(error, axis=-1).max() < 0.5
    assert np.sqrt(covariance[0].diagonal()).max() < 1.0


def test_a_crack_along_one_side_hides_that_side_alone():
    camera = make_camera("pinhole")
    shape = bar(6.0, 0.0, 3.0, 0.3)
    image = picture(camera, [shape]).copy()
    corners = order_corners(to_image(camera, shape))
    _, _, length = side_frames(corners)
    side = int(length.argmax())
    first, last = corners[side], corners[(side + 1) % 4]
    rng = np.random.default_rng(1)
    for share in np.linspace(0, 1, 60):
        at = first + share * (last - first) + rng.normal(0, 1.2, 2)
        cv2.circle(image, tuple(np.round(at).astype(int).tolist()), 2, (25, 25, 25), -1)
    fit, _, _, _ = fitted(image, camera, [shape], off_px=0.5)
    sigma = np.sqrt(fit.side_variance()[0])
    others = np.delete(sigma, side)
    assert sigma[side] > 1.2 * sigma[(side + 2) % 4], "the clean long side stays a good one"
    assert others.max() < 0.6


def test_an_end_beyond_the_border_is_vague_along_the_dash_and_the_other_end_is_not():
    camera = make_camera("pinhole")
    shape = bar(4.2, 0.4, 3.0, 0.2)
    true_px = order_corners(to_image(camera, shape))
    assert true_px[:, 1].max() > camera.info.height + 20
    image = picture(camera, [shape])
    view = RoadCamera(camera, 16)
    seen = true_px.copy()
    for low, high in ((0, 3), (1, 2)):
        assert seen[low, 1] > seen[high, 1]
        share = (camera.info.height - 1 - seen[high, 1]) / (seen[low, 1] - seen[high, 1])
        seen[low] = seen[high] + share * (seen[low] - seen[high])
    start = order_corners(seen)[None]
    fit = fit_quadrilaterals(patches_about(image, view, start), view, start, open_sides(start, view))
    corners_px, covariance = fit.corners_px, fit.covariance_px()
    order = np.argsort(corners_px[0][:, 1])
    along = corners_px[0][order[2:]].mean(axis=0) - corners_px[0][order[:2]].mean(axis=0)
    for corner in order[:2]:
        assert sigma_along(covariance[0], corner, along) < 0.5
    for corner in order[2:]:
        assert sigma_along(covariance[0], corner, along) > 50
        across = sigma_along(covariance[0], corner, np.array([-along[1], along[0]]))
        assert across < 0.1 * sigma_along(covariance[0], corner, along)


def test_yellow_paint_as_bright_as_the_ground_is_found_by_its_colour():
    camera = make_camera("pinhole")
    shape = diamond(6.0, 0.0, 1.2, 0.7)
    mask = picture(camera, [shape], ground=0.0, paint=1.0, noise=0.0, linear=True)[..., :1] / 255.0
    ground, yellow = np.array([90.0, 90.0, 90.0]), np.array([30.0, 97.0, 108.0])
    image = ground + (yellow - ground) * mask
    noisy = image + np.random.default_rng(0).normal(0, 1, image.shape)
    linear = type(camera)(**{**vars(camera), "linear_response": True})
    _, _, _, error = fitted(np.round(noisy).astype(np.uint8), linear, [shape])
    assert np.linalg.norm(error, axis=-1).max() < 0.3


def test_without_any_paint_the_corners_are_as_vague_as_the_outline():
    camera = make_camera("pinhole")
    shape = diamond(6.0, 0.0, 1.2, 0.7)
    _, _, covariance, _ = fitted(picture(camera, [diamond(60.0, 0.0)]), camera, [shape])
    assert np.sqrt(covariance[0].diagonal()).min() > 1.0


def test_correlated_residuals_inflate_the_variance_as_they_do_that_of_a_mean():
    rng, rho = np.random.default_rng(1), 0.5
    noise = rng.normal(size=(4000, 200))
    for n in range(1, 200):
        noise[:, n] = rho * noise[:, n - 1] + np.sqrt(1 - rho**2) * noise[:, n]
    factor = variance_inflation(noise[:, 1:], noise[:, :-1], np.ones((4000, 199)), 0.9)
    assert np.median(factor) == pytest.approx(200 * noise.mean(axis=1).var(), rel=0.1)
