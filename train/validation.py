"""The fixed images on which networks are compared, and how well a network does on them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import torch

from models import Prediction
from train.config import TrainConfig
from train.data import Pair, validation_pairs
from train.labels import VALIDATION, Tell, read_labels
from train.metrics import Score, Tally
from train.targets import Targets

RENDERS = "renders"
PHOTOGRAPHS = "photographs"
"""The names of the sets."""


def validation_sets(config: TrainConfig, classes: Sequence[str], tell: Tell) -> dict[str, list[Pair]]:
    """Fixed renders and, if the labelled images hold some out, photographs, each with its answers.

    Both are empty if ``config.validation.images`` is 0. ``classes`` are those of the network.

    Raises:
        LabelError: a label file or an image is missing, damaged or does not fit.
    """
    images = config.validation.images
    renders = []
    for number, pair in enumerate(validation_pairs(config.data, config.seed, images)):
        tell(number / images, "rendering the validation set")
        renders.append(pair)
    sets = {RENDERS: renders}
    held_out = read_labels(config.data, classes, tell, VALIDATION) if images else None
    if held_out is not None:
        sets[PHOTOGRAPHS] = list(held_out.whole())
    return sets


@torch.inference_mode()
def score_of(
    network: Callable[[torch.Tensor], Prediction],
    pairs: Iterable[Pair],
    classes: Sequence[str],
    device: torch.device | str = "cpu",
) -> Score:
    """How well a network in eval mode, on ``device``, does on images, one after the other."""
    tally = Tally(classes)
    for image, targets in pairs:
        batch = Targets(*(target[None].to(device) for target in targets))
        tally.add(network(image[None].to(device)), batch)
    return tally.score()


def metrics_of_sets(scores: Mapping[str, Score]) -> dict[str, float]:
    """Scores as flat figures; those of photographs carry the name of their set."""
    return {
        (f"{name}_" if name != RENDERS else "") + figure: value
        for name, score in scores.items()
        for figure, value in score.figures().items()
    }
