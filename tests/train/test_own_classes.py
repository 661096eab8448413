"""Users' own classes from labels over weights to the exported file, whose detector finds and maps them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from export.onnx_file import export_checkpoint
from export.source import read_source
from models import MarkingNet, Prediction
from tests.train.small import coco, tiny
from train.average import mean_checkpoint
from train.checkpoint import Checkpoint, fresh_checkpoint, load_checkpoint, save_checkpoint
from train.config import DataConfig, TrainConfig
from train.growth import with_classes
from train.labels import paint_labels, read_labels
from train.labels_image import Shape
from train.loop import Trainer
from train.metrics import Tally
from train.targets import IGNORE, Targets, kind_target
from v2hdm.catalogue import PAINT_CLASSES, SHIPPED, Catalogue, load_catalogue
from v2hdm.detection.network import Network
from v2hdm.errors import ConfigError, DetectorError, LabelError

T, PAD = "parking_t", "pad"
SIZES = {"length_m": [0.8, 1.4], "width_m": [0.4, 1.2]}
ENTRIES = {T: {"family": "symbol", **SIZES}, PAD: {"family": "quadrilateral", **SIZES}}
CLASSES = (*PAINT_CLASSES, T, PAD)


@pytest.fixture
def catalogue() -> Catalogue:
    return SHIPPED.with_own(ENTRIES, "test")


@pytest.fixture
def image() -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return torch.randint(0, 256, (1, 64, 96, 3), dtype=torch.uint8, generator=generator)


@pytest.fixture
def shipped_run(tmp_path: Path) -> Path:
    """A checkpoint that knows the shipped classes."""
    torch.manual_seed(0)
    config = replace(tiny(tmp_path), net=replace(tiny(tmp_path).net, wide_kinds=True))
    state = fresh_checkpoint(config)
    state.averaged = MarkingNet(config.net).state_dict()
    save_checkpoint(state, tmp_path / "shipped.pt")
    return tmp_path / "shipped.pt"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An exported file of an untaught network that knows two own classes."""
    folder = tmp_path_factory.mktemp("exported")
    config = run_of(folder)
    state = fresh_checkpoint(config)
    state.averaged = MarkingNet(config.net, len(CLASSES)).state_dict()
    export_checkpoint(state, folder / "own.onnx", opset=18, tolerance=1e-3)
    return folder / "own.onnx"


def written(folder: Path, entries: dict[str, dict[str, object]] = ENTRIES) -> Path:
    path = folder / "classes.yaml"
    path.write_text(json.dumps({"classes": entries}))
    return path


def run_of(folder: Path, start: Path | None = None, **changes: object) -> TrainConfig:
    config = replace(tiny(folder / "run"), catalogue=str(written(folder)), **changes)
    return replace(config, start=start and str(start), net=replace(config.net, wide_kinds=True))


def labels_of(folder: Path, kind: str) -> DataConfig:
    small = DataConfig(width=64, height=32, render_width=80, render_height=48, workers=0, labelled_share=1.0)
    content = [{"id": 1, "name": kind}, {"id": 2, "name": "zebra"}]
    return replace(small, coco=str(coco(folder, categories=content)))


def test_targets_tell_own_classes_from_the_shipped_ones() -> None:
    labels = np.zeros((16, 16), dtype=np.uint8)
    labels[:8], labels[8:, 8:] = 1 + CLASSES.index(PAD), 1
    kinds = kind_target(labels)
    assert (kinds[:2] == CLASSES.index(PAD)).all()
    assert (kinds[2:, 2:] == 0).all()
    assert (kinds[2:, :2] == IGNORE).all()


def test_a_label_is_called_like_an_own_class(tmp_path: Path) -> None:
    data = labels_of(tmp_path, "Parking-T")
    images = read_labels(data, CLASSES)
    assert images is not None
    rng = np.random.default_rng(0)
    seen = torch.cat([images.view(rng)[1].kinds.flatten() for _ in range(30)])
    assert set(seen.tolist()) == {CLASSES.index(T), IGNORE}
    with pytest.raises(LabelError, match="'Parking-T' is no class of the detector"):
        read_labels(data)
    (shape,) = images.images[0].shapes or ()
    assert shape.kind == T


def test_own_paint_is_labelled_by_its_place_in_the_catalogue() -> None:
    square = np.array([[2.0, 2.0], [9.0, 2.0], [9.0, 9.0], [2.0, 9.0]])
    labels = paint_labels([Shape(PAD, (square,))], 0, 0, 16, 12, CLASSES)
    assert set(np.unique(labels)) == {0, 1 + CLASSES.index(PAD)}


def test_own_classes_are_scored() -> None:
    tally, kind = Tally(CLASSES), CLASSES.index(PAD)
    kinds = torch.full((1, len(CLASSES), 2, 2), -5.0)
    kinds[:, kind] = 5.0
    nothing = torch.zeros((1, 1, 1), dtype=torch.uint8)
    answers = Targets(
        torch.ones((1, 4, 4), dtype=torch.uint8),
        torch.ones((1, 2, 2)),
        torch.full((1, 2, 2), kind, dtype=torch.uint8),
        torch.ones((1, 2, 2)),
        nothing,
        nothing.float(),
    )
    tally.add(Prediction(torch.full((1, 1, 4, 4), 5.0), kinds, torch.zeros((1, 2, 1, 1))), answers)
    assert tally.score().iou == {PAD: 1.0}


def test_known_classes_keep_their_shares_and_a_new_one_starts_small(
    shipped_run: Path, catalogue: Catalogue, image: torch.Tensor
) -> None:
    before = load_checkpoint(shipped_run).network()
    grown = with_classes(before.state_dict(), PAINT_CLASSES, catalogue, "here")
    after = MarkingNet(run_of(shipped_run.parent).net, len(CLASSES)).eval()
    after.load_state_dict(grown)
    with torch.inference_mode():
        old, new = before(image), after(image)
    torch.testing.assert_close(new.paint, old.paint)
    torch.testing.assert_close(new.lanes, old.lanes)
    torch.testing.assert_close(new.kinds[:, : len(PAINT_CLASSES)], old.kinds)
    shares = new.kinds.softmax(dim=1)
    assert float(shares[:, len(PAINT_CLASSES) :].sum(dim=1).max()) < 0.1


def test_classes_go_by_name_where_the_order_of_a_catalogue_changes(
    shipped_run: Path, catalogue: Catalogue
) -> None:
    weights = with_classes(load_checkpoint(shipped_run).averaged, PAINT_CLASSES, catalogue, "here")
    weights["kinds.bias"] = torch.arange(10.0)
    turned = SHIPPED.with_own({PAD: ENTRIES[PAD], T: ENTRIES[T]}, "test")
    again = with_classes(weights, catalogue.names, turned, "here")
    assert again["kinds.bias"].tolist() == [*range(8), 9.0, 8.0]
    with pytest.raises(ConfigError, match="here knows parking_t, pad"):
        with_classes(weights, catalogue.names, SHIPPED, "here")


def test_a_run_with_own_classes_is_exported_read_and_learnt_on(tmp_path: Path, shipped_run: Path) -> None:
    data = labels_of(tmp_path, "Parking T")
    config = run_of(tmp_path, shipped_run, data=data)
    state = Trainer(config, lambda share, line: None).run()
    assert state.catalogue.names == CLASSES
    path = tmp_path / "own.onnx"
    export_checkpoint(load_checkpoint(tmp_path / "run" / "last.pt"), path, opset=18, tolerance=1e-3)
    network = Network(path)
    assert network.info.classes == CLASSES
    assert network.info.catalogue == SHIPPED.with_own(ENTRIES, "test")
    assert len(network.run(np.zeros((32, 48, 3), dtype=np.uint8)).kinds) == len(CLASSES)
    # The file alone is enough to learn on from, and to export again.
    again = fresh_checkpoint(replace(config, catalogue=None, start=str(path)))
    assert again.catalogue.names == CLASSES
    assert len(again.averaged["kinds.bias"]) == len(CLASSES)
    assert len(read_source(path).net.state_dict()["kinds.bias"]) == len(CLASSES)


def test_the_mean_of_runs_takes_the_shipped_network_in(tmp_path: Path, shipped_run: Path) -> None:
    state = fresh_checkpoint(run_of(tmp_path, shipped_run))
    save_checkpoint(state, tmp_path / "own.pt")
    mean = mean_checkpoint(tmp_path / "own.pt", [shipped_run])
    assert mean.catalogue.names == CLASSES
    torch.testing.assert_close(mean.averaged["kinds.bias"], state.averaged["kinds.bias"])


def test_a_run_is_not_resumed_with_other_classes(tmp_path: Path, shipped_run: Path) -> None:
    config = run_of(tmp_path, shipped_run)
    Trainer(config, lambda share, line: None).run()
    written(tmp_path, {PAD: ENTRIES[PAD]})
    with pytest.raises(ConfigError, match="was trained with the classes parking_t, pad, not pad"):
        Trainer(replace(config, steps=5), lambda share, line: None)
    written(tmp_path)
    assert Trainer(replace(config, steps=4), lambda share, line: None).run().step == 4


def test_a_checkpoint_of_before_there_were_own_classes_is_read(tmp_path: Path, shipped_run: Path) -> None:
    content = torch.load(shipped_run, weights_only=True)
    del content["own_classes"], content["config"]["catalogue"]
    torch.save(content, tmp_path / "old.pt")
    assert load_checkpoint(tmp_path / "old.pt").catalogue == SHIPPED


def test_a_catalogue_that_is_missing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: no such file"):
        fresh_checkpoint(replace(tiny(tmp_path), catalogue=str(tmp_path / "none.yaml")))


@pytest.mark.parametrize(
    ("own", "words"),
    [
        ({PAD: {"family": "circle"}}, "family of 'pad'"),
        ({"diamond": ENTRIES[PAD]}, "is the name of 'diamond' already"),
        ([PAD], "no usable 'v2hdm' metadata"),
        ({T: ENTRIES[T]}, r"unknown classes \['pad'\]"),
    ],
)
def test_a_file_with_wrong_classes_is_refused(
    tmp_path: Path, exported: Path, own: object, words: str
) -> None:
    path = tmp_path / "own.onnx"
    model = onnx.load_model(str(exported))
    (entry,) = model.metadata_props
    entry.value = json.dumps(json.loads(entry.value) | {"own_classes": own})
    onnx.save_model(model, str(path))
    with pytest.raises(DetectorError, match=words):
        Network(path)


def test_a_checkpoint_holds_its_classes_as_plain_data(tmp_path: Path) -> None:
    state = Checkpoint(config={}, own_classes=load_catalogue(written(tmp_path)).own_entries())
    save_checkpoint(state, tmp_path / "own.pt")
    assert load_checkpoint(tmp_path / "own.pt").catalogue.names == CLASSES
