"""``v2hdm calibrate ground DRIVE``: mountings from bare ground (docs/calibration.md)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from v2hdm.cli.arguments import add_drive, drive_of, exit_code, result_of, steps_of
from v2hdm.cli.command import Command


def _run(arguments: Sequence[str]) -> int:
    """Estimate mountings, one line per camera, without torch; 0 for PASS and WARN, 3 for FAIL."""
    parser = COMMAND.parser()
    add_drive(parser, "extrinsic")
    parsed = parser.parse_args(arguments)
    from v2hdm.calibration.from_ground import calibrate_from_ground, summary_lines, write_ground_calibration

    drive = drive_of(parsed)
    folder = parsed.output or Path("outputs") / f"{drive.name}-extrinsic"
    settings = {"drive": str(parsed.drive), "cameras": list(drive.cameras)}
    with result_of(folder, f"v2hdm calibrate ground of {parsed.drive.resolve()}", settings) as unfinished:
        calibrated = calibrate_from_ground(drive, workers=parsed.workers, progress=steps_of("match ground"))
        write_ground_calibration(calibrated, unfinished)
    print("\n".join([*summary_lines(calibrated), f"results in {folder}"]))
    return exit_code(calibrated.verdict)


COMMAND = Command(
    "v2hdm calibrate ground", "Estimate each camera's mounting from bare ground, without markings.", _run
)
