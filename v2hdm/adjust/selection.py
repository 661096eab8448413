"""The model of the poses' errors that a drive calls for, chosen by observations held out of the solve.

Every model is fitted to most of the observations of a stretch of the drive and predicts the others. What
it predicts best is right, in the one sense that a drive without ground truth can tell: a model that
leaves an error out mispredicts, and one that fits noise does, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.adjust.problem import KnownLengths, Observations, Problem, SolveOptions
from v2hdm.adjust.solution import Solution
from v2hdm.adjust.solve import solve
from v2hdm.errors import AdjustError
from v2hdm.geometry.rigid import exp
from v2hdm.records import BoolArray, FloatArray, IntArray


def restrict(problem: Problem, keep: BoolArray) -> tuple[Problem, IntArray]:
    """``problem`` with the observations ``keep`` (K,) only, and which corners of it the part still has.

    Every camera must keep an observation. Frames are cut off before the first and after the last that is
    used, so that a drift still runs through the others.
    """
    seen = problem.observations
    corners, corner = np.unique(seen.corner[keep], return_inverse=True)
    frame = seen.frame[keep]
    used = slice(int(frame.min()), int(frame.max()) + 1)
    start, twist, control = problem.corners_start, problem.twist_vehicle, problem.control
    if control is not None:
        left = np.isin(control.corner, corners)
        number = np.searchsorted(corners, control.corner[left])
        control = control.take(left, number)
    lengths = problem.lengths
    if lengths is not None:
        left = np.isin(lengths.first, corners) & np.isin(lengths.second, corners)
        first, second = (np.searchsorted(corners, ends[left]) for ends in (lengths.first, lengths.second))
        lengths = KnownLengths(first, second, lengths.length_m[left], lengths.sigma_m[left])
    part = replace(
        problem,
        map_from_vehicle=problem.map_from_vehicle[used],
        observations=replace(seen.take(keep), frame=frame - used.start, corner=corner.astype(np.int64)),
        corner_count=len(corners),
        corners_start=None if start is None else start[corners],
        twist_vehicle=None if twist is None else twist[used],
        visit=None if problem.visit is None else problem.visit[used],
        control=control,
        lengths=lengths,
    )
    return part, corners


@dataclass(frozen=True)
class Model:
    """The pose errors that are estimated beside map and extrinsics."""

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

# Frames of the stretch that models are compared on, and the share of its observations held out.
_STRETCH_FRAMES = 120
_HELD_OUT_SHARE = 0.2
_MIN_HELD_OUT = 40  # with fewer than these the residuals cannot tell one model from another
# By how much what can take up errors of other inputs, such as a clock offset, must predict better than what
# does without.
_SURE_STANDARD_ERRORS = 3.0
# Where the loss of a held-out residual bends, squared sigmas: wrong associations must not decide.
_LOSS_SCALE2 = 9.0


@dataclass(frozen=True)
class Selection:
    """The model chosen, and each model's score: the mean robust loss of the held-out observations.

    There are no scores where too little was seen often enough to hold any of it out.
    Without a model error and for Gaussian noise the score is a little below 2.
    """

    name: str
    scores: Mapping[str, float]

    @property
    def sentence(self) -> str:
        """One sentence on the choice."""
        if not self.scores:
            return f"pose model '{self.name}', since too few observations repeat to choose by them"
        scores = ", ".join(f"{name} {score:.2f}" for name, score in self.scores.items())
        return f"pose model '{self.name}' predicts held-out observations best (mean loss: {scores})"


def with_model(options: SolveOptions, model: Model) -> SolveOptions:
    """``options`` that estimate what ``model`` says."""
    return replace(options, pose_states=model.pose_states, clock_offset=model.clock_offset)


def select_model(problem: Problem, options: SolveOptions, names: Sequence[str] = tuple(MODELS)) -> Selection:
    """Choose the richest of the models ``names`` that predicts as well as the best.

    As well means: within one standard error of the paired difference, by frames, since errors within a frame
    go together (Hastie, Tibshirani and Friedman, The Elements of Statistical Learning, section 7.10). A clock
    offset trades against the camera's forward offset, so it is taken only where it predicts better than all
    others by more than three standard errors. The extrinsics of ``problem`` had better be near already;
    ``names`` begin with the simplest, and ``clock`` is left out where twists are not known. Raises
    AdjustError where a model's problem cannot be solved.
    """
    unknown = [name for name in names if name not in MODELS]
    if unknown:
        raise AdjustError(f"unknown model '{unknown[0]}': choose from {', '.join(MODELS)}")
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
    """Whether ``problem`` predicts held-out observations better than ``rival``, by three standard errors."""
    chosen = _stretch(problem)
    held_out = _held_out(restrict(problem, chosen)[0].observations)
    if np.count_nonzero(held_out) < _MIN_HELD_OUT:
        return False
    own, other = (_losses(restrict(one, chosen)[0], held_out, options) for one in (problem, rival))
    frame = problem.observations.frame[chosen][held_out]
    return not _as_good(other - own, frame, _SURE_STANDARD_ERRORS)


def _losses(whole: Problem, held_out: BoolArray, options: SolveOptions) -> FloatArray:
    """The robust losses of the ``held_out`` observations of ``whole``, as the others predict them."""
    fitted, corners = restrict(whole, ~held_out)
    solution = solve(fitted, replace(options, coarse=False))
    squared = predicted_squared(whole, held_out, fitted, solution, corners)
    return np.asarray(_LOSS_SCALE2 * np.log1p(squared / _LOSS_SCALE2))


def predicted_squared(
    whole: Problem, held_out: BoolArray, fitted: Problem, solution: Solution, corners: np.ndarray
) -> FloatArray:
    """Squared residuals, in sigmas, of the ``held_out`` observations by the solution of the others."""
    seen = whole.observations
    camera, frame = seen.camera[held_out], seen.frame[held_out]
    first = int(whole.observations.frame[~held_out].min())
    vehicle_from_map = np.linalg.inv(solution.map_from_vehicle)[frame - first]
    if fitted.twist_vehicle is not None:
        late_s = solution.clock_offset_s[camera, fitted.visit_of_frame[frame - first]]
        if seen.row_share is not None:
            late_s = late_s + solution.read_out_s[camera] * seen.row_share[held_out]
        moved = fitted.twist_vehicle[frame - first] * late_s[:, None]
        vehicle_from_map = exp(-moved) @ vehicle_from_map
    cam_from_map = solution.cam_from_vehicle[camera] @ vehicle_from_map
    points_map = solution.corners_map[np.searchsorted(corners, seen.corner[held_out])]
    ground = np.column_stack([points_map, np.zeros(len(points_map)), np.ones(len(points_map))])
    points = (cam_from_map @ ground[..., None])[:, :3, 0]
    intrinsic = whole.intrinsic[camera]
    pixel = intrinsic[:, :2] * points[:, :2] / points[:, 2:] + intrinsic[:, 2:]
    off = pixel - seen.pinhole_px[held_out]
    solved = np.linalg.solve(seen.covariance_px[held_out], off[..., None])[..., 0]
    return np.asarray(np.sum(off * solved, axis=1))


def _stretch(problem: Problem) -> BoolArray:
    """Observations (K,) of the run of frames that holds most of them, every camera's included."""
    seen, frames = problem.observations, len(problem.map_from_vehicle)
    if frames <= _STRETCH_FRAMES:
        return np.ones(len(seen.frame), dtype=bool)
    count = np.zeros(frames + 1)
    count[1:] = np.cumsum(np.bincount(seen.frame, minlength=frames))
    begin = int(np.argmax(count[_STRETCH_FRAMES:] - count[:-_STRETCH_FRAMES]))
    keep = (seen.frame >= begin) & (seen.frame < begin + _STRETCH_FRAMES)
    keep &= np.bincount(seen.corner[keep], minlength=problem.corner_count)[seen.corner] >= 2
    everywhere = len(np.unique(seen.camera[keep])) == len(problem.intrinsic)
    return keep if everywhere else np.ones(len(seen.frame), dtype=bool)


def _held_out(seen: Observations) -> BoolArray:
    """A share of the observations (K,); two of each corner stay, and the first and last frames."""
    rng = np.random.default_rng(0)
    order = rng.permutation(len(seen.corner))
    place = np.empty(len(order), dtype=np.int64)
    by_corner = order[np.argsort(seen.corner[order], kind="stable")]
    starts = np.flatnonzero(np.diff(seen.corner[by_corner], prepend=-1))
    place[by_corner] = np.arange(len(order)) - np.repeat(starts, np.diff(starts, append=len(order)))
    held_out = (place >= 2) & (rng.random(len(order)) < _HELD_OUT_SHARE)
    fitted = seen.frame[~held_out]
    return np.asarray(held_out & (seen.frame >= fitted.min()) & (seen.frame <= fitted.max()))


def _as_good(excess: FloatArray, frame: np.ndarray, standard_errors: float = 1.0) -> bool:
    """Whether losses exceed others by no more than so many standard errors, clustered by ``frame``."""
    mean = float(excess.mean())
    by_frame = np.bincount(frame, weights=excess - mean)
    return mean <= standard_errors * float(np.sqrt(np.sum(by_frame**2))) / len(excess)
