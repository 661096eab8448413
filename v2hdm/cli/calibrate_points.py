"""``v2hdm calibrate points POINTS.csv --intrinsics FILE``: a camera's mounting and IPM, each with its sigma.

docs/calibration.md describes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import exit_code, parser_of, result_of
from v2hdm.errors import ConfigError, DriveError

_SIGMA = "standard deviation of {}, per coordinate (default: %(default)g {})"


def run(arguments: Sequence[str]) -> int:
    """Calibrate a camera; 0 for PASS and WARN, 3 for FAIL."""
    parser = parser_of("calibrate points")
    columns = "CSV with the columns u, v (px), x, y (m, forward and left) and perhaps name"
    parser.add_argument("points", type=Path, help=columns)
    written = "the camera's intrinsics, as written by ROS, Kalibr, OpenCV or COLMAP, or by this program"
    parser.add_argument("--intrinsics", type=Path, required=True, metavar="FILE", help=written)
    parser.add_argument("--camera-name", metavar="NAME", help="which camera of intrinsics that hold several")
    parser.add_argument("--name", help="what to call the camera (default: as the intrinsics call it)")
    parser.add_argument("--image", type=Path, help="the image that was clicked in, for the picture")
    for option, default, unit, of in (("pixel", 0.5, "PX", "clicking"), ("survey", 0.01, "M", "surveying")):
        meaning = _SIGMA.format(of, unit.lower())
        parser.add_argument(f"--{option}-sigma", type=float, default=default, metavar=unit, help=meaning)
    parser.add_argument("--output", type=Path, help="folder of results (default: outputs/<camera>-calibrate)")
    parsed = parser.parse_args(arguments)
    from dataclasses import replace

    from v2hdm.calibration.from_points import calibrate_from_points, summary_lines, write_point_calibration
    from v2hdm.calibration.points import read_points
    from v2hdm.detection.frames import read_bgr
    from v2hdm.io.calibration.intrinsics import read_intrinsics
    from v2hdm.io.safe.texts import take_camera_name

    info = read_intrinsics(parsed.intrinsics, parsed.camera_name, "--camera-name")
    info = replace(info, name=parsed.name or info.name)
    take_camera_name(info.name, "--name" if parsed.name else f"{parsed.intrinsics} (--name)", ConfigError)
    points = read_points(parsed.points)
    image = None if parsed.image is None else read_bgr(parsed.image)
    if image is not None and image.shape[:2] != (info.height, info.width):
        raise DriveError(
            f"{parsed.image}: the image is {image.shape[1]} x {image.shape[0]}, but the intrinsics of "
            f"'{info.name}' are for {info.width} x {info.height}; give both for one size"
        )
    sigmas = {"pixel_sigma": parsed.pixel_sigma, "survey_sigma": parsed.survey_sigma}
    found = calibrate_from_points(points, info, **sigmas)
    folder = parsed.output or Path("outputs") / f"{info.name}-calibrate"
    files = {"points": str(parsed.points), "intrinsics": str(parsed.intrinsics)}
    settings = {**files, "image": None if parsed.image is None else str(parsed.image), **sigmas}
    with result_of(folder, f"v2hdm calibrate points of {parsed.points.resolve()}", settings) as unfinished:
        write_point_calibration(found, unfinished, image)
    print(*summary_lines(found), f"results in {folder}", sep="\n")
    return exit_code(found.verdict)
