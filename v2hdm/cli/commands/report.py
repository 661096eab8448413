"""``v2hdm report RESULT`` (docs/report.md)."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from v2hdm.cli.arguments import add_result
from v2hdm.cli.command import Command
from v2hdm.errors import ConfigError, MapFileError, V2hdmError
from v2hdm.store import names
from v2hdm.store.inputs import protected_inputs

if TYPE_CHECKING:
    from v2hdm.records import Drive
    from v2hdm.report.job import StatedJob

_FIELDS = {
    "site": "name of the site",
    "client": "who ordered the survey",
    "operator": "who drove and mapped",
    "receiver": "receiver, antenna and correction service",
    "geoid": "geoid model of heights above sea level, such as GCG2016",
}
"""Statements of people for the document, by the option; what is stated once stays."""


def _run(arguments: Sequence[str]) -> None:
    """Write ``report.html`` again: after an update, or where check points or a mosaic were added."""
    parser = COMMAND.parser()
    add_result(parser)
    under = "picture under the map: a GeoTIFF, such as an aerial photograph, or a folder of XYZ tiles"
    parser.add_argument("--background", type=Path, metavar="PATH", help=under)
    for name, says in _FIELDS.items():
        parser.add_argument(f"--{name}", metavar="TEXT", help=says)
    parser.add_argument(
        "--epoch", type=float, metavar="YEARS", help="epoch of the coordinates, such as 2024.4"
    )
    system = "system of the report's coordinates, such as EPSG:25832, or local (default: UTM)"
    parser.add_argument("--crs", metavar="NAME", help=system)
    compared = "result of v2hdm compare to add (default: RESULT-compared beside it)"
    parser.add_argument("--comparison", type=Path, metavar="DIR", help=compared)
    parser.add_argument("--pdf", action="store_true", help="write report.pdf, too (extra pdf)")
    parsed = parser.parse_args(arguments)
    import cv2  # noqa: F401  # the absence of these is reported before anything is read
    import jinja2  # noqa: F401

    from v2hdm.io.drive import drive_of
    from v2hdm.report.job import Job, check_job
    from v2hdm.store.results import added_to

    stated = {name: getattr(parsed, name) for name in (*_FIELDS, "epoch")}
    job = Job(**stated)
    check_job(job, "--")
    if parsed.pdf:
        from v2hdm.report.paper import check_paper

        check_paper("--pdf")
    drive = drive_of(parsed.result, parsed.drive)
    print("draw the report", file=sys.stderr, flush=True)
    comparison = parsed.comparison or _beside(parsed.result)
    with added_to(parsed.result, "RESULT") as folder:
        paths = _write(folder, drive, parsed, job, comparison)
    without = "" if drive else ", without the drive's images"
    for path in paths:
        print(f"{parsed.result / path.name}: {path.stat().st_size / 1e6:.1f} MB{without}")


def _write(
    folder: Path, drive: Drive | None, parsed: argparse.Namespace, job: object, comparison: Path | None
) -> list[Path]:
    """Write page and paper with the new statements; if that fails, the old statements stay."""
    from v2hdm.report.coverage import coverage_of, write_coverage
    from v2hdm.report.job import Job, read_job
    from v2hdm.report.page.document import write_page  # the libraries of its charts, which takes seconds
    from v2hdm.report.page.facts import read_cameras

    assert isinstance(job, Job)
    before = read_job(folder)
    now = before.with_more(job, parsed.crs)
    if now != before:
        _restate(folder, now)
    try:
        if drive is not None and not (folder / names.COVERAGE).is_file():
            cameras = read_cameras(folder)
            mountings = {name: camera.calibration.cam_from_vehicle for name, camera in cameras.items()}
            write_coverage(folder, coverage_of(drive, mountings))
        paths = [write_page(folder, drive, parsed.background, comparison)]
        if parsed.pdf:
            from v2hdm.report.paper import write_paper

            paths.append(write_paper(folder, drive, comparison))
    except V2hdmError:
        if now != before:
            _restate(folder, before)
        raise
    return paths


def _restate(folder: Path, job: StatedJob) -> None:
    """Replace the statements on the survey, although their file is an input of the report."""
    from v2hdm.report.job import write_job

    with protected_inputs():
        write_job(folder, job)


def _beside(result: Path) -> Path | None:
    """The comparison of a result in the default folder of ``v2hdm compare``; None if there is none."""
    from v2hdm.store.files import load_json

    folder = result.resolve().with_name(f"{result.resolve().name}-compared")
    if not (folder / names.AS_BUILT).is_file():
        return None
    try:  # the settings of a comparison are JSON
        stated = load_json(folder / names.CONFIG, MapFileError).get("map")
    except (MapFileError, ConfigError, OSError):
        return None
    mapped = Path(str(stated))
    mapped = mapped if mapped.is_dir() else mapped.parent
    return folder if mapped.resolve() == result.resolve() else None


COMMAND = Command(
    "v2hdm report",
    "Write the report.html of a result again.",
    _run,
    interrupted="interrupted; the report is unchanged",
)
