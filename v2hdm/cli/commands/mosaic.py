"""``v2hdm mosaic RESULT`` (docs/report.md)."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from v2hdm.cli.arguments import add_result, steps_of
from v2hdm.cli.command import Command
from v2hdm.errors import MapFileError


def _run(arguments: Sequence[str]) -> None:
    """Add the mosaic to a result: the ground as a GeoTIFF, and pictures before and after."""
    parser = COMMAND.parser()
    add_result(parser)
    parser.add_argument(
        "--resolution", type=float, metavar="M", default=0.02, help="size of a pixel (default: 0.02)"
    )
    parser.add_argument("--device", default="cpu", metavar="NAME", help="cpu or cuda (default: cpu)")
    parsed = parser.parse_args(arguments)
    import torch  # noqa: F401  # its absence is reported before that of what is built on it

    from v2hdm.io.drive import single_drive_of
    from v2hdm.mosaic.result import write_mosaic
    from v2hdm.pipeline.config import check_device
    from v2hdm.report.page.document import write_page
    from v2hdm.store.results import added_to

    logging.basicConfig(format="%(message)s")
    check_device(parsed.device)
    if not parsed.result.is_dir():
        raise MapFileError(f"{parsed.result}: no such folder; give the result folder of v2hdm map")
    drive = single_drive_of(parsed.result, parsed.drive, "a mosaic is")
    with added_to(parsed.result, "RESULT") as folder:
        steps = steps_of("project images onto the ground")
        write_mosaic(folder, drive, parsed.resolution, parsed.device, steps)
        write_page(folder, drive)
    print(f"mosaic in {parsed.result}, and under the map of its report.html")


COMMAND = Command(
    "v2hdm mosaic",
    "Show the ground of a result from above, before and after the optimisation.",
    _run,
    interrupted="interrupted; files in the result folder are complete",
)
