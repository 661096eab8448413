r"""What a solution may be off by the clock of the images, which it takes as recorded.

A clock that is equally late in all cameras is one more unknown p with a prior N(0, s^2), and so is its drift
over the drive; a solve holds both at zero. With the columns z of :mod:`v2hdm.faults.score_tests`, net of all
that is estimated, the observations know p with the information w = z'z and the score -z'r, so that

.. math:: p \sim N(m, v), \quad v = (s^{-2} + w)^{-1}, \quad m = -v z' r,

and the solution, which would follow p, is off with the second moment v + m^2. On a straight road at constant
speed w is almost nothing: a late clock and a map that is shifted along the road look the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from v2hdm.adjust.covariance import Moves
from v2hdm.adjust.problem import Problem
from v2hdm.adjust.solution import Solution
from v2hdm.faults.columns import Hypothesis, lateness
from v2hdm.faults.score_tests import noise_multiples
from v2hdm.faults.sensitivity import Sensitivity
from v2hdm.records import FloatArray, PoseNoise


@dataclass(frozen=True)
class _Error:
    """An error of the clock: ``share`` (J,) of it at each frame."""

    share: FloatArray
    is_drift: bool = False


class ClockEvidence(NamedTuple):
    """Evidence of observations on the n errors of clocks: ``information`` (n, n) and ``score`` (n,)."""

    information: FloatArray
    score: FloatArray


class ClockErrors(NamedTuple):
    """The errors of clocks as a whole drive shows them, of which a problem is a part.

    ``root`` (n, n) is one of their second moments, ``rising`` (J,) the share of a drift at each frame.
    """

    root: FloatArray
    rising: FloatArray


def moves_with_clocks(
    problem: Problem, solution: Solution, noises: Sequence[PoseNoise], known: ClockErrors | None = None
) -> Moves | None:
    """Motion of a solution under the errors of the clock that drive and prior leave open, one column each.

    ``noises`` are those of the sessions' poses; what is ``known`` of the errors comes from the observations
    unless it is stated. None where the clock is stated to be right, or nothing moves.
    """
    twist = problem.twist_vehicle
    errors = list(_errors(problem, noises, None if known is None else known.rising))
    if not errors or twist is None:
        return None
    solved = Sensitivity.at(solution.covariance.whitening)
    late = [lateness(problem, error.share, is_drift=error.is_drift) for error in errors]
    root = second_moments([_evidence(solved, late)], noises) if known is None else known.root
    columns = [hypothesis.column(solved)["observations"].flatten().cpu().numpy() for hypothesis in late]
    moved = solved.moves(np.stack(columns, axis=1))
    # A pose is where the vehicle was at the stamp: it errs by the way until the exposure, too.
    of_way = np.stack([np.asarray(twist) * error.share[:, None] for error in errors], axis=2)
    return Moves(moved.corners @ root, moved.extrinsic @ root, (of_way + moved.poses) @ root)


def clock_evidence(
    problem: Problem, solution: Solution, noises: Sequence[PoseNoise], rising: FloatArray
) -> ClockEvidence | None:
    """The evidence of a problem, part of a drive, on its clocks; None where these are stated to be right."""
    errors = list(_errors(problem, noises, rising))
    if not errors or problem.twist_vehicle is None:
        return None
    solved = Sensitivity.at(solution.covariance.whitening)
    return _evidence(solved, [lateness(problem, error.share, is_drift=error.is_drift) for error in errors])


def second_moments(evidence: Sequence[ClockEvidence], noises: Sequence[PoseNoise]) -> FloatArray:
    """Root (n, n) of the second moments of the errors, s, under prior and the evidence of all parts."""
    sigma_s = [sigma for noise in noises for sigma in (noise.clock_s, noise.clock_drift_s) if sigma > 0]
    information = np.sum([part.information for part in evidence], axis=0)
    score = np.sum([part.score for part in evidence], axis=0)
    covariance = np.linalg.inv(np.diag(np.array(sigma_s) ** -2.0) + information)
    mean = covariance @ score
    return np.asarray(np.linalg.cholesky(covariance + np.outer(mean, mean)), dtype=np.float64)


def _errors(
    problem: Problem, noises: Sequence[PoseNoise], rising: FloatArray | None = None
) -> Iterator[_Error]:
    """Lateness and drift of each session's clock, as far as they may differ from zero."""
    for session, noise in enumerate(noises):
        is_own = problem.session_of_frame == session
        drift = np.zeros(len(is_own))
        drift[is_own] = np.linspace(-0.5, 0.5, int(is_own.sum())) if rising is None else rising[is_own]
        if noise.clock_s > 0:
            yield _Error(is_own.astype(np.float64))
        if noise.clock_drift_s > 0:
            yield _Error(drift, is_drift=True)


def _evidence(solved: Sensitivity, late: Sequence[Hypothesis]) -> ClockEvidence:
    """The observations' evidence: the less, the larger their noise is than the stated one."""
    efficient = solved.efficient_columns([hypothesis.column(solved) for hypothesis in late])
    multiple = noise_multiples(late, solved)
    return ClockEvidence(
        information=efficient @ efficient.T / np.sqrt(np.outer(multiple, multiple)),
        score=-efficient @ solved.flat(solved.residuals) / multiple,
    )
