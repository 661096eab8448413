"""All checks of a result, in the order in which they are told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from v2hdm.ground import GroundEstimate
from v2hdm.mapping.results import MethodResult
from v2hdm.records import Drive
from v2hdm.verdict.results.against_ground import check_against_ground
from v2hdm.verdict.results.solution import BEST, check_solution
from v2hdm.verdict.verdict import Finding


def check_result(
    drive: Drive,
    methods: Mapping[str, Mapping[str, MethodResult]],
    ground: Sequence[Mapping[str, GroundEstimate]] = (),
) -> list[Finding]:
    """The checks after the solve, and the mapper's mountings against those of bare ground.

    Args:
        drive: what was mapped.
        methods: results by camera set, the one of all cameras last, then by method.
        ground: of each visit, by camera, what bare ground says; empty where it was not asked.
    """
    best = list(methods.values())[-1][BEST]
    findings = check_solution(drive, methods)
    for visit, estimates in zip(drive.visits, ground, strict=False):
        own = check_against_ground(best.calibrations, estimates)
        if drive.joined:
            own = [replace(finding, about=f"{finding.about} of {visit.name}") for finding in own]
        findings += own
    return findings
