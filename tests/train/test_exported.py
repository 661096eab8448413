"""A training that starts from an exported file: the same function, with normalisations that can learn on."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import onnx
import pytest
import torch

from export.onnx_file import export_checkpoint, to_onnx
from models import MarkingNet, NetConfig
from tests.train.small import tiny
from train.checkpoint import Checkpoint, fresh_checkpoint, load_checkpoint, save_checkpoint
from train.exported import read_exported, unfold
from train.loop import Trainer
from v2hdm.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = ROOT / "v2hdm" / "detection" / "weights" / "default.onnx"
SHIPPED_FLOAT = ROOT / "models" / "marking_net.onnx"

Images = list[torch.Tensor]


@pytest.fixture
def images() -> Images:
    generator = torch.Generator().manual_seed(3)
    return [torch.randint(0, 256, (2, 64, 96, 3), dtype=torch.uint8, generator=generator) for _ in range(4)]


@pytest.fixture
def net(images: Images) -> MarkingNet:
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


def folded(net: MarkingNet) -> dict[str, torch.Tensor]:
    twin = MarkingNet(tiny(Path()).net)
    twin.load_state_dict(net.state_dict())
    return twin.fold().state_dict()


def test_an_unfolded_network_says_what_the_folded_one_says(net: MarkingNet, images: Images) -> None:
    again = MarkingNet(tiny(Path()).net)
    again.load_state_dict(unfold(folded(net), tiny(Path()).net, images[:1]))
    with torch.inference_mode():
        pairs = zip(again.eval()(images[2]), net(images[2]), strict=True)
        assert max(float((a - b).abs().max()) for a, b in pairs) < 1e-3


def test_it_says_the_same_while_it_trains_on_what_its_statistics_are_of(
    net: MarkingNet, images: Images
) -> None:
    again = MarkingNet(tiny(Path()).net)
    again.load_state_dict(unfold(folded(net), tiny(Path()).net, images[:1]))
    with torch.no_grad():
        pairs = zip(again.train()(images[0]), net(images[0]), strict=True)
        assert max(float((a - b).abs().max()) for a, b in pairs) < 1e-2


def test_a_training_starts_from_an_exported_file(net: MarkingNet, images: Images, tmp_path: Path) -> None:
    config = tiny(tmp_path / "run")
    taught = Checkpoint(config=asdict(config), renders=70, averaged=net.state_dict())
    export_checkpoint(taught, tmp_path / "net.onnx", opset=18, tolerance=1e-3)
    trainer = Trainer(replace(config, start=str(tmp_path / "net.onnx")), lambda share, line: None)
    assert trainer.state.renders == 70, "the renders that taught it would be shown again"
    with torch.inference_mode():
        pairs = zip(trainer.averaged.module.eval()(images[0]), net(images[0]), strict=True)
        assert max(float((a - b).abs().max()) for a, b in pairs) < 1e-3
    assert trainer.run().step == 3
    assert load_checkpoint(tmp_path / "run" / "last.pt").step == 3


@pytest.mark.parametrize("separable", [True, False])
def test_a_training_grows_a_smaller_network_that_goes_on_saying_the_same(
    net: MarkingNet, images: Images, tmp_path: Path, separable: bool
) -> None:
    config = tiny(tmp_path / "run")
    larger = NetConfig(widths=[16, 24, 32, 48], dilations=[1, 2, 4], separable=separable, wide_kinds=True)
    taught = Checkpoint(config=asdict(config), renders=70, averaged=net.state_dict())
    export_checkpoint(taught, tmp_path / "net.onnx", opset=18, tolerance=1e-3)
    save_checkpoint(taught, tmp_path / "net.pt")
    for start in ("net.onnx", "net.pt"):
        state = fresh_checkpoint(replace(config, net=larger, start=str(tmp_path / start)))
        grown = MarkingNet(larger)
        grown.load_state_dict(state.averaged)
        with torch.inference_mode():
            pairs = zip(grown.eval()(images[0]), net(images[0]), strict=True)
            assert max(float((a - b).abs().max()) for a, b in pairs) < 1e-3
        assert Trainer(
            replace(config, net=larger, start=str(tmp_path / start), output=str(tmp_path / f"from {start}")),
            lambda share, line: None,
        ).run()


def test_a_file_older_than_a_switch_holds_a_network_without_it(net: MarkingNet) -> None:
    settings = asdict(tiny(Path()).net)
    del settings["wide_kinds"]
    checkpoint = Checkpoint(config={"net": settings}, averaged=net.state_dict())
    assert checkpoint.network().wide_kinds is None


@pytest.mark.parametrize("path", [SHIPPED, SHIPPED_FLOAT], ids=lambda path: path.name)
def test_the_shipped_files_can_learn_on(tmp_path: Path, path: Path) -> None:
    config = replace(tiny(tmp_path), start=str(path), net=NetConfig())
    assert set(fresh_checkpoint(config).averaged) == set(MarkingNet().state_dict())


def test_the_shipped_files_are_of_one_training() -> None:
    int8, float32 = read_exported(SHIPPED), read_exported(SHIPPED_FLOAT)
    assert (int8.label["precision"], float32.label["precision"]) == ("int8", "float32")
    for key in ("commit", "steps", "renders", "metrics", "training"):
        assert int8.label[key] == float32.label[key]


def _no_onnx(path: Path) -> None:
    path.write_bytes(b"no model")


def _of_another_program(path: Path) -> None:
    onnx.save_model(to_onnx(MarkingNet(tiny(path).net).fold(), 18), str(path))


def _of_another_network(path: Path) -> None:
    path.write_bytes(SHIPPED.read_bytes())


def _of_other_weights(path: Path) -> None:
    model = onnx.load_model(str(SHIPPED))
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
def test_a_file_that_cannot_start_a_training_is_refused(tmp_path: Path, make: object, reason: str) -> None:
    assert callable(make)
    path = tmp_path / "other.onnx"
    make(path)
    with pytest.raises(ConfigError, match=reason):
        fresh_checkpoint(replace(tiny(tmp_path), start=str(path)))
