"""The map against check points, known sizes and corrections: whether it is as stated, and why not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from v2hdm.io.maps.corrections import Correction
from v2hdm.mapping.bundle import known_lengths
from v2hdm.mapping.options import SizeOptions
from v2hdm.mapping.results import MethodResult
from v2hdm.records import FloatArray
from v2hdm.report.check_points import CheckTable, squared
from v2hdm.site.corrections import unmet
from v2hdm.verdict.verdict import Finding, Status, passed

CHECK = "check points"
FRAME = "survey frame"
SIGNIFICANCE = 1e-3  # share of maps as good as they state that are contradicted by chance


def check_points(table: CheckTable) -> Finding:
    """Whether the check points contradict the sigmas that map and survey state, by their chi-square.

    Where they do, the simpler fault that leaves the rest as stated is named: one point off, or all off alike.
    """
    total = len(table.compared) + len(table.unmatched)
    if not table.compared:
        says = f"none of {total} has a corner of the map within reach, the first: {table.unmatched[0][1]}"
        return Finding(CHECK, Status.WARN, None, None, "", says, "map")
    off_m, covariance = table.off_m.ravel(), table.covariance_m2
    value, limit = _ratio(table.squared, len(off_m)), _limit(len(off_m))
    status, says = (
        Status.PASS,
        (
            f"{len(table.compared)} of {total} lie {100 * table.rmse_m:.1f} cm off the map (RMSE), as far as "
            "map and survey state"
        ),
    )
    if value > limit:
        status, says = _explained(table, off_m, covariance)
    return Finding(CHECK, status, value, limit, "", says, "map")


def check_frame(found: Mapping[str, int]) -> list[Finding]:
    """A survey that fits not at all, or better by another reading, by the counts of corners in reach."""
    others = {says: count for says, count in found.items() if says}
    likeliest = max(others, key=lambda says: others[says], default="")
    stated, most = found.get("", 0), others.get(likeliest, 0)
    if stated and most <= stated:
        return [passed(FRAME, "survey", f"{stated} corners of the map have a point within reach", stated)]
    says = (
        f"{stated} corners of the map have a point within reach, and {most} would {likeliest}: "
        "mend the file or mapping.survey.crs"
    )
    if not stated and not most:
        says = "no corner of the map has a surveyed point within reach: mind datum, zone, units, reach_m"
    return [Finding(FRAME, Status.WARN, float(stated), None, "", says, "survey")]


def _explained(table: CheckTable, off_m: FloatArray, covariance: FloatArray) -> tuple[Status, str]:
    """The simplest fault that leaves the rest as good as stated."""
    rest, cause = min(
        [_all_alike(off_m, covariance), *(_without(table, k) for k in range(len(table.compared)))],
        key=lambda fault: fault[0],
    )
    degrees = len(off_m) - 2
    if degrees and _ratio(rest, degrees) <= _limit(degrees):
        return cause
    stated_m = float(np.sqrt(np.trace(covariance) / len(table.compared)))
    return Status.FAIL, (
        f"they lie {100 * table.rmse_m:.1f} cm off the map (RMSE), where map and survey state "
        f"{100 * stated_m:.1f} cm: the map is worse than it says; state larger pose_noise, drift above all, "
        "and let some of them be control points"
    )


_Fault = tuple[float, tuple[Status, str]]


def _all_alike(off_m: FloatArray, covariance: FloatArray) -> _Fault:
    """A shift of all points, by generalised least squares."""
    shift = np.tile(np.eye(2), (len(off_m) // 2, 1))
    weighed = np.linalg.solve(covariance, shift)
    by_m = np.linalg.solve(shift.T @ weighed, weighed.T @ off_m)
    says = (
        f"the map lies {100 * by_m[0]:+.1f} cm in x and {100 * by_m[1]:+.1f} cm in y of all of them: survey "
        "and poses have another datum or origin, or the receiver drifts by more than pose_noise says; let "
        "some of them be control points"
    )
    return squared(off_m - shift @ by_m, covariance), (Status.FAIL, says)


def _without(table: CheckTable, k: int) -> _Fault:
    kept = np.delete(np.arange(2 * len(table.compared)), [2 * k, 2 * k + 1])
    one = table.compared[k]
    says = (
        f"{one.point.id} lies {100 * one.distance_m:.1f} cm off its corner of {one.kind} {one.marking_id}, "
        "the others where they should: measure it anew, and look at the paint there"
    )
    rest = squared(table.off_m.ravel()[kept], table.covariance_m2[np.ix_(kept, kept)]) if len(kept) else 0.0
    return rest, (Status.WARN, says)


def _ratio(value: float, degrees: int) -> float:
    """Root of a chi-square by its degrees of freedom: 1 where all is as stated."""
    return float(np.sqrt(value / degrees))


def _limit(degrees: int) -> float:
    return _ratio(float(chi2.isf(SIGNIFICANCE, degrees)), degrees)


def check_known_sizes(sizes: SizeOptions, best: MethodResult) -> list[Finding]:
    """A finding for each known size that no marking of the map is near to, and so was not used."""
    found = []
    for name, size in sizes.by_class_m.items():
        markings = [one for one in best.hd_map.markings if one.kind == name]
        corners_map = np.array([one.corners_map for one in markings]).reshape(-1, 4, 2)
        numbers = np.arange(4 * len(markings)).reshape(-1, 4)
        alone = replace(sizes, by_class_m={name: size})
        if not known_lengths(alone, [name] * len(markings), corners_map, numbers):
            says = (
                f"none of the {len(markings)} markings of class {name} is about {size[0]:g} m by "
                f"{size[1]:g} m, so that the size was not used; mend or drop it"
            )
            about = f"mapping.known_sizes.by_class_m.{name}"
            found.append(Finding("known size", Status.WARN, 0.0, None, "", says, about))
    return found


def check_corrections(corrections: Sequence[Correction], best: MethodResult) -> list[Finding]:
    """A finding where a person's corrections have found nothing to correct."""
    missing = unmet(corrections, best.hd_map)
    if not missing:
        return []
    says = (
        f"{len(missing)} of {len(corrections)} have found no candidate, and change nothing: "
        f"{', '.join(missing[:5])}; correct the map of this very drive, or drop them"
    )
    return [Finding("corrections", Status.WARN, float(len(missing)), 0.0, "", says, "map.corrections")]
