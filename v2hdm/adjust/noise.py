"""How far the recorded poses err, and over which distance, as the drive itself shows.

Receivers state their errors badly. Yet markings that were seen again and again have to lie still. The errors
of the poses are drawn from their posterior at the solution, where it is Gaussian, by the factors of
:mod:`v2hdm.adjust.whitening`; their mean square gives a sigma, and the distance after which their
autocorrelation has fallen to 1 / e that over which they fade. Under these the posterior is another one, so
the two take turns, as in expectation and maximisation (Dempster, Laird and Rubin, JRSS B 39, 1977). The
likelihood of the Gauss-Markov process would make far too long distances of roads smoother than it from image
to image.

What was stated is the prior: a long route overrules it; what images cannot see, such as an offset of the
whole map, stays as stated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch

from v2hdm.adjust.layout import state_prior
from v2hdm.adjust.problem import POSE_STATES, Drift, PoseSigma, Problem
from v2hdm.adjust.solution import Solution
from v2hdm.adjust.whitening import factorise
from v2hdm.geometry.planar import length_along
from v2hdm.records import FloatArray

_SPREAD = math.log(2.0)
"""Standard deviation of the logarithm of a true sigma, or distance, about the stated one: a factor of two."""

_MOST = math.log(30.0)  # most that a sigma or distance is scaled by, as a logarithm
_DRAWS = 8  # errors drawn from the posterior, each with its mirror image about the mean
_ROUNDS = 4  # rounds of drawing and estimating: sigmas move by a tenth in the third
_LEAST_STEP_M = 0.02  # step between frames below which a vehicle stands
_LEAST_LAGS = 8  # steps of a route below which no distance can be estimated

_GROUPS = {"position": (0, 1), "height": (2,), "roll_pitch": (3, 4), "heading": (5,)}
"""Axes of a frame's tangent whose errors are alike."""


@dataclass(frozen=True)
class _Scales:
    """Logarithms of what a group's stated white sigma, drift and distance are multiplied by."""

    white: float = 0.0
    drift: float = 0.0
    over: float = 0.0


def estimate_noise(problem: Problem, solution: Solution) -> tuple[PoseSigma, ...]:
    """The sigmas of each visit's poses that the drive shows; as stated where nothing is estimated.

    The solution is under sigmas that are not far off. All visits' sigmas of a kind are scaled alike.
    """
    descent = solution.covariance.descent
    arrays, stated = descent.engine.arrays, problem.pose_sigmas
    if not arrays.states:
        return stated
    states_of = tuple(POSE_STATES[axis] for axis in arrays.states)
    scales, generator = dict.fromkeys(_GROUPS, _Scales()), torch.Generator()
    for _ in range(_ROUNDS):
        sigmas = tuple(_scaled(one, scales) for one in stated)
        _, *prior = state_prior(replace(problem, pose_sigma=sigmas), states_of)
        transition, root = (arrays.state_transition.new_tensor(one) for one in prior)
        engine = descent.engine.over(
            replace(arrays, state_transition=transition, state_information_root=root)
        )
        whitening = factorise(engine, descent.plan, descent.estimate, descent.robust)
        noise = torch.randn(_DRAWS, whitening.size, generator=generator.manual_seed(0), dtype=torch.float64)
        off = [whitening.step(y.to(whitening.gradient) - whitening.gradient)[0] for y in (*noise, *-noise)]
        states = descent.estimate.frame_state + torch.stack([one.frame_state for one in off])
        errors = np.zeros((*states.shape[:2], 6))
        for column, axis in enumerate(arrays.states):
            errors[..., axis] += states[..., column].cpu().numpy()
        scales = {name: _scales(problem, errors, name) for name in _GROUPS}
    return tuple(_scaled(one, scales) for one in stated)


def _of_group(sigma: PoseSigma, name: str) -> tuple[float, Drift]:
    """Sigma and drift of a group."""
    axis = _GROUPS[name][0]
    return float(sigma.by_state()[axis]), sigma.drift_by_state()[axis]


def _scaled(stated: PoseSigma, scales: Mapping[str, _Scales]) -> PoseSigma:
    """A visit's sigmas, each multiplied by its scale."""
    out = {}
    for name, scale in scales.items():
        sigma, drift = _of_group(stated, name)
        white = math.sqrt(max(sigma**2 - drift.sigma**2, 0.0)) * math.exp(scale.white)
        fading = Drift(drift.sigma * math.exp(scale.drift), drift.over_m * math.exp(scale.over))
        out[name] = math.hypot(white, fading.sigma), fading
    (position_m, position), (height_m, _) = out["position"], out["height"]
    (attitude_rad, attitude), (heading_rad, heading) = out["roll_pitch"], out["heading"]
    return PoseSigma(position_m, heading_rad, attitude_rad, height_m, position, heading, attitude)


def _scales(problem: Problem, drawn: FloatArray, name: str) -> _Scales:
    """The scales of a group that errors (D, J, 6), drawn, call for."""
    errors = drawn[:, :, _GROUPS[name]]
    if name == "position":  # its drift keeps its direction in the map
        errors = np.einsum("jab,djb->dja", problem.map_from_vehicle[:, :2, :2], errors)
    stated = [_of_group(one, name) for one in problem.pose_sigmas]
    drift_m2, total_m2 = np.mean([[drift.sigma**2, sigma**2] for sigma, drift in stated], axis=0)
    over_m = float(np.mean([drift.over_m for _, drift in stated]))
    correlation, step_m, path_m = _autocorrelation(problem, errors)
    if not total_m2 > 0 or not correlation[0] > 0:  # not among the states of the frames
        return _Scales()
    if not drift_m2 or len(correlation) < _LEAST_LAGS:
        count = errors.shape[1] * errors.shape[2]
        return _Scales(white=_shrunk(0.5 * math.log(correlation[0] / total_m2), 1 / (2 * count)))
    fading, white = max(float(correlation[1]), 0.01 * correlation[0]), float(correlation[0] - correlation[1])
    below = np.flatnonzero(correlation <= fading / math.e)
    faded_m = step_m * float(below[0] if len(below) else len(correlation))
    independent = errors.shape[2] * max(path_m / (2 * faded_m), 0.5)
    return _Scales(
        white=_shrunk(
            0.5 * math.log(max(white, 1e-4 * correlation[0]) / max(total_m2 - drift_m2, 1e-4 * total_m2)),
            1 / (2 * independent),
        ),
        drift=_shrunk(0.5 * math.log(fading / drift_m2), 1 / (2 * independent)),
        over=_shrunk(math.log(faded_m / over_m), 1 / independent),
    )


def _autocorrelation(problem: Problem, errors: FloatArray) -> tuple[FloatArray, float, float]:
    """Mean products of errors (D, J, a) that lie 0, 1, 2 ... steps apart, the step, and the path, m."""
    poses, visit = problem.map_from_vehicle, problem.visit_of_frame
    products, counts, path_m = np.zeros(0), np.zeros(0), 0.0
    moved = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1)[np.diff(visit) == 0]
    moved = moved[moved > _LEAST_STEP_M]
    step_m = float(np.median(moved)) if len(moved) else _LEAST_STEP_M
    for own in (visit == number for number in range(problem.visit_count)):
        place = length_along(poses[own][:, :2, 3])
        grid = np.arange(0.0, place[-1] + step_m / 2, step_m)
        nearest = np.rint(np.interp(grid, place, np.arange(len(place)))).astype(np.int64)
        even = errors[:, own][:, nearest]
        size = 2 * len(grid)
        spectrum = np.abs(np.fft.rfft(even, size, axis=1)) ** 2
        found = np.fft.irfft(spectrum, size, axis=1)[:, : len(grid)].mean(axis=(0, 2))
        lags = max(len(products), len(found))
        products = np.pad(products, (0, lags - len(products))) + np.pad(found, (0, lags - len(found)))
        counts = np.pad(counts, (0, lags - len(counts))) + np.pad(
            np.arange(len(grid), 0, -1), (0, lags - len(found))
        )
        path_m += float(place[-1])
    return products / counts, step_m, path_m


def _shrunk(logarithm: float, variance: float) -> float:
    """An estimated logarithm of a scale, drawn towards 0, what was stated, as its variance asks for."""
    return float(np.clip(logarithm * _SPREAD**2 / (_SPREAD**2 + variance), -_MOST, _MOST))
