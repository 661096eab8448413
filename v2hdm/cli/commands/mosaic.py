"""``v2hdm mosaic RESULT`` (docs/report.md)."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence

from v2hdm.cli.arguments import add_result, steps_of
from v2hdm.cli.command import Command
from v2hdm.errors import MapFileError

_log = logging.getLogger(__name__)


def _run(arguments: Sequence[str]) -> None:
    """Add the mosaic to a result: the ground as a GeoTIFF, and pictures before and after."""
    parser = COMMAND.parser()
    add_result(parser)
    parser.add_argument(
        "--resolution", type=float, metavar="M", default=0.02, help="size of a pixel (default: 0.02)"
    )
    workers = "number of processes (default: all cores)"
    parser.add_argument("--workers", type=int, default=0, metavar="N", help=workers)
    parser.add_argument("--device", help=argparse.SUPPRESS)  # of 1.0
    parsed = parser.parse_args(arguments)
    from v2hdm.executor import open_executor
    from v2hdm.io.drive import single_drive_of
    from v2hdm.mosaic.result import write_mosaic
    from v2hdm.report.page.document import write_page
    from v2hdm.settings import check_workers
    from v2hdm.store.results import added_to

    logging.basicConfig(format="%(message)s")
    check_workers(parsed.workers)
    if parsed.device is not None:
        _log.warning("--device has no effect since 1.1 and goes with 2.0: leave it out")
    if not parsed.result.is_dir():
        raise MapFileError(f"{parsed.result}: no such folder; give the result folder of v2hdm map")
    drive = single_drive_of(parsed.result, parsed.drive, "a mosaic is")
    with added_to(parsed.result, "RESULT") as folder, open_executor(parsed.workers) as executor:
        steps = steps_of("project images onto the ground")
        write_mosaic(folder, drive, parsed.resolution, steps, executor)
        write_page(folder, drive)
    print(f"mosaic in {parsed.result}, and under the map of its report.html")


COMMAND = Command(
    "v2hdm mosaic",
    "Show the ground of a result from above, before and after the optimisation.",
    _run,
    interrupted="interrupted; files in the result folder are complete",
)
