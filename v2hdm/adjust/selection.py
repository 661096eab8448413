"""The pose error model that a drive calls for, and its noise, estimated from the drive itself.

Every model is fitted to most observations of a part of the drive and predicts the rest: a model that omits an
error mispredicts, and so does one that fits noise. This needs no ground truth.

Receivers misstate their errors, but markings that are observed repeatedly lie still. Errors of the poses are
drawn from their Gaussian posterior at the solution, by the factors of :mod:`v2hdm.adjust.whitening`: their
mean square yields a sigma, and the distance at which their autocorrelation falls to 1 / e the correlation
length. The posterior depends on both, so the steps alternate, as in expectation and maximisation (Dempster,
Laird and Rubin, JRSS B 39, 1977). The likelihood of the Gauss-Markov process would overestimate the length
on roads smoother than it from image to image. The stated noise is the prior: a long route overrules it;
unobservable parts, such as an offset of the whole map, stay as stated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from v2hdm.adjust.layout import state_prior
from v2hdm.adjust.problem import (
    POSE_STATES,
    Drift,
    KnownLengths,
    Observations,
    PoseSigma,
    Problem,
    SolveOptions,
)
from v2hdm.adjust.solution import Solution
from v2hdm.adjust.solve import solve
from v2hdm.adjust.whitening import factorise
from v2hdm.errors import AdjustError, shown
from v2hdm.geometry.planar import length_along
from v2hdm.geometry.rigid import exp
from v2hdm.records import BoolArray, FloatArray, IntArray


def restrict(problem: Problem, keep: BoolArray) -> tuple[Problem, IntArray]:
    """``problem`` with the observations ``keep`` (K,) alone, and the corners of it that remain.

    Every camera must keep an observation. Frames are dropped before the first and after the last in use:
    drift continues through the others.
    """
    observations = problem.observations
    corners, corner = np.unique(observations.corner[keep], return_inverse=True)
    frame = observations.frame[keep]
    used = slice(int(frame.min()), int(frame.max()) + 1)
    poses_start = problem.poses_start
    start = problem.corners_start
    twist = problem.twist_vehicle
    control = problem.control
    if control is not None:
        is_kept = np.isin(control.corner, corners)
        number = np.searchsorted(corners, control.corner[is_kept])
        control = control.take(is_kept, number)
    lengths = problem.lengths
    if lengths is not None:
        is_kept = np.isin(lengths.first, corners) & np.isin(lengths.second, corners)
        first, second = (np.searchsorted(corners, ends[is_kept]) for ends in (lengths.first, lengths.second))
        lengths = KnownLengths(first, second, lengths.length_m[is_kept], lengths.sigma_m[is_kept])
    part = replace(
        problem,
        map_from_vehicle=problem.map_from_vehicle[used],
        poses_start=None if poses_start is None else poses_start[used],
        observations=replace(
            observations.take(keep), frame=frame - used.start, corner=corner.astype(np.int64)
        ),
        corner_count=len(corners),
        corners_start=None if start is None else start[corners],
        twist_vehicle=None if twist is None else twist[used],
        session=None if problem.session is None else problem.session[used],
        control=control,
        lengths=lengths,
    )
    return part, corners


@dataclass(frozen=True)
class Model:
    """The pose errors estimated beside map and extrinsics."""

    pose_states: tuple[str, ...] = ()
    clock_offset: bool = False


MODELS: Mapping[str, Model] = {
    "paper": Model(),
    "roll_pitch": Model(("roll", "pitch")),
    "full": Model(("roll", "pitch", "heading", "x", "y")),
    "heave": Model(("roll", "pitch", "heading", "x", "y", "height")),
    "clock": Model(("roll", "pitch", "heading", "x", "y", "height"), clock_offset=True),
}
"""Models by name, the simplest first. ``paper`` trusts the recorded poses."""

_STRETCH_FRAMES = 120  # number of frames of the part of the drive that models are compared on; chosen
_HELD_OUT_SHARE = 0.2  # fraction of its observations that are held out; chosen
_MIN_HELD_OUT = 40  # least number of held-out observations: with fewer, residuals cannot separate models

# Standard errors by which a model that can absorb errors of other inputs, such as a clock offset, must
# predict better than one without.
_SURE_STANDARD_ERRORS = 3.0

_LOSS_SCALE2 = 9.0  # squared sigmas at which the loss bends, lest wrong associations decide


@dataclass(frozen=True)
class Selection:
    """The chosen model, and every model's score: the mean robust loss of held-out observations.

    Scores are absent if too few observations repeat to be held out. With a correct model and Gaussian noise a
    score is a little below 2.
    """

    name: str
    scores: Mapping[str, float]

    @property
    def sentence(self) -> str:
        """One sentence on the choice."""
        if not self.scores:
            return f"pose model '{self.name}', since too few observations repeat to choose"
        scores = ", ".join(f"{name} {score:.2f}" for name, score in self.scores.items())
        return f"pose model '{self.name}' predicts held-out observations best (mean loss: {scores})"


def with_model(options: SolveOptions, model: Model) -> SolveOptions:
    """``options`` with the states and clock offsets of ``model``."""
    return replace(options, pose_states=model.pose_states, clock_offset=model.clock_offset)


def select_model(problem: Problem, options: SolveOptions, names: Sequence[str] = tuple(MODELS)) -> Selection:
    """Choose the richest of the models ``names`` that predicts as well as the best, from simplest to richest.

    As well means within one standard error of the paired difference, clustered by frame, within which errors
    correlate (Hastie, Tibshirani and Friedman, The Elements of Statistical Learning, section 7.10). A clock
    offset trades against the camera's forward offset, so it must beat all others by three standard errors;
    without twists it is left out. The extrinsics of ``problem`` should be near. Raises AdjustError for an
    unsolvable model.
    """
    unknown = [name for name in names if name not in MODELS]
    if unknown:
        raise AdjustError(f"unknown model {shown(unknown[0])}: choose from {', '.join(MODELS)}")
    candidates = [
        name for name in names if problem.twist_vehicle is not None or not MODELS[name].clock_offset
    ]
    punctual = [name for name in candidates if not MODELS[name].clock_offset] or candidates
    stretch, _ = restrict(problem, _stretch(problem))
    held_out = _held_out(stretch.observations)
    if np.count_nonzero(held_out) < _MIN_HELD_OUT:
        return Selection(punctual[-1], {})
    losses = {name: _losses(stretch, held_out, with_model(options, MODELS[name])) for name in candidates}
    frame = stretch.observations.frame[held_out]
    best = min(punctual, key=lambda name: float(losses[name].mean()))
    chosen = [name for name in punctual if _as_good(losses[name] - losses[best], frame)][-1]
    for name in candidates:
        gain = losses[best] - losses[name]
        if MODELS[name].clock_offset and not _as_good(gain, frame, _SURE_STANDARD_ERRORS):
            chosen = name
    return Selection(chosen, {name: float(loss.mean()) for name, loss in losses.items()})


def predicts_better(problem: Problem, rival: Problem, options: SolveOptions) -> bool:
    """Whether ``problem`` predicts held-out observations better than ``rival`` by three standard errors."""
    chosen = _stretch(problem)
    held_out = _held_out(restrict(problem, chosen)[0].observations)
    if np.count_nonzero(held_out) < _MIN_HELD_OUT:
        return False
    losses = _losses(restrict(problem, chosen)[0], held_out, options)
    losses_of_rival = _losses(restrict(rival, chosen)[0], held_out, options)
    frame = problem.observations.frame[chosen][held_out]
    return not _as_good(losses_of_rival - losses, frame, _SURE_STANDARD_ERRORS)


def _losses(whole: Problem, held_out: BoolArray, options: SolveOptions) -> FloatArray:
    """Robust losses of the ``held_out`` observations of ``whole``, predicted from the others."""
    fitted, corners = restrict(whole, ~held_out)
    solution = solve(fitted, replace(options, coarse=False))
    squared = predicted_squared(whole, held_out, fitted, solution, corners)
    return np.asarray(_LOSS_SCALE2 * np.log1p(squared / _LOSS_SCALE2))


def predicted_squared(
    whole: Problem, held_out: BoolArray, fitted: Problem, solution: Solution, corners: np.ndarray
) -> FloatArray:
    """Squared Mahalanobis distances of ``held_out`` observations from the solution of the others."""
    observations = whole.observations
    camera = observations.camera[held_out]
    frame = observations.frame[held_out]
    first = int(whole.observations.frame[~held_out].min())
    vehicle_from_map = np.linalg.inv(solution.map_from_vehicle)[frame - first]
    if fitted.twist_vehicle is not None:
        late_s = solution.clock_offset_s[camera, fitted.session_of_frame[frame - first]]
        if observations.row_share is not None:
            late_s = late_s + solution.read_out_s[camera] * observations.row_share[held_out]
        motion = fitted.twist_vehicle[frame - first] * late_s[:, None]
        vehicle_from_map = exp(-motion) @ vehicle_from_map
    cam_from_map = solution.cam_from_vehicle[camera] @ vehicle_from_map
    points_map = solution.corners_map[np.searchsorted(corners, observations.corner[held_out])]
    ground = np.column_stack([points_map, np.zeros(len(points_map)), np.ones(len(points_map))])
    points = (cam_from_map @ ground[..., None])[:, :3, 0]
    intrinsic = whole.intrinsic[camera]
    pixel = intrinsic[:, :2] * points[:, :2] / points[:, 2:] + intrinsic[:, 2:]
    offset_px = pixel - observations.pinhole_px[held_out]
    solved = np.linalg.solve(observations.covariance_px[held_out], offset_px[..., None])[..., 0]
    return np.asarray(np.sum(offset_px * solved, axis=1))


def _stretch(problem: Problem) -> BoolArray:
    """Observations (K,) of the run of frames with most of them, including every camera's."""
    observations = problem.observations
    frames = len(problem.map_from_vehicle)
    if frames <= _STRETCH_FRAMES:
        return np.ones(len(observations.frame), dtype=bool)
    count = np.zeros(frames + 1)
    count[1:] = np.cumsum(np.bincount(observations.frame, minlength=frames))
    begin = int(np.argmax(count[_STRETCH_FRAMES:] - count[:-_STRETCH_FRAMES]))
    keep = (observations.frame >= begin) & (observations.frame < begin + _STRETCH_FRAMES)
    keep &= np.bincount(observations.corner[keep], minlength=problem.corner_count)[observations.corner] >= 2
    everywhere = len(np.unique(observations.camera[keep])) == len(problem.intrinsic)
    return keep if everywhere else np.ones(len(observations.frame), dtype=bool)


def busiest(problem: Problem) -> int:
    """Number of observations of the part of the drive that models are compared on."""
    return int(np.count_nonzero(_stretch(problem)))


def _held_out(observations: Observations) -> BoolArray:
    """Held-out observations (K,); two of each corner stay, and the first and last frames."""
    rng = np.random.default_rng(0)
    order = rng.permutation(len(observations.corner))
    place = np.empty(len(order), dtype=np.int64)
    by_corner = order[np.argsort(observations.corner[order], kind="stable")]
    starts = np.flatnonzero(np.diff(observations.corner[by_corner], prepend=-1))
    place[by_corner] = np.arange(len(order)) - np.repeat(starts, np.diff(starts, append=len(order)))
    held_out = (place >= 2) & (rng.random(len(order)) < _HELD_OUT_SHARE)
    fitted = observations.frame[~held_out]
    return np.asarray(held_out & (observations.frame >= fitted.min()) & (observations.frame <= fitted.max()))


def _as_good(excess: FloatArray, frame: np.ndarray, standard_errors: float = 1.0) -> bool:
    """Whether losses exceed others by at most ``standard_errors``, clustered by ``frame``."""
    mean = float(excess.mean())
    by_frame = np.bincount(frame, weights=excess - mean)
    return mean <= standard_errors * float(np.sqrt(np.sum(by_frame**2))) / len(excess)


_SPREAD = math.log(2.0)
"""Prior sigma of the logarithm of a scale on a stated sigma or length: a factor of two."""

_MOST = math.log(30.0)  # largest logarithm of a scale on a stated sigma or length
_DRAWS = 8  # number of draws from the posterior, each with its mirror image about the mean
_ROUNDS = 4  # number of rounds of drawing and estimating: sigmas change by a tenth in the third
_LEAST_STEP_M = 0.02  # distance, m, between frames below which a vehicle stands
_LEAST_LAGS = 8  # least number of steps of a route that show a correlation length

_GROUPS = {"position": (0, 1), "height": (2,), "roll_pitch": (3, 4), "heading": (5,)}
"""Axes of a frame's tangent with a common scale."""


@dataclass(frozen=True)
class _Scales:
    """Logarithms of the scales on a group's stated white sigma, drift and correlation length."""

    white: float = 0.0
    drift: float = 0.0
    over: float = 0.0


def estimate_noise(problem: Problem, solution: Solution) -> tuple[PoseSigma, ...]:
    """Standard deviations of each session's poses, estimated from the drive; as stated where not observable.

    ``solution`` must be under roughly correct sigmas. All sessions share the scales.
    """
    descent = solution.covariance.descent
    arrays = descent.engine.arrays
    stated = problem.pose_sigmas
    if not arrays.states:
        return stated
    states_of = tuple(POSE_STATES[axis] for axis in arrays.states)
    scales = dict.fromkeys(_GROUPS, _Scales())
    generator = torch.Generator()
    engine = descent.engine
    for _ in range(_ROUNDS):
        sigmas = tuple(_scaled(sigma, scales) for sigma in stated)
        prior = state_prior(replace(problem, pose_sigma=sigmas), states_of)
        transition = arrays.state_transition.new_tensor(prior.transition)
        root = arrays.state_transition.new_tensor(prior.information_root)
        scaled = replace(arrays, state_transition=transition, state_information_root=root)
        engine = engine.over(scaled)
        whitening = factorise(engine, descent.plan, descent.estimate, descent.robust)
        noise = torch.randn(_DRAWS, whitening.size, generator=generator.manual_seed(0), dtype=torch.float64)
        steps = [whitening.step(y.to(whitening.gradient) - whitening.gradient)[0] for y in (*noise, *-noise)]
        states = descent.estimate.frame_state + torch.stack([step.frame_state for step in steps])
        errors = np.zeros((*states.shape[:2], 6))
        for column, axis in enumerate(arrays.states):
            errors[..., axis] += states[..., column].cpu().numpy()
        scales = {name: _scales(problem, errors, name) for name in _GROUPS}
    return tuple(_scaled(sigma, scales) for sigma in stated)


def _of_group(sigma: PoseSigma, name: str) -> tuple[float, Drift]:
    """Sigma and drift of a group."""
    axis = _GROUPS[name][0]
    return float(sigma.by_state()[axis]), sigma.drift_by_state()[axis]


def _scaled(stated: PoseSigma, scales: Mapping[str, _Scales]) -> PoseSigma:
    """A session's sigmas times their scales."""
    out = {}
    for name, scale in scales.items():
        sigma, drift = _of_group(stated, name)
        white = math.sqrt(max(sigma**2 - drift.sigma**2, 0.0)) * math.exp(scale.white)
        fading = Drift(drift.sigma * math.exp(scale.drift), drift.over_m * math.exp(scale.over))
        out[name] = math.hypot(white, fading.sigma), fading
    (position_m, position) = out["position"]
    (height_m, _) = out["height"]
    (attitude_rad, attitude) = out["roll_pitch"]
    (heading_rad, heading) = out["heading"]
    drifts = position, heading, attitude
    return PoseSigma(position_m, heading_rad, attitude_rad, height_m, *drifts, stated.heading_slip)


def _scales(problem: Problem, drawn: FloatArray, name: str) -> _Scales:
    """Scales of a group from drawn errors (D, J, 6)."""
    errors = drawn[:, :, _GROUPS[name]]
    if name == "position":  # its drift keeps its direction in the map
        errors = np.einsum("jab,djb->dja", problem.map_from_vehicle[:, :2, :2], errors)
    stated = [_of_group(sigma, name) for sigma in problem.pose_sigmas]
    drift_m2, total_m2 = np.mean([[drift.sigma**2, sigma**2] for sigma, drift in stated], axis=0)
    over_m = float(np.mean([drift.over_m for _, drift in stated]))
    correlation, step_m, path_m = _autocorrelation(problem, errors)
    if not total_m2 > 0 or not correlation[0] > 0:  # not among the frames' states
        return _Scales()
    if not drift_m2 or len(correlation) < _LEAST_LAGS:
        count = errors.shape[1] * errors.shape[2]
        return _Scales(white=_shrunk(0.5 * math.log(correlation[0] / total_m2), 1 / (2 * count)))
    fading = max(float(correlation[1]), 0.01 * correlation[0])
    white = float(correlation[0] - correlation[1])
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


class _Autocorrelation(NamedTuple):
    """How errors along a route resemble each other."""

    products: FloatArray  # (L,) mean product of errors 0, 1, 2, ... steps apart
    step_m: float
    path_m: float  # length of the route


def _autocorrelation(problem: Problem, errors: FloatArray) -> _Autocorrelation:
    """The autocorrelation of errors (D, J, a) at a drive's frames."""
    poses = problem.map_from_vehicle
    session = problem.session_of_frame
    products = np.zeros(0)
    counts = np.zeros(0)
    path_m = 0.0
    moved = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1)[np.diff(session) == 0]
    moved = moved[moved > _LEAST_STEP_M]
    step_m = float(np.median(moved)) if len(moved) else _LEAST_STEP_M
    for in_session in (session == number for number in range(problem.session_count)):
        place = length_along(poses[in_session][:, :2, 3])
        grid = np.arange(0.0, place[-1] + step_m / 2, step_m)
        nearest = np.rint(np.interp(grid, place, np.arange(len(place)))).astype(np.int64)
        even = errors[:, in_session][:, nearest]
        size = 2 * len(grid)
        spectrum = np.abs(np.fft.rfft(even, size, axis=1)) ** 2
        product = np.fft.irfft(spectrum, size, axis=1)[:, : len(grid)].mean(axis=(0, 2))
        lags = max(len(products), len(product))
        products = np.pad(products, (0, lags - len(products))) + np.pad(product, (0, lags - len(product)))
        counts = np.pad(counts, (0, lags - len(counts))) + np.pad(
            np.arange(len(grid), 0, -1), (0, lags - len(product))
        )
        path_m += float(place[-1])
    return _Autocorrelation(products / counts, step_m, path_m)


def _shrunk(logarithm: float, variance: float) -> float:
    """Estimated logarithm of a scale, shrunk towards the stated 0 according to its variance."""
    return float(np.clip(logarithm * _SPREAD**2 / (_SPREAD**2 + variance), -_MOST, _MOST))
