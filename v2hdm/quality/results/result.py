"""All checks of a result, in the order in which they are told."""

from __future__ import annotations

from collections.abc import Mapping

from v2hdm.ground import GroundEstimate
from v2hdm.mapping.results import MethodResult
from v2hdm.quality.results.against_ground import check_against_ground
from v2hdm.quality.results.solution import BEST, check_solution
from v2hdm.quality.verdict import Finding
from v2hdm.records import Drive


def check_result(
    drive: Drive,
    methods: Mapping[str, Mapping[str, MethodResult]],
    ground: Mapping[str, GroundEstimate] | None = None,
) -> list[Finding]:
    """The checks after the solve, and the mapper's mountings against those of bare ground.

    Args:
        drive: what was mapped.
        methods: results by camera set, the one of all cameras last, then by method.
        ground: what bare ground says, by camera; None where it was not asked.
    """
    best = list(methods.values())[-1][BEST]
    return [*check_solution(drive, methods), *check_against_ground(best.calibrations, ground or {})]
