r"""Errors of a solution by the clock of the images, which it takes as recorded.

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
from v2hdm.faults.sensitivity import Follow, Sensitivity, to_optimum
from v2hdm.records import FloatArray, PoseNoise


@dataclass(frozen=True)
class ClockError:
    """An error of the clock: ``share`` (J,) of it at each frame."""

    share: FloatArray
    is_drift: bool = False

    def hypothesis(self, problem: Problem) -> Hypothesis:
        """The error as a fault of a problem."""
        return lateness(problem, self.share, is_drift=self.is_drift)


class ClockEvidence(NamedTuple):
    """Evidence of observations on the n errors of clocks: ``information`` (n, n) and ``score`` (n,)."""

    information: FloatArray
    score: FloatArray


class ClockErrors(NamedTuple):
    """The errors of clocks as a whole drive shows them, of which a problem is a part.

    ``root`` (n, n) is one of their second moments, ``rising`` (J,) the share of a drift at each frame. The
    rest of the problem follows them as ``follow`` says.
    """

    root: FloatArray
    rising: FloatArray
    follow: Follow


def moves_with_clocks(
    problem: Problem, solution: Solution, noises: Sequence[PoseNoise], of_drive: ClockErrors | None = None
) -> Moves | None:
    """Motion of a solution under the errors of the clock that drive and prior leave open, one column each.

    ``noises`` are those of the sessions' poses. The errors are those ``of_drive``, or else come from the
    observations. None where the clock is stated to be right, or nothing moves.
    """
    twist = problem.twist_vehicle
    errors = list(errors_of_clocks(problem, noises, None if of_drive is None else of_drive.rising))
    if not errors or twist is None:
        return None
    solved = Sensitivity.at(solution.covariance.whitening)
    late = [error.hypothesis(problem) for error in errors]
    root = second_moments(_evidence(solved, late), noises) if of_drive is None else of_drive.root
    columns = [hypothesis.column(solved)["observations"].flatten().cpu().numpy() for hypothesis in late]
    moved = solved.moves(np.stack(columns, axis=1), to_optimum if of_drive is None else of_drive.follow)
    # A pose is where the vehicle was at the stamp: it errs by the way until the exposure, too.
    of_way = np.stack([np.asarray(twist) * error.share[:, None] for error in errors], axis=2)
    return Moves(moved.corners @ root, moved.extrinsic @ root, (of_way + moved.poses) @ root)


def second_moments(evidence: ClockEvidence, noises: Sequence[PoseNoise]) -> FloatArray:
    """Root (n, n) of the second moments of the errors, s, under prior and evidence."""
    sigma_s = [sigma for noise in noises for sigma in (noise.clock_s, noise.clock_drift_s) if sigma > 0]
    covariance = np.linalg.inv(np.diag(np.array(sigma_s) ** -2.0) + evidence.information)
    mean = covariance @ evidence.score
    return np.asarray(np.linalg.cholesky(covariance + np.outer(mean, mean)), dtype=np.float64)


def errors_of_clocks(
    problem: Problem, noises: Sequence[PoseNoise], rising: FloatArray | None = None
) -> Iterator[ClockError]:
    """Lateness and drift of each session's clock, as far as they may differ from zero."""
    for session, noise in enumerate(noises):
        is_own = problem.session_of_frame == session
        drift = np.zeros(len(is_own))
        drift[is_own] = np.linspace(-0.5, 0.5, int(is_own.sum())) if rising is None else rising[is_own]
        if noise.clock_s > 0:
            yield ClockError(is_own.astype(np.float64))
        if noise.clock_drift_s > 0:
            yield ClockError(drift, is_drift=True)


def _evidence(solved: Sensitivity, late: Sequence[Hypothesis]) -> ClockEvidence:
    """The observations' evidence: the less, the larger their noise is than the stated one."""
    efficient = solved.efficient_columns([hypothesis.column(solved) for hypothesis in late])
    multiple = noise_multiples(late, solved)
    return ClockEvidence(
        information=efficient @ efficient.T / np.sqrt(np.outer(multiple, multiple)),
        score=-efficient @ solved.flat(solved.residuals) / multiple,
    )
