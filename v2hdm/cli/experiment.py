"""``v2hdm experiment``: its arguments are Hydra overrides (docs/experiment.md)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from v2hdm.cli.main import COMMANDS

if TYPE_CHECKING:
    from v2hdm.cli.compose import Job

_PORTS = "name ports (+run@ports.port1=port1) or set what is missing on the command line"


def run(arguments: Sequence[str]) -> int:
    """Compare all methods."""
    import torch  # noqa: F401  # its absence is reported before that of what is built on it

    from v2hdm.cli.compose import work_on
    from v2hdm.experiment.plan import ExperimentConfig

    return work_on(COMMANDS["experiment"], "experiment", ExperimentConfig, _compare, arguments, _PORTS)


def _compare(job: Job) -> None:
    from v2hdm.experiment.run import experiment_on_terminal

    experiment_on_terminal(job.settings, job.yaml)
