"""``v2hdm calibrate ground DRIVE``: one line per camera on stdout and the verdict on the drive.

Calibrations and pictures of the matched ground go into the output folder (docs/extrinsic.md). No torch is
needed.
"""

from __future__ import annotations

from collections.abc import Sequence

from v2hdm.cli.main import add_drive, parser_of
from v2hdm.errors import EXIT_FAILED_VERDICT


def run(arguments: Sequence[str]) -> int:
    """Estimate mountings; 0 for PASS and WARN, 3 for FAIL."""
    parser = parser_of("calibrate ground")
    add_drive(parser, "extrinsic")
    parsed = parser.parse_args(arguments)
    from v2hdm.calibration.from_ground import estimate_mountings

    return EXIT_FAILED_VERDICT if estimate_mountings(parsed) else 0
