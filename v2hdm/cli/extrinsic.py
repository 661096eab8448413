"""The door to a camera's mounting from bare ground: ``python -m v2hdm.cli.extrinsic DRIVE``, no marking needed.

It needs no torch. One line a camera on stdout and the verdict on the drive, progress on stderr; a calibration
and a picture of the matched ground a camera in the output folder. docs/extrinsic.md describes them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.door import EXIT_FAILED_VERDICT, ShowVersion, answer_signals, open_door

_INTERRUPTED = "interrupted; nothing was written"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the door; 0 for PASS and WARN, 3 for FAIL, 2 with one line on stderr for what cannot be read."""
    parsed = _parser().parse_args(arguments)
    return open_door("v2hdm.cli.extrinsic", "map", _INTERRUPTED, lambda: _estimate(parsed))


def _estimate(parsed: argparse.Namespace) -> int:
    from v2hdm.calibration.from_ground import estimate_mountings

    return EXIT_FAILED_VERDICT if estimate_mountings(parsed) else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m v2hdm.cli.extrinsic", description=__doc__.split("\n\n")[0]
    )
    parser.add_argument("--version", action=ShowVersion)
    parser.add_argument("drive", type=Path, help="the drive's folder; see docs/drive-format.md")
    parser.add_argument(
        "--camera", action="append", default=[], metavar="NAME", help="only this camera; may be repeated"
    )
    parser.add_argument("--format", default="auto", help="auto, folder or kitti (default: auto)")
    parser.add_argument(
        "--output", type=Path, help="folder for the results (default: outputs/<drive>-extrinsic)"
    )
    parser.add_argument("--workers", type=int, default=0, help="processes (default: one per core)")
    return parser


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
