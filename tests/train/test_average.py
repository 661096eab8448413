"""The mean of several runs' weights."""

from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

from models import MarkingNet
from tests.train.small import tiny
from train.average import mean_checkpoint, scored
from train.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from train.loop import Trainer
from v2hdm.errors import ConfigError


def taught(path: Path, seed: int, **net: object) -> dict[str, torch.Tensor]:
    """Write a checkpoint of random weights; returns them."""
    config = tiny(path)
    config = replace(config, net=replace(config.net, **net))
    torch.manual_seed(seed)
    state = MarkingNet(config.net).state_dict()
    save_checkpoint(
        Checkpoint(config=asdict(config), step=seed, averaged=state, metrics={"mean_iou": 1.0}), path
    )
    return state


def test_the_mean_is_between_its_parts_by_their_weights(tmp_path: Path) -> None:
    first, second = (taught(tmp_path / f"{seed}.pt", seed) for seed in (1, 2))
    mean = mean_checkpoint(tmp_path / "1.pt", [tmp_path / "2.pt"], [3.0, 1.0])
    for name, value in mean.averaged.items():
        torch.testing.assert_close(value, (0.75 * first[name] + 0.25 * second[name]).to(value.dtype))
    assert mean.metrics == {}, "nobody has scored the mean yet"
    assert 0 <= scored(mean)["mean_iou"] <= 1
    save_checkpoint(mean, tmp_path / "mean.pt")
    assert (
        load_checkpoint(tmp_path / "mean.pt").network().stem[0].weight.shape == first["stem.0.weight"].shape
    )


def test_parts_that_cannot_be_averaged_are_refused(tmp_path: Path) -> None:
    taught(tmp_path / "1.pt", 1)
    taught(tmp_path / "other.pt", 2, head_width=4)
    with pytest.raises(ConfigError, match="holds the network"):
        mean_checkpoint(tmp_path / "1.pt", [tmp_path / "other.pt"])
    with pytest.raises(ConfigError, match="no checkpoint at"):
        mean_checkpoint(tmp_path / "1.pt", [tmp_path / "none.pt"])
    with pytest.raises(ConfigError, match="1 weights for 2 files"):
        mean_checkpoint(tmp_path / "1.pt", [tmp_path / "1.pt"], [1.0])


def test_the_mean_with_its_own_start_is_between_the_two_though_the_network_grew(tmp_path: Path) -> None:
    taught(tmp_path / "small.pt", 1)
    config = tiny(tmp_path / "run")
    grown = replace(config, start=str(tmp_path / "small.pt"), net=replace(config.net, wide_kinds=True))
    trainer = Trainer(grown, lambda share, line: None)
    start = {name: value.clone() for name, value in trainer.averaged.module.state_dict().items()}
    trainer.run()
    mean = mean_checkpoint(tmp_path / "run" / "last.pt", [tmp_path / "small.pt"])
    end = load_checkpoint(tmp_path / "run" / "last.pt").averaged
    for name, value in mean.averaged.items():
        if value.is_floating_point():
            torch.testing.assert_close(value, (start[name] + end[name]) / 2, atol=1e-5, rtol=1e-5)
