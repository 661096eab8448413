"""Paint of training's scenes has the shape, size and place of real paint."""

import numpy as np
import pytest

from train.scenes.letters import WORDS, random_hand, random_text
from train.scenes.paint import (
    Bend,
    Brush,
    Facing,
    RoadPaint,
    double_line,
    random_brush,
    rectangle,
    rhombus,
    stout_arrow,
    street_paint,
)
from train.scenes.scenes import random_scene
from train.scenes.symbols import (
    hollow_diamond,
    lines_across,
    with_bays,
    with_boxes,
    with_crossing,
    with_crosswalk,
    with_double,
    with_far_stop,
    with_give_way,
    with_other,
    with_users,
    with_words,
)
from train.scenes.views import looking
from v2hdm.geometry.planar import signed_area
from v2hdm.records import (
    ARROW,
    BICYCLE,
    BOX,
    CROSSWALK_BAR,
    DIAMOND,
    LANE_DASH,
    LANE_LINE,
    OTHER_PAINT,
    STOP_LINE,
    TEXT,
    CameraInfo,
)
from v2hdm.simulate.render.letters import Hand, word
from v2hdm.simulate.render.renderer import Renderer
from v2hdm.simulate.render.scene import Ground, Paint, Scene


def turns_of(polygon):
    """Twice the area (N,) between each two sides of a polygon, above 0 where it turns left."""
    sides = np.roll(polygon, -1, axis=0) - polygon
    following = np.roll(sides, -1, axis=0)
    return sides[:, 0] * following[:, 1] - sides[:, 1] * following[:, 0]


def test_paint_polygons_are_convex_and_have_the_size_asked_for():
    scenes = [random_scene(np.random.default_rng(index)) for index in range(12)]
    polygons = [paint.polygon_map for scene, _ in scenes for paint in scene.paints]
    assert polygons
    for polygon in polygons:
        assert (turns_of(polygon) > -1e-9).all() or (turns_of(polygon) < 1e-9).all()
    assert np.ptp(rhombus(np.zeros(2), 1.2, 0.6)[:, 0]) == pytest.approx(1.2)
    assert np.ptp(rectangle(np.zeros(2), 3.0, 0.15, np.pi / 2)[:, 1]) == pytest.approx(3.0)


def test_an_outline_of_a_diamond_is_a_diamond_and_its_middle_shows_the_ground():
    rng = np.random.default_rng(0)
    brush = Brush((0.7, 0.7, 0.7), 0.0, 0.0)
    corners = rhombus(np.array([6.0, 0.0]), 2.0, 1.4)
    info = CameraInfo("down", 120, 120, np.array([[100.0, 0, 60], [0, 100.0, 60], [0, 0, 1]]))
    above = looking(np.array([6.0, 0.0, 3.0]), 0.0, np.pi / 2, 0.0)
    ground = Ground(albedo_bgr=(0.1, 0.1, 0.1), contrast=0.0, stains=0.0)
    rendered = []
    for paints in ([Paint(kind=DIAMOND, polygon_map=corners)], hollow_diamond(brush, rng, corners, 0.2)):
        rendered.append(Renderer(Scene(ground=ground, paints=tuple(paints))).render(info, above, rng))
    filled, hollow = rendered
    assert (filled.labels == hollow.labels).mean() > 0.999
    assert filled.image[60, 60, 1] > 2 * hollow.image[60, 60, 1]
    ring = (hollow.labels > 0) & (hollow.image[..., 1] > 2 * hollow.image[60, 60, 1])
    assert 0.3 < ring.sum() / (hollow.labels > 0).sum() < 0.6, "a stroke of 0.2 m is 46 % of the area"


def test_stout_arrows_are_of_convex_parts_that_begin_at_their_tail_and_fit_a_lane():
    for seed in range(60):
        parts = list(stout_arrow(np.random.default_rng(seed)))
        assert all(signed_area(part) > 0 and (turns_of(part) > -1e-9).all() for part in parts)
        points = np.vstack(parts)
        assert points[:, 0].min() == 0
        assert 2 < points[:, 0].max() < 6.5
        assert np.abs(points[:, 1]).max() < 1.4


def test_half_of_the_arrows_face_the_camera_when_half_are_asked_to():
    turned = []
    for seed in range(60):
        brush = Brush((0.7, 0.7, 0.7), 0.0, 0.0)
        facing = [Facing(np.random.default_rng(seed), share) for share in (0.0, 0.5)]
        roads = [street_paint(np.random.default_rng(seed), brush, Bend(0.0), share) for share in facing]
        arrows = [[p.polygon_map for p in road.paints if p.kind == ARROW] for road in roads]
        assert len(arrows[0]) == len(arrows[1])
        turned += [not np.allclose(a, b) for a, b in zip(*arrows, strict=True)]
    assert len(turned) > 60
    assert 0.3 < np.mean(turned) < 0.7


def test_a_stop_line_that_meets_lines_of_lanes_reaches_from_one_to_another():
    met = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        brush, bend = random_brush(rng, 0.0), Bend(0.01 if seed % 2 else 0.0)
        road = street_paint(rng, brush, bend)
        crossed = with_crossing(rng, road, brush, bend, 1.0)
        if crossed is road:
            continue
        bar = crossed.paints[-1].polygon_map
        assert crossed.paints[-1].kind == STOP_LINE
        along = bend.to_map(np.column_stack([np.linspace(0, 30, 3001), np.zeros(3001)]))
        at = float(np.argmin(np.linalg.norm(along - bar.mean(axis=0), axis=1))) * 0.01
        heading = float(bend.heading(at))
        beside = (bar - bend.to_map(np.array([at, 0.0]))) @ np.array([-np.sin(heading), np.cos(heading)])
        lines = lines_across(road.lanes, bend, at)
        met += ((lines > beside.min() - 0.5) & (lines < beside.max() + 0.5)).sum() >= 2
    assert met > 15


def test_words_are_strokes_of_their_size_in_the_order_in_which_they_are_read():
    short_word, far = (list(word(text, 2.0, 0.5, 0.1)) for text in ("BUS", "BUS LANE"))
    assert all(signed_area(stroke) > 0 for stroke in far)
    assert np.ptp(np.vstack(short_word)[:, 0]) == pytest.approx(2.1, abs=0.05)
    assert np.vstack(far)[:, 0].max() == pytest.approx(4.85, abs=0.05)
    left_i, right_l = (np.vstack(list(word(text, 2.0, 0.5, 0.1)))[:, 1] for text in ("I", "LI"))
    assert right_l.max() > left_i.max()
    assert all(list(word(text, 2.0, 0.5, 0.1)) for text in WORDS)


PAINTED = (
    (with_words, {TEXT}), (with_bays, {TEXT}), (with_boxes, {BOX}), (with_users, {BICYCLE}),
    (with_other, {OTHER_PAINT}), (with_give_way, {STOP_LINE}), (with_far_stop, {STOP_LINE}),
    (with_crosswalk, {CROSSWALK_BAR, STOP_LINE}), (with_double, {LANE_LINE, LANE_DASH}),
)  # fmt: skip


@pytest.mark.parametrize(("lay", "kinds"), PAINTED)
def test_paint_laid_on_a_bare_road_is_convex_and_of_the_class_that_labels_call_it(lay, kinds):
    laid = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        brush = random_brush(rng, 0.0)
        bare = RoadPaint()
        assert lay(rng, bare, brush, Bend(0.0), 0.0) is bare
        paints = lay(rng, bare, brush, Bend(0.01), 1.0).paints
        laid += bool(paints)
        assert {paint.kind for paint in paints} <= kinds
        for paint in paints:
            turn = turns_of(paint.polygon_map)
            assert (turn > -1e-9).all() or (turn < 1e-9).all()
    assert laid == 30


def test_numbers_words_and_letters_have_strokes_in_every_hand():
    rng = np.random.default_rng(0)
    texts = [random_text(rng) for _ in range(200)]
    assert {text.isdigit() for text in texts} == {True, False}
    for text in texts:
        strokes = list(word(text, 2.0, 0.5, 0.1, random_hand(rng)))
        assert all(signed_area(stroke) > 0 and (turns_of(stroke) > -1e-9).all() for stroke in strokes)
        assert np.vstack(strokes)[:, 0].max() == pytest.approx(2.0 + 2.8 * text.count(" "), abs=0.3), (
            "letters are as tall as asked for, whatever the hand"
        )


def test_a_stencil_leaves_bridges_and_a_round_hand_has_more_strokes():
    plain, stencil, round_hand = (
        list(word("B", 2.0, 0.5, 0.1, hand)) for hand in (Hand(), Hand(stencil=True), Hand(rounds=1))
    )
    assert len(stencil) > len(plain)
    assert len(round_hand) > len(plain)
    area = [sum(signed_area(stroke) for stroke in strokes) for strokes in (plain, stencil)]
    assert area[1] < area[0]


def test_the_strands_of_a_double_line_are_a_hand_apart():
    for seed in range(40):
        rng = np.random.default_rng(seed)
        double = double_line(rng, random_brush(rng, 0.0), Bend(0.0), 1.0)
        across = np.array([[p.polygon_map[:, 1].min(), p.polygon_map[:, 1].max()] for p in double.paints])
        right, left = across[across[:, 1] < 1.0], across[across[:, 0] > 1.0]
        assert 0.08 <= left[:, 0].min() - right[:, 1].max() <= 0.35
        assert len(double.lanes) == 1


def test_a_stop_line_far_ahead_is_12_to_40_m_away():
    for seed in range(40):
        rng = np.random.default_rng(seed)
        brush = random_brush(rng, 0.0)
        for paint in with_far_stop(rng, RoadPaint(), brush, Bend(0.0), 1.0).paints:
            assert 6 < paint.polygon_map[:, 0].mean() < 44
