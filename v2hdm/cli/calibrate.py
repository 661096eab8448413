"""``v2hdm calibrate points``, ``ground`` and ``compare``; see docs/calibration.md."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from v2hdm.cli.main import add_drive, drive_of, exit_code, parser_of, result_of, steps_of
from v2hdm.errors import EXIT_FAILED_VERDICT, ConfigError, DriveError

if TYPE_CHECKING:
    from v2hdm.calibration.compare import Movement

_SIGMA = "standard deviation of {}, per coordinate (default: %(default)g {})"


def from_points(arguments: Sequence[str]) -> int:
    """Estimate a camera's mounting and IPM with their sigmas; 0 for PASS and WARN, 3 for FAIL."""
    parser = parser_of("calibrate points")
    columns = "CSV with the columns u, v (px), x, y (m, forward and left) and optionally name"
    parser.add_argument("points", type=Path, help=columns)
    written = "the camera's intrinsics, as written by ROS, Kalibr, OpenCV or COLMAP, or by this program"
    parser.add_argument("--intrinsics", type=Path, required=True, metavar="FILE", help=written)
    parser.add_argument("--camera-name", metavar="NAME", help="the camera to use if the file has several")
    parser.add_argument("--name", help="name of the camera (default: that in the intrinsics)")
    parser.add_argument("--image", type=Path, metavar="FILE", help="where the pixels were read, to draw on")
    for option, default, unit, of in (("pixel", 0.5, "PX", "a pixel"), ("survey", 0.01, "M", "a survey")):
        meaning = _SIGMA.format(of, unit.lower())
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
    found = calibrate_from_points(points, info, **sigmas)
    folder = parsed.output or Path("outputs") / f"{info.name}-calibrate"
    files = {"points": str(parsed.points), "intrinsics": str(parsed.intrinsics)}
    settings = {**files, "image": None if parsed.image is None else str(parsed.image), **sigmas}
    with result_of(folder, f"v2hdm calibrate points of {parsed.points.resolve()}", settings) as unfinished:
        write_point_calibration(found, unfinished, image)
    print(*summary_lines(found), f"results in {folder}", sep="\n")
    return exit_code(found.verdict)


def from_ground(arguments: Sequence[str]) -> int:
    """Estimate mountings, one line per camera, without torch; 0 for PASS and WARN, 3 for FAIL."""
    parser = parser_of("calibrate ground")
    add_drive(parser, "extrinsic")
    parsed = parser.parse_args(arguments)
    from v2hdm.calibration.from_ground import calibrate_from_ground, summary_lines, write_ground_calibration

    drive = drive_of(parsed)
    folder = parsed.output or Path("outputs") / f"{drive.name}-extrinsic"
    settings = {"drive": str(parsed.drive), "cameras": list(drive.cameras)}
    with result_of(folder, f"v2hdm calibrate ground of {parsed.drive.resolve()}", settings) as unfinished:
        found = calibrate_from_ground(drive, workers=parsed.workers, progress=steps_of("match ground"))
        write_ground_calibration(found, unfinished)
    print(*summary_lines(found), f"results in {folder}", sep="\n")
    return exit_code(found.verdict)


_LEAST = 1e-12  # smaller probabilities are all the same


def compare(arguments: Sequence[str]) -> int:
    """Compare two calibrations of each camera; 0 if none has moved, 3 if one has."""
    parser = parser_of("calibrate compare")
    parser.add_argument("before", type=Path, help="result folder or calibration file of the earlier drive")
    parser.add_argument("after", type=Path, help="the same from the later drive")
    parser.add_argument("--json", action="store_true", help="print one JSON list instead of lines")
    parsed = parser.parse_args(arguments)
    from v2hdm.calibration.compare import compare_calibrations, turned_alike
    from v2hdm.io.calibration.reading import trusted_calibrations

    before, after = (trusted_calibrations(path) for path in (parsed.before, parsed.after))
    movements = compare_calibrations(before, after)
    if parsed.json:
        print(json.dumps([_as_json(one) for one in movements]))
    else:
        for one in movements:
            print(_line(one))
        if turned_alike(movements):
            print(
                "all cameras have turned alike: more likely the vehicle's heading, or the frame of the "
                "poses, has changed"
            )
    for name in sorted(before.keys() ^ after.keys()):
        print(f"{name}: only in one of the two; not compared", file=sys.stderr)
    return EXIT_FAILED_VERDICT if any(one.moved for one in movements) else 0


def _line(one: Movement) -> str:
    from numpy import degrees

    parts = [
        f"{axis} {1e3 * value:+.0f} +- {1e3 * sigma:.0f} mm"
        for axis, value, sigma in zip(("forward", "left", "up"), one.shift_m, one.sigma[:3], strict=True)
    ] + [
        f"{axis} {degrees(value):+.2f} +- {degrees(sigma):.2f} deg"
        for axis, value, sigma in zip(("roll", "pitch", "yaw"), one.turn_rad, one.sigma[3:], strict=True)
    ]
    least_mm = 1e3 * one.detectable[:3].max()
    least_deg = degrees(one.detectable[3:].max())
    found = (
        f"MOVED (by chance in at most {max(one.probability, _LEAST):.1g} of such pairs)"
        if one.moved
        else f"not moved (a shift of {least_mm:.0f} mm or a turn of {least_deg:.2f} deg would have shown)"
    )
    return f"{one.camera}: {found}: {', '.join(parts)}"


def _as_json(one: Movement) -> dict[str, object]:
    arrays = {key: getattr(one, key).tolist() for key in ("shift_m", "turn_rad", "covariance", "detectable")}
    return {"camera": one.camera, "moved": one.moved, "probability": one.probability, **arrays}
