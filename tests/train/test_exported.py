"""Trainings that start from an exported file, the mean of several, and users' own classes."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from export.onnx_file import export_checkpoint, to_onnx
from export.source import read_source
from models import MarkingNet, NetConfig, Prediction
from tests.export.graphs import graphs_made_once as graphs_made_once
from tests.train.small import coco, tiny
from train.average import mean_checkpoint, scored
from train.checkpoint import (
    Checkpoint,
    check_same_experiment,
    fresh_checkpoint,
    load_checkpoint,
    own_entries,
    save_checkpoint,
)
from train.config import DataConfig, LabelError
from train.exported import read_exported, unfold
from train.growth import with_classes
from train.labels import read_labels
from train.loop import Trainer
from train.metrics import Tally
from train.targets import IGNORE, Targets
from v2hdm.catalogue import PAINT_CLASSES, SHIPPED
from v2hdm.detection.detector import Detector
from v2hdm.detection.network import Network
from v2hdm.errors import ConfigError, DetectorError

ROOT = Path(__file__).resolve().parents[2]
SHIPPED_FILE = ROOT / "v2hdm" / "detection" / "weights" / "default.onnx"
SHIPPED_FLOAT = ROOT / "models" / "marking_net.onnx"

Images = list[torch.Tensor]


@pytest.fixture(scope="module")
def images():
    generator = torch.Generator().manual_seed(3)
    return [torch.randint(0, 256, (2, 64, 96, 3), dtype=torch.uint8, generator=generator) for _ in range(4)]


@pytest.fixture(scope="module")
def net(images):
    """A network whose normalisations all say something."""
    torch.manual_seed(0)
    net = MarkingNet(tiny(Path()).net)
    for name, parameter in net.named_parameters():
        if ".1." in name and parameter.ndim == 1:
            torch.nn.init.uniform_(parameter, 0.4, 1.6)
    with torch.no_grad():
        for image in images:
            net.train()(image)
    return net.eval()


@pytest.fixture(scope="module")
def starts(net, tmp_path_factory):
    """That network as 70 renders have taught it, exported and as a checkpoint."""
    folder = tmp_path_factory.mktemp("starts")
    taught = Checkpoint(config=asdict(tiny(folder)), renders=70, averaged=net.state_dict())
    export_checkpoint(taught, folder / "net.onnx", opset=18, tolerance=1e-3)
    save_checkpoint(taught, folder / "net.pt")
    return folder / "net.onnx", folder / "net.pt"


def folded(net):
    twin = MarkingNet(tiny(Path()).net)
    twin.load_state_dict(net.state_dict())
    return twin.fold().state_dict()


@pytest.mark.parametrize(("training", "number", "atol"), [(False, 2, 1e-3), (True, 0, 1e-2)])
def test_an_unfolded_network_says_what_the_folded_one_says(net, images, training, number, atol):
    """While it trains: on the images that its statistics are of."""
    again = MarkingNet(tiny(Path()).net)
    again.load_state_dict(unfold(folded(net), tiny(Path()).net, images[:1]))
    with torch.no_grad():
        pairs = zip(again.train(training)(images[number]), net(images[number]), strict=True)
        assert max(float((a - b).abs().max()) for a, b in pairs) < atol


def test_a_training_starts_from_an_exported_file(net, images, starts, tmp_path):
    config = replace(tiny(tmp_path / "run"), start=str(starts[0]))
    trainer = Trainer(config, lambda share, line: None)
    assert trainer.state.renders == 70, "the renders that taught it would be shown again"
    with torch.inference_mode():
        pairs = zip(trainer.averaged.module.eval()(images[0]), net(images[0]), strict=True)
        assert max(float((a - b).abs().max()) for a, b in pairs) < 1e-3
    assert trainer.run().step == 3
    assert load_checkpoint(tmp_path / "run" / "last.pt").step == 3


@pytest.mark.parametrize("separable", [True, False])
def test_a_training_grows_a_smaller_network_that_goes_on_saying_the_same(
    net, images, starts, tmp_path, separable
):
    larger = NetConfig(widths=[16, 24, 32, 48], dilations=[1, 2, 4], separable=separable, added_kinds=8)
    for start in starts:
        config = replace(tiny(tmp_path / start.name, steps=1), net=larger, start=str(start))
        state = fresh_checkpoint(config)
        grown = MarkingNet(larger)
        grown.load_state_dict(state.averaged)
        with torch.inference_mode():
            pairs = zip(grown.eval()(images[0]), net(images[0]), strict=True)
            assert max(float((a - b).abs().max()) for a, b in pairs) < 1e-3
        assert Trainer(config, lambda share, line: None).run().step == 1


def test_channels_that_a_wide_head_gets_leave_what_it_says(tmp_path, images):
    config = tiny(tmp_path / "first")
    config = replace(config, net=replace(config.net, wide_kinds=True))
    torch.manual_seed(2)
    first = MarkingNet(config.net).eval()
    state = Checkpoint(config=asdict(config), averaged=first.state_dict())
    save_checkpoint(state, tmp_path / "first.pt")
    larger = replace(config.net, added_kinds=8)
    grown = MarkingNet(larger)
    start = replace(config, net=larger, start=str(tmp_path / "first.pt"))
    grown.load_state_dict(fresh_checkpoint(start).averaged)
    with torch.inference_mode():
        kinds = grown.eval()(images[0]).kinds
        torch.testing.assert_close(kinds, first(images[0]).kinds, atol=1e-3, rtol=0)
    assert len(grown.wide_kinds[0][-1][0].weight) == 24
    save_checkpoint(Checkpoint(config=asdict(start), averaged=grown.state_dict()), tmp_path / "grown.pt")
    with pytest.raises(ConfigError, match="holds the network"):
        fresh_checkpoint(replace(config, start=str(tmp_path / "grown.pt")))


def test_a_file_older_than_a_switch_holds_a_network_without_it(net):
    settings = asdict(tiny(Path()).net)
    del settings["wide_kinds"]
    checkpoint = Checkpoint(config={"net": settings}, averaged=net.state_dict())
    assert checkpoint.network().wide_kinds is None


@pytest.mark.parametrize("path", [SHIPPED_FILE, SHIPPED_FLOAT], ids=lambda path: path.name)
def test_the_shipped_files_can_learn_on(tmp_path, path):
    config = replace(tiny(tmp_path), start=str(path), net=NetConfig())
    assert set(fresh_checkpoint(config).averaged) == set(MarkingNet().state_dict())


def test_the_shipped_files_are_of_one_training():
    int8, float32 = read_exported(SHIPPED_FILE), read_exported(SHIPPED_FLOAT)
    assert (int8.label["precision"], float32.label["precision"]) == ("int8", "float32")
    for key in ("commit", "steps", "renders", "metrics", "training"):
        assert int8.label[key] == float32.label[key]


def _no_onnx(path):
    path.write_bytes(b"no model")


def _of_another_program(path):
    onnx.save_model(to_onnx(MarkingNet(tiny(path).net).fold(), 18), str(path))


def _of_another_network(path):
    path.write_bytes(SHIPPED_FILE.read_bytes())


def _of_other_weights(path):
    model = onnx.load_model(str(SHIPPED_FILE))
    (entry,) = model.metadata_props
    label = json.loads(entry.value)
    label["training"]["net"] = vars(tiny(path).net)
    entry.value = json.dumps(label)
    onnx.save_model(model, str(path))


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda path: None, "no file"),
        (_no_onnx, "was not written by"),
        (_of_another_program, "was not written by"),
        (_of_another_network, "holds the network"),
        (_of_other_weights, "has no weight"),
    ],
)
def test_a_file_that_cannot_start_a_training_is_refused(tmp_path, make, reason):
    assert callable(make)
    path = tmp_path / "other.onnx"
    make(path)
    with pytest.raises(ConfigError, match=reason):
        fresh_checkpoint(replace(tiny(tmp_path), start=str(path)))


def taught(path, seed, **net):
    """Write a checkpoint of random weights; returns them."""
    config = tiny(path)
    config = replace(config, net=replace(config.net, **net))
    torch.manual_seed(seed)
    state = MarkingNet(config.net).state_dict()
    scores = {"mean_iou": 1.0}
    save_checkpoint(Checkpoint(config=asdict(config), step=seed, averaged=state, metrics=scores), path)
    return state


def test_the_mean_is_between_its_parts_by_their_weights(tmp_path):
    first, second = (taught(tmp_path / f"{seed}.pt", seed) for seed in (1, 2))
    mean = mean_checkpoint(tmp_path / "1.pt", [tmp_path / "2.pt"], [3.0, 1.0])
    for name, value in mean.averaged.items():
        torch.testing.assert_close(value, (0.75 * first[name] + 0.25 * second[name]).to(value.dtype))
    assert mean.metrics == {}, "nobody has scored the mean yet"
    assert 0 <= scored(mean)["mean_iou"] <= 1
    save_checkpoint(mean, tmp_path / "mean.pt")
    assert (
        load_checkpoint(tmp_path / "mean.pt").network().stem[0].weight.shape == first["stem.0.weight"].shape
    )


def test_parts_that_cannot_be_averaged_are_refused(tmp_path):
    taught(tmp_path / "1.pt", 1)
    taught(tmp_path / "other.pt", 2, head_width=4)
    with pytest.raises(ConfigError, match="holds the network"):
        mean_checkpoint(tmp_path / "1.pt", [tmp_path / "other.pt"])
    with pytest.raises(ConfigError, match="no checkpoint at"):
        mean_checkpoint(tmp_path / "1.pt", [tmp_path / "none.pt"])
    with pytest.raises(ConfigError, match="1 weights for 2 files"):
        mean_checkpoint(tmp_path / "1.pt", [tmp_path / "1.pt"], [1.0])


def test_the_mean_with_its_own_start_is_between_the_two_though_the_network_grew(tmp_path):
    taught(tmp_path / "small.pt", 1)
    config = tiny(tmp_path / "run")
    grown = replace(config, start=str(tmp_path / "small.pt"), net=replace(config.net, wide_kinds=True))
    trainer = Trainer(grown, lambda share, line: None)
    start = {name: value.clone() for name, value in trainer.averaged.module.state_dict().items()}
    trainer.run()
    mean = mean_checkpoint(tmp_path / "run" / "last.pt", [tmp_path / "small.pt"])
    end = load_checkpoint(tmp_path / "run" / "last.pt").averaged
    for name, value in mean.averaged.items():
        if value.is_floating_point():
            torch.testing.assert_close(value, (start[name] + end[name]) / 2, atol=1e-5, rtol=1e-5)


T, PAD = "parking_t", "pad"
SIZES = {"length_m": [0.8, 1.4], "width_m": [0.4, 1.2]}
ENTRIES = {T: {"family": "symbol", **SIZES}, PAD: {"family": "quadrilateral", **SIZES}}
CLASSES = (*PAINT_CLASSES, T, PAD)


@pytest.fixture
def catalogue():
    return SHIPPED.with_own(ENTRIES, "test")


@pytest.fixture
def image():
    generator = torch.Generator().manual_seed(3)
    return torch.randint(0, 256, (1, 64, 96, 3), dtype=torch.uint8, generator=generator)


@pytest.fixture
def shipped_run(tmp_path):
    """A checkpoint that knows the shipped classes."""
    torch.manual_seed(0)
    config = replace(tiny(tmp_path), net=replace(tiny(tmp_path).net, wide_kinds=True))
    state = fresh_checkpoint(config)
    state.averaged = MarkingNet(config.net).state_dict()
    save_checkpoint(state, tmp_path / "shipped.pt")
    return tmp_path / "shipped.pt"


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """An exported file of an untaught network that knows two own classes."""
    folder = tmp_path_factory.mktemp("exported")
    config = run_of(folder)
    state = fresh_checkpoint(config)
    state.averaged = MarkingNet(config.net, len(CLASSES)).state_dict()
    export_checkpoint(state, folder / "own.onnx", opset=18, tolerance=1e-3)
    return folder / "own.onnx"


def written(folder, entries=ENTRIES):
    path = folder / "classes.yaml"
    path.write_text(json.dumps({"classes": entries}))
    return path


def run_of(folder, start=None, **changes):
    config = replace(tiny(folder / "run"), catalogue=str(written(folder)), **changes)
    return replace(config, start=start and str(start), net=replace(config.net, wide_kinds=True))


def labels_of(folder, kind):
    small = DataConfig(width=64, height=32, render_width=80, render_height=48, workers=0, labelled_share=1.0)
    content = [{"id": 1, "name": kind}, {"id": 2, "name": "zebra"}]
    return replace(small, coco=str(coco(folder, categories=content)))


def test_a_label_is_called_like_an_own_class(tmp_path):
    data = labels_of(tmp_path, "Parking-T")
    images = read_labels(data, CLASSES)
    rng = np.random.default_rng(0)
    classes = torch.cat([images.view(rng)[1].kinds.flatten() for _ in range(30)])
    assert set(classes.tolist()) == {CLASSES.index(T), IGNORE}
    with pytest.raises(LabelError, match="'Parking-T' is no class of the detector"):
        read_labels(data)
    (shape,) = images.images[0].shapes or ()
    assert shape.kinds == (T,)


def test_own_classes_are_scored():
    tally, kind, ones = Tally(CLASSES), CLASSES.index(PAD), torch.ones((1, 2, 2))
    kinds = torch.full((1, len(CLASSES), 2, 2), -5.0)
    kinds[:, kind] = 5.0
    paint, none = torch.ones((1, 4, 4), dtype=torch.uint8), torch.zeros((1, 1, 1), dtype=torch.uint8)
    answers = Targets(paint, ones, (kind * ones).to(torch.uint8), ones, none, none.float())
    tally.add(Prediction(torch.full((1, 1, 4, 4), 5.0), kinds, torch.zeros((1, 2, 1, 1))), answers)
    assert tally.score().iou == {PAD: 1.0}


def test_known_classes_keep_their_shares_and_a_new_one_starts_small(shipped_run, catalogue, image):
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


def test_classes_go_by_name_where_the_order_of_a_catalogue_changes(shipped_run, catalogue):
    weights = with_classes(load_checkpoint(shipped_run).averaged, PAINT_CLASSES, catalogue, "here")
    weights["kinds.bias"] = torch.arange(float(len(CLASSES)))
    turned = SHIPPED.with_own({PAD: ENTRIES[PAD], T: ENTRIES[T]}, "test")
    again = with_classes(weights, catalogue.names, turned, "here")
    last = len(PAINT_CLASSES)
    assert again["kinds.bias"].tolist() == [*range(last), last + 1, last]
    with pytest.raises(ConfigError, match="here knows parking_t, pad"):
        with_classes(weights, catalogue.names, SHIPPED, "here")


def test_a_run_with_own_classes_is_exported_read_and_learnt_on(tmp_path, shipped_run):
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


def test_the_mean_of_runs_takes_the_shipped_network_in(tmp_path, shipped_run):
    state = fresh_checkpoint(run_of(tmp_path, shipped_run))
    save_checkpoint(state, tmp_path / "own.pt")
    mean = mean_checkpoint(tmp_path / "own.pt", [shipped_run])
    assert mean.catalogue.names == CLASSES
    torch.testing.assert_close(mean.averaged["kinds.bias"], state.averaged["kinds.bias"])


def test_a_run_is_not_resumed_with_other_classes(tmp_path, shipped_run):
    config = run_of(tmp_path, shipped_run)
    Trainer(config, lambda share, line: None).run()
    written(tmp_path, {PAD: ENTRIES[PAD]})
    with pytest.raises(ConfigError, match="was trained with the classes parking_t, pad, not pad"):
        Trainer(replace(config, steps=5), lambda share, line: None)
    written(tmp_path)
    assert Trainer(replace(config, steps=4), lambda share, line: None).run().step == 4


def test_a_checkpoint_of_before_there_were_own_classes_is_read(tmp_path, shipped_run):
    content = torch.load(shipped_run, weights_only=True)
    del content["own_classes"], content["config"]["catalogue"]
    torch.save(content, tmp_path / "old.pt")
    assert load_checkpoint(tmp_path / "old.pt").catalogue == SHIPPED


@pytest.mark.parametrize(
    ("own_classes", "words"),
    [
        ({PAD: {"family": "circle"}}, "family of 'pad'"),
        ({"diamond": ENTRIES[PAD]}, "is already the name of 'diamond'"),
        ([PAD], "no usable 'v2hdm' metadata"),
        ({T: ENTRIES[T]}, r"unknown classes \['pad'\]"),
    ],
)
def test_a_file_with_wrong_classes_is_refused(tmp_path, exported, own_classes, words):
    path = tmp_path / "own.onnx"
    model = onnx.load_model(str(exported))
    (entry,) = model.metadata_props
    entry.value = json.dumps(json.loads(entry.value) | {"own_classes": own_classes})
    onnx.save_model(model, str(path))
    with pytest.raises(DetectorError, match=words):
        Network(path)


OLDEST = 8  # shipped classes of the networks before there were words and boxes


def of_the_oldest(path):
    """A checkpoint of a network that knows the oldest classes only."""
    torch.manual_seed(0)
    config = replace(tiny(path.parent), net=replace(tiny(path.parent).net, wide_kinds=True))
    state = fresh_checkpoint(config)
    state.averaged = MarkingNet(config.net, OLDEST).state_dict()
    state.model = state.averaged
    save_checkpoint(state, path)
    return config


def test_a_network_of_the_oldest_classes_is_exported_and_learns_the_others(tmp_path, image):
    config = of_the_oldest(tmp_path / "old.pt")
    old = load_checkpoint(tmp_path / "old.pt")
    assert old.classes == PAINT_CLASSES[:OLDEST]
    export_checkpoint(old, tmp_path / "old.onnx", opset=18, tolerance=1e-3)
    assert Network(tmp_path / "old.onnx").info.classes == PAINT_CLASSES[:OLDEST]
    for start in ("old.pt", "old.onnx"):
        grown = fresh_checkpoint(replace(config, start=str(tmp_path / start)))
        assert grown.classes == PAINT_CLASSES
        with torch.inference_mode():
            kinds = grown.network()(image).kinds[:, :OLDEST]
            torch.testing.assert_close(kinds, old.network()(image).kinds, atol=1e-3, rtol=1e-3)


def test_a_run_from_before_a_class_was_added_is_not_resumed_but_started_from(tmp_path):
    config = of_the_oldest(tmp_path / "last.pt")
    with pytest.raises(ConfigError, match=r"before .* text, box, bicycle: go on with start="):
        check_same_experiment(load_checkpoint(tmp_path / "last.pt"), config, tmp_path / "last.pt")


def test_the_mean_of_an_old_and_a_new_network_knows_all_classes(tmp_path):
    of_the_oldest(tmp_path / "old.pt")
    mean = mean_checkpoint(tmp_path / "old.pt", [tmp_path / "old.pt"])
    assert mean.classes == PAINT_CLASSES


def test_a_class_that_catalogue_and_start_define_differently_is_named_in_one_line(
    tmp_path, shipped_run, catalogue
):
    state = load_checkpoint(shipped_run)
    state.averaged = with_classes(state.averaged, PAINT_CLASSES, catalogue, "here")
    state.own_classes = own_entries(catalogue)
    save_checkpoint(state, tmp_path / "own.pt")
    wide = {"length_m": [0.8, 1.4], "width_m": [0.4, 2.4]}
    config = run_of(tmp_path, tmp_path / "own.pt")
    written(tmp_path, ENTRIES | {PAD: ENTRIES[PAD] | wide})
    with pytest.raises(
        ConfigError, match=r"classes.yaml and start=.*own.pt define pad differently"
    ) as refused:
        fresh_checkpoint(config)
    assert "\n" not in str(refused.value)


def test_an_own_class_called_like_a_newly_shipped_one_is_named_in_one_line(tmp_path):
    config = of_the_oldest(tmp_path / "old.pt")
    state = load_checkpoint(tmp_path / "old.pt")
    state.own_classes = {"text": ENTRIES[T]}
    save_checkpoint(state, tmp_path / "own.pt")
    with pytest.raises(ConfigError, match="'text' is already the name of 'text'"):
        fresh_checkpoint(replace(config, start=str(tmp_path / "own.pt")))


def test_a_network_without_some_classes_says_once_that_they_are_not_found(tmp_path, caplog):
    of_the_oldest(tmp_path / "old.pt")
    export_checkpoint(load_checkpoint(tmp_path / "old.pt"), tmp_path / "old.onnx", opset=18, tolerance=1e-3)
    for _ in range(2):
        Detector.load(tmp_path / "old.onnx")
    (line,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert line.endswith("does not know text, box, bicycle: none of these will be found")


def test_a_class_is_averaged_over_the_files_that_know_it(tmp_path):
    config = of_the_oldest(tmp_path / "old.pt")
    new = fresh_checkpoint(replace(config, start=str(tmp_path / "old.pt")))
    new.averaged = {
        name: value + 1 if value.is_floating_point() else value for name, value in new.averaged.items()
    }
    save_checkpoint(new, tmp_path / "new.pt")
    mean = mean_checkpoint(tmp_path / "new.pt", [tmp_path / "old.pt"]).averaged
    for name in ("kinds.weight", "kinds.bias"):
        torch.testing.assert_close(mean[name][OLDEST:], new.averaged[name][OLDEST:])
        torch.testing.assert_close(mean[name][:OLDEST], new.averaged[name][:OLDEST] - 0.5)
    torch.testing.assert_close(mean["stem.0.weight"], new.averaged["stem.0.weight"] - 0.5)
