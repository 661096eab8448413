"""``v2hdm calibrate points``: a camera from surveyed ground points and their pixels (docs/calibration.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.arguments import exit_code, result_of
from v2hdm.cli.command import Command
from v2hdm.errors import ConfigError, DriveError

_SIGMA = "standard deviation of a {}, per coordinate (default: %(default)g {})"


def _run(arguments: Sequence[str]) -> int:
    """Estimate a camera's mounting and IPM with their sigmas; 0 for PASS and WARN, 3 for FAIL."""
    parser = COMMAND.parser()
    columns = "CSV with the columns u, v (px), x, y (m, forward and left) and optionally name"
    parser.add_argument("points", type=Path, help=columns)
    written = "the camera's intrinsics, as written by ROS, Kalibr, OpenCV or COLMAP, or by this program"
    parser.add_argument("--intrinsics", type=Path, required=True, metavar="FILE", help=written)
    parser.add_argument("--camera-name", metavar="NAME", help="the camera to use if the file has several")
    parser.add_argument("--name", help="name of the camera (default: that in the intrinsics)")
    parser.add_argument("--image", type=Path, metavar="FILE", help="where the pixels were read, to draw on")
    for option, default, unit in (("pixel", 0.5, "PX"), ("survey", 0.01, "M")):
        meaning = _SIGMA.format(option, unit.lower())
        parser.add_argument(f"--{option}-sigma", type=float, default=default, metavar=unit, help=meaning)
    parser.add_argument("--output", type=Path, metavar="DIR", help="default: outputs/<camera>-calibrate")
    parsed = parser.parse_args(arguments)
    from dataclasses import replace

    from v2hdm.calibration.from_points import calibrate_from_points, summary_lines, write_point_calibration
    from v2hdm.calibration.points import read_points
    from v2hdm.detection.frames import read_bgr
    from v2hdm.io.calibration.intrinsics import read_intrinsics
    from v2hdm.safe.texts import take_camera_name

    info = read_intrinsics(parsed.intrinsics, parsed.camera_name, "--camera-name")
    info = replace(info, name=parsed.name or info.name)
    take_camera_name(info.name, "--name" if parsed.name else f"{parsed.intrinsics} (--name)", ConfigError)
    points = read_points(parsed.points)
    image = None if parsed.image is None else read_bgr(parsed.image)
    if image is not None and image.shape[:2] != (info.height, info.width):
        raise DriveError(
            f"{parsed.image}: the image is {image.shape[1]} x {image.shape[0]}, but the intrinsics of "
            f"'{info.name}' are for {info.width} x {info.height}; give both at the same size"
        )
    sigmas = {"pixel_sigma": parsed.pixel_sigma, "survey_sigma": parsed.survey_sigma}
    calibrated = calibrate_from_points(points, info, **sigmas)
    folder = parsed.output or Path("outputs") / f"{info.name}-calibrate"
    files = {"points": str(parsed.points), "intrinsics": str(parsed.intrinsics)}
    settings = {**files, "image": None if parsed.image is None else str(parsed.image), **sigmas}
    with result_of(folder, f"v2hdm calibrate points of {parsed.points.resolve()}", settings) as unfinished:
        write_point_calibration(calibrated, unfinished, image)
    print("\n".join([*summary_lines(calibrated), f"results in {folder}"]))
    return exit_code(calibrated.verdict)


COMMAND = Command(
    "v2hdm calibrate points", "Calibrate a camera from surveyed ground points and their pixels.", _run
)
