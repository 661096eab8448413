"""From a finished network to a checkpoint that knows a few classes more; all else that it says stays."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from models import NetConfig
from train.areas.cells import CellReader, Cells, View
from train.areas.config import AreasConfig
from train.areas.fit import check_shown, fit_rows
from train.areas.views import marks_of_targets, views_of_photograph
from train.average import classes_of, scored
from train.bar import Share
from train.checkpoint import Checkpoint, fresh_checkpoint, load_checkpoint, save_checkpoint
from train.config import TrainConfig, ValidationConfig
from train.data import RenderStream
from train.exported import read_exported
from train.growth import CLASS_CHANNELS, CLASS_LAYERS, recorded_net
from train.labels import labelled_images
from train.labels_image import LabelledImage
from v2hdm.errors import ConfigError
from v2hdm.safe.texts import shown
from v2hdm.settings import check_settings
from v2hdm.store.results import locked_folder

_PHOTOGRAPHS_SEEN = 0.7  # share of the time that has passed after the photographs, about
_RENDERS_SEEN = 0.85  # share after the renders
_FITTED = 0.95  # share after the fit


def learn_areas(config: AreasConfig, tell: Share) -> Path:
    """Fit the classes and write the checkpoint; returns its path.

    Raises:
        ConfigError: A setting is wrong, there are no photographs, or they and the renders lack a class.
        LabelError: The label file or an image is missing, damaged or does not fit.
        DriveError: An image cannot be read.
    """
    check_areas(config)
    torch.set_num_threads(config.threads)
    path = Path(config.output) / "best.pt"
    with locked_folder(path.parent):
        save_checkpoint(_learnt(config, tell), path)
    return path


def _learnt(config: AreasConfig, tell: Share) -> Checkpoint:
    """The network with the rows of its classes, scored."""
    began_s = time.monotonic()
    tell(0.0, "reading the network and the labels")
    state = started(config)
    images = [image for image in labelled_images(config.data) if image.shapes is not None]
    if not images:
        raise ConfigError(
            "no photographs to learn from: set data.coco=instances.json and data.coco_images=FOLDER"
        )
    cells = _gathered(config, state, images, tell)
    check_shown(cells, config.classes)

    def fitted(share: float) -> None:
        tell(_RENDERS_SEEN + (_FITTED - _RENDERS_SEEN) * share, f"fitting {len(cells.marks)} cells of paint")

    rows = fit_rows(cells, len(config.classes), config.render_share, config.ridge, config.steps, fitted)
    put_rows(state, config, rows)
    tell(_FITTED, "scoring on the validation renders")
    state.metrics = scored(state)
    state.best_iou = state.metrics["mean_iou"]
    state.step = config.steps
    state.renders += -(-config.render_views // config.data.views_per_render)
    state.elapsed_s = time.monotonic() - began_s
    return state


def check_areas(config: AreasConfig) -> None:
    """Refuse settings that no fit can work with; raises ConfigError that names the key."""
    check_settings(config)
    if not config.classes or len(set(config.classes)) < len(config.classes):
        raise ConfigError(f"classes is {config.classes}: name one class or more, each once")


def started(config: AreasConfig) -> Checkpoint:
    """The network of ``config.start`` with channels for the classes, which say nothing of use yet.

    Raises:
        ConfigError: It cannot be read, or cannot get these classes.
    """
    state = fresh_checkpoint(_training_of(config))
    names = state.catalogue.names
    for name in (*config.classes, *config.log_odds):
        if name not in names:
            raise ConfigError(f"classes: no class {shown(name)}; choose from: {', '.join(names)}")
    classes = {*classes_of(Path(config.start)), *config.classes}
    class_names = tuple(name for name in names if name in classes)
    for layer in CLASS_CHANNELS & state.averaged.keys():
        state.averaged[layer] = state.averaged[layer][_places(names, class_names)]
    state.model = state.averaged
    if state.classes != class_names:
        missing = next(name for name in names if name not in class_names)
        raise ConfigError(
            f"classes: {', '.join(config.classes)} come after {missing}, which {config.start} does not know: "
            "add it to classes="
        )
    return state


def _training_of(config: AreasConfig) -> TrainConfig:
    """The training that would let nothing but the classes' channels learn."""
    return TrainConfig(
        output=config.output,
        start=config.start,
        seed=config.seed,
        steps=config.steps,
        head_updates=config.steps,
        only_classes=config.classes,
        threads=config.threads,
        validation=ValidationConfig(images=config.scored_images),
        net=_net_of(Path(config.start)),
        data=config.data,
    )


def known_already(config: AreasConfig) -> list[str]:
    """The classes that the network knows already and that will be fitted anew."""
    known_classes = classes_of(Path(config.start))
    return [name for name in config.classes if name in known_classes]


def put_rows(state: Checkpoint, config: AreasConfig, rows: Tensor) -> None:
    """Make fitted rows (classes, C + 1) those of a checkpoint, and change their log odds as configured."""
    places = _places(state.classes, config.classes)
    first = 0
    for layer in (name for name in CLASS_LAYERS if f"{name}.weight" in state.averaged):
        weight = state.averaged[f"{layer}.weight"]
        bias = state.averaged[f"{layer}.bias"]
        inputs = weight.shape[1]
        weight[places] = rows[:, first : first + inputs, None, None]
        bias[places] = 0.0
        first += inputs
    changed = torch.tensor([config.log_odds.get(name, 0.0) for name in config.classes])
    state.averaged["kinds.bias"][places] = rows[:, -1] + changed


def _places(channels: Sequence[str], classes: Sequence[str]) -> list[int]:
    """The places of classes among channels."""
    return [channels.index(name) for name in classes]


def _net_of(path: Path) -> NetConfig:
    earlier = read_exported(path) if path.suffix == ".onnx" else load_checkpoint(path)
    return recorded_net(earlier.config["net"])


def _gathered(config: AreasConfig, state: Checkpoint, images: Sequence[LabelledImage], tell: Share) -> Cells:
    """The cells of all photographs and renders."""
    rng = np.random.default_rng([config.seed, 8])
    places = _places(state.classes, config.classes)
    reader = CellReader(state.network(), places, rng)
    cells = []
    for number, image in enumerate(images):
        tell(_PHOTOGRAPHS_SEEN * number / len(images), f"{number} of {len(images)} photographs seen")
        for view in views_of_photograph(image, config.classes, config.sky, rng):
            cells.append(reader.read(view, is_render=False))
    for number, view in enumerate(_views_of_renders(config, state, places)):
        share = _PHOTOGRAPHS_SEEN + (_RENDERS_SEEN - _PHOTOGRAPHS_SEEN) * number / config.render_views
        tell(share, f"{number} of {config.render_views} views of renders seen")
        cells.append(reader.read(view, is_render=True))
    return Cells.joined(cells)


def _views_of_renders(config: AreasConfig, state: Checkpoint, places: Sequence[int]) -> Iterator[View]:
    """Views of renders that did not teach the network yet; the classes are at ``places`` of the channels."""
    stream = RenderStream(config.data, config.seed, state.renders)
    for image, answers in islice(stream, config.render_views):
        yield View(image.numpy(), marks_of_targets(answers, places))
