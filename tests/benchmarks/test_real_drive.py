"""The count on real drives is checked on a flat road with a line of dashes whose truth is known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.benchmarks.real_drive import Tally, judge_image, map_summary, summary
from tests.benchmarks.real_reference import Painted, Reference, read_reference
from tests.benchmarks.real_view import View
from v2hdm.errors import MapFileError
from v2hdm.records import (
    ARROW,
    LANE_DASH,
    LANE_LINE,
    CameraInfo,
    Exclusion,
    FloatArray,
    MarkingDetection,
)
from v2hdm.surface.paths import Paths
from v2hdm.surface.surface import Surface

INFO = CameraInfo("front", 1200, 600, np.array([[700.0, 0, 600], [0, 700.0, 200], [0, 0, 1]]))
# The camera stands 1.6 m above the origin and looks along the map's x.
VIEW = View(INFO, np.array([[0.0, -1, 0, 0], [0, 0, -1, 1.6], [1, 0, 0, 0], [0, 0, 0, 1]]))
ROUTE = np.column_stack([np.linspace(0, 40, 81), np.zeros(81)])


def dash(x: float, y: float = 1.5) -> FloatArray:
    return np.array([[x, y - 0.1], [x + 3, y - 0.1], [x + 3, y + 0.1], [x, y + 0.1]])


def detection(polygon_map: FloatArray, kind: str = LANE_DASH) -> MarkingDetection:
    return MarkingDetection(kind, 0.9, VIEW.project(polygon_map), np.eye(8), np.ones(4, dtype=np.bool_))


def whole(*painted: Painted) -> Reference:
    return Reference(painted, frozenset({LANE_DASH, ARROW}))


def written(folder: Path, content: object) -> Path:
    path = folder / "reference.json"
    path.write_text(json.dumps(content))
    return path


def test_a_drawn_file_places_markings_hides_and_places_cameras(tmp_path: Path) -> None:
    arrow = {"kind": ARROW, "polygon_map": [[10, 0], [14, 0], [12, 1]]}
    hidden = [{"image": 3, "box_px": [0, 0, 10, 10]}]
    camera = [{"image": 5, "matrix": VIEW.cam_from_map.tolist()}]
    path = written(tmp_path, {"markings": [arrow], "hidden": hidden, "cam_from_map": camera})
    reference = read_reference(path, ROUTE)
    assert [painted.kind for painted in reference.markings] == [ARROW]
    assert not reference.whole
    assert len(reference.hidden[3]) == 1
    np.testing.assert_array_equal(reference.cam_from_map[5], VIEW.cam_from_map)


def test_a_truth_file_is_whole_for_dashes_and_arrows_alone(tmp_path: Path) -> None:
    content = {"dashes": [dash(8).tolist()], "arrows": {"left": [20.0, 1.0]}, "whole": "in reach"}
    reference = read_reference(written(tmp_path, content), ROUTE)
    assert [painted.kind for painted in reference.markings] == [LANE_DASH, ARROW]
    assert reference.whole == {LANE_DASH, ARROW}
    np.testing.assert_allclose(reference.markings[1].centre_map, [20.0, 1.0], atol=1e-6)


def test_the_reference_of_another_drive_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, {"dashes": [dash(8, y=500.0).tolist()], "arrows": {}})
    with pytest.raises(MapFileError, match=r"within 20 m of the route, the nearest 500 m away"):
        read_reference(path, ROUTE)


@pytest.mark.parametrize(
    "text",
    ["no json", "[]", '{"markings": [{"kind": "cow", "polygon_map": [[0, 0]]}]}', "{}", '{"dashes": [[1]]}'],
)
def test_a_file_of_another_form_is_refused_by_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "reference.json"
    path.write_text(text)
    with pytest.raises(MapFileError, match=r"reference\.json"):
        read_reference(path, ROUTE)


def test_a_marking_is_found_only_within_half_a_metre() -> None:
    reference = whole(Painted(LANE_DASH, dash(8)))
    for offset, found_as in ((0.3, LANE_DASH), (0.8, None)):
        result = judge_image(VIEW, reference, [], [detection(dash(8 + offset))])
        assert [shown.found_as for shown in result.shown] == [found_as]
        assert not result.false


def test_what_is_far_cut_or_hidden_is_not_asked_for() -> None:
    for start in (0.5, 19.0):
        assert not judge_image(VIEW, whole(Painted(LANE_DASH, dash(start))), [], []).shown
    box = np.array([0.0, 0.0, 1200.0, 600.0])
    assert not judge_image(VIEW, whole(Painted(LANE_DASH, dash(8))), [box], []).shown


def test_a_detection_away_from_all_paint_is_false_and_one_beside_its_dash_is_not() -> None:
    reference = whole(Painted(LANE_DASH, dash(8)))
    result = judge_image(VIEW, reference, [], [detection(dash(8, -3.0)), detection(dash(8, 1.2))])
    assert len(result.false) == 1
    assert result.shown[0].found_as is None


def test_two_detections_on_one_dash_find_it_once_and_a_wrong_class_is_told() -> None:
    reference = whole(Painted(LANE_DASH, dash(8)))
    detections = [detection(dash(8), ARROW), detection(dash(8.3))]
    tally = Tally(reference, np.zeros(1))
    tally.add(judge_image(VIEW, reference, [], detections))
    assert tally.found["dashes in the sun"] == 1
    assert tally.right["dashes in the sun"] == 0
    assert "100.0 %" in summary(tally, reference)
    assert tally.taken_for == {("dashes in the sun", ARROW): 1}


def test_an_optional_marking_is_neither_missed_nor_false() -> None:
    reference = whole(Painted(LANE_DASH, dash(8), optional=True))
    result = judge_image(VIEW, reference, [], [detection(dash(8))])
    assert not result.shown
    assert not result.false


def test_the_map_is_judged_by_what_is_painted() -> None:
    reference = whole(Painted(LANE_DASH, dash(8)), Painted(LANE_DASH, dash(14)), Painted(LANE_DASH, dash(20)))
    tally = Tally(reference, np.zeros(3))
    tally.add(judge_image(VIEW, reference, [], [detection(dash(14))]))
    mapped = [(LANE_DASH, dash(8)), (LANE_DASH, dash(8, -4.0)), (LANE_LINE, dash(8, -6.0))]
    left_out = Exclusion(LANE_DASH, np.array([15.0, 1.5]), 7, "its position is too uncertain")
    table, *lines = map_summary(mapped, [left_out], reference, tally).split("\n")[1:]
    assert table.split() == ["lane_dash", "3", "1", "1"]
    assert lines == [
        "missing: lane_dash at 15.5, 1.5: found in 1 of the 1 images that show it; left out as lane_dash of "
        "7 sightings: its position is too uncertain",
        "missing: lane_dash at 21.5, 1.5: found in 0 of the 0 images that show it; no candidate of the map "
        "lies there",
        "false: 1 markings of the map (target none): lane_dash at 9.5, -4.0",
    ]


def test_over_a_crowned_road_pixels_and_points_are_each_others() -> None:
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, 0, 3] = np.arange(40.0)
    level = Surface.level(Paths.of(poses, np.zeros(40, dtype=np.int64)))
    falls = np.pad([0.0, 0.0, 0.03], (0, len(level.parameters) - 3))
    view = replace(VIEW, surface=replace(level, parameters=falls).seen_from(poses[:1]))
    points_map = dash(8.0, 3.0)
    assert np.abs(view.project(points_map) - VIEW.project(points_map)).max() > 2.0
    np.testing.assert_allclose(view.ground(view.project(points_map)), points_map, atol=0.01)
