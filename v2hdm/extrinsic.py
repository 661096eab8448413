"""The door to a camera's mounting from bare ground: ``python -m v2hdm.extrinsic DRIVE``, no marking needed.

It needs the base install only. One line a camera on stdout, progress on stderr; a calibration and a picture
of the matched ground a camera in the output folder. docs/extrinsic.md describes them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from v2hdm.door import answer_signals, open_door

_INTERRUPTED = "interrupted before the last camera; what is in the output folder is whole"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the door; the exit code is 0, or 2 with one line on stderr for what a user got wrong."""
    parsed = _parser().parse_args(arguments)
    return open_door("v2hdm.extrinsic", None, _INTERRUPTED, lambda: _estimate(parsed))


def _estimate(parsed: argparse.Namespace) -> None:
    from v2hdm.drive import ReadOptions, read_drive
    from v2hdm.ground.write import estimate_and_write

    drive = read_drive(parsed.drive, ReadOptions(format=parsed.format, cameras=parsed.camera or []))
    output = parsed.output or Path("outputs") / f"{drive.name}-extrinsic"
    estimate_and_write(drive, output)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m v2hdm.extrinsic", description=__doc__.split("\n\n")[0])
    parser.add_argument("drive", type=Path, help="the drive's folder; see docs/drive-format.md")
    parser.add_argument("--camera", action="append", metavar="NAME", help="only this camera; may be repeated")
    parser.add_argument("--format", default="auto", help="auto, folder or kitti (default: auto)")
    parser.add_argument(
        "--output", type=Path, help="folder for the results (default: outputs/<drive>-extrinsic)"
    )
    return parser


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
