"""A run's survey: control points go into the mapping, check points wait until the map is made."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from v2hdm.errors import DriveError
from v2hdm.io.maps.features import with_heights
from v2hdm.mapping.options import ControlOptions, MappingOptions, SurveyOptions
from v2hdm.mapping.results import MethodResult
from v2hdm.records import Drive, FloatArray
from v2hdm.survey.check_points import CheckTable, compare
from v2hdm.survey.read import SurveyedPoint, SurveyTable, in_map, misreadings, read_survey
from v2hdm.verdict import Finding
from v2hdm.verdict.results.accuracy import check_frame, check_points

_log = logging.getLogger(__name__)

_NAMED = 5  # largest number of points that a line of the log names
_NEAR_M = 22.0  # how far from the route, m, images may show a point: as far as the detector looks by default


@dataclass(frozen=True)
class Survey:
    """A survey as a run uses it: settings of the mapping with its control points, and its check points.

    ``points`` are all of the file, ``elsewhere`` where they would lie, had it meant something else (N, 2).
    """

    mapping: MappingOptions
    check: tuple[SurveyedPoint, ...] = ()
    points: tuple[SurveyedPoint, ...] = ()
    elsewhere: dict[str, FloatArray] | None = None

    def counts_in_reach(self, result: MethodResult) -> dict[str, int]:
        """How many points have a corner of the map within reach: as stated (""), and read otherwise."""
        corners = KDTree(np.array([marking.corners_map for marking in result.hd_map.markings]).reshape(-1, 2))
        ways = {"": _positions(self.points), **(self.elsewhere or {})}
        return {says: _places(corners, at, self.mapping.survey.reach_m) for says, at in ways.items()}


def table_of(options: SurveyOptions) -> SurveyTable | None:
    """The file of a survey as it states its points, None where there is none; raises DriveError."""
    if options.file is None:
        return None
    return read_survey(Path(options.file), options.crs, options.geoid_m, options.sigma_m)


def take_survey(drive: Drive, options: MappingOptions) -> Survey:
    """The survey of a drive, before anything is estimated; DriveError where it cannot be this drive's."""
    table = table_of(options.survey)
    if table is None:
        return Survey(options)
    points = in_map(table, drive.origin)
    elsewhere = misreadings(table, drive.origin)
    _check_near(table, points, elsewhere, drive, min(_NEAR_M, options.max_range_m))
    control = [
        ControlOptions(id=point.id, position_map=point.position_map.tolist(), sigma_m=point.sigma_m.tolist())
        for point in points
        if not point.is_check
    ]
    survey = options.survey.only([*options.survey.points, *control])
    check = tuple(point for point in points if point.is_check)
    _log.info("%s: %d control points and %d check points", table.path, len(control), len(check))
    return Survey(replace(options, survey=survey), check, points, elsewhere)


def compare_survey(survey: Survey, drive: Drive, best: MethodResult) -> CheckTable | None:
    """The check points against the finished map of ``best``; None where there are none."""
    if not survey.check:
        return None
    assert best.joint_covariance is not None
    hd_map = with_heights(best.hd_map, drive.road)
    reach_m = survey.mapping.survey.reach_m
    return compare(hd_map, survey.check, reach_m, best.joint_covariance, drive.route_map)


def check_survey(survey: Survey, best: MethodResult, compared: CheckTable | None) -> list[Finding]:
    """The findings on a survey, and on its check points where they were compared."""
    findings = check_frame(survey.counts_in_reach(best)) if survey.points else []
    return findings if compared is None else [check_points(compared), *findings]


def _check_near(
    table: SurveyTable,
    points: Sequence[SurveyedPoint],
    elsewhere: dict[str, FloatArray],
    drive: Drive,
    range_m: float,
) -> None:
    """Warn of points that no image can show; refuse a survey that has no others."""
    route = KDTree(drive.route_map)
    away_m = route.query(_positions(points))[0]
    far = np.flatnonzero(away_m > range_m)
    if len(far) < len(points):
        if len(far):
            names = ", ".join(points[k].id for k in far[:_NAMED])
            _log.warning(
                "%s: %d of %d points lie farther than %g m from the route, up to %.0f m: %s%s",
                table.path, len(far), len(points), range_m, away_m.max(), names,
                ", ..." if len(far) > _NAMED else "",
            )  # fmt: skip
        return
    likeliest = max(elsewhere, key=lambda says: _places(route, elsewhere[says], range_m), default="")
    in_reach = int((route.query(elsewhere[likeliest])[0] <= range_m).sum()) if likeliest else 0
    advice = "check datum, zone, units, column order and the drive's origin"
    if in_reach:
        advice = f"{in_reach} would {likeliest}; fix the file or mapping.survey.crs"
    raise DriveError(
        f"{table.path}: none of its {len(points)} points lies within {range_m:g} m of the route, the nearest "
        f"is {away_m.min():.0f} m away: {advice}"
    )


def _places(tree: KDTree, at: FloatArray, reach_m: float) -> int:
    """How many of a tree's places points have within reach: those heaped up on one spot have a single one."""
    off_m, nearest = tree.query(at)
    return len(np.unique(nearest[off_m <= reach_m]))


def _positions(points: Sequence[SurveyedPoint]) -> FloatArray:
    return np.array([point.position_map for point in points]).reshape(-1, 2)
