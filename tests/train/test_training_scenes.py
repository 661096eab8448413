"""Random scenes, views and hardships of training: reproducible, varied, labelled where the paint is."""

from dataclasses import fields
from functools import cache, partial

import cv2
import numpy as np
import pytest

from train.augment import random_crop
from train.config import DataConfig
from train.data import RenderStream, validation_pairs
from train.scenes import scenes
from train.scenes.hardships import (
    Hardships,
    bleached,
    junction_approach,
    things_beside,
    tight_bend,
    with_side_seams,
)
from train.scenes.letters import WORDS, random_hand, random_text
from train.scenes.paint import (
    Bend,
    Brush,
    Facing,
    RoadPaint,
    double_line,
    port_paint,
    random_brush,
    rectangle,
    rhombus,
    stout_arrow,
    street_paint,
)
from train.scenes.remains import with_erased
from train.scenes.scenes import TrainingSample, image_line, image_points, random_scene, training_sample
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
from train.scenes.traffic import reflectance, traffic
from train.scenes.views import TrainingView, looking, mounted_otherwise, random_view, turned_aside
from train.scenes.weather import GROUNDS, photo_tile
from train.scenes.windscreen import before_lens
from v2hdm.catalogue import PAINT_CLASSES, SHIPPED
from v2hdm.detection.camera import ASIDE_RAD
from v2hdm.geometry.lens import undistort_points
from v2hdm.geometry.planar import clip_convex, inside_convex, signed_area
from v2hdm.geometry.rigid import camera_centre
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
from v2hdm.simulate.render.renderer import Motion, Optics, Renderer
from v2hdm.simulate.render.scene import Box, Ground, Paint, Scene, box_footprint

TINY = DataConfig(width=64, height=32, render_width=80, render_height=48, views_per_render=2, reservoir=3)


def test_a_seed_and_an_index_make_the_same_picture_again():
    first, again = (training_sample(5, 3, 96, 64) for _ in range(2))
    np.testing.assert_array_equal(first.image, again.image)
    np.testing.assert_array_equal(first.labels, again.labels)
    assert (training_sample(5, 4, 96, 64).image != first.image).any()


def test_streams_of_one_seed_are_the_same():
    one, other = iter(RenderStream(TINY, 1)), iter(RenderStream(TINY, 1))
    for _ in range(5):
        (image, answers), (image_again, answers_again) = next(one), next(other)
        assert image.shape == (32, 64, 3)
        assert answers.paint.shape == (16, 32)
        assert bool((image == image_again).all())
        assert all(bool((a == b).all()) for a, b in zip(answers, answers_again, strict=True))


def test_validation_shows_other_scenes_than_training():
    image, _ = next(validation_pairs(TINY, 1, 1))
    assert (image.numpy() != training_sample(1, 0, 64, 32).image).any()


def test_all_classes_are_seen_in_a_hundred_or_so_samples():
    seen = {int(c) for index in range(120) for c in np.unique(training_sample(2, index, 320, 192).labels)}
    assert seen == set(range(1 + len(PAINT_CLASSES)))


def test_painted_pixels_are_mostly_brighter_than_the_ground_around_them():
    brighter = []
    for index in range(40):
        sample = training_sample(7, index, 192, 96, difficulty=0.0)
        grey, paint = sample.image.mean(axis=2), sample.labels > 0
        if 200 < paint.sum() < paint.size / 2:
            rows = np.flatnonzero(paint.any(axis=1))
            band = slice(rows[0], rows[-1] + 1)
            brighter.append(grey[band][paint[band]].mean() > np.median(grey[band][~paint[band]]))
    assert len(brighter) > 5
    assert np.mean(brighter) > 0.75


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


def test_lanes_lie_on_their_paint():
    on_paint, seen = 0, 0
    for index in range(60):
        sample = training_sample(3, index, 192, 96, difficulty=0.0)
        lane_paint = np.isin(sample.labels, [1 + PAINT_CLASSES.index(kind) for kind in SHIPPED.lane_paint])
        for lane in sample.lanes_px:
            u, v = np.round(lane).astype(int).T
            inside = (u >= 0) & (u < 192) & (v >= 30) & (v < 96)
            inside[inside] = ~sample.hidden[v[inside], u[inside]]
            seen += inside.sum()
            on_paint += lane_paint[v[inside], u[inside]].sum()
    assert seen > 300
    assert 0.4 < on_paint / seen < 0.95, "dashes leave gaps, double lines are bare between"


def test_a_line_is_the_middle_of_the_strands_that_run_there_and_follows_the_one_that_goes_on():
    """Three metres about the end of a strand the line passes over; no paint is farther than half a double."""
    passing, one_of_two, doubles = 1.5, 0, 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        road = street_paint(rng, random_brush(rng, 0.0), Bend(0.0))
        for lane in road.lanes:
            strands = _solid_strands_about(road, lane)
            if len(strands) != 2:
                continue
            doubles += 1
            for along, left in lane:
                near = [(along + passing > start) & (along - passing < end) for start, end, _ in strands]
                here = [(along - passing > start) & (along + passing < end) for start, end, _ in strands]
                if near != here or not any(here):
                    continue
                one_of_two += sum(here) == 1
                assert left == pytest.approx(np.mean([strands[k][2] for k in np.flatnonzero(here)]), abs=1e-6)
            assert np.abs(np.diff(lane[:, 1])).max() < 0.06
    assert doubles > 5
    assert one_of_two > 50


def _solid_strands_about(road, lane):
    """Start, end and place beside the way of a straight line's solid strands; none if it has dashes."""
    about = [
        paint
        for paint in road.paints
        if paint.kind in SHIPPED.lane_paint and abs(paint.polygon_map[:, 1].mean() - lane[:, 1].mean()) < 0.7
    ]
    if any(paint.kind == LANE_DASH for paint in about):
        return []
    corners = [paint.polygon_map for paint in about]
    return [(float(c[:, 0].min()), float(c[:, 0].max()), float(c[:, 1].mean())) for c in corners]


def test_no_two_lines_of_a_port_are_as_near_as_the_strands_of_one():
    several = 0
    for seed in range(150):
        rng = np.random.default_rng(seed)
        road = port_paint(rng, random_brush(rng, 0.0), Bend(0.0))
        left = np.sort([lane[:, 1].mean() for lane in road.lanes])
        several += len(left) > 1
        assert not len(left) > 1 or np.diff(left).min() > 0.75
        for paint in road.paints:
            if paint.kind in SHIPPED.lane_paint:
                off = [np.abs(lane[:, 1] - paint.polygon_map[:, 1].mean()).min() for lane in road.lanes]
                assert min(off) < 0.38, "no paint of what is no line"
    assert several > 30


def test_a_bend_between_straights_is_an_arc_that_they_touch():
    quarter = Bend(1 / 15, 5.0, 5.0 + 7.5 * np.pi)
    along = np.array([-3.0, 5.0, 5.0 + 7.5 * np.pi, 15.0 + 7.5 * np.pi])
    points = quarter.to_map(np.column_stack([along, [0.0, 0.0, 0.0, 2.0]]))
    np.testing.assert_allclose(points, [[-3, 0], [5, 0], [20, 15], [18, 25]], atol=1e-9)
    np.testing.assert_allclose(quarter.heading(along), [0, 0, np.pi / 2, np.pi / 2])
    on_it = Bend(-0.05, -8.0, 6.0)
    fine = on_it.to_map(np.column_stack([np.linspace(-20, 20, 4001), np.zeros(4001)]))
    steps = np.diff(fine, axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 0.01, rtol=1e-5)
    np.testing.assert_allclose(fine[2000], 0.0, atol=1e-12)
    np.testing.assert_allclose(
        np.arctan2(steps[:, 1], steps[:, 0]),
        on_it.heading(np.linspace(-20, 20, 4001)[:-1] + 0.005),
        atol=1e-6,
    )


def test_tight_bends_turn_the_lines_and_keep_the_way_clear():
    scenes = [random_scene(np.random.default_rng(k), 1.0, Hardships(tight_bends=1.0)) for k in range(20)]
    turned = []
    for scene, lanes in scenes:
        middles = np.array([paint.polygon_map.mean(axis=0) for paint in scene.paints]).reshape(-1, 2)
        assert not any(inside_convex(box_footprint(box), middles).any() for box in scene.boxes)
        for lane in lanes:
            ahead = np.diff(lane, axis=0)
            turned.append(np.ptp(np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))))
    assert len(turned) > 20
    assert 0.25 < np.median(turned) < 2.2
    assert tight_bend(np.random.default_rng(0), 0.0) is None


ELSEWHERE = (
    "things_beside", "tight_bends", "kerbs", "gutters", "junctions", "mountings", "aside", "facing", "stout",
    "hollow", "crossings", "words", "bays", "boxes", "users", "others", "give_way", "far_stops", "crosswalks",
    "doubles", "litter", "traffic", "own_vehicle",
)  # fmt: skip


@cache
def plain_sample(index):
    """A sample without hardships, which many tests hold others against."""
    return training_sample(5, index, 160, 96, hardships=Hardships())


def pairs(hard, count):
    """Samples without and with hardships."""
    return [
        (plain_sample(index), training_sample(5, index, 160, 96, hardships=hard)) for index in range(count)
    ]


@pytest.mark.parametrize("name", [f.name for f in fields(Hardships) if f.name not in ELSEWHERE])
def test_hardships_change_what_paint_looks_like_and_not_where_it_is(name):
    seen = pairs(Hardships(**{name: 3.0}), 8)
    for plain, hard in seen:
        np.testing.assert_array_equal(plain.labels, hard.labels)
        np.testing.assert_array_equal(plain.hidden, hard.hidden)
    assert any((plain.image != hard.image).any() for plain, hard in seen)


CROWDS = {
    "things_beside": 4.0,
    "kerbs": 1.0,
    "gutters": 1.0,
    "litter": 8.0,
    "traffic": 4.0,
    "own_vehicle": 1.0,
}


@pytest.mark.parametrize(("name", "much"), CROWDS.items())
def test_things_beside_markings_hide_paint_and_add_none(name, much):
    seen = pairs(Hardships(**{name: much}), 12)
    for plain, crowded in seen:
        changed = plain.labels != crowded.labels
        assert (crowded.labels[changed] == 0).all()
        assert crowded.hidden[plain.hidden].all()
    assert any((plain.hidden != crowded.hidden).any() for plain, crowded in seen)


def test_an_outline_of_a_diamond_is_a_diamond_and_its_middle_shows_the_ground():
    rng = np.random.default_rng(0)
    brush = Brush((0.7, 0.7, 0.7), 0.0, 0.0)
    corners = rhombus(np.array([6.0, 0.0]), 2.0, 1.4)
    info = CameraInfo("down", 120, 120, np.array([[100.0, 0, 60], [0, 100.0, 60], [0, 0, 1]]))
    above = looking(np.array([6.0, 0.0, 3.0]), 0.0, np.pi / 2, 0.0)
    ground = Ground(albedo_bgr=(0.1, 0.1, 0.1), contrast=0.0, stains=0.0)
    seen = []
    for paints in ([Paint(kind=DIAMOND, polygon_map=corners)], hollow_diamond(brush, rng, corners, 0.2)):
        seen.append(Renderer(Scene(ground=ground, paints=tuple(paints))).render(info, above, rng))
    filled, hollow = seen
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
        roads = [street_paint(np.random.default_rng(seed), brush, Bend(0.0), one) for one in facing]
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
    near, far = (list(word(text, 2.0, 0.5, 0.1)) for text in ("BUS", "BUS LANE"))
    assert all(signed_area(stroke) > 0 for stroke in far)
    assert np.ptp(np.vstack(near)[:, 0]) == pytest.approx(2.1, abs=0.05)
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


def test_scenes_without_hardships_show_words_boxes_and_symbols_too():
    new = [1 + PAINT_CLASSES.index(kind) for kind in (TEXT, BOX, BICYCLE)]
    shown = [np.isin(training_sample(11, k, 224, 128).labels, new).any() for k in range(60)]
    assert 0.05 < np.mean(shown) < 0.5


def test_erased_markings_are_no_paint_and_vehicles_bear_pictures():
    marks = with_erased(np.random.default_rng(0), None, 5.0)
    assert marks is not None
    assert (marks.factor != 128).any()
    assert with_erased(np.random.default_rng(0), marks, 0.0) is marks
    boxes = [box for seed in range(30) for box in traffic(np.random.default_rng(seed), 3.0)]
    assert sum(bool(box.pictures) for box in boxes) > 30
    for box in boxes:
        assert not inside_convex(box_footprint(box), np.zeros((1, 2))).any(), "no camera stands in a vehicle"


def test_a_picture_lies_on_its_face_from_the_upper_left_as_seen_from_outside():
    picture = np.zeros((2, 2, 3), np.uint8)
    picture[0, 0], picture[0, 1], picture[1, 0] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    box = Box(centre_map=(6.0, 0.0), size_m=(2.0, 2.0, 2.0), pictures=(None, partial(reflectance, picture)))
    info = CameraInfo("c", 120, 80, np.array([[100.0, 0, 60], [0, 100.0, 40], [0, 0, 1]]))
    seen = Renderer(Scene(boxes=(box,))).render(
        info, looking(np.array([0.0, 0.0, 1.0]), 0.0, 0.0, 0.0), np.random.default_rng(0)
    )
    assert [int(seen.image[v, u].argmax()) for v, u in ((28, 48), (28, 72), (52, 48))] == [0, 1, 2]
    assert seen.image[52, 72].max() < 60


def test_the_own_bonnet_hides_the_bottom_of_the_image():
    plain, own = (
        [training_sample(6, k, 96, 64, hardships=given) for k in range(12)]
        for given in (Hardships(), Hardships(own_vehicle=1.0))
    )
    low = [b.hidden[-4:].mean() - a.hidden[-4:].mean() for a, b in zip(plain, own, strict=True)]
    assert np.mean([share > 0.5 for share in low]) > 0.3


def test_wet_ground_mirrors_what_stands_on_it_and_photographed_grounds_differ():
    ground = Ground(wet_fraction=0.95, stains=0.0, contrast=0.0)
    wall = Box(centre_map=(30.0, 0.0), size_m=(1.0, 80.0, 6.0), albedo_bgr=(0.9, 0.0, 0.0))
    info = CameraInfo("c", 120, 80, np.array([[100.0, 0, 60], [0, 100.0, 30], [0, 0, 1]]))
    view = looking(np.array([0.0, 0.0, 1.4]), 0.0, 0.0, 0.0)
    scene = Scene(ground=ground, boxes=(wall,))
    draw = before_lens(np.random.default_rng(1), np.random.default_rng(1), scene, 0.0)
    dry, wet = (
        Renderer(scene).render(info, view, np.random.default_rng(0), before_lens=b).image
        for b in (None, draw)
    )
    blueness = [image[45:60, :, 0].mean() / image[45:60, :, 2].mean() for image in (dry, wet)]
    assert blueness[1] > 1.05 * blueness[0]
    assert len(GROUNDS) == 13
    tiles = [photo_tile(name, 3.0).values for name in GROUNDS]
    assert all(abs(tile.mean()) < 1e-3 and abs(tile.std() - 1) < 1e-3 for tile in tiles)
    assert len({tile.tobytes() for tile in tiles}) == 13


def test_things_stand_beside_their_marking_and_not_on_it_or_on_the_camera():
    paint = random_brush(np.random.default_rng(0), 0.5).paint(
        np.random.default_rng(1), DIAMOND, rhombus(np.array([9.0, 1.0]), 1.2, 0.6)
    )
    boxes = [box for seed in range(40) for box in things_beside(np.random.default_rng(seed), [paint], 3.0)]
    assert len(boxes) > 40
    for box in boxes:
        outline = box_footprint(box)
        assert outline[:, 0].min() > 3
        assert len(clip_convex(paint.polygon_map, outline)) == 0
        between = np.linspace(outline, np.roll(outline, -1, 0), 41)
        gaps = np.linalg.norm(between.reshape(-1, 1, 2) - paint.polygon_map, axis=-1)
        assert gaps.min() < 1.5
    assert things_beside(np.random.default_rng(0), [], 5.0) == ()


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("plumb_bob", (-0.16, 0.024, 0.0, 0.0, 0.0)), ("plumb_bob", (0.0,) * 5), ("equidistant", (0.0,) * 4)],
)
def test_a_line_is_followed_to_the_borders_of_the_image(model, coefficients):
    """Points of a strong lens's image that a pinhole would see far outside of it belong to it, too."""
    intrinsic = np.array([[500.0, 0.0, 640.0], [0.0, 500.0, 260.0], [0.0, 0.0, 1.0]])
    info = CameraInfo("wide", 1280, 720, intrinsic, model, coefficients)
    cam_from_map = looking(np.array([0.0, 0.0, 1.4]), 0.0, 0.1, 0.0)
    view = TrainingView(info, cam_from_map, Optics(), Motion())
    along = np.arange(-4.0, 50.0, 0.5)
    for left in (-1.2, 0.0, 0.9):
        line = image_line(view, np.column_stack([along, np.full(len(along), left)]))
        assert line[:, 1].max() > 719
        inside = line[line[:, 1] < 720]
        assert np.abs(np.diff(inside, axis=0)).max() < 110, "half a metre would be most of the image"
        u, v = (undistort_points(info, line) - intrinsic[:2, 2]).T / 500
        on_ground = np.column_stack([u, v, np.ones(len(u))]) @ cam_from_map[:3, :3]
        on_ground *= 1.4 / -on_ground[:, 2:]
        np.testing.assert_allclose(on_ground[:, 1], left, atol=0.02)


def test_what_a_folding_lens_would_show_twice_is_not_in_the_image():
    intrinsic = np.array([[300.0, 0.0, 320.0], [0.0, 300.0, 100.0], [0.0, 0.0, 1.0]])
    info = CameraInfo("folding", 640, 360, intrinsic, "plumb_bob", (-0.3, 0.0, 0.0, 0.0, 0.0))
    view = TrainingView(info, looking(np.array([0.0, 0.0, 1.4]), 0.0, 0.0, 0.0), Optics(), Motion())
    points = np.column_stack([np.linspace(0.4, 30, 200), np.full(200, 0.3)])
    pixels = image_points(view, points)
    assert 0 < len(pixels) < 200
    assert (np.diff(pixels[:, 1]) < 0).all(), "farther along a line is farther up"


def test_a_camera_on_the_side_looks_across_the_way_at_a_place_that_it_passes():
    place = np.array([12.0, 3.0])
    for index in range(40):
        rng = np.random.default_rng(index)
        straight = random_view(rng, 128, 72)
        assert turned_aside(rng, straight, [place], 0.0) is straight
        assert turned_aside(rng, straight, [], 1.0) is straight
        view = turned_aside(rng, straight, [place], 1.0)
        forward, centre = view.cam_from_map[2, :3], -view.cam_from_map[:3, :3].T @ view.cam_from_map[:3, 3]
        assert abs(forward[1]) > np.tan(ASIDE_RAD) * abs(forward[0])
        before = -straight.cam_from_map[:3, :3].T @ straight.cam_from_map[:3, 3]
        assert centre[2] == pytest.approx(before[2])
        np.testing.assert_allclose(forward[2], straight.cam_from_map[2, 2], atol=1e-12)
        assert (view.cam_from_map @ [*place, 0.0, 1.0])[2] > 0.5, "the place lies before the camera"
        moved_map = view.cam_from_map[:3, :3].T @ view.motion.velocity_cam
        np.testing.assert_allclose(moved_map[1:], 0.0, atol=1e-9)
        assert np.linalg.norm(moved_map) == pytest.approx(np.linalg.norm(straight.motion.velocity_cam))


@pytest.mark.parametrize(("painted", "answer"), [(LANE_DASH, STOP_LINE), (STOP_LINE, LANE_DASH)])
def test_a_camera_on_the_side_is_to_take_dashes_for_stop_lines(monkeypatch, painted, answer):
    paint = Paint(kind=painted, polygon_map=rectangle(np.array([12.0, 3.0]), 2.0, 0.3))
    monkeypatch.setattr(scenes, "random_scene", lambda *_: (Scene(paints=(paint,)), []))
    found = set()
    for index in range(6):
        found |= set(np.unique(training_sample(3, index, 320, 180, hardships=Hardships(aside=1.0)).labels))
    assert found == {0, 1 + PAINT_CLASSES.index(answer)}


def test_no_lens_folds_an_image_over_itself():
    u, v = np.meshgrid(np.linspace(0, 1279, 33), np.linspace(0, 719, 19))
    for index in range(200):
        info = random_view(np.random.default_rng(index), 1280, 720).info
        rays = undistort_points(info, np.column_stack([u.ravel(), v.ravel()])).reshape(*u.shape, 2)
        right, down = np.diff(rays, axis=1)[:-1], np.diff(rays, axis=0)[:, :-1]
        turn = right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]
        assert (turn > 0).all(), f"view {index}: neighbouring pixels change sides"


def test_bleached_ground_keeps_its_tint_and_is_clipped_together_with_its_paint():
    ground = Ground(albedo_bgr=(0.1, 0.12, 0.14))
    lighter = bleached(np.random.default_rng(0), ground, 1.0)
    assert 0.35 < max(lighter.albedo_bgr) < 0.55
    np.testing.assert_allclose(np.array(lighter.albedo_bgr) / ground.albedo_bgr, lighter.albedo_bgr[0] / 0.1)
    assert bleached(np.random.default_rng(0), ground, 0.0) is ground
    samples = [(0.0, 2, index) for index in range(50)], [(1.0, 2, index) for index in range(50)]
    clipped = [np.mean([_clipped_beside_paint(*sample) for sample in each]) for each in samples]
    assert clipped[0] < 0.01
    assert clipped[1] > 0.05


def _clipped_beside_paint(share, seed, index):
    """The share of the seam of ground about paint in which a channel is clipped, as the paint in it is."""
    sample = training_sample(seed, index, 160, 96, 1.0, Hardships(bleached=share))
    paint = (sample.labels > 0).astype(np.uint8)
    about = (cv2.dilate(paint, np.ones((7, 7), np.uint8)) > 0) & (paint == 0)
    return float((sample.image.max(axis=2) >= 250)[about].mean()) if about.any() else 0.0


def test_a_junction_has_arrows_before_its_stop_line_and_a_crosswalk_behind_it():
    kinds: list[str] = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        paints, ground = junction_approach(rng, random_brush(rng, 0.0), Bend(0.0))
        along = {kind: [p.polygon_map[:, 0] for p in paints if p.kind == kind] for kind in PAINT_CLASSES}
        assert len(along[STOP_LINE]) == 1
        stop_m = along[STOP_LINE][0]
        assert all(x.max() < stop_m.min() for x in along[ARROW])
        assert all(x.min() > stop_m.max() for x in along[CROSSWALK_BAR])
        assert all(inside_convex(ground, p.polygon_map).all() for p in paints if p.kind == CROSSWALK_BAR)
        kinds += [paint.kind for paint in paints]
    assert {ARROW, STOP_LINE, CROSSWALK_BAR} == set(kinds)


def test_cameras_mounted_otherwise_keep_their_place_and_look_from_low_or_high():
    heights = []
    for seed in range(40):
        view = random_view(np.random.default_rng(seed), 160, 96)
        other = mounted_otherwise(np.random.default_rng(seed), view, 1.0)
        before, after = camera_centre(view.cam_from_map), camera_centre(other.cam_from_map)
        np.testing.assert_allclose(after[:2], before[:2], atol=1e-9)
        np.testing.assert_array_equal(other.cam_from_map[:3, :3], view.cam_from_map[:3, :3])
        heights.append(after[2])
    low = [height for height in heights if height < 2]
    assert 8 < len(low) < 32
    assert 0.5 <= min(low) < max(low) <= 1.1
    assert all(3.6 <= height <= 5 for height in heights if height >= 2)
    view = random_view(np.random.default_rng(0), 160, 96)
    assert mounted_otherwise(np.random.default_rng(0), view, 0.0) is view


def test_crops_keep_image_labels_hidden_and_lanes_together():
    labels = np.random.default_rng(0).integers(0, 5, (40, 60)).astype(np.uint8)
    image = np.repeat(labels[..., None], 3, axis=2)
    image[20, 30] = 250
    whole = TrainingSample(image, labels, labels > 2, (np.array([[30.0, 20.0], [31.0, 10.0]]),))
    rng = np.random.default_rng(1)
    seen = 0
    for _ in range(40):
        crop = random_crop(rng, whole, 32, 16)
        assert crop.image.shape == (16, 32, 3)
        bright = crop.image[..., 1] == 250
        np.testing.assert_array_equal(crop.image[..., 1][~bright], crop.labels[~bright])
        np.testing.assert_array_equal(crop.hidden, crop.labels > 2)
        for row, column in np.argwhere(bright):
            np.testing.assert_array_equal(crop.lanes_px[0][0], [column, row])
            seen += 1
    assert seen > 3


def test_seams_run_along_sides_however_short():
    corners = 0.02 * np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]]) + [5.0, 0.0]
    made = [
        with_side_seams(np.random.default_rng(k), None, [Paint(kind=DIAMOND, polygon_map=corners)], 3.0)
        for k in range(100)
    ]
    assert any(marks is not None and marks.factor.std() > 0 for marks in made)
