"""torch takes three seconds to make the graph of a network: those of one structure share it in tests."""

from collections.abc import Callable, Iterator
from copy import deepcopy
from typing import Any

import onnx
import pytest
import torch
from onnx import numpy_helper
from torch import nn

from export import onnx_file

_made: dict[str, onnx.ModelProto] = {}
"""Graphs by the structure of their networks, with weights of no meaning by the names of the network's."""


@pytest.fixture(scope="module", autouse=True)
def graphs_made_once() -> Iterator[None]:
    """In modules that import this, the graph of a network is that of one like it, with its own weights."""
    with pytest.MonkeyPatch.context() as patch:
        original = onnx_file.graph_of
        patch.setattr(onnx_file, "graph_of", lambda *arguments: _graph(original, *arguments))
        yield


def _graph(original: Callable[..., onnx.ModelProto], module: nn.Module, *arguments: Any) -> onnx.ModelProto:
    weights = module.state_dict()
    structure = repr(
        (module, [(name, weight.shape, weight.dtype) for name, weight in weights.items()], arguments)
    )
    if structure not in _made:
        _made[structure] = original(_with_other_weights(module), *arguments)
    model = deepcopy(_made[structure])
    initializers = {tensor.name: tensor for tensor in model.graph.initializer}
    for name, value in weights.items():
        initializers[name].CopyFrom(numpy_helper.from_array(value.detach().numpy(), name))
    return model


def _with_other_weights(module: nn.Module) -> nn.Module:
    """The module with weights that are all unlike: torch would make one of two that are the same."""
    other = deepcopy(module)
    generator = torch.Generator().manual_seed(0)
    for value in other.state_dict().values():
        value.copy_(torch.rand(value.shape, generator=generator))
    return other
