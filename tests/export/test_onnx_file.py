"""The exported file: the network's function, a label, whole or not at all; and its manifest."""

import json
import shutil
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from export import __main__ as door
from export import manifest, onnx_file
from export.onnx_file import export_checkpoint
from export.parity import PARITY_SIZES
from models import MarkingNet, NetConfig
from train.checkpoint import Checkpoint
from train.config import DataConfig, TrainConfig
from train.scenes.scenes import training_sample
from train.targets import IGNORE, paint_target
from v2hdm.catalogue import PAINT_CLASSES
from v2hdm.detection import weights
from v2hdm.detection.network import METADATA_KEY
from v2hdm.errors import DetectorError

ROOT = Path(__file__).resolve().parents[2]
CONF = str(ROOT / "conf")
SHIPPED = ROOT / "v2hdm" / "detection" / "weights" / "default.onnx"

SMALL = NetConfig(widths=[16, 16, 16, 16], dilations=[1, 2])


@pytest.fixture(scope="module")
def checkpoint():
    torch.manual_seed(0)
    net = MarkingNet(SMALL)
    net.train()
    net(torch.randint(0, 256, (2, 64, 64, 3), dtype=torch.uint8))
    config = TrainConfig(output="somewhere/private", net=SMALL, data=DataConfig(coco="private/labels.json"))
    return Checkpoint(config=asdict(config), step=5, averaged=net.state_dict(), metrics={"mean_iou": 0.25})


@pytest.fixture(scope="module")
def exported(checkpoint, tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "net.onnx"
    assert export_checkpoint(checkpoint, path, opset=18, tolerance=1e-3) < 1e-3
    return path


@pytest.mark.parametrize(("height", "width"), [*PARITY_SIZES, (720, 1280)])
def test_the_file_computes_what_the_network_computes(checkpoint, exported, height, width):
    image = np.random.default_rng(height).integers(0, 256, (1, height, width, 3)).astype(np.uint8)
    session = onnxruntime.InferenceSession(exported)
    with torch.inference_mode():
        prediction = checkpoint.network()(torch.from_numpy(image))
    for name, expected in prediction._asdict().items():
        (output,) = session.run([name], {"image": image})
        np.testing.assert_allclose(output, expected.numpy(), atol=1e-4)


def test_the_label_says_how_to_run_it_and_where_it_comes_from(exported):
    properties = {p.key: p.value for p in onnx.load(exported).metadata_props}
    label = json.loads(properties[METADATA_KEY])
    assert label["classes"] == list(PAINT_CLASSES)
    assert (label["multiple"], label["strides"], label["steps"]) == (
        16,
        {"paint": 2, "kinds": 4, "lanes": 8},
        5,
    )
    assert label["metrics"] == {"mean_iou": 0.25}
    assert label["precision"] == "float32"
    assert 0 <= label["parity"]["difference"] < 1e-3
    assert label["training"]["batch"] == TrainConfig().batch
    assert "private" not in properties[METADATA_KEY]
    assert label["training"]["data"]["own_labels"] == {"coco": True, "tusimple": False}


def test_the_file_says_nothing_of_the_machine_that_it_was_made_on(exported):
    assert str(Path(__file__).parents[2]).encode() not in exported.read_bytes()


def test_a_file_that_differs_from_its_network_is_not_written(checkpoint, exported, tmp_path, monkeypatch):
    monkeypatch.setattr(onnx_file, "to_onnx", lambda net, opset: onnx.load(exported))
    other = replace(checkpoint, averaged={k: v + 0.1 for k, v in checkpoint.averaged.items()})
    with pytest.raises(DetectorError, match="was not written"):
        export_checkpoint(other, tmp_path / "net.onnx", opset=18, tolerance=1e-3)
    assert list(tmp_path.iterdir()) == []


def test_weights_that_are_no_numbers_are_not_written(checkpoint, tmp_path):
    name = next(iter(checkpoint.averaged))
    broken = replace(checkpoint, averaged={**checkpoint.averaged, name: checkpoint.averaged[name] * np.nan})
    with pytest.raises(DetectorError, match="not finite"):
        export_checkpoint(broken, tmp_path / "net.onnx", opset=18, tolerance=1e-3)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (["checkpoint=nowhere.pt", "output=net.onnx"], "no checkpoint at nowhere.pt"),
        (["checkpoint=nowhere.onnx", "output=net.onnx"], "no file nowhere.onnx"),
        (["output=net.onnx"], "no value for checkpoint; `python -m export checkpoint=... output=...`"),
    ],
)
def test_what_is_missing_is_named_in_one_line(overrides, line, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["export", *overrides])
    monkeypatch.chdir(tmp_path)
    assert door.main() == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith("error: ")
    assert line in error
    assert "\n" not in error
    assert not list(tmp_path.iterdir())


def test_the_shipped_detector_finds_fresh_paint_where_it_is():
    session = onnxruntime.InferenceSession(SHIPPED)
    recall, precision, overlap = [], [], np.zeros((3, 3))
    for index in range(12):
        sample = training_sample(424242, index, 448, 256, difficulty=0.0)
        (paint,) = session.run(["paint"], {"image": sample.image[None]})
        target = paint_target(sample.labels)
        is_paint, painted = paint[0, 0] > 0, target == 1
        if painted.sum() > 150:
            recall.append(is_paint[painted].mean())
            precision.append(painted[is_paint & (target != IGNORE)].mean())
        for row, column in np.ndindex(3, 3):
            overlap[row, column] += (np.roll(is_paint, (row - 1, column - 1), (0, 1)) & painted).sum()
    assert np.median(recall) > 0.85
    assert np.median(precision) > 0.85
    for before, here, after in (overlap[:, 1], overlap[1]):
        shift = 0.5 * (after - before) / (2 * here - before - after)
        assert abs(shift) < 0.1, "masks are displaced by this many logits"


@pytest.fixture
def folder(tmp_path):
    copy = tmp_path / "weights"
    shutil.copytree(weights.FOLDER, copy, ignore=shutil.ignore_patterns("__pycache__", "*.py"))
    return copy


def check(folder):
    weights._problem.cache_clear()
    weights.check_weights(folder)


def change(folder, name):
    with (folder / name).open("ab") as file:
        file.write(b"\n")


def test_a_new_network_is_refused_until_judge_and_lane_score_were_fitted_to_it(folder):
    change(folder, "default.onnx")
    manifest.record(["default.onnx"], "python -m export", folder)
    with pytest.raises(DetectorError, match=r"judge\.onnx: was fitted to a network other .* train\.ship"):
        check(folder)
    change(folder, "judge.onnx")
    change(folder, "confidence.json")
    manifest.record(["judge.onnx", "confidence.json"], "python -m train.ship runs/gpu", folder)
    with pytest.raises(DetectorError, match=r"lane_score\.json: .* train\.ship"):
        check(folder)
    manifest.record(["lane_score.json"], "kept", folder)
    check(folder)
    files = weights.read_manifest(folder)["files"]
    assert files["lane_score.json"]["command"] == "kept"
    assert len({entry["network"] for entry in files.values()}) == 1


def test_the_manifest_names_the_commit_the_day_and_the_command(folder):
    manifest.record(["judge.onnx"], "python -m train.ship runs/gpu", folder)
    written = weights.read_manifest(folder)
    entry = written["files"]["judge.onnx"]
    assert written["commit"] is None or len(written["commit"].removesuffix("-dirty")) == 40
    assert entry["command"] == "python -m train.ship runs/gpu"
    assert entry["made"].count("-") == 2


def test_an_export_elsewhere_leaves_the_manifest_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(manifest, "record", lambda *_: pytest.fail("the manifest was written"))
    manifest.record_network(tmp_path / "mine.onnx", "python -m export")


def test_what_is_no_fitted_file_is_refused(folder):
    with pytest.raises(DetectorError, match=r"scores\.json: no fitted file .* give one of default\.onnx"):
        manifest.record(["scores.json"], "by hand", folder)
