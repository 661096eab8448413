"""Proposals, what other markings say of one, and the judge of what is believed."""

import json

import cv2
import numpy as np
import onnx
import pytest

from tests.detection.pictures import bar, brightness_model, diamond, make_camera, picture, to_image
from train.fit_judge import fit
from v2hdm.catalogue import load_catalogue
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.classifier import AMONG, COMPANIES, SHAPES, classify_among
from v2hdm.detection.company import COMPANY, company
from v2hdm.detection.detector import Detector
from v2hdm.detection.evidence import CHANNELS, FEATURES
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.quads.blobs import Blob
from v2hdm.detection.quads.propose import open_sides, propose
from v2hdm.detection.weights import CONFIDENCE_FILE, JUDGE_FILE
from v2hdm.geometry.planar import order_corners
from v2hdm.records import (
    ARROW,
    BICYCLE,
    BOX,
    CHEVRON,
    DIAMOND,
    LANE_DASH,
    LANE_LINE,
    OTHER_PAINT,
    STOP_LINE,
    TEXT,
)

CATALOGUE = load_catalogue()
VIEW = RoadCamera(make_camera("plumb_bob"), 16)
RHOMBUS = diamond(8.0, 0.0)
STRIP = bar(8.0, 0.0, 3.0, 0.15)


def along(corners, count=40):
    """Points all along the sides of a polygon."""
    share = np.arange(count)[:, None] / count
    return np.concatenate(
        [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    )


def proposal_of(shape, scores):
    blob = Blob(scores, np.ones((3, 3)), np.zeros(2), 2, to_image(VIEW.camera, along(shape)))
    (proposal,) = propose([blob], VIEW, CATALOGUE, 30.0)
    return proposal


def test_size_decides_where_the_network_is_in_doubt():
    scores = {LANE_DASH: 0.4, DIAMOND: 0.35}
    assert proposal_of(RHOMBUS, scores).kind == DIAMOND, "no dash is so wide for its length"
    assert proposal_of(STRIP, scores).kind == LANE_DASH
    assert proposal_of(bar(10.0, 0.0, 9.0, 0.15), {LANE_LINE: 0.5, LANE_DASH: 0.4}).kind == LANE_LINE
    assert proposal_of(STRIP, {LANE_LINE: 0.5, LANE_DASH: 0.4}).kind == LANE_DASH, "a line is longer"


@pytest.mark.parametrize("symbol", [ARROW, CHEVRON, OTHER_PAINT])
def test_all_classes_with_four_corners_that_are_not_negligible_go_to_the_judge(symbol):
    assert proposal_of(RHOMBUS, {symbol: 0.6, DIAMOND: 0.3}).kinds(CATALOGUE)[0] == DIAMOND
    assert LANE_DASH in proposal_of(STRIP, {symbol: 0.6, LANE_DASH: 0.3}).kinds(CATALOGUE)
    assert STOP_LINE not in proposal_of(RHOMBUS, {DIAMOND: 0.9}).kinds(CATALOGUE)


def test_a_class_that_neither_network_nor_size_names_does_not_go_to_the_judge():
    long = bar(10.0, 0.0, 5.0, 0.15)
    assert proposal_of(long, {LANE_LINE: 0.9, LANE_DASH: 0.02}).kinds(CATALOGUE) == []
    assert proposal_of(long, {LANE_LINE: 0.9, LANE_DASH: 0.1}).kinds(CATALOGUE) == [LANE_DASH], (
        "by the network"
    )
    short = bar(10.0, 0.0, 3.0, 0.15)
    assert proposal_of(short, {LANE_LINE: 0.9, LANE_DASH: 0.02}).kinds(CATALOGUE) == [LANE_DASH], (
        "by its size"
    )


def test_the_shares_of_the_classes_add_up_to_one():
    share = proposal_of(STRIP, {LANE_DASH: 0.5, LANE_LINE: 0.3, ARROW: 0.1}).share
    assert sum(share.values()) == pytest.approx(1.0)


def test_an_arrow_is_as_likely_whatever_other_symbols_the_network_tells_apart():
    shape = bar(8.0, 0.0, 4.0, 0.9)
    others = (DIAMOND, LANE_DASH, LANE_LINE, STOP_LINE, CHEVRON, OTHER_PAINT)
    before = dict.fromkeys(others, 0.02) | {ARROW: 0.6}
    few = proposal_of(shape, before)
    many = proposal_of(shape, before | dict.fromkeys((TEXT, BOX, BICYCLE), 0.0))
    assert many.share[ARROW] == pytest.approx(few.share[ARROW], abs=0.01)
    assert many.symbol_score(ARROW) == pytest.approx(few.symbol_score(ARROW), abs=0.01)


@pytest.mark.parametrize("shape", [RHOMBUS, STRIP, bar(6.0, 1.0, 0.4, 3.0)])
def test_the_start_is_the_quadrilateral_that_the_paint_fills(shape):
    proposal = proposal_of(shape, {DIAMOND: 0.5, LANE_DASH: 0.5})
    true_px = order_corners(VIEW.undistort(to_image(VIEW.camera, shape)))
    turned = [np.roll(true_px, k, axis=0) for k in range(4)]
    assert min(np.abs(proposal.corners_pinhole_px - t).max() for t in turned) < 3.0
    assert proposal.fill > 0.85


def test_paint_beyond_the_range_starts_no_quadrilateral():
    blob = Blob({DIAMOND: 0.9}, np.ones((3, 3)), np.zeros(2), 2, to_image(VIEW.camera, along(RHOMBUS)))
    (proposal,) = propose([blob], VIEW, CATALOGUE, 4.0)
    assert proposal.kinds(CATALOGUE) == []


def test_a_side_along_the_border_is_open():
    height = VIEW.info.height
    inside = np.array([[300.0, 100], [280, 200], [330, 205], [340, 110]])
    cut = np.array([[300.0, 250], [280, height - 1], [350, height - 1], [340, 250]])
    assert open_sides(np.stack([inside, cut]), VIEW).tolist() == [[False] * 4, [False, True, False, False]]


def diamond_at(x, y, length=1.2, width=0.8):
    return np.array([[x + length / 2, y], [x, y + width / 2], [x - length / 2, y], [x, y - width / 2]])


def dash_at(x, y, length=2.0, heading=0.0):
    along, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    box = np.array([[-1, -0.075], [1, -0.075], [1, 0.075], [-1, 0.075]]) * [length / 2, 1.0]
    return box[:, :1] * along + box[:, 1:] * left + (x, y)


def reported(ground, kinds, probability):
    columns = company(np.stack(ground), kinds, np.array(probability)).T
    return dict(zip(COMPANY, columns, strict=True))


def test_diamonds_of_one_stencil_are_alike_and_others_are_not():
    small, across = diamond_at(8, 0, 0.6, 0.4), diamond_at(10, 0, 0.8, 1.2)
    said = reported([diamond_at(4, 0), diamond_at(6, 0), small, across], [DIAMOND] * 4, [0.9, 0.8, 0.5, 0.25])
    assert said["alike"][:2] == pytest.approx([0.8, 0.9], abs=1e-3)
    assert said["most_alike"] == pytest.approx([0.8, 0.9, 0.0, 0.0], abs=0.01)
    assert said["unlike"][0] == pytest.approx(0.75, abs=0.01)
    assert said["surest_other"].tolist() == [0.8, 0.9, 0.9, 0.9]


def test_neither_another_class_nor_another_reading_of_the_same_paint_is_company():
    said = reported(
        [diamond_at(4, 0), diamond_at(4.1, 0), dash_at(6, 0)], [DIAMOND, DIAMOND, LANE_DASH], [0.9] * 3
    )
    assert not any(column.any() for column in said.values())


def test_a_dash_has_others_in_its_line_after_a_gap_only():
    for other, in_line in (
        (dash_at(9, 0), 0.9),
        (dash_at(6.5, 0), 0.0),  # goes on where it ends
        (dash_at(9, 1.0), 0.0),
        (dash_at(9, 0, heading=0.5), 0.0),
        (dash_at(29, 0), 0.0),
    ):
        assert reported([dash_at(4, 0), other], [LANE_DASH] * 2, [0.5, 0.9])["in_line"][0] == in_line
    assert not reported([diamond_at(4, 0), diamond_at(9, 0)], [DIAMOND] * 2, [0.5, 0.9])["in_line"].any()


def test_a_row_of_dashes_may_be_an_arc():
    def on_circle(metres, turned=0.0):
        angle = metres / 15
        return dash_at(15 * np.sin(angle), 15 - 15 * np.cos(angle), 3.0, angle + turned)

    for other, in_line in (
        (on_circle(6), 0.9),
        (on_circle(-6), 0.9),
        (on_circle(6, np.pi), 0.9),  # axes have no sense of direction
        (on_circle(6, 0.3), 0.0),
        (on_circle(6, -0.4), 0.0),
        (on_circle(4), 0.0),
    ):
        assert reported([on_circle(0), other], [LANE_DASH] * 2, [0.5, 0.9])["in_line"][0] == in_line


def test_diamonds_far_apart_may_be_turned_by_a_bend():
    def turned(x, angle):
        around = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        return (diamond_at(0, 0) @ around) + (x, 0)

    diamond_near = reported([diamond_at(4, 0), turned(6, 0.5)], [DIAMOND] * 2, [0.5, 0.9])["most_alike"][0]
    far = reported([diamond_at(4, 0), turned(16, 0.5)], [DIAMOND] * 2, [0.5, 0.9])["most_alike"][0]
    assert diamond_near < 0.05
    assert far > 0.6


def test_one_that_is_alone_or_above_the_horizon_has_no_company():
    assert not company(diamond_at(4, 0)[None], [DIAMOND], np.array([0.9])).any()
    above = np.full((4, 2), np.nan)
    assert np.isfinite(
        company(np.stack([above, diamond_at(4, 0)]), [DIAMOND] * 2, np.array([0.9, 0.9]))
    ).all()


def test_a_doubtful_diamond_is_believed_among_others_like_it():
    odds, kinds = np.array([0.5, 4.0, 4.0, 4.0]), [DIAMOND] * 4
    field = np.stack([diamond_at(4.0 + 3 * k, 0) for k in range(4)])
    mixed = field.copy()
    mixed[1:] = 4 + 0.4 * (mixed[1:] - 4)
    among, among_mixed = (classify_among(odds, ground, kinds)[0] for ground in (field, mixed))
    assert 1 - among_mixed > 2 * (1 - among)


def confidences(image, folder):
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
    of_fleck = confidences(fleck, tmp_path)
    assert of_fleck, "the network takes it for paint"
    assert painted > DetectorOptions().min_confidence > max(of_fleck)


def test_judge_and_weights_are_those_of_the_evidence_that_is_gathered():
    label = json.loads(onnx.load(JUDGE_FILE).metadata_props[0].value)
    assert (label["features"], label["channels"]) == ([*FEATURES], [*CHANNELS])
    assert label["shapes"] == [*SHAPES]
    fitted = json.loads(CONFIDENCE_FILE.read_text())
    assert set(fitted) == set(COMPANIES)
    assert all(set(fitted[name]["weights"]) == set(AMONG) for name in COMPANIES)


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
    fitted, found_bias = fit(evidence, true)
    np.testing.assert_allclose(fitted, weights, rtol=0.1)
    assert found_bias == pytest.approx(bias, rel=0.1)
