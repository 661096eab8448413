"""Corners against truth: of one fit, and of the whole detector."""

import cv2
import numpy as np
import pytest

from tests.detection.pictures import (
    LENSES,
    bar,
    brightness_model,
    diamond,
    extrinsic,
    make_camera,
    output_of,
    patches_of,
    picture,
    to_image,
)
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.quads.fit import fit_quadrilaterals
from v2hdm.detection.quads.propose import open_sides
from v2hdm.detection.quads.robust import variance_inflation
from v2hdm.geometry.planar import order_corners, side_frames, signed_area
from v2hdm.simulate.render.renderer import Renderer
from v2hdm.simulate.render.scene import Box, Paint, Scene

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
    parts, count = [], 0
    for seed in seeds:
        image = picture(
            camera, shapes, blur_px=blur_px, seed=seed, linear=linear, paint=0.9 if linear else 0.5
        )
        markings, _ = detect(models, image, camera, kind, **options)
        count += len(markings)
        parts.append(errors_px(markings, truth_px))
    return *(np.concatenate(part) for part in zip(*parts, strict=True)), count / len(seeds)


def normalised(errors, covariances):
    """Squared errors in units of their stated covariance: 2 on average if that is honest."""
    return np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)


@pytest.mark.parametrize("lens", sorted(LENSES))
def test_near_corners_are_found_to_a_tenth_of_a_pixel(models, lens):
    errors, _, count = run(models, NEAR, lens)
    assert count == len(NEAR)
    assert len(errors) == 4 * len(NEAR)
    assert np.quantile(np.linalg.norm(errors, axis=1), 0.9) < 0.12


@pytest.mark.parametrize("lens", ["pinhole", "plumb_bob", "rational_polynomial"])
def test_far_corners_are_found_to_a_fifth_of_a_pixel(models, lens):
    errors, _, count = run(models, FAR, lens)
    assert count == len(FAR)
    distance = np.linalg.norm(errors, axis=1)
    assert np.median(distance) < 0.12
    assert np.quantile(distance, 0.9) < 0.35


def test_far_corners_are_not_pushed_outwards(models):
    """A gamma-coded fit widens far markings by some tenths of a px; a linear one must not."""
    errors, _, _ = run(models, FAR, "pinhole", seeds=(1, 2))
    assert np.abs(errors.mean(axis=0)).max() < 0.03


def test_a_camera_with_linear_response_is_taken_at_its_word(models):
    errors, _, count = run(models, NEAR + FAR[:6], linear=True)
    assert count >= len(NEAR) + 5
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


@pytest.mark.parametrize("occluder", ["dark", "like the ground"])
def test_a_diamond_half_hidden_behind_a_straight_edge_is_not_believed(occluder):
    """The edge is as clean as the paint's own: only the shape on the ground, and the image about it, tell."""
    camera = make_camera("pinhole")
    detector = Detector.load(None, DetectorOptions(min_confidence=0.0))
    whole, cut = [], []
    for x in (5.4, 7.0, 9.0):
        for yaw_deg in (0.0, 20.0):
            image = picture(camera, [diamond(x, 0.5, 1.2, 0.8, yaw_deg)])
            middle = int(to_image(camera, np.array([[x, 0.5]]))[0, 0])
            whole.append(max(marking.score for marking in detector.detect(image, camera)[0]))
            image[:, middle:] = 4 if occluder == "dark" else image[0, 0]
            cut.append(max((marking.score for marking in detector.detect(image, camera)[0]), default=0.0))
    assert min(whole) > 0.9
    assert max(cut) < min(whole)
    assert np.mean(cut) < 0.5
    assert np.mean(np.array(cut) > DetectorOptions().min_confidence) < 0.2


@pytest.mark.parametrize("y", [-0.6, 0.4])
def test_a_bar_half_hidden_behind_a_dark_edge_has_no_points_there(models, y):
    """Only its length tells an edge that looks like ground, and one image knows only the class's length."""
    camera = make_camera("pinhole")
    image = picture(camera, [bar(6.0, y, 0.3, 2.4)], ground=0.2, paint=0.6)
    middle = int(to_image(camera, np.array([[6.0, y]]))[0, 0])
    (whole,), _ = detect(models, image, camera, "stop_line", min_confidence=0.0)
    assert whole.corner_valid.all()
    image[:, middle:] = 4
    (cut,), _ = detect(models, image, camera, "stop_line", min_confidence=0.0)
    hidden = cut.corners_px[:, 0] > middle - 5
    assert hidden.sum() == 2
    np.testing.assert_array_equal(cut.corner_valid, ~hidden)


def dash_behind(box_at):
    """The dash seen first in a rendered image of one from 6 to 9 m ahead, perhaps behind a box 70 cm wide."""
    camera = make_camera("pinhole")
    dash = np.array([[6.0, -0.075], [9.0, -0.075], [9.0, 0.075], [6.0, 0.075]])
    boxes = [Box(centre_map=box_at, size_m=(0.3, 0.7, 0.3), albedo_bgr=(0.1, 0.25, 0.5))] if box_at else []
    scene = Scene(paints=(Paint(kind="lane_dash", polygon_map=dash),), boxes=tuple(boxes))
    image = Renderer(scene).render(camera.info, extrinsic(), np.random.default_rng(0)).image
    markings, _ = Detector.load(options=DetectorOptions.for_mapping()).detect(image, camera)
    surest = max(markings, key=lambda marking: marking.score)
    order = np.argsort(surest.corners_px[:, 1])
    along = surest.corners_px[order[2:]].mean(axis=0) - surest.corners_px[order[:2]].mean(axis=0)
    sigma_px = [sigma_along(surest.covariance_px, corner, along) for corner in order]
    return surest, order, sigma_px


def test_an_end_behind_a_box_is_vague_along_the_dash_and_one_that_is_seen_is_not():
    dash, _, sigma_px = dash_behind(None)
    assert dash.corner_valid.all()
    assert max(sigma_px) < 5
    for box_at, hidden in (((8.4, 0.0), slice(0, 2)), ((6.2, 0.0), slice(2, 4))):
        dash, order, sigma_px = dash_behind(box_at)
        assert not dash.corner_valid[order[hidden]].any()
        assert min(sigma_px[hidden]) > 5
        visible_corners = [k for k in range(4) if k not in range(4)[hidden]]
        assert dash.corner_valid[order[visible_corners]].all()
        assert max(sigma_px[k] for k in visible_corners) < 5


def test_narrow_far_dashes_are_fitted_as_a_whole(models):
    shapes = [bar(x, y, 3.0, 0.15) for x in (8.0, 12.0) for y in (-1.7, 1.7)]
    errors, _, count = run(models, shapes, kind="lane_dash")
    assert count == len(shapes)
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


def squares_of(error, covariance):
    """Squared errors (M, 4) in units of the stated covariance of each corner."""
    blocks = np.stack([covariance[:, k : k + 2, k : k + 2] for k in range(0, 8, 2)], axis=1)
    return (error * np.linalg.solve(blocks, error[..., None])[..., 0]).sum(axis=-1)


def sigma_along(covariance, corner, direction):
    """Standard deviation of a corner along a direction (2,), px."""
    part = covariance[2 * corner : 2 * corner + 2, 2 * corner : 2 * corner + 2]
    unit = direction / np.linalg.norm(direction)
    return float(np.sqrt(unit @ part @ unit))


@pytest.mark.parametrize(("x", "y", "yaw"), [(8.0, -1.0, 30.0), (20.0, 2.0, 85.0), (26.0, -4.0, 30.0)])
def test_a_marking_is_fitted_alike_whatever_else_the_image_shows(x, y, yaw):
    """The bands about a slim dash's sides go on beyond its sharp corners; the larger markings' boxes too."""
    camera = make_camera()
    view = RoadCamera(camera, 16)
    shapes = [bar(x, y, 3.0, 0.15, yaw), diamond(6.0, 1.0, 1.2, 0.7, 20.0), bar(8.0, -1.5, 4.0, 0.3)]
    image = picture(camera, shapes)
    start = np.stack([order_corners(to_image(camera, shape)) for shape in shapes]) + 0.7
    output = patches_about(image, view, start).output

    def corners_px(count):
        patches = patches_of(image, view, output, start[:count])
        return fit_quadrilaterals(patches, view, start[:count], open_sides(start[:count], view)).corners_px

    np.testing.assert_allclose(corners_px(3)[0], corners_px(1)[0], atol=0.005)


@pytest.mark.parametrize("paint", [1.2, 1.6])
def test_paint_brighter_than_the_sensor_can_say_is_not_drawn_larger(paint):
    """Where the paint is clipped, the visible edge lies outside the true one, by .3 px and more here."""
    camera = make_camera()
    shapes = [diamond(x, y, 1.2, 0.7, 9.0 * y) for x in (6.0, 8.0, 10.0) for y in (-1.9, -0.3, 1.4)]
    fit, _, _, error = fitted(picture(camera, shapes, paint=paint, blur_px=0.9), camera, shapes)
    normal = side_frames(fit.quad.corners).normal
    outward = (error * normal).sum(axis=-1)
    assert abs(np.median(outward)) < 0.12
    assert np.median(np.linalg.norm(error, axis=-1)) < 0.25


@pytest.mark.parametrize("lens", sorted(LENSES))
def test_a_bar_across_the_view_is_found_from_end_to_end(lens):
    """The lens bows its sides by a pixel and more."""
    camera = make_camera(lens)
    shape = bar(6.0, 0.0, 0.3, 2.4)
    _, _, covariance, error = fitted(picture(camera, [shape], ground=0.2, paint=0.6), camera, [shape])
    assert np.linalg.norm(error, axis=-1).max() < 0.25
    assert np.median(squares_of(error, covariance)) < 4.0


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
    length = side_frames(corners).length
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
    cut_px = true_px.copy()
    for low, high in ((0, 3), (1, 2)):
        assert cut_px[low, 1] > cut_px[high, 1]
        share = (camera.info.height - 1 - cut_px[high, 1]) / (cut_px[low, 1] - cut_px[high, 1])
        cut_px[low] = cut_px[high] + share * (cut_px[low] - cut_px[high])
    start = order_corners(cut_px)[None]
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
