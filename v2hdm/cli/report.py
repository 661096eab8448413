"""``v2hdm report RESULT``: the report, from the files of the folder and the images of the drive.

Every run writes one; again after an update, or where check points or a mosaic were added (docs/report.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import parser_of


def run(arguments: Sequence[str]) -> None:
    """Write ``report.html``."""
    parser = parser_of("report")
    parser.add_argument("folder", type=Path, help="result folder of v2hdm map")
    parser.add_argument("--drive", type=Path, help="the drive that it mapped (default: where it was then)")
    parser.add_argument(
        "--background",
        type=Path,
        metavar="PATH",
        help="under the map: a GeoTIFF, such as an aerial picture, or a folder of XYZ tiles",
    )
    parsed = parser.parse_args(arguments)
    from v2hdm.io.drive.of_result import drive_of
    from v2hdm.report.page.document import write_page
    from v2hdm.store.results import added_to

    drive = drive_of(parsed.folder, parsed.drive)
    with added_to(parsed.folder, "folder") as folder:
        path = write_page(folder, drive, parsed.background)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB" + ("" if drive else ", without the drive's images"))
