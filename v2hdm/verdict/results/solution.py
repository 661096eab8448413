"""After the solve: contradicted inputs, how well everything fits, and whether results agree.

The inputs are tested one at a time (:mod:`v2hdm.faults.score_tests`); a contradicted input that could be done
without has been dropped (:mod:`v2hdm.mapping.recovery`) and is reported here. Every other sign of a wrong
input is measured as well, so that an unforeseen fault is not silent. docs/verdict.md has the figures of clean
and spoilt drives.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import betaln, logsumexp

from v2hdm.densities import log_beta_density
from v2hdm.faults import Contradiction, Fault, table
from v2hdm.faults.odds import (
    CLEAR_SIGMAS,
    RIVAL_LOG_ODDS,
    even_sigmas,
    is_contradicted,
    is_observable,
    is_physical,
    is_possible,
    leaves_doubt,
    log_odds,
    matters,
    possible_sigmas,
    probability,
)
from v2hdm.faults.sensitivity import STRETCHES
from v2hdm.ground.results import GroundEstimate
from v2hdm.mapping.results import CameraFit, MethodResult, SolveEvidence
from v2hdm.records import Drive
from v2hdm.site.candidates import LACKS_A_CORNER, TOO_UNCERTAIN
from v2hdm.site.parallax import NOT_OBSERVED, NOT_ON_GROUND
from v2hdm.verdict.results import agreement
from v2hdm.verdict.verdict import Finding, Status, judge, passed

_HELD_OUT_LIMIT = 4.0
"""Largest mean robust loss of held-out observations: clean drives reach 1.9 to 2.3, wrong inputs begin at
6.5."""

_EXCLUDED_LIMIT = 0.2
"""Largest share of candidate markings that may be left out, not counting those that are merely uncertain, and
two standard errors taken off: clean drives reach 0.05 of hundreds and 0.13 of 26, swapped axes 0.75 of
200."""

_REJECTED_OF_RIGHT = (2.0, 300.0)
"""Beta distribution of the share of a camera's corners that the others contradict on right drives: its mean
and standard deviation are a little above those of 50 cameras, rendered or made without pictures, 0.0055 and
0.0035."""

_REJECTED_OF_WRONG = (1.0, 6.0)
"""The same where a lens, clock or mounting is wrong: mean 0.14, as without distortion coefficients."""

_OTHER_SHARE = 0.1
"""Share of candidates that are no markings on the ground, such as running boards, on right drives: those left
out there are 0.05 of hundreds and 0.13 of 26."""

_SHARES = np.logspace(-6, np.log10(0.999), 400)  # shares of rejected sightings, over which is integrated

_VARIANCE_LIMIT = 3.0
"""Largest variance of observations over the one that the detector states: clean drives reach 0.2, a drive
without its distortion 6."""

_POSE_NOISE_LIMIT = 3.0
"""Largest noise of the poses over the stated one; where none is stated, the usual one may be off by three."""

_ODDS_LIMIT = CLEAR_SIGMAS**2 / 2  # log odds from which a cause is named that no score test looks for
_LEAST_JITTER_S = 0.005  # scatter of stamps, s, that does not matter
_USUAL_JITTER_S = 0.02  # scatter of stamps, s, that is usual where there is any
_JUMP_LIMIT = 9.0  # largest single correction of a pose, in sigmas
_CLOCK_OBSERVABLE_S = 0.004  # largest sigma of an observed clock offset, s: two are 8 ms

_LEVER_OBSERVABLE_M = 0.025
"""Largest sigma, m, of the point that the poses are of, at which a drive observes it: twice that, at 95 %, is
the usual accuracy goal."""


def check_result(
    drive: Drive, best: MethodResult, ground: Sequence[Mapping[str, GroundEstimate]] = ()
) -> list[Finding]:
    """The checks after the solve ``best``, and its mountings against those of bare ground, by session."""
    findings = check_solution(drive, best)
    for session, estimates in zip(drive.sessions, ground, strict=False):
        of_session = agreement.check_against_ground(best, estimates)
        suffix = f" of {session.name}" if drive.joined else ""
        findings += [replace(finding, about=f"{finding.about}{suffix}") for finding in of_session]
    return findings


_OVER_PLANES = ("ground residual", "poses against ground")
"""Checks of images against bare ground, which they take for a plane around each image."""


def over_ground(findings: Iterable[Finding], best: MethodResult, is_tried: bool) -> list[Finding]:
    """The findings on the inputs as the map answers them, of which the ground is a surface or a plane.

    Where it is a surface no bend matters, nor what warns of images that do not move as over a plane. A small
    bend in the recorded heights is their noise if a surface was tried (``is_tried``, as
    ``mapping.ground=auto`` has it) and explained the markings no better.
    """
    if best.hd_map.ground:
        fine = "the ground is curved, and mapped as a surface"
        answered = {"road": tuple(Status), **dict.fromkeys(_OVER_PLANES, (Status.WARN,))}
    else:
        fine = "the recorded heights are curved, but the markings show a plane"
        answered = {"road": (Status.WARN,)} if is_tried else {}
    return [
        replace(finding, status=Status.PASS, says=fine, limit=None)
        if finding.status in answered.get(finding.check, ())
        else finding
        for finding in findings
    ]


def told_by_poses(findings: Iterable[Finding], of_inputs: Iterable[Finding]) -> list[Finding]:
    """The findings of a solve, without those raised under poses that failed before it (``of_inputs``).

    A solve takes the poses' kind of error as stated. Under a heading that is none, or stamps that jitter, it
    lays what they did to clocks, surveys and mountings: that follows, and says nothing of these.
    """
    failed = any(f.status is Status.FAIL and f.about == "poses" for f in of_inputs)
    return [finding for finding in findings if not failed or finding.status is Status.PASS]


def check_solution(drive: Drive, best: MethodResult) -> list[Finding]:
    """All checks after the solve; arguments as for :func:`check_result`."""
    causes: list[Finding] = []
    symptoms: list[Finding] = []
    if best.evidence is not None:
        causes = check_inputs(best.evidence)
        symptoms = [*check_fit(best.evidence), _excluded(best)]
    symptoms += [*agreement.check_doubles(best), *agreement.check_heights(drive)]
    symptoms += agreement.check_agreement(best, drive)
    named = next((finding for finding in causes if finding.status is Status.FAIL), None)
    return [*causes, *(_explained(finding, named) for finding in symptoms)]


def _explained(finding: Finding, named: Finding | None) -> Finding:
    """A symptom that points to the cause which the tests of the inputs have named, if they have."""
    if named is None or finding.status is Status.PASS:
        return finding
    return replace(finding, says=f"{finding.says.split(': ')[0]}: see {named.check}")


def check_inputs(evidence: SolveEvidence) -> list[Finding]:
    """Inputs that were dropped, inputs that are contradicted still, and what is not observable."""
    findings = [_corrected(error) for error in evidence.corrected]
    raised = {finding.check for finding in findings}
    contradicted = [test for test in evidence.score_tests if is_contradicted(test)]
    if not contradicted:
        contradicted = [test for test in evidence.score_tests if _is_left(test, evidence.corrected)][:1]
    foreign = _foreign(evidence)
    named = _named(evidence, contradicted, foreign)
    findings += named if foreign.status is Status.FAIL else [*named, foreign]
    raised |= {finding.check for finding in named}
    tests_of: dict[str, list[Contradiction]] = {}
    for test in evidence.score_tests:
        tests_of.setdefault(test.fault.check, []).append(test)
    unobservable = list(_unobservable(evidence, raised))
    answered = raised | {
        finding.check for finding in unobservable if not _observable(tests_of[finding.check])
    }
    findings += [_agrees(check, tests) for check, tests in tests_of.items() if check not in answered]
    return [*findings, *unobservable]


def _named(evidence: SolveEvidence, contradicted: list[Contradiction], foreign: Finding) -> list[Finding]:
    """The causes to be told, the likeliest first: each would explain part of the same contradictions.

    Others are left out if less than a tenth as likely, but for stamps that jitter within the allowed noise.
    Where the corners fit badly and no input is contradicted, something is wrong for certain: then stamps need
    only be ten times likelier to jitter than not.
    """
    is_unexplained = not contradicted and _fits_badly(evidence)
    stamps = _stamps(evidence, RIVAL_LOG_ODDS if is_unexplained else _ODDS_LIMIT)
    causes = {foreign: evidence.foreign.gain} if foreign.status is Status.FAIL else {}
    if contradicted:
        likeliest = contradicted[0]
        finding = _contradicted(contradicted) if is_physical(likeliest) else _unknown(likeliest)
        causes[finding] = log_odds(likeliest)
    doubtful = _doubtful(evidence)
    if not causes and stamps.status is not Status.FAIL and doubtful:
        causes[_doubted(doubtful)] = log_odds(doubtful[0])
    jitter = stamps
    if stamps.status is not Status.PASS:
        # Noise that is allowed for contradicts no input: where one is, and they explain it, they do harm.
        jitter = replace(stamps, status=Status.FAIL) if contradicted else stamps
        causes[jitter] = _jitter_odds(evidence)
    least = max(causes.values(), default=0.0) - RIVAL_LOG_ODDS
    named = [cause for cause in sorted(causes, key=lambda cause: -causes[cause]) if causes[cause] > least]
    return [*named, stamps] if stamps.status is Status.WARN and jitter not in named else named


def _observable(tested: list[Contradiction]) -> list[Contradiction]:
    """The tests that this drive observes; none where an error that all cameras share may hide beside them."""
    return [] if _hidden(tested) else [test for test in tested if _is_observable(test)]


def _hidden(tested: list[Contradiction]) -> list[Contradiction]:
    """Errors of single cameras that this drive observes, and that all may share without its seeing them."""
    observed_faults = {
        (test.fault, test.axis) for test in tested if len(test.cameras) == 1 and _is_observable(test)
    }
    shared = [test for test in tested if len(test.cameras) > 1 and (test.fault, test.axis) in observed_faults]
    return [test for test in shared if not _is_observable(test)]


def _is_observable(test: Contradiction) -> bool:
    return _sigma(test) <= test.fault.observable_sigma


def _corrected(error: Contradiction) -> Finding:
    fault = error.fault
    says = f"{error.sentence} ({error.sigmas:.0f} sigmas); {fault.corrected_by}: {fault.remedy}"
    return _input(error, Status.WARN, says)


def _is_left(test: Contradiction, corrected: Sequence[Contradiction]) -> bool:
    """Whether, a clock corrected, a drift or heading is likelier than none: even odds, once it is off."""
    off = {camera for error in corrected if error.fault is table.CLOCK for camera in error.cameras}
    return test.fault.like_clock and off >= set(test.cameras) and matters(test) and log_odds(test) > 0


def _unknown(test: Contradiction) -> Finding:
    """No input can be off by as much as would explain the residuals."""
    says = (
        "the markings contradict the inputs, and no plausible input error explains them: compare "
        "images and poses in time and space"
    )
    return Finding("cause unknown", Status.FAIL, test.sigmas, even_sigmas(test), "sigmas", says, "map")


def _contradicted(tests: list[Contradiction]) -> Finding:
    likeliest = tests[0]
    least = log_odds(likeliest) - RIVAL_LOG_ODDS
    rivals = [test.sentence for test in tests if log_odds(test) > least]
    says = f"{' or '.join(rivals)} ({likeliest.sigmas:.0f} sigmas)"
    return _input(likeliest, Status.FAIL, f"{says}, and the map is wrong by it: {likeliest.fault.remedy}")


def _doubted(tests: list[Contradiction]) -> Finding:
    likeliest = tests[0]
    says = " or ".join(test.sentence for test in tests)
    says = f"{says}, as far as the drive can tell ({likeliest.sigmas:.1f} sigmas): {likeliest.fault.remedy}"
    return _input(likeliest, Status.WARN, says)


def _input(test: Contradiction, status: Status, says: str) -> Finding:
    about = ", ".join(test.cameras)
    limit = even_sigmas(test) if status is Status.FAIL else possible_sigmas(test)
    # It is one on errors that matter: what is too small to matter passes beyond it, and has none.
    decides = (test.sigmas > limit) is (status is not Status.PASS)
    return Finding(test.fault.check, status, test.sigmas, limit if decides else None, "sigmas", says, about)


def _agrees(check: str, tested: list[Contradiction]) -> Finding:
    observable = _observable(tested)
    if not observable:
        hidden = _hidden(tested)
        least = min(hidden or tested, key=_sigma)
        below = f" below {_least_shown(least)}" if np.isfinite(_sigma(least)) else ""
        whose = " that all cameras share" if hidden else ""
        says = f"the markings of this drive do not reveal errors{whose}{below}"
        return passed(check, ", ".join(least.cameras), f"{says}: include a turn, and drive past more of them")
    worst = max(observable, key=lambda test: test.sigmas)
    if is_contradicted(worst):
        says = "not told apart from what is named as wrong: fix that first"
        return passed(check, ", ".join(worst.cameras), says)
    shown = f"they show errors from {_least_shown(max(observable, key=_sigma))}"
    says = (
        f"the markings agree with the inputs, the largest deviation being {worst.sigmas:.1f} sigmas; {shown}"
    )
    if is_possible(worst) or worst.sigmas > CLEAR_SIGMAS:
        why = "other causes are likelier" if matters(worst) else "too little to matter by itself"
        says = f"the markings fit better if {worst.sentence} ({worst.sigmas:.1f} sigmas): {why}; {shown}"
    return _input(worst, Status.PASS, says)


def _sigma(test: Contradiction) -> float:
    """By the stretches or by the model, whichever is larger."""
    return max(test.sigma, test.model_sigma)


def _least_shown(test: Contradiction) -> str:
    """The size from which on a drive shows an error, with its unit."""
    return test.fault.shown(CLEAR_SIGMAS * _sigma(test))


def doubted(evidence: SolveEvidence) -> Contradiction | None:
    """The input that is likeliest to be off, of those that may well be, unless a likelier cause is named."""
    likeliest = next(iter(_doubtful(evidence)), None)
    raised = {finding.check for finding in check_inputs(evidence) if finding.status is not Status.PASS}
    return likeliest if likeliest is not None and likeliest.fault.check in raised else None


def _doubtful(evidence: SolveEvidence) -> list[Contradiction]:
    """The input likeliest to be off, and those at least a tenth as likely, if one may well be off."""
    rivals = [test for test in evidence.score_tests if is_observable(test) and not is_contradicted(test)]
    if not leaves_doubt(rivals):
        return []
    least = math.exp(-RIVAL_LOG_ODDS) * max(map(probability, rivals))
    return sorted((t for t in rivals if probability(t) > least), key=probability, reverse=True)


def relied_on(evidence: SolveEvidence) -> dict[str, str]:
    """By check, the inputs that would move the whole map if they erred in all cameras alike, unseen."""
    relied = {}
    if _loosest_clock_s(evidence) > _CLOCK_OBSERVABLE_S:
        relied[table.CLOCK.check] = "the clocks"
    if _loose_levers(evidence):
        relied[table.LEVER.check] = "the surveyed centres"
    return relied


def _loosest_clock_s(evidence: SolveEvidence) -> float:
    return max((test.sigma for test in _of_all(evidence, table.CLOCK, table.CLOCK)), default=0.0)


def _loose_levers(evidence: SolveEvidence) -> list[Contradiction]:
    levers = _of_all(evidence, table.LEVER, table.SURVEY)
    return [test for test in levers if test.axis < 2 and test.sigma > _LEVER_OBSERVABLE_M]


def _unobservable(evidence: SolveEvidence, raised: set[str]) -> Iterator[Finding]:
    """Errors of all cameras together that no drive of this kind shows, and the drive that would."""
    loosest_s = _loosest_clock_s(evidence)
    loose = _loose_levers(evidence)
    if loosest_s > _CLOCK_OBSERVABLE_S and "clock" not in raised:
        sure = f"to better than {2e3 * loosest_s:.0f} ms" if np.isfinite(loosest_s) else "at all"
        says = f"the markings do not show {sure} whether all clocks are equally late: include a turn"
        yield passed("clock", "all cameras", says)
    if loose and "survey" not in raised:
        names = " and ".join(("forward", "left")[axis] for axis in sorted({test.axis for test in loose}))
        worst_m = max(test.sigma for test in loose)
        shows = f"would show one from {200 * worst_m:.0f} cm on" if worst_m < 1 else "shows none"
        says = (
            f"nothing checks the surveyed centres and the antenna {names}: an error of theirs shifts the "
            f"whole map by as much, and this drive {shows}; measure them again, or include a turn"
        )
        yield passed("survey", "all cameras", says)


def _of_all(evidence: SolveEvidence, shared: Fault, single: Fault) -> list[Contradiction]:
    """The tests of all cameras together, those of the only one where there are no others."""
    together = [test for test in evidence.score_tests if test.fault is shared and len(test.cameras) > 1]
    return together or [test for test in evidence.score_tests if test.fault is single]


def check_fit(evidence: SolveEvidence) -> Iterator[Finding]:
    """How well observations and poses fit, before any variance was adapted to them."""
    factor = evidence.variance_factor
    scatter = "times the variance that the detector states"
    yield judge(
        "fit", "map", factor, _VARIANCE_LIMIT, "",
        fine=f"corners scatter with {factor:.2f} {scatter}",
        wrong=f"corners scatter with {factor:.1f} {scatter}: poses, lens and images do not fit together; "
        "check camera_info and the pose_noise first",
    )  # fmt: skip
    for name, fit in evidence.fits.items():
        says = f"{100 * fit.rejected_share:.1f} % of its corners contradict the rest"
        yield judge(
            "rejected", name, max(_rejected_odds(fit), 0.0), _ODDS_LIMIT, "",
            fine=f"{says}, of {fit.sightings:.0f} independent sightings",
            wrong=f"{says}, too many for {fit.sightings:.0f} independent sightings: its lens, clock or "
            "mounting is wrong",
        )  # fmt: skip
    if evidence.held_out_loss is not None:
        yield judge(
            "held out", "map", evidence.held_out_loss, _HELD_OUT_LIMIT, "",
            fine="the map predicts corners that it has not seen as well as the noise allows",
            wrong="the map mispredicts corners that it has not seen: poses, clocks or lens still err",
        )  # fmt: skip
    if evidence.pose_noise:
        yield from _poses(evidence)


def _rejected_odds(fit: CameraFit) -> float:
    """The log odds of a wrong camera, by how many of its sightings of each candidate are rejected.

    A wrong one contradicts all candidates alike. What stands or moves contradicts a right one, too, but by
    itself: it may have any share.
    """
    contradicted = fit.rejected_share * fit.sightings
    of_all = np.array([[fit.sightings, contradicted]])
    count, rejected = (fit.by_candidate if len(fit.by_candidate) else of_all).T
    agreeing = np.maximum(count - rejected, 0.0)
    of_marking = rejected * np.log(_SHARES[:, None]) + agreeing * np.log1p(-_SHARES[:, None])
    of_other = betaln(rejected + 1, agreeing + 1)
    other = _OTHER_SHARE if len(count) > 1 else 0.0
    with np.errstate(divide="ignore"):
        mixed = np.logaddexp(np.log1p(-other) + of_marking, np.log(other) + of_other)
    along = mixed.sum(axis=1) + np.log(np.gradient(_SHARES))
    wrong, right = (
        logsumexp(along + log_beta_density(_SHARES, a, b))
        for a, b in (_REJECTED_OF_WRONG, _REJECTED_OF_RIGHT)
    )
    return float(wrong - right)


def _foreign(evidence: SolveEvidence) -> Finding:
    """Images of another place than those before and after them, and than their poses."""
    segment = evidence.foreign
    return judge(
        "foreign images", "map", max(segment.gain, 0.0), _ODDS_LIMIT, "",
        fine="no stretch has markings that the other images lack",
        wrong=f"from {segment.begin_s:.1f} to {segment.end_s:.1f} s the images show other markings than "
        "before and after, as those of another drive do: compare the lists of images and poses",
    )  # fmt: skip


def _jitter_odds(evidence: SolveEvidence) -> float:
    """The log odds that stamps scatter: of unequal variances along the way and across it, a stretch each."""
    ratio = max(evidence.along_over_across, 1.0)
    size = math.log1p((evidence.jitter_s / _USUAL_JITTER_S) ** 2)
    return STRETCHES * math.log((ratio + 1 / ratio) / 2) - size


def _fits_badly(evidence: SolveEvidence) -> bool:
    """Whether observations fit so badly that something is wrong."""
    return any(finding.status is Status.FAIL for finding in check_fit(evidence))


def _stamps(evidence: SolveEvidence, limit: float) -> Finding:
    """Stamps that scatter: the poses err more than stated, from image to image, and only along the way.

    They are named from log odds of ``limit`` on.
    """
    ratio = evidence.along_over_across
    by_ms = 1e3 * evidence.jitter_s
    allowed = max(evidence.pose_noise.values(), default=0.0) <= _POSE_NOISE_LIMIT
    return judge(
        "image stamps", "poses", _jitter_odds(evidence) * (evidence.jitter_s > _LEAST_JITTER_S), limit,
        "", fine="the poses err as much across the path as along it",
        wrong=f"the stamps of the images jitter by {by_ms:.0f} ms: poses err {ratio:.0f} times as much along "
        "the way as across it: stamp images when exposed, not when they arrive",
        status=Status.WARN if allowed else Status.FAIL,
    )  # fmt: skip


def _poses(evidence: SolveEvidence) -> Iterator[Finding]:
    kind = max(evidence.pose_noise, key=lambda name: evidence.pose_noise[name])
    factor = evidence.pose_noise[kind]
    yield judge(
        "pose noise", "poses", factor, _POSE_NOISE_LIMIT, "",
        fine=f"the poses err {factor:.1f} times as much as pose_noise, which map and tests allow for",
        wrong=f"the poses err {factor:.1f} times as much as pose_noise.{kind}: state it, or find out "
        "why the receiver, or its clock, is worse than stated",
        status=Status.WARN,
    )  # fmt: skip
    yield judge(
        "pose jump", "poses", evidence.worst_innovation, _JUMP_LIMIT, "sigmas",
        fine="no pose stands out from the others",
        wrong=f"at {evidence.worst_innovation_s:.1f} s the pose is {evidence.worst_innovation:.0f} sigmas "
        "from where the markings put it: the position jumps, or the fix was lost; "
        "check the receiver's log there",
        status=Status.WARN,
    )  # fmt: skip


def _excluded(best: MethodResult) -> Finding:
    # What was too far off, too briefly in view, or no paint contradicts nothing.
    innocent = (TOO_UNCERTAIN, LACKS_A_CORNER, NOT_OBSERVED, NOT_ON_GROUND)
    left_out = sum(exclusion.reason not in innocent for exclusion in best.excluded)
    count = left_out + len(best.hd_map.markings)
    share = left_out / max(count, 1)
    surely = share - 2 * float(np.sqrt(share * (1 - share) / max(count, 1)))
    says = f"{left_out} of {count} candidates were left out"
    return judge(
        "excluded", "map", surely, _EXCLUDED_LIMIT, "",
        fine=f"{says}, not counting those that are merely uncertain or not on the ground",
        wrong=f"{says}: markings are seen, but not where others place them; see excluded.geojson",
        status=Status.WARN,
    )  # fmt: skip
