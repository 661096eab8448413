"""A rounded layer with channels that a training added: those that it had stay, bit by bit.

The layer is the one before the classes are read off. It reads and writes bytes, so what is added is rounded
as well, and scaled to fill the bytes that the layer's output goes through.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from torch import Tensor

from export.int8 import HIGHEST_WEIGHT
from models import MarkingNet

HIDDEN = "wide_kinds.0.0"
"""Name of the convolution whose output channels a training may add to."""

_HIGHEST_BYTE = 255
_FILLED = 0.8
"""Share of the bytes' range that an added channel fills on the images shown. Chosen: others may show more."""

Array = NDArray[np.float32]


class Added(NamedTuple):
    """The channels (A,) that a training added to the layer, in float32."""

    weight: Array  # (A, C, 3, 3)
    bias: Array  # (A,)
    gain: Array  # (A,) factor that is hidden in weight and bias, to be undone by what reads the channels


def is_grown(before: Tensor, wanted: Tensor, tolerance: Mapping[str, float]) -> bool:
    """Whether ``wanted`` is ``before`` with more entries at the end of its first axis."""
    known = len(before)
    is_longer = len(wanted) > known and wanted.shape[1:] == before.shape[1:]
    return is_longer and torch.allclose(before, wanted[:known], **tolerance)


@torch.inference_mode()
def added_channels(net: MarkingNet, known: int, highest: float, images: Sequence[NDArray[np.uint8]]) -> Added:
    """The channels after the ``known`` ones, scaled so that images drive each nearly to ``highest``.

    Args:
        net: Folded.
        known: Channels that the rounded layer has.
        highest: Largest value that the bytes of the layer's output hold.
        images: (H, W, 3) uint8 BGR, heights and widths multiples of the network's.
    """
    assert net.wide_kinds is not None
    layer = net.wide_kinds[0]
    largest = torch.zeros(layer[0].out_channels)

    def note(_: object, __: object, output: Tensor) -> None:
        largest.copy_(torch.maximum(largest, output.amax(dim=(0, 2, 3))))

    hook = layer.register_forward_hook(note)
    for image in images:
        net(torch.from_numpy(image[None]))
    hook.remove()
    gain = (_FILLED * highest / largest[known:].clamp(min=1e-6)).numpy()
    weight = layer[0].weight[known:].numpy() * gain[:, None, None, None]
    return Added(weight, layer[0].bias[known:].numpy() * gain, gain)


def highest_output(model: onnx.ModelProto) -> float:
    """The largest value that the bytes of the layer's output hold."""
    readers = {name: node for node in model.graph.node for name in node.input}
    (convolution,) = (node for node in model.graph.node if f"{HIDDEN}.weight" in node.input)
    encode = readers[readers[convolution.output[0]].output[0]]
    scale = next(tensor for tensor in model.graph.initializer if tensor.name == encode.input[1])
    return float(numpy_helper.to_array(scale)) * _HIGHEST_BYTE


def append_channels(model: onnx.ModelProto, before: Array, read_gain: Array, added: Added) -> None:
    """Put channels behind those of the rounded layer, in place.

    Args:
        model: The rounded network.
        before: The layer's weights (N, C, 3, 3) in float32.
        read_gain: Factors (N,) in the rounded weights that read the layer's channels.
        added: The new channels.
    """
    tensors = {tensor.name: tensor for tensor in model.graph.initializer}
    whole, scale, bias, bias_scale = (
        numpy_helper.to_array(tensors[f"{HIDDEN}.{name}"])
        for name in ("weight.bytes", "weight.scale", "bias.bytes", "bias.scale")
    )
    # What the layer reads and gives is scaled channel by channel, to be rounded well.
    stored = whole * (scale * read_gain)[:, None, None, None]
    of_outputs = (0, 2, 3)
    input_gain = (stored * before).sum(axis=of_outputs) / np.square(before).sum(axis=of_outputs)
    weight = added.weight * input_gain[:, None, None]
    added_scale = (np.abs(weight).max(axis=(1, 2, 3)) / HIGHEST_WEIGHT).astype(np.float32)
    added_whole = np.round(weight / added_scale[:, None, None, None]).astype(np.int8)
    bytes_step = bias_scale[0] / scale[0]
    added_bias_scale = added_scale * bytes_step
    added_bias = np.round(added.bias / added_bias_scale).astype(np.int32)
    for name, had, more in (
        ("weight.bytes", whole, added_whole),
        ("weight.scale", scale, added_scale),
        ("bias.bytes", bias, added_bias),
        ("bias.scale", bias_scale, added_bias_scale),
    ):
        joined = np.concatenate([had, more.astype(had.dtype)])
        tensors[f"{HIDDEN}.{name}"].CopyFrom(numpy_helper.from_array(joined, f"{HIDDEN}.{name}"))
