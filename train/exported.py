"""An exported file as the start of a training, so that the shipped network can learn a user's own labels."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from models import MarkingNet, NetConfig
from models.marking_net import ConvNormRelu
from v2hdm.catalogue import Catalogue
from v2hdm.detection.network import METADATA_KEY, read_catalogue
from v2hdm.errors import ConfigError

_GROWTH = 3.0
"""How many times larger than at the start the weights of a trained convolution are, about (seen in those
that no normalisation follows)."""


@dataclass(frozen=True)
class Exported:
    """The training metadata of an exported file, and its weights by their names in the folded network.

    ``config`` are the training's settings, ``renders`` how many renders had taught it, as in a checkpoint;
    ``label`` is all that the file says. The weights of an int8 file are multiples of the steps that they were
    rounded to.
    """

    config: dict[str, Any]
    renders: int
    weights: dict[str, Tensor]
    label: dict[str, Any]

    @property
    def classes(self) -> tuple[str, ...]:
        """The classes of its channels: a network may be older than the last of the shipped ones."""
        return tuple(self.label["classes"])

    @property
    def catalogue(self) -> Catalogue:
        """The shipped classes and its own."""
        return read_catalogue(self.label)


def read_exported(path: Path) -> Exported:
    """Read a file written by `python -m export`.

    Raises:
        ConfigError: There is no such file, or another program wrote it.
    """
    if not path.is_file():
        raise ConfigError(f"no file {path} to start from: give a checkpoint, or an exported .onnx file")
    try:
        model = onnx.load_model(str(path))
        label = json.loads({entry.key: entry.value for entry in model.metadata_props}[METADATA_KEY])
        config = dict(label["training"])
        renders = int(label.get("renders", 0))
        label["classes"] = [str(name) for name in label["classes"]]
        NetConfig(**config["net"])
        arrays = _constants(model.graph)
    except Exception as error:
        reason = f"{type(error).__name__}: {error!s:.120}".replace("\n", " ")
        raise ConfigError(f"{path} was not written by `python -m export` ({reason})") from error
    weights = {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}
    return Exported(config, renders, weights, label)


def _constants(graph: onnx.GraphProto) -> dict[str, np.ndarray]:
    """The constants of a graph by the names that its nodes read: as stored, or as scaled integers."""
    arrays = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    for node in graph.node:
        if node.op_type == "DequantizeLinear" and node.input[0] in arrays:
            whole = arrays[node.input[0]]
            scale = arrays[node.input[1]]
            zero = arrays[node.input[2]].astype(np.int64) if len(node.input) > 2 else np.zeros_like(scale)
            along = (-1, *[1] * (whole.ndim - 1))  # an export scales each output, its first axis
            steps = whole.astype(np.float64) - zero.reshape(along)
            arrays[node.output[0]] = (steps * scale.reshape(along)).astype(np.float32)
    return arrays


@torch.no_grad()
def unfold(folded: dict[str, Tensor], config: NetConfig, images: Iterable[Tensor]) -> dict[str, Tensor]:
    """The state of a network, with its batch normalisations, that computes what a folded one does.

    Folding leaves of a normalisation only a scale in the convolution and a shift. Its statistics are taken
    anew from what the convolution gives on ``images``, (B, H, W, 3) uint8, and its scale and shift undo
    them: the network says the same in eval mode and, on images like these, nearly the same while it trains.
    The convolution's own scale is then free; it gets that of a trained one, since updates of the usual size
    would tear smaller weights about.

    Raises:
        ConfigError: A weight is missing or of another shape.
    """
    classes = len(folded["kinds.bias"]) if "kinds.bias" in folded else 1
    parameters = MarkingNet(config, classes).fold().state_dict()
    for name, value in parameters.items():
        if name not in folded or folded[name].shape != value.shape:
            raise ConfigError(f"the file to start from has no weight {name} of shape {tuple(value.shape)}")
    net = MarkingNet(config, classes).eval()
    norms = {name: module[1] for name, module in net.named_modules() if isinstance(module, ConvNormRelu)}
    shifts = {f"{name}.0.bias": f"{name}.1.bias" for name in norms}
    state = net.state_dict()
    state |= {shifts.get(name, name): value for name, value in folded.items() if name in parameters}
    for name in norms:
        convolution = f"{name}.0.weight"
        scale = _GROWTH * _size(parameters[convolution]).mean() / _size(folded[convolution]).clamp(min=1e-6)
        state[convolution] = folded[convolution] * scale
        state[f"{name}.1.weight"] = 1 / scale.flatten()
    net.load_state_dict(state)
    moments = [_Moments(norm) for norm in norms.values()]
    for image in images:
        net(image)
    for moment in moments:
        moment.into_norm()
    return net.state_dict()


def _size(convolution: Tensor) -> Tensor:
    """Norm (outputs, 1, 1, 1) of the weights of each output."""
    return convolution.flatten(1).norm(dim=1)[:, None, None, None]


class _Moments:
    """Mean and variance of each channel of what a normalisation is given."""

    def __init__(self, norm: nn.BatchNorm2d) -> None:
        self._norm = norm
        self._sums = torch.zeros((3, norm.num_features), dtype=torch.float64)
        norm.running_var.fill_(1 - norm.eps)  # with a mean of 0: nothing but scale and shift
        self._hook = norm.register_forward_pre_hook(self._add)

    def _add(self, _norm: nn.Module, inputs: tuple[Tensor]) -> None:
        channels = inputs[0].detach().double().transpose(0, 1).flatten(1)
        powers = torch.ones_like(channels), channels, channels**2
        self._sums += torch.stack([power.sum(dim=1) for power in powers])

    def into_norm(self) -> None:
        """Make them the normalisation's statistics; what it computes stays the same."""
        self._hook.remove()
        count, total, squares = self._sums
        mean = total / count
        variance = (squares / count - mean**2).clamp(min=0)
        norm = self._norm
        norm.bias += mean * norm.weight
        norm.weight *= torch.sqrt(variance + norm.eps)
        norm.running_mean.copy_(mean)
        norm.running_var.copy_(variance)
