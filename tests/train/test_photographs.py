"""Labels of photographs: what is drawn around paint, listed apart, or rare."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.benchmarks.photographs import covered, joined
from tests.train.small import coco, tiny, train
from train.config import DataConfig, LabelError, LossConfig
from train.examples import photograph
from train.label_hints import with_hints
from train.labels import Favour, Place, paint_labels, read_labels
from train.labels_image import LabelledImage, Shape
from train.labels_tone import log_light, tone_of
from train.loop import Trainer
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.detection.camera import RoadCamera, camera_from_calibration, rough_calibration
from v2hdm.errors import ConfigError
from v2hdm.geometry.ipm import apply_homography
from v2hdm.records import ARROW, CROSSWALK_BAR, LANE_DASH, LANE_LINE, STOP_LINE, TEXT

MOUNTING = [1.3, -12.0, 90.0]


def outline(left, top, right, bottom):
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]], dtype=np.float64)


def crosswalk(ground=90, paint=190):
    """An image (128, 256, 3) of six bars of 16 px, 32 px apart, in light that falls off to the right."""
    image = np.full((128, 256, 3), ground, dtype=np.float64)
    for left in range(32, 224, 32):
        image[50:90, left : left + 16] = paint
    image *= np.linspace(1.2, 0.6, 256)[:, None]
    return np.clip(image, 0, 255).astype(np.uint8)


def labelled(folder, image, shape, **settings):
    cv2.imwrite(str(folder / "a.png"), image)
    plain = LabelledImage("", folder / "a.png", shapes=(shape,), edge_px=3.0)
    config = DataConfig(coco_tone=True, coco_camera=MOUNTING, **settings)
    (hinted,) = with_hints([plain], config, lambda share: None)
    return paint_labels(hinted, Place.whole(image.shape[1], image.shape[0]))


@pytest.mark.parametrize("kind", [CROSSWALK_BAR, TEXT])
def test_the_bright_pieces_in_an_outline_are_paint_and_the_rest_is_ground(tmp_path, kind):
    shape = Shape((kind, "none"), (outline(26, 44, 230, 96),))
    labels, unknown = labelled(tmp_path, crosswalk(), shape)
    assert set(np.unique(labels)) == {0, 1 + PAINT_CLASSES.index(kind)}
    for left in range(32, 224, 32):
        assert (labels[52:88, left + 2 : left + 14] > 0).all()
        assert (labels[52:88, left + 18 : left + 30] == 0).all()
        assert not unknown[52:88, left + 18 : left + 30].any()
    assert not unknown[52:88, 34:46].any()


def test_an_outline_of_which_all_is_alike_says_nothing(tmp_path):
    assert tone_of(log_light(np.full((128, 256, 3), 90, np.uint8)), [outline(26, 44, 230, 96)], True) is None
    shape = Shape((CROSSWALK_BAR, "none"), (outline(26, 44, 230, 96),))
    labels, unknown = labelled(tmp_path, np.full((128, 256, 3), 90, np.uint8), shape)
    assert unknown[50:90, 30:226].all()
    assert not labels.any()


def test_a_line_drawn_three_times_as_wide_is_as_thin_as_its_paint(tmp_path):
    image = np.full((128, 256, 3), 90, np.uint8)
    image[60:65] = 190
    labels, unknown = labelled(tmp_path, image, Shape((STOP_LINE,), (outline(20, 55, 236, 70),)))
    stop_line = 1 + PAINT_CLASSES.index(STOP_LINE)
    assert (labels[60:65, 30:226] == stop_line).all()
    assert not labels[67:].any()
    assert not unknown[67:69, 30:226].any()


def test_an_arrow_stays_as_it_is_drawn(tmp_path):
    labels, _ = labelled(tmp_path, crosswalk(), Shape((ARROW,), (outline(26, 44, 230, 96),)))
    assert (labels[50:90, 30:226] == 1 + PAINT_CLASSES.index(ARROW)).all()


def test_a_window_half_as_large_shows_the_same_paint(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), crosswalk())
    shape = Shape((CROSSWALK_BAR, "none"), (outline(26, 44, 230, 96),))
    toned = replace(shape, tone=tone_of(log_light(crosswalk()), shape.rings_px, True))
    image = LabelledImage("", tmp_path / "a.png", shapes=(toned,))
    whole, _ = paint_labels(image, Place.whole(256, 128))
    half, _ = paint_labels(image, Place(np.array([16, 8]), np.array([0.5, 0.5]), 110, 56))
    assert (half > 0).mean() == pytest.approx((whole[8:120, 16:236] > 0).mean(), rel=0.1)


@pytest.mark.parametrize(("ahead_m", "left_m", "kind"), [(0.4, 3.0, STOP_LINE), (3.0, 0.12, LANE_DASH)])
def test_a_line_across_the_way_is_a_stop_line_and_one_along_it_is_not(tmp_path, ahead_m, left_m, kind):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((720, 1280, 3), 90, np.uint8))
    road = RoadCamera(camera_from_calibration(rough_calibration("", 1280, 720, *MOUNTING)))
    shape = np.array([[0, 0], [ahead_m, 0], [ahead_m, left_m], [0, left_m]])
    ring = road.distort(apply_homography(road.pinhole_px_from_vehicle, shape + np.array([6.0, -left_m / 2])))
    image = LabelledImage("", tmp_path / "a.png", shapes=(Shape((LANE_DASH, LANE_LINE, STOP_LINE), (ring,)),))
    (hinted,) = with_hints([image], DataConfig(coco_camera=MOUNTING), lambda share: None)
    (stop_line,) = hinted.shapes or ()
    other = {STOP_LINE: {LANE_DASH, LANE_LINE}, LANE_DASH: {STOP_LINE}}[kind]
    assert not other & set(stop_line.kinds)


def small(folder, **settings):
    sizes = {"width": 64, "height": 32, "render_width": 80, "render_height": 48}
    return DataConfig(**sizes, coco=str(coco(folder)), workers=0, labelled_share=1.0, **settings)


def listed(folder, name, content):
    (folder / name).write_text(json.dumps(content))
    return str(folder / name)


@pytest.mark.parametrize("content", [[1], {"about": "looked at", "annotations": [1]}])
def test_listed_annotations_are_of_the_category_that_the_list_is_of(tmp_path, content):
    config = small(tmp_path, coco_relabel={STOP_LINE: listed(tmp_path, "stop_lines.json", content)})
    assert [shape.kinds for image in read_labels(config).images for shape in image.shapes] == [(STOP_LINE,)]
    lists = {"halt": listed(tmp_path, "halt.json", content)}
    config = small(tmp_path, coco_relabel=lists, coco_classes={"halt": STOP_LINE})
    assert [shape.kinds for image in read_labels(config).images for shape in image.shapes] == [(STOP_LINE,)]


@pytest.mark.parametrize(
    ("lists", "words"),
    [
        (
            {STOP_LINE: [1], LANE_DASH: [1]},
            "annotation 1 is to be lane_dash, but .*stop_line.json says stop_line",
        ),
        ({STOP_LINE: [1, 88]}, "stop_line.json: .*coco.json has no annotation 88"),
        ({STOP_LINE: {"stop": [1]}}, "stop_line.json: is no list of ids"),
        ({STOP_LINE: [[1]]}, "stop_line.json: is no list of ids"),
        ({"halt": [1]}, "category 'halt' is no class of the detector"),
    ],
)
def test_a_list_that_does_not_fit_the_labels_is_named_in_one_line(tmp_path, lists, words):
    files = {name: listed(tmp_path, f"{name}.json", content) for name, content in lists.items()}
    with pytest.raises(LabelError, match=words) as refused:
        read_labels(small(tmp_path, coco_relabel=files))
    assert "\n" not in str(refused.value)


def test_a_label_file_without_a_new_class_says_how_to_go_on(tmp_path):
    with pytest.raises(
        LabelError, match=r"no category 'slow'.*coco_relabel, or drop it: '~data.coco_classes.slow'"
    ):
        read_labels(small(tmp_path, coco_classes={"slow": "text|none"}))


def test_images_with_a_rare_class_are_shown_oftener_the_more_balance_is_asked_for():
    ring = (outline(0, 0, 4, 4),)
    images = [LabelledImage("", Path(), shapes=(Shape((ARROW,), ring),))] * 16
    images += [LabelledImage("", Path(), shapes=(Shape((ARROW,), ring), Shape((STOP_LINE,), ring)))]
    images += [LabelledImage("", Path(), shapes=())]
    plain, some, much = (Favour.of(images, balance).of_images for balance in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(plain, 1 / 18)
    assert some[16] / some[0] == pytest.approx(17**0.5)
    assert much[16] / much[0] == pytest.approx(8.0)  # at most
    assert some[17] == some[0]
    favour = Favour.of(images, 0.5).of_points(images[16])
    assert favour[1] / favour[0] == pytest.approx(17**0.5)


def test_the_heads_of_classes_learn_alone_at_first(tmp_path):
    trainer = Trainer(replace(tiny(tmp_path, steps=4), head_updates=2), lambda share, line: None)
    start = {name: value.clone() for name, value in trainer.net.state_dict().items()}
    trainer.config.steps = 2
    trainer.run()
    changed = {name for name, value in trainer.net.state_dict().items() if (value != start[name]).any()}
    assert changed
    assert all(name.startswith(("kinds.", "wide_kinds.")) for name in changed)
    trainer.config.steps = 4
    trainer.run()
    assert (trainer.net.state_dict()["stem.0.weight"] != start["stem.0.weight"]).any()


def heads_alone(folder, **changes):
    """A trainer whose heads learn alone from the start of a small run, and what that start says of noise."""
    if not (folder / "first").is_dir():
        train(tiny(folder / "first"))
    start = str(folder / "first" / "last.pt")
    config = replace(tiny(folder, steps=12), start=start, head_updates=12, learning_rate=1e-2)
    return Trainer(replace(config, **changes), lambda share, line: None)


def test_heads_that_learn_alone_keep_to_the_classes_of_their_start(tmp_path):
    image = torch.randint(0, 256, (4, 32, 64, 3), dtype=torch.uint8)
    moved = []
    for weight in (0.0, 30.0):
        trainer = heads_alone(tmp_path, output=str(tmp_path / f"kept{weight}"), loss=LossConfig(kept=weight))
        # Paint is seen everywhere, so that the classes of bare ground are kept, too.
        for net in (trainer.net, trainer._before):
            torch.nn.init.constant_(net.paint.bias, 50.0)
        before = trainer._before(image).kinds.softmax(1)
        trainer.run()
        moved.append((trainer.net.eval()(image).kinds.softmax(1) - before).abs().mean().item())
    assert moved[1] < 0.5 * moved[0]


def test_of_classes_that_learn_alone_the_others_stay(tmp_path):
    trainer = heads_alone(tmp_path, only_classes=["text"])
    before = trainer._before.state_dict()
    names = trainer.state.catalogue.names
    text = names.index("text")
    trainer.run()
    changed = {name for name, value in trainer.net.state_dict().items() if (value != before[name]).any()}
    assert changed == {"kinds.weight", "kinds.bias"}
    rows = (trainer.net.state_dict()["kinds.weight"] != before["kinds.weight"]).flatten(1).any(dim=1)
    assert rows.tolist() == [k == text for k in range(len(names))]


def test_channels_that_are_added_learn_with_the_classes_that_read_them(tmp_path):
    small = tiny(tmp_path / "first")
    small = replace(small, net=replace(small.net, separable=False, wide_kinds=True))
    train(small)
    trainer = heads_alone(tmp_path, only_classes=["text"], net=replace(small.net, added_kinds=8))
    before = trainer._before.state_dict()
    text = trainer.state.catalogue.names.index("text")
    trainer.run()
    moved = {name: value != before[name] for name, value in trainer.net.state_dict().items()}
    changed = {name for name, is_moved in moved.items() if is_moved.any()}
    assert changed <= {
        "kinds.weight", "kinds.bias", "wide_kinds.1.weight", "wide_kinds.1.bias",
        "wide_kinds.0.0.weight", "wide_kinds.0.1.weight", "wide_kinds.0.1.bias",
    }  # fmt: skip
    hidden = moved["wide_kinds.0.0.weight"].flatten(1).any(dim=1)
    assert not hidden[:16].any()
    assert hidden[16:].any()
    classes = moved["wide_kinds.1.weight"].flatten(1).any(dim=1)
    assert classes.tolist() == [k == text for k in range(len(classes))]


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"only_classes": ["letters"]}, "no class 'letters'; choose from: diamond"),
        ({"only_classes": ["text"], "start": None}, "set start= and head_updates=, too"),
        ({"only_classes": ["text"], "head_updates": 0}, "set start= and head_updates=, too"),
    ],
)
def test_classes_that_cannot_learn_alone_are_refused(tmp_path, changes, line):
    with pytest.raises(ConfigError, match=line):
        heads_alone(tmp_path, **changes)


def test_the_judge_learns_a_stop_line_as_thin_as_its_paint(tmp_path):
    image = np.full((720, 1280, 3), 90, np.uint8)
    image[500:508, 300:900] = 190
    cv2.imwrite(str(tmp_path / "a.png"), image)
    ring = outline(300, 490, 900, 520)
    shape = Shape((STOP_LINE,), (ring,), tone_of(log_light(image), [ring], False))
    config = DataConfig(coco_camera=MOUNTING)
    plain = LabelledImage("", tmp_path / "a.png", shapes=(shape,))
    (marking,) = photograph(plain, config, np.random.default_rng(0)).markings
    assert marking.kind == STOP_LINE
    assert np.ptp(marking.polygon_px, axis=0).tolist() == pytest.approx([600, 8], abs=1)


def test_neighbouring_pieces_have_one_hull_and_a_far_one_its_own():
    bars = [outline(left, 50, left + 10, 90) for left in (20, 40, 60, 300)]
    hulls = sorted(joined(bars, 1.0), key=lambda hull: hull[:, 0].min())
    assert [np.ptp(hull, axis=0).tolist() for hull in hulls] == [[50, 40], [10, 40]]
    assert joined([], 1.0) == []


def test_a_stop_line_is_covered_as_far_as_pieces_lie_inside_its_outline():
    line = outline(100, 400, 499, 420)
    assert covered(line, [outline(100, 405, 299, 412)]) == pytest.approx(0.5)
    assert covered(line, [outline(100, 430, 499, 440)]) == 0
    assert covered(line, []) == 0
