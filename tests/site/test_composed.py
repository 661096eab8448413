"""Crosswalks and double lines of what is mapped."""

from dataclasses import replace

import numpy as np
import pytest

from v2hdm.records import HDMap, Lane, Marking
from v2hdm.site.composed import composed, with_double_lines

BAR = np.array([[-1.5, -0.25], [1.5, -0.25], [1.5, 0.25], [-1.5, 0.25]])
OWN_M, SHARED_M = 0.01, 0.02


def bars(count=6, noise_m=0.0, rng=None, relative_m=OWN_M / 2):
    covariance = OWN_M**2 * np.eye(8) + SHARED_M**2 * np.tile(np.eye(2), (4, 4))
    off = np.zeros((count, 4, 2)) if rng is None else rng.normal(0.0, noise_m, (count, 4, 2))
    return tuple(
        Marking("crosswalk_bar", BAR + [20.0, float(k)] + off[k], 4 + k, covariance, relative_m)
        for k in range(count)
    )


def line(kind, y_m, start_m=0.0, end_m=30.0, **more):
    x = np.arange(start_m, end_m + 0.25, 0.5)
    return Lane(kind, np.column_stack([x, np.full(len(x), y_m)]), 5, **more)


def test_bars_become_one_crosswalk_that_names_them():
    diamond = Marking("diamond", BAR + np.array([40.0, 0.0]), 3)
    hd_map = composed(HDMap((diamond, *bars())))
    (crosswalk,) = hd_map.symbols
    assert crosswalk.kind == "crosswalk"
    assert [marking.id for marking in hd_map.markings] == [1, 2, 3, 4, 5, 6, 7]
    assert sorted(crosswalk.parts) == [2, 3, 4, 5, 6, 7]
    assert crosswalk.sightings == 9
    np.testing.assert_allclose(np.ptp(crosswalk.outline_map, axis=0), [3.0, 5.5])


def test_the_covariance_of_a_crosswalk_is_that_of_its_bars_and_what_they_share_stays():
    rng = np.random.default_rng(5)
    true = composed(HDMap(bars())).symbols[0].outline_map
    errors = []
    for _ in range(300):
        shifted = [
            replace(bar, corners_map=bar.corners_map + shift)
            for shift in [rng.normal(0.0, SHARED_M, 2)]
            for bar in bars(noise_m=OWN_M, rng=rng)
        ]
        (crosswalk,) = composed(HDMap(tuple(shifted))).symbols
        errors.append((crosswalk.outline_map - true).ravel())
    covariance = crosswalk.covariance_m2
    assert covariance is not None
    squared = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(covariance), errors) / 8
    assert 0.8 < squared.mean() < 1.2
    # Six bars know their ends better than one, but not where the map lies.
    assert SHARED_M < np.sqrt(covariance[0, 0]) < np.hypot(SHARED_M, OWN_M)


def test_bars_of_unknown_accuracy_make_a_crosswalk_of_unknown_accuracy():
    plain = tuple(replace(bar, covariance_m2=None) for bar in bars())
    (crosswalk,) = composed(HDMap(plain)).symbols
    assert crosswalk.covariance_m2 is None


def test_an_earlier_crosswalk_is_replaced_and_its_id_stays():
    once = composed(HDMap(bars()))
    numbered = replace(once, symbols=(replace(once.symbols[0], id=77, sightings=1),))
    (again,) = composed(numbered).symbols
    assert (again.id, again.sightings) == (77, 9)
    assert composed(replace(numbered, markings=numbered.markings[:2])).symbols == ()


@pytest.mark.parametrize(
    ("left", "right", "backwards", "expected"),
    [
        ("lane_line", "lane_line", False, ("lane_line", "lane_line")),
        ("lane_dash", "lane_line", False, ("lane_dash", "lane_line")),
        ("lane_dash", "lane_line", True, ("lane_line", "lane_dash")),
    ],
)
def test_two_lines_beside_each_other_become_one_double_line(left, right, backwards, expected):
    first, second = line(right, 0.0, id=3), line(left, 0.24, id=4)
    if backwards:
        first = replace(first, points_map=first.points_map[::-1])
    (double,) = with_double_lines([first, second])
    assert (double.kind, double.lines, double.id) == ("double_line", expected, 3)
    assert double.apart_m == pytest.approx(0.24)
    np.testing.assert_allclose(double.points_map[:, 1], 0.12)
    left_line, other = double.painted
    assert (left_line.kind, other.kind) == expected
    assert sorted([left_line.points_map[0, 1], other.points_map[0, 1]]) == pytest.approx([0.0, 0.24])


def test_a_line_is_double_only_as_long_as_another_runs_beside_it():
    lanes = with_double_lines([line("lane_line", 0.0, id=1), line("lane_dash", 0.3, 10.0, 20.0, id=2)])
    assert sorted(lane.kind for lane in lanes) == ["double_line", "lane_line", "lane_line"]
    assert sorted(np.ptp(lane.points_map[:, 0]) for lane in lanes) == pytest.approx(
        [10.0, 10.0, 10.0], abs=1.0
    )
    assert sorted(lane.id or 0 for lane in lanes) == [0, 0, 1]


@pytest.mark.parametrize("apart_m", [0.05, 0.7, 3.5])
def test_lines_nearer_or_farther_than_those_of_a_double_line_stay_two(apart_m):
    lanes = (line("lane_line", 0.0), line("lane_line", apart_m))
    assert with_double_lines(lanes) == lanes


def test_lines_that_cross_stay_two():
    other = replace(
        line("lane_line", 0.0), points_map=line("lane_line", 0.0).points_map @ [[1, 0.1], [0, 1]] - [0, 1.5]
    )
    assert len(with_double_lines([line("lane_line", 0.0), other])) == 2
