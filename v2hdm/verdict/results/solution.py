"""After the solve: what the drive says of its own inputs, and how well everything fits.

The inputs are tested one at a time (:mod:`v2hdm.adjust.suspect`); what was contradicted and could be done
without has been dropped (:mod:`v2hdm.mapping.recovery`) and is told here. Everything else that a wrong input
shows in is measured as well, so that a fault that nobody thought of is not silent. docs/verdict.md has what
clean and spoilt drives measure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from v2hdm.adjust import Fault
from v2hdm.mapping.recovery import CLOCK_OBSERVABLE_S, CONTRADICTED_SIGMAS, OBSERVABLE_SIGMA, is_contradicted
from v2hdm.mapping.results import Contradiction, MethodResult, SolveEvidence
from v2hdm.records import Drive
from v2hdm.site.markings import TOO_UNCERTAIN
from v2hdm.verdict.judgement import judge, passed
from v2hdm.verdict.results.agreement import check_agreement
from v2hdm.verdict.results.doubles import check_doubles
from v2hdm.verdict.results.fault_words import CHECKS, remedy_of, wrong_as
from v2hdm.verdict.verdict import Finding, Status

BEST = "Opt"
"""The method whose map is the result."""

HELD_OUT_LIMIT = 4.0
"""Mean robust loss of held-out observations: clean drives reach 1.9 to 2.3, wrong inputs begin at 6.5."""

EXCLUDED_LIMIT = 0.2
"""Share of candidate markings that were left out, but for those that are merely uncertain, two standard
errors taken off it: clean drives reach .05 of hundreds and .13 of 26, swapped axes .75 of 200."""

REJECTED_LIMIT = 0.06
"""Share of corner observations that the rest contradicts: clean drives reach .02, no distortion .14."""

VARIANCE_LIMIT = 3.0
"""Variance of observations as a multiple of the detector's statement: clean drives reach .2, no distortion
6."""

WINDOW_LIMIT = 8.0
"""The worst window of the route as a multiple of the median one: clean drives reach 2."""

POSE_PULL_LIMIT = 1.4
"""Root mean square of what is taken off a recorded pose, in its sigmas: at most 1 where these are right."""

JUMP_LIMIT = 9.0
"""Largest single pull on a pose, in sigmas."""

LEVER_TOLD_M = 0.15
"""Sigma of the point that the poses are of, m, up to which a drive tells it."""


def check_solution(drive: Drive, methods: Mapping[str, Mapping[str, MethodResult]]) -> list[Finding]:
    """All checks after the solve.

    Args:
        drive: what was mapped.
        methods: results by camera set, the one of all cameras last, then by method.
    """
    best = list(methods.values())[-1][BEST]
    causes: list[Finding] = []
    symptoms: list[Finding] = []
    if best.evidence is not None:
        causes = check_inputs(best.evidence)
        symptoms = [*check_fit(best.evidence), _excluded(best)]
    symptoms += check_doubles(best)
    if len(methods) > 1:
        symptoms += check_agreement({name: by_method[BEST] for name, by_method in methods.items()}, drive)
    named = next((finding for finding in causes if finding.status is Status.FAIL), None)
    return [*causes, *(_explained(finding, named) for finding in symptoms)]


def _explained(finding: Finding, named: Finding | None) -> Finding:
    """A symptom that points to the cause which the tests of the inputs have named, if they have.

    What is wrong stands before the colon of its sentence, and the causes that are likely otherwise after it.
    """
    if named is None or finding.status is Status.PASS:
        return finding
    return replace(finding, says=f"{finding.says.split(': ')[0]}: see {named.check}")


def check_inputs(evidence: SolveEvidence) -> list[Finding]:
    """What was dropped, what is contradicted still, and what this drive cannot tell."""
    findings = [_corrected(one) for one in evidence.corrected]
    raised = {finding.check for finding in findings}
    still = [one for one in evidence.suspects if is_contradicted(one)]
    if still:
        # Other inputs would explain part of the same residuals: the one that explains most is named.
        findings.append(_contradicted(still[0], still[1:]))
        raised.add(findings[-1].check)
    by_check: dict[str, list[Contradiction]] = {}
    for one in evidence.suspects:
        by_check.setdefault(CHECKS[one.fault], []).append(one)
    untold = _untold(evidence, raised)
    said = raised | {finding.check for finding in untold if not _is_told(by_check[finding.check])}
    findings += [_agrees(check, tested) for check, tested in by_check.items() if check not in said]
    return [*findings, *untold]


def _is_told(tested: list[Contradiction]) -> bool:
    return any(one.sigma <= OBSERVABLE_SIGMA[one.fault] for one in tested)


def _corrected(one: Contradiction) -> Finding:
    done = _DONE.get(one.fault, "it was left out of the result")
    says = f"{wrong_as(one)} ({one.sigmas:.0f} sigmas); {done}: {remedy_of(one)}"
    return Finding(
        CHECKS[one.fault],
        Status.WARN,
        one.sigmas,
        CONTRADICTED_SIGMAS,
        "sigmas",
        says,
        ", ".join(one.cameras),
    )


_DONE = {
    Fault.CLOCK: "the images were posed anew",
    Fault.SIZE: "all known sizes were left out of the result",
}
"""How an input was corrected, where it was not just left out."""


def _contradicted(one: Contradiction, others: list[Contradiction]) -> Finding:
    rivals = [wrong_as(other) for other in others if other.sigmas > 0.8 * one.sigmas]
    instead = f" or {rivals[0]}" if rivals else ""
    says = f"{wrong_as(one)}{instead} ({one.sigmas:.0f} sigmas), and the map is wrong by it: {remedy_of(one)}"
    return Finding(
        CHECKS[one.fault],
        Status.FAIL,
        one.sigmas,
        CONTRADICTED_SIGMAS,
        "sigmas",
        says,
        ", ".join(one.cameras),
    )


def _agrees(check: str, tested: list[Contradiction]) -> Finding:
    if not _is_told(tested):
        says = "the markings of this drive do not tell it: drive a turn, and past more of them"
        return passed(check, ", ".join(tested[0].cameras), says)
    told = [one for one in tested if one.sigma <= OBSERVABLE_SIGMA[one.fault]]
    worst = max(told, key=lambda one: one.sigmas)
    names = ", ".join(worst.cameras)
    if is_contradicted(worst):
        return passed(check, names, "not told apart from what is named as wrong: mend that first")
    says = f"the markings agree with what is stated, to {worst.sigmas:.1f} sigmas"
    return Finding(check, Status.PASS, worst.sigmas, CONTRADICTED_SIGMAS, "sigmas", says, names)


def _untold(evidence: SolveEvidence, raised: set[str]) -> list[Finding]:
    """What no drive of this kind can tell of all cameras together, and what would."""
    findings = []
    clocks = _of_all(evidence, Fault.CLOCK, Fault.CLOCK)
    loosest_s = max((one.sigma for one in clocks), default=0.0)
    if loosest_s > CLOCK_OBSERVABLE_S and "clock" not in raised:
        sigma_ms = 1e3 * loosest_s
        sure = f"better than {2 * sigma_ms:.0f} ms" if np.isfinite(sigma_ms) else "at all"
        says = (
            f"the markings do not tell {sure} whether all clocks are late alike: drive a turn, or change the "
            "speed"
        )
        findings.append(passed("clock", "all cameras", says))
    levers = _of_all(evidence, Fault.LEVER, Fault.SURVEY)
    axes = sorted({one.axis for one in levers if one.axis < 2 and one.sigma > LEVER_TOLD_M})
    if axes and "survey" not in raised:
        names = " and ".join(("forward", "left")[axis] for axis in axes)
        says = (
            f"this drive does not tell how far {names} the cameras sit of the point that the poses are of: "
            "the survey of centre and antenna is relied on; drive a turn"
        )
        findings.append(passed("survey", "all cameras", says))
    return findings


def _of_all(evidence: SolveEvidence, shared: Fault, single: Fault) -> list[Contradiction]:
    """The tests of all cameras together, those of the only one where there are no others."""
    together = [one for one in evidence.suspects if one.fault is shared and len(one.cameras) > 1]
    return together or [one for one in evidence.suspects if one.fault is single]


def check_fit(evidence: SolveEvidence) -> list[Finding]:
    """How well observations and poses fit, before any variance was adapted to them."""
    factor = evidence.variance_factor
    worst = int(np.argmax(evidence.along_route))
    window = float(evidence.along_route[worst] / max(np.median(evidence.along_route), 1e-12))
    findings = [
        judge(
            "fit",
            "map",
            factor,
            VARIANCE_LIMIT,
            "",
            fine=f"corners scatter with {factor:.2f} times the variance that the detector states",
            wrong=f"corners scatter with {factor:.1f} times the variance that the detector states: poses, "
            f"lens and "
            "images do not fit together; check camera_info and the pose_noise first",
        ),
        judge(
            "fit along the route",
            "map",
            window,
            WINDOW_LIMIT,
            "",
            fine="the fit is even along the route",
            wrong=f"from {evidence.window_s[worst]:.1f} s on corners scatter with {window:.0f} times the "
            f"usual "
            "variance: the position jumps there, or poses are missing; check the fix of the receiver",
        ),
    ]
    for name, fit in evidence.fits.items():
        findings.append(
            judge(
                "rejected",
                name,
                fit.rejected_share,
                REJECTED_LIMIT,
                "",
                fine=f"{100 * fit.rejected_share:.1f} % of its corners contradict the rest",
                wrong=f"{100 * fit.rejected_share:.0f} % of its corners contradict the rest: its lens, "
                f"clock or "
                "mounting is not as stated",
            )
        )
    loss = evidence.held_out_loss
    if loss is not None:
        findings.append(
            judge(
                "held out",
                "map",
                loss,
                HELD_OUT_LIMIT,
                "",
                fine="the map predicts corners that it has not seen as well as the noise allows",
                wrong="the map mispredicts corners that it has not seen: an error of poses, clocks or "
                "lens is left",
            )
        )
    return [*findings, *_poses(evidence)]


def _poses(evidence: SolveEvidence) -> list[Finding]:
    if not evidence.pose_pulls:
        return []
    state = max(evidence.pose_pulls, key=lambda name: evidence.pose_pulls[name])
    pull = evidence.pose_pulls[state]
    key = {"roll": "roll_pitch_rad", "pitch": "roll_pitch_rad", "heading": "heading_rad"}.get(
        state, "position_m"
    )
    return [
        judge(
            "pose noise",
            "poses",
            pull,
            POSE_PULL_LIMIT,
            "sigmas",
            fine="the poses are as good as pose_noise says, or better",
            wrong=f"the {state} of the poses errs {pull:.1f} times as much as pose_noise says: sigmas of "
            f"the map are "
            f"too small; state a larger {key}",
            status=Status.WARN,
        ),
        judge(
            "pose jump",
            "poses",
            evidence.worst_pull,
            JUMP_LIMIT,
            "sigmas",
            fine="no pose stands out from the others",
            wrong=f"at {evidence.worst_pull_s:.1f} s the pose is {evidence.worst_pull:.0f} sigmas from "
            f"where the "
            "markings put it: the position jumps, or the fix was lost; check the receiver's log there",
            status=Status.WARN,
        ),
    ]


def _excluded(best: MethodResult) -> Finding:
    # A place that is merely uncertain was seen too far off, or too briefly: it contradicts nothing.
    left_out = sum(one.reason != TOO_UNCERTAIN for one in best.excluded)
    count = left_out + len(best.hd_map.markings)
    share = left_out / max(count, 1)
    surely = share - 2 * float(np.sqrt(share * (1 - share) / max(count, 1)))
    return judge(
        "excluded",
        "map",
        surely,
        EXCLUDED_LIMIT,
        "",
        fine=f"{left_out} of {count} candidates were left out, those aside that are merely uncertain",
        wrong=f"{left_out} of {count} candidates were left out: markings are seen, but not where others put "
        "them; see excluded.geojson",
        status=Status.WARN,
    )
