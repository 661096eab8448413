"""``v2hdm experiment`` (docs/experiment.md); its settings are Hydra overrides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from v2hdm.cli.command import GO_ON, Command

if TYPE_CHECKING:
    from v2hdm.cli.compose import Job

_ADVICE = "name ports (+run@ports.port1=port1) or set the missing keys on the command line"


def _run(arguments: Sequence[str]) -> int:
    """Compare all methods."""
    import torch  # noqa: F401  # its absence is reported before that of what is built on it

    from v2hdm.cli.compose import work_on
    from v2hdm.experiment.plan import ExperimentConfig

    return work_on(COMMAND, "experiment", ExperimentConfig, _compare, arguments, _ADVICE)


def _compare(job: Job) -> None:
    from v2hdm.experiment.run import experiment_on_terminal

    experiment_on_terminal(job.settings, job.yaml)


COMMAND = Command(
    "v2hdm experiment",
    "Compare all methods on both ports, as the paper does.",
    _run,
    interrupted=f"interrupted; finished drives and detections are kept, {GO_ON}",
)
