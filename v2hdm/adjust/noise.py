r"""How far the recorded poses err, and over which distance, by the drive itself: maximum marginal likelihood.

Receivers state their errors badly, and a road's ground moves the vehicle in ways that nobody states. Yet a
drive shows them: markings that were seen again and again have to lie still. With the estimated states s of the
frames integrated out, the likelihood of the observations is maximised over the sigmas theta of their prior,

.. math:: \hat\theta = \arg\max_\theta \log p(\theta) + \log \int p(u | s)\, p(s | \theta)\, ds,

by expectation and maximisation (Dempster, Laird and Rubin, JRSS B 39, 1977): states are drawn from their
posterior at the solution, where it is Gaussian, by the factors of :mod:`v2hdm.adjust.whitening`, and theta
makes the draws likeliest. What was stated is the prior: each sigma, and each distance over which a drift
fades, is log-normal about it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize_scalar

from v2hdm.adjust.layout import MIN_STEP, state_components, state_prior
from v2hdm.adjust.problem import POSE_STATES, Drift, PoseSigma, Problem
from v2hdm.adjust.solution import Solution
from v2hdm.adjust.whitening import factorise
from v2hdm.records import FloatArray

_SPREAD = math.log(2.5)
"""Standard deviation of the logarithm of a true sigma about that of the stated one: a factor of 2.5."""

_OVER_SPREAD = math.log(8.0)
"""The same of the distance over which a drift fades, which hardly anybody knows."""

_MOST = math.log(100.0)
"""Most that a sigma or distance is scaled by, as a logarithm."""

_DRAWS = 12
"""States drawn from the posterior: with hundreds of frames each sigma is known to a hundredth."""

_ROUNDS = 12
"""Most rounds of expectation and maximisation; they end when no sigma changes by more than ``_SETTLED``."""

_SETTLED = 0.02
"""Relative change of a sigma or distance that no longer matters."""

_GROUPS = {"position": (0, 1), "height": (2,), "roll_pitch": (3, 4), "heading": (5,)}
"""Axes of a frame's tangent whose errors are alike."""


@dataclass(frozen=True)
class _Scales:
    """Logarithms of what a group's stated white sigma, drift and distance are multiplied by."""

    white: float = 0.0
    drift: float = 0.0
    over: float = 0.0

    def apart(self, other: _Scales) -> float:
        """The largest relative change."""
        return max(abs(a - b) for a, b in zip(vars(self).values(), vars(other).values(), strict=True))


def estimate_noise(problem: Problem, solution: Solution) -> tuple[PoseSigma, ...]:
    """The sigmas of each visit's poses that make the drive likeliest; as stated where nothing is estimated.

    All visits' sigmas of a kind are scaled alike.

    Args:
        problem: the drive, with the stated sigmas.
        solution: of it, under sigmas that are not far off.
    """
    descent = solution.covariance.descent
    arrays, stated = descent.engine.arrays, problem.pose_sigmas
    if not arrays.states:
        return stated
    scales = dict.fromkeys(_GROUPS, _Scales())
    generator = torch.Generator()
    for _ in range(_ROUNDS):
        transition, root = _prior(problem, arrays.states, scales)
        like = arrays.state_transition.new_tensor
        engine = descent.engine.over(
            replace(arrays, state_transition=like(transition), state_information_root=like(root))
        )
        whitening = factorise(engine, descent.plan, descent.estimate, descent.robust)
        noise = torch.randn(_DRAWS, whitening.size, generator=generator.manual_seed(0), dtype=torch.float64)
        off = [whitening.step(y.to(whitening.gradient) - whitening.gradient)[0] for y in (*noise, *-noise)]
        states = descent.estimate.frame_state + torch.stack([one.frame_state for one in off])
        before, scales = scales, _likeliest(problem, arrays.states, states.cpu().numpy())
        if all(one.apart(before[name]) < _SETTLED for name, one in scales.items()):
            break
    return tuple(_scaled(one, scales) for one in stated)


def _prior(
    problem: Problem, axes: Sequence[int], scales: Mapping[str, _Scales]
) -> tuple[FloatArray, FloatArray]:
    """Transition and inverse sigmas of the frames' states under scaled sigmas."""
    sigmas = tuple(_scaled(one, scales) for one in problem.pose_sigmas)
    components = state_components(sigmas, tuple(POSE_STATES[axis] for axis in axes))
    return state_prior(problem.map_from_vehicle, components, problem.visit_of_frame)


def _scaled(stated: PoseSigma, scales: Mapping[str, _Scales]) -> PoseSigma:
    """A visit's sigmas, each multiplied by its scale."""

    def total(sigma: float, drift: Drift, scale: _Scales) -> tuple[float, Drift]:
        white = math.sqrt(max(sigma**2 - drift.sigma**2, 0.0)) * math.exp(scale.white)
        fading = Drift(drift.sigma * math.exp(scale.drift), drift.over_m * math.exp(scale.over))
        return math.hypot(white, fading.sigma), fading

    position_m, position = total(stated.position_m, stated.position_drift, scales["position"])
    heading_rad, heading = total(stated.heading_rad, stated.heading_drift, scales["heading"])
    attitude_rad, attitude = total(stated.roll_pitch_rad, stated.roll_pitch_drift, scales["roll_pitch"])
    height_m = stated.height_m * math.exp(scales["height"].white)
    return PoseSigma(position_m, heading_rad, attitude_rad, height_m, position, heading, attitude)


def _likeliest(problem: Problem, axes: Sequence[int], drawn: FloatArray) -> dict[str, _Scales]:
    """The scales under which the states (D, J, S) that were drawn are likeliest, by group."""
    unscaled = dict.fromkeys(_GROUPS, _Scales())
    _, root = _prior(problem, axes, unscaled)
    first_drift = next((n for n in range(1, len(axes)) if axes[n] <= axes[n - 1]), len(axes))
    poses, visit = problem.map_from_vehicle, problem.visit_of_frame
    step_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0, prepend=poses[:1, :3, 3]), axis=1)
    turn = np.tile(np.eye(6), (len(poses), 1, 1))
    turn[1:, :2, :2] = poses[1:, :2, :2].transpose(0, 2, 1) @ poses[:-1, :2, :2]
    goes_on = np.diff(visit, prepend=-1) == 0
    scales = {}
    for name, group in _GROUPS.items():
        white = [n for n in range(first_drift) if axes[n] in group]
        fading = [n for n in range(first_drift, len(axes)) if axes[n] in group]
        scale = _Scales()
        if white:
            squares = np.mean(np.sum((drawn[:, :, white] * root[:, white]) ** 2, axis=(1, 2)))
            scale = replace(scale, white=_scale_of(float(squares), len(root) * len(white)))
        if fading:
            drift = [one.drift_by_state()[axes[fading[0]]] for one in problem.pose_sigmas]
            sigma, over_m = (
                np.array([getattr(one, key) for one in drift])[visit] for key in ("sigma", "over_m")
            )
            own = drawn[:, :, fading]
            columns = [axes[n] for n in fading]
            before = np.einsum("jab,djb->dja", turn[:, columns][:, :, columns], np.roll(own, 1, axis=1))

            def profile(over: float) -> tuple[float, float]:
                """Negative log posterior at the best sigma for a distance, and that sigma, as scales."""
                memory = goes_on * np.exp(-np.maximum(step_m / (over_m * math.exp(over)), MIN_STEP))
                width = np.sqrt(1 - memory**2)
                new = (own - memory[:, None] * before) / (sigma * width)[:, None]
                count = own[0].size
                squares = float(np.mean(np.sum(new**2, axis=(1, 2))))
                best = _scale_of(squares, count)
                loss = (
                    count * best
                    + math.exp(-2 * best) * squares / 2
                    + own.shape[2] * float(np.log(width).sum())
                )
                return loss + best**2 / (2 * _SPREAD**2) + (over / _OVER_SPREAD) ** 2 / 2, best

            found = minimize_scalar(lambda over: profile(over)[0], bounds=(-_MOST, _MOST), method="bounded")
            scale = replace(scale, drift=profile(found.x)[1], over=float(found.x))
        scales[name] = scale
    return scales


def _scale_of(squares: float, count: int) -> float:
    """The likeliest logarithm a of a sigma's scale, for the sum of ``count`` squares in stated sigmas.

    Minimises count a + exp(-2 a) squares / 2 + a^2 / (2 spread^2) by Newton's method.
    """
    a = 0.5 * math.log(max(squares, 1e-12) / count)
    for _ in range(20):
        pull = math.exp(-2 * a) * squares
        a -= (count - pull + a / _SPREAD**2) / (2 * pull + 1 / _SPREAD**2)
    return min(max(a, -_MOST), _MOST)
