"""Users' own labels: exact areas, both formats, mixed into the renders, and every mistake by name."""

import json
import re
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from hypothesis import given
from hypothesis import strategies as st

from tests.train.small import HEIGHT, WIDTH, coco
from train.config import DataConfig, TrainConfig
from train.data import RenderStream
from train.labels import LabelledImages, paint_labels, read_labels
from train.labels_image import Shape
from train.labels_raster import coverage
from train.targets import IGNORE
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.cli.compose import register
from v2hdm.errors import ConfigError, LabelError
from v2hdm.records import ARROW, CROSSWALK_BAR, DIAMOND

SQUARE = [10, 10, 20, 10, 20, 20, 10, 20]
ZEBRA = {"id": 3, "image_id": 9, "category_id": 2, "segmentation": [SQUARE]}
CONF = str(Path(__file__).resolve().parents[2] / "conf")


def config(**changes: object) -> DataConfig:
    small = {"width": 64, "height": 32, "render_width": 80, "render_height": 48, "workers": 0}
    return DataConfig(**(small | changes))


def tusimple(folder: Path, name: str = "a.png", **changes: object) -> Path:
    """A file of one image with a lane that leans: column 40 at row 10, column 70 at row 60."""
    rows = list(range(10, 61, 10))
    entry = {"raw_file": name, "h_samples": rows, "lanes": [[40, 46, 52, 58, 64, 70], [-2] * 6]} | changes
    (folder / "lanes.json").write_text(json.dumps(entry) + "\n")
    return folder / "lanes.json"


def labelled(**files: object) -> LabelledImages:
    found = read_labels(config(**files))
    assert found is not None
    return found


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


def test_labels_have_no_bias_in_either_direction():
    """Edges at every offset: the labelled band is, on average, as wide as the polygon."""
    offsets = (np.arange(20) + 0.5) / 20
    for transposed in (False, True):
        errors = []
        for left, right in np.stack(np.meshgrid(4 + offsets, 9 + offsets), axis=-1).reshape(-1, 2):
            ring = np.array([[left, -5], [right, -5], [right, 30], [left, 30]])
            shape = Shape(DIAMOND, (ring[:, ::-1] if transposed else ring,))
            labels = paint_labels([shape], 0, 0, 16, 16)
            errors.append((labels > 0).sum() / 16 - (right - left))
        assert abs(np.mean(errors)) < 0.01


def test_a_concave_polygon_and_one_with_two_parts_are_filled_as_drawn():
    notch = np.array([[1.0, 1], [9, 1], [9, 9], [5, 3], [1, 9]])
    covered = coverage(notch, 0, 0, 11, 11)
    assert covered[8, 5] == 0.0
    assert covered[2, 5] > 0.9
    parts = (np.array([[0, 0], [3, 0], [3, 3], [0, 3.0]]), np.array([[6, 6], [9, 6], [9, 9], [6, 9.0]]))
    labels = paint_labels([Shape(ARROW, parts)], 0, 0, 11, 11)
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
    labels = paint_labels(image.shapes or (), 0, 0, WIDTH, HEIGHT)
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
    both = next(image for image in labels.images if image.path.name == "a.png")
    assert both.shapes
    (lane,) = both.lanes_px or ()
    np.testing.assert_array_equal(lane[0], [70, 60])


def test_a_category_is_mapped_by_the_configuration_or_left_out(tmp_path):
    path = coco(tmp_path, annotations=[ZEBRA])
    mapped = labelled(coco=str(path), coco_classes={"zebra": CROSSWALK_BAR})
    assert [shape.kind for image in mapped.images for shape in image.shapes or ()] == [CROSSWALK_BAR]
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


def test_without_labels_there_is_nothing_to_mix_in():
    assert read_labels(config()) is None
    assert TrainConfig().data.coco is None


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
            "a.png is 96x64 but its labels are for 5x5",
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
        ({"coco": path, "width": 128}, "smaller than a view of 128x32"),
    ):
        with pytest.raises(LabelError, match=words):
            read_labels(config(**files))
    with pytest.raises(ConfigError, match=r"labelled_share is 0"):
        read_labels(config(coco=path, labelled_share=0))
