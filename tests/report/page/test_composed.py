"""The page shows areas, crosswalks and double lines."""

import numpy as np

from tests.report.page import folder as folders
from v2hdm.records import HDMap, Lane, Marking, Symbol
from v2hdm.report.page.facts import read_facts
from v2hdm.report.page.layers import layers
from v2hdm.site.composed import composed

BAR = np.array([[-1.5, -0.25], [1.5, -0.25], [1.5, 0.25], [-1.5, 0.25]])


def yard(names="diamond"):
    """A stop line that is a give-way line, a crosswalk, a word and a double line."""
    bars = tuple(Marking("crosswalk_bar", BAR + np.array([9.0, float(k)]), 5, accuracy="A") for k in range(4))
    stop = Marking("stop_line", BAR + np.array([6.0, 0.0]), 4, accuracy="A", variety="give_way")
    x = np.arange(0.0, 12.1, 0.5)
    lines = [
        Lane(kind, np.column_stack([x, np.full(len(x), y)]), 4)
        for kind, y in (("lane_line", 2.4), ("lane_dash", 2.64))
    ]
    word = Symbol("text", BAR + np.array([3.0, -2.0]), 3, accuracy="B")
    return composed(HDMap((stop, *bars), tuple(lines), symbols=(word,)))


def test_areas_double_lines_and_varieties_are_in_the_page_s_map(tmp_path, monkeypatch):
    monkeypatch.setattr(folders, "small_map", yard)
    drive = folders.make_result(tmp_path)
    shown = layers(read_facts(tmp_path / "result", drive), None)
    kinds = shown["kinds"]
    assert kinds == ["crosswalk", "crosswalk_bar", "stop_line", "text", "lane_dash", "lane_line"]
    assert [marking.get("kind") for marking in shown["markings"]] == ["give_way", None, None, None, None]
    by_kind = {kinds[symbol["k"]]: symbol for symbol in shown["symbols"]}
    assert by_kind["crosswalk"]["parts"] == [2, 3, 4, 5]
    assert all(symbol["area"] for symbol in by_kind.values())
    # A double line is one line, drawn as the two that are painted.
    assert shown["lane_lines"] == 1
    assert sorted(kinds[line["k"]] for line in shown["lanes"]) == ["lane_dash", "lane_line"]
    assert sorted(line["p"][0][1] for line in shown["lanes"]) == [2.4, 2.64]
