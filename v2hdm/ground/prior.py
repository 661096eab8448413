"""Ground matches, and the drive's statements about their images, as a prior."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from v2hdm.ground.model import Mount
from v2hdm.ground.motion import Motion
from v2hdm.records import HEAVE_SIGMA_M, BoolArray, Camera, Drive, FloatArray, IntArray, PoseNoise

STATES = ("roll", "pitch", "yaw", "forward", "left", "up")
"""Errors of a pose, rad and m, in vehicle axes."""

_LEAST_POSE_SIGMA = 1e-6  # least sigma, m or rad: poses stated as exact would make the covariance singular
_UNSURVEYED_M = 0.5  # standard deviation of a camera centre from a guess, m
_HEIGHT_SIGMA_M = 0.2  # least sigma of a height, m: the ground shows it better, a survey's would bias it


@dataclass(frozen=True)
class Observations:
    """Matches of all pairs of one camera.

    ``first`` and ``second`` (N,) are rows of the poses, ``first_px`` and ``second_px`` (N, 2) raw pixels,
    ``pair`` (N,) the pair's index.
    """

    first: IntArray
    second: IntArray
    first_px: FloatArray
    second_px: FloatArray
    pair: IntArray

    def only(self, keep: BoolArray) -> Observations:
        """The matches selected by a mask (N,)."""
        return Observations(**{name: values[keep] for name, values in vars(self).items()})


@dataclass(frozen=True)
class Prior:
    """The statements of a drive about I images and their camera.

    ``poses`` (I, 4, 4) are ``map_from_vehicle`` as recorded, ``pose_information`` (6, I, I) that of their
    errors, ``velocity`` (I, 3) the smoothed motion. A grade of 1 has lifted the poses by ``climb_m`` (I,), m.
    ``course_map`` (N, 2), m, are points of the driven path; ``centre_vehicle`` and ``centre_sigma_m`` (3,),
    m, the surveyed camera centre.
    """

    poses: FloatArray
    pose_information: FloatArray
    velocity: FloatArray
    climb_m: FloatArray
    course_map: FloatArray
    centre_vehicle: FloatArray
    centre_sigma_m: FloatArray


class ObservedPrior(NamedTuple):
    """Observations, and the statements of a drive about their images."""

    observations: Observations  # with the images of ``prior``
    prior: Prior
    rows: IntArray  # (I,) of the motion, of these images


@dataclass(frozen=True)
class Stated:
    """The statements of a drive about one camera, its poses under one reading.

    ``clock_s`` is added to image stamps, ``centre_sigma_m`` overrides the survey's by axis; without
    ``surveyed`` the centre is the guess's.
    """

    drive: Drive
    camera: Camera
    motion: Motion
    guess: Mount
    clock_s: float = 0.0
    centre_sigma_m: dict[int, float] = field(default_factory=dict)
    surveyed: bool = True

    def with_surveyed_height(self) -> Stated:
        """The same with the survey's own sigma of the height, which resembles distance and focal length."""
        prior = self.camera.centre_prior
        return self if prior is None else replace(self, centre_sigma_m={2: float(prior.sigma_m[2])})

    def poses(self) -> FloatArray:
        """``map_from_vehicle`` (I, 4, 4) at all images."""
        return self.motion.poses(self.clock_s)

    def path_m(self) -> FloatArray:
        """Distance driven (I,) at all images."""
        return self.motion.path_at_images(self.clock_s)

    def prior_of(self, observations: Observations) -> ObservedPrior:
        """The prior of the images of observations."""
        images = np.concatenate([observations.first, observations.second])
        rows, place = np.unique(images, return_inverse=True)
        count = len(observations.first)
        path_m = self.path_m()[rows]
        survey = self.camera.centre_prior if self.surveyed else None
        sigma_m = np.full(3, _UNSURVEYED_M) if survey is None else survey.sigma_m.copy()
        sigma_m[2] = max(sigma_m[2], _HEIGHT_SIGMA_M)
        for axis, wider_m in self.centre_sigma_m.items():
            sigma_m[axis] = wider_m
        prior = Prior(
            poses=self.poses()[rows],
            pose_information=pose_information(self.drive.pose_noise, path_m),
            velocity=self.motion.velocity_at_images(self.clock_s)[rows],
            climb_m=path_m - path_m.mean(),
            course_map=self.motion.course_map(),
            centre_vehicle=self.guess.centre_vehicle if survey is None else survey.centre_vehicle,
            centre_sigma_m=sigma_m,
        )
        renumbered = replace(observations, first=place[:count], second=place[count:])
        return ObservedPrior(renumbered, prior, rows)


def state_sigmas(noise: PoseNoise) -> FloatArray:
    """Standard deviations (6,) of a pose's :data:`STATES`."""
    tilt = noise.roll_pitch_rad
    position = noise.position_m
    sigmas = [tilt, tilt, noise.heading_rad, position, position, HEAVE_SIGMA_M]
    return np.asarray(np.maximum(np.array(sigmas), _LEAST_POSE_SIGMA))


def pose_information(noise: PoseNoise, path_m: FloatArray) -> FloatArray:
    """Inverse covariance (6, I, I) of each state's errors at images after driving ``path_m`` (I,).

    Drift correlates images that are close on the path.
    """
    apart_m = np.abs(path_m[:, None] - path_m[None])
    drifts = (
        [(noise.roll_pitch_drift_rad, noise.roll_pitch_drift_over_m)] * 2
        + [(noise.heading_drift_rad, noise.heading_drift_over_m)]
        + [(noise.position_drift_m, noise.position_drift_over_m)] * 2
        + [(0.0, 1.0)]
    )
    out = []
    for sigma, (drift, over_m) in zip(state_sigmas(noise), drifts, strict=True):
        white = np.sqrt(max(sigma**2 - drift**2, _LEAST_POSE_SIGMA**2))
        covariance = white**2 * np.eye(len(path_m)) + drift**2 * np.exp(-apart_m / over_m)
        out.append(np.linalg.inv(covariance))
    return np.array(out)
