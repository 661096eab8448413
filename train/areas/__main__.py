"""``python -m train.areas [key=value ...]`` fits words and boxes; its arguments are Hydra overrides."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from v2hdm.cli.command import Command
from v2hdm.cli.main import answer_signals

if TYPE_CHECKING:
    from v2hdm.cli.compose import Job


def main() -> int:
    """Fit the classes; returns the exit code."""
    return COMMAND(sys.argv[1:])


def _run(arguments: Sequence[str]) -> int:
    from train.areas.config import AreasConfig
    from v2hdm.cli.compose import Door, work_on

    return work_on(COMMAND, Door("train_areas", AreasConfig, "set it on the command line"), _learn, arguments)


def _learn(job: Job) -> None:
    from rich.console import Console

    from train.areas.learn import check_areas, known_already, learn_areas
    from train.bar import share_of_work

    check_areas(job.settings)
    console = Console(stderr=True)
    if anew := known_already(job.settings):
        console.print(f"{job.settings.start} knows {', '.join(anew)} already: fitted anew", highlight=False)
    with share_of_work(console, "reading the network and the labels") as tell:
        path = learn_areas(job.settings, tell)
        tell(1.0, "done")
    print(f"{path}: python -m train.ship {path.parent} --keep network judge lane_score")


COMMAND = Command(
    "python -m train.areas",
    "Let a finished network learn words and boxes.",
    _run,
    extra="train",
    interrupted="interrupted; nothing was written",
)

if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
