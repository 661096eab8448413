"""The door: `python -m train [key=value ...]`."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import hydra
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from train.config import TrainConfig
from train.loop import Trainer
from v2hdm.errors import V2hdmError

_CONF = Path(__file__).resolve().parents[1] / "conf"

ConfigStore.instance().store(name="train_schema", node=TrainConfig)


@hydra.main(version_base="1.3", config_path=str(_CONF), config_name="train")
def main(composed: DictConfig) -> None:
    """Train the detector's network."""
    console = Console(stderr=True)
    logging.basicConfig(
        level=logging.INFO, format="%(message)s", handlers=[RichHandler(console=console)], force=True
    )
    columns = (
        BarColumn(),
        TextColumn("{task.percentage:.0f} %"),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
    )
    try:
        config = OmegaConf.to_object(composed)
        assert isinstance(config, TrainConfig)
        with Progress(*columns, console=console) as bar:
            task = bar.add_task("rendering the validation set", total=1.0)
            trainer = Trainer(config, lambda share, line: bar.update(task, completed=share, description=line))
            state = trainer.run()
    except V2hdmError as error:
        console.print(f"[red]error:[/] {error}", highlight=False, soft_wrap=True)
        sys.exit(2)
    console.print(
        f"trained {state.step} steps, mean IoU {state.best_iou:.3f}: {Path(config.output) / 'best.pt'}"
    )


if __name__ == "__main__":
    main()
