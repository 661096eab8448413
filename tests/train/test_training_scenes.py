"""Random scenes, views and hardships of training: reproducible, varied, labelled where the paint is."""

from dataclasses import fields
from functools import cache, partial

import cv2
import numpy as np
import pytest

from train.config import DataConfig
from train.data import RenderStream, validation_pairs
from train.scenes.hardships import (
    Hardships,
    bleached,
    junction_approach,
    things_beside,
    tight_bend,
    with_side_seams,
)
from train.scenes.paint import (
    Bend,
    port_paint,
    random_brush,
    rhombus,
    street_paint,
)
from train.scenes.remains import with_erased
from train.scenes.scenes import random_scene, training_sample
from train.scenes.traffic import reflectance, traffic
from train.scenes.views import looking
from train.scenes.weather import GROUNDS, photo_tile
from train.scenes.windscreen import before_lens
from v2hdm.catalogue import PAINT_CLASSES, SHIPPED
from v2hdm.geometry.planar import clip_convex, inside_convex
from v2hdm.records import (
    ARROW,
    BICYCLE,
    BOX,
    CROSSWALK_BAR,
    DIAMOND,
    LANE_DASH,
    STOP_LINE,
    TEXT,
    CameraInfo,
)
from v2hdm.simulate.render.renderer import Renderer
from v2hdm.simulate.render.scene import Box, Ground, Paint, Scene, box_footprint

TINY = DataConfig(width=64, height=32, render_width=80, render_height=48, views_per_render=2, reservoir=3)


def test_a_seed_and_an_index_make_the_same_picture_again():
    first, again = (training_sample(5, 3, 96, 64) for _ in range(2))
    np.testing.assert_array_equal(first.image, again.image)
    np.testing.assert_array_equal(first.labels, again.labels)
    assert (training_sample(5, 4, 96, 64).image != first.image).any()


def test_streams_of_one_seed_are_the_same():
    stream, other = iter(RenderStream(TINY, 1)), iter(RenderStream(TINY, 1))
    for _ in range(5):
        (image, answers), (image_again, answers_again) = next(stream), next(other)
        assert image.shape == (32, 64, 3)
        assert answers.paint.shape == (16, 32)
        assert bool((image == image_again).all())
        assert all(bool((a == b).all()) for a, b in zip(answers, answers_again, strict=True))


def test_validation_shows_other_scenes_than_training():
    image, _ = next(validation_pairs(TINY, 1, 1))
    assert (image.numpy() != training_sample(1, 0, 64, 32).image).any()


def test_all_classes_are_seen_in_a_hundred_or_so_samples():
    classes = {int(c) for index in range(120) for c in np.unique(training_sample(2, index, 320, 192).labels)}
    assert classes == set(range(1 + len(PAINT_CLASSES)))


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


def test_lanes_lie_on_their_paint():
    on_paint, inside_count = 0, 0
    for index in range(60):
        sample = training_sample(3, index, 192, 96, difficulty=0.0)
        lane_paint = np.isin(sample.labels, [1 + PAINT_CLASSES.index(kind) for kind in SHIPPED.lane_paint])
        for lane in sample.lanes_px:
            u, v = np.round(lane).astype(int).T
            inside = (u >= 0) & (u < 192) & (v >= 30) & (v < 96)
            inside[inside] = ~sample.hidden[v[inside], u[inside]]
            inside_count += inside.sum()
            on_paint += lane_paint[v[inside], u[inside]].sum()
    assert inside_count > 300
    assert 0.4 < on_paint / inside_count < 0.95, "dashes leave gaps, double lines are bare between"


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
                is_near = [(along + passing > start) & (along - passing < end) for start, end, _ in strands]
                here = [(along - passing > start) & (along + passing < end) for start, end, _ in strands]
                if is_near != here or not any(here):
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
    scene_pairs = pairs(Hardships(**{name: 3.0}), 8)
    for plain, hard in scene_pairs:
        np.testing.assert_array_equal(plain.labels, hard.labels)
        np.testing.assert_array_equal(plain.hidden, hard.hidden)
    assert any((plain.image != hard.image).any() for plain, hard in scene_pairs)


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
    scene_pairs = pairs(Hardships(**{name: much}), 12)
    for plain, crowded in scene_pairs:
        changed = plain.labels != crowded.labels
        assert (crowded.labels[changed] == 0).all()
        assert crowded.hidden[plain.hidden].all()
    assert any((plain.hidden != crowded.hidden).any() for plain, crowded in scene_pairs)


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
    rendered = Renderer(Scene(boxes=(box,))).render(
        info, looking(np.array([0.0, 0.0, 1.0]), 0.0, 0.0, 0.0), np.random.default_rng(0)
    )
    assert [int(rendered.image[v, u].argmax()) for v, u in ((28, 48), (28, 72), (52, 48))] == [0, 1, 2]
    assert rendered.image[52, 72].max() < 60


def test_the_own_bonnet_hides_the_bottom_of_the_image():
    plain, with_bonnet = (
        [training_sample(6, k, 96, 64, hardships=hardships) for k in range(12)]
        for hardships in (Hardships(), Hardships(own_vehicle=1.0))
    )
    low = [b.hidden[-4:].mean() - a.hidden[-4:].mean() for a, b in zip(plain, with_bonnet, strict=True)]
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


def test_bleached_ground_keeps_its_tint_and_is_clipped_together_with_its_paint():
    ground = Ground(albedo_bgr=(0.1, 0.12, 0.14))
    lighter = bleached(np.random.default_rng(0), ground, 1.0)
    assert 0.35 < max(lighter.albedo_bgr) < 0.55
    np.testing.assert_allclose(np.array(lighter.albedo_bgr) / ground.albedo_bgr, lighter.albedo_bgr[0] / 0.1)
    assert bleached(np.random.default_rng(0), ground, 0.0) is ground
    samples = [(0.0, 2, index) for index in range(50)], [(1.0, 2, index) for index in range(50)]
    clipped = [np.mean([_clipped_beside_paint(*sample) for sample in sample_list]) for sample_list in samples]
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


def test_seams_run_along_sides_however_short():
    corners = 0.02 * np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]]) + [5.0, 0.0]
    marks_made = [
        with_side_seams(np.random.default_rng(k), None, [Paint(kind=DIAMOND, polygon_map=corners)], 3.0)
        for k in range(100)
    ]
    assert any(marks is not None and marks.factor.std() > 0 for marks in marks_made)
