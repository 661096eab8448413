"""Lane lines that a person draws, deletes, joins or splits are so in the next map."""

import numpy as np
import pytest

from v2hdm.errors import MapFileError
from v2hdm.io.maps.corrections import ADDED, REJECTED, Correction, correction_of, entry_of
from v2hdm.records import HDMap, Lane
from v2hdm.site.line_corrections import with_lines_corrected


def straight(begin, end, y=0.0):
    x = np.arange(begin, end + 0.25, 0.5)
    return Lane("lane_line", np.column_stack([x, np.full(len(x), y)]), 9, sigma_m=np.full(len(x), 0.011))


def said(says, *places):
    return Correction(
        says=says, kind="lane_line", outline_map=[list(place) for place in places], is_line=True
    )


def corrected(lanes, *corrections):
    hd_map, heard = with_lines_corrected(HDMap((), tuple(lanes)), corrections)
    return hd_map.lanes, [(entry.says, entry.against) for entry in heard]


def ends(lane):
    return [lane.points_map[0].tolist(), lane.points_map[-1].tolist()]


def test_without_corrections_all_lines_stay():
    lanes = (straight(0, 20), straight(0, 20, 3.0))
    assert corrected(lanes)[0] == lanes


def test_a_drawn_line_is_in_the_map_and_the_images_say_that_they_show_none():
    (line, drawn), heard = corrected([straight(0, 20)], said(ADDED, (0, 5), (10, 5)))
    assert ends(line) == [[0, 0], [20, 0]]
    assert ends(drawn) == [[0, 5], [10, 5]]
    assert drawn.sigma_m == pytest.approx(0.02)
    assert heard == [("drawn", "the images show a line along 0 % of it")]


def test_a_deleted_part_is_out_and_the_rest_stays():
    parts, heard = corrected([straight(0, 20), straight(0, 20, 3.0)], said(REJECTED, (8, 0.1), (12, 0.1)))
    assert [ends(part) for part in parts] == [
        [[0, 0], [7.5, 0]],
        [[12.5, 0], [20, 0]],
        [[0, 3], [20, 3]],
    ]
    assert heard == [("deleted", "9 images show it")]


def test_joined_lines_are_one_that_lies_where_the_images_show_it():
    lanes = [straight(0, 10), straight(14, 24)]
    (joined,), heard = corrected(
        lanes,
        said(REJECTED, (0, 0), (10, 0)),
        said(REJECTED, (14, 0), (24, 0)),
        said(ADDED, (0, 0.1), (10, 0.1), (14, 0.1), (24, 0.1)),
    )
    assert joined.points_map[[0, -1], 0].tolist() == [0, 24]
    on_paint = (joined.points_map[:, 0] <= 10) | (joined.points_map[:, 0] >= 14)
    assert joined.points_map[on_paint, 1] == pytest.approx(0.0)
    assert joined.sigma_m[on_paint] == pytest.approx(0.011)
    middle = np.abs(joined.points_map[:, 0] - 12) < 1
    assert joined.points_map[middle, 1] == pytest.approx(0.1)
    assert joined.sigma_m[middle] == pytest.approx(0.02)
    assert [against for _, against in heard] == ["", "", ""]


def test_a_split_line_is_two():
    parts, heard = corrected(
        [straight(0, 20)],
        said(REJECTED, (0, 0), (20, 0)),
        said(ADDED, (0, 0), (9, 0)),
        said(ADDED, (11, 0), (20, 0)),
    )
    assert [ends(part) for part in parts] == [[[0, 0], [9, 0]], [[11, 0], [20, 0]]]
    assert [against for _, against in heard] == ["", "", ""]


def test_a_line_is_read_as_it_was_written_and_refused_where_it_crosses_itself():
    correction = said(ADDED, (0, 0), (10, 1), (20, 0))
    assert correction_of(entry_of(correction), "file") == correction
    crossed = {"says": "added", "class": "lane_line", "line_map": [[0, 0], [10, 0], [10, 5], [5, -5]]}
    with pytest.raises(MapFileError, match="line_map crosses itself; draw it again"):
        correction_of(crossed, "file")
    with pytest.raises(MapFileError, match="needs two points"):
        correction_of(crossed | {"line_map": [[0, 0]]}, "file")
