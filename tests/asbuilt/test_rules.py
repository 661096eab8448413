"""Paint against a table of rules: by class, quantity and unit; a table that cannot be meant is refused."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.asbuilt.site import layout, mapped
from v2hdm.asbuilt.decisions import Fate
from v2hdm.asbuilt.reading import classes_of
from v2hdm.asbuilt.rules import compare_with_rules, read_rules
from v2hdm.errors import MapFileError, V2hdmError
from v2hdm.records import HDMap, PaintLeft

HEAD = "class,quantity,low,high,unit,source\n"
KINDS = classes_of(HDMap(()))


def rules(tmp_path, *lines):
    path = tmp_path / "rules.csv"
    path.write_text(HEAD + "\n".join(lines) + "\n")
    return read_rules(path, KINDS)


@pytest.fixture(scope="module")
def hd_map():
    return mapped(layout(3, 10).shapes, 2)


def values(findings, name):
    return [
        quantity.value for finding in findings for quantity in finding.quantities if quantity.name == name
    ]


def test_lengths_widths_gaps_and_spacings_are_measured(tmp_path, hd_map):
    table = rules(
        tmp_path,
        "lane_dash,length,290,310,cm,a",
        "lane_dash,width,0.10,0.20,m,a",
        "lane_dash,gap,5.9,6.1,m,a",
        "lane_dash,spacing,8.9,9.1,m,a",
        "lane_dash,offset,,0.1,m,a",
        "lane_dash,angle,,20,deg,a",
    )
    findings = compare_with_rules(hd_map, table)
    assert len(findings) == 20
    assert {finding.fate for finding in findings} == {Fate.RIGHT}
    assert np.mean(values(findings, "length")) == pytest.approx(3.0, abs=0.01)
    assert np.mean(values(findings, "width")) == pytest.approx(0.15, abs=0.005)
    assert np.mean(values(findings, "gap")) == pytest.approx(6.0, abs=0.01)
    assert np.mean(values(findings, "spacing")) == pytest.approx(9.0, abs=0.01)
    assert len(values(findings, "gap")) == 18  # the last dash of each row has none ahead


def test_a_gap_is_surer_than_the_places_of_its_dashes(tmp_path, hd_map):
    findings = compare_with_rules(hd_map, rules(tmp_path, "lane_dash,spacing,8.9,9.1,m,a"))
    spacing = next(quantity for finding in findings for quantity in finding.quantities)
    place_m = np.sqrt(np.trace(hd_map.markings[0].covariance_m2) / 8)
    assert spacing.sigma < place_m


def test_wear_below_a_limit_is_off_and_unknown_wear_is_not_judged(tmp_path, hd_map):
    worn, whole, unknown = (
        replace(hd_map.markings[k], paint=paint)
        for k, paint in enumerate([PaintLeft(0.5, 0.03), PaintLeft(0.9, 0.03), None])
    )
    findings = compare_with_rules(
        HDMap((worn, whole, unknown)), rules(tmp_path, "lane_dash,paint_left,70,,%,a")
    )
    assert [finding.fate for finding in findings] == [Fate.OFF, Fate.RIGHT, Fate.RIGHT]
    assert not findings[2].quantities


def test_wide_paint_is_off_by_a_rule_in_inches(tmp_path, hd_map):
    findings = compare_with_rules(hd_map, rules(tmp_path, "lane_dash,width,2,4,in,a"))
    assert {finding.fate for finding in findings} == {Fate.OFF}


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("lane_dash,width,0.1,0.2,,a", "line 2: has no unit; give one of: m, cm"),
        ("lane_dash,width,0.1,0.2,deg,a", "width is not measured in 'deg'"),
        ("dash,width,0.1,0.2,m,a", "'dash' is not a class"),
        ("lane_dash,weight,0.1,0.2,m,a", "unknown quantity 'weight'"),
        ("lane_dash,width,0.3,0.2,m,a", "low is above high"),
        ("lane_dash,width,,,m,a", "has no limit"),
        ("lane_dash,width,wide,,m,a", "low"),
        ("lane_dash,width,0.1,0.2,m", "5 cells under 6 columns"),
    ],
)
def test_a_table_that_cannot_be_meant_is_refused_with_its_line(line, says, tmp_path):
    with pytest.raises(V2hdmError, match=re.escape(says)):
        rules(tmp_path, line)


def test_a_table_without_units_is_refused(tmp_path):
    path = tmp_path / "rules.csv"
    path.write_text("class,quantity,low,high\nlane_dash,width,1,2\n")
    with pytest.raises(MapFileError, match="has no column unit"):
        read_rules(path, KINDS)


@pytest.mark.parametrize("path", sorted(Path("examples/rules").glob("*.csv")), ids=lambda path: path.name)
def test_the_tables_of_the_examples_are_read_and_state_their_sources(path):
    table = read_rules(path, KINDS)
    assert table
    assert all(rule.source for rule in table)
