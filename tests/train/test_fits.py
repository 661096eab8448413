"""What teaches the detector its scores runs against the detector as it is."""

from collections.abc import Sequence
from dataclasses import fields
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from train import fit_judge, fit_lane_score
from train.confident_spots import Spots, lit
from train.examples import Example, TrueMarking, example, polygon_overlap
from train.fit_judge import Gathered, is_true
from train.fit_lane_score import proposed, seen
from v2hdm.detection import weights
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.records import ARROW, DIAMOND, LANE_DASH, MarkingDetection
from v2hdm.workers import share_out

SEED = 4711


@pytest.fixture(scope="module")
def shown() -> Example:
    """A scene with several markings and lines."""
    cv2.setNumThreads(1)
    scenes = (example(index, 0.2, SEED) for index in range(30))
    return next(s for s in scenes if sum(m.fair for m in s.markings) > 3 and len(s.lanes_px) > 1)


@pytest.fixture
def detector() -> Detector:
    return Detector.load(options=DetectorOptions(max_range_m=24.0, min_confidence=0.0))


def reported(shown: Example, detector: Detector, spots: Spots) -> list[MarkingDetection]:
    with pytest.MonkeyPatch.context() as patch:
        run = detector.run_network
        patch.setattr(detector, "run_network", lambda *given: spots.claimed(run(*given)))
        markings, _ = detector.detect(shown.image, shown.camera)
    return [marking for marking in markings if len(marking.outline_px) == 0]


def found(shown: Example, markings: Sequence[MarkingDetection]) -> set[int]:
    """The markings that must be found, by number, and are, as their class."""
    return {
        number
        for number, true in enumerate(shown.markings)
        if true.fair
        and any(
            m.kind == true.kind and polygon_overlap(m.corners_px, true.polygon_px) >= 0.5 for m in markings
        )
    }


def test_readings_of_quadrilaterals_are_gathered_with_their_truth(shown, detector):
    gathered = Gathered()
    gathered.add(0, shown, detector)
    count = len(gathered.kind)
    assert count == len(gathered.evidence) == len(gathered.views) == len(gathered.true) == len(gathered.lit)
    assert gathered.true.count(True) > 3


def test_spots_of_sun_are_proposed_as_markings_and_known_to_be_none(shown, detector):
    view = detector.road_camera(shown.camera)
    spotted, spots = lit(shown, view, np.random.default_rng(1))
    without, with_spots = Gathered(), Gathered()
    without.add(0, shown, detector)
    with_spots.add(0, spotted, detector, spots)
    assert (spots.light > 0).any()
    assert all(with_spots.lit)
    assert with_spots.true.count(False) > without.true.count(False)
    plain = [m for m in detector.detect(shown.image, shown.camera)[0] if len(m.outline_px) == 0]
    before, after = found(shown, plain), found(shown, reported(spotted, detector, spots))
    assert len(before) > 3
    assert len(before - after) <= 1, "markings stay what they are, but for one that a spot may touch"
    unlit = spots.light == 0
    np.testing.assert_array_equal(spotted.image[unlit], shown.image[unlit])


def test_spots_of_sun_that_the_network_takes_for_markings_are_not_reported(shown):
    detector = Detector.load(options=DetectorOptions())
    view = detector.road_camera(shown.camera)
    for seed in range(3):
        spotted, spots = lit(shown, view, np.random.default_rng(seed))
        for marking in reported(spotted, detector, spots):
            mask = np.zeros(spots.light.shape, np.uint8)
            cv2.fillPoly(mask, [np.round(marking.corners_px).astype(np.int32)], 1)
            assert spots.light[mask > 0].mean() < 0.5


def test_lines_of_lanes_are_proposed_with_their_truth(shown, detector):
    found = proposed(seen(shown, detector))
    assert found is not None
    assert len(found.lines) == len(found.alone) == len(found.true)
    assert found.true.any()


def test_readings_that_were_gathered_in_parts_are_those_gathered_at_once(tmp_path):
    cv2.setNumThreads(1)
    ranges = range(0, 2), range(2, 3), range(0, 3)
    parts = [
        fit_judge.Part(numbers, 3, weights.NETWORK_FILE, tmp_path / f"{k}.npz")
        for k, numbers in enumerate(ranges)
    ]
    first, second, whole = (Gathered.load([fit_judge.gather(part).path]) for part in parts)
    together = Gathered.load([part.path for part in parts[:2]])
    assert 0 < len(first.kind) < len(whole.kind) == len(first.kind) + len(second.kind)
    for item in fields(Gathered):
        one, other = getattr(together, item.name), getattr(whole, item.name)
        assert type(one[0]) is type(other[0])
        np.testing.assert_array_equal(np.array(one), np.array(other), err_msg=item.name)
    assert {type(true) for true in whole.true} <= {bool, type(None)}


def test_what_is_seen_of_lanes_comes_back_from_another_process():
    seen_there: list[fit_lane_score.Seen] = []
    part = fit_lane_score.Part(range(3), 100, weights.NETWORK_FILE)
    share_out(fit_lane_score.see, [part], 1, cv2.setNumThreads, (1,), seen_there.extend)
    lines = [found.lines for image in seen_there if (found := proposed(image)) is not None]
    assert len(seen_there) == 3
    assert sum(map(len, lines)) > 0


def test_the_head_of_an_arrow_is_no_diamond_and_a_hidden_dash_is_neither_true_nor_false():
    head = np.array([[100.0, 100], [130, 160], [160, 100]])
    hidden = np.array([[300.0, 100], [310, 100], [310, 200], [300, 200]])
    shown = SimpleNamespace(
        markings=[TrueMarking(ARROW, head, 5.0, False), TrueMarking(LANE_DASH, hidden, 5.0, False)]
    )
    over_head = np.array([[130.0, 90], [105, 115], [130, 140], [155, 115]])
    assert is_true(shown, DIAMOND, over_head) == (False, None)
    assert is_true(shown, LANE_DASH, hidden)[0] is True
    assert is_true(shown, LANE_DASH, hidden - [0, 70])[0] is None
    assert is_true(shown, LANE_DASH, hidden + np.array([200.0, 0.0])) == (False, None)
