"""Scores of maps whose errors are known: right ones, and ones that are wrong on purpose."""

import math

import numpy as np
import pytest

from tests.benchmark.hand import DIAMOND, at, feature, paint, write
from v2hdm.benchmark.scoring import FALSE_ALARM, RIGHT, SILENT, UNSTATED, score_map, table_of
from v2hdm.benchmark.submissions import read_submission


@pytest.fixture
def scored(tmp_path, reference):
    def score(features, **members):
        path = write(tmp_path / "map.geojson", features, **members)
        return score_map(read_submission(path, reference.truth.map), reference, "hand")

    return score


def test_the_truth_itself_has_a_perfect_score(scored, reference):
    score = scored(paint(reference), verdict="PASS")
    assert score.markings.recall == 1.0
    assert score.markings.expected == 39
    assert score.markings.false_markings == 0
    assert score.markings.corner_rmse_m == pytest.approx(0.0, abs=1e-6)
    assert score.is_good
    assert score.verdict_is == RIGHT
    assert score.lanes is None


@pytest.mark.parametrize(
    ("off_m", "verdict", "fate"),
    [(0.03, "PASS", RIGHT), (0.03, "FAIL", FALSE_ALARM), (0.07, "PASS", SILENT), (0.07, "FAIL", RIGHT),
     (0.07, {"status": "WARN"}, UNSTATED), (0.07, None, None)],
)  # fmt: skip
def test_a_map_that_is_moved_has_the_error_that_it_was_moved_by(off_m, verdict, fate, scored, reference):
    score = scored(paint(reference, (off_m, 0.0)), verdict=verdict)
    assert score.markings.corner_rmse_m == pytest.approx(off_m, abs=1e-6)
    assert score.markings.corner_bias_m == pytest.approx(off_m, abs=1e-6)
    assert score.corner_median_m == pytest.approx(off_m, abs=1e-6)
    assert score.is_good == (off_m < 0.05)
    assert score.verdict_is == fate


@pytest.mark.parametrize(
    ("off_m", "verdict", "is_right"),
    [(0.03, "PASS", True), (0.03, "WARN", False), (0.03, "FAIL", False), (0.07, "PASS", False),
     (0.07, "WARN", False), (0.07, "FAIL", True), (0.07, None, None)],
)  # fmt: skip
def test_strictly_a_warning_is_never_right(off_m, verdict, is_right, scored, reference):
    assert scored(paint(reference, (off_m, 0.0)), verdict=verdict).is_strictly_right is is_right


def test_a_warning_is_right_only_while_the_stated_accuracy_holds(scored, reference):
    honest = paint(reference, (0.07, 0.0), sigma_m=0.06)
    assert scored(honest, verdict="WARN").verdict_is == RIGHT
    assert scored(paint(reference, (0.07, 0.0), sigma_m=0.02), verdict="WARN").verdict_is == UNSTATED
    invented = [feature("diamond", at(DIAMOND, 2.0 + 4.0 * k, 30.0), sigma_m=0.06) for k in range(3)]
    assert scored([*honest, *invented], verdict="WARN").verdict_is == UNSTATED


def test_the_parts_of_the_nees_tell_a_wrong_place_from_a_wrong_shape(scored, reference):
    moved = scored(paint(reference, (0.03, 0.0), sigma_m=0.03)).stated
    # The centre of four corners is known twice as well as each: (3 cm / 1.5 cm)^2 over two coordinates.
    assert moved.place == pytest.approx(2.0, rel=1e-3)
    assert moved.shape == pytest.approx(0.0, abs=1e-6)
    assert math.isnan(moved.beside)
    longer = [
        feature(m.kind, m.corners_map + 0.03 * np.sign(m.corners_map - m.corners_map.mean(0)), sigma_m=0.03)
        for m in reference.truth.map.markings
        if m.kind == "lane_dash"
    ]
    stated = scored(longer).stated
    assert stated.place == pytest.approx(0.0, abs=1e-6)
    # Eight errors of a sigma each, over six degrees of freedom.
    assert stated.shape == pytest.approx(8 / 6, rel=1e-3)


def test_what_is_left_out_or_invented_is_counted(scored, reference):
    features = paint(reference)[10:]
    features.append(feature("diamond", at(DIAMOND, 50.0, 12.0)))
    features.append(feature("diamond", at(DIAMOND, 4.0, 3.2)))
    score = scored(features)
    # Of the twenty diamonds that stay one has no counterpart left: the added one takes that of the second.
    assert score.by_class["diamond"].recall == pytest.approx(21 / 30)
    assert score.by_class["lane_dash"].recall == 1.0
    assert score.markings.recall == pytest.approx(30 / 39)
    assert score.markings.false_markings == 1
    assert not score.is_good


def test_a_marking_of_a_wrong_class_is_false_and_missing(scored, reference):
    features = paint(reference)
    features[0] = feature("stop_line", at(DIAMOND, 0.0, 3.0))
    score = scored(features)
    assert score.markings.false_markings == 1
    assert score.markings.recall == pytest.approx(38 / 39)
    assert score.by_class["stop_line"].false_markings == 1
    assert math.isnan(score.by_class["stop_line"].recall)


@pytest.mark.parametrize(("factor", "nees"), [(1.0, 1.0), (0.5, 4.0), (2.0, 0.25)])
def test_sigmas_that_are_too_small_or_large_show_in_the_nees(factor, nees, scored, reference):
    rng = np.random.default_rng(3)
    features = [
        feature(m.kind, m.corners_map + rng.normal(0.0, 0.01, (4, 2)), sigma_m=0.01 * factor)
        for m in reference.truth.map.markings
    ]
    score = scored(features)
    assert score.stated.corners == 160
    assert score.stated.nees == pytest.approx(nees, rel=0.2)
    inside = {1.0: (0.90, 0.99), 0.5: (0.4, 0.7), 2.0: (0.99, 1.0)}[factor]
    assert inside[0] <= score.stated.inside_95 <= inside[1]


def test_the_order_of_a_ring_and_its_sense_make_no_difference(scored, reference):
    rng = np.random.default_rng(4)
    root = rng.normal(0.0, 0.01, (8, 8))
    covariance = root @ root.T
    error = rng.normal(0.0, 0.02, (40, 4, 2))
    scores = []
    for order in ([0, 1, 2, 3], [2, 3, 0, 1], [3, 2, 1, 0], [1, 0, 3, 2]):
        rows = np.arange(8).reshape(4, 2)[order].ravel()
        stated = covariance[np.ix_(rows, rows)].tolist()
        pairs = zip(reference.truth.map.markings, error, strict=True)
        features = [feature(m.kind, (m.corners_map + e)[order], covariance_m2=stated) for m, e in pairs]
        score = scored(features)
        scores.append((score.markings.corner_rmse_m, score.stated.nees, score.stated.inside_95))
    for other in scores[1:]:
        assert other == pytest.approx(scores[0], rel=1e-6)


def test_lane_lines_are_measured_across(scored, reference):
    line = reference.truth.map.lanes[0].points_map
    half = feature("lane_line", at(line[:61], 0.0, 0.04), "LineString")
    score = scored([*paint(reference), half])
    assert score.lanes is not None
    assert score.lanes.rms_lateral_error_m == pytest.approx(0.04, abs=1e-3)
    assert score.lanes.mapped_fraction == pytest.approx(0.5, abs=0.01)


def test_the_table_says_what_the_score_holds(scored, reference):
    lines = table_of(scored(paint(reference, (0.03, 0.0), sigma_m=0.02), verdict="PASS"))
    assert lines[1].split() == ["all", "39", "100.0", "%", "40", "0", "3.0", "cm"]
    assert "corners: half within 3.0 cm, 95 % within 3.0 cm" in lines
    assert (
        "stated accuracy: NEES 1.12 (1 is right), 100.0 % of 160 corners inside their 95 % ellipse" in lines
    )
    assert "NEES by part: places 4.50, shapes 0.00" in lines
    assert lines[-1] == "verdict: PASS, right; strictly (no WARN) right"


def test_as_json_has_none_for_what_cannot_be_told(scored, reference):
    content = scored(paint(reference)).as_json()
    assert content["stated"]["corners"] == 0
    assert {content["stated"][part] for part in ("nees", "inside_95", "place", "beside", "shape")} == {None}
    assert content["markings"]["recall"] == 1.0
