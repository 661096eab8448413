"""Proposals: the odds of classes by network and size, and the quadrilateral to begin with."""

import numpy as np
import pytest

from tests.detection.pictures import bar, diamond, make_camera, to_image
from v2hdm.catalogue import load_catalogue
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.propose import Blob, open_sides, propose
from v2hdm.errors import ConfigError
from v2hdm.geometry.quadrilateral import order_corners
from v2hdm.records import ARROW, CHEVRON, DIAMOND, LANE_DASH, LANE_LINE, OTHER_PAINT, STOP_LINE

CATALOGUE = load_catalogue()
VIEW = RoadCamera(make_camera("plumb_bob"), 16)
RHOMBUS = diamond(8.0, 0.0)
STRIP = bar(8.0, 0.0, 3.0, 0.15)


def along(corners: np.ndarray, count: int = 40) -> np.ndarray:
    """Points all along the sides of a polygon."""
    share = np.arange(count)[:, None] / count
    return np.concatenate(
        [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    )


def proposal_of(shape: np.ndarray, scores: dict[str, float]):
    blob = Blob(scores, np.ones((3, 3)), np.zeros(2), 2, to_image(VIEW.camera, along(shape)))
    (found,) = propose([blob], VIEW, CATALOGUE, 30.0)
    return found


def test_size_decides_where_the_network_is_in_doubt():
    scores = {LANE_DASH: 0.4, DIAMOND: 0.35}
    assert proposal_of(RHOMBUS, scores).kind == DIAMOND, "no dash is so wide for its length"
    assert proposal_of(STRIP, scores).kind == LANE_DASH
    assert proposal_of(bar(10.0, 0.0, 9.0, 0.15), {LANE_LINE: 0.5, LANE_DASH: 0.4}).kind == LANE_LINE
    assert proposal_of(STRIP, {LANE_LINE: 0.5, LANE_DASH: 0.4}).kind == LANE_DASH, "a line is longer"


@pytest.mark.parametrize("symbol", [ARROW, CHEVRON, OTHER_PAINT])
def test_all_classes_with_four_corners_that_are_not_negligible_go_to_the_judge(symbol):
    assert proposal_of(RHOMBUS, {symbol: 0.6, DIAMOND: 0.3}).kinds(CATALOGUE)[0] == DIAMOND
    assert LANE_DASH in proposal_of(STRIP, {symbol: 0.6, LANE_DASH: 0.3}).kinds(CATALOGUE)
    assert STOP_LINE not in proposal_of(RHOMBUS, {DIAMOND: 0.9}).kinds(CATALOGUE)


def test_the_shares_of_the_classes_add_up_to_one():
    share = proposal_of(STRIP, {LANE_DASH: 0.5, LANE_LINE: 0.3, ARROW: 0.1}).share
    assert sum(share.values()) == pytest.approx(1.0)


@pytest.mark.parametrize("shape", [RHOMBUS, STRIP, bar(6.0, 1.0, 0.4, 3.0)])
def test_the_start_is_the_quadrilateral_that_the_paint_fills(shape):
    found = proposal_of(shape, {DIAMOND: 0.5, LANE_DASH: 0.5})
    true_px = order_corners(VIEW.undistort(to_image(VIEW.camera, shape)))
    turned = [np.roll(true_px, k, axis=0) for k in range(4)]
    assert min(np.abs(found.corners_pinhole_px - t).max() for t in turned) < 3.0
    assert found.fill > 0.85


def test_paint_beyond_the_range_starts_no_quadrilateral():
    blob = Blob({DIAMOND: 0.9}, np.ones((3, 3)), np.zeros(2), 2, to_image(VIEW.camera, along(RHOMBUS)))
    (found,) = propose([blob], VIEW, CATALOGUE, 4.0)
    assert found.kinds(CATALOGUE) == []


def test_a_side_along_the_border_is_open():
    width, height = VIEW.info.width, VIEW.info.height
    inside = np.array([[300.0, 100], [280, 200], [330, 205], [340, 110]])
    cut = np.array([[300.0, 250], [280, height - 1], [350, height - 1], [340, 250]])
    assert open_sides(np.stack([inside, cut]), VIEW).tolist() == [[False] * 4, [False, True, False, False]]
    assert width > 400


def test_a_wrong_entry_of_the_catalogue_is_refused_by_name(tmp_path):
    file = tmp_path / "catalogue.yaml"
    for entry, word in (
        ("{family: circle, length_m: [1, 2], width_m: [1, 2]}", "family"),
        ("{family: stripe, length_m: [2, 1], width_m: [1, 2]}", "length_m"),
        ("{family: stripe, length_m: [1, 2], width_m: [1, 2], colour: red}", "nothing else"),
        ("{family: stripe, length_m: [1, 2], width_m: [1, 2], softness: 0}", "softness"),
    ):
        file.write_text(f"classes:\n  mine: {entry}\n")
        with pytest.raises(ConfigError, match=word) as failure:
            load_catalogue(file)
        assert "mine" in str(failure.value)
