"""The judge: markings are believed and flecks of sun are not, and spoilt sides are trusted less."""

import json

import cv2
import numpy as np
import onnx
import pytest

from tests.detection.pictures import bar, brightness_model, diamond, make_camera, picture, to_image
from train.fit_judge import fit
from v2hdm.detection.classifier import AMONG, SHAPES
from v2hdm.detection.detector import Detector
from v2hdm.detection.evidence import CHANNELS, FEATURES
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.weights import CONFIDENCE_FILE, JUDGE_FILE


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


def test_judge_and_weights_are_those_of_the_evidence_that_is_gathered():
    label = json.loads(onnx.load(JUDGE_FILE).metadata_props[0].value)
    assert (label["features"], label["channels"]) == ([*FEATURES], [*CHANNELS])
    assert label["shapes"] == [*SHAPES]
    fitted = json.loads(CONFIDENCE_FILE.read_text())
    assert set(fitted) == set(SHAPES)
    assert all(set(fitted[shape]["weights"]) == set(AMONG) for shape in SHAPES)


def test_an_end_worn_to_shreds_is_trusted_less_than_a_clean_one(tmp_path):
    camera = make_camera("pinhole")
    shape = bar(7.0, 0.2, 3.0, 0.25)
    rng = np.random.default_rng(2)
    holes = [
        diamond(x, y, 0.12, 0.12)
        for x, y in zip(rng.uniform(7.6, 8.5, 60), rng.uniform(0.08, 0.32, 60), strict=True)
    ]
    detector = Detector.load(brightness_model(tmp_path, "lane_dash"), DetectorOptions(min_confidence=0.0))
    sigma = []
    for image in (picture(camera, [shape]), picture(camera, [shape], holes=holes)):
        marking = max(detector.detect(image, camera)[0], key=lambda m: np.ptp(m.corners_px[:, 1]))
        far = np.argsort(marking.corners_px[:, 1])[:2]
        sigma.append(np.sqrt(marking.covariance_px[2 * far + 1, 2 * far + 1].max()))
    assert sigma[1] > 1.2 * sigma[0]


def test_the_fit_of_the_weights_finds_those_that_made_the_data():
    rng = np.random.default_rng(0)
    evidence = rng.normal(size=(20000, 3)) * [1.0, 10.0, 0.1] + [0.0, 5.0, 1.0]
    weights, bias = np.array([1.0, -0.1, 8.0]), -7.0
    true = rng.random(20000) < 1 / (1 + np.exp(-evidence @ weights - bias))
    found, found_bias = fit(evidence, true)
    np.testing.assert_allclose(found, weights, rtol=0.1)
    assert found_bias == pytest.approx(bias, rel=0.1)
