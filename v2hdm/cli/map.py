"""``v2hdm map +run=port2``: its arguments are Hydra overrides, which ``--help`` lists."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from v2hdm.cli.main import COMMANDS
from v2hdm.errors import EXIT_FAILED_VERDICT

if TYPE_CHECKING:
    from v2hdm.cli.compose import Job

_RUNS = "choose a run (+run=port1, +run=port2, +run=kitti drive.path=...) or set it on the command line"


def run(arguments: Sequence[str]) -> int:
    """Map a drive; 0 for PASS and WARN, 3 for FAIL."""
    from v2hdm.cli.compose import work_on
    from v2hdm.pipeline.config import RunConfig

    return work_on(COMMANDS["map"], "map", RunConfig, _map, arguments)


def _map(job: Job) -> int:
    from v2hdm.cli import compose
    from v2hdm.cli.terminal import run_on_terminal
    from v2hdm.pipeline.config import RunConfig
    from v2hdm.verdict import Status

    settings = compose.to_dataclass(job.composed, RunConfig, _RUNS)
    settings.output = job.folder(settings.output)
    verdict = run_on_terminal(settings, compose.to_yaml(job.composed))
    return EXIT_FAILED_VERDICT if verdict.status is Status.FAIL else 0
