"""The int8 graph in another order: it says the same, to rounding, of images of any size."""

from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper

from export import int8
from export.arrange import arrange
from export.graph import Graph, open_session
from export.onnx_file import to_onnx
from models import MarkingNet, NetConfig, Prediction

CONFIG = NetConfig(widths=[16, 32, 16, 16], dilations=[1, 2])
SIZES = ((16, 16), (48, 112), (96, 32))


def noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(height).integers(0, 256, (height, width, 3), dtype=np.uint8)


def before(config: NetConfig) -> onnx.ModelProto:
    """The graph with bytes inside, as it was thought out."""
    torch.manual_seed(1)
    net = MarkingNet(config).train()
    with torch.no_grad():
        for _ in range(20):  # normalisations that have seen nothing have no biases
            net(torch.from_numpy(noise(64, 96)[None]))
    plain = to_onnx(net.eval().fold(), 18)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(int8, "arrange", lambda graph: None)
        return int8.to_int8(plain, [noise(64, 96)])


def after(model: onnx.ModelProto) -> onnx.ModelProto:
    graph = Graph(model)
    arrange(graph)
    arranged = graph.stored()
    onnx.checker.check_model(arranged, full_check=True)
    return arranged


@pytest.fixture(scope="module")
def thought_out() -> onnx.ModelProto:
    return before(CONFIG)


def check_same(one: onnx.ModelProto, other: onnx.ModelProto) -> None:
    sessions = [open_session(model.SerializeToString()) for model in (one, other)]
    for size in SIZES:
        said = [session.run(list(Prediction._fields), {"image": noise(*size)[None]}) for session in sessions]
        for name, a, b in zip(Prediction._fields, *said, strict=True):
            np.testing.assert_allclose(a, b, atol=2e-5, err_msg=f"{name} of {size}")


def test_it_says_the_same(thought_out: onnx.ModelProto) -> None:
    check_same(thought_out, after(thought_out))


@pytest.mark.parametrize("without", ["lanes", "wide_kinds"])
def test_a_network_without_a_head_says_the_same(without: str) -> None:
    model = before(replace(CONFIG, separable=True, **{without: False}))
    check_same(model, after(model))


def test_nothing_slow_is_left_nor_anything_unused(thought_out: onnx.ModelProto) -> None:
    graph = after(thought_out).graph
    assert "Resize" not in {node.op_type for node in graph.node}
    read = {name for node in graph.node for name in node.input} | {value.name for value in graph.output}
    assert {name for node in graph.node for name in node.output} <= read
    assert {tensor.name for tensor in graph.initializer} <= read


def test_it_is_arranged_once(thought_out: onnx.ModelProto) -> None:
    once = after(thought_out)
    assert after(once).SerializeToString() == once.SerializeToString()


def test_weights_keep_their_names_and_values(thought_out: onnx.ModelProto) -> None:
    kept = {t.name: numpy_helper.to_array(t) for t in after(thought_out).graph.initializer}
    for tensor in thought_out.graph.initializer:
        if tensor.name.endswith((".weight", ".weight.bytes", ".bias", ".bias.bytes")):
            np.testing.assert_array_equal(kept[tensor.name], numpy_helper.to_array(tensor))
