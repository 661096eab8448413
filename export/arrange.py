"""The int8 graph in an order that onnxruntime computes fast; what it says stays the same.

onnxruntime's integer convolutions want the channels of a pixel side by side, while a graph of convolutions
says that those of a channel are. It turns its tensors round and leaves out the turns that cancel. So three
things are written here as they are fast on such tensors, which takes a quarter of the network's time off it:

- Its ``Resize`` doubles features value by value. Here each pixel is put beside itself, which is half of it,
  and each row is added to both rows of its pair, which is the other half.
- A last convolution of one pixel is a product of matrices. As a convolution its floats would be turned twice.
- A convolution of one channel at twice the resolution reads what was brought there first, and computes as if
  there were sixteen channels. A transposed convolution does both at once, where the tensor is small.

Weights keep their names and shapes: what is made of them onnxruntime works out when it loads the file.
"""

from __future__ import annotations

from itertools import count
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from export.graph import Graph

_CHANNELS_LAST = [0, 2, 3, 1]  # places of (n, c, h, w) that make (n, h, w, c)
_CHANNELS_FIRST = [0, 3, 1, 2]  # places of (n, h, w, c) that make (n, c, h, w)

_TO_FINER = ["Reshape", "Transpose", "Reshape", "Transpose", "Reshape"]
"""The nodes that turn four channels into one of twice the resolution."""


def arrange(graph: Graph) -> None:
    """Rewrite a graph whose tensors go through bytes, as :func:`export.int8.to_int8` makes it."""
    work = _Arranger(graph)
    for node in list(graph.nodes):
        match node.op_type:
            case "QuantizeLinear":
                work.add_doubled(node)
            case "Add" if node.output[0] in graph.outputs:
                work.read_off_twice(node)
            case "Conv" if node.output[0] in graph.outputs:
                work.read_off(node)
                work.read_off_finer(node)
    work.drop_unused()


class _Arranger:
    """Puts other nodes in the place of some; what nothing reads any more stays until it is dropped."""

    def __init__(self, graph: Graph):
        self._graph = graph.model.graph
        self._maker = {name: node for node in self._graph.node for name in node.output}
        self._constants = {tensor.name: tensor for tensor in self._graph.initializer}
        self._written: list[onnx.NodeProto] = []
        self._numbers = count()

    def add_doubled(self, encode: onnx.NodeProto) -> None:
        """Where bytes are made of a sum with what was doubled: without a tensor of the doubled."""
        total = self._maker[encode.input[0]]
        steps = ["DequantizeLinear", "QuantizeLinear", "Resize"]
        small = (self._behind(name, steps) for name in total.input)
        large = reversed(total.input)
        pairs = [pair for pair in zip(small, large, strict=True) if total.op_type == "Add" and pair[0]]
        if not pairs:
            return
        coarse, fine = (self._maker[name] for name in pairs[0])
        coarse_bytes, fine_bytes = (
            self._write("Transpose", [decode.input[0]], perm=_CHANNELS_LAST) for decode in (coarse, fine)
        )
        parts = zip(self._in_pairs(coarse_bytes, fine_bytes), (coarse, fine), strict=True)
        decoded = [self._write("DequantizeLinear", [rows, *decode.input[1:]]) for rows, decode in parts]
        coded = self._write("QuantizeLinear", [self._write("Add", decoded), *encode.input[1:]])
        shaped = self._write("Reshape", [coded, self._write("Shape", [fine_bytes])])
        self._write("Transpose", [shaped], encode.output[0], perm=_CHANNELS_FIRST)
        self._put_in_place_of(encode)

    def read_off_twice(self, total: onnx.NodeProto) -> None:
        """An output that is the sum of two convolutions of one pixel, the second of them doubled."""
        fine = total.input[0]
        coarse = self._behind(total.input[1], ["Resize"])
        convolutions = [self._maker.get(name) for name in (fine, coarse or "")]
        if not all(conv is not None and self._is_of_one_pixel(conv) for conv in convolutions):
            return
        fine, coarse = (self._products(conv) for conv in convolutions if conv is not None)
        # There are four times fewer of the coarse to add both biases to.
        bias = self._write("Add", [conv.input[2] for conv in convolutions if conv is not None])
        rows = self._write("Add", list(self._in_pairs(self._write("Add", [coarse, bias]), fine)))
        shaped = self._write("Reshape", [rows, self._write("Shape", [fine])])
        self._write("Transpose", [shaped], total.output[0], perm=_CHANNELS_FIRST)
        self._put_in_place_of(total)

    def read_off(self, conv: onnx.NodeProto) -> None:
        """An output that is a convolution of one pixel."""
        if self._is_of_one_pixel(conv):
            turned = self._write("Transpose", [self._products(conv)], perm=_CHANNELS_FIRST)
            bias = self._write("Unsqueeze", [conv.input[2], self._constant([1, 2])])
            self._write("Add", [turned, bias], conv.output[0])
            self._put_in_place_of(conv)

    def read_off_finer(self, conv: onnx.NodeProto) -> None:
        """An output that is a convolution of 3 x 3 finer pixels."""
        features = self._behind(conv.input[0], _TO_FINER)
        if features is None:
            return
        weight = numpy_helper.to_array(self._constants[conv.input[1]])
        flat = self._write("Reshape", [conv.input[1], self._constant([-1])])
        padded = self._write("Concat", [flat, self._constant(np.zeros(1, np.float32))], axis=0)
        transposed = self._write("Gather", [padded, self._constant(_places(weight))], axis=0)
        shape = {"kernel_shape": [4, 4], "strides": [2, 2], "pads": [1, 1, 1, 1]}
        self._write("ConvTranspose", [features, transposed, conv.input[2]], conv.output[0], **shape)
        self._put_in_place_of(conv)

    def drop_unused(self) -> None:
        """Leave out whatever no output needs."""
        needed = {value.name for value in self._graph.output}
        used = []
        for node in reversed(self._graph.node):
            if needed.intersection(node.output):
                needed.update(node.input)
                used.append(node)
        for whole, part in (
            (self._graph.node, used[::-1]),
            (self._graph.initializer, [t for t in self._graph.initializer if t.name in needed]),
        ):
            part = list(part)
            del whole[:]
            whole.extend(part)

    def _in_pairs(self, coarse: str, fine: str) -> tuple[str, str]:
        """Tensors (1, h, w, c) and (1, 2h, 2w, c) as (h, 1, 2wc) and (h, 2, 2wc), the first one doubled."""
        beside = self._write("Concat", [coarse, coarse], axis=3)
        doubled, unpaired = (
            self._write("Unsqueeze", [self._write("Flatten", [name], axis=2), self._constant([1])])
            for name in (beside, fine)
        )
        return doubled, self._write("Reshape", [unpaired, self._constant([-1, 2, 0])])

    def _products(self, conv: onnx.NodeProto) -> str:
        """The output of a convolution of one pixel before its bias, channels last."""
        decode = self._maker[conv.input[0]]
        pixels = self._write("Transpose", [decode.input[0]], perm=_CHANNELS_LAST)
        values = self._write("DequantizeLinear", [pixels, *decode.input[1:]])
        matrix = self._write("Flatten", [conv.input[1]], axis=1)
        return self._write("MatMul", [values, self._write("Transpose", [matrix], perm=[1, 0])])

    def _is_of_one_pixel(self, conv: onnx.NodeProto) -> bool:
        """Whether it is a convolution of 1 x 1 that computes with floats on what comes from bytes."""
        if conv.op_type != "Conv" or conv.input[1] not in self._constants:
            return False
        decode = self._maker.get(conv.input[0])
        kernel = tuple(self._constants[conv.input[1]].dims[2:])
        return kernel == (1, 1) and decode is not None and decode.op_type == "DequantizeLinear"

    def _behind(self, name: str, steps: list[str]) -> str | None:
        """The steps of this kind that make a tensor, the last first; None if it is made otherwise."""
        for step in steps:
            node = self._maker.get(name)
            if node is None or node.op_type != step:
                return None
            name = node.input[0]
        return name

    def _constant(self, values: list[int] | NDArray[Any]) -> str:
        """A constant of the graph; shapes and axes, which are given as lists, are shared."""
        array = np.asarray(values)
        name = f"arranged.shape.{values}" if isinstance(values, list) else self._new_name()
        if name not in self._constants:
            self._constants[name] = self._graph.initializer.add()
            self._constants[name].CopyFrom(numpy_helper.from_array(array, name))
        return name

    def _write(self, op: str, inputs: list[str], output: str | None = None, **attributes: Any) -> str:
        name = output or self._new_name()
        self._written.append(helper.make_node(op, inputs, [name], name=f"{name}.{op}", **attributes))
        return name

    def _new_name(self) -> str:
        return f"arranged.{next(self._numbers)}"

    def _put_in_place_of(self, old: onnx.NodeProto) -> None:
        place = list(self._graph.node).index(old)
        self._graph.node.remove(old)
        for node in reversed(self._written):
            self._graph.node.insert(place, node)
        self._maker |= {name: node for node in self._written for name in node.output}
        self._written.clear()


def _places(weight: NDArray[np.float32]) -> NDArray[np.int64]:
    """Where in a weight (1, C, 3, 3), flat and with a zero at its end, that of the transposed one comes from.

    That is (4C, 1, 4, 4) with stride 2: an input pixel reaches the 4 x 4 finer ones about its own four, which
    its channels hold one by one, row by row; each of those has its 3 x 3 of them, from the other side.
    """
    places = np.full((weight.shape[1], 2, 2, 4, 4), weight.size, dtype=np.int64)
    from_other_side = np.arange(weight.size).reshape(weight.shape[1:])[:, ::-1, ::-1]
    for row in range(2):
        for column in range(2):
            places[:, row, column, row : row + 3, column : column + 3] = from_other_side
    return places.reshape(-1, 1, 4, 4)
