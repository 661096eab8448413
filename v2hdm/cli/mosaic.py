"""``v2hdm mosaic RESULT``: the ground from above, as a GeoTIFF and as pictures before and after.

docs/report.md describes it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import parser_of, steps_of
from v2hdm.errors import MapFileError


def run(arguments: Sequence[str]) -> None:
    """Add the mosaic to a result."""
    parser = parser_of("mosaic")
    parser.add_argument("result", type=Path, help="result folder of v2hdm map")
    parser.add_argument("--drive", type=Path, help="the drive's folder (default: where it was when mapped)")
    parser.add_argument("--resolution", type=float, metavar="M", default=0.02, help="side of a pixel (0.02)")
    parser.add_argument("--device", default="cpu", help="cpu or cuda (default: cpu)")
    parsed = parser.parse_args(arguments)
    import torch  # noqa: F401  # its absence is reported before that of what is built on it

    from v2hdm.io.drive.of_result import single_drive_of
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
        steps = steps_of("put images on the ground")
        write_mosaic(folder, drive, parsed.resolution, parsed.device, steps)
        write_page(folder, drive)
    print(f"mosaic in {parsed.result}, and under the map of its report.html")
