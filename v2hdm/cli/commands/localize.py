"""``v2hdm localize MAP DRIVE``: find a drive's poses in a map (docs/living-map.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.arguments import add_drive, drive_of, result_of, steps_of
from v2hdm.cli.command import Command
from v2hdm.errors import EXIT_FAILED_VERDICT


def _run(arguments: Sequence[str]) -> int:
    """Localise a drive in a map; 3 if the map does not explain the drive.

    Only the first recorded pose is used; the others show how far off it is.
    """
    parser = COMMAND.parser()
    parser.add_argument("map", type=Path, help="result folder of v2hdm map, or the map.geojson in it")
    add_drive(parser, "localized")
    parsed = parser.parse_args(arguments)
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


COMMAND = Command("v2hdm localize", "Find the vehicle's poses from the markings of a map.", _run)
