"""The door to the report: ``python -m v2hdm.report RESULT_FOLDER`` makes its ``report.html`` again.

Every run writes one. Again, from the files of the folder and the images of the drive: after an update, or
where check points or a mosaic were added. docs/report.md describes it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.door import ShowVersion, answer_signals, open_door


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the door; 2 with one line for what cannot be read."""
    parsed = _parser().parse_args(arguments)
    return open_door("v2hdm.report", "map", "interrupted; the report is as it was", lambda: _report(parsed))


def _report(parsed: argparse.Namespace) -> None:
    from v2hdm.io.drive.of_result import drive_of
    from v2hdm.report.page.document import write_page
    from v2hdm.store.results import added_to

    drive = drive_of(parsed.folder, parsed.drive)
    with added_to(parsed.folder, "folder") as folder:
        path = write_page(folder, drive)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB" + ("" if drive else ", without the drive's images"))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m v2hdm.report", description=__doc__.split("\n\n")[0])
    parser.add_argument("--version", action=ShowVersion)
    parser.add_argument("folder", type=Path, help="result folder of v2hdm.map")
    parser.add_argument(
        "--drive",
        type=Path,
        help="the drive that it mapped (default: where it was then, if it is there still)",
    )
    return parser


if __name__ == "__main__":
    answer_signals()
    sys.exit(main())
