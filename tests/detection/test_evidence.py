"""What speaks for a marking: the image about its sides, and the probability that is made of it."""

import json

import cv2
import numpy as np
import onnx
import pytest

from tests.detection.pictures import (
    bar,
    brightness_model,
    crisp_view,
    diamond,
    make_camera,
    picture,
    to_image,
)
from train.fit_judge import fit
from v2hdm.detection.corners.confidence import SHAPES, TOLD, confidence
from v2hdm.detection.corners.evidence import FEATURES, Steps, grey_steps, whole_ends
from v2hdm.detection.corners.found import Corners
from v2hdm.detection.corners.grey import linear_grey
from v2hdm.detection.corners.rectified import CHANNELS
from v2hdm.detection.corners.refine import doubt_corners
from v2hdm.detection.corners.straight import Quads
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.weights import CONFIDENCE_FILE, JUDGE_FILE
from v2hdm.geometry.quadrilateral import order_corners
from v2hdm.records import CROSSWALK_BAR, DIAMOND, LANE_DASH, STOP_LINE


def steps_of(image: np.ndarray, corners_px: np.ndarray) -> Steps:
    whole = np.array([[0, 0, image.shape[1], image.shape[0]]])
    return grey_steps(linear_grey(image, 0, len(image), whole, False), Quads.straight(corners_px))


def test_the_steps_of_a_marking_are_those_of_its_paint_and_end_at_its_corners():
    camera = make_camera("pinhole")
    shapes = [diamond(6.0, 0.0), bar(6.0, 1.6, 1.5, 0.4)]
    corners_px = np.stack([order_corners(to_image(camera, shape)) for shape in shapes])
    steps = steps_of(picture(camera, shapes, ground=0.1, paint=0.5), corners_px)
    np.testing.assert_allclose(steps.typical, np.log(0.51 / 0.11), atol=0.1)
    assert np.abs(steps.going_on).max() < 0.26
    assert not steps.runs_on().any()


def test_a_side_that_runs_on_spoils_the_corner_that_it_passes():
    """A quadrilateral laid over part of a bar: its far end is nowhere, and its long sides run on there."""
    camera = make_camera("pinhole")
    image = picture(camera, [bar(6.0, 0.0, 3.0, 0.5)])
    part_px = order_corners(to_image(camera, bar(5.5, 0.0, 2.0, 0.5)))
    runs_on = steps_of(image, part_px[None]).runs_on()[0]
    upper = part_px[:, 1] < part_px[:, 1].mean()
    np.testing.assert_array_equal(runs_on, upper)


def test_all_sides_of_paint_are_even_in_sun_and_in_shade_and_half_in_each():
    camera = make_camera("pinhole")
    shapes = [diamond(6.0, 0.0), bar(6.0, 1.6, 1.5, 0.4)]
    corners_px = np.stack([order_corners(to_image(camera, shape)) for shape in shapes])
    image = picture(camera, shapes, ground=0.2, paint=0.6, linear=True).astype(np.float64)
    shaded = image.copy()
    shaded[: int(corners_px[0, :, 1].mean())] *= 0.4
    for lit in (image, shaded, 0.4 * image):
        whole = np.array([[0, 0, image.shape[1], image.shape[0]]])
        grey = linear_grey(lit.astype(np.uint8), 0, len(image), whole, True)
        assert not grey_steps(grey, Quads.straight(corners_px)).uneven().any()


@pytest.mark.parametrize("beyond", [0.3, 0.05])
def test_a_worn_end_and_one_that_a_shadow_makes_are_uneven(beyond):
    """What lies beyond the far end is paint half gone, or ground and paint in shade alike."""
    camera = make_camera("pinhole")
    seen = bar(6.0, 0.0, 2.0, 0.3)
    corners_px = order_corners(to_image(camera, seen))
    image = picture(camera, [seen], ground=0.15, paint=0.5, noise=0.0, linear=True).astype(np.float64) / 255
    rest = to_image(camera, bar(7.5, 0.0, 1.0, 0.3 if beyond > 0.15 else 4.0))
    cv2.fillConvexPoly(image, np.round(rest * 16).astype(np.int32), (beyond,) * 3, cv2.LINE_AA, 4)
    whole = np.array([[0, 0, image.shape[1], image.shape[0]]])
    grey = linear_grey(np.round(255 * image).astype(np.uint8), 0, len(image), whole, True)
    uneven = grey_steps(grey, Quads.straight(corners_px[None])).uneven()[0]
    np.testing.assert_array_equal(uneven, corners_px[:, 1] < corners_px[:, 1].mean())


def test_what_spoils_one_corner_of_an_end_spoils_the_other():
    """Side 1 runs on beyond corner 2; which corner shares an end with that is for the lengths to say."""
    going_on = np.zeros((1, 4, 2, 3))
    going_on[0, 1, 1] = 0.9
    steps = Steps(
        along=np.ones((1, 4, 12)),
        typical=np.ones(1),
        near=np.ones(1),
        by_side=np.ones((1, 4)),
        going_on=going_on,
        overexposed=np.zeros(1),
    )
    runs_on = steps.runs_on()
    assert runs_on[0].tolist() == [False, False, True, False]
    assert not steps.uneven().any()
    across, along = np.array([[1.0, 9.0, 1.0, 9.0]]), np.array([[9.0, 1.0, 9.0, 1.0]])
    assert whole_ends(runs_on, across)[0].tolist() == [False, False, True, True]
    assert whole_ends(runs_on, along)[0].tolist() == [False, True, True, False]


@pytest.mark.parametrize(
    ("kind", "vague", "valid"),
    [
        (DIAMOND, False, [False, True, True, False]),
        (DIAMOND, True, [True, True, True, False]),
        (LANE_DASH, False, [True, True, False, False]),
        (LANE_DASH, True, [True, True, False, False]),
    ],
)
def test_doubtful_corners_are_not_valid_but_vague_ones_of_diamonds_where_those_are_asked_for(
    kind, vague, valid
):
    """Of a diamond the uneven ones are in doubt, of anything longer those of its spoilt ends."""
    found = Corners.at(np.zeros((1, 4, 2)))
    found.covariance *= 0.01
    found.valid[0] = True, True, True, False
    uneven, spoilt_ends = np.array([[True, False, False, True]]), np.array([[False, False, True, True]])
    doubt_corners(found, uneven, spoilt_ends, [kind], vague)
    assert found.valid[0].tolist() == valid
    sigma = np.sqrt(np.diagonal(found.covariance[0]))
    np.testing.assert_allclose(sigma[2:6], 0.1)
    np.testing.assert_allclose(sigma[:2], 2.0 if kind == DIAMOND and vague else 0.1, atol=0.01)


def test_corners_on_the_border_of_a_shadow_are_not_valid(tmp_path):
    """The network sees the sunny part of a bar only; the shadow's border runs on over the ground."""
    camera = make_camera("pinhole")
    shape = bar(5.4, 0.0, 1.4, 0.9)
    image = picture(camera, [shape], ground=0.2, paint=0.6).astype(np.float64)
    border = int(to_image(camera, np.array([[5.4, 0.0]]))[0, 1])
    image[:border] *= 0.4
    detector = Detector.load(brightness_model(tmp_path, "crosswalk_bar", 160), DetectorOptions())
    for marking in detector.detect(image.astype(np.uint8), camera)[0]:
        on_border = np.abs(marking.corners_px[:, 1] - border) < 3
        assert not marking.corner_valid[on_border].any()


def test_steps_tell_what_is_overexposed():
    camera = make_camera()
    shapes = [diamond(6.0, 0.0)]
    corners_px = np.stack([order_corners(to_image(camera, shape)) for shape in shapes])
    shares = [steps_of(picture(camera, shapes, paint=paint), corners_px).overexposed for paint in (0.5, 1.5)]
    assert shares[0] == pytest.approx(0.0)
    assert shares[1] > 0.8


def confidences(image: np.ndarray, folder) -> list[float]:
    options = DetectorOptions(min_confidence=0.0)
    detector = Detector.load(brightness_model(folder), options)
    return [marking.score for marking in detector.detect(image, make_camera("pinhole"))[0]]


@pytest.mark.parametrize("x", [6.0, 10.0])
def test_a_round_soft_fleck_is_improbable_where_a_diamond_is_not(tmp_path, x):
    camera = make_camera("pinhole")
    (painted,) = confidences(picture(camera, [diamond(x, 0.0, 1.2, 0.7)]), tmp_path)
    image = np.full((camera.info.height, camera.info.width), 95, dtype=np.float32)
    box_px = to_image(camera, diamond(x, 0.0, 1.2, 0.9))
    size = np.ptp(box_px, axis=0) / 2
    centre = tuple(box_px.mean(axis=0).astype(int).tolist())
    cv2.ellipse(image, centre, tuple(size.astype(int).tolist()), 0, 0, 360, 190, cv2.FILLED)
    soft = cv2.GaussianBlur(image, (0, 0), float(size[1] / 3))
    fleck = np.repeat(np.round(soft)[..., None], 3, axis=2).astype(np.uint8)
    found = confidences(fleck, tmp_path)
    assert found, "the network takes it for paint"
    assert painted > DetectorOptions().min_confidence > max(found)
    assert painted / (1 - painted) > 5 * max(found) / (1 - max(found))


def test_a_fleck_among_painted_diamonds_is_believed_far_less_than_they_are(tmp_path):
    """Although the network is as sure of it as of them."""
    camera = make_camera("pinhole")
    field = [diamond(x, y, 1.2, 0.7) for x in (5.5, 8.5) for y in (-1.5, 1.5)]
    image = picture(camera, field)
    box_px = to_image(camera, diamond(7.0, 0.0, 0.8, 1.6))
    centre, size = box_px.mean(axis=0).astype(int).tolist(), (np.ptp(box_px, axis=0) / 2).astype(int)
    light = np.zeros(image.shape, dtype=np.float32)
    cv2.ellipse(light, centre, size.tolist(), 0, 0, 360, (95.0, 95.0, 95.0), cv2.FILLED)
    image = np.clip(image + cv2.GaussianBlur(light, (0, 0), 4.0), 0, 255).astype(np.uint8)
    detector = Detector.load(brightness_model(tmp_path), DetectorOptions(min_confidence=0.0))
    markings = sorted(detector.detect(image, camera)[0], key=lambda marking: marking.score)
    assert len(markings) == 5
    assert np.abs(markings[0].corners_px.mean(axis=0) - centre).max() < 5
    fleck, faintest = (marking.score for marking in markings[:2])
    assert faintest / (1 - faintest) > 10 * fleck / (1 - fleck)


def test_judge_and_weights_are_those_of_what_is_measured_and_prefer_evidence():
    label = json.loads(onnx.load(JUDGE_FILE).metadata_props[0].value)
    assert (label["features"], label["channels"]) == ([*FEATURES], [*CHANNELS])
    assert label["shapes"] == [*SHAPES]
    fitted = json.loads(CONFIDENCE_FILE.read_text())
    assert set(fitted) == set(SHAPES)
    assert all(set(fitted[shape]["weights"]) == set(TOLD) for shape in SHAPES)
    kinds = [DIAMOND, LANE_DASH, STOP_LINE, CROSSWALK_BAR]
    none, all_around = np.zeros((2, len(kinds), len(FEATURES)))
    for name in ("odds_inside", "surest_inside"):
        all_around[:, FEATURES.index(name)] = 5.0
    for name in (
        "certainty",
        "share",
        "possible_share",
        "four_corners",
        "support",
        "weakest_side",
        "sharpness",
    ):
        all_around[:, FEATURES.index(name)] = 1.0
    views = np.stack([crisp_view(kind) for kind in kinds])
    ground = 100.0 * np.arange(len(kinds))[:, None, None] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    assert (confidence(none, views, kinds, ground) < confidence(all_around, views, kinds, ground)).all()
    first, second = confidence(all_around, views, kinds, ground)[2:]
    assert first == second, "bars of any class are judged alike"


def test_the_fit_of_the_weights_finds_those_that_made_the_data():
    rng = np.random.default_rng(0)
    evidence = rng.normal(size=(20000, 3)) * [1.0, 10.0, 0.1] + [0.0, 5.0, 1.0]
    weights, bias = np.array([1.0, -0.1, 8.0]), -7.0
    true = rng.random(20000) < 1 / (1 + np.exp(-evidence @ weights - bias))
    found, found_bias = fit(evidence, true)
    np.testing.assert_allclose(found, weights, rtol=0.1)
    assert found_bias == pytest.approx(bias, rel=0.1)
