"""A rounded file with the classes that a training added: all else in it stays, bit by bit.

The layers that name classes are not rounded. A network that differs from the one in a rounded file in these
alone needs no new rounding, which would move outlines and lanes by chance. So does one whose new classes read
channels of their own (:mod:`export.hidden_rows`): these are rounded and put behind the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from onnx import numpy_helper
from torch import Tensor

from export.calibration import looks
from export.hidden_rows import HIDDEN, added_channels, append_channels, highest_output, is_grown
from export.onnx_file import write_labelled
from export.source import Source
from train.exported import read_exported
from train.growth import CLASS_CHANNELS
from v2hdm.errors import DetectorError

_ALIKE = {"rtol": 1e-4, "atol": 1e-5}
"""How near two weights are that are the same: a normalisation was folded into them once more. Chosen."""

_RENDERS = 6
"""Renders that tell how far added channels reach. Chosen: two of each size of image."""
_SEED = 71  # of these renders

_READS_HIDDEN = "wide_kinds.1.weight"  # the weight whose second axis is that of the hidden layer's channels


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
    wanted = source.net.state_dict()
    is_larger = len(wanted.get(_READS_HIDDEN, before[_READS_HIDDEN])[0]) > len(before[_READS_HIDDEN][0])
    images = [image for look in looks(_SEED, _RENDERS) for image in look] if is_larger else []
    model = with_class_rows(onnx.load_model(str(rounded)), before, source, rounded, images)
    rounding = {key: label[key] for key in ("precision", "parity", "int8") if key in label}
    write_labelled(model, source.label | rounding, output)


def with_class_rows(
    rounded: onnx.ModelProto,
    before: Mapping[str, Tensor],
    source: Source,
    path: Path,
    images: Sequence[NDArray[np.uint8]] = (),
) -> onnx.ModelProto:
    """The rounded network with the channels of classes of another one.

    Args:
        rounded: A file of int8.
        before: The weights that it was made of, float32, folded.
        source: The network whose classes it is to know; only what reads classes off may differ, and channels
            may have been added before that.
        path: Of the rounded file, for errors.
        images: (H, W, 3) uint8 BGR that tell how far added channels reach; needed where there are any.

    Raises:
        DetectorError: The networks differ in more than the channels of classes.
    """
    net = deepcopy(source.net).fold()
    wanted = net.state_dict()
    _check_kept(before, wanted, path)
    model = onnx.ModelProto()
    model.CopyFrom(rounded)
    added = None
    known = len(before[f"{HIDDEN}.weight"])
    if len(wanted[f"{HIDDEN}.weight"]) > known:
        added = added_channels(net, known, highest_output(model), images)
        reader = next(tensor for tensor in model.graph.initializer if tensor.name == _READS_HIDDEN)
        gain = _input_gain(numpy_helper.to_array(reader), before[_READS_HIDDEN].numpy())
        append_channels(model, before[f"{HIDDEN}.weight"].numpy(), gain[:, 0, 0], added)
    for tensor in model.graph.initializer:
        if tensor.name in CLASS_CHANNELS:
            stored = numpy_helper.to_array(tensor)
            gain = added.gain if added is not None and tensor.name == _READS_HIDDEN else None
            rows = _rows(stored, before[tensor.name].numpy(), wanted[tensor.name].numpy(), gain)
            tensor.CopyFrom(numpy_helper.from_array(rows, tensor.name))
    for value in model.graph.output:
        if value.name == "kinds":
            value.type.tensor_type.shape.dim[1].dim_value = len(source.label["classes"])
    del model.graph.value_info[:]
    onnx.checker.check_model(model)
    return model


def _check_kept(before: Mapping[str, Tensor], wanted: Mapping[str, Tensor], path: Path) -> None:
    """Refuse a network that differs from the rounded one in more than what its added classes read."""
    for name, value in wanted.items():
        known = before.get(name)
        is_alike = known is not None and known.shape == value.shape and torch.allclose(known, value, **_ALIKE)
        is_longer = name.startswith(HIDDEN) and known is not None and is_grown(known, value, _ALIKE)
        if name not in CLASS_CHANNELS and not is_alike and not is_longer:
            raise DetectorError(
                f"{path} cannot be kept: {name} of the network is another one, not the channels of classes "
                "alone; leave out --keep network to round it anew"
            )


def _rows(
    stored: np.ndarray, before: np.ndarray, wanted: np.ndarray, input_gain: np.ndarray | None = None
) -> np.ndarray:
    """The weights (K, ...) in the scale of the file, whose inputs are scaled to be rounded well.

    Rows that are as they were ``before`` stay as ``stored``. Inputs that are new have their own
    ``input_gain`` (A,).
    """
    scale = np.ones(1) if stored.ndim == 1 else _input_gain(stored, before)
    if input_gain is not None:
        scale = np.concatenate([scale, (1 / input_gain)[:, None, None]])
        more = ((0, 0), (0, len(input_gain)), (0, 0), (0, 0))
        stored = np.pad(stored, more)
        before = np.pad(before, more)
    rows = (wanted * scale).astype(np.float32)
    known = len(stored)
    is_kept = np.array([np.allclose(wanted[k], before[k], **_ALIKE) for k in range(known)])
    rows[:known][is_kept] = stored[is_kept]
    return rows


def _input_gain(stored: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Factors (C, 1, 1) by which stored weights (K, C, 1, 1) differ from those before, input by input."""
    return np.asarray((stored * before).sum(axis=0) / np.maximum(np.square(before).sum(axis=0), 1e-12))
