"""``python -m export checkpoint=CHECKPOINT output=FILE.onnx``: its arguments are Hydra overrides."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from v2hdm.cli.command import Command
from v2hdm.cli.main import answer_signals

if TYPE_CHECKING:
    from v2hdm.cli.compose import Job


def main() -> int:
    """Export; returns the exit code."""
    return COMMAND(sys.argv[1:])


def _run(arguments: Sequence[str]) -> int:
    from export.config import ExportConfig
    from v2hdm.cli.compose import Door, work_on

    advice = "`python -m export checkpoint=... output=...`"
    return work_on(COMMAND, Door("export", ExportConfig, advice), _export, arguments)


def _export(job: Job) -> None:
    from export.console import export

    export(job.settings)


COMMAND = Command("python -m export", "Export a checkpoint of the detector to ONNX.", _run, extra="train")

if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
