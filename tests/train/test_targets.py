"""Losses, scores, targets and users' own labels, worked out by hand."""

import json
import re
from collections import Counter
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hypothesis import given
from hypothesis import strategies as st

from models import Prediction
from tests.train.small import HEIGHT, WIDTH, coco
from train.config import DataConfig, LabelError, LossConfig, TrainConfig
from train.data import RenderStream
from train.label_hints import with_hints
from train.labels import JUDGING, LEARNT, VALIDATION, Place, held_out, paint_labels, read_labels
from train.labels_image import ANY, PAINT_ONLY, LabelledImage, Shape
from train.labels_raster import coverage
from train.losses import dice_loss, kept_loss, kind_loss, lane_loss, paint_loss, rare_paint, total_loss
from train.metrics import Tally
from train.scenes.scenes import TrainingSample
from train.targets import (
    IGNORE,
    Targets,
    kind_target,
    kind_weight,
    lane_targets,
    paint_target,
    paint_weight,
    piece_size,
    targets,
)
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.cli.compose import register
from v2hdm.detection.camera import RoadCamera, camera_from_calibration, rough_calibration
from v2hdm.errors import ConfigError
from v2hdm.geometry.ipm import apply_homography
from v2hdm.records import ARROW, CROSSWALK_BAR, DIAMOND


def test_a_block_is_paint_by_most_of_its_pixels_and_a_tie_is_ignored():
    labels = np.array([[1, 1, 0, 2], [1, 0, 2, 0], [0, 0, 3, 3], [0, 4, 3, 3]], dtype=np.uint8)
    assert paint_target(labels).tolist() == [[1, IGNORE], [0, 1]]


def test_the_paint_target_moves_no_edge():
    labels = np.zeros((64, 64), dtype=np.uint8)
    labels[:, 21:] = 1
    assert paint_target(labels)[0, 9:12].tolist() == [0, IGNORE, 1]


def test_a_cell_has_the_class_of_most_of_its_paint():
    labels = np.zeros((8, 8), dtype=np.uint8)
    labels[:4, :4] = 3
    labels[0, :3] = 1
    labels[4:, 4] = 2  # a quarter of the cell is too little paint to be asked for its class
    assert kind_target(labels).tolist() == [[2, IGNORE], [IGNORE, IGNORE]]
    assert kind_target(labels).max(initial=0, where=kind_target(labels) != IGNORE) < len(PAINT_CLASSES)


def test_a_piece_of_paint_counts_as_the_root_of_its_cells():
    kinds = np.full((8, 12), IGNORE, dtype=np.uint8)
    kinds[1:5, 1:5] = 3
    kinds[1:5, 5] = 0  # of another class, though it touches
    kinds[7, 10] = 3
    weight = kind_weight(piece_size(kinds))
    assert weight[kinds == IGNORE].max() == 0
    assert weight[1:5, 1:5].sum() == pytest.approx(4)
    assert weight[1:5, 5].sum() == pytest.approx(2)
    assert weight[7, 10] == 1
    assert not kind_weight(piece_size(np.full((4, 4), IGNORE, dtype=np.uint8))).any()


def test_small_pieces_and_what_is_around_them_weigh_more():
    kinds = np.full((40, 40), IGNORE, dtype=np.uint8)
    kinds[4:8, 4:8] = 0
    kinds[30, 10] = 2
    kinds[20:30, 20:30] = 1
    weight = paint_weight(piece_size(kinds))
    assert weight[5, 5] == weight[4, 2] == 2  # the root of 64 / 16
    assert weight[4, 1] == weight[25, 25] == 1, "far from paint, or in the paint of a near marking"
    assert weight[30, 10] == weight[32, 12] == 4, "no piece weighs more"
    assert (paint_weight(piece_size(np.full((4, 4), IGNORE, dtype=np.uint8))) == 1).all()


def test_a_line_crosses_each_row_anchor_in_one_cell():
    line = np.array([[10.0, 40.0], [42.0, -10.0]])
    has_line, offset = lane_targets([line], 32, 64)
    assert (has_line == 1).sum(axis=1).tolist() == [1, 1, 1, 1]
    for row in range(4):
        (column,) = np.flatnonzero(has_line[row] == 1)
        u = 8 * (column + offset[row, column]) + 3.5
        assert u == pytest.approx(10 + 32 * (40 - (8 * row + 3.5)) / 50, abs=1e-5)


def test_a_crossing_near_the_next_cell_leaves_that_one_open():
    has_line, offset = lane_targets([np.array([[15.3, 20.0], [15.3, -5.0]])], 16, 32)
    assert has_line.tolist() == [[0, 1, IGNORE, 0]] * 2
    assert offset[0, 1] == pytest.approx((15.3 + 0.5) / 8 - 1.5)


def test_a_line_along_the_row_anchors_asks_for_nothing():
    has_line, _ = lane_targets([np.array([[2.0, 5.0], [60.0, 2.0]])], 16, 64)
    assert 1 not in has_line
    assert IGNORE in has_line


def test_a_line_behind_a_box_may_be_found_or_not():
    hidden = np.zeros((32, 64), dtype=bool)
    hidden[:16] = True
    labels = np.zeros((32, 64), dtype=np.uint8)
    sample = TrainingSample(
        np.zeros((32, 64, 3), np.uint8), labels, hidden, (np.array([[30.0, 40.0], [30.0, -5.0]]),)
    )
    has_line = targets(sample).lane_there.numpy()
    assert (has_line[:, 3] == [IGNORE, IGNORE, 1, 1]).all()


KINDS = len(PAINT_CLASSES)


def sure(labels):
    """Log odds that are all but certain of 0 or 1."""
    return 40.0 * (labels == 1).float() - 20.0


def sure_kinds(labels):
    """Logits (B, K, H, W) that are all but certain of the given classes."""
    labels_or_zero = torch.where(labels == IGNORE, 0, labels).long()
    return 30.0 * torch.nn.functional.one_hot(labels_or_zero, KINDS).permute(0, 3, 1, 2).float()


def example():
    """A picture of 8 x 16 px with paint, its class and a lane's line, and the perfect prediction of it."""
    paint = torch.zeros((1, 4, 8), dtype=torch.uint8)
    paint[0, :2, :4] = 1
    kinds = torch.full((1, 2, 4), IGNORE, dtype=torch.uint8)
    kinds[0, 0, :2] = 3
    has_line = torch.tensor([[[0, 1]]], dtype=torch.uint8)
    offset = torch.tensor([[[0.0, 0.25]]])
    prediction = Prediction(
        sure(paint)[:, None], sure_kinds(kinds), torch.stack([sure(has_line), offset], dim=1)
    )
    worth = torch.ones(kinds.shape)
    return prediction, Targets(paint, worth, kinds, worth, has_line, offset)


def test_certain_and_right_costs_nothing():
    prediction, targets = example()
    assert float(total_loss(prediction, targets, LossConfig())) < 1e-3


@pytest.mark.parametrize("wrong", ["paint", "kinds", "lanes"])
def test_each_output_that_is_wrong_costs(wrong):
    prediction, targets = example()
    prediction = prediction._replace(**{wrong: getattr(prediction, wrong).flip(-1)})
    assert float(total_loss(prediction, targets, LossConfig())) > 1


def test_certain_and_wrong_costs_the_whole_dice_loss_and_a_picture_without_paint_none():
    labels = torch.full((1, 40, 40), 1)
    assert float(dice_loss(sure(torch.zeros_like(labels)), labels)) > 0.99
    assert float(dice_loss(sure(0 * labels), 0 * labels)) == pytest.approx(0, abs=1e-6)


def test_ignored_elements_get_no_gradient():
    labels = torch.tensor([[[0, 1, IGNORE, 1]]], dtype=torch.uint8)
    logits = torch.randn(1, 1, 4, requires_grad=True)
    worth = torch.tensor([[[1.0, 1.0, 1.0, 3.0]]])
    paint_loss(logits, labels, worth, 2.0, 0.0).backward()
    assert float(logits.grad[..., 2].abs().max()) == 0
    pull = logits.grad[0, 0] / (logits[0, 0].sigmoid() - labels[0, 0]).detach()
    assert float(pull[1]) > 0
    assert float(pull[3] / pull[1]) == pytest.approx(3, rel=1e-4), "an element is not worth what it should be"


def test_a_batch_without_paint_or_lanes_has_a_finite_loss():
    kinds = torch.full((1, 2, 2), IGNORE, dtype=torch.uint8)
    assert float(kind_loss(torch.randn(1, KINDS, 2, 2), kinds, torch.ones(1, 2, 2))) == 0
    none = torch.zeros((1, 2, 2), dtype=torch.uint8)
    nothing = torch.zeros(1, 2, 2)
    targets = Targets(none, nothing, kinds, nothing, none, nothing)
    assert torch.isfinite(lane_loss(torch.randn(1, 2, 2, 2), targets, 3.0))


def answers_for_cells(painted, kinds):
    """The targets of one row of cells: whether labels paint each, and its class or IGNORE."""
    paint = torch.tensor(painted, dtype=torch.uint8).repeat_interleave(2)[None, None].repeat(1, 2, 1)
    labels = torch.tensor([[kinds]], dtype=torch.uint8)
    nothing = torch.zeros(1, 1, len(kinds))
    return Targets(paint, nothing, labels, torch.ones(1, 1, len(kinds)), nothing, nothing)


def test_what_was_said_of_classes_is_kept_where_no_label_says_otherwise():
    before = torch.zeros(1, KINDS, 1, 6)
    before[0, 0] = 2.0  # the first class everywhere
    of_cells = torch.tensor([5.0, 5.0, 5.0, 5.0, 5.0, -5.0])
    is_seen = of_cells.repeat_interleave(2)[None, None, None].repeat(1, 1, 2, 1)
    # Of the same class, bare, of another class, paint of an unknown one, unknown ground, not seen as paint.
    answers = answers_for_cells([1, 0, 1, 1, IGNORE, 0], [0, IGNORE, 1, IGNORE, IGNORE, IGNORE])
    assert float(kept_loss(before, before, is_seen, answers)) == 0
    moved = before.clone().requires_grad_()
    with torch.no_grad():
        moved[0, 1] += 3.0
    loss = kept_loss(moved, before, is_seen, answers)
    log_share = before[0, :, 0, 0].log_softmax(0)
    expected = (log_share.exp() * (log_share - moved[0, :, 0, 0].log_softmax(0))).sum()
    assert float(loss.detach()) == pytest.approx(float(expected.detach()), rel=1e-5)
    loss.backward()
    has_pull = (moved.grad[0].abs().sum(dim=0)[0] > 0).tolist()
    assert has_pull == [True, True, False, False, False, False]
    pull = moved.grad[0, 1, 0]
    assert float(pull[0] / pull[1]) == pytest.approx(10.0, rel=1e-4), "bare cells are worth a tenth"


def test_where_no_paint_is_seen_nothing_is_kept():
    logits = torch.randn(1, KINDS, 1, 2)
    nowhere = torch.full((1, 1, 2, 4), -5.0)
    assert float(kept_loss(logits, -logits, nowhere, answers_for_cells([0, 0], [IGNORE, IGNORE]))) == 0


def test_cells_of_no_weight_leave_the_loss_of_kinds_as_it_is():
    labels = torch.tensor([[[0, 1, 1, IGNORE]]], dtype=torch.uint8)
    logits = torch.randn(1, KINDS, 1, 4)
    without = torch.tensor([[[1.0, 1.0, 0.0, 0.0]]])
    half = kind_loss(logits, labels, without)
    wrong = logits.clone()
    wrong[..., 2] += 5 * torch.randn(KINDS)[None, :, None]
    assert torch.equal(half, kind_loss(wrong, labels, without))
    whole = kind_loss(logits, labels, torch.ones(1, 1, 4))
    first, second, third = (-logits[0, :, 0, k].log_softmax(0)[label] for k, label in enumerate((0, 1, 1)))
    rare, common = 3**0.5, 1.5**0.5
    expected = (rare * first + common * (second + third)) / (rare + 2 * common)
    assert float(whole) == pytest.approx(float(expected), rel=1e-5)


def test_the_score_counts_by_hand():
    prediction, targets = example()
    kinds = targets.kinds.clone()
    kinds[0, 0, 1] = 5
    tally = Tally()
    tally.add(prediction, targets._replace(kinds=kinds))
    score = tally.score()
    assert score.iou == {"arrow": 1 / 2, "crosswalk_bar": 0.0}
    assert score.mean_iou == 1 / 4
    assert (score.paint_iou, score.lane_recall, score.lane_precision) == (1.0, 1.0, 1.0)


def test_a_crossing_two_cells_off_is_neither_found_nor_right():
    has_line = torch.zeros((1, 1, 8), dtype=torch.uint8)
    has_line[..., 2] = 1
    for column, right in ((3, 1.0), (4, 0.0)):
        answer = torch.zeros((1, 1, 8), dtype=torch.uint8)
        answer[..., column] = 1
        paint = torch.zeros((1, 4, 32), dtype=torch.uint8)
        kinds = torch.full((1, 2, 16), IGNORE, dtype=torch.uint8)
        nothing = torch.zeros(kinds.shape)
        tally = Tally()
        tally.add(
            Prediction(
                sure(paint)[:, None], sure_kinds(kinds), torch.stack([sure(answer), sure(answer)], dim=1)
            ),
            Targets(paint, nothing, kinds, nothing, has_line, torch.zeros((1, 1, 8))),
        )
        assert (tally.score().lane_recall, tally.score().lane_precision) == (right, right)


SQUARE = [10, 10, 20, 10, 20, 20, 10, 20]
ZEBRA = {"id": 3, "image_id": 9, "category_id": 2, "segmentation": [SQUARE]}
CONF = str(Path(__file__).resolve().parents[2] / "conf")


def config(**changes):
    small = {"width": 64, "height": 32, "render_width": 80, "render_height": 48, "workers": 0}
    return DataConfig(**(small | changes))


def tusimple(folder, name="a.png", **changes):
    """A file of one image with a lane that leans: column 40 at row 10, column 70 at row 60."""
    rows = list(range(10, 61, 10))
    entry = {"raw_file": name, "h_samples": rows, "lanes": [[40, 46, 52, 58, 64, 70], [-2] * 6]} | changes
    (folder / "lanes.json").write_text(json.dumps(entry) + "\n")
    return folder / "lanes.json"


def labelled(**files):
    labels_read = read_labels(config(**files))
    assert labels_read is not None
    return labels_read


def test_a_rectangle_between_pixels_covers_its_exact_area():
    ring = np.array([[1.25, 1.5], [4.25, 1.5], [4.25, 3.5], [1.25, 3.5]])
    covered = coverage(ring, 0, 0, 7, 6)
    rows, columns = np.array([0, 0, 1, 1, 0, 0]), np.array([0, 0.25, 1, 1, 0.75, 0, 0])
    np.testing.assert_allclose(covered, np.outer(rows, columns), atol=1e-6)


@given(st.integers(0, 10**6), st.integers(3, 9))
def test_the_area_of_any_star_shaped_polygon_is_kept_wherever_it_lies(seed, count):
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, count))
    ring = rng.uniform(20, 30, 2) + rng.uniform(2, 15, (count, 1)) * np.column_stack(
        [np.cos(angle), np.sin(angle)]
    )
    u, v = ring.T
    area = abs(np.dot(u, np.roll(v, -1)) - np.dot(v, np.roll(u, -1))) / 2
    if np.diff(angle, append=angle[0] + 2 * np.pi).max() > np.pi:
        return  # then the middle is outside, and edges may cross
    assert coverage(ring, 0, 0, 60, 60).sum() == pytest.approx(
        area, abs=0.02 * np.hypot(*np.ptp(ring, axis=0))
    )
    part = coverage(ring, 17, 23, 20, 11)
    np.testing.assert_allclose(part, coverage(ring, 0, 0, 60, 60)[23:34, 17:37], atol=1e-5)


def painted(shapes, width, height):
    """Labels (height, width) of an image of which all is known."""
    labels, unknown = paint_labels(
        LabelledImage("", Path(), shapes=tuple(shapes)), Place.whole(width, height)
    )
    assert not unknown.any()
    return labels


def test_labels_have_no_bias_in_either_direction():
    """Edges at every offset: the labelled band is, on average, as wide as the polygon."""
    offsets = (np.arange(20) + 0.5) / 20
    for transposed in (False, True):
        errors = []
        for left, right in np.stack(np.meshgrid(4 + offsets, 9 + offsets), axis=-1).reshape(-1, 2):
            ring = np.array([[left, -5], [right, -5], [right, 30], [left, 30]])
            shape = Shape((DIAMOND,), (ring[:, ::-1] if transposed else ring,))
            labels = painted([shape], 16, 16)
            errors.append((labels > 0).sum() / 16 - (right - left))
        assert abs(np.mean(errors)) < 0.01


def test_a_concave_polygon_and_one_with_two_parts_are_filled_as_drawn():
    notch = np.array([[1.0, 1], [9, 1], [9, 9], [5, 3], [1, 9]])
    covered = coverage(notch, 0, 0, 11, 11)
    assert covered[8, 5] == 0.0
    assert covered[2, 5] > 0.9
    parts = (np.array([[0, 0], [3, 0], [3, 3], [0, 3.0]]), np.array([[6, 6], [9, 6], [9, 9], [6, 9.0]]))
    labels = painted([Shape((ARROW,), parts)], 11, 11)
    assert labels[1, 1] == labels[7, 7] == 1 + PAINT_CLASSES.index(ARROW)
    assert labels[4, 4] == 0


def test_views_of_coco_images_show_their_markings_where_they_are_bright(tmp_path):
    labels = labelled(coco=str(coco(tmp_path)))
    rng, painted = np.random.default_rng(1), 0
    for _ in range(40):
        image, answers = labels.view(rng)
        grey = image.numpy()[..., 1].reshape(16, 2, 32, 2).mean(axis=(1, 3))
        paint = answers.paint.numpy()
        painted += (paint == 1).any()
        if (paint == 1).any() and (paint == 0).any():
            assert grey[paint == 1].min() > grey[paint == 0].max() - 30
        assert set(np.unique(answers.kinds)) <= {PAINT_CLASSES.index(ARROW), IGNORE}
        assert (answers.lane_there == IGNORE).all()
    assert painted > 10


def test_coco_counts_from_the_corner_of_the_first_pixel(tmp_path):
    (image, _) = labelled(coco=str(coco(tmp_path))).images
    labels = painted(image.shapes or (), WIDTH, HEIGHT)
    rows, columns = np.nonzero(labels)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (20, 39, 30, 49)


def test_views_of_tusimple_images_answer_for_lanes_only(tmp_path):
    coco(tmp_path)
    labels = labelled(tusimple=str(tusimple(tmp_path)))
    rng = np.random.default_rng(2)
    crossed = 0
    for _ in range(20):
        _, answers = labels.view(rng)
        assert (answers.paint == IGNORE).all()
        assert (answers.kinds == IGNORE).all()
        crossed += int((answers.lane_there == 1).sum())
    assert crossed > 20


def test_an_image_in_both_files_has_both_labels(tmp_path):
    labels = labelled(coco=str(coco(tmp_path)), tusimple=str(tusimple(tmp_path)))
    assert len(labels.images) == 2
    image = next(image for image in labels.images if image.path.name == "a.png")
    assert image.shapes
    (lane,) = image.lanes_px or ()
    np.testing.assert_array_equal(lane[0], [70, 60])


def test_a_category_is_mapped_by_the_configuration_or_left_out(tmp_path):
    path = coco(tmp_path, annotations=[ZEBRA])
    mapped = labelled(coco=str(path), coco_classes={"zebra": CROSSWALK_BAR})
    assert [shape.kinds for image in mapped.images for shape in image.shapes or ()] == [(CROSSWALK_BAR,)]
    dropped = labelled(coco=str(path), coco_classes={"zebra": "none"})
    assert [image.shapes for image in dropped.images] == [(), ()]


def test_the_advice_about_an_unknown_category_is_an_argument_that_works(tmp_path):
    path = coco(tmp_path, annotations=[ZEBRA])
    with pytest.raises(LabelError) as refusal:
        read_labels(config(coco=str(path)))
    (argument,) = re.findall("'([+].*?)'", str(refusal.value))
    register("train", TrainConfig)
    with initialize_config_dir(CONF, version_base="1.3"):
        composed = compose("train", overrides=[argument.replace("CLASS", CROSSWALK_BAR)])
    assert composed.data.coco_classes == {"zebra": CROSSWALK_BAR}


@pytest.mark.parametrize(("share", "low", "high"), [(0.3, 20, 45), (1.0, 100, 100)])
def test_the_share_of_labelled_views_is_what_was_asked_for(tmp_path, share, low, high):
    data = config(coco=str(coco(tmp_path)), labelled_share=share, views_per_render=40)
    labels = read_labels(data)
    pairs = islice(RenderStream(data, 3, labels=labels), 100)
    from_labels = sum(bool((answers.lane_there == IGNORE).all()) for _, answers in pairs)
    assert low <= from_labels <= high


def test_squeezed_images_are_stretched_together_with_their_labels(tmp_path):
    labels = labelled(coco=str(coco(tmp_path)), coco_size=[2 * WIDTH, HEIGHT])
    image = labels.images[0]
    assert image.pixels().shape == (HEIGHT, 2 * WIDTH, 3)
    rows, columns = np.nonzero(painted(image.shapes or (), 2 * WIDTH, HEIGHT))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (20, 39, 60, 99)
    rng, grey = np.random.default_rng(4), []
    for _ in range(40):
        view, answers = labels.view(rng)
        paint = np.kron(answers.paint.numpy(), np.ones((2, 2)))
        grey.append((view.numpy()[paint == 1].mean() if (paint == 1).any() else 200.0) > 150)
    assert np.mean(grey) > 0.9


def test_near_an_outline_and_in_unknown_ground_nothing_is_known():
    square, other = (np.array([[a, 20.0], [a + 20, 20], [a + 20, 40], [a, 40]]) for a in (10, 60))
    shapes = (Shape((ARROW,), (square,)), Shape(("unknown",), (other,)))
    labels, unknown = paint_labels(
        LabelledImage("", Path(), shapes=shapes, edge_px=3.0), Place.whole(WIDTH, HEIGHT)
    )
    assert unknown[30, 11]
    assert unknown[30, 8]
    assert not unknown[30, 20]
    assert not unknown[30, 2]
    assert unknown[30, 70]
    assert not labels[:, 50:].any()
    answers = targets(TrainingSample(np.zeros((64, 96, 3), np.uint8), labels, unknown, (), unknown))
    assert answers.paint[15, 10] == 1
    assert answers.paint[15, 35] == IGNORE == answers.paint[15, 5]


def test_an_outline_with_paint_somewhere_in_it_is_paint_where_the_network_sees_some(tmp_path):
    image = np.full((128, 256, 3), 90, np.uint8)
    image[60:100, 40:70] = image[60:100, 110:140] = 235
    cv2.imwrite(str(tmp_path / "a.png"), image)
    ring = np.array([[30.0, 50], [150, 50], [150, 110], [30, 110]])
    shapes = (Shape((CROSSWALK_BAR, "none"), (ring,)),)
    plain = LabelledImage("", tmp_path / "a.png", shapes=shapes)
    (hinted,) = with_hints([plain], config(coco_complete=[DIAMOND]), lambda share: None)
    labels, unknown = paint_labels(hinted, Place.whole(256, 128))
    assert unknown[50:109, 31:149].all()
    bar = 1 + PAINT_CLASSES.index(CROSSWALK_BAR)
    assert set(np.unique(labels)) == {0, bar}
    assert (labels[70:90, 48:64] == bar).mean() > 0.9
    assert (labels[70:90, 80:100] == 0).mean() > 0.9
    hidden = replace(plain, shapes=())
    (silent,) = with_hints([hidden], config(coco_complete=[DIAMOND]), lambda share: None)
    _, unknown = paint_labels(silent, Place.whole(256, 128))
    (complete,) = with_hints([hidden], config(coco_complete=list(PAINT_CLASSES)), lambda share: None)
    assert unknown[70:90, 48:64].mean() > 0.9
    assert not paint_labels(complete, Place.whole(256, 128))[1].any()


def test_a_line_is_of_the_class_that_its_size_on_the_ground_tells(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((360, 640, 3), 90, np.uint8))
    camera = [1.5, 10.0, 80.0]
    road = RoadCamera(camera_from_calibration(rough_calibration("", 640, 360, *camera)))
    either = ("lane_dash", "lane_line", DIAMOND)
    for kind, far, left in (("lane_line", 40.0, 1.15), (DIAMOND, 5.5, 2.5)):
        ground = np.array([[4.0, 1.0], [far, 1.0], [far, left], [4.0, left]])
        ring = road.distort(apply_homography(road.pinhole_px_from_vehicle, ground))
        image = LabelledImage("", tmp_path / "a.png", shapes=(Shape(either, (ring,)),))
        (hinted,) = with_hints([image], config(coco_camera=camera), lambda share: None)
        assert [shape.kinds for shape in hinted.shapes or ()] == [(kind,)]
    unclear = replace(image, shapes=(Shape((ARROW, DIAMOND), (np.array([[0.0, 0], [9, 0], [9, 9]]),)),))
    (hinted,) = with_hints([unclear], config(), lambda share: None)
    assert [shape.kinds for shape in hinted.shapes or ()] in ([(ANY,)], [(ARROW,)], [(DIAMOND,)])
    labels = painted([Shape((ANY,), (np.array([[0.0, 0], [9, 0], [9, 9], [0, 9]]),))], 16, 16)
    assert labels[5, 5] == PAINT_ONLY
    assert paint_target(labels)[2, 2] == 1
    assert kind_target(labels)[1, 1] == IGNORE


def test_photographs_of_one_place_have_one_role_and_neighbours_share_it():
    stems = [f"{number:03d}{letter}" for number in range(1, 601) for letter in ("", "a", "b")]
    roles = dict(zip(stems, held_out(stems), strict=True))
    assert all(roles[stem[:3]] == role for stem, role in roles.items())
    counts = Counter(roles.values())
    assert counts[VALIDATION] == 180
    assert counts[JUDGING] == 360
    assert counts[LEARNT] == 1260
    changes = sum(a != b for a, b in pairwise(roles[f"{number:03d}"] for number in range(1, 601)))
    assert changes < 600 / 10


ANNOTATION = {"id": 5, "image_id": 7, "category_id": 1, "segmentation": [[0, 0, 9, 0, 9, 9]]}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"annotations": [ANNOTATION | {"category_id": 2}]}, "annotation 5: category 'zebra' is no class"),
        ({"annotations": [ANNOTATION | {"category_id": 8}]}, "annotation 5: its category 8 is not in the"),
        ({"annotations": [ANNOTATION | {"image_id": 8}]}, "annotation 5: its image 8 is not in the file"),
        ({"annotations": [ANNOTATION | {"segmentation": {"counts": "x"}}]}, "no list of polygons"),
        ({"annotations": [ANNOTATION | {"segmentation": [[0, 0, 1]]}]}, "not x, y, x, y"),
        ({"annotations": [ANNOTATION | {"segmentation": [[0, 0, 1, 1]]}]}, "under three points"),
        ({"annotations": [{"id": 5}]}, r"annotations\[0\] has no 'image_id'"),
        ({"images": "none"}, "has no list 'images'"),
        ({"images": [], "annotations": []}, "has no images"),
        ({"images": [{"id": 7, "file_name": "gone.png"}]}, "image 7: .*gone.png: image listed but missing"),
        (
            {"images": [{"id": 7, "file_name": "a.png", "width": 5, "height": 5}]},
            "is 96x64 but its labels are",
        ),
    ],
)
def test_a_mistake_in_a_coco_file_is_named(tmp_path, changes, words):
    with pytest.raises(LabelError, match=words):
        read_labels(config(coco=str(coco(tmp_path, **changes))))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lanes": [[1, 2]]}, "line 1: lane 0 has 2 columns for 6 h_samples"),
        ({"lanes": [["a"] * 6]}, "lane 0: is no list of numbers"),
        ({"lanes": 3}, "lanes is no list"),
        ({"raw_file": "gone.png"}, "gone.png: image listed but missing"),
    ],
)
def test_a_mistake_in_a_tusimple_file_is_named(tmp_path, changes, words):
    coco(tmp_path)
    with pytest.raises(LabelError, match=words):
        read_labels(config(tusimple=str(tusimple(tmp_path, **changes))))


def test_damaged_and_missing_files_and_settings_that_cannot_be_are_named(tmp_path):
    path, bad = str(coco(tmp_path)), tmp_path / "bad.json"
    bad.write_text('{"raw_file": "a.png"}\n{"lanes": \n')
    for files, words in (
        ({"coco": str(tmp_path / "none.json")}, "none.json: no such file"),
        ({"tusimple": str(bad)}, "line 1: has no 'lanes'"),
        ({"coco": path, "coco_classes": {"stripe": ARROW}}, "has no category 'stripe', only Arrow, zebra"),
        ({"coco": path, "coco_classes": {"zebra": "stripes"}}, "to be 'stripes'; choose from: diamond"),
        ({"coco": path, "coco_complete": ["stripes"]}, "coco_complete: .*'stripes'"),
        ({"coco": path, "width": 128}, "smaller than a view of 128x32"),
    ):
        with pytest.raises(LabelError, match=words):
            read_labels(config(**files))
    with pytest.raises(ConfigError, match=r"labelled_share is 0"):
        read_labels(config(coco=path, labelled_share=0))


def test_the_paint_of_a_rare_class_weighs_more_in_and_around_it():
    kinds = torch.full((1, 8, 32), IGNORE, dtype=torch.uint8)
    kinds[0, :, :9] = 1
    kinds[0, 4, 20] = 4
    worth = rare_paint(kinds, torch.ones((1, 8, 32)))
    assert (worth[0, :, :9] == 1).all()
    assert worth[0, 4, 20] == worth[0, 2, 22] == 4  # 72 times rarer: at most
    assert worth[0, 4, 27] == 1
    assert (rare_paint(torch.full_like(kinds, IGNORE), torch.ones((1, 8, 32))) == 1).all()
