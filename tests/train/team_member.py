"""One of the processes that test_distributed.py starts with torchrun: trains, goes on, leaves its weights."""

import sys
from dataclasses import replace
from pathlib import Path

import torch

from tests.train.small import tiny
from train.config import TrainConfig, ValidationConfig
from train.data import RenderStream
from train.distributed import joined_team
from train.loop import Trainer


def small(output: Path, steps: int) -> TrainConfig:
    """The training of a team's member."""
    return replace(tiny(output, steps), device="cpu", validation=ValidationConfig(images=1))


def main(folder: Path) -> None:
    indices: list[int] = []
    render = RenderStream._render
    RenderStream._render = lambda self, index: (indices.append(index), render(self, index))[1]
    with joined_team("cpu") as team:
        mean = torch.tensor([float(team.rank), 10.0 * team.rank])
        team.average([mean[:1], mean[1:]])
        for steps in (2, 4):
            trainer = Trainer(small(folder / "run", steps), lambda share, line: None, team)
            left = trainer.state.step
            state = trainer.run()
        members = {"net": trainer.net.state_dict(), "averaged": trainer.averaged.module.state_dict()}
        plain = {"left": left, "step": state.step, "renders": state.renders, "seen": indices, "mean": mean}
        torch.save(members | plain, folder / f"member{team.rank}.pt")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
