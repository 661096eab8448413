"""``python -m train.score start=FILE [key=value ...]`` says how good a network is, without a training.

Its arguments are those of :mod:`train`: ``start`` is the network, a checkpoint or an exported file;
``labels=roadmark data.coco=FILE`` adds the photographs that a training would hold out.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from v2hdm.cli.command import Command
from v2hdm.cli.main import answer_signals
from v2hdm.errors import ConfigError

if TYPE_CHECKING:
    from train.config import TrainConfig
    from train.labels import Tell
    from train.metrics import Score
    from v2hdm.cli.compose import Job


def main() -> int:
    """Score a network; returns the exit code."""
    return COMMAND(sys.argv[1:])


def _run(arguments: Sequence[str]) -> int:
    from train.config import TrainConfig
    from v2hdm.cli.compose import Door, work_on

    return work_on(COMMAND, Door("train", TrainConfig, "set it on the command line"), _score, arguments)


def _score(job: Job) -> None:
    from rich.console import Console

    from train.bar import share_of_work

    with share_of_work(Console(stderr=True), "reading the network") as tell:
        scores = scores_of(job.settings, tell)
        tell(1.0, "done")
    for name, score in scores.items():
        print(f"{name}: {score}")


def scores_of(config: TrainConfig, tell: Tell) -> dict[str, Score]:
    """How well the network ``config.start`` does on each set of images of :mod:`train.validation`.

    Raises:
        ConfigError: no network is named, it cannot be read, or nothing is asked to be scored.
        LabelError: a label file or an image is missing, damaged or does not fit.
    """
    import torch

    from train.checkpoint import fresh_checkpoint
    from train.config import check_training
    from train.validation import score_of, validation_sets

    check_training(config)
    if config.start is None:
        raise ConfigError("start names no network: set start=models/marking_net.onnx or start=RUN/best.pt")
    if config.validation.images == 0:
        raise ConfigError("validation.images is 0, which leaves nothing to score: set it to 64")
    torch.set_num_threads(config.threads)
    checkpoint = fresh_checkpoint(config)
    network = checkpoint.network()
    scores = {}
    for name, pairs in validation_sets(config, checkpoint.classes, tell).items():
        tell(0.9, f"scoring {len(pairs)} {name}")
        scores[f"{len(pairs)} {name}"] = score_of(network, pairs, checkpoint.classes)
    return scores


COMMAND = Command(
    "python -m train.score",
    "Score a network on the images that its training is validated by.",
    _run,
    extra="train",
)

if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
