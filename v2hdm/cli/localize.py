"""The door to localisation: ``python -m v2hdm.cli.localize MAP DRIVE``, the vehicle's pose from a map's markings.

Of the recorded poses only the first is used, and all to tell how far off the result is. docs/localize.md
describes it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.door import EXIT_FAILED_VERDICT, ShowVersion, answer_signals, open_door

_INTERRUPTED = "interrupted; nothing was written"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the door; 3 where the map does not explain the drive, 2 with one line for what cannot be read."""
    parsed = _parser().parse_args(arguments)
    return open_door("v2hdm.cli.localize", "map", _INTERRUPTED, lambda: _localise(parsed))


def _localise(parsed: argparse.Namespace) -> int:
    from v2hdm.localization.run import localise_drive

    return 0 if localise_drive(parsed) else EXIT_FAILED_VERDICT


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m v2hdm.cli.localize", description=__doc__.split("\n\n")[0]
    )
    parser.add_argument("--version", action=ShowVersion)
    parser.add_argument("map", type=Path, help="result folder of v2hdm.map, or the map.geojson in it")
    parser.add_argument("drive", type=Path, help="the drive's folder; see docs/drive-format.md")
    parser.add_argument(
        "--camera", action="append", default=[], metavar="NAME", help="only this camera; may be repeated"
    )
    parser.add_argument("--format", default="auto", help="auto, folder or kitti (default: auto)")
    parser.add_argument(
        "--output", type=Path, help="folder for the results (default: outputs/<drive>-localized)"
    )
    parser.add_argument("--workers", type=int, default=0, help="processes (default: one per core)")
    return parser


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
