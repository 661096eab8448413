"""``v2hdm calibrate points POINTS.csv --intrinsics FILE``: a camera's mounting and IPM, each with its sigma.

docs/calibrate.md describes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import parser_of
from v2hdm.errors import EXIT_FAILED_VERDICT

_SIGMA = "standard deviation of {}, per coordinate (default: %(default)g {})"


def run(arguments: Sequence[str]) -> int:
    """Calibrate a camera; 0 for PASS and WARN, 3 for FAIL."""
    parser = parser_of("calibrate points")
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
    for option, default, unit, of in (("pixel", 0.5, "PX", "clicking"), ("survey", 0.01, "M", "surveying")):
        meaning = _SIGMA.format(of, unit.lower())
        parser.add_argument(f"--{option}-sigma", type=float, default=default, metavar=unit, help=meaning)
    parser.add_argument(
        "--output", type=Path, help="folder for the results (default: outputs/<camera>-calibrate)"
    )
    parsed = parser.parse_args(arguments)
    from v2hdm.calibration.from_points import calibrate_camera

    return EXIT_FAILED_VERDICT if calibrate_camera(parsed) else 0
