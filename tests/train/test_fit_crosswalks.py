"""The fit of what a row says of its bars, and of logistic regressions."""

import numpy as np
import pytest

from tests.detection.pictures import bar, make_camera, to_image
from train.examples import Example, TrueMarking
from train.fit_crosswalks import _is_bar
from train.logistic import likeliest_weights
from v2hdm.detection.network import as_probability

CAMERA = make_camera("pinhole")


@pytest.mark.parametrize("weights", [(0.5, -1.0, 2.0), (0.0, 0.0, 0.0)])
def test_the_weights_that_made_the_truth_are_fitted_to_it(weights):
    rng = np.random.default_rng(4)
    features = rng.normal(0.0, 1.0, (6000, 3))
    offset = rng.normal(0.0, 1.0, 6000)
    is_true = rng.random(6000) < as_probability(offset + features @ np.array(weights))
    fitted = likeliest_weights(features, offset, is_true.astype(float), ridge=0.2)
    assert fitted == pytest.approx(weights, abs=0.15)


def test_few_examples_leave_the_weights_near_nought():
    fitted = likeliest_weights(np.ones((1, 1)), np.zeros(1), np.ones(1), ridge=2.0)
    assert 0.0 < fitted[0] < 0.3


def test_a_bar_is_one_by_its_overlap_in_a_render_and_by_its_middle_in_a_photograph():
    corners = to_image(CAMERA, bar(8.0, 0.0, 2.0, 0.4))
    shifted = to_image(CAMERA, bar(8.0, 0.3, 2.0, 0.4))
    beside = to_image(CAMERA, bar(8.0, 2.5, 2.0, 0.4))
    image = np.zeros((CAMERA.info.height, CAMERA.info.width, 3), np.uint8)
    render = Example(image, CAMERA, [TrueMarking("crosswalk_bar", corners, 8.0, True)], [])
    assert [_is_bar(render, shape) for shape in (corners, shifted, beside)] == [True, None, False]
    outline = to_image(CAMERA, bar(8.0, 0.0, 3.0, 4.0))
    labelled = TrueMarking("crosswalk_bar", outline, np.nan, False)
    nothing = np.zeros(image.shape[:2], dtype=bool)
    photograph = Example(image, CAMERA, [labelled], [], unknown=nothing)
    far = to_image(CAMERA, bar(8.0, 4.0, 2.0, 0.4))
    assert [_is_bar(photograph, shape) for shape in (corners, shifted, far)] == [True, True, False]
