"""Whether a map is as good as the user asks, and as it states by check points, known sizes and corrections.

A map meets ``accuracy_goal_cm`` where 95 % of its corners lie within that radius, by the covariances that it
states in its own frame: what moves all markings alike counts in full. Markings of accuracy C, which the map
states to be known less well, count where they are not fewer than the others. A mounting meets the goal where
it leaves the ground ahead known as well.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import compress
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from v2hdm.faults import Contradiction, table
from v2hdm.faults.odds import CLEAR_SIGMAS
from v2hdm.geometry.rigid import camera_centre
from v2hdm.io.maps.corrections import Correction
from v2hdm.mapping.bundle import known_lengths
from v2hdm.mapping.options import SizeOptions
from v2hdm.mapping.results import MethodResult, SolveEvidence
from v2hdm.records import ACCURACIES, SIGMAS_95, Calibration, FloatArray, Marking
from v2hdm.site.accuracy import (
    LEFT_OUT_BY_GRADE,
    absolute_radii_m,
    radius_95_m,
    radius_of_all_m,
    relative_radii_m,
    well_known,
)
from v2hdm.site.candidates import LACKS_A_CORNER, TOO_UNCERTAIN
from v2hdm.site.corrections import unmet
from v2hdm.survey.check_points import CheckTable, squared
from v2hdm.verdict.results.solution import check_inputs, doubted, relied_on
from v2hdm.verdict.verdict import GOAL, Finding, Status, passed

_AHEAD_M = 10.0  # distance, m, within which a vehicle uses what it sees on the ground


def check_goal(best: MethodResult, goal_m: float, frame: str) -> Iterator[Finding]:
    """The map, in a ``frame`` of poses or survey, against the 95 % radius ``goal_m``, then each mounting."""
    markings = best.hd_map.markings
    goal = f"; goal {100 * goal_m:g} cm"
    unknown_clocks = list(_unknown_clocks(best.evidence, goal_m))
    yield from unknown_clocks
    yield from _unseen_lenses(best.evidence, goal_m)
    if markings:
        judged = well_known(markings)
        radii_m = absolute_radii_m(judged)
        reached_m = radius_of_all_m(radii_m.ravel())
        corners = f"95 % of the corners of {len(judged)} markings"
        says = f"{corners} within {_cm(reached_m)} in the frame of the {frame}"
        if best.evidence is not None:
            says += _conditions(best.evidence, raised_checks=[finding.check for finding in unknown_clocks])
        relative_m = relative_radii_m(judged)
        if len(relative_m):
            says += f", {_cm(radius_of_all_m(relative_m))} from marking to marking"
        says += goal + _beside(best, len(markings) - len(judged))
        coarse = list(compress(judged, radii_m.max(axis=1) > goal_m))
        met = 100 * (len(judged) - len(coarse)) // len(markings)
        helps = f"{met} % of the markings meet the goal; {_largest_part(best, coarse or judged)}"
        yield _judged("map", reached_m, goal_m, says, helps)
    for name, calibration in best.calibrations.items():
        left_m, helps = ground_ahead(calibration)
        says = f"the ground ahead is known, given its mounting, to {_cm(left_m)} (95 %){goal}"
        yield _judged(name, left_m, goal_m, says, helps)


_CLOCKS = (table.CLOCK.check, table.CLOCK_DRIFT.check)


def told_once(findings: Iterable[Finding], of_goal: Iterable[Finding]) -> tuple[list[Finding], list[Finding]]:
    """The findings of a solve and those on the goal, without what either says less well than the other.

    A clock that is named as wrong is not unknown; what is unknown of all clocks is told with its size; and of
    a lens whose unseen errors make the map miss the goal it is not told that the markings agree with it.
    """
    of_goal = list(of_goal)
    unseen = {finding.check for finding in of_goal if finding.is_unobservable}
    findings = [f for f in findings if not (f.check in unseen and f.status is Status.PASS)]
    if any(finding.check in _CLOCKS and finding.status is not Status.PASS for finding in findings):
        return findings, [finding for finding in of_goal if finding.check not in _CLOCKS]
    if any(finding.check in _CLOCKS for finding in of_goal):
        findings = [f for f in findings if not (f.check in _CLOCKS and f.is_unobservable)]
    return findings, of_goal


def _unknown_clocks(evidence: SolveEvidence | None, goal_m: float) -> Iterator[Finding]:
    """The clocks, where what is unknown of them alone makes a map miss the goal."""
    clock_m = None if evidence is None else evidence.clock_m
    if clock_m is None or clock_m <= goal_m:
        return
    says = (
        f"whether all clocks are late or fast cannot be told, and leaves the corners open by {_cm(clock_m)} "
        "(95 %), which the map states: include a turn, or state pose_noise.clock_s in drive.yaml"
    )
    yield Finding(table.CLOCK.check, Status.WARN, 100 * clock_m, 100 * goal_m, "cm", says, "all cameras")


def _unseen_lenses(evidence: SolveEvidence | None, goal_m: float) -> Iterator[Finding]:
    """The errors of ``camera_info`` that no marking shows, although they make a map miss the goal.

    They are Baarda's minimal detectable errors with their external reliability (A testing procedure for use
    in geodetic networks, 1968): the largest error that the tests would let pass, and what it does.
    """
    if evidence is None:
        return
    raised = {finding.check for finding in check_inputs(evidence) if finding.status is not Status.PASS}
    largest: dict[str, tuple[float, Contradiction]] = {}
    for test in evidence.score_tests:
        moved_m = CLEAR_SIGMAS * max(test.sigma, test.model_sigma) * test.moves_m
        check = test.fault.check
        least_m = goal_m if check not in largest else largest[check][0]
        if test.fault.is_of_lens and np.isfinite(moved_m) and moved_m > least_m and check not in raised:
            largest[check] = moved_m, test
    for check, (moved_m, test) in largest.items():
        size = test.fault.shown(CLEAR_SIGMAS * max(test.sigma, test.model_sigma))
        whose = "all cameras alike" if len(test.cameras) > 1 else "it"
        says = (
            f"an error of {whose} would show from {size} on, and moves the corners by {_cm(moved_m)} until "
            "then: calibrate the lens, or include a turn"
        )
        yield passed(check, ", ".join(test.cameras), says)


def _beside(best: MethodResult, coarse: int) -> str:
    """Markings beside those of the statement on the map's corners, without which the share would flatter."""
    reasons = (TOO_UNCERTAIN, LACKS_A_CORNER, *LEFT_OUT_BY_GRADE)
    uncertain = sum(exclusion.reason in reasons for exclusion in best.excluded)
    says = ""
    if coarse:
        is_are = "is" if coarse == 1 else "are"
        says += f"; {coarse} more {is_are} known less well (accuracy {ACCURACIES[-1]})"
    if uncertain:
        says += f"; {uncertain} more left out as too uncertain"
    return says


def _conditions(evidence: SolveEvidence, raised_checks: Sequence[str]) -> str:
    """The inputs that absolute accuracy rests on: one that may be wrong, or those that no image shows.

    What is unknown of the inputs of the checks ``told`` is part of the stated accuracy.
    """
    doubtful = doubted(evidence)
    relied = [name for check, name in relied_on(evidence).items() if check not in raised_checks]
    if doubtful is not None:
        return f" (unless the {doubtful.fault.check} is off, which is possible)"
    return f" (if {' and '.join(relied)} are right, which this drive cannot show)" if relied else ""


def _judged(about: str, radius_m: float, goal_m: float, says: str, helps: str) -> Finding:
    status = Status.PASS if radius_m <= goal_m else Status.WARN
    value = 100 * radius_m if np.isfinite(radius_m) else None
    says = says if status is Status.PASS else f"{says}: {helps}"
    return Finding(GOAL, status, value, 100 * goal_m, "cm", says, about)


def _largest_part(best: MethodResult, coarse: Sequence[Marking]) -> str:
    """The largest of the errors that are stated of the markings that miss the goal, and what helps."""
    clock_m = (best.evidence.clock_m if best.evidence is not None else None) or 0.0
    poses = best.poses
    pose_m = [] if poses is None else SIGMAS_95 * poses.sigma[poses.has_marking, :2].max(axis=1)
    # Poses are stated at the stamps of the images, with what clocks leave open.
    own_pose_m = float(np.sqrt(max(_median(pose_m) ** 2 - clock_m**2, 0.0)))
    parts = [
        (own_pose_m, "the poses: tie them down by mapping.survey"),
        (_median(list(map(_own_m, coarse))), "each marking's own views: pass them closer and again"),
    ]
    if clock_m:
        parts.append((clock_m, "the clocks: include a turn, or state pose_noise.clock_s"))
    # What one camera leaves open, a better one settles.
    left_m, helps = min(map(ground_ahead, best.calibrations.values()), default=(np.inf, ""))
    if np.isfinite(left_m):
        parts.append((left_m, f"the mounting: {helps}"))
    size_m, part = max(parts)
    return f"the largest part, {_cm(size_m)}, is {part}"


def _own_m(marking: Marking) -> float:
    """The 95 % radius, m, of a marking's part in a distance and of its worst corner beside its centre."""
    if marking.covariance_m2 is None:
        return 0.0
    centre_m = float(radius_95_m(np.einsum("iajb->ab", marking.covariance_m2.reshape(4, 2, 4, 2)) / 16))
    shape_m2 = max(float(absolute_radii_m([marking]).max()) ** 2 - centre_m**2, 0.0)
    return float(np.hypot(SIGMAS_95 * (marking.relative_sigma_m or 0.0), np.sqrt(shape_m2)))


def ground_ahead(calibration: Calibration) -> tuple[float, str]:
    """The 95 % radius, m, of a ground point as a mounting places it, and what would make it smaller.

    The point is where the camera looks, or 10 m ahead where that is farther; infinite if unknown.
    """
    moves = _ground_jacobian(calibration.cam_from_vehicle)
    covariance = calibration.covariance
    if covariance is None:
        return float("inf"), "it saw no marking of the map"

    def radius_of(part: slice) -> float:
        return float(radius_95_m(moves[:, part] @ covariance[part, part] @ moves[:, part].T))

    place_m = radius_of(slice(0, 3))
    turn_m = radius_of(slice(3, 6))
    left_m = radius_of(slice(6))
    of_place = "include a turn, or survey the camera's place"
    of_turn = "drive past more markings, near and far"
    return left_m, of_place if place_m > turn_m else of_turn


def _ground_jacobian(cam_from_vehicle: FloatArray) -> FloatArray:
    """How the ground (x, y) at one pixel moves with the mounting's left tangent: (2, 6)."""
    to_vehicle = cam_from_vehicle[:3, :3].T
    height_m = camera_centre(cam_from_vehicle)[2]
    axis = to_vehicle[:, 2]
    level = float(np.hypot(axis[0], axis[1]))
    is_near = -axis[2] * _AHEAD_M > level * height_m
    x, y, z = axis * height_m / -axis[2] if is_near else (*axis[:2] * _AHEAD_M / level, -height_m)
    # exp(xi) moves a point p of the camera by -R'(v + w x p) in the vehicle; its ray meets the ground anew.
    turned = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ to_vehicle
    moved = np.hstack([-to_vehicle, turned])
    return np.asarray(moved[:2] - np.outer([x / z, y / z], moved[2]))


def _median(values: Sequence[float] | FloatArray) -> float:
    return float(np.median(values)) if len(values) else 0.0


def _cm(size_m: float) -> str:
    return f"{100 * size_m:.{int(size_m < 0.1)}f} cm" if np.isfinite(size_m) else "an unknown distance"


CHECK = "check points"
FRAME = "survey frame"
SIGNIFICANCE = 1e-3  # share of maps as good as they state that are contradicted by chance


def check_points(table: CheckTable) -> Finding:
    """Whether the check points contradict the sigmas that map and survey state, by their chi-square.

    Where they do, the simplest cause is named that leaves what it does not explain as stated: one point off,
    or all off alike.
    """
    total = len(table.compared) + len(table.unmatched)
    if not table.compared:
        says = f"none of {total} has a map corner within reach, the first: {table.unmatched[0][1]}"
        return Finding(CHECK, Status.WARN, None, None, "", says, "map")
    off_m = table.off_m.ravel()
    covariance = table.covariance_m2
    value = _ratio(table.squared, len(off_m))
    limit = _limit(len(off_m))
    off = f"{len(table.compared)} of {total} lie {100 * table.rmse_m:.1f} cm off the map (RMSE)"
    status = Status.PASS
    says = f"{off}, as far as map and survey state"
    if value > limit:
        status, says = _explained(table, off_m, covariance)
    return Finding(CHECK, status, value, limit, "", says, "map")


def check_frame(corners: Mapping[str, int]) -> list[Finding]:
    """A survey that fits not at all, or better by another reading, by the counts of corners in reach."""
    others = {says: count for says, count in corners.items() if says}
    likeliest = max(others, key=lambda says: others[says], default="")
    stated = corners.get("", 0)
    most = others.get(likeliest, 0)
    if stated and most <= stated:
        return [passed(FRAME, "survey", f"{stated} corners of the map have a point within reach", stated)]
    says = (
        f"{stated} corners of the map have a point within reach, and {most} would {likeliest}: "
        "fix the file or mapping.survey.crs"
    )
    if not stated and not most:
        says = "no corner of the map has a surveyed point within reach: check datum, zone, units, reach_m"
    return [Finding(FRAME, Status.WARN, float(stated), None, "", says, "survey")]


def _explained(table: CheckTable, off_m: FloatArray, covariance: FloatArray) -> tuple[Status, str]:
    """The simplest fault that leaves what it does not explain as good as stated."""
    causes = [_all_alike(off_m, covariance), *(_without(table, k) for k in range(len(table.compared)))]
    likeliest = min(causes, key=lambda cause: cause.squared)
    degrees = len(off_m) - 2
    if degrees and _ratio(likeliest.squared, degrees) <= _limit(degrees):
        return likeliest.status, likeliest.says
    stated_m = float(np.sqrt(np.trace(covariance) / len(table.compared)))
    return Status.FAIL, (
        f"they lie {100 * table.rmse_m:.1f} cm off the map (RMSE), where map and survey state "
        f"{100 * stated_m:.1f} cm: the map is worse than stated; state larger pose_noise, above all drift, "
        "and make some of them control points"
    )


class _Cause(NamedTuple):
    """Why check points may be off."""

    squared: float  # chi-square of what it does not explain
    status: Status
    says: str


def _all_alike(off_m: FloatArray, covariance: FloatArray) -> _Cause:
    """A shift of all points, by generalised least squares."""
    shift = np.tile(np.eye(2), (len(off_m) // 2, 1))
    weighed = np.linalg.solve(covariance, shift)
    by_m = np.linalg.solve(shift.T @ weighed, weighed.T @ off_m)
    says = (
        f"the map lies {100 * by_m[0]:+.1f} cm in x and {100 * by_m[1]:+.1f} cm in y of all of them: survey "
        "and poses have another datum or origin, or the receiver drifts by more than pose_noise; make "
        "some of them control points"
    )
    return _Cause(squared(off_m - shift @ by_m, covariance), Status.FAIL, says)


def _without(table: CheckTable, k: int) -> _Cause:
    """One point that is off, and the others are not."""
    others = np.delete(np.arange(2 * len(table.compared)), [2 * k, 2 * k + 1])
    compared = table.compared[k]
    corner = f"corner of {compared.kind} {compared.marking_id}"
    says = (
        f"{compared.point.id} lies {100 * compared.distance_m:.1f} cm off its {corner}, "
        "the others where they should: survey it again, and look at the paint there"
    )
    if not len(others):
        return _Cause(0.0, Status.WARN, says)
    covariance = table.covariance_m2[np.ix_(others, others)]
    return _Cause(squared(table.off_m.ravel()[others], covariance), Status.WARN, says)


def _ratio(value: float, degrees: int) -> float:
    """Root of a chi-square by its degrees of freedom: 1 where all is as stated."""
    return float(np.sqrt(value / degrees))


def _limit(degrees: int) -> float:
    return _ratio(float(chdtri(degrees, SIGNIFICANCE)), degrees)


def check_known_sizes(sizes: SizeOptions, best: MethodResult) -> list[Finding]:
    """A finding for each known size that no marking of the map is near to, and so was not used."""
    findings = []
    for name, size in sizes.by_class_m.items():
        markings = [marking for marking in best.hd_map.markings if marking.kind == name]
        corners_map = np.array([marking.corners_map for marking in markings]).reshape(-1, 4, 2)
        numbers = np.arange(4 * len(markings)).reshape(-1, 4)
        alone = replace(sizes, by_class_m={name: size})
        if not known_lengths(alone, [name] * len(markings), corners_map, numbers):
            says = (
                f"none of the {len(markings)} markings of class {name} is about {size[0]:g} m by "
                f"{size[1]:g} m, so that the size was not used; fix or drop it"
            )
            about = f"mapping.known_sizes.by_class_m.{name}"
            findings.append(Finding("known size", Status.WARN, 0.0, None, "", says, about))
    return findings


_LISTED = 5  # corrections that a line names: as many as a reader takes in


def check_corrections(corrections: Sequence[Correction], best: MethodResult) -> list[Finding]:
    """The corrections that the map follows, those that the images contradict, and those of nothing."""
    about = "map.corrections"
    findings = []
    missing = unmet(corrections, best.hd_map)
    if missing:
        says = (
            f"{len(missing)} of {len(corrections)} match no candidate and have no effect: "
            f"{', '.join(missing[:_LISTED])}; correct a map of this drive, or drop them"
        )
        findings.append(Finding("corrections", Status.WARN, float(len(missing)), 0.0, "", says, about))
    contradicted = [heard.sentence for heard in best.heard if heard.against]
    if contradicted:
        says = (
            f"{len(contradicted)} of {len(corrections)} are followed against the images: "
            f"{'; '.join(contradicted[:_LISTED])}: look at these again"
        )
        count = float(len(contradicted))
        findings.append(Finding("corrections against images", Status.WARN, count, 0.0, "", says, about))
    elif best.heard:
        says = f"the images do not contradict {len(best.heard)} corrections that the map follows"
        findings.append(passed("corrections against images", about, says, 0.0))
    return findings
