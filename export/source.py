"""The source of an export: a network and its label, from a checkpoint or an earlier export."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from models import MarkingNet, Prediction
from models.marking_net import KIND_STRIDE, LANE_STRIDE, MULTIPLE, PAINT_STRIDE
from train.checkpoint import Checkpoint, load_checkpoint
from train.exported import read_exported
from train.growth import recorded_net
from v2hdm.errors import ConfigError

STRIDES = dict(zip(Prediction._fields, (PAINT_STRIDE, KIND_STRIDE, LANE_STRIDE), strict=True))


@dataclass(frozen=True)
class Source:
    """A network in eval mode, and what a reader of its file needs to know to run it, and of its origin."""

    net: MarkingNet
    label: dict[str, Any]


def read_source(path: Path) -> Source:
    """Read a checkpoint, or a float32 file (``.onnx``) that was exported before.

    Raises:
        ConfigError: It is neither, or holds weights that were rounded already.
    """
    return _of_exported(path) if path.suffix == ".onnx" else of_checkpoint(load_checkpoint(path))


def of_checkpoint(checkpoint: Checkpoint) -> Source:
    """The averaged weights of a checkpoint."""
    label = {
        "classes": list(checkpoint.classes),
        "own_classes": checkpoint.own_classes,
        "multiple": MULTIPLE,
        "strides": STRIDES,
        "input": "uint8 BGR, NHWC",
        "commit": _commit(),
        "steps": checkpoint.step,
        "renders": checkpoint.renders,
        "training_minutes": round(checkpoint.elapsed_s / 60, 1),
        "metrics": {name: round(value, 4) for name, value in checkpoint.metrics.items()},
        "training": _without_paths(checkpoint.config),
    }
    return Source(checkpoint.network(), label)


def _of_exported(path: Path) -> Source:
    """The weights of a file; its label goes on saying where they come from."""
    exported = read_exported(path)
    if exported.label.get("precision", "float32") != "float32":
        raise ConfigError(
            f"{path} holds weights that were rounded to int8 already: give the checkpoint, or the float32 "
            "file, that it was made from"
        )
    net = MarkingNet(recorded_net(exported.config["net"]), len(exported.classes)).fold()
    try:
        net.load_state_dict({name: exported.weights[name] for name in net.state_dict()})
    except (KeyError, RuntimeError) as error:
        raise ConfigError(f"{path} does not hold the weights of the network that its label names") from error
    return Source(net, exported.label)


def weights_not_finite(net: torch.nn.Module) -> list[str]:
    """Names of the weights that hold a value that is no number."""
    return [name for name, value in net.state_dict().items() if not torch.isfinite(value).all()]


def _without_paths(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a training less what says something of the machine that it ran on."""
    settings = {key: value for key, value in config.items() if key not in ("output", "device", "resume")}
    for key in ("start", "catalogue"):
        settings[key] = settings.get(key) and Path(settings[key]).name
    labels = {key: bool(settings["data"].get(key)) for key in ("coco", "tusimple")}
    paths = ("coco", "coco_images", "tusimple", "tusimple_images")
    settings["data"] = {k: v for k, v in settings["data"].items() if k not in paths} | {"own_labels": labels}
    return settings


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
