"""``v2hdm localize MAP DRIVE``: find poses in a map (docs/living-map.md), live too (docs/live.md)."""

from __future__ import annotations

import argparse
import gc
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.arguments import add_drive, drive_of, result_of, steps_of
from v2hdm.cli.command import Command, need_installed
from v2hdm.errors import EXIT_FAILED_VERDICT, ConfigError
from v2hdm.settings import THREAD_VARIABLES

_MAP = "result folder of v2hdm map, or the map.geojson in it"


def _run(arguments: Sequence[str]) -> int:
    """Localise a drive in a map; 3 if the map does not explain the drive.

    Only the first recorded pose is used; the others show how far off it is.
    """
    if "--live" in arguments:
        return _run_live(arguments)
    parser = COMMAND.parser()
    parser.add_argument("map", type=Path, help=_MAP)
    add_drive(parser, "localized")
    parser.add_argument("--live", action="store_true", help="while the vehicle drives: see --live --help")
    parsed = parser.parse_args(arguments)
    need_installed("torch")  # before the drive is read, and long before it is loaded
    from v2hdm.io.calibration.reading import trusted_calibrations
    from v2hdm.io.maps.reading import read_geojson
    from v2hdm.store.names import map_file

    path = map_file(parsed.map)
    hd_map = read_geojson(path)
    calibrations = trusted_calibrations(path.parent)
    drive = drive_of(parsed)
    folder = parsed.output or Path("outputs") / f"{drive.name}-localized"
    settings = {"map": str(parsed.map), "drive": str(parsed.drive), "cameras": list(drive.cameras)}
    maker = f"v2hdm localize of {parsed.drive.resolve()} in {path.resolve()}"
    steps = steps_of("images")
    with result_of(folder, maker, settings) as unfinished:
        steps(0, len(drive.images))
        from v2hdm.localization.run import localize, summary_lines, write_localised  # torch, among others

        located = localize(hd_map, drive, calibrations, workers=parsed.workers, progress=steps)
        write_localised(located, drive, unfinished)
    print("\n".join([*summary_lines(located), f"results in {folder}"]))
    return 0 if located.explained else EXIT_FAILED_VERDICT


def _live_parser() -> argparse.ArgumentParser:
    """The options of a vehicle as it drives."""
    parser = COMMAND.parser()
    parser.add_argument("map", type=Path, help=_MAP)
    parser.add_argument(
        "--live", action="store_true", required=True, help="localise while the vehicle drives"
    )
    image = "a camera's name and its device index, or the folder that receives its images; repeatable"
    parser.add_argument("--images", action="append", required=True, metavar="CAMERA=SOURCE", help=image)
    motion = "speeds, yaw rates and any positions: a file that grows, or - for stdin"
    parser.add_argument("--motion", required=True, metavar="FILE", help=motion)
    begin = "start, within 5 m and 20 deg; the heading counts from east to north (default: anywhere)"
    parser.add_argument("--start", type=float, nargs=3, metavar=("EAST", "NORTH", "HEADING"), help=begin)
    antenna = "place of the positions' antenna: m ahead of the rear axle and to the left (default: 0 0)"
    parser.add_argument(
        "--antenna", type=float, nargs=2, default=(0.0, 0.0), metavar=("AHEAD", "LEFT"), help=antenna
    )
    calibration = "calibration of a camera (default: those beside the map); repeatable"
    parser.add_argument(
        "--calibration", action="append", type=Path, default=[], metavar="FILE", help=calibration
    )
    parser.add_argument(
        "--delay", type=float, default=0.0, metavar="S", help="age of a picture when its file is dated, s"
    )
    full = "search one of N images of a camera as a whole, the others where the map expects markings"
    parser.add_argument("--every-full", type=int, default=5, metavar="N", help=f"{full} (default: 5)")
    parser.add_argument("--limit", type=int, metavar="N", help="stop after N images")
    parser.add_argument(
        "--output", type=Path, metavar="FILE", help="file for the JSON lines (default: stdout)"
    )
    mcap = "a new folder for an MCAP of ROS 2 messages (extra ros)"
    parser.add_argument("--mcap", type=Path, metavar="DIR", help=mcap)
    return parser


def _run_live(arguments: Sequence[str]) -> int:
    """Localise a vehicle as it drives, until Ctrl-C."""
    parsed = _live_parser().parse_args(arguments)
    # The filter's matrices are small: several threads of BLAS would spin on the cores that detection needs.
    for variable in THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")
    from v2hdm.io.calibration.reading import trusted_calibrations
    from v2hdm.io.maps.reading import read_geojson
    from v2hdm.localization.live import localize_live
    from v2hdm.localization.localizer import Localizer
    from v2hdm.localization.messages import pose_bag
    from v2hdm.localization.places import rough_position
    from v2hdm.localization.pose import Pose
    from v2hdm.localization.stream import MotionLines, pose_record
    from v2hdm.store.lines import lines_to
    from v2hdm.store.names import CALIBRATIONS, map_file

    path = map_file(parsed.map)
    hd_map = read_geojson(path)
    files = parsed.calibration or sorted(path.parent.glob(CALIBRATIONS)) or [path.parent]
    content = {file: calibration for file in files for calibration in trusted_calibrations(file).values()}
    by_camera = {calibration.info.name: file for file, calibration in content.items()}
    sources = _sources(parsed, by_camera)
    calibrations = {name: content[by_camera[name]] for name in sources}
    prior = None if parsed.start is None else rough_position(*parsed.start)
    if parsed.every_full < 1:
        raise ConfigError(f"--every-full {parsed.every_full}: give a number of images, 1 or more")
    localizer = Localizer(hd_map, calibrations, prior, antenna_m=parsed.antenna, every_full=parsed.every_full)
    is_stdin = parsed.motion == "-"
    lines = MotionLines("standard input" if is_stdin else parsed.motion, hd_map.origin)
    stream_in = sys.stdin if is_stdin else Path(parsed.motion)

    gc.freeze()  # the map outlives every image: no collection need look at it again
    lines_of_poses = lines_to(parsed.output, b'{"stamp_s": ', "poses", grows=True)
    with pose_bag(parsed.mcap) as write_message, lines_of_poses as stream:

        def write(pose: Pose) -> None:
            print(json.dumps(pose_record(pose)), file=stream, flush=True)
            write_message(pose)

        try:
            localize_live(
                localizer,
                sources,
                by_camera,
                stream_in,
                lines,
                write,
                delay_s=parsed.delay,
                limit=parsed.limit,
            )
        except KeyboardInterrupt:
            return 0
    return 0


def _sources(parsed: argparse.Namespace, calibrations: dict[str, Path]) -> dict[str, str]:
    """The source of each camera; ConfigError for one that is not calibrated."""
    sources = {}
    for stated in parsed.images:
        name, equals, source = stated.partition("=")
        if not equals or not source:
            raise ConfigError(
                f"--images {stated}: give a camera's name and its folder, as front=images/front"
            )
        if name not in calibrations:
            names = ", ".join(calibrations) or "none"
            raise ConfigError(f"--images {stated}: no calibration of camera '{name}'; there are: {names}")
        sources[name] = source
    return sources


COMMAND = Command("v2hdm localize", "Find the vehicle's poses from the markings of a map.", _run)
