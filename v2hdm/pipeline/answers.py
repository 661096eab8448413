"""A person's answers to questions on lanes in a run: followed where its drives do not contradict them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, replace

from v2hdm.io.maps.corrections import Correction, Heard
from v2hdm.io.maps.questions import answers_among
from v2hdm.pipeline.result import Result
from v2hdm.topology.build import answered_graph
from v2hdm.verdict import Finding, Status, Verdict
from v2hdm.verdict.verdict import passed

_log = logging.getLogger(__name__)
_LISTED = 5  # answers that a finding names


def with_answers(result: Result, corrections: Sequence[Correction]) -> Result:
    """The result with those answers among ``corrections`` that it can follow, all of them in its figures.

    An answer that contradicts a drive, or has no lane at its place, is a finding.
    """
    answers = answers_among(corrections)
    if not answers or not result.methods:
        return result
    answered = answered_graph(result.map, result.drive.paths, answers)
    places = [correction.place for correction in corrections if correction.is_answer]
    reason_of = {id(refusal.answer): refusal.reason for refusal in answered.refused}
    heard_answers = [
        Heard(place, f"answered: {answer.answer}", f"not followed: {reason_of[id(answer)]}")
        if id(answer) in reason_of
        else Heard(place, f"answered: {answer.answer}")
        for place, answer in zip(places, answers, strict=True)
    ]
    for heard in heard_answers:
        _log.info("%s", f"answer on lanes: {heard.sentence}")
    figures = dict(result.figures)
    figures["corrections"] = [*figures.get("corrections", ()), *map(asdict, heard_answers)]
    findings = [*result.verdict.findings, _finding(heard_answers, len(answered.refused))]
    return replace(result, answers=answered.followed, figures=figures, verdict=Verdict.of(findings))


def _finding(heard_answers: Sequence[Heard], refused: int) -> Finding:
    about = "map.corrections"
    if not refused:
        return passed("answers on lanes", about, f"the lanes follow {len(heard_answers)} answers", 0.0)
    sentences = [heard.sentence for heard in heard_answers if heard.against]
    listed = "; ".join(sentences[:_LISTED])
    says = f"{refused} of {len(heard_answers)} cannot be followed: {listed}: answer these again"
    return Finding("answers on lanes", Status.WARN, float(refused), 0.0, "", says, about)
