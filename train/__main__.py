"""The training command: ``python -m train [key=value ...]``."""

from __future__ import annotations

import sys
from functools import partial
from typing import TYPE_CHECKING

from v2hdm.cli.door import answer_signals, open_door

if TYPE_CHECKING:
    from v2hdm.cli.config import Job

_INTERRUPTED = "interrupted; what was saved until then is kept"


def main() -> int:
    """Run the command, whose arguments are Hydra overrides (``--help`` lists them); returns its exit code."""
    return _settle(_train)


_settle = partial(open_door, "train", "train", _INTERRUPTED)


def _train() -> int:
    from train.config import TrainConfig
    from v2hdm.cli.config import work_on

    return work_on("train", TrainConfig, _run, _settle, __doc__ or "")


def _run(job: Job) -> None:
    from train.config import TrainConfig
    from train.console import train
    from v2hdm.cli.config import to_dataclass

    config = to_dataclass(job.composed, TrainConfig, "set it on the command line")
    config.output = job.folder(config.output)
    train(config)


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
