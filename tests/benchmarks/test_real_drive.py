"""The count on real drives is checked on a flat road with a line of dashes whose truth is known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.real_drive import Tally, judge_image, map_summary, summary
from tests.benchmarks.real_reference import Painted, Reference, make_reference
from tests.benchmarks.real_view import View
from v2hdm.errors import MapFileError
from v2hdm.records import ARROW, LANE_DASH, CameraInfo, FloatArray, Marking, MarkingDetection

INFO = CameraInfo("front", 1200, 600, np.array([[700.0, 0, 600], [0, 700.0, 200], [0, 0, 1]]))
# The camera stands 1.6 m above the origin and looks along the map's x.
VIEW = View(INFO, np.array([[0.0, -1, 0, 0], [0, 0, -1, 1.6], [1, 0, 0, 0], [0, 0, 0, 1]]))
ROUTE = np.column_stack([np.linspace(0, 40, 81), np.zeros(81)])


def dash(x: float, y: float = 1.5) -> FloatArray:
    return np.array([[x, y - 0.1], [x + 3, y - 0.1], [x + 3, y + 0.1], [x, y + 0.1]])


def mapped(*starts: float) -> list[Marking]:
    return [Marking(LANE_DASH, dash(x), 5) for x in starts]


def detection(polygon_map: FloatArray, kind: str = LANE_DASH) -> MarkingDetection:
    return MarkingDetection(kind, 0.9, VIEW.project(polygon_map), np.eye(8), np.ones(4, dtype=np.bool_))


def one(*painted: Painted) -> Reference:
    return Reference(painted, True, {})


def test_a_dash_that_the_map_lacks_is_put_between_its_neighbours() -> None:
    found = make_reference(mapped(2, 8, 20, 26), ROUTE, None)
    assert len(found.markings) == 5
    assert not found.whole
    np.testing.assert_allclose(found.markings[-1].centre_map, [15.5, 1.5], atol=0.05)
    np.testing.assert_allclose(np.ptp(found.markings[-1].polygon_map, axis=0), [3.0, 0.2], atol=0.02)


def test_dashes_of_two_lines_are_completed_apart_and_not_beyond_their_ends() -> None:
    other = [Marking(LANE_DASH, dash(x, -1.8), 5) for x in (5, 11, 17)]
    found = make_reference([*mapped(2, 8, 20, 26), *other], ROUTE, None)
    assert len(found.markings) == 8


def test_a_file_adds_removes_hides_and_places_cameras(tmp_path: Path) -> None:
    path = tmp_path / "reference.json"
    arrow = {"kind": ARROW, "polygon_map": [[10, 0], [14, 0], [12, 1]]}
    hidden = [{"image": 3, "box_px": [0, 0, 10, 10]}]
    camera = [{"image": 5, "matrix": VIEW.cam_from_map.tolist()}]
    content = {"markings": [arrow], "remove": [[3.5, 1.5]], "hidden": hidden, "cam_from_map": camera}
    path.write_text(json.dumps(content))
    found = make_reference(mapped(2, 8, 14), ROUTE, path)
    assert [p.kind for p in found.markings] == [ARROW, LANE_DASH, LANE_DASH]
    assert len(found.hidden[3]) == 1
    np.testing.assert_array_equal(found.cam_from_map[5], VIEW.cam_from_map)


def test_a_file_that_is_whole_leaves_the_map_out(tmp_path: Path) -> None:
    path = tmp_path / "reference.json"
    path.write_text(json.dumps({"markings": [], "whole": True}))
    assert make_reference(mapped(2, 8, 14), ROUTE, path).markings == ()


@pytest.mark.parametrize(
    "text", ["no json", '{"markings": [{"kind": "cow", "polygon_map": [[0, 0]]}]}', "{}"]
)
def test_a_file_of_another_form_is_refused_by_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "reference.json"
    path.write_text(text)
    with pytest.raises(MapFileError, match=r"reference\.json"):
        make_reference([], ROUTE, path)


def test_a_marking_is_found_only_within_half_a_metre() -> None:
    reference = one(Painted(LANE_DASH, dash(8)))
    for offset, found_as in ((0.3, LANE_DASH), (0.8, None)):
        result = judge_image(VIEW, reference, [], [detection(dash(8 + offset))])
        assert [seen.found_as for seen in result.seen] == [found_as]
        assert not result.false


def test_what_is_far_cut_or_hidden_is_not_asked_for() -> None:
    for start in (0.5, 19.0):
        assert not judge_image(VIEW, one(Painted(LANE_DASH, dash(start))), [], []).seen
    box = np.array([0.0, 0.0, 1200.0, 600.0])
    assert not judge_image(VIEW, one(Painted(LANE_DASH, dash(8))), [box], []).seen


def test_a_detection_away_from_all_paint_is_false_and_one_beside_its_dash_is_not() -> None:
    reference = one(Painted(LANE_DASH, dash(8)))
    result = judge_image(VIEW, reference, [], [detection(dash(8, -3.0)), detection(dash(8, 1.2))])
    assert len(result.false) == 1
    assert result.seen[0].found_as is None


def test_two_detections_on_one_dash_find_it_once_and_a_wrong_class_is_told() -> None:
    reference = one(Painted(LANE_DASH, dash(8)))
    given = [detection(dash(8), ARROW), detection(dash(8.3))]
    tally = Tally(reference, np.zeros(1))
    tally.add(judge_image(VIEW, reference, [], given))
    assert tally.found["dashes in the sun"] == 1
    assert tally.right["dashes in the sun"] == 0
    assert "100.0 %" in summary(tally, reference)
    assert tally.taken_for == {("dashes in the sun", ARROW): 1}


def test_an_optional_marking_is_neither_missed_nor_false() -> None:
    reference = one(Painted(LANE_DASH, dash(8), optional=True))
    result = judge_image(VIEW, reference, [], [detection(dash(8))])
    assert not result.seen
    assert not result.false


def test_the_map_is_judged_by_what_is_painted() -> None:
    reference = one(Painted(LANE_DASH, dash(8)), Painted(LANE_DASH, dash(14)))
    tally = Tally(reference, np.zeros(2))
    tally.add(judge_image(VIEW, reference, [], []))
    text = map_summary([*mapped(8), Marking(LANE_DASH, dash(8, -4.0), 3)], reference, tally)
    assert "1 markings false" in text
    assert "1 of the 2 dashes of the road" in text
