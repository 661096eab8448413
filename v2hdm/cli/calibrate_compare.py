"""``v2hdm calibrate compare BEFORE AFTER``: one line per camera on stdout (docs/calibration.md)."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from v2hdm.cli.main import parser_of
from v2hdm.errors import EXIT_FAILED_VERDICT

if TYPE_CHECKING:
    from v2hdm.calibration.compare import Movement

_LEAST = 1e-12  # smaller probabilities are all the same


def run(arguments: Sequence[str]) -> int:
    """Compare two calibrations of each camera; 0 where none has moved, 3 where one has."""
    parser = parser_of("calibrate compare")
    parser.add_argument("before", type=Path, help="result folder or calibration file of the earlier drive")
    parser.add_argument("after", type=Path, help="the same of the later drive")
    parser.add_argument("--json", action="store_true", help="print one JSON list instead of lines")
    parsed = parser.parse_args(arguments)
    from v2hdm.calibration.compare import compare_calibrations, turned_alike
    from v2hdm.io.calibration.reading import trusted_calibrations

    before, after = (trusted_calibrations(path) for path in (parsed.before, parsed.after))
    movements = compare_calibrations(before, after)
    if parsed.json:
        print(json.dumps([_as_json(one) for one in movements]))
    else:
        for one in movements:
            print(_line(one))
        if turned_alike(movements):
            print(
                "all cameras have turned alike: rather than each of them, the vehicle's heading, "
                "or the frame of the poses, has changed"
            )
    for name in sorted(before.keys() ^ after.keys()):
        print(f"{name}: only in one of the two; not compared", file=sys.stderr)
    return EXIT_FAILED_VERDICT if any(one.moved for one in movements) else 0


def _line(one: Movement) -> str:
    from numpy import degrees

    parts = [
        f"{axis} {1e3 * value:+.0f} +- {1e3 * sigma:.0f} mm"
        for axis, value, sigma in zip(("forward", "left", "up"), one.shift_m, one.sigma[:3], strict=True)
    ] + [
        f"{axis} {degrees(value):+.2f} +- {degrees(sigma):.2f} deg"
        for axis, value, sigma in zip(("roll", "pitch", "yaw"), one.turn_rad, one.sigma[3:], strict=True)
    ]
    least_mm, least_deg = 1e3 * one.detectable[:3].max(), degrees(one.detectable[3:].max())
    found = (
        f"MOVED (by chance in {max(one.probability, _LEAST):.1g} of such pairs at most)"
        if one.moved
        else f"not moved (a shift of {least_mm:.0f} mm or a turn of {least_deg:.2f} deg would have shown)"
    )
    return f"{one.camera}: {found}: {', '.join(parts)}"


def _as_json(one: Movement) -> dict[str, object]:
    arrays = {key: getattr(one, key).tolist() for key in ("shift_m", "turn_rad", "covariance", "detectable")}
    return {"camera": one.camera, "moved": one.moved, "probability": one.probability, **arrays}
