"""``python -m train [key=value ...]`` trains the detector; its arguments are Hydra overrides."""

from __future__ import annotations

import sys
import threading
from typing import TYPE_CHECKING

from v2hdm.cli.main import Command, answer_signals

if TYPE_CHECKING:
    from v2hdm.cli.compose import Job

_COMMAND = Command(
    "python -m train", "Train the detector.", "train", "interrupted; what was saved until then is kept"
)


def main() -> int:
    """Train; returns the exit code."""
    return _COMMAND.guard(_train)


def _train() -> int:
    from train.config import TrainConfig
    from v2hdm.cli.compose import work_on

    return work_on(_COMMAND, "train", TrainConfig, _run, sys.argv[1:], "set it on the command line")


def _run(job: Job) -> None:
    from train.console import train

    threading.excepthook = _leave_to_main
    train(job.settings)


def _leave_to_main(failed: threading.ExceptHookArgs) -> None:
    """Print no error of the disk from TensorBoard's thread: the next figure raises it in the main one."""
    if not isinstance(failed.exc_value, OSError):
        threading.__excepthook__(failed)


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
