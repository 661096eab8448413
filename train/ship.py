"""``python -m train.ship runs/gpu`` makes a trained network the detector's own.

It exports the network, fits the judge, the confidence and the score of lanes to it, and puts all of them with
their manifest where the detector looks for them. Nothing is put there before everything is done.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.command import Command
from v2hdm.cli.main import answer_signals


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit code is 0, or 2 with one line on stderr for what a user can mend."""
    return COMMAND(sys.argv[1:] if arguments is None else arguments)


def _run(arguments: Sequence[str]) -> None:
    parsed = _parser().parse_args(arguments)
    from train.shipment import Order, ship_on_terminal

    ship_on_terminal(Order(**vars(parsed)))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m train.ship", description=__doc__.split("\n\n")[1])
    parser.add_argument(
        "source",
        type=Path,
        help="folder of a training, a checkpoint, or an exported .onnx file (one of int8 is taken as it is)",
    )
    parser.add_argument("--into", type=Path, help="folder of the files (default: that of the detector)")
    parser.add_argument("--precision", choices=("int8", "float32"), default="int8", help="of the network")
    parser.add_argument(
        "--keep",
        nargs="+",
        choices=("network", "judge", "lane_score"),
        default=(),
        help="files of the folder that are kept instead of fitted anew; of the network all but its classes",
    )
    parser.add_argument("--judge-images", type=int, default=1650, help="renders that the judge learns from")
    parser.add_argument("--lane-images", type=int, default=450, help="renders for the score of lanes")
    parser.add_argument(
        "--labels",
        type=Path,
        metavar="TRAINING",
        help="a training from whose labelled photographs the judge learns, too (default: the source, where "
        "it is one)",
    )
    parser.add_argument("--workers", type=int, default=0, help="processes (default: one per core)")
    return parser


COMMAND = Command(
    "python -m train.ship",
    "Make a trained network the detector's own.",
    _run,
    extra="train",
    interrupted="interrupted; the same command resumes from here, and the detector's files are unchanged",
)

if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
