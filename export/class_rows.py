"""A rounded file with the classes that a training added: all else in it stays, bit by bit.

The layers that name classes are not rounded. A network that differs from the one in a rounded file in these
alone needs no new rounding, which would move outlines and lanes by chance.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor

from export.onnx_file import write_labelled
from export.source import Source
from train.exported import read_exported
from train.growth import CLASS_CHANNELS
from v2hdm.errors import DetectorError

_ALIKE = {"rtol": 1e-4, "atol": 1e-5}
"""How near two weights are that are the same: a normalisation was folded into them once more. Chosen."""


def add_classes(rounded: Path, float_file: Path, source: Source, output: Path) -> None:
    """Write a rounded file with the classes of another network; see :func:`with_class_rows`.

    The label is that of the network, but says how near the rounded file is to its own.

    Args:
        rounded: The file of int8.
        float_file: The float32 file that it was made of.
        source: The network whose classes it is to know.
        output: Is written whole or not at all.

    Raises:
        ConfigError: A file is none of `python -m export`, or the output cannot be written.
        DetectorError: The networks differ in more than the channels of classes.
    """
    before = read_exported(float_file).weights
    label = read_exported(rounded).label
    model = with_class_rows(onnx.load_model(str(rounded)), before, source, rounded)
    rounding = {key: label[key] for key in ("precision", "parity", "int8") if key in label}
    write_labelled(model, source.label | rounding, output)


def with_class_rows(
    rounded: onnx.ModelProto, before: Mapping[str, Tensor], source: Source, path: Path
) -> onnx.ModelProto:
    """The rounded network with the channels of classes of another one.

    Args:
        rounded: A file of int8.
        before: The weights that it was made of, float32, folded.
        source: The network whose classes it is to know; only what reads classes off may differ.
        path: Of the rounded file, for errors.

    Raises:
        DetectorError: The networks differ in more than the channels of classes.
    """
    wanted = deepcopy(source.net).fold().state_dict()
    for name, value in wanted.items():
        known = before.get(name)
        is_alike = known is not None and known.shape == value.shape and torch.allclose(known, value, **_ALIKE)
        if name not in CLASS_CHANNELS and not is_alike:
            raise DetectorError(
                f"{path} cannot be kept: {name} of the network is another one, not the channels of classes "
                "alone; leave out --keep network to round it anew"
            )
    model = onnx.ModelProto()
    model.CopyFrom(rounded)
    for tensor in model.graph.initializer:
        if tensor.name in CLASS_CHANNELS:
            stored = numpy_helper.to_array(tensor)
            rows = _rows(stored, before[tensor.name].numpy(), wanted[tensor.name].numpy())
            tensor.CopyFrom(numpy_helper.from_array(rows, tensor.name))
    for value in model.graph.output:
        if value.name == "kinds":
            value.type.tensor_type.shape.dim[1].dim_value = len(source.label["classes"])
    del model.graph.value_info[:]
    onnx.checker.check_model(model)
    return model


def _rows(stored: np.ndarray, before: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The weights (K, ...) in the scale of the file, whose inputs are scaled to be rounded well.

    Rows that are as they were ``before`` stay as ``stored``.
    """
    if stored.ndim == 1:
        scale = np.ones(1)
    else:
        scale = (stored * before).sum(axis=0) / np.maximum(np.square(before).sum(axis=0), 1e-12)
    rows = (wanted * scale).astype(np.float32)
    known = len(stored)
    is_kept = np.array([np.allclose(wanted[k], before[k], **_ALIKE) for k in range(known)])
    rows[:known][is_kept] = stored[is_kept]
    return rows
