"""Classes that a finished network learns alone."""

import shutil
import sys
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from models import MarkingNet
from tests.detection.pictures import make_camera
from tests.train.small import HEIGHT, WIDTH, coco, tiny
from train.areas.__main__ import main
from train.areas.cells import BARE, OPEN, OTHER, CellReader, Cells, View
from train.areas.config import AreasConfig
from train.areas.fit import fit_rows, worth_of
from train.areas.learn import learn_areas
from train.areas.views import Change, changes, marks_of_shapes, marks_of_targets, views_of_photograph
from train.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from train.labels import Place, labelled_images
from train.labels_image import Shape
from train.scenes.scenes import TrainingSample
from train.shipment import Order, ship
from train.targets import IGNORE, targets
from v2hdm.catalogue import NOT_PAINT, SHIPPED
from v2hdm.detection import weights
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.network import Network, run_on_road
from v2hdm.errors import ConfigError
from v2hdm.records import BOX, TEXT

AREAS = (TEXT, BOX)
KNOWN = SHIPPED.names[: SHIPPED.names.index(TEXT)]
WORD, BOXED, ARROW = (
    (slice(8, 24), slice(8, 40)),
    (slice(8, 24), slice(56, 88)),
    (slice(40, 56), slice(8, 40)),
)


def square(left, top, right, bottom):
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]], dtype=np.float64)


@pytest.fixture
def start(tmp_path):
    """A checkpoint of random weights that knows neither words nor boxes."""
    config = tiny(tmp_path)
    config = replace(config, net=replace(config.net, wide_kinds=True))
    torch.manual_seed(4)
    net = MarkingNet(config.net, len(KNOWN))
    save_checkpoint(Checkpoint(config=asdict(config), averaged=net.state_dict()), tmp_path / "start.pt")
    return tmp_path / "start.pt"


@pytest.fixture
def config(tmp_path, start):
    """A fit to two photographs, one of which shows a white word, a grey box and a light arrow."""
    rings = {1: square(8, 8, 40, 24), 2: square(56, 8, 88, 24), 3: square(8, 40, 40, 56)}
    annotations = [
        {"id": number, "image_id": 7, "category_id": number, "segmentation": [ring.ravel().tolist()]}
        for number, ring in rings.items()
    ]
    categories = [{"id": 1, "name": TEXT}, {"id": 2, "name": BOX}, {"id": 3, "name": "arrow"}]
    labels = coco(tmp_path, annotations=annotations, categories=categories)
    image = np.full((HEIGHT, WIDTH, 3), 40, dtype=np.uint8)
    for place, grey in ((WORD, 250), (BOXED, 120), (ARROW, 190)):
        image[place] = grey
    cv2.imwrite(str(tmp_path / "a.png"), image)
    data = replace(tiny(tmp_path).data, coco=str(labels))
    return AreasConfig(
        output=str(tmp_path / "fit"),
        start=str(start),
        log_odds={},
        ridge=1e-5,
        sky=0.0,
        render_views=2,
        scored_images=1,
        data=data,
    )


def quiet(share, doing):
    pass


def test_the_rows_tell_words_from_boxes_and_both_from_other_paint(config):
    state = load_checkpoint(learn_areas(config, quiet))
    assert state.classes == (*KNOWN, *AREAS)
    (image,) = (image for image in labelled_images(config.data) if image.shapes)
    with torch.inference_mode():
        logits = state.network()(torch.from_numpy(image.pixels())[None]).kinds[0]
    text, box = logits[-2:].numpy()
    others = logits[:-2].amax(dim=0).numpy()
    word, boxed, arrow = (
        (slice(3, 5), slice(4, 8)),
        (slice(3, 5), slice(16, 20)),
        (slice(11, 13), slice(4, 8)),
    )
    assert (text[word] > box[word]).all()
    assert (box[boxed] > text[boxed]).all()
    assert (text[word] > others[word]).mean() >= 0.5
    assert (box[boxed] > others[boxed]).mean() >= 0.5
    assert (np.maximum(text, box)[arrow] < others[arrow]).all()


def test_all_else_that_the_network_says_stays(config, start):
    after = load_checkpoint(learn_areas(config, quiet)).network()
    before = load_checkpoint(start).network()
    image = torch.randint(0, 256, (1, 64, 96, 3), dtype=torch.uint8)
    with torch.inference_mode():
        said, said_before = after(image), before(image)
    assert torch.equal(said.paint, said_before.paint)
    assert torch.equal(said.lanes, said_before.lanes)
    torch.testing.assert_close(said.kinds[:, : len(KNOWN)], said_before.kinds)


@pytest.mark.slow
def test_rows_fitted_to_the_shipped_network_are_shipped_with_all_else_as_it_was(
    config, tmp_path, monkeypatch
):
    into = tmp_path / "into"
    shutil.copytree(weights.FOLDER, into, ignore=shutil.ignore_patterns("__pycache__", "*.py"))
    network_file = Path("models/marking_net.onnx").resolve()
    shutil.copy(network_file, into)
    fit = learn_areas(replace(config, start=str(network_file), render_views=0), quiet)
    monkeypatch.chdir(tmp_path)
    ship(Order(source=fit.parent, into=into, keep=("network", "judge", "lane_score")), quiet)
    weights.check_weights(into)
    before, after = (Network(folder / weights.NETWORK_FILE.name) for folder in (weights.FOLDER, into))
    assert after.info.classes == before.info.classes
    camera = make_camera("pinhole")
    image = np.full((camera.info.height, camera.info.width, 3), 90, dtype=np.uint8)
    image[250:300, 200:400] = 250
    outputs = [run_on_road(network, image, RoadCamera(camera, 16)) for network in (before, after)]
    np.testing.assert_array_equal(outputs[0].paint, outputs[1].paint)
    np.testing.assert_array_equal(outputs[0].kinds, outputs[1].kinds)
    assert (outputs[0].areas != outputs[1].areas).any()


def test_a_network_that_knows_the_classes_gets_the_same_rows_anew(config):
    first = learn_areas(config, quiet)
    second = learn_areas(replace(config, start=str(first), output=config.output + "2"), quiet)
    rows = [load_checkpoint(path).averaged["kinds.weight"][-2:] for path in (first, second)]
    # The second fit sees other renders.
    assert torch.nn.functional.cosine_similarity(*(row.flatten() for row in rows), dim=0) > 0.8


def test_log_odds_are_changed_as_configured(config):
    plain = load_checkpoint(learn_areas(config, quiet)).averaged
    changed = load_checkpoint(learn_areas(replace(config, log_odds={BOX: -2.0}), quiet)).averaged
    difference = changed["kinds.bias"] - plain["kinds.bias"]
    torch.testing.assert_close(difference[-2:], torch.tensor([0.0, -2.0]))


@pytest.mark.parametrize(
    ("setting", "reason"),
    [
        ({"classes": [BOX]}, "come after text"),
        ({"classes": ["tram"]}, "no class 'tram'"),
        ({"log_odds": {"tram": 1.0}}, "no class 'tram'"),
        ({"classes": [TEXT, BOX, "bicycle"], "render_views": 0}, "no paint of bicycle was seen"),
        ({"classes": []}, "name one class or more"),
        ({"classes": [TEXT, TEXT]}, "each once"),
        ({"sky": 1.5}, "sky is 1.5"),
        ({"start": "none.pt"}, "no checkpoint at none.pt"),
    ],
)
def test_what_cannot_be_fitted_is_refused(config, setting, reason):
    config = replace(config, **setting)
    with pytest.raises(ConfigError, match=reason):
        learn_areas(config, quiet)


def test_a_fit_without_photographs_ends_in_one_line(monkeypatch, capsys, start, tmp_path):
    monkeypatch.setattr(sys, "argv", ["areas", f"start={start}", f"output={tmp_path / 'fit'}"])
    assert main() == 2
    error = capsys.readouterr().err
    assert error.splitlines()[-1].startswith("error: no photographs to learn from: set data.coco=")


def test_fitted_classes_lie_over_others_and_their_borders_are_open():
    shapes = [
        Shape((TEXT, NOT_PAINT), (square(15.5, 15.5, 39.5, 39.5),)),
        Shape(("lane_dash", "lane_line"), (square(-0.5, 31.5, 63.5, 39.5),)),
        Shape(("unknown",), (square(47.5, -0.5, 63.5, 7.5),)),
    ]
    place = Place(np.zeros(2, dtype=np.intp), np.full(2, 0.25), 16, 16)
    marks = marks_of_shapes(shapes, place, AREAS)
    assert (marks[4:10, 4:10] == AREAS.index(TEXT)).all()
    assert (marks[2:4, 4:10] == OPEN).all()
    assert (marks[8:10, 12:] == OTHER).all()
    assert (marks[0:2, 12:] == OPEN).all()
    assert (marks[12:] == BARE).all()


def test_a_render_is_open_where_paint_has_no_class():
    labels = np.zeros((16, 16), dtype=np.uint8)
    labels[:4, :4] = 1 + SHIPPED.names.index(TEXT)
    labels[:4, 8:12] = 1
    labels[8:10, 8:10] = 1  # a quarter of a cell: too little to show its class
    sample = TrainingSample(np.zeros((16, 16, 3), np.uint8), labels, np.zeros((16, 16), bool), (), None)
    answers = targets(sample)
    assert answers.kinds[2, 2] == IGNORE
    marks = marks_of_targets(answers, [SHIPPED.names.index(name) for name in AREAS])
    assert [marks[0, 0], marks[0, 2], marks[2, 2], marks[3, 3]] == [0, OTHER, OPEN, BARE]


def test_a_mirrored_view_is_the_mirror_of_a_plain_one(config, monkeypatch):
    (image,) = (image for image in labelled_images(config.data) if image.shapes)
    views = [Change(1.0, is_mirrored=mirrored, is_relit=False) for mirrored in (False, True)]
    monkeypatch.setattr("train.areas.views.changes", lambda *_: iter(views))
    plain, mirrored = views_of_photograph(image, AREAS, 0.25, np.random.default_rng(0))
    assert plain.image.shape == (48, WIDTH, 3), "a quarter of the height is sky"
    np.testing.assert_array_equal(plain.image[:, ::-1], mirrored.image)
    np.testing.assert_array_equal(plain.marks[:, ::-1], mirrored.marks)
    assert len(list(changes(np.random.default_rng(0), shows_class=True))) == 4


def test_what_is_read_of_a_cell_gives_its_logits(start):
    """Rows of the network itself, applied to the features, are what it says."""
    net = load_checkpoint(start).network()
    reader = CellReader(net, [0], np.random.default_rng(0))
    image = np.random.default_rng(1).integers(0, 256, (32, 48, 3), dtype=np.uint8)
    marks = np.zeros((8, 12), dtype=np.int8)
    cells = reader.read(View(image, marks), is_render=False)
    with torch.inference_mode():
        paint, kinds, _ = net(torch.from_numpy(image)[None])
    is_seen = torch.nn.functional.max_pool2d(paint, 2)[0, 0] > -1
    rows = torch.cat([net.kinds.weight, net.wide_kinds[1].weight], dim=1)[:, :, 0, 0]
    logits = cells.features.float() @ rows.T + net.kinds.bias + net.wide_kinds[1].bias
    torch.testing.assert_close(logits, kinds[0][:, is_seen].T, atol=0.01, rtol=0.01)
    torch.testing.assert_close(cells.others, kinds[0][1:, is_seen].logsumexp(dim=0))


def cells_of(marks, features):
    count = len(marks)
    is_render = torch.arange(count) % 2 == 0
    return Cells(features.half(), torch.zeros(count), torch.tensor(marks, dtype=torch.int8), is_render)


def test_cells_of_a_mark_weigh_the_same_together_however_many_they_are():
    marks = [0] * 40 + [1] * 4 + [OTHER] * 10 + [BARE] * 6
    cells = cells_of(marks, torch.zeros((60, 1)))
    worth = worth_of(cells, 2, 0.3)
    sums = [float(worth[cells.marks == mark].sum()) for mark in (0, 1, OTHER, BARE)]
    assert sums[0] == pytest.approx(sums[1])
    assert float(worth[cells.is_render].sum() / worth.sum()) == pytest.approx(0.3)


def test_fitted_rows_are_where_the_loss_is_least():
    generator = torch.Generator().manual_seed(0)
    marks = torch.randint(-2, 2, (400,), generator=generator).tolist()
    features = torch.randn((400, 3), generator=generator)
    features[:, 0] += torch.tensor(marks)
    cells = cells_of(marks, features)
    rows = fit_rows(cells, 2, 0.5, 0.01, 200, lambda share: None)
    worth = worth_of(cells, 2, 0.5)
    answer = torch.where(cells.marks >= 0, cells.marks, 2).long()

    def loss(rows):
        logits = torch.column_stack(
            [cells.features.float() @ rows[:, :-1].T + rows[:, -1], torch.zeros(len(answer))]
        )
        losses = torch.nn.functional.cross_entropy(logits, answer, reduction="none")
        return float((worth * losses).sum() + 0.01 * rows[:, :-1].square().sum())

    for _ in range(20):
        other = rows + 0.1 * torch.randn(rows.shape, generator=generator)
        assert loss(rows) < loss(other)
