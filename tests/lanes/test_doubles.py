"""Double lines told apart by the points beside the line that runs between them."""

import numpy as np
import pytest

from v2hdm.lanes.doubles import with_doubles
from v2hdm.lanes.points import LaneCloud
from v2hdm.records import HDMap, Lane
from v2hdm.site.composed import composed

X = np.arange(0.0, 30.1, 0.5)
LINE = Lane("lane_line", np.column_stack([X, np.zeros(len(X))]), 8)


def cloud(offsets, images=12, sigma_m=0.03, far_share=0.3, rng=None, until_m=30.0, dashed=(), wide_m=0.0):
    """What images show of lines beside the x axis: apart from near, midway from far."""
    rng = rng or np.random.default_rng(4)
    points, image, dash = [], [], []
    for number in range(images):
        shift = rng.normal(0.0, 0.01)
        for place, y in enumerate(offsets):
            x = np.arange(rng.uniform(0.0, 0.5), 30.0, 0.5)
            beside = np.where(rng.random(len(x)) < far_share, np.mean(offsets), y)
            beside = np.where(x <= until_m, beside, offsets[0])
            y_m = beside + shift + rng.normal(0.0, np.hypot(sigma_m, wide_m), len(x))
            keep = (x <= until_m) | (place == 0)
            if place in dashed:
                keep &= x % 6.0 < 3.0
            points.append(np.column_stack([x, y_m])[keep])
            image += [number] * int(keep.sum())
            dash += [place in dashed] * int(keep.sum())
    points = np.concatenate(points)
    along = np.tile([1.0, 0.0], (len(points), 1))
    weight = np.full(len(points), 1 / sigma_m**2)
    return LaneCloud(points, along, weight, np.array(image), np.array(dash, dtype=bool))


@pytest.mark.parametrize("apart_m", [0.2, 0.24, 0.34, 0.44])
def test_a_line_between_two_is_these_two(apart_m):
    lines = with_doubles([LINE], cloud((apart_m / 2, -apart_m / 2)))
    assert sorted(float(np.median(line.points_map[:, 1])) for line in lines) == pytest.approx(
        [-apart_m / 2, apart_m / 2], abs=0.02
    )
    (double,) = composed(HDMap((), lines)).lanes
    assert double.kind == "double_line"
    assert double.apart_m == pytest.approx(apart_m, abs=0.03)


@pytest.mark.parametrize(
    "one",
    [
        cloud((0.0,)),
        cloud((0.0, 0.0), far_share=0.0),
        cloud((0.0,), wide_m=0.08),
        cloud((0.04, -0.04), far_share=0.0),
    ],
    ids=["one line", "seen twice", "seen badly", "of two cameras that disagree"],
)
def test_one_line_stays_one(one):
    assert with_doubles([LINE], one) == (LINE,)


def test_a_line_is_double_only_where_it_is():
    lines = with_doubles([LINE], cloud((0.12, -0.12), until_m=15.0))
    kinds = sorted(round(float(np.ptp(line.points_map[:, 0]))) for line in lines)
    assert len(lines) == 3
    assert all(abs(length - 15) <= 3 for length in kinds)


def test_a_dashed_line_beside_a_solid_one_stays_dashed():
    lines = with_doubles([LINE], cloud((0.12, -0.12), dashed=(0,)))
    (double,) = [lane for lane in composed(HDMap((), lines)).lanes if lane.kind == "double_line"]
    assert double.lines == ("lane_dash", "lane_line")
    assert np.ptp(double.points_map[:, 0]) >= 18.0


def test_a_cloud_of_nothing_leaves_the_lines():
    none = LaneCloud(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0, int), np.zeros(0, bool))
    assert with_doubles([LINE], none) == (LINE,)
