"""The command ``python -m export checkpoint=CHECKPOINT output=v2hdm/detection/weights/default.onnx``."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from v2hdm.cli.door import answer_signals, open_door

if TYPE_CHECKING:
    from v2hdm.cli.config import Job

_INTERRUPTED = "interrupted; nothing was written"


def main() -> int:
    """Run the command, whose arguments are Hydra overrides (``--help`` lists them); returns its exit code."""
    return _settle(_export)


_settle = partial(open_door, "export", "train", _INTERRUPTED)


def _export() -> int:
    from export.config import ExportConfig
    from v2hdm.cli.config import work_on

    return work_on("export", ExportConfig, _run, _settle, __doc__ or "")


def _run(job: Job) -> None:
    from export.config import ExportConfig
    from export.console import export
    from v2hdm.cli.config import to_dataclass

    config = to_dataclass(job.composed, ExportConfig, "`python -m export checkpoint=... output=...`")
    output = Path(config.output)
    config.output = str(Path(job.folder(str(output.parent))) / output.name)
    export(config)


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
