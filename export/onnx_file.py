"""The network as an ONNX file: any size, weights inside, checked against torch, labelled."""

from __future__ import annotations

import json
import logging
import subprocess
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch

from models import MarkingNet, Prediction
from models.marking_net import KIND_STRIDE, LANE_STRIDE, MULTIPLE, PAINT_STRIDE
from train.checkpoint import Checkpoint
from v2hdm.detection.network import METADATA_KEY
from v2hdm.errors import DetectorError
from v2hdm.records import PAINT_CLASSES

_STRIDES = dict(zip(Prediction._fields, (PAINT_STRIDE, KIND_STRIDE, LANE_STRIDE), strict=True))

PARITY_SIZES = ((16, 16), (48, 112), (256, 448), (192, 1248), (544, 960))
"""Image heights and widths at which file and network are compared."""


def export_checkpoint(checkpoint: Checkpoint, path: Path, opset: int, tolerance: float) -> float:
    """Write the averaged weights of a checkpoint to an ONNX file.

    The graph takes ``image`` (1, H, W, 3) uint8 BGR, H and W multiples of 16, and gives the outputs of
    :class:`models.Prediction` by their names. The file appears whole and checked, or not at all.

    Returns:
        The largest difference of an output between file and network over :data:`PARITY_SIZES`.

    Raises:
        DetectorError: The difference exceeds ``tolerance``, or weights are not finite.
    """
    net = checkpoint.network()
    broken = [name for name, value in net.state_dict().items() if not torch.isfinite(value).all()]
    if broken:
        raise DetectorError(
            f"{path} was not written: {broken[0]} of the checkpoint holds values that are not finite; "
            "export an earlier checkpoint"
        )
    model = to_onnx(checkpoint.network().fold(), opset)
    onnx.helper.set_model_props(model, {METADATA_KEY: json.dumps(label(checkpoint))})
    content = model.SerializeToString()
    difference = parity(net, content)
    if not difference <= tolerance:
        raise DetectorError(
            f"{path} was not written: its outputs would differ from the network's by {difference:.2g}, "
            f"more than tolerance={tolerance:g}; try another opset"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    partial.write_bytes(content)
    partial.replace(path)
    return difference


def to_onnx(net: MarkingNet, opset: int) -> onnx.ModelProto:
    """The graph of a network, its height and width left open."""
    rows, columns = torch.export.Dim("rows", min=1, max=512), torch.export.Dim("columns", min=1, max=512)
    image = torch.zeros((1, 5 * MULTIPLE, 7 * MULTIPLE, 3), dtype=torch.uint8)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            net,
            (image,),
            dynamo=True,
            opset_version=opset,
            input_names=["image"],
            output_names=list(Prediction._fields),
            dynamic_shapes=({1: MULTIPLE * rows, 2: MULTIPLE * columns},),
            external_data=False,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    _name_sizes(model)
    _forget_source(model)
    onnx.checker.check_model(model)
    return model


def label(checkpoint: Checkpoint) -> dict[str, Any]:
    """What a reader of the file needs to know to run it, and where it comes from."""
    return {
        "classes": list(PAINT_CLASSES),
        "multiple": MULTIPLE,
        "strides": _STRIDES,
        "input": "uint8 BGR, NHWC",
        "commit": _commit(),
        "steps": checkpoint.step,
        "renders": checkpoint.renders,
        "training_minutes": round(checkpoint.elapsed_s / 60, 1),
        "metrics": {name: round(value, 4) for name, value in checkpoint.metrics.items()},
        "training": _without_paths(checkpoint.config),
    }


def parity(net: MarkingNet, content: bytes) -> float:
    """Largest difference of any output between a network and the ONNX file made of it."""
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    generator = np.random.default_rng(0)
    worst = 0.0
    for height, width in PARITY_SIZES:
        image = generator.integers(0, 256, (1, height, width, 3), dtype=np.uint8)
        with torch.inference_mode():
            prediction = net(torch.from_numpy(image))
        outputs = session.run(list(Prediction._fields), {"image": image})
        for output, expected in zip(outputs, prediction, strict=True):
            if output.shape != tuple(expected.shape):
                return float("inf")
            worst = max(worst, float(np.abs(output - expected.numpy()).max()))
    return worst


def _name_sizes(model: onnx.ModelProto) -> None:
    """Call the open sizes of input and output what they are, where the exporter leaves formulas."""
    names = {output: {2: f"height / {stride}", 3: f"width / {stride}"} for output, stride in _STRIDES.items()}
    names["image"] = {1: "height", 2: "width"}
    for value in (*model.graph.input, *model.graph.output):
        for axis, name in names[value.name].items():
            value.type.tensor_type.shape.dim[axis].dim_param = name


def _forget_source(model: onnx.ModelProto) -> None:
    """Drop what the exporter notes of the source of each node: paths of the machine that it ran on."""
    for part in (*model.graph.node, *model.graph.value_info, *model.graph.initializer):
        del part.metadata_props[:]
        part.doc_string = ""


def _without_paths(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a training less what says something of the machine that it ran on."""
    kept = {key: value for key, value in config.items() if key not in ("output", "device", "resume")}
    kept["start"] = kept.get("start") and Path(kept["start"]).name
    labels = {key: bool(kept["data"].get(key)) for key in ("coco", "tusimple")}
    paths = ("coco", "coco_images", "tusimple", "tusimple_images")
    kept["data"] = {k: v for k, v in kept["data"].items() if k not in paths} | {"own_labels": labels}
    return kept


def _commit() -> str:
    """The commit of this checkout, or ``unknown`` outside of one."""
    try:
        answer = subprocess.run(
            ["git", "rev-parse", "HEAD"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return answer.stdout.strip()
