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
and West, Econometrica 55, 1987). With few segments it is noisy, hence shrunk towards that of the drive's
other faults (Smyth, Statistical Applications in Genetics and Molecular Biology 3, 2004). A fault costs about
four evaluations of the gradient, and no solve.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial

import numpy as np
import torch
from scipy import stats
from scipy.spatial import KDTree
from torch import Tensor

from v2hdm.adjust.arrays import Arrays
from v2hdm.adjust.problem import Problem
from v2hdm.adjust.solution import Solution
from v2hdm.faults.sensitivity import Rows, Sensitivity, raised, stretches
from v2hdm.records import FloatArray

_LEAST_OBSERVABLE = 1e-9  # fraction of a fault's own information, net of all else, below which it is rounding
_LEAST_P = 1e-300  # a smaller p-value is zero in floating point
_STRETCHES_PER_CHANGE = 2  # segments between candidate frames of a change of inputs

_MOST_CHANGES = 12
"""Candidate frames of a change, over all sessions: each costs a test of every camera and axis."""

_DRIFTS = 3  # shapes of a clock drift: linear, and cosines of two and three half waves

_STEPS = ((1.0, 0.0), (0.0, 1.0), (0.5**0.5, 0.5**0.5), (-(0.5**0.5), 0.5**0.5))
"""Directions of position steps in the map: no direction is more than 22.5 deg from one of them."""

_LEAST_SPEED_MPS = 0.5  # a slower vehicle has no course
_LAGS = 1  # neighbouring segments with correlated errors
_PRIOR_FREEDOM = 15.0  # degrees of freedom of the prior on each test's disagreement


class Fault(Enum):
    """An input that may be wrong; its value has :attr:`unit`."""

    CLOCK = "clock"  # images were taken later than stamped
    CLOCK_DRIFT = "clock drift"  # increasingly so: total from first to last image
    FOCAL = "focal"  # relative error of the focal length
    DISTORTION = "distortion"  # first radial coefficient
    PRINCIPAL = "principal"  # position in the image
    SLOPE = "slope"  # of the ground, unknown to the poses
    CROWN = "crown"  # fall of the ground to both sides of the route
    COURSE = "course"  # the heading is that of the motion of a point ahead of the rear axle
    STEP = "step"  # offset of recorded positions from some time on
    KNOCK = "knock"  # rotation of a camera from some time on; of all cameras by load
    SURVEY = "survey"  # of one camera's centre
    LEVER = "lever"  # of all centres, or of the point that poses refer to
    SCALE = "scale"  # relative error of distances between recorded positions
    SIZE = "size"  # of known lengths of one value
    CONTROL = "control"  # of one surveyed point
    DATUM = "datum"  # of all surveyed points

    @property
    def unit(self) -> str:
        """Unit of the value and its sigma; empty if dimensionless."""
        return _UNITS.get(self, "m")


_UNITS = {
    Fault.CLOCK: "s",
    Fault.CLOCK_DRIFT: "s",
    Fault.FOCAL: "",
    Fault.DISTORTION: "",
    Fault.PRINCIPAL: "px",
    Fault.SLOPE: "rad",
    Fault.CROWN: "",
    Fault.KNOCK: "rad",
    Fault.SCALE: "",
}


def sigmas_of(p_value: float) -> float:
    """Two-sided p-value as a number of standard deviations of a normal distribution."""
    return float(stats.norm.isf(max(p_value, _LEAST_P) / 2))


CHANGES = (Fault.STEP, Fault.KNOCK)  # faults that begin at an unknown time


@dataclass(frozen=True)
class ScoreTest:
    """The test of one fault."""

    fault: Fault  # the hypothesis
    camera: int  # index in the problem; -1 for all together
    # axis, 0 to 2, of the vehicle (survey, lever, knock), map (slope, datum; step: east, north, north-east,
    # north-west) or image (principal); side (crown: both, left, right); or shape of a drift
    axis: int
    # control point, known length, (clock) session, or first frame of a change (step, knock); -1: none, all
    item: int
    value: float = 0.0  # true minus stated
    sigma: float = float("inf")  # from the segments' disagreement; inf if unobservable
    model_sigma: float = float("inf")  # standard deviation under the model's own noise
    p_value: float = 1.0  # probability of such a value without the fault; 1 if unobservable
    # log-likelihood ratio of the fault, each segment predicted from the others; negative if they disagree
    gain: float = 0.0

    @property
    def sigmas(self) -> float:
        """The p-value as a number of standard deviations of a normal distribution."""
        return sigmas_of(self.p_value)


@dataclass(frozen=True)
class _Hypothesis:
    """One fault, and its column of the Jacobian."""

    fault: Fault
    column: Callable[[Sensitivity], Rows]
    camera: int = -1
    axis: int = 0
    item: int = -1

    @property
    def key(self) -> tuple[Fault, int, int, int]:
        """The fault that is tested; a sudden and a gradual step from one frame share it."""
        return self.fault, self.camera, self.axis, self.item


@dataclass(frozen=True)
class _Answer:
    """Scores and information of the route's segments on one fault."""

    hypothesis: _Hypothesis  # the fault
    score: FloatArray  # (G + 1,) s_g, and below w_g; the last is of priors of no segment
    information: FloatArray
    drawn: FloatArray  # (D, G + 1) scores of noise drawn from the model
    own: float  # the fault's information with all else known

    @classmethod
    def to(cls, hypothesis: _Hypothesis, solved: Sensitivity) -> _Answer:
        """The segments' scores at a solution."""
        column = hypothesis.column(solved)
        efficient = solved.flat(solved.efficient(column))
        information = solved.by_stretch(efficient, efficient)
        own = sum(float(row.square().sum()) for row in column.values())
        score = -solved.by_stretch(efficient, solved.flat(solved.residuals))
        return cls(hypothesis, score, information, solved.by_stretch(efficient, solved.noise).T, own)

    @property
    def is_observable(self) -> bool:
        """Whether the fault's net information exceeds rounding."""
        return float(self.information.sum()) > _LEAST_OBSERVABLE * self.own > 0

    @property
    def value(self) -> float:
        """Estimated value of the fault."""
        return float(self.score.sum() / self.information.sum())

    @property
    def disagreement(self) -> float:
        """Variance of the segments' scores relative to that under the model's noise."""
        by_model = float(np.mean([self._apart(score) for score in self.drawn]))
        return self._apart(self.score) / max(by_model, 1e-300)

    def _apart(self, score: FloatArray) -> float:
        """Sum of squared residual scores (G + 1,), with Bartlett's weights of neighbours."""
        off = (score - score.sum() / self.information.sum() * self.information)[:-1]
        lags = range(1, _LAGS + 1)
        together = sum(2 * (1 - lag / (_LAGS + 1)) * float(off[lag:] @ off[:-lag]) for lag in lags)
        return max(float(off @ off) + together, 0.0)

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the disagreement: effective number of segments minus one."""
        w = self.information[:-1]
        speaking = float(w.sum()) ** 2 / max(float(w @ w), 1e-300) - float(w.sum() / self.information.sum())
        return max(speaking, 0.0) / (1 + 2 * sum((1 - lag / (_LAGS + 1)) ** 2 for lag in range(1, _LAGS + 1)))

    def test(self, usual: float) -> ScoreTest:
        """The test, shrinking the variance factor towards the drive's ``usual`` one."""
        at = self.hypothesis
        blank = ScoreTest(at.fault, at.camera, at.axis, at.item)
        if not self.is_observable:
            return blank
        freedom = self.freedom
        multiple = (_PRIOR_FREEDOM * usual + freedom * self.disagreement) / (_PRIOR_FREEDOM + freedom)
        if at.fault not in CHANGES:
            # Noise as lasting as the fault is common to all segments, and no disagreement of theirs: they may
            # widen the model's sigma, but not narrow it.
            multiple = max(multiple, 1.0)
        w = self.information
        s = self.score
        total = float(self.information.sum())
        sigma = float(np.sqrt(multiple * w[:-1].sum() + w[-1])) / total
        # Each segment is predicted from the others, which include priors of no segment.
        others = (s.sum() - s[:-1]) / np.maximum(total - w[:-1], _LEAST_OBSERVABLE * total)
        gain = float(np.sum(others * s[:-1] - others**2 * w[:-1] / 2)) / multiple
        p_value = 2 * float(stats.t.sf(abs(self.value) / sigma, _PRIOR_FREEDOM + freedom))
        numbers = {"value": self.value, "sigma": sigma, "model_sigma": total**-0.5, "p_value": p_value}
        return replace(blank, **numbers, gain=gain)


def score_faults(problem: Problem, solution: Solution) -> tuple[ScoreTest, ...]:
    """Tests at ``solution`` of every fault that ``problem`` can have, largest gain first."""
    solved = Sensitivity.at(solution.covariance.whitening)
    answers = [_Answer.to(hypothesis, solved) for hypothesis in _hypotheses(problem, solved.arrays)]
    # Sudden and gradual steps from one frame count as one test: the sudden one, which comes first.
    said = {one.hypothesis.key: one.disagreement for one in reversed(answers) if one.is_observable}
    usual = float(np.median(list(said.values()))) if said else 1.0
    found = _likeliest_changes([(one, one.test(usual)) for one in answers])
    found += _control_points(problem, solution, usual)
    return tuple(sorted(found, key=lambda test: -test.gain))


def _hypotheses(problem: Problem, arrays: Arrays) -> Iterator[_Hypothesis]:
    cameras = range(arrays.camera_count)
    changes = _changes(arrays)
    for camera in [*([-1] if arrays.camera_count > 1 else []), *cameras]:
        if problem.twist_vehicle is not None:
            for session in range(problem.session_count) if problem.session_count > 1 else [-1]:
                own = (problem.session_of_frame == session) | (session < 0)
                yield _Hypothesis(Fault.CLOCK, _moving(_late, problem, camera, own), camera, item=session)
        yield _Hypothesis(Fault.FOCAL, partial(_lens, camera, 0), camera)
        yield _Hypothesis(Fault.DISTORTION, partial(_lens, camera, 1), camera)
        for axis in (0, 1):
            yield _Hypothesis(Fault.PRINCIPAL, partial(_principal, problem, camera, axis), camera, axis)
        for axis in range(_DRIFTS if problem.twist_vehicle is not None else 0):
            # The clock's error (J,) goes from half the value to minus half, in one half wave or more.
            share = np.linspace(0.0, 1.0, len(problem.map_from_vehicle))
            wave = share - 0.5 if axis == 0 else 0.5 * np.cos((axis + 1) * np.pi * share)
            yield _Hypothesis(Fault.CLOCK_DRIFT, _moving(_late, problem, camera, wave), camera, axis)
        for frame in changes:
            for axis in (1, 2):
                yield _Hypothesis(Fault.KNOCK, _moving(_knock, camera, axis, frame), camera, axis, frame)
    for axis in (0, 1):
        yield _Hypothesis(Fault.SLOPE, _moving(_slope, axis), axis=axis)
    for axis in range(len(_STEPS)):
        for frame, until in [*zip(changes, changes, strict=True), *zip(changes, changes[2:], strict=False)]:
            yield _Hypothesis(Fault.STEP, _moving(_step, axis, frame, until), axis=axis, item=frame)
    for axis in range(3):
        yield _Hypothesis(Fault.CROWN, partial(_crown, axis), axis=axis)
    if problem.twist_vehicle is not None:
        yield _Hypothesis(Fault.COURSE, _moving(_course, problem))
    if bool((arrays.centre_information_root > 0).any()):
        for axis in range(3):
            for camera in cameras:
                yield _Hypothesis(Fault.SURVEY, partial(_survey, camera, axis), camera, axis)
            if arrays.camera_count > 1:
                yield _Hypothesis(Fault.LEVER, partial(_survey, -1, axis), -1, axis)
        yield _Hypothesis(Fault.SCALE, _moving(_scale))
    if bool((arrays.control_root > 0).any()):
        for axis in (0, 1):
            yield _Hypothesis(Fault.DATUM, partial(_datum, axis), axis=axis)
    for item, length_m in enumerate(torch.unique(arrays.lengths.length_m)):
        yield _Hypothesis(Fault.SIZE, partial(_size, arrays.lengths.length_m == length_m), item=item)


def _likeliest_changes(found: list[tuple[_Answer, ScoreTest]]) -> list[ScoreTest]:
    """Keep the likeliest frame of each input's change, with Sidak's correction for the other frames."""
    kept = [one for _, one in found if one.fault not in CHANGES]
    changes: dict[tuple[Fault, int, int], list[tuple[_Answer, ScoreTest]]] = {}
    for answer, one in found:
        if one.fault in CHANGES:
            changes.setdefault((one.fault, one.camera, one.axis), []).append((answer, one))
    for chances in changes.values():
        best = max((one for _, one in chances), key=lambda one: one.gain)
        many = _chances(chances)
        p_value = -float(np.expm1(many * np.log1p(-min(best.p_value, 1 - 1e-9))))
        kept.append(replace(best, p_value=p_value, gain=best.gain - float(np.log(many))))
    return kept


def _chances(changes: list[tuple[_Answer, ScoreTest]]) -> float:
    """Effective number of independent tests among these, whose noise is correlated.

    It is tr(R)^2 / tr(R^2) of their correlation R (Galwey, Genetic Epidemiology 33, 2009).
    """
    drawn = np.array([answer.drawn.ravel() for answer, one in changes if np.isfinite(one.sigma)])
    if not len(drawn):
        return float(len(changes))
    drawn = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    return float(len(drawn) ** 2 / np.sum((drawn @ drawn.T) ** 2))


def _control_points(problem: Problem, solution: Solution, usual: float) -> Iterator[ScoreTest]:
    """Test each surveyed point against everything else on its corner.

    The residual between a point and its corner has the point's covariance minus the corner's; both axes are
    tested together, with two degrees of freedom.
    """
    control = problem.control
    if control is None or not len(control.corner):
        return
    covariance = solution.corner_covariance(control.corner[:, None])
    for m, (point, sigma_m) in enumerate(zip(control.points_map, control.sigma_m, strict=True)):
        off = solution.corners_map[control.corner[m]] - point
        expected = np.diag(sigma_m**2) - covariance[m]
        if np.linalg.eigvalsh(expected).min() <= _LEAST_OBSERVABLE * np.max(sigma_m) ** 2:
            continue
        squared = float(off @ np.linalg.solve(expected, off)) / max(usual, 1.0)
        # Without the point, its corner would lie farther away, by the point's share of the information.
        apart = float(np.linalg.norm(sigma_m**2 * np.linalg.solve(expected, off)))
        sigma = apart / max(squared, 1e-12) ** 0.5
        p_value = float(stats.chi2.sf(squared, 2))
        yield ScoreTest(Fault.CONTROL, -1, -1, m, apart, sigma, sigma, p_value, squared / 2)


def _lens(camera: int, power: int, solved: Sensitivity) -> Rows:
    """Relative error p of a focal length or, with ``power`` 1, error p of the first radial coefficient."""
    # Projected points rather than measured ones: pixels, whose noise is stated, do not scale.
    projected = solved.projected
    mine = (solved.camera == camera) | (camera < 0)
    return {"observations": solved.whiten(projected * projected.square().sum(0) ** power * mine)}


def _principal(problem: Problem, camera: int, axis: int, solved: Sensitivity) -> Rows:
    """A principal point one pixel farther right, or down."""
    seen_by = solved.camera
    focal_px = torch.as_tensor(problem.intrinsic[:, axis])
    off = ((seen_by == camera) | (camera < 0)) / focal_px.to(seen_by.device)[seen_by]
    none = torch.zeros_like(off)
    return {"observations": solved.whiten(torch.stack([off, none] if axis == 0 else [none, off]))}


def _moving(motion: Callable[..., Tensor], *about: object) -> Callable[[Sensitivity], Rows]:
    """The column of a ``motion`` (C, J, 6) of the vehicle in its own frame, which is written into zeros."""

    def column(solved: Sensitivity) -> Rows:
        extrinsic = solved.whitening.estimate.cam_from_vehicle[:, None]
        arrays = solved.arrays
        still = arrays.centre.new_zeros(arrays.camera_count, arrays.frame_count, 6)
        tangent = arrays.at_moments(motion(*about, arrays, still), axis=1)
        shift, turn = (
            (extrinsic[..., :3, :3] @ one[..., None])[..., 0] for one in (tangent[..., :3], tangent[..., 3:])
        )
        shift = shift + torch.linalg.cross(extrinsic[..., :3, 3].expand_as(turn), turn)
        return {"observations": solved.seen(solved.turned(-torch.cat([shift, turn], dim=-1)))}

    return column


def _late(problem: Problem, camera: int, share: FloatArray, _: Arrays, out: Tensor) -> Tensor:
    """Images late by a ``share`` (J,) of the value."""
    twist = torch.as_tensor(np.asarray(problem.twist_vehicle) * share[:, None])
    out[slice(None) if camera < 0 else camera] = twist.to(out.device)
    return out


def _changes(arrays: Arrays) -> list[int]:
    """Candidate frames of a change: about a dozen, evenly spread over the segments of all sessions."""
    stretch = stretches(arrays)
    begins = (stretch.diff() > 0).nonzero()[:, 0] + 1
    within = [int(j) for j in begins if arrays.session[j] == arrays.session[j - 1]]
    return within[1 :: max(_STRETCHES_PER_CHANGE, -(-len(within) // _MOST_CHANGES))]


def _course(problem: Problem, _: Arrays, out: Tensor) -> Tensor:
    """Heading taken from the course of a point ahead of the rear axle, which sideslips in bends."""
    twist = np.asarray(problem.twist_vehicle)
    speed = np.hypot(twist[:, 0], twist[:, 1])
    curvature = np.where(speed > _LEAST_SPEED_MPS, twist[:, 5] / np.maximum(speed, _LEAST_SPEED_MPS), 0.0)
    out[..., 5] = -torch.as_tensor(curvature).to(out.device)
    return out


def _step(axis: int, frame: int, until: int, arrays: Arrays, out: Tensor) -> Tensor:
    """Positions recorded short along a direction: growing from ``frame`` to ``until``, then constant."""
    out[..., :3] = arrays.vehicle_from_map[:, :3, :2] @ arrays.centre.new_tensor(_STEPS[axis])
    after = torch.arange(1 - frame, 1 - frame + arrays.frame_count, device=out.device)[:, None]
    return out * _since(arrays, frame) * (after / (until - frame + 1)).clamp(max=1.0)


def _scale(arrays: Arrays, out: Tensor) -> Tensor:
    """Positions recorded too close together, as those of a grid that shrinks the ground."""
    position = arrays.vehicle_from_map.inverse()[:, :3, 3:]
    out[..., :3] = (arrays.vehicle_from_map[:, :3, :3] @ (position - position.mean(dim=0)))[..., 0]
    return out


def _knock(camera: int, axis: int, frame: int, arrays: Arrays, out: Tensor) -> Tensor:
    """Rotation of a camera about its own centre; load rotates all of them about the rear axle."""
    turn = torch.eye(3, dtype=out.dtype, device=out.device)[axis]
    chosen = slice(None) if camera < 0 else slice(camera, camera + 1)
    out[chosen, :, 3:] = turn
    if camera >= 0:
        out[chosen, :, :3] = torch.linalg.cross(arrays.centre[chosen], turn.expand(1, 3))[:, None]
    return out * _since(arrays, frame)


def _since(arrays: Arrays, frame: int) -> Tensor:
    """1 for the frames (J, 1) from ``frame`` to the end of its session, else 0."""
    later = torch.arange(arrays.frame_count, device=arrays.session.device) >= frame
    return (later & (arrays.session == arrays.session[frame])).to(arrays.centre.dtype)[:, None]


def _crown(axis: int, solved: Sensitivity) -> Rows:
    """Corners lower by the value times their distance from the route, on both sides or one."""
    arrays = solved.arrays
    estimate = solved.whitening.estimate
    frames = arrays.vehicle_from_map.inverse()
    route = KDTree(frames[:, :2, 3].cpu().numpy())
    nearest = torch.as_tensor(route.query(estimate.corners_map.cpu().numpy())[1], device=frames.device)
    left = ((estimate.corners_map - frames[nearest, :2, 3]) * frames[nearest, :2, 1]).sum(1)
    lower = (left.abs(), left.clamp(min=0), -left.clamp(max=0))[axis]
    return raised(solved, -lower[arrays.corner.long()])


def _slope(axis: int, arrays: Arrays, out: Tensor) -> Tensor:
    """Ground that rises along an axis of the map, unknown to the poses."""
    turn = arrays.centre.new_tensor([0.0, -1.0, 0.0] if axis == 0 else [1.0, 0.0, 0.0])
    out[..., 3:] = arrays.vehicle_from_map[:, :3, :3] @ turn
    return out


def _survey(camera: int, axis: int, solved: Sensitivity) -> Rows:
    out = torch.zeros_like(solved.arrays.centre)
    which = slice(None) if camera < 0 else camera
    out[which, axis] = -solved.arrays.centre_information_root[which, axis]
    return {"camera_centre": out}


def _datum(axis: int, solved: Sensitivity) -> Rows:
    out = torch.zeros_like(solved.arrays.control)
    out[:, axis:] = -solved.arrays.control_root[:, 2 * axis : 2 + axis]
    return {"control_points": out}


def _size(which: Tensor, solved: Sensitivity) -> Rows:
    return {"known_lengths": -solved.arrays.lengths.information_root * which}
