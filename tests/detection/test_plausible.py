"""What a blob is tried as: by its class scores and its size on the ground."""

from pathlib import Path

import numpy as np
import pytest

from tests.detection.pictures import bar, brightness_model, diamond, make_camera, to_image
from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.detector import Detector
from v2hdm.detection.paint.blobs import Blob
from v2hdm.detection.paint.plausible import (
    Piece,
    cornered_kind,
    plausible_kind,
    rival_kinds,
    unlikely_kinds,
)
from v2hdm.records import (
    ARROW,
    CHEVRON,
    CROSSWALK_BAR,
    DIAMOND,
    LANE_DASH,
    LANE_LINE,
    OTHER_PAINT,
    STOP_LINE,
)

VIEW = CameraView(make_camera("plumb_bob"), 16)
RHOMBUS = diamond(8.0, 0.0)
STRIP = bar(8.0, 0.0, 3.0, 0.15)


def tried_as(
    outline_vehicle: np.ndarray, scores: dict[str, float], touches_symbol: bool = False
) -> str | None:
    """The class as which a blob is fitted with four corners."""
    outline_px = to_image(VIEW.camera, outline_vehicle)
    blob = Blob(scores, np.ones((3, 3)), np.zeros(2), 2, outline_px, touches_symbol)
    piece = Piece.of(blob, outline_vehicle, VIEW)
    found = plausible_kind(piece)
    return None if found is None else cornered_kind(piece, found[0])


@pytest.mark.parametrize("symbol", [ARROW, CHEVRON])
def test_a_symbol_that_may_be_a_diamond_or_a_dash_is_tried_as_one(symbol: str) -> None:
    assert tried_as(RHOMBUS, {symbol: 0.6, DIAMOND: 0.3}) == DIAMOND
    assert tried_as(STRIP, {symbol: 0.6, LANE_DASH: 0.3}) == LANE_DASH


def test_a_symbol_is_not_tried_as_what_its_shape_or_the_network_rules_out() -> None:
    assert tried_as(RHOMBUS, {ARROW: 0.9, DIAMOND: 0.05}) is None, "the network is sure"
    assert tried_as(RHOMBUS, {ARROW: 0.6, LANE_DASH: 0.3}) is None, "no dash is so wide"
    assert tried_as(STRIP, {ARROW: 0.6, DIAMOND: 0.3}) is None, "no diamond is so slim"
    assert tried_as(RHOMBUS, {ARROW: 0.6, DIAMOND: 0.3}, touches_symbol=True) is None, "a part of a symbol"
    assert tried_as(RHOMBUS, {OTHER_PAINT: 0.6, DIAMOND: 0.3}) is None, "letters have strokes like diamonds"


def test_a_symbol_cut_by_the_border_is_not_tried_as_anything_else() -> None:
    cut = to_image(VIEW.camera, RHOMBUS)
    cut[:, 0] -= cut[:, 0].min() - 1
    on_ground = VIEW.ground(VIEW.undistort(cut))
    blob = Blob({ARROW: 0.6, DIAMOND: 0.3}, np.ones((3, 3)), np.zeros(2), 2, cut)
    assert cornered_kind(Piece.of(blob, on_ground, VIEW), ARROW) is None


def test_short_lane_paint_is_tried_as_a_dash_and_shorter_paint_as_a_diamond() -> None:
    scores = {LANE_LINE: 0.8, LANE_DASH: 0.12, DIAMOND: 0.05}
    assert tried_as(STRIP, scores) == LANE_DASH
    assert tried_as(bar(8.0, 0.0, 0.6, 0.15), scores) == DIAMOND
    assert tried_as(STRIP, {LANE_LINE: 0.9, LANE_DASH: 0.02}) == LANE_DASH, "it ends at both sides"


def test_what_is_too_long_for_a_dash_is_tried_as_several_if_the_network_says_dash() -> None:
    long = bar(14.0, 0.0, 16.0, 0.15)
    assert tried_as(long, {LANE_DASH: 0.9, LANE_LINE: 0.05}) == LANE_DASH
    assert tried_as(long, {LANE_DASH: 0.3, LANE_LINE: 0.6}) is None


def test_what_is_too_small_for_its_class_is_tried_as_what_it_may_be() -> None:
    small = diamond(6.0, 0.0, 0.7, 0.5)
    assert tried_as(small, {CROSSWALK_BAR: 0.7, DIAMOND: 0.2}) == DIAMOND
    assert tried_as(small, {OTHER_PAINT: 0.7, DIAMOND: 0.2}) is None, "letters have strokes like diamonds"


def test_a_quadrilateral_is_read_as_every_class_that_it_may_be() -> None:
    def rivals(outline_vehicle: np.ndarray, scores: dict[str, float], kind: str) -> list[str]:
        outline_px = to_image(VIEW.camera, outline_vehicle)
        blob = Blob(scores, np.ones((3, 3)), np.zeros(2), 2, outline_px)
        return rival_kinds(Piece.of(blob, outline_vehicle, VIEW), kind)

    wide = bar(8.0, 0.0, 3.0, 0.3)
    scores = {CROSSWALK_BAR: 0.5, LANE_DASH: 0.3, STOP_LINE: 0.1, DIAMOND: 0.01}
    assert rivals(wide, scores, CROSSWALK_BAR) == [LANE_DASH, STOP_LINE]
    assert rivals(RHOMBUS, {DIAMOND: 0.5, LANE_DASH: 0.4}, DIAMOND) == [], "no dash is so wide"
    cut = wide - np.array([0.0, np.ptp(wide[:, 1]) + 8.0])
    assert rivals(cut, scores, CROSSWALK_BAR) == [], "what the border cuts may be anything"


def piece_of(outline_vehicle: np.ndarray, scores: dict[str, float]) -> Piece:
    """A blob of that outline on the ground, as the test camera sees it."""
    outline_px = to_image(VIEW.camera, outline_vehicle)
    return Piece.of(Blob(scores, np.ones((3, 3)), np.zeros(2), 2, outline_px), outline_vehicle, VIEW)


def test_what_the_network_rules_out_is_tried_where_its_size_and_shape_allow_it() -> None:
    small = diamond(6.0, 0.0, 0.6, 0.25)
    assert unlikely_kinds(piece_of(small, {LANE_DASH: 0.9})) == [DIAMOND], "no dash is so short"
    assert unlikely_kinds(piece_of(small, {OTHER_PAINT: 0.9})) == [], "letters have strokes like diamonds"
    assert unlikely_kinds(piece_of(STRIP, {LANE_LINE: 0.9})) == [], "no diamond is so slim"
    assert unlikely_kinds(piece_of(STRIP, {ARROW: 0.9, LANE_DASH: 0.05})) == [LANE_DASH]


def test_what_the_border_only_comes_near_to_is_tried_and_what_it_cuts_is_not() -> None:
    near, cut = (to_image(VIEW.camera, RHOMBUS) for _ in range(2))
    near[:, 0] -= near[:, 0].min() - 3
    cut[:, 0] -= cut[:, 0].min() - 1
    tried = []
    for outline_px in (near, cut):
        blob = Blob({ARROW: 0.6, DIAMOND: 0.3}, np.ones((3, 3)), np.zeros(2), 2, outline_px)
        piece = Piece.of(blob, VIEW.ground(VIEW.undistort(outline_px)), VIEW)
        assert cornered_kind(piece, ARROW) is None
        tried.append(unlikely_kinds(piece))
    assert tried == [[DIAMOND], []]


def test_a_class_that_size_and_shape_rule_out_takes_no_share_from_the_others() -> None:
    sworn = piece_of(RHOMBUS, {LANE_DASH: 0.95})
    assert sworn.share_among_possible(DIAMOND) == pytest.approx(1.0), "no lane paint is so wide"
    assert piece_of(RHOMBUS, {ARROW: 0.95}).share_among_possible(DIAMOND) < 0.06, "an arrow may be"
    split = piece_of(STRIP, {LANE_DASH: 0.45, LANE_LINE: 0.45})
    assert split.share_among_possible(LANE_DASH) == pytest.approx(0.5, abs=0.03)


def test_a_diamond_that_has_a_shaft_and_something_of_a_symbol_is_the_head_of_an_arrow(tmp_path: Path) -> None:
    detector = Detector.load(brightness_model(tmp_path))

    def kinds(scores: dict[str, float], *shaft: np.ndarray) -> list[str]:
        blobs = [
            Blob(classes, np.ones((3, 3)), np.zeros(2), 2, to_image(VIEW.camera, outline))
            for classes, outline in ((scores, RHOMBUS), *(({LANE_DASH: 0.9}, strip) for strip in shaft))
        ]
        return [candidate.kind for candidate in detector._candidates(blobs, VIEW)]

    for worn in (
        {DIAMOND: 0.75, ARROW: 0.15},
        {DIAMOND: 0.5, OTHER_PAINT: 0.3},
        {DIAMOND: 0.6, CHEVRON: 0.1},
    ):
        assert kinds(worn) == [DIAMOND]
        assert kinds(worn, bar(6.2, 0.0, 2.0, 0.15)) == [LANE_DASH]
        assert kinds(worn, bar(6.2, 1.5, 2.0, 0.15)) == [DIAMOND, LANE_DASH], "it ends beside the diamond"
    for sure in ({DIAMOND: 0.9}, {DIAMOND: 0.85, ARROW: 0.05}):
        assert kinds(sure, bar(6.2, 0.0, 2.0, 0.15)) == [DIAMOND, LANE_DASH], "dashes end at diamonds, too"
