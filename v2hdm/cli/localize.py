"""``v2hdm localize MAP DRIVE``: only the first recorded pose is used; the others show how far off it is.

docs/localize.md describes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import add_drive, parser_of
from v2hdm.errors import EXIT_FAILED_VERDICT


def run(arguments: Sequence[str]) -> int:
    """Localise a drive in a map; 3 where the map does not explain the drive."""
    parser = parser_of("localize")
    parser.add_argument("map", type=Path, help="result folder of v2hdm map, or the map.geojson in it")
    add_drive(parser, "localized")
    parsed = parser.parse_args(arguments)
    from v2hdm.localization.run import localise_drive

    return 0 if localise_drive(parsed) else EXIT_FAILED_VERDICT
