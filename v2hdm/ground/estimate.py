"""From a drive to what its bare ground says of one camera."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.ground.adjust import Adjusted, adjust, tangent_covariance
from v2hdm.ground.beliefs import Beliefs
from v2hdm.ground.matcher import Matcher, Round
from v2hdm.ground.motion import motion_of
from v2hdm.ground.mount import Mount, guessed_mount
from v2hdm.ground.noise import state_sigmas
from v2hdm.ground.options import GroundOptions
from v2hdm.ground.pairs import changing_pairs, spread_pairs
from v2hdm.ground.parameters import clock_shows, free_parameters
from v2hdm.ground.readings import Readings, try_readings
from v2hdm.ground.results import GroundEstimate, GroundStatus, MatchedGround, Parameter, Reading
from v2hdm.ground.scatter import scatter
from v2hdm.records import Calibration, Drive, FloatArray, IntArray, PoseNoise


@dataclass(frozen=True)
class _Stage:
    """One round: how far matches are searched, on how wide a grid, in every how manieth pair.

    ``loosened`` is how much further off than stated the poses' heading and sideways place may be, so that the
    few pairs which show a wrong clock do not count as outliers.
    """

    search_m: float
    grids: float
    every: int
    loosened: float


_STAGES = (
    _Stage(0.9, 1.5, 2, 20.0),
    _Stage(0.5, 1.5, 2, 8.0),
    _Stage(0.24, 1.0, 1, 2.0),
    _Stage(0.12, 1.0, 1, 1.0),
)

_CLOCK_APART_M = (0.8, 4.0)
"""Distance between the images of a pair that shows the clock: motion changes within it."""

_CLOCK_LOOSENED = 2.0
"""Factor on the stated noise of headings up to which a clock is told apart from them."""

_LEAST_MATCHES = 60
"""Ten for each of the six quantities of a mounting."""

_FLATNESS_M = 0.003
"""How far a paved road departs from a plane, m: roads are laid to 3 to 5 mm under a straightedge.

EN 13036-7 measures it."""

_LEAST_PATCHES = 200
"""Fewer in view of all pairs tell nothing, matched or not."""


def estimate_ground(drive: Drive, camera: str, options: GroundOptions | None = None) -> GroundEstimate:
    """Estimate the mounting of ``camera`` and what contradicts the drive, from bare ground alone.

    Raises:
        DriveError: an image cannot be read.
    """
    began_s = time.perf_counter()
    options = options or GroundOptions()
    motion = motion_of(drive, camera, Reading.AS_GIVEN)
    beliefs = Beliefs(drive, drive.cameras[camera], motion, guessed_mount(drive.cameras[camera]))
    matcher = Matcher(drive, camera, motion, options)
    readings = try_readings(drive, camera, matcher, beliefs, options.readings)
    solved = None
    if readings.start.mount is not None and readings.best is Reading.AS_GIVEN:
        solved = _solve(matcher, beliefs, readings.start.mount, options)
    out = _nothing(camera, beliefs, readings) if solved is None else _found(camera, solved, readings, options)
    return replace(out, seconds=time.perf_counter() - began_s)


@dataclass(frozen=True)
class _Solved:
    """The last round's matches, what was believed of them, the solution and its poses of all images."""

    pairs: IntArray
    matched: Round
    beliefs: Beliefs
    adjusted: Adjusted
    poses: FloatArray
    clock: Parameter | None


def _solve(matcher: Matcher, beliefs: Beliefs, mount: Mount, options: GroundOptions) -> _Solved | None:
    """Match and adjust in turn, each round from the last one's solution; None without enough matches."""
    path_m = beliefs.path_m()
    pairs = spread_pairs(path_m, options.pairs, options.shortest_m, options.longest_m)
    free = "clock_s" if "clock_s" in options.free and clock_shows(beliefs.motion) else None
    if free is not None:
        velocity = beliefs.motion.velocity_at_images()
        pairs = np.vstack([pairs, changing_pairs(path_m, velocity, options.clock_pairs, *_CLOCK_APART_M)])
    poses = beliefs.poses()
    for stage in _STAGES:
        matched = matcher.match(
            mount, poses, pairs[:: stage.every], stage.search_m, stage.grids * options.grid_m
        )
        if len(matched.correlation) < _LEAST_MATCHES:
            return None
        used, believed, rows = beliefs.about(matched.observations, stage.loosened)
        # Where headings may be far off, so may the clock: nothing would hold the camera's yaw.
        freed = free if stage.loosened <= _CLOCK_LOOSENED else None
        adjusted = adjust(used, believed, mount, freed, max(stage.loosened / 2, 1.0))
        if np.count_nonzero(adjusted.weight) < _LEAST_MATCHES:  # rays that miss the ground fix nothing
            return None
        mount = adjusted.mount
        if freed is not None:
            beliefs = beliefs.at_clock(beliefs.clock_s + adjusted.extra)
        poses = beliefs.poses()
        poses[rows] = adjusted.poses
    clock = None
    if free is not None:
        sigma = float(np.sqrt(adjusted.covariance[6, 6]))
        clock = Parameter("clock_s", beliefs.clock_s, sigma, told=True)
    return _Solved(pairs, matched, beliefs, adjusted, poses, clock)


def _found(camera: str, solved: _Solved, readings: Readings, options: GroundOptions) -> GroundEstimate:
    mount, matched = solved.adjusted.mount, solved.matched
    seen = matched.observations
    factor = scatter(seen, solved.beliefs, solved.adjusted)
    own = factor * solved.adjusted.covariance[:6, :6] + _flatness(options)
    covariance = tangent_covariance(mount, own)
    image = solved.beliefs.motion.image
    return GroundEstimate(
        camera=camera,
        status=GroundStatus.FOUND,
        shares=readings.shares,
        reading=readings.best,
        calibration=Calibration(mount.info, mount.cam_from_vehicle, covariance),
        guess_cam_from_vehicle=solved.beliefs.guess.cam_from_vehicle,
        parameters=free_parameters(options.free, seen, solved.beliefs, solved.adjusted, solved.clock, factor),
        median_residual=float(np.median(solved.adjusted.residual)),
        pulls=_pulls(solved.adjusted, solved.beliefs.drive.pose_noise),
        patches=MatchedGround(
            image[solved.pairs],
            solved.poses[solved.pairs],
            seen.pair,
            seen.first_px,
            seen.second_px,
            matched.correlation,
        ),
        seconds=0.0,
    )


def _flatness(options: GroundOptions) -> FloatArray:
    """Covariance (6, 6) of turn and centre from ground that is no plane, tilted and lifted for all pairs."""
    tilt = _FLATNESS_M / (2 * options.strip_m)
    pitch = _FLATNESS_M / (2 * options.longest_m)
    return np.diag(np.square([tilt, pitch, 0.0, 0.0, 0.0, _FLATNESS_M]))


def _pulls(adjusted: Adjusted, noise: PoseNoise) -> Mapping[str, float]:
    rms = np.sqrt(np.mean((adjusted.pose_errors / state_sigmas(noise)) ** 2, axis=0))
    return {
        "heading": float(rms[2]),
        "position": float(np.sqrt(np.mean(rms[3:5] ** 2))),
        "tilt": float(np.sqrt(np.mean(rms[:2] ** 2))),
        "height": float(rms[5]),
    }


def _nothing(camera: str, beliefs: Beliefs, readings: Readings) -> GroundEstimate:
    little = readings.start.sought < _LEAST_PATCHES and readings.best is Reading.AS_GIVEN
    return GroundEstimate(
        camera=camera,
        status=GroundStatus.TOO_LITTLE if little else GroundStatus.NO_MATCH,
        shares=readings.shares,
        reading=readings.best,
        calibration=None,
        guess_cam_from_vehicle=beliefs.guess.cam_from_vehicle,
        parameters={},
        median_residual=float("nan"),
        pulls={},
        patches=None,
        seconds=0.0,
    )
