"""How sure a reading is a stop line is fitted."""

import numpy as np
import pytest

from tests.train.test_odds import readings
from train.examples import Example, TrueMarking, example
from train.fit_judge import AT_JUNCTIONS
from train.fit_stop_lines import Readings, fitted, is_stop_line, readings_in
from v2hdm.detection.classifier import AMONG
from v2hdm.detection.detector import Detector
from v2hdm.detection.options import DetectorOptions
from v2hdm.records import LANE_DASH, STOP_LINE

LINE_PX = np.array([[300.0, 400], [900, 400], [900, 412], [300, 412]])


def shown(kind):
    """An image in which one marking is true."""
    return Example(np.zeros((720, 1280, 3), np.uint8), None, [TrueMarking(kind, LINE_PX, 9.0, True)], [])


@pytest.mark.parametrize(
    ("kind", "moved_px", "answer"),
    [
        (STOP_LINE, (4, 1), True),
        (STOP_LINE, (590, 0), None),  # perhaps what a wide lens makes of its other end
        (STOP_LINE, (0, 200), False),
        (LANE_DASH, (4, 1), False),
    ],
)
def test_a_reading_is_a_stop_line_where_it_lies_on_one(kind, moved_px, answer):
    assert is_stop_line(shown(kind), LINE_PX + moved_px) is answer


def test_the_company_of_a_stop_line_says_nothing():
    entry = fitted(Readings(*readings(0.8, -1.0, 500)))
    assert list(entry["weights"]) == list(AMONG)
    assert [entry["weights"][name] for name in AMONG if name != "alone"] == [0.0] * (len(AMONG) - 1)
    assert entry["weights"]["alone"] == pytest.approx(0.8, abs=0.15)
    assert entry["bias"] == pytest.approx(-1.0, abs=0.4)


def test_the_judge_is_asked_about_stop_lines_of_images():
    detector = Detector.load(options=DetectorOptions(max_range_m=24.0, min_confidence=0.0))
    parts = [readings_in(example(number, 1.0, 4711, AT_JUNCTIONS), detector) for number in (0, 1)]
    odds, true = (np.concatenate(column) for column in zip(*parts, strict=True))
    assert len(odds) == len(true) > 0
    assert odds[true].mean() > odds[~true].mean() if (~true).any() else true.all()
