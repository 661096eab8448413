"""Signs of a port: on free ground, in the truth, and nothing else of the port moves."""

from dataclasses import replace

import numpy as np
import pytest

from tests.simulate.conftest import tiny_port
from v2hdm.errors import ConfigError
from v2hdm.executor import HERE
from v2hdm.geometry.planar import clip_convex, inside_convex, signed_area
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.records import BOX, CROSSWALK, CROSSWALK_BAR, DOUBLE_LINE, LANE_LINE, TEXT
from v2hdm.simulate.port import drive
from v2hdm.simulate.port.build import build_port
from v2hdm.simulate.port.config import PaintConfig, PortConfig, RouteConfig, SignsConfig
from v2hdm.simulate.port.drive import render_drive
from v2hdm.simulate.port.paint import around
from v2hdm.simulate.render.letters import LETTERS, Hand, word
from v2hdm.simulate.render.scene import box_footprint

SIGNS = SignsConfig(words=["EBH"], numbers=3, hatched=2, crosswalks=1, double_lines=1)
LONG = RouteConfig(pieces=[[60.0, 0.0], [20.0, 60.0], [40.0, 0.0]], image_spacing_m=9.0)


@pytest.fixture(scope="module")
def ports():
    plain = PortConfig(route=LONG)
    return build_port(plain), build_port(replace(plain, paint=PaintConfig(signs=SIGNS)))


def test_a_port_with_signs_is_otherwise_the_same(ports):
    plain, signed = ports
    before, after = plain.renderer.scene.paints, signed.renderer.scene.paints
    assert len(after) > len(before)
    for paint, other in zip(before, after, strict=False):
        assert replace(paint, polygon_map=0) == replace(other, polygon_map=0)  # type: ignore[arg-type]
        np.testing.assert_array_equal(paint.polygon_map, other.polygon_map)
    for paint, other in zip(plain.hd_map.markings, signed.hd_map.markings, strict=False):
        np.testing.assert_array_equal(paint.corners_map, other.corners_map)
    assert not plain.hd_map.symbols
    assert not plain.texts
    np.testing.assert_array_equal(plain.driven.map_from_vehicle, signed.driven.map_from_vehicle)


def test_all_signs_that_are_asked_for_are_in_the_truth(ports):
    _, signed = ports
    symbols = signed.hd_map.symbols
    kinds = [symbol.kind for symbol in symbols]
    assert kinds.count(BOX) == 2
    assert kinds.count(CROSSWALK) == 1
    assert list(signed.texts.values()) == ["EBH", "101", "102", "103"]
    assert all(symbols[number].kind == TEXT for number in signed.texts)
    assert sum(marking.kind == CROSSWALK_BAR for marking in signed.hd_map.markings) == 4
    (double,) = (lane for lane in signed.hd_map.lanes if lane.kind == DOUBLE_LINE)
    assert LANE_LINE in double.lines
    assert double.apart_m > PaintConfig().line_width_m


def test_signs_lie_on_nothing_and_nothing_stands_on_them(ports):
    plain, signed = ports
    others = [paint.polygon_map for paint in plain.renderer.scene.paints]
    others += [box_footprint(box) for box in plain.renderer.scene.boxes]
    added = signed.renderer.scene.paints[len(plain.renderer.scene.paints) :]
    for paint in added:
        counter_clockwise = paint.polygon_map
        assert signed_area(counter_clockwise) > 0
        for other in others:
            if np.linalg.norm(other.mean(axis=0) - counter_clockwise.mean(axis=0)) < 40:
                assert len(clip_convex(counter_clockwise, other)) <= 2


def test_the_outline_of_a_sign_holds_all_of_its_paint_and_a_word_begins_at_its_lower_left(ports):
    plain, signed = ports
    added = signed.renderer.scene.paints[len(plain.renderer.scene.paints) :]
    points = np.vstack([paint.polygon_map for paint in added if paint.kind in (TEXT, BOX)])
    outlines = [symbol.outline_map for symbol in signed.hd_map.symbols if symbol.kind in (TEXT, BOX)]
    middle = [outline.mean(axis=0) + 1.0001 * (outline - outline.mean(axis=0)) for outline in outlines]
    assert np.any([inside_convex(outline, points) for outline in middle], axis=0).all()
    assert all(signed_area(outline) > 0 for outline in outlines)
    low_left, low_right, _, high_left = around(list(word("L", 2.0, 1.0, 0.1)))
    assert low_left[1] > low_right[1], "left of the way is the left of a word"
    assert high_left[0] > low_left[0], "up in a word is ahead"


def test_ports_without_signs_keep_their_folder_in_the_cache(tmp_path, monkeypatch):
    monkeypatch.setattr(drive, "render_drive", lambda *_: None)
    folders = [
        drive.rendered_drive(
            PortConfig(paint=PaintConfig(signs=signs)), tmp_path, HERE, lambda done, total: None
        )
        for signs in (SignsConfig(), SIGNS)
    ]
    assert folders[0].name == "port1-5152c55c71"
    assert folders[1] != folders[0]


@pytest.mark.parametrize("words", [["ebh"], [""], ["A B", "Ä"]])
def test_words_that_cannot_be_painted_are_refused(words):
    with pytest.raises(ConfigError, match=r"paint.signs.words: .* use A to Z, 0 to 9 and -"):
        build_port(tiny_port(paint=PaintConfig(signs=SignsConfig(words=words))))


def test_the_truth_of_signs_is_read_as_it_was_written(tmp_path):
    config = tiny_port(paint=PaintConfig(signs=SignsConfig(numbers=2, hatched=1)))
    render_drive(config, tmp_path, HERE, lambda done, total: None)
    port, truth = build_port(config), read_truth(read_drive(tmp_path))
    assert truth.texts == port.texts
    assert len(truth.map.symbols) == len(port.hd_map.symbols) > 0
    assert truth.symbol_visibility is not None
    assert truth.symbol_visibility.shape == (len(truth.visibility), len(truth.map.symbols))
    assert truth.visibility.shape[1] == len(truth.map.markings)
    (tmp_path / "truth" / "texts.csv").write_text("symbol,text\n99,EBH\n")
    with pytest.raises(Exception, match=r"texts.csv: line 2: no text of a symbol below"):
        read_truth(read_drive(tmp_path))


def test_letters_are_as_tall_as_asked_for_drawn_out_or_not():
    for hand in (Hand(), Hand(stretch=2.0), Hand(stencil=True)):
        for letter in LETTERS:
            if letter != "-":
                strokes = np.vstack(list(word(letter, 2.0, 0.8, 0.01, hand)))
                assert np.ptp(strokes[:, 0]) == pytest.approx(2.0, abs=0.05)
