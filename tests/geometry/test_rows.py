"""Rows of bars on the ground, and the outline about one."""

import numpy as np
import pytest

from v2hdm.geometry.rows import outline_of_row, rows_of_bars

BAR = np.array([[-1.5, -0.25], [1.5, -0.25], [1.5, 0.25], [-1.5, 0.25]])


def row(numbers=range(6), step=(0.0, 1.0), at=(0.0, 0.0), turn_rad=0.0):
    """Bars of 3 m by 0.5 m at some places of an even row."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    bars = np.array([BAR + k * np.array(step) for k in numbers])
    return bars @ np.array([[c, s], [-s, c]]) + at


@pytest.mark.parametrize("turn_rad", [0.0, 0.7, 2.0, -1.2])
def test_the_outline_of_a_crosswalk_is_that_of_its_bars(turn_rad):
    bars = row(turn_rad=turn_rad)[[3, 0, 5, 1, 4, 2]]
    (members,) = rows_of_bars(bars)
    outline = outline_of_row(bars[members])
    expected = np.array([[-1.5, -0.25], [1.5, -0.25], [1.5, 5.25], [-1.5, 5.25]])
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    off_m = np.linalg.norm(outline.corners[:, None] - expected @ np.array([[c, s], [-s, c]]), axis=2)
    assert sorted(off_m.argmin(axis=1)) == [0, 1, 2, 3]
    assert off_m.min(axis=1).max() < 1e-9
    along = outline.corners[1] - outline.corners[0]
    assert np.linalg.norm(along) == pytest.approx(5.5)  # along the bars' ends, across the road
    x, y = (outline.corners - outline.corners.mean(axis=0)).T
    assert (x * np.roll(y, -1) - y * np.roll(x, -1) > 0).all()  # counter-clockwise


def test_a_missing_bar_leaves_one_crosswalk_and_a_bar_by_itself_none():
    bars = np.concatenate([row([0, 1, 3, 4]), row([0], at=(20.0, 0.0))])
    (members,) = rows_of_bars(bars)
    assert members.tolist() in ([0, 1, 2, 3], [3, 2, 1, 0])


def test_bars_of_an_oblique_crosswalk_have_an_oblique_outline():
    bars = row(step=(0.4, 1.0))
    (members,) = rows_of_bars(bars)
    ends = outline_of_row(bars[members]).corners
    slope = (ends[1] - ends[0])[0] / (ends[1] - ends[0])[1]
    assert slope == pytest.approx(0.4, abs=0.02)


@pytest.mark.parametrize(
    "bars",
    [
        row([0, 1]),
        row([0, 1.0, 2.6, 3.1]),
        np.array([BAR * [1, 1], BAR * [0.5, 1] + [0, 1], BAR * [1.6, 1] + [0, 2]]),
        np.array([BAR, BAR[:, ::-1] + np.array([0, 1.8]), BAR + np.array([0, 3.6])]),
        row(step=(0.0, 3.0)),
    ],
    ids=["two bars", "uneven steps", "other lengths", "other directions", "bays of a car park"],
)
def test_what_is_no_even_row_of_alike_bars_is_no_crosswalk(bars):
    assert rows_of_bars(bars) == []


def test_two_crosswalks_at_a_corner_are_two():
    bars = np.concatenate([row(), row(at=(6.0, -4.0), turn_rad=np.pi / 2)])
    rows = rows_of_bars(bars)
    assert sorted(sorted(members.tolist()) for members in rows) == [[*range(6)], [*range(6, 12)]]


def test_the_derivative_of_an_outline_is_that_of_small_motions():
    rng = np.random.default_rng(3)
    bars = row() + rng.normal(0.0, 0.01, (6, 4, 2))
    outline = outline_of_row(bars)
    np.testing.assert_allclose(outline.by_corner @ bars.ravel(), outline.corners.ravel(), atol=1e-9)
    shift = np.tile([0.3, -0.2], 24)
    np.testing.assert_allclose(outline.by_corner @ shift, np.tile([0.3, -0.2], 4), atol=0.02)
