"""The mapping door: ``python -m v2hdm.map +run=port2`` turns a drive into a map and a calibration."""

from __future__ import annotations

import sys
from functools import partial
from typing import TYPE_CHECKING

from v2hdm.cli.door import EXIT_FAILED_VERDICT, answer_signals, open_door, version_line

if TYPE_CHECKING:
    from v2hdm.cli.config import Job

_INTERRUPTED = "interrupted; what was found so far is kept in the cache, no result was written"
_RUNS = "choose a run (+run=port1, +run=port2, +run=kitti drive.path=...) or set it on the command line"


def main() -> int:
    """Run the door, whose arguments are Hydra overrides (``--help`` lists them), or ``--version``.

    The exit code is 0, 2 where a user must mend something, or 3 where a verdict is FAIL.
    """
    if "--version" in sys.argv[1:]:  # Hydra would tell its own
        print(version_line())
        return 0
    return _settle(_map)


_settle = partial(open_door, "v2hdm.map", "map", _INTERRUPTED)


def _map() -> int:
    from v2hdm.cli.config import work_on
    from v2hdm.pipeline.config import RunConfig

    return work_on("map", RunConfig, _run, _settle, __doc__ or "")


def _run(job: Job) -> int:
    from v2hdm.cli import config, console
    from v2hdm.pipeline.config import RunConfig
    from v2hdm.verdict import Status

    run = config.to_dataclass(job.composed, RunConfig, _RUNS)
    run.output = job.folder(run.output)
    failed = console.run_on_terminal(run, config.to_yaml(job.composed)).status is Status.FAIL
    return EXIT_FAILED_VERDICT if failed else 0


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
