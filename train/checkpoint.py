"""Checkpoints: one file that a training resumes from and an export starts from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from models import MarkingNet
from train.config import TrainConfig
from train.data import validation_pairs
from train.exported import read_exported, unfold
from train.growth import can_grow, class_count, grow, recorded_net, with_classes
from v2hdm.catalogue import SHIPPED, Catalogue, load_catalogue
from v2hdm.errors import ConfigError
from v2hdm.store.files import whole_file
from v2hdm.store.inputs import note_input, refuse_input

# What may differ between the parts of a resumed run without making it another experiment.
_FREE_TO_CHANGE = (
    "output",
    "device",
    "minutes",
    "steps",
    "threads",
    "checkpoint_minutes",
    "resume",
    "validation",
)

_VIEWS_TO_UNFOLD = 24  # views by which folded weights are unfolded
_ENTRY = ("family", "length_m", "width_m", "softness", "group")


def own_entries(catalogue: Catalogue) -> dict[str, dict[str, Any]]:
    """The classes that are not shipped, as plain data that :meth:`Catalogue.with_own` takes."""
    own_classes = {
        name: asdict(description)
        for name, description in catalogue.classes.items()
        if name not in SHIPPED.classes
    }
    return {
        name: {key: list(entry[key]) if isinstance(entry[key], tuple) else entry[key] for key in _ENTRY}
        for name, entry in own_classes.items()
    }


@dataclass
class Checkpoint:
    """State of a training. ``averaged`` are the weights to use, ``metrics`` what they scored last.

    ``config`` is the :class:`TrainConfig` as a dict, ``own_classes`` what users' catalogue says.
    Everything is plain data and tensors, so that a file is read without running code from it.
    """

    config: dict[str, Any]
    step: int = 0
    renders: int = 0
    elapsed_s: float = 0.0
    model: dict[str, Tensor] = field(default_factory=dict)
    averaged: dict[str, Tensor] = field(default_factory=dict)
    optimizer: dict[str, Any] = field(default_factory=dict)
    metrics: dict[str, float] = field(default_factory=dict)
    best_iou: float = 0.0
    own_classes: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def classes(self) -> tuple[str, ...]:
        """The classes of the network's channels: a network may be older than the last of the shipped ones."""
        own_classes = tuple(self.own_classes)
        weights = self.averaged or self.model
        shipped = class_count(weights) - len(own_classes) if weights else len(SHIPPED.names)
        return SHIPPED.names[:shipped] + own_classes

    @property
    def catalogue(self) -> Catalogue:
        """The classes that the network tells apart."""
        return SHIPPED.with_own(self.own_classes, "the checkpoint")

    def network(self) -> MarkingNet:
        """The network with the averaged weights, in eval mode."""
        net = MarkingNet(recorded_net(self.config["net"]), class_count(self.averaged))
        net.load_state_dict(self.averaged)
        return net.eval()


def fresh_checkpoint(config: TrainConfig, catalogue: Catalogue | None = None) -> Checkpoint:
    """The state before the first update: that of no network yet, or with the weights of ``config.start``.

    Its classes are those of ``catalogue``, else of ``config.catalogue``, else of ``config.start``.

    Raises:
        ConfigError: ``config.start`` is no checkpoint or exported file, or one of another network;
            ``config.catalogue`` is none, or lacks a class that ``config.start`` knows.
    """
    if catalogue is None and config.catalogue is not None:
        catalogue = load_catalogue(Path(config.catalogue))
    state = Checkpoint(config=asdict(config), own_classes=own_entries(catalogue or SHIPPED))
    if config.start is None:
        return state
    path = Path(config.start)
    note_input(path)
    for name in ("last.pt", "best.pt"):
        refuse_input(Path(config.output) / name)
    earlier = read_exported(path) if path.suffix == ".onnx" else load_checkpoint(path)
    then = recorded_net(earlier.config["net"])
    if not can_grow(then, config.net):
        raise ConfigError(
            f"start={config.start} holds the network {asdict(then)}, not {asdict(config.net)}: "
            "give its `net` settings"
        )
    catalogue = catalogue or earlier.catalogue
    where = f"start={config.start}"
    for name, entry in earlier.catalogue.classes.items():
        if catalogue.classes.get(name, entry) != entry:
            raise ConfigError(
                f"{config.catalogue} and {where} define {name} differently: "
                "make them alike, or choose another name"
            )
    state.own_classes = own_entries(catalogue)
    classes = earlier.classes
    if isinstance(earlier, Checkpoint) and then == config.net:
        state.averaged = with_classes(earlier.averaged, classes, catalogue, where)
    else:
        folded = earlier.network().fold().state_dict() if isinstance(earlier, Checkpoint) else earlier.weights
        folded = with_classes(folded, classes, catalogue, where)
        pairs = validation_pairs(config.data, config.seed, _VIEWS_TO_UNFOLD)
        views = (image[None] for image, _ in pairs)
        state.averaged = unfold(grow(folded, then, config.net), config.net, views)
    state.model = state.averaged
    state.renders = earlier.renders
    return state


def save_checkpoint(checkpoint: Checkpoint, path: Path) -> None:
    """Write a checkpoint; a kill leaves the one before it.

    Raises:
        ConfigError: It cannot be written there.
    """
    content = BytesIO()  # torch turns an error of the disk into one of its own
    torch.save(vars(checkpoint), content)
    try:
        with whole_file(path) as partial:
            partial.write_bytes(content.getbuffer())
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be written ({error.strerror}); free space or set another output="
        ) from None


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint onto the CPU.

    Raises:
        ConfigError: There is none at ``path`` or it is damaged.
    """
    if not path.is_file():
        raise ConfigError(f"no checkpoint at {path}: train one with `python -m train`, or name another")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        return Checkpoint(**content)
    except Exception as error:
        raise ConfigError(
            f"{path} is no checkpoint of `python -m train` ({error!s:.60}...): name another".replace(
                "\n", " "
            )
        ) from error


def check_same_experiment(checkpoint: Checkpoint, config: TrainConfig, path: Path) -> None:
    """Refuse to go on with a run under settings, or with classes, that would make it another one.

    Raises:
        ConfigError: Naming the settings that differ.
    """
    then = _completed(checkpoint.config, asdict(TrainConfig()))
    now = asdict(config)
    changed = [key for key in now if key not in _FREE_TO_CHANGE and then.get(key) != now[key]]
    if changed:
        raise ConfigError(
            f"{path} was trained with another {', '.join(changed)}: set it back, or choose a new `output`"
        )
    if checkpoint.classes != checkpoint.catalogue.names:
        later = [name for name in checkpoint.catalogue.names if name not in checkpoint.classes]
        raise ConfigError(
            f"{path} was trained before there were the classes {', '.join(later)}: go on with start={path} "
            "and a new `output`"
        )
    if config.catalogue is not None:
        own_classes = own_entries(load_catalogue(Path(config.catalogue)))
        if list(own_classes) != list(checkpoint.own_classes):
            raise ConfigError(
                f"{path} was trained with the classes {', '.join(checkpoint.own_classes)}, not "
                f"{', '.join(own_classes)}: set them back in {config.catalogue}, or choose a new `output`"
            )


def _completed(config: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration with the settings that there were not yet when it was saved."""
    return {
        key: _completed(config[key], default)
        if isinstance(config.get(key), dict) and default
        else config.get(key, default)
        for key, default in defaults.items()
    }
