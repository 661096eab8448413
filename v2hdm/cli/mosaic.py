"""The door to the mosaic: ``python -m v2hdm.cli.mosaic RESULT`` shows the ground of a finished run from above.

Of all images, with the adjusted poses and calibrations: a GeoTIFF, a picture, and the same ground before and
after the optimisation side by side. docs/mosaic.md describes it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.door import ShowVersion, answer_signals, open_door

_INTERRUPTED = "interrupted; files that stand in the result folder are whole"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the door; 0, or 2 with one line on stderr for what a user must mend."""
    parsed = _parser().parse_args(arguments)
    return open_door("v2hdm.cli.mosaic", "map", _INTERRUPTED, lambda: _mosaic(parsed))


def _mosaic(parsed: argparse.Namespace) -> None:
    import torch  # noqa: F401  # its absence is told before that of what is built on it

    from v2hdm.pipeline.mosaic import mosaic_of_result

    for line in mosaic_of_result(parsed):
        print(line)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m v2hdm.cli.mosaic", description=__doc__.split("\n\n")[0])
    parser.add_argument("--version", action=ShowVersion)
    parser.add_argument("result", type=Path, help="result folder of v2hdm.map")
    parser.add_argument(
        "--drive", type=Path, help="the drive's folder (default: where it was when it was mapped)"
    )
    parser.add_argument(
        "--resolution", type=float, metavar="M", help="side of a pixel on the ground (default: 0.02 m)"
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda (default: cpu)")
    return parser


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
