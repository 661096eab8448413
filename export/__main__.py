"""``python -m export checkpoint=CHECKPOINT output=FILE.onnx``: its arguments are Hydra overrides."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from v2hdm.cli.main import Command, answer_signals

if TYPE_CHECKING:
    from v2hdm.cli.compose import Job

_COMMAND = Command("python -m export", "Export a checkpoint of the detector to ONNX.", "train")


def main() -> int:
    """Export; returns the exit code."""
    return _COMMAND.guard(_export)


def _export() -> int:
    from export.config import ExportConfig
    from v2hdm.cli.compose import work_on

    advice = "`python -m export checkpoint=... output=...`"
    return work_on(_COMMAND, "export", ExportConfig, _run, sys.argv[1:], advice)


def _run(job: Job) -> None:
    from export.console import export

    export(job.settings)


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
