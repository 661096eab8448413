"""``v2hdm localize MAP DRIVE``: only the first recorded pose is used; the others show how far off it is.

docs/living-map.md describes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import add_drive, drive_of, parser_of, result_of, steps_of
from v2hdm.errors import EXIT_FAILED_VERDICT


def run(arguments: Sequence[str]) -> int:
    """Localise a drive in a map; 3 where the map does not explain the drive."""
    parser = parser_of("localize")
    parser.add_argument("map", type=Path, help="result folder of v2hdm map, or the map.geojson in it")
    add_drive(parser, "localized")
    parsed = parser.parse_args(arguments)
    from v2hdm.io.calibration.reading import trusted_calibrations
    from v2hdm.io.maps.reading import read_geojson
    from v2hdm.localization.run import localize, summary_lines, write_localised

    path = parsed.map / "map.geojson" if parsed.map.is_dir() else parsed.map
    hd_map, calibrations = read_geojson(path), trusted_calibrations(path.parent)
    drive = drive_of(parsed)
    folder = parsed.output or Path("outputs") / f"{drive.name}-localized"
    settings = {"map": str(parsed.map), "drive": str(parsed.drive), "cameras": list(drive.cameras)}
    with result_of(folder, settings) as unfinished:
        found = localize(hd_map, drive, calibrations, workers=parsed.workers, progress=steps_of("images"))
        write_localised(found, drive, unfinished)
    print(*summary_lines(found), f"results in {folder}", sep="\n")
    return 0 if found.explained else EXIT_FAILED_VERDICT
