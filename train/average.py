"""The command `python -m train.average runs/b/last.pt runs/a/last.pt --output runs/mean.pt`.

The mean of the weights of runs that went on from each other often does better than any of them: what each
learnt is kept, what each came to by chance is averaged out (Izmailov et al., "Averaging Weights Leads to
Wider Optima and Better Generalization", UAI 2018; Wortsman et al., "Model soups", ICML 2022). Of runs that
started apart the mean is nothing.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from train.checkpoint import Checkpoint, fresh_checkpoint, load_checkpoint, save_checkpoint
from train.config import DataConfig, TrainConfig
from train.data import validation_pairs
from train.exported import read_exported
from train.growth import CLASS_CHANNELS, recorded_net, with_classes
from train.validation import score_of
from v2hdm.errors import ConfigError, V2hdmError


def mean_checkpoint(
    first: Path, others: Sequence[Path], weights: Sequence[float] | None = None
) -> Checkpoint:
    """A checkpoint with the mean of the averaged weights of several.

    Args:
        first: The checkpoint whose settings the mean has.
        others: Checkpoints or exported files of the same network, or of one that can grow into it.
        weights: What each counts, first to last; all alike by default.

    Raises:
        ConfigError: A file cannot be read, holds another network, or the weights are not one for each.
    """
    shares = list(weights) if weights is not None else [1.0] * (1 + len(others))
    if len(shares) != 1 + len(others) or min(shares) < 0 or not sum(shares) > 0:
        raise ConfigError(
            f"{len(shares)} weights for {1 + len(others)} files: give one for each, none below 0"
        )
    mean = load_checkpoint(first)
    classes_of_files = [mean.classes]
    mean.averaged = with_classes(mean.averaged, mean.classes, mean.catalogue, str(first))
    config = TrainConfig(net=recorded_net(mean.config["net"]), data=DataConfig(**mean.config["data"]))
    states = [mean.averaged]
    for path in others:
        torch.manual_seed(mean.config["seed"])  # what a smaller network grows by is drawn as that run drew it
        states.append(fresh_checkpoint(replace(config, start=str(path)), mean.catalogue).averaged)
        classes_of_files.append(classes_of(path))
    knows = torch.tensor([[name in classes for name in mean.catalogue.names] for classes in classes_of_files])
    of_class = _shares_of_classes(torch.tensor(shares, dtype=torch.float64), knows)
    mean.averaged = {
        name: _mean(
            [state[name] for state in states], of_class if name in CLASS_CHANNELS else of_class[:, :1]
        )
        if value.is_floating_point()
        else value
        for name, value in mean.averaged.items()
    }
    mean.model = mean.averaged
    mean.optimizer = {}
    mean.metrics = {}
    return mean


def classes_of(path: Path) -> tuple[str, ...]:
    """The classes that a checkpoint or an exported file knows."""
    return read_exported(path).classes if path.suffix == ".onnx" else load_checkpoint(path).classes


def _shares_of_classes(shares: Tensor, knows: Tensor) -> Tensor:
    """Shares (F, K) of each file in the channel of each class: nothing where it does not know the class.

    The first class is one that all know. A class that no file knows is averaged as if all did.
    """
    of_class = shares[:, None] * knows
    of_class = torch.where(of_class.sum(dim=0) > 0, of_class, shares[:, None])
    return of_class / of_class.sum(dim=0)


def _mean(values: Sequence[Tensor], shares: Tensor) -> Tensor:
    """The mean of tensors (K, ...) by their shares (F, K or 1) along the first axis."""
    total = torch.zeros_like(values[0], dtype=torch.float64)
    for value, share in zip(values, shares, strict=True):
        total += value.double() * share.reshape(-1, *[1] * (value.ndim - 1))
    return total.to(values[0].dtype)


def scored(checkpoint: Checkpoint) -> dict[str, float]:
    """The figures of a checkpoint's averaged weights on the validation renders of its own settings."""
    config = checkpoint.config
    renders = validation_pairs(DataConfig(**config["data"]), config["seed"], config["validation"]["images"])
    return score_of(checkpoint.network(), renders, checkpoint.catalogue.names).figures()


def main() -> None:
    """Write the mean of checkpoints."""
    about = "Average the weights of runs that went on from each other."
    parser = argparse.ArgumentParser(prog="python -m train.average", description=about)
    parser.add_argument("checkpoint", nargs="+", type=Path, help="the first gives the settings")
    parser.add_argument("--weights", type=float, nargs="+", help="what each counts; all alike by default")
    parser.add_argument("--output", type=Path, required=True)
    parsed = parser.parse_args()
    try:
        mean = mean_checkpoint(parsed.checkpoint[0], parsed.checkpoint[1:], parsed.weights)
    except V2hdmError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    mean.metrics = scored(mean)
    save_checkpoint(mean, parsed.output)
    print(f"{parsed.output}: the mean of {len(parsed.checkpoint)}, mean IoU {mean.metrics['mean_iou']:.3f}")


if __name__ == "__main__":
    main()
