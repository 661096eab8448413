"""Tests of inputs that every section made, as tests of the whole drive.

An error of an input is the same in all sections: its estimates are averaged, and their disagreement, in which
errors that a section does not know of show, widens the average's sigma. A change of an input happens in one
section: of the sections' likeliest changes the likeliest one counts, among as many.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from v2hdm.errors import MappingError
from v2hdm.faults import Contradiction, Item, Recovery
from v2hdm.faults.odds import is_contradicted, log_odds
from v2hdm.mapping.recovery import is_ambiguous
from v2hdm.mapping.results import ForeignSegment

_PRIOR_FREEDOM = 15.0  # degrees of freedom of the prior that sections agree as their sigmas say; chosen


def pooled_tests(by_section: Sequence[Sequence[Contradiction]]) -> tuple[Contradiction, ...]:
    """The tests of all sections, one for each input, the most likely error first."""
    alike: dict[object, list[Contradiction]] = {}
    for tests in by_section:
        for test in tests:
            about = "" if test.fault.item is Item.FRAME else test.about
            alike.setdefault((test.fault.name, test.axis, test.cameras, about), []).append(test)
    pooled = [
        _likeliest(tests) if tests[0].fault.item is Item.FRAME else _mean(tests) for tests in alike.values()
    ]
    return tuple(sorted(pooled, key=log_odds, reverse=True))


def _likeliest(tests: Sequence[Contradiction]) -> Contradiction:
    """The likeliest of the changes of several sections, with Sidak's correction for the others."""
    likeliest = max(tests, key=lambda test: test.gain)
    count = len(tests)
    p_value = -float(np.expm1(count * np.log1p(-min(likeliest.p_value, 1 - 1e-9))))
    return replace(likeliest, p_value=p_value, gain=likeliest.gain - math.log(count))


def _mean(tests: Sequence[Contradiction]) -> Contradiction:
    """The mean of one input's error over the sections, weighted by their information."""
    finite = [test for test in tests if math.isfinite(test.sigma) and math.isfinite(test.model_sigma)]
    if len(finite) < 2:
        return finite[0] if finite else tests[0]
    value = np.array([test.value for test in finite])
    information = np.array([test.sigma for test in finite]) ** -2.0
    score = information * value
    mean = float(score.sum() / information.sum())
    freedom = len(finite) - 1
    disagreement = float(information @ np.square(value - mean)) / freedom
    multiple = max((_PRIOR_FREEDOM + freedom * disagreement) / (_PRIOR_FREEDOM + freedom), 1.0)
    sigma = math.sqrt(multiple / float(information.sum()))
    # Each section is predicted from the others, as segments are within a section.
    predicted = (score.sum() - score) / (information.sum() - information)
    gain = float(np.sum(predicted * score - predicted**2 * information / 2)) / multiple
    of_model = float(np.sum(np.array([test.model_sigma for test in finite]) ** -2.0)) ** -0.5
    return replace(
        max(finite, key=lambda test: test.gain),
        value=mean,
        sigma=sigma,
        model_sigma=of_model,
        p_value=2 * float(ndtr(-abs(mean) / sigma)),
        gain=gain,
    )


def refuse_contradicted(tests: Sequence[Contradiction], foreign: ForeignSegment) -> None:
    """Raise MappingError where a drive contradicts an input that the mapper could do without.

    Without sections it would do without it; sections, which have all that they share in common, cannot.
    """
    worst = next((test for test in tests if is_contradicted(test)), None)
    if worst is None or worst.fault.recovery is Recovery.NONE or log_odds(worst) <= foreign.gain:
        return
    if worst.sigma > worst.fault.recoverable_sigma or is_ambiguous(worst, tests):
        return
    about = f" {worst.about}" if worst.about else ""
    raise MappingError(
        f"the sections together contradict the {worst.fault.name}{about} of {' and '.join(worst.cameras)} by "
        f"{worst.sigmas:.0f} sigmas ({worst.value:+.3g} {worst.fault.unit}); correct it, or map without "
        "sections (map.section_m=0)"
    )
