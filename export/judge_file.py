"""The judge as an ONNX file, checked against torch, and read again to learn on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from onnx import numpy_helper

from export.onnx_file import graph_of, write_labelled
from models.judge import Judge
from v2hdm.detection.classifier import JUDGE_INPUTS, JUDGE_OUTPUTS
from v2hdm.errors import DetectorError

_OPSET = 20  # version of ONNX's operators
_TOLERANCE = 1e-3  # largest difference of the file's answers from the network's
_ROWS = (1, 7, 64)  # numbers of rows that the file is checked with


def write_judge(judge: Judge, views_shape: tuple[int, int, int], label: dict[str, Any], path: Path) -> None:
    """Write ``path``, whose inputs are those of :meth:`models.judge.Judge.forward`, of any number of rows.

    Args:
        judge: has learnt.
        views_shape: channels, rows and columns of a view.
        label: what the file says of itself, as JSON in its metadata.
        path: appears whole and checked, or not at all.

    Raises:
        DetectorError: the file's answers would not be the network's.
    """
    rows_of_each = {0: torch.export.Dim("rows", min=1, max=4096)}
    inputs = _any_rows(judge, views_shape, 5)
    model = graph_of(judge, inputs, list(JUDGE_OUTPUTS), (rows_of_each,) * 3, _OPSET)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    for rows in _ROWS:
        inputs = _any_rows(judge, views_shape, rows)
        with torch.no_grad():
            expected = judge(*inputs.values())
        named = {name: part.numpy() for name, part in inputs.items()}
        for name, answer, answer_of_network in zip(
            JUDGE_OUTPUTS, session.run(None, named), expected, strict=True
        ):
            difference = float(np.abs(answer - answer_of_network.numpy()).max())
            if not difference <= _TOLERANCE:
                raise DetectorError(f"{path} was not written: its {name} would differ by {difference:.2g}")
    write_labelled(model, label, path)


def read_judge(path: Path, channels: int, features: int, shapes: int, width: int) -> Judge | None:
    """The judge in a file of :func:`write_judge`, to learn on; None where it is of other inputs."""
    judge = Judge(channels, features, shapes, width, 0.0)
    values = {part.name: numpy_helper.to_array(part) for part in onnx.load(path).graph.initializer}
    state = judge.state_dict()
    if any(name not in values or values[name].shape != tuple(part.shape) for name, part in state.items()):
        return None
    judge.load_state_dict({name: torch.from_numpy(values[name].copy()) for name in state})
    return judge


def _any_rows(judge: Judge, views_shape: tuple[int, int, int], rows: int) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(rows)
    views = torch.randn((rows, *views_shape), generator=generator)
    evidence = torch.randn((rows, len(judge.mean)), generator=generator)
    shape = torch.eye(judge.shapes)[torch.arange(rows) % judge.shapes]
    return dict(zip(JUDGE_INPUTS, (views, evidence, shape), strict=True))
