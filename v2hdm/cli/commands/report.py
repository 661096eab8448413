"""``v2hdm report RESULT`` (docs/report.md)."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.arguments import add_result
from v2hdm.cli.command import Command


def _run(arguments: Sequence[str]) -> None:
    """Write ``report.html`` again: after an update, or where check points or a mosaic were added."""
    parser = COMMAND.parser()
    add_result(parser)
    under = "picture under the map: a GeoTIFF, such as an aerial photograph, or a folder of XYZ tiles"
    parser.add_argument("--background", type=Path, metavar="PATH", help=under)
    parsed = parser.parse_args(arguments)
    import cv2  # noqa: F401  # the absence of these is reported before anything is read
    import jinja2  # noqa: F401

    from v2hdm.io.drive import drive_of
    from v2hdm.store.results import added_to

    drive = drive_of(parsed.result, parsed.drive)
    print("draw the report", file=sys.stderr, flush=True)
    from v2hdm.report.page.document import write_page  # the libraries of its charts, which takes seconds

    with added_to(parsed.result, "RESULT") as folder:
        path = write_page(folder, drive, parsed.background)
    without = "" if drive else ", without the drive's images"
    print(f"{parsed.result / path.name}: {path.stat().st_size / 1e6:.1f} MB{without}")


COMMAND = Command(
    "v2hdm report",
    "Write the report.html of a result again.",
    _run,
    interrupted="interrupted; the report is unchanged",
)
