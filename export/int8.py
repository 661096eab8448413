"""The network with 8-bit integers inside: a third of the file, and less time where a CPU multiplies bytes.

The graph stays one of plain ONNX: every convolution but the last of each output reads weights and inputs
through ``DequantizeLinear``, and what it computes goes through ``QuantizeLinear`` (the "QDQ" form, of which
onnxruntime makes integer kernels). Images are bytes already, so the first layer reads them as they are.
Outputs are left in float32, and so is what makes them of the last features: an outline between pixels, and
the place of a lane within its cell, would show the steps.

Weights have 7 bits, -64 to 64. CPUs with AVX2 or AVX-512 but without VNNI add products of two bytes in 16
bits that saturate at 32767; 2 * 255 * 64 = 32640 cannot, so every machine computes the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from export.arrange import arrange
from export.equalise import equalise
from export.graph import Convolution, FloatTensor, Graph
from export.rounding import Moments, input_moments, round_weights
from v2hdm.errors import DetectorError

HIGHEST_WEIGHT = 64
"""Weights are integers from minus this to this."""

_HIGHEST_INPUT = 255  # highest value of a byte

_ROWS = slice(None, None, 4)
"""Share of an output's rows that the correlation of its inputs is estimated from."""

_BYTES = "{}.bytes"
_SCALE = "{}.scale"
_ZERO = "{}.zero"


@dataclass(frozen=True)
class _Coding:
    """A tensor as bytes: ``value = scale * (byte - zero)``."""

    scale: np.float32
    zero: np.uint8


@dataclass(frozen=True)
class _Image:
    """Where the graph turns bytes of the image into numbers: the steps of it, and the same as a coding."""

    bytes_name: str
    steps: list[onnx.NodeProto]
    coding: _Coding

    @property
    def output(self) -> str:
        return str(self.steps[-1].output[0])


def to_int8(model: onnx.ModelProto, images: Sequence[NDArray[np.uint8]]) -> onnx.ModelProto:
    """Make the int8 network of a float one.

    Args:
        model: As :func:`export.onnx_file.to_onnx` makes it; it is left as it is.
        images: What the network is to be shown, (H, W, 3) uint8 BGR: ranges and weights are fitted to them.

    Returns:
        A model with the same inputs, outputs and properties. The weights of its convolutions are the outputs
        of ``DequantizeLinear`` nodes, by the names that they had.

    Raises:
        DetectorError: There are no images.
    """
    if not images:
        raise DetectorError("int8 needs images to fit ranges to: set int8.frames to 1 or more")
    graph = Graph(model)
    image = _image_input(graph)
    equalise(graph, images)
    fine = _fine(graph)
    coarse = [conv for conv in graph.convolutions if conv.output not in fine]
    codings = _codings(graph, images, fine)
    codings[image.output] = image.coding
    moments = _moments(graph, coarse, images)
    for conv in coarse:
        _round(graph, conv, codings[conv.input], moments[conv.weight])
    _read_bytes(graph, image)
    del codings[image.output]
    _through_bytes(graph, codings)
    arrange(graph)
    result = graph.stored()
    onnx.checker.check_model(result)
    return result


def _image_input(graph: Graph) -> _Image:
    """Find the cast of the image to float, and the shift and scale that come after it."""
    cast = next(node for node in graph.nodes if node.op_type == "Cast")
    (shift,) = (node for node in graph.nodes if cast.output[0] in node.input)
    (gain,) = (node for node in graph.nodes if shift.output[0] in node.input)
    assert (shift.op_type, gain.op_type) == ("Sub", "Mul")
    zero = graph.weights[shift.input[1]].item()
    scale = graph.weights[gain.input[1]].item()
    assert zero == np.uint8(zero), "grey values are shifted by a whole number"
    return _Image(cast.input[0], [cast, shift, gain], _Coding(np.float32(scale), np.uint8(zero)))


def _fine(graph: Graph) -> set[str]:
    """Names of the outputs, and of what is added up to them after the last convolutions."""
    fine = {*graph.outputs}
    for node in reversed(list(graph.nodes)):
        if node.output[0] in fine and node.op_type in ("Add", "Resize"):
            fine |= {name for name in node.input if name}
    return fine


def _codings(graph: Graph, images: Sequence[NDArray[np.uint8]], fine: set[str]) -> dict[str, _Coding]:
    """The codings of all tensors that go through bytes, by their names."""
    not_coded = fine | {node.input[0] for node in graph.nodes if node.op_type == "Relu"}
    through = ("Conv", "Relu", "Add", "Resize")
    names = [n.output[0] for n in graph.nodes if n.op_type in through and n.output[0] not in not_coded]
    low: dict[str, float] = dict.fromkeys(names, 0.0)
    high: dict[str, float] = dict.fromkeys(names, 0.0)
    for values in graph.run(names, images):
        for name, value in values.items():
            low[name], high[name] = min(low[name], float(value.min())), max(high[name], float(value.max()))
    return {name: _coding(low[name], high[name]) for name in names}


def _coding(low: float, high: float) -> _Coding:
    scale = max(high - low, 1e-6) / _HIGHEST_INPUT
    return _Coding(np.float32(scale), np.uint8(round(-low / scale)))


def _moments(
    graph: Graph, convolutions: list[Convolution], images: Sequence[NDArray[np.uint8]]
) -> dict[str, Moments]:
    """:func:`input_moments` of every convolution, by the names of their weights."""
    sums: dict[str, Moments] = {}
    for inputs in graph.run([conv.input for conv in convolutions], images):
        for conv in convolutions:
            moments = input_moments(conv, inputs[conv.input], _ROWS)
            sums[conv.weight] = sums[conv.weight] + moments if conv.weight in sums else moments
    return sums


def _round(graph: Graph, conv: Convolution, coding: _Coding, moments: Moments) -> None:
    """Make a convolution read rounded weights and a bias in 32 bits, each by the name that it had."""
    rounded = round_weights(
        graph.weights.pop(conv.weight), graph.weights.pop(conv.bias), moments, HIGHEST_WEIGHT
    )
    bias_scale = (rounded.scale * coding.scale).astype(np.float32)
    whole_bias = np.clip(np.round(rounded.bias / bias_scale.astype(np.float64)), -(2**31) + 1, 2**31 - 1)
    _remove_initializers(graph, {conv.weight, conv.bias})
    _dequantized(graph, conv.weight, rounded.whole, rounded.scale)
    _dequantized(graph, conv.bias, whole_bias.astype(np.int32), bias_scale)


def _remove_initializers(graph: Graph, names: set[str]) -> None:
    tensors = graph.model.graph.initializer
    others = [tensor for tensor in tensors if tensor.name not in names]
    del tensors[:]
    tensors.extend(others)


def _dequantized(graph: Graph, name: str, whole: NDArray[np.integer], scale: FloatTensor) -> None:
    """A constant tensor as integers with a scale for each output."""
    whole_name = _BYTES.format(name)
    scale_name = _SCALE.format(name)
    graph.model.graph.initializer.extend(
        [numpy_helper.from_array(whole, whole_name), numpy_helper.from_array(scale, scale_name)]
    )
    node = helper.make_node(
        "DequantizeLinear", [whole_name, scale_name], [name], name=f"{name}.float", axis=0
    )
    graph.model.graph.node.insert(0, node)


def _read_bytes(graph: Graph, image: _Image) -> None:
    """Let the first convolution read the bytes of the image themselves."""
    nodes = graph.model.graph.node
    place = list(nodes).index(image.steps[0])
    for step in image.steps:
        nodes.remove(step)
    nodes.insert(place, _decode(graph, image.bytes_name, image.output, image.coding))


def _through_bytes(graph: Graph, codings: dict[str, _Coding]) -> None:
    """Send tensors through bytes on their way to all that reads them."""
    nodes = list(graph.nodes)
    del graph.model.graph.node[:]
    for node in nodes:
        for index, name in enumerate(node.input):
            if name in codings:
                node.input[index] = f"{name}.coded"
        graph.model.graph.node.append(node)
        name = node.output[0]
        if name in codings:
            code = _decode(graph, _BYTES.format(name), f"{name}.coded", codings[name])
            encode = helper.make_node(
                "QuantizeLinear", [name, *code.input[1:]], [code.input[0]], name=f"{name}.encode"
            )
            graph.model.graph.node.extend([encode, code])


def _decode(graph: Graph, source: str, output: str, coding: _Coding) -> onnx.NodeProto:
    scale = _SCALE.format(output)
    zero = _ZERO.format(output)
    graph.model.graph.initializer.extend(
        [
            numpy_helper.from_array(np.asarray(coding.scale), scale),
            numpy_helper.from_array(np.asarray(coding.zero), zero),
        ]
    )
    return helper.make_node("DequantizeLinear", [source, scale, zero], [output], name=f"{output}.decode")
