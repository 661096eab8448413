"""The network as an ONNX file: any size, weights inside, checked against torch, labelled."""

from __future__ import annotations

import json
import logging
import warnings
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray

from export.calibration import looks
from export.config import Int8Config
from export.int8 import to_int8
from export.parity import Parity, int8_parity, largest_difference
from export.source import STRIDES, Source, of_checkpoint, weights_not_finite
from models import MarkingNet, Prediction
from models.marking_net import MULTIPLE
from train.bar import Share
from train.checkpoint import Checkpoint
from v2hdm.detection.network import METADATA_KEY
from v2hdm.errors import ConfigError, DetectorError
from v2hdm.store.files import whole_file

_PARITY_SEED_OFFSET = 1_000_003  # distance of the seeds that a file is checked with from those of its making
_FITTING = 0.15
"""Share of the time of an int8 export that does not go into its renders, about."""


def export_checkpoint(checkpoint: Checkpoint, path: Path, opset: int, tolerance: float) -> float:
    """:func:`export_float` of the averaged weights of a checkpoint."""
    return export_float(of_checkpoint(checkpoint), path, opset, tolerance)


def export_float(source: Source, path: Path, opset: int, tolerance: float) -> float:
    """Write a network to an ONNX file that computes in float32.

    The graph takes ``image`` (1, H, W, 3) uint8 BGR, H and W multiples of 16, and gives the outputs of
    :class:`models.Prediction` by their names. The file appears whole and checked, or not at all.

    Returns:
        The largest difference of an output between file and network over
        :data:`export.parity.PARITY_SIZES`.

    Raises:
        DetectorError: The difference exceeds ``tolerance``, or weights are not finite.
    """
    model = _checked(source, path, opset)
    difference = largest_difference(source.net, model.SerializeToString())
    if not difference <= tolerance:
        raise DetectorError(
            f"{path} was not written: its outputs would differ from the network's by {difference:.2g}, "
            f"more than tolerance={tolerance:g}; try another opset"
        )
    write_labelled(model, source.label | {"precision": "float32", "parity": {"difference": difference}}, path)
    return difference


def export_int8(source: Source, path: Path, opset: int, config: Int8Config, tell: Share) -> Parity:
    """Write a network to an ONNX file that computes with bytes; see :mod:`export.int8`.

    Inputs, outputs and label are those of :func:`export_float`.

    Returns:
        How near it is to the network, on renders that it was not fitted to.

    Raises:
        DetectorError: A figure of that is beyond its bound, weights are not finite, or there are no renders.
    """
    model = _checked(source, path, opset)
    if config.frames < 1 or config.parity_frames < 1:
        raise DetectorError("int8.frames and int8.parity_frames must be 1 or more: int8 is fitted to renders")
    total = config.frames + config.parity_frames
    share = (1 - _FITTING) / total
    fitted = _images(config.seed, config.frames, tell, 0.0, share)
    unseen = _images(
        config.seed + _PARITY_SEED_OFFSET, config.parity_frames, tell, share * config.frames, share
    )
    tell(1 - _FITTING, "fitting ranges and weights")
    model = to_int8(model, fitted)
    parity = int8_parity(source.net, model.SerializeToString(), unseen)
    beyond = parity.beyond(asdict(config.bounds))
    if beyond:
        raise DetectorError(
            f"{path} was not written: on renders, int8 changes what the network says too much: "
            f"{', '.join(beyond)}; give more int8.frames, or export with precision=float32"
        )
    figures = {name: round(value, 4) for name, value in asdict(parity).items()}
    fitting = {"frames": config.frames, "seed": config.seed, "parity_frames": config.parity_frames}
    write_labelled(model, source.label | {"precision": "int8", "parity": figures, "int8": fitting}, path)
    tell(1.0, "written")
    return parity


def to_onnx(net: MarkingNet, opset: int) -> onnx.ModelProto:
    """The graph of a network, its height and width left open."""
    rows = torch.export.Dim("rows", min=1, max=512)
    columns = torch.export.Dim("columns", min=1, max=512)
    image = torch.zeros((1, 5 * MULTIPLE, 7 * MULTIPLE, 3), dtype=torch.uint8)
    open_sizes = ({1: MULTIPLE * rows, 2: MULTIPLE * columns},)
    model = graph_of(net, {"image": image}, list(Prediction._fields), open_sizes, opset)
    _name_sizes(model)
    return model


def graph_of(
    module: torch.nn.Module,
    inputs: dict[str, torch.Tensor],
    outputs: list[str],
    open_sizes: tuple[dict[int, Any], ...],
    opset: int,
) -> onnx.ModelProto:
    """The checked graph of a module, weights inside, without a word of where it was made.

    Args:
        module: ready to be asked.
        inputs: by name, examples of what its ``forward`` takes, in order.
        outputs: names of what it gives.
        open_sizes: of each input, which axes may have any size, as ``torch.export.Dim``.
        opset: ONNX operator set.
    """
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            module,
            tuple(inputs.values()),
            dynamo=True,
            opset_version=opset,
            input_names=list(inputs),
            output_names=outputs,
            dynamic_shapes=open_sizes,
            external_data=False,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto  # another copy each time that it is asked for
    _forget_source(model)
    onnx.checker.check_model(model)
    return model


def _checked(source: Source, path: Path, opset: int) -> onnx.ModelProto:
    """The float32 graph of a network whose weights are all finite."""
    broken = weights_not_finite(source.net)
    if broken:
        raise DetectorError(
            f"{path} was not written: {broken[0]} of the checkpoint holds values that are not finite; "
            "export an earlier checkpoint"
        )
    return to_onnx(deepcopy(source.net).fold(), opset)


def _images(seed: int, frames: int, tell: Share, start: float, share: float) -> list[NDArray[np.uint8]]:
    """All that the detector shows its network of some renders."""
    images: list[NDArray[np.uint8]] = []
    for index, images_of_frame in enumerate(looks(seed, frames)):
        images += images_of_frame
        tell(start + (index + 1) * share, "rendering what the detector looks at")
    return images


def write_labelled(model: onnx.ModelProto, label: dict[str, Any], path: Path) -> None:
    """Write a model with its label, whole or not at all."""
    onnx.helper.set_model_props(model, {METADATA_KEY: json.dumps(label)})
    try:
        with whole_file(path) as partial:
            partial.write_bytes(model.SerializeToString())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror}); name another file") from None


def _name_sizes(model: onnx.ModelProto) -> None:
    """Call the open sizes of input and output what they are, where the exporter leaves formulas."""
    names = {output: {2: f"height / {stride}", 3: f"width / {stride}"} for output, stride in STRIDES.items()}
    names["image"] = {1: "height", 2: "width"}
    for value in (*model.graph.input, *model.graph.output):
        for axis, name in names[value.name].items():
            value.type.tensor_type.shape.dim[axis].dim_param = name


def _forget_source(model: onnx.ModelProto) -> None:
    """Drop what the exporter notes of the source of each node: paths of the machine that it ran on."""
    for part in (*model.graph.node, *model.graph.value_info, *model.graph.initializer):
        del part.metadata_props[:]
        part.doc_string = ""
