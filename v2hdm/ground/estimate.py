"""A camera's mounting, further parameters and their errors, estimated from a drive's bare ground."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.executor import HERE, Executor
from v2hdm.ground.adjust import CENTRE, Adjusted, Errors, adjust
from v2hdm.ground.model import Mount, guessed_mount
from v2hdm.ground.motion import ARM_M, Motion, changing_pairs, motion_of, spread_pairs
from v2hdm.ground.patches import STRIP_M, Matcher, Round
from v2hdm.ground.planes import plane_of
from v2hdm.ground.prior import Observations, Stated, state_sigmas
from v2hdm.ground.results import STEEP_RAD, GroundEstimate, GroundOptions, GroundStatus, Parameter, Reading
from v2hdm.ground.start import Readings, contradicts, try_readings
from v2hdm.records import Calibration, Drive, FloatArray, PoseNoise

_FREE_CENTRE = {"forward_m": (0, 2.0), "left_m": (1, 2.0), "up_m": (2, 0.3)}  # axis, prior sigma, m
_STRAIGHT = "the vehicle drives straight: include a turn"
_FEW = "too few matches: drive farther"

# Largest standard deviation of an observable value, a third of the smallest error worth reporting, and the
# drive that would reduce it.
_OBSERVABLE = {
    "clock_s": (0.015, "speed and direction hardly change: include a turn"),
    "focal_scale": (0.01, "the camera looks too level and the vehicle drives straight: include a turn"),
    "distortion_k1": (
        0.03, "too little ground is matched away from the image centre: drive on rougher ground",
    ),
    "grade": (0.001, _FEW),
    "up_m": (0.03, _FEW),
    "forward_m": (0.1, _STRAIGHT),
    "left_m": (0.1, _STRAIGHT),
}  # fmt: skip

_LEAST_TURN_RADPS = 0.05  # change of yaw rate within a pair that shows 15 ms over the noise of 20 pairs
_STRETCHES = 8  # segments of the route: enough to estimate a variance, with several pairs in each
_WELL_KNOWN = [0, 1, 2, 5]  # roll, pitch, yaw and height: the other two come mostly from the survey

# Shortest and longest baseline of a pair, m: errors of position weigh less the longer it is; beyond, the
# ground changes its appearance and leaves the region common to both images.
_APART_M = (2.0, 4.0)
_CLOCK_APART_M = (
    0.8,
    4.0,
)  # shortest and longest baseline of a pair for the clock, m: motion changes within it

_GRID_M = 0.04  # spacing of the resampled ground, m
_LEAST_MATCHES = 60  # matches of a mounting at least: ten for each of its degrees of freedom
_FLATNESS_M = 0.003  # unevenness, m: roads are laid to 3 to 5 mm under a straightedge (EN 13036-7)
_LEAST_PATCHES = 200  # fewer patches than this in view of all pairs are no evidence, matched or not


class _Stage(NamedTuple):
    """One round: search radius, factor on the grid's spacing, and the step between the pairs used."""

    search_m: float
    grids: float
    every: int


# The rounds of an estimate, from coarse to fine.
_STAGES = (
    _Stage(search_m=0.9, grids=1.5, every=2),
    _Stage(search_m=0.5, grids=1.5, every=2),
    _Stage(search_m=0.24, grids=1.0, every=1),
    _Stage(search_m=0.12, grids=1.0, every=1),
)


def estimate_ground(drive: Drive, camera: str, options: GroundOptions | None = None) -> GroundEstimate:
    """Estimate the mounting of ``camera`` and what contradicts the drive, from bare ground alone.

    Raises:
        DriveError: an image cannot be read.
    """
    began_s = time.perf_counter()
    options = options or GroundOptions()
    motion = motion_of(drive, camera, Reading.AS_GIVEN)
    stated = Stated(drive, drive.cameras[camera], motion, guessed_mount(drive.cameras[camera]))
    matcher = Matcher(drive, camera, motion)
    readings = try_readings(drive, camera, matcher, stated, options.readings)
    out = _nothing(camera, readings)
    start = readings.start
    if readings.best is Reading.AS_GIVEN:
        solved = None
        if start.mount is not None:
            solved = _solve(matcher, stated, start.mount, options)
        if solved is not None:
            out = _found(out, solved, options.free)
        elif out.status is GroundStatus.NO_MATCH and not contradicts(matcher, stated):
            out = replace(out, status=GroundStatus.NO_TEXTURE)
    return replace(out, seconds=time.perf_counter() - began_s)


@dataclass(frozen=True)
class _Solved:
    """The last round's matches, their prior and the solution."""

    matched: Round
    stated: Stated
    adjusted: Adjusted
    clock: Parameter | None


def _solve(matcher: Matcher, stated: Stated, mount: Mount, options: GroundOptions) -> _Solved | None:
    """Match and adjust in turn, each round from the last solution; None with too few matches."""
    path_m = stated.path_m()
    pairs = spread_pairs(path_m, options.pairs, _APART_M)
    free = "clock_s" if "clock_s" in options.free and clock_shows(stated.motion) else None
    if free is not None:
        moves = stated.motion.velocity_at_images() * [1.0, 1.0, ARM_M]  # of the ground in view, m/s
        pairs = np.vstack([pairs, changing_pairs(path_m, moves, options.clock_pairs, _CLOCK_APART_M)])
    poses = stated.poses()
    for stage in _STAGES:
        matched = matcher.match(mount, poses, pairs[:: stage.every], stage.search_m, stage.grids * _GRID_M)
        if len(matched) < _LEAST_MATCHES:
            return None
        observed = stated.prior_of(matched.observations)
        adjusted = adjust(observed.observations, observed.prior, mount, free)
        if np.count_nonzero(adjusted.weight) < _LEAST_MATCHES:  # rays that miss the ground fix nothing
            return None
        mount = adjusted.mount
        if free is not None:
            stated = replace(stated, clock_s=stated.clock_s + adjusted.extra)
        poses = stated.poses()
        poses[observed.rows] = adjusted.poses
    clock = None
    if free is not None:
        sigma = float(np.sqrt(adjusted.covariance[6, 6]))
        clock = Parameter("clock_s", stated.clock_s, sigma, observable=True)
    return _Solved(matched, stated, adjusted, clock)


def _found(nothing: GroundEstimate, solved: _Solved, free: tuple[str, ...]) -> GroundEstimate:
    """The estimate of a solution, with the parameters ``free`` freed one at a time."""
    adjusted = solved.adjusted
    mount = adjusted.mount
    observations = solved.matched.observations
    factor = _scatter(observations, solved.stated, adjusted)
    # Uneven ground tilts and lifts all pairs alike.
    tilt = _FLATNESS_M / (2 * STRIP_M)
    pitch = _FLATNESS_M / (2 * _APART_M[1])
    flatness = np.diag(np.square([tilt, pitch, 0.0, 0.0, 0.0, _FLATNESS_M]))
    # Left tangent of ``cam_from_vehicle`` (translation, rotation) by turn and centre in vehicle axes.
    by_axes = -np.kron([[0, 1], [1, 0]], mount.vehicle_from_cam_rotation.T)
    covariance = by_axes @ (factor * adjusted.covariance[:6, :6] + flatness) @ by_axes.T
    calibration = Calibration(mount.info, mount.cam_from_vehicle, covariance)
    # Clock and noise of the pixels are held, as where a parameter is freed, which is a few steps from here.
    observed = solved.stated.prior_of(observations)
    start = adjust(observed.observations, observed.prior, mount, without=adjusted)
    freed = {
        name: _free(name, observations, solved.stated, start)
        for name in free
        if name != "clock_s" or solved.clock is None
    }
    k1 = freed.get("distortion_k1") or _free("distortion_k1", observations, solved.stated, start)
    # Here the camera's height is no better known than before.
    focal = adjust(observed.observations, observed.prior, start.mount, "focal_scale", without=start)
    by_lens = np.array([_by_lens(focal), _by_lens(k1.adjusted)])
    return replace(
        nothing,
        status=GroundStatus.FOUND,
        calibration=calibration,
        plane=plane_of(calibration, by_lens @ by_axes.T),
        parameters=_free_parameters(free, freed, solved, factor),
        median_residual=float(np.median(adjusted.residual)),
        innovations=_innovations(adjusted, solved.stated.drive.pose_noise),
    )


def _by_lens(freed: Adjusted) -> FloatArray:
    """Change (6,) of the mounting's turn and centre by an error of the lens, which a solution frees."""
    return np.asarray(freed.covariance[:6, 6] / freed.covariance[6, 6])


def _nothing(camera: str, readings: Readings) -> GroundEstimate:
    """The estimate where no mounting is found."""
    little = readings.start.sought < _LEAST_PATCHES and readings.best is Reading.AS_GIVEN
    return GroundEstimate(
        camera=camera,
        status=GroundStatus.TOO_LITTLE if little else GroundStatus.NO_MATCH,
        shares=readings.shares,
        reading=readings.best,
        calibration=None,
        parameters={},
        median_residual=float("nan"),
        innovations={},
        seconds=0.0,
    )


def _innovations(adjusted: Adjusted, noise: PoseNoise) -> Mapping[str, float]:
    """RMS of the estimated pose errors, by kind, in stated sigmas."""
    rms = np.sqrt(np.mean((adjusted.pose_errors / state_sigmas(noise)) ** 2, axis=0))
    return {
        "heading": float(rms[2]),
        "position": float(np.sqrt(np.mean(rms[3:5] ** 2))),
        "tilt": float(np.sqrt(np.mean(rms[:2] ** 2))),
        "height": float(rms[5]),
    }


def _scatter(observations: Observations, stated: Stated, solved: Adjusted) -> float:
    """Variance inflation factor of ``solved``, at least 1.

    Uneven roads, mis-stated pose noise and errors shared by neighbouring matches make segments of the route
    disagree. Each segment is left out in turn (Efron and Stein, The jackknife estimate of variance, 1981);
    the factor is the jackknife variance over the formal one, averaged over the angles and the height.
    """
    pairs, first_match = np.unique(observations.pair, return_index=True)
    ordered = pairs[np.argsort(observations.first[first_match], kind="stable")]
    stretches = [part for part in np.array_split(ordered, _STRETCHES) if len(part)]
    free = "clock_s" if len(solved.covariance) > 6 else None
    answers = []
    images = np.unique(np.concatenate([observations.first, observations.second]))  # of ``solved``
    for part in stretches:
        observed = stated.prior_of(observations.only(~np.isin(observations.pair, part)))
        initial = Errors.of(solved, np.searchsorted(images, observed.rows))
        mount = adjust(observed.observations, observed.prior, solved.mount, free, initial=initial).mount
        turn = mount.vehicle_from_cam_rotation @ solved.mount.vehicle_from_cam_rotation.T
        small = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        answers.append([*(np.array(small) / 2), *(mount.centre_vehicle - solved.mount.centre_vehicle)])
    count = len(stretches)
    if count < 2:
        return 1.0
    spread = (count - 1) * np.var(np.array(answers), axis=0)
    return max(1.0, float(np.mean(spread[_WELL_KNOWN] / np.diag(solved.covariance)[_WELL_KNOWN])))


def clock_shows(motion: Motion) -> bool:
    """Whether the yaw rate changes along the drive, beyond the noise of smoothed poses."""
    low, high = np.percentile(motion.velocity_at_images()[:, 2], (3, 97))
    return bool(high - low > _LEAST_TURN_RADPS)


def _free_parameters(
    names: tuple[str, ...], freed_alone: Mapping[str, _Freed], solved: _Solved, factor: float
) -> Mapping[str, Parameter]:
    """The parameters ``names``, the clock as solved; ``factor`` inflates variances, see :func:`_scatter`."""
    turns = clock_shows(solved.stated.motion)
    widened = float(np.sqrt(factor))
    parameters = {}
    for name in names:
        if name == "clock_s" and solved.clock is not None:
            parameters[name] = replace(solved.clock, sigma=solved.clock.sigma * widened)
            continue
        freed = freed_alone[name]
        largest, why_not = _OBSERVABLE[name]
        # An error inflates the variance; whether it is observable must not depend on that.
        observable = name != "clock_s" and float(np.sqrt(freed.variance)) < largest
        if name == "focal_scale":
            observable = observable and (turns or solved.adjusted.mount.depression_rad > STEEP_RAD)
        sigma = freed.sigma(factor)
        parameters[name] = Parameter(name, freed.value, sigma, observable, "" if observable else why_not)
    return parameters


class _Freed(NamedTuple):
    """A parameter that is freed beside the mounting."""

    value: float
    adjusted: Adjusted  # the solution with it free
    place: int  # of the parameter in that solution's covariance

    @property
    def variance(self) -> float:
        """Variance of the parameter."""
        return float(self.adjusted.covariance[self.place, self.place])

    def sigma(self, usual: float) -> float:
        """Standard deviation from the disagreement of the route's segments, shrunk to the drive's ``usual``.

        Variances of so few segments are themselves noisy (Smyth, Statistical Applications in Genetics and
        Molecular Biology 3, 2004).
        """
        data = self.adjusted.data_variance[self.place]
        multiple = (usual + self.adjusted.stretch_variance[self.place] / max(data, 1e-300)) / 2
        return float(np.sqrt(self.variance + max(multiple - 1, 0.0) * data))


def _free(name: str, observations: Observations, stated: Stated, start: Adjusted) -> _Freed:
    """The solution with one parameter free, from the ``start``, where all are held."""
    if name in _FREE_CENTRE:
        axis, sigma_m = _FREE_CENTRE[name]
        wider = replace(stated, centre_sigma_m={**stated.centre_sigma_m, axis: sigma_m})
        observed = wider.prior_of(observations)
        adjusted = adjust(observed.observations, observed.prior, start.mount, without=start)
        value = adjusted.mount.centre_vehicle[axis] - observed.prior.centre_vehicle[axis]
        return _Freed(float(value), adjusted, CENTRE.start + axis)
    surer = stated.with_surveyed_height() if name == "focal_scale" else stated
    observed = surer.prior_of(observations)
    adjusted = adjust(observed.observations, observed.prior, start.mount, free=name, without=start)
    return _Freed(adjusted.extra, adjusted, 6)


_worker_drive: Drive | None = None


def estimate_cameras(
    drive: Drive, executor: Executor = HERE, progress: Callable[[int, int], None] | None = None
) -> dict[str, GroundEstimate]:
    """Estimate every camera's mounting from bare ground, as many at a time as an executor can.

    ``progress(done, total)`` is called before the first camera and after each.
    Raises DriveError for an unreadable image, WorkerError if a process died.
    """
    estimates: dict[str, GroundEstimate] = {}

    def take(estimate: GroundEstimate) -> None:
        estimates[estimate.camera] = estimate
        if progress:
            progress(len(estimates), len(drive.cameras))

    names = list(drive.cameras)
    if progress:
        progress(0, len(names))
    if executor.workers <= 1 or len(names) == 1:
        for name in names:
            take(estimate_ground(drive, name))
    else:
        executor.share_out(_work, names, _start_worker, (drive,), take)
    return estimates


def _start_worker(drive: Drive) -> None:
    global _worker_drive
    cv2.setNumThreads(1)
    _worker_drive = drive


def _work(camera: str) -> GroundEstimate:
    assert _worker_drive is not None
    return estimate_ground(_worker_drive, camera)
