"""``v2hdm calibrate compare BEFORE AFTER``: whether a camera has moved (docs/calibration.md)."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from v2hdm.cli.command import Command
from v2hdm.errors import EXIT_FAILED_VERDICT

if TYPE_CHECKING:
    from v2hdm.calibration.compare import Movement

_LEAST_PROBABILITY = 1e-12  # smaller ones are all the same to a reader


def _run(arguments: Sequence[str]) -> int:
    """Compare two calibrations of each camera; 0 if none has moved, 3 if one has."""
    parser = COMMAND.parser()
    parser.add_argument("before", type=Path, help="result folder or calibration file of the earlier drive")
    parser.add_argument("after", type=Path, help="the same from the later drive")
    parser.add_argument("--json", action="store_true", help="print one JSON list instead of lines")
    parsed = parser.parse_args(arguments)
    from v2hdm.calibration.compare import compare_calibrations, turned_alike
    from v2hdm.io.calibration.reading import trusted_calibrations

    before, after = (trusted_calibrations(path) for path in (parsed.before, parsed.after))
    movements = compare_calibrations(before, after)
    if parsed.json:
        print(json.dumps([_as_json(movement) for movement in movements]))
    else:
        for movement in movements:
            print(_line(movement))
        if turned_alike(movements):
            print(
                "all cameras have turned alike: more likely the vehicle's heading, or the frame of the "
                "poses, has changed"
            )
    for name in sorted(before.keys() ^ after.keys()):
        print(f"{name}: only in one of the two; not compared", file=sys.stderr)
    return EXIT_FAILED_VERDICT if any(movement.moved for movement in movements) else 0


def _line(movement: Movement) -> str:
    from numpy import degrees

    parts = [
        f"{axis} {1e3 * value:+.0f} +- {1e3 * sigma:.0f} mm"
        for axis, value, sigma in zip(
            ("forward", "left", "up"), movement.shift_m, movement.sigma[:3], strict=True
        )
    ] + [
        f"{axis} {degrees(value):+.2f} +- {degrees(sigma):.2f} deg"
        for axis, value, sigma in zip(
            ("roll", "pitch", "yaw"), movement.turn_rad, movement.sigma[3:], strict=True
        )
    ]
    least_mm = 1e3 * movement.detectable[:3].max()
    least_deg = degrees(movement.detectable[3:].max())
    outcome = (
        f"MOVED (by chance in at most {max(movement.probability, _LEAST_PROBABILITY):.1g} of such pairs)"
        if movement.moved
        else f"not moved (a shift of {least_mm:.0f} mm or a turn of {least_deg:.2f} deg would have shown)"
    )
    return f"{movement.camera}: {outcome}: {', '.join(parts)}"


def _as_json(movement: Movement) -> dict[str, object]:
    arrays = {
        key: getattr(movement, key).tolist() for key in ("shift_m", "turn_rad", "covariance", "detectable")
    }
    return {"camera": movement.camera, "moved": movement.moved, "probability": movement.probability, **arrays}


COMMAND = Command("v2hdm calibrate compare", "Say whether a camera has moved between two results.", _run)
