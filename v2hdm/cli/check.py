"""The checking door: ``python -m v2hdm.cli.check DRIVE`` says in seconds what is wrong with a drive.

One line a finding, a verdict, and pictures: the route, and horizon and metric ground grid in sample images of
every camera. docs/check.md says what each finding means. It needs no torch.
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
    return open_door("v2hdm.cli.check", "map", _INTERRUPTED, lambda: _check(parsed))


def _check(parsed: argparse.Namespace) -> int:
    if parsed.list_topics:
        from v2hdm.io.drive import ReadOptions
        from v2hdm.io.importers.bag.describe import list_topics

        print(list_topics(parsed.drive, Path(ReadOptions().cache)))
        return 0
    from v2hdm.verdict.check import check_up

    return EXIT_FAILED_VERDICT if check_up(parsed) else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m v2hdm.cli.check", description=__doc__.split("\n\n")[0])
    parser.add_argument("--version", action=ShowVersion)
    parser.add_argument("drive", type=Path, help="a drive folder or a bag, in any format that is mapped")
    parser.add_argument(
        "--camera", action="append", default=[], metavar="NAME", help="check this camera; may be repeated"
    )
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help="folder of the pictures (default: outputs/<drive>-check)"
    )
    parser.add_argument(
        "--no-ground", dest="ground", action="store_false", help="do not match bare ground: faster, says less"
    )
    parser.add_argument(
        "--list-topics", action="store_true", help="only list a bag's topics, and the drive.yaml for it"
    )
    parser.add_argument("--all", action="store_true", help="also print the checks that passed")
    parser.add_argument("--workers", type=int, default=0, help="processes (default: one per core)")
    return parser


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
