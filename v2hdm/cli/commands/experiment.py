"""``v2hdm experiment`` (docs/experiment.md); its settings are Hydra overrides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from v2hdm.cli.command import GO_ON, Command

if TYPE_CHECKING:
    from v2hdm.cli.compose import Job


def _run(arguments: Sequence[str]) -> int:
    """Compare all methods."""
    import torch  # noqa: F401  # its absence is reported before that of what is built on it

    from v2hdm.cli.compose import Door, work_on
    from v2hdm.experiment.plan import ExperimentConfig

    advice = "name ports (+run@ports.port1=port1) or set the missing keys on the command line"
    further = "\nThose of a rendered port, ports.NAME.simulate.*, are listed by v2hdm simulate --help."
    door = Door("experiment", ExperimentConfig, advice, lambda key: ".simulate." not in key, further)
    return work_on(COMMAND, door, _compare, arguments)


def _compare(job: Job) -> None:
    from v2hdm.experiment.run import experiment_on_terminal

    experiment_on_terminal(job.settings, job.yaml)


COMMAND = Command(
    "v2hdm experiment",
    "Compare all methods on both ports, as the paper does.",
    _run,
    interrupted=f"interrupted; finished drives and detections are kept, {GO_ON}",
)
