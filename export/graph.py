"""An ONNX graph of convolutions as what is made int8 from it needs to see it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cached_property

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

FloatTensor = NDArray[np.float32]


class Convolution:
    """A convolution of the graph: the names of what it reads and writes, and how it is shaped."""

    def __init__(self, node: onnx.NodeProto):
        self.node = node
        self.input, self.weight, self.bias = node.input
        self.output = node.output[0]
        attributes = {a.name: helper.get_attribute_value(a) for a in node.attribute}
        self.depthwise = attributes.get("group", 1) > 1
        self.kernel = tuple(attributes["kernel_shape"])
        self.stride = tuple(attributes.get("strides", (1, 1)))
        self.dilation = tuple(attributes.get("dilations", (1, 1)))
        self.padding = tuple(attributes.get("pads", (0, 0, 0, 0))[:2])


class Graph:
    """A model whose weights can be read and changed by their names.

    Args:
        model: As `python -m export` writes it; it is copied.
    """

    def __init__(self, model: onnx.ModelProto):
        self.model = onnx.ModelProto()
        self.model.CopyFrom(model)
        self.weights: dict[str, FloatTensor] = {
            tensor.name: numpy_helper.to_array(tensor).copy()
            for tensor in model.graph.initializer
            if tensor.data_type == TensorProto.FLOAT
        }

    @property
    def nodes(self) -> Iterable[onnx.NodeProto]:
        """In the order in which they are computed."""
        return self.model.graph.node

    @cached_property
    def convolutions(self) -> list[Convolution]:
        """In the order in which they are computed."""
        return [Convolution(node) for node in self.nodes if node.op_type == "Conv"]

    @property
    def outputs(self) -> list[str]:
        """Names of what the model gives."""
        return [value.name for value in self.model.graph.output]

    def stored(self) -> onnx.ModelProto:
        """The model with the weights as they are now."""
        for tensor in self.model.graph.initializer:
            if tensor.name in self.weights:
                tensor.CopyFrom(numpy_helper.from_array(self.weights[tensor.name], tensor.name))
        return self.model

    def run(
        self, names: Iterable[str], images: Iterable[NDArray[np.uint8]]
    ) -> Iterator[dict[str, FloatTensor]]:
        """The tensors ``names``, inner ones too, for each of some images (H, W, 3)."""
        names = list(dict.fromkeys(names))
        watched = onnx.ModelProto()
        watched.CopyFrom(self.stored())
        already_out = {*self.outputs}
        for name in names:
            if name not in already_out:
                watched.graph.output.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, None))
        session = open_session(watched.SerializeToString())
        for image in images:
            yield dict(zip(names, session.run(names, {"image": image[None]}), strict=True))


def open_session(content: bytes) -> onnxruntime.InferenceSession:
    """A model's session on one CPU thread, as the vehicle runs it."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
