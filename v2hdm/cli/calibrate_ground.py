"""``v2hdm calibrate ground DRIVE``: one line per camera on stdout and the verdict on the drive.

Calibrations and pictures of the matched ground go into the output folder (docs/calibration.md). No torch is
needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.main import add_drive, drive_of, exit_code, parser_of, result_of, steps_of


def run(arguments: Sequence[str]) -> int:
    """Estimate mountings; 0 for PASS and WARN, 3 for FAIL."""
    parser = parser_of("calibrate ground")
    add_drive(parser, "extrinsic")
    parsed = parser.parse_args(arguments)
    from v2hdm.calibration.from_ground import calibrate_from_ground, summary_lines, write_ground_calibration

    drive = drive_of(parsed)
    folder = parsed.output or Path("outputs") / f"{drive.name}-extrinsic"
    with result_of(folder, {"drive": str(parsed.drive), "cameras": list(drive.cameras)}) as unfinished:
        found = calibrate_from_ground(drive, workers=parsed.workers, progress=steps_of("match ground"))
        write_ground_calibration(found, unfinished)
    print(*summary_lines(found), f"results in {folder}", sep="\n")
    return exit_code(found.verdict)
