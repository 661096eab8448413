"""The door to the experiment: ``python -m v2hdm.experiment`` compares all methods on both ports.

Arguments are Hydra overrides (``--help`` lists them). docs/experiment.md describes it.
"""

from __future__ import annotations

import sys
from functools import partial
from typing import TYPE_CHECKING

from v2hdm.cli.door import answer_signals, open_door, version_line

if TYPE_CHECKING:
    from v2hdm.cli.config import Job

_INTERRUPTED = "interrupted; finished drives and detections are kept, the same command goes on from there"
_PORTS = "name ports (+run@ports.port1=port1) or set what is missing on the command line"


def main() -> int:
    """Run the door; 0, or 2 where a user must mend something."""
    if "--version" in sys.argv[1:]:  # Hydra would tell its own
        print(version_line())
        return 0
    return _settle(_experiment)


_settle = partial(open_door, "v2hdm.experiment", "map", _INTERRUPTED)


def _experiment() -> int:
    import torch  # noqa: F401  # its absence is told before that of what is built on it

    from v2hdm.cli.config import work_on
    from v2hdm.experiment.plan import ExperimentConfig

    return work_on("experiment", ExperimentConfig, _run, _settle, __doc__ or "")


def _run(job: Job) -> None:
    from v2hdm.cli import config
    from v2hdm.experiment.plan import ExperimentConfig
    from v2hdm.experiment.run import experiment_on_terminal

    settings = config.to_dataclass(job.composed, ExperimentConfig, _PORTS)
    settings.output = job.folder(settings.output)
    experiment_on_terminal(settings, config.to_yaml(job.composed))


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
