"""``python -m train [key=value ...]`` trains the detector; its arguments are Hydra overrides."""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING

from v2hdm.cli.command import Command
from v2hdm.cli.main import answer_signals

if TYPE_CHECKING:
    from v2hdm.cli.compose import Job


def main() -> int:
    """Train; returns the exit code."""
    return COMMAND(sys.argv[1:])


def _run(arguments: Sequence[str]) -> int:
    from train.config import TrainConfig
    from v2hdm.cli.compose import Door, work_on

    return work_on(COMMAND, Door("train", TrainConfig, "set it on the command line"), _train, arguments)


def _train(job: Job) -> None:
    from train.console import train

    threading.excepthook = _leave_to_main
    train(job.settings)


def _leave_to_main(failed: threading.ExceptHookArgs) -> None:
    """Print no error of the disk from TensorBoard's thread: the next figure raises it in the main one."""
    if not isinstance(failed.exc_value, OSError):
        threading.__excepthook__(failed)


COMMAND = Command(
    "python -m train",
    "Train the detector.",
    _run,
    extra="train",
    interrupted="interrupted; what was saved until then is kept",
)

if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
