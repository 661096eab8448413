"""Channels brought to one range, so that one scale of 8 bits serves all channels of a tensor.

A channel may be divided by any positive number where it is computed if the weights that read it are
multiplied by the same: the function stays what it was (Nagel et al., "Data-Free Quantization Through Weight
Equalization and Bias Correction", ICCV 2019). Left as trained, the channels of one tensor differ in range by
twenty times, and the small ones drown in the rounding of the large ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from export.graph import Convolution, FloatTensor, Graph

_THROUGH = ("Relu", "Resize", "Add")
"""Operators that commute with scaling a channel in all their inputs and outputs."""

_LEAST = 1e-3
"""A channel that stays below this share of the largest says nothing on the images seen, and is left alone."""


@dataclass
class _Group:
    """Tensors whose channels can only be scaled together, and the convolutions that write and read them."""

    tensors: list[str] = field(default_factory=list)
    writers: list[Convolution] = field(default_factory=list)
    readers: list[Convolution] = field(default_factory=list)


def equalise(graph: Graph, images: Sequence[NDArray[np.uint8]]) -> None:
    """Bring the channels of each inner tensor to one range, as seen on ``images``; outputs stay the same."""
    groups = _groups(graph)
    ranges: dict[str, FloatTensor] = {}
    for values in graph.run([name for group in groups for name in group.tensors], images):
        for name, value in values.items():
            highest = np.abs(value[0]).max(axis=(1, 2))
            ranges[name] = np.maximum(ranges.get(name, highest), highest)
    for group in groups:
        scale = _scale(np.max([ranges[name] for name in group.tensors], axis=0))
        for conv in group.writers:
            graph.weights[conv.weight] /= scale[:, None, None, None]
            graph.weights[conv.bias] /= scale
        for conv in group.readers:
            along_inputs = (slice(None), None) if conv.depthwise else (None, slice(None))
            graph.weights[conv.weight] *= scale[(*along_inputs, None, None)]


def _scale(ranges: FloatTensor) -> FloatTensor:
    """The divisor of each channel; 1 in the geometric mean, and 1 for channels that are as good as 0."""
    alive = ranges > _LEAST * ranges.max()
    scale = np.ones_like(ranges)
    if alive.any():
        scale[alive] = ranges[alive] / np.exp(np.log(ranges[alive]).mean())
    return scale


def _groups(graph: Graph) -> list[_Group]:
    """The groups that only convolutions and operators linear in every channel touch."""
    parent: dict[str, str] = {}

    def root(name: str) -> str:
        while parent.setdefault(name, name) != name:
            name = parent[name]
        return name

    for node in graph.nodes:
        if node.op_type in _THROUGH:
            for name in node.input:
                if name and name not in graph.weights:
                    parent[root(name)] = root(node.output[0])
    groups: dict[str, _Group] = {}
    for conv in graph.convolutions:
        groups.setdefault(root(conv.output), _Group()).writers.append(conv)
        groups.setdefault(root(conv.input), _Group()).readers.append(conv)
    others = {name for node in graph.nodes if node.op_type not in (*_THROUGH, "Conv") for name in node.input}
    for name in list(parent):
        groups.setdefault(root(name), _Group()).tensors.append(name)
    fixed = {root(name) for name in (*others, *graph.outputs)}
    # What a ReLU reads is never rounded; only what comes out of it has a range to speak of.
    inside = {node.input[0] for node in graph.nodes if node.op_type == "Relu"}
    for group in groups.values():
        group.tensors = [name for name in group.tensors if name not in inside]
    return [g for name, g in groups.items() if name not in fixed and g.writers and g.readers]
