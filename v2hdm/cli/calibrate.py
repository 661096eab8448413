"""The door to a pre-calibration: ``python -m v2hdm.cli.calibrate POINTS.csv --intrinsics FILE``.

From surveyed ground points and their pixels to a camera's mounting and IPM, each with its sigma, and a
verdict on both. docs/calibrate.md describes it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.door import EXIT_FAILED_VERDICT, ShowVersion, answer_signals, open_door

_INTERRUPTED = "interrupted; nothing was written"
_PIXEL_SIGMA, _SURVEY_SIGMA = 0.5, 0.01


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the door; 0 for PASS and WARN, 3 for FAIL, 2 with one line on stderr for what cannot be used."""
    parsed = _parser().parse_args(arguments)
    return open_door("v2hdm.cli.calibrate", "map", _INTERRUPTED, lambda: _calibrate(parsed))


def _calibrate(parsed: argparse.Namespace) -> int:
    from v2hdm.calibration.from_points import calibrate_camera

    return EXIT_FAILED_VERDICT if calibrate_camera(parsed) else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m v2hdm.cli.calibrate", description=__doc__.split("\n\n")[0]
    )
    parser.add_argument("--version", action=ShowVersion)
    parser.add_argument(
        "points",
        type=Path,
        help="CSV with the columns u, v (px), x, y (m, forward and left) and perhaps name",
    )
    parser.add_argument(
        "--intrinsics",
        type=Path,
        required=True,
        metavar="FILE",
        help="the camera's intrinsics, as written by ROS, Kalibr, OpenCV or COLMAP, or by this program",
    )
    parser.add_argument("--camera-name", metavar="NAME", help="which camera of intrinsics that hold several")
    parser.add_argument("--name", help="what to call the camera (default: as the intrinsics call it)")
    parser.add_argument("--image", type=Path, help="the image that was clicked in, for the picture")
    parser.add_argument(
        "--pixel-sigma",
        type=float,
        default=_PIXEL_SIGMA,
        metavar="PX",
        help=f"standard deviation of clicking, per coordinate (default: {_PIXEL_SIGMA:g} px)",
    )
    parser.add_argument(
        "--survey-sigma",
        type=float,
        default=_SURVEY_SIGMA,
        metavar="M",
        help=f"standard deviation of surveying, per coordinate (default: {_SURVEY_SIGMA:g} m)",
    )
    parser.add_argument(
        "--output", type=Path, help="folder for the results (default: outputs/<camera>-calibrate)"
    )
    return parser


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
