"""``v2hdm report``, ``view``, ``labels`` and ``mosaic``: what is made of a finished result."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import parser_of, result_of, steps_of
from v2hdm.errors import MapFileError


def _parser_of(name: str) -> argparse.ArgumentParser:
    """The beginning of the parser of a command on a result."""
    parser = parser_of(name)
    parser.add_argument("result", type=Path, help="result folder of v2hdm map")
    where = "the drive's folder (default: where it was when mapped)"
    parser.add_argument("--drive", type=Path, metavar="DIR", help=where)
    return parser


def report(arguments: Sequence[str]) -> None:
    """Write ``report.html`` again: after an update, or where check points or a mosaic were added."""
    parser = _parser_of("report")
    under = "picture under the map: a GeoTIFF, such as an aerial photograph, or a folder of XYZ tiles"
    parser.add_argument("--background", type=Path, metavar="PATH", help=under)
    parsed = parser.parse_args(arguments)
    from v2hdm.io.drive import drive_of
    from v2hdm.report.page.document import write_page
    from v2hdm.store.results import added_to

    drive = drive_of(parsed.result, parsed.drive)
    with added_to(parsed.result, "RESULT") as folder:
        path = write_page(folder, drive, parsed.background)
    without = "" if drive else ", without the drive's images"
    print(f"{parsed.result / path.name}: {path.stat().st_size / 1e6:.1f} MB{without}")


def view(arguments: Sequence[str]) -> None:
    """Serve the report, to correct markings in, until Ctrl-C; every correction is written at once."""
    parser = _parser_of("view")
    parser.add_argument("--corrections", type=Path, metavar="FILE", help="default: RESULT.corrections.yaml")
    parsed = parser.parse_args(arguments)
    from v2hdm.io.drive import drive_of
    from v2hdm.report.view import file_beside, server_of

    path = parsed.corrections or file_beside(parsed.result)
    server, address, session = server_of(parsed.result, drive_of(parsed.result, parsed.drive), path)
    try:
        print(f"open {address}; Ctrl-C ends it", flush=True)
        server.serve_forever()
    except KeyboardInterrupt:
        count = len(session.corrections)
        print(f"{count} corrections in {path}: map.corrections={path} in the next run" if count else "ended")
    finally:
        server.server_close()


def labels(arguments: Sequence[str]) -> None:
    """Write ``instances.json``, the map in every image of its drive, in COCO's format."""
    parser = _parser_of("labels")
    parser.add_argument("--output", type=Path, metavar="DIR", help="folder (default: outputs/<drive>-labels)")
    parser.add_argument("--range", type=float, metavar="M", default=16.0, help="farthest label (default: 16)")
    parsed = parser.parse_args(arguments)
    from v2hdm.io.drive import single_drive_of
    from v2hdm.labels import FILE, write_labels

    drive = single_drive_of(parsed.result, parsed.drive, "labels are")
    folder = parsed.output or Path("outputs") / f"{drive.name}-labels"
    made = f"v2hdm labels of {parsed.result.resolve()}"
    with result_of(folder, made, {"result": str(parsed.result), "range_m": parsed.range}) as unfinished:
        found = write_labels(parsed.result, drive, unfinished, parsed.range, steps_of("label images"))
    print(
        f"{found['shown']} labels in {found['images']} images, {found['unsure']} of uncertain visibility; "
        f"{found['hidden']} markings are hidden there\n"
        f"labels in {folder}: python -m train labels=map data.coco={folder / FILE} "
        f"data.coco_images={drive.root}"
    )


def mosaic(arguments: Sequence[str]) -> None:
    """Add the mosaic to a result: the ground as a GeoTIFF, and pictures before and after."""
    parser = _parser_of("mosaic")
    parser.add_argument("--resolution", type=float, metavar="M", default=0.02, help="a pixel (default: 0.02)")
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
