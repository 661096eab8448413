"""The door: ``python -m export checkpoint=CHECKPOINT output=v2hdm/detection/weights/default.onnx``."""

from __future__ import annotations

import sys

from v2hdm.door import answer_signals, open_door

_INTERRUPTED = "interrupted; nothing was written"


def main() -> int:
    """Run the door, whose arguments are Hydra overrides (``--help`` lists them); returns its exit code."""
    return open_door("export", "train", _INTERRUPTED, _export)


def _export() -> None:
    from export.config import ExportConfig
    from export.console import export
    from v2hdm.config import compositions, to_dataclass

    for composed in compositions("export", ExportConfig):
        export(to_dataclass(composed, ExportConfig, "`python -m export checkpoint=... output=...`"))


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
