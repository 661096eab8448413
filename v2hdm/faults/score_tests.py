r"""The single wrong input that would best explain the residuals: score tests at a solution.

A fault is one more parameter p of the model, zero in the solve: a clock offset, a focal length, a shift of a
survey. With whitened residuals r and Jacobians J_p by the fault and J_y by the estimated unknowns, one step
gives its value (Rao's score test; Rao, Linear Statistical Inference and Its Applications, 2nd ed., section
6e):

.. math:: z = J_p - J_y H^{-1} J_y' J_p, \quad p = -\frac{z' r}{z' z},

everything else being re-estimated along with p. Residuals of a real road are no white noise: errors of poses
and of the ground under the wheels are smooth along the route. So each segment g of the route yields a score
s_g = z_g' r_g and an information w_g = z_g' z_g of its own, and the segments' disagreement e_g = s_g + p w_g
is the noise that the fault is tested against: a cluster-robust variance (Liang and Zeger, Biometrika 73,
1986; corrected by Bell and McCaffrey, Survey Methodology 28, 2002; neighbours by Bartlett's weights, Newey
and West, Econometrica 55, 1987). With few segments it is noisy, hence shrunk (Smyth, Statistical Applications
in Genetics and Molecular Biology 3, 2004) towards what the drive's noise makes of it: positions may err less
than stated where angles err more, so that each kind of noise has a variance of its own over the stated one,
estimated from the disagreements of all faults (variance components; Rao, Journal of Multivariate Analysis 1,
1971). A fault costs about four evaluations of the gradient, and no solve.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import chdtrc, stdtr

from v2hdm.adjust.problem import Problem
from v2hdm.adjust.solution import Solution
from v2hdm.faults import table
from v2hdm.faults.columns import Hypothesis, hypotheses
from v2hdm.faults.score import ScoreTest
from v2hdm.faults.sensitivity import NOISES, POSITION_NOISE, Rows, Sensitivity
from v2hdm.faults.table import Fault
from v2hdm.records import FloatArray

_LEAST_OBSERVABLE = 1e-9  # fraction of a fault's own information, net of all else, below which it is rounding
_LAGS = 1  # neighbouring segments with correlated errors
_PRIOR_FREEDOM = 15.0  # degrees of freedom of the prior on each test's disagreement

_STATED_FREEDOM = 6.0
"""Degrees of freedom of the prior that a kind of noise has the stated variance: within a factor of 1.6 either
way in two of three drives."""

_OF_CAMERAS = ("camera_centre", "ground_planes")  # what is known of mountings beside the markings
_ROUNDS = 50  # towards the variances of the noise, which settle to 1 %


@dataclass(frozen=True)
class Segments:
    """Scores and information of the route's G segments on one fault; the last of each are of no segment."""

    score: FloatArray  # (G + 1,) s_g
    information: FloatArray  # (G + 1,) w_g
    drawn: FloatArray  # (D, G + 1) scores of noise drawn from the model
    information_alone: float  # the fault's information with all else known

    @property
    def is_observable(self) -> bool:
        """Whether the fault's net information exceeds rounding."""
        return float(self.information.sum()) > _LEAST_OBSERVABLE * self.information_alone > 0

    @property
    def value(self) -> float:
        """Estimated value of the fault."""
        return float(self.score.sum() / self.information.sum())

    @cached_property
    def disagreement(self) -> float:
        """Variance of the segments' scores relative to that under the model's noise."""
        scatter = self._scatter(np.vstack([self.score, self.drawn]))
        return float(scatter[0] / max(float(np.mean(scatter[1:])), 1e-300))

    def _scatter(self, scores: FloatArray) -> FloatArray:
        """Sums (n,) of squared residual scores (n, G + 1), with Bartlett's weights of neighbours."""
        values = scores.sum(axis=1, keepdims=True) / self.information.sum()
        off = (scores - values * self.information)[:, :-1]
        squared = np.square(off).sum(axis=1)
        for lag in range(1, _LAGS + 1):
            squared += 2 * (1 - lag / (_LAGS + 1)) * (off[:, lag:] * off[:, :-lag]).sum(axis=1)
        return np.asarray(np.maximum(squared, 0.0))

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the disagreement: effective number of segments minus one."""
        w = self.information[:-1]
        effective = float(w.sum()) ** 2 / max(float(w @ w), 1e-300) - float(w.sum() / self.information.sum())
        return max(effective, 0.0) / (
            1 + 2 * sum((1 - lag / (_LAGS + 1)) ** 2 for lag in range(1, _LAGS + 1))
        )

    def multiple(self, usual: float) -> float:
        """Variance of the segments' noise over the stated one, shrunk towards the ``usual`` one."""
        freedom = self.freedom
        return (_PRIOR_FREEDOM * usual + freedom * self.disagreement) / (_PRIOR_FREEDOM + freedom)

    def sigma(self, multiple: float) -> float:
        """Standard deviation of the value, if the segments' noise has such a variance over the stated one."""
        of_segments = float(self.information[:-1].sum())
        of_priors = float(self.information[-1])
        return float(np.sqrt(multiple * of_segments + of_priors)) / (of_segments + of_priors)

    @property
    def noise_multiple(self) -> float:
        """Variance of the noise in the score over the stated one, at least 1."""
        if not self.is_observable:
            return 1.0
        return max(self.sigma(self.multiple(1.0)) ** 2 * float(self.information.sum()), 1.0)


@dataclass(frozen=True)
class _Answer(Segments):
    """The segments' answer to one hypothesis."""

    hypothesis: Hypothesis
    of_surveys: tuple[float, float]  # score and information of what is known of the cameras' mountings
    by_noise: FloatArray  # (N,) information by the kind of noise
    moves_m: float  # as of :class:`v2hdm.faults.ScoreTest`

    @classmethod
    def to(cls, hypotheses: Sequence[Hypothesis], solved: Sensitivity) -> list[_Answer]:
        """The segments' scores at a solution, on some faults."""
        columns = [hypothesis.column(solved) for hypothesis in hypotheses]
        efficient = solved.efficient_columns(columns)
        of_cameras = np.r_[tuple(solved.places[name] for name in _OF_CAMERAS)]
        surveys = efficient[:, of_cameras]
        survey_scores = -surveys @ solved.flat(solved.residuals)[of_cameras]
        information = solved.information(efficient)
        noise = np.column_stack([-solved.flat(solved.residuals), solved.noise])
        scores = solved.by_stretch(efficient, noise)
        moves_m = _motions_m(hypotheses, columns, solved)
        return [
            cls(
                score=scores[number, :, 0],
                information=information[number].sum(axis=1),
                drawn=scores[number, :, 1:].T,
                information_alone=sum(float(row.square().sum()) for row in columns[number].values()),
                hypothesis=hypothesis,
                of_surveys=(float(survey_scores[number]), float(np.square(surveys[number]).sum())),
                by_noise=information[number].sum(axis=0),
                moves_m=float(moves_m[number]),
            )
            for number, hypothesis in enumerate(hypotheses)
        ]

    def without(self, effect: FloatArray) -> _Answer:
        """The answer without the ``effect`` (G + 1,) of another fault on the scores."""
        return replace(self, score=self.score - effect)

    @property
    def noise_shares(self) -> FloatArray:
        """Shares (N,) of the kinds of noise in the score's variance under the model."""
        return np.asarray(self.by_noise / self.by_noise.sum())

    def test(self, variances: FloatArray) -> ScoreTest:
        """The test, shrinking its variance factor towards that of noise with ``variances`` (N,)."""
        hypothesis = self.hypothesis
        fault = hypothesis.fault
        blank = ScoreTest(
            fault.name, hypothesis.camera, hypothesis.axis, hypothesis.item, moves_m=self.moves_m
        )
        if not self.is_observable:
            return blank
        multiple = self.multiple(float(self.noise_shares @ variances))
        if not fault.is_change:
            # Noise as lasting as the fault is common to all segments, and no disagreement of theirs: they may
            # widen the model's sigma, but not narrow it.
            multiple = max(multiple, 1.0)
        information = self.information[:-1]
        score = self.score[:-1]
        total = float(self.information.sum())
        sigma = self.sigma(multiple)
        # Each segment is predicted from the others, which include priors of no segment.
        predicted = (self.score.sum() - score) / np.maximum(total - information, _LEAST_OBSERVABLE * total)
        gain = float(np.sum(predicted * score - predicted**2 * information / 2)) / multiple
        # Surveys, and the ground, belong to no segment: they are one more, and gain by the value itself.
        survey_score, survey_information = self.of_surveys
        gain += self.value * survey_score - self.value**2 * survey_information / 2
        return replace(
            blank,
            value=self.value,
            sigma=sigma,
            model_sigma=total**-0.5,
            p_value=2 * float(stdtr(_PRIOR_FREEDOM + self.freedom, -abs(self.value) / sigma)),
            gain=gain,
        )


def _motions_m(hypotheses: Sequence[Hypothesis], columns: Sequence[Rows], solved: Sensitivity) -> FloatArray:
    """Root mean square motions (n,), m, of the corners under unit errors of lenses; 0 under others."""
    out = np.zeros(len(hypotheses))
    of_lens = [number for number, hypothesis in enumerate(hypotheses) if hypothesis.fault.is_of_lens]
    if of_lens:
        observed = [columns[number]["observations"].flatten().cpu().numpy() for number in of_lens]
        moved = solved.moves(np.stack(observed, axis=1)).corners
        out[of_lens] = np.sqrt(np.square(moved).sum(axis=1).mean(axis=0))
    return out


def score_faults(problem: Problem, solution: Solution) -> tuple[ScoreTest, ...]:
    """Tests at ``solution`` of every fault that ``problem`` can have, largest gain first."""
    solved = Sensitivity.at(solution.covariance.whitening)
    parts = solved.in_parts(hypotheses(problem, solved.arrays))
    answers = [answer for part in parts for answer in _Answer.to(part, solved)]
    variances = _noise_variances(answers, solved)
    tests = _likeliest_changes([(answer, answer.test(variances)) for answer in answers])
    tests += _control_points(problem, solution, float(variances[POSITION_NOISE]))
    return tuple(sorted(tests, key=lambda test: -test.gain))


def noise_multiples(hypotheses: Sequence[Hypothesis], solved: Sensitivity) -> FloatArray:
    """Variance (n,) of the noise in each fault's score over the stated one, at least 1."""
    return np.array([answer.noise_multiple for answer in _Answer.to(hypotheses, solved)])


def _noise_variances(answers: list[_Answer], solved: Sensitivity) -> FloatArray:
    """Variance (N,) of each kind of noise over the stated one, likeliest under the faults' disagreements.

    A true fault is noise to all other faults, and would hide itself: it is the one of the largest gain, and
    disagreements are those without it; of a change they are those of its likeliest frame. A disagreement
    varies as a chi-square about the mean of the variances, by their shares in the fault's score. The
    likelihood rises with each round (Fevotte and Idier, Neural Computation 23, 2011).
    """
    stated = np.ones(NOISES)
    likeliest: dict[tuple[Fault, int, int], tuple[float, _Answer]] = {}
    for answer in answers:
        if answer.is_observable:
            test = answer.test(stated)
            best = likeliest.setdefault((test.fault, test.camera, test.axis), (test.gain, answer))
            if test.gain > best[0]:
                likeliest[test.fault, test.camera, test.axis] = test.gain, answer
    if not likeliest:
        return stated
    first = max(likeliest.values(), key=lambda rated: rated[0])[1]
    tested = _without(first, [answer for _, answer in likeliest.values()], solved)
    # The prior is a fault of each kind of noise alone, whose segments disagree as stated.
    shares = np.stack([*(answer.noise_shares for answer in tested), *np.eye(NOISES)])
    disagreement = np.array([*(answer.disagreement for answer in tested), *stated])
    freedom = np.array([*(answer.freedom for answer in tested), *(_STATED_FREEDOM * stated)])
    variances = stated
    for _ in range(_ROUNDS):
        expected = shares @ variances
        observed = shares.T @ (freedom * disagreement / expected**2)
        variances = variances * np.sqrt(observed / (shares.T @ (freedom / expected)))
    return np.asarray(variances)


def _without(fault: _Answer, answers: Sequence[_Answer], solved: Sensitivity) -> list[_Answer]:
    """The answers without a fault of its estimated value, whose residuals are known."""
    (effect,) = fault.value * solved.efficient_columns([fault.hypothesis.column(solved)])
    out = []
    for part in solved.in_parts(answers):
        columns = solved.efficient_columns([answer.hypothesis.column(solved) for answer in part])
        effects = solved.by_stretch(columns, effect)
        out += [answer.without(of_scores) for answer, of_scores in zip(part, effects, strict=True)]
    return out


def _likeliest_changes(tested: list[tuple[_Answer, ScoreTest]]) -> list[ScoreTest]:
    """Keep the likeliest frame of each input's change, with Sidak's correction for the other frames."""
    tests = [test for _, test in tested if not test.fault.is_change]
    changes: dict[tuple[Fault, int, int], list[tuple[_Answer, ScoreTest]]] = {}
    for answer, test in tested:
        if test.fault.is_change:
            changes.setdefault((test.fault, test.camera, test.axis), []).append((answer, test))
    for candidates in changes.values():
        likeliest = max((test for _, test in candidates), key=lambda test: test.gain)
        count = _independent(candidates)
        p_value = -float(np.expm1(count * np.log1p(-min(likeliest.p_value, 1 - 1e-9))))
        tests.append(replace(likeliest, p_value=p_value, gain=likeliest.gain - float(np.log(count))))
    return tests


def _independent(changes: list[tuple[_Answer, ScoreTest]]) -> float:
    """Effective number of independent tests among these, whose noise is correlated.

    It is tr(R)^2 / tr(R^2) of their correlation R (Galwey, Genetic Epidemiology 33, 2009).
    """
    drawn = np.array([answer.drawn.ravel() for answer, test in changes if np.isfinite(test.sigma)])
    if not len(drawn):
        return float(len(changes))
    drawn = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    return float(len(drawn) ** 2 / np.sum((drawn @ drawn.T) ** 2))


def _control_points(problem: Problem, solution: Solution, variance: float) -> Iterator[ScoreTest]:
    """Test each surveyed point against everything else on its corner.

    The residual between a point and its corner has the point's covariance minus the corner's; both axes are
    tested together, with two degrees of freedom. ``variance`` is that of positions over the stated one: they
    place the corner.
    """
    control = problem.control
    if control is None or not len(control.corner):
        return
    covariance = solution.corner_covariance(control.corner[:, None])
    for item, (point, sigma_m) in enumerate(zip(control.points_map, control.sigma_m, strict=True)):
        off = solution.corners_map[control.corner[item]] - point
        expected = np.diag(sigma_m**2) - covariance[item]
        if np.linalg.eigvalsh(expected).min() <= _LEAST_OBSERVABLE * np.max(sigma_m) ** 2:
            continue
        squared = float(off @ np.linalg.solve(expected, off)) / max(variance, 1.0)
        # Without the point, its corner would lie farther away, by the point's share of the information.
        distance_m = float(np.linalg.norm(sigma_m**2 * np.linalg.solve(expected, off)))
        test_sigma_m = distance_m / max(squared, 1e-12) ** 0.5
        yield ScoreTest(
            table.CONTROL.name,
            camera=-1,
            axis=-1,
            item=item,
            value=distance_m,
            sigma=test_sigma_m,
            model_sigma=test_sigma_m,
            p_value=float(chdtrc(2, squared)),
            gain=squared / 2,
        )
