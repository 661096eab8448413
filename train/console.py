"""A training on the terminal: a progress bar and the log."""

from __future__ import annotations

import logging
import multiprocessing
import signal
import sys
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from rich.console import Console
from rich.logging import RichHandler

from train.bar import share_of_work
from train.config import TrainConfig, check_training
from train.distributed import Team, joined_team
from train.loop import Trainer
from v2hdm.store.results import locked_folder


def train(config: TrainConfig) -> None:
    """Train the detector's network, together with the processes that torchrun started."""
    check_training(config)
    with joined_team(config.device) as team, _alone(config, team):
        _train(config, team)


def _alone(config: TrainConfig, team: Team) -> AbstractContextManager[None]:
    """Keep a second training out of the folder of this one."""
    return locked_folder(Path(config.output)) if team.leads else nullcontext()


def _train(config: TrainConfig, team: Team) -> None:
    console = Console(stderr=True, quiet=not team.leads)
    handler = RichHandler(console=console, show_path=False)
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[handler], force=True)
    with share_of_work(console, "rendering the validation set") as tell:
        trainer = Trainer(config, tell, team)
        try:
            state = trainer.run()
        except KeyboardInterrupt:
            _end_workers()
            raise
    # The renders that choose best.pt show none of a user's own classes.
    checkpoint = Path(config.output) / ("last.pt" if state.own_classes else "best.pt")
    console.print(f"trained {state.step} steps, mean IoU {state.best_iou:.3f}: {checkpoint}")


def _end_workers() -> None:
    """End the processes that render; torch would wait until each has finished its batch."""
    if sys.platform != "win32":
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # torch takes the end of one for a failure
    for process in multiprocessing.active_children():
        process.terminate()
