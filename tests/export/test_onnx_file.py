"""The exported file: the network's function at any size, with a label, whole or not at all."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from export.onnx_file import METADATA_KEY, PARITY_SIZES, export_checkpoint
from models import MarkingNet, NetConfig
from train.checkpoint import Checkpoint
from train.config import TrainConfig
from v2hdm.errors import DetectorError
from v2hdm.records import PAINT_CLASSES

SMALL = NetConfig(widths=[16, 16, 16, 16], dilations=[1, 2])


@pytest.fixture(scope="module")
def checkpoint() -> Checkpoint:
    torch.manual_seed(0)
    net = MarkingNet(SMALL)
    net.train()
    net(torch.randint(0, 256, (2, 64, 64, 3), dtype=torch.uint8))
    config = TrainConfig(output="somewhere/private", net=SMALL)
    return Checkpoint(config=asdict(config), step=5, averaged=net.state_dict(), metrics={"mean_iou": 0.25})


@pytest.fixture(scope="module")
def exported(checkpoint: Checkpoint, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("export") / "net.onnx"
    assert export_checkpoint(checkpoint, path, opset=18, tolerance=1e-3) < 1e-3
    return path


@pytest.mark.parametrize(("height", "width"), [*PARITY_SIZES, (720, 1280)])
def test_the_file_computes_what_the_network_computes(
    checkpoint: Checkpoint, exported: Path, height: int, width: int
) -> None:
    image = np.random.default_rng(height).integers(0, 256, (1, height, width, 3)).astype(np.uint8)
    (logits,) = onnxruntime.InferenceSession(exported).run(None, {"image": image})
    with torch.inference_mode():
        expected = checkpoint.network()(torch.from_numpy(image)).numpy()
    assert logits.shape == (1, 1 + len(PAINT_CLASSES), height // 2, width // 2)
    np.testing.assert_allclose(logits, expected, atol=1e-4)


def test_the_label_says_how_to_run_it_and_where_it_comes_from(exported: Path) -> None:
    properties = {p.key: p.value for p in onnx.load(exported).metadata_props}
    label = json.loads(properties[METADATA_KEY])
    assert label["classes"] == list(PAINT_CLASSES)
    assert (label["multiple"], label["stride"], label["steps"]) == (16, 2, 5)
    assert label["metrics"] == {"mean_iou": 0.25}
    assert label["training"]["batch"] == TrainConfig().batch
    assert "private" not in properties[METADATA_KEY]


def test_a_file_that_differs_from_its_network_is_not_written(checkpoint: Checkpoint, tmp_path: Path) -> None:
    with pytest.raises(DetectorError, match="was not written"):
        export_checkpoint(checkpoint, tmp_path / "net.onnx", opset=18, tolerance=-1.0)
    assert list(tmp_path.iterdir()) == []
