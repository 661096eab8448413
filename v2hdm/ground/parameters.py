"""Quantities that the ground may contradict, each freed alone beside the mounting."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from v2hdm.ground.adjust import CENTRE, Adjusted, Observations, adjust
from v2hdm.ground.beliefs import Beliefs
from v2hdm.ground.motion import Motion
from v2hdm.ground.results import Parameter

_FREE_CENTRE = {"forward_m": (0, 2.0), "left_m": (1, 2.0), "up_m": (2, 0.3)}
"""Axis of the centre, and how far from its survey it may be, m."""

_TOLD_SIGMA = {
    "focal_scale": 0.01,
    "distortion_k1": 0.03,
    "grade": 0.001,
    "up_m": 0.03,
    "forward_m": 0.1,
    "left_m": 0.1,
    "clock_s": 0.015,
}
"""Standard deviations above which a value says nothing: a third of the smallest fault worth telling."""

_STEEP_RAD = np.deg2rad(10)
"""A camera that looks down less shows focal length and height only as a product, unless the vehicle turns."""

_REAL_CHANGE = 4.0
"""Changes of motion must be so many times what the noise of the poses looks like."""

_LEAST_SPEED_CHANGE_MPS = 0.5
_LEAST_TURN_RADPS = 0.05
"""Changes of speed and of yaw rate within a pair's length that show 15 ms over the noise of 20 pairs."""

_REMEDY = {
    "clock_s": "speed and direction hardly change: drive a turn",
    "focal_scale": "the camera looks too level and the vehicle drives straight: drive a turn",
    "distortion_k1": "too little ground is matched away from the image's middle: drive on rougher ground",
    "grade": "too few matches: drive further",
    "up_m": "too few matches: drive further",
    "forward_m": "the vehicle drives straight: drive a turn",
    "left_m": "the vehicle drives straight: drive a turn",
}


def clock_shows(motion: Motion) -> bool:
    """Whether speed or yaw rate really change along the drive, beyond the noise of smoothed poses."""
    velocity = motion.velocity_at_images()
    calm = np.percentile(velocity, 97, axis=0) - np.percentile(velocity, 3, axis=0)
    return bool(calm[2] > _LEAST_TURN_RADPS)


def free_parameters(
    names: tuple[str, ...],
    observations: Observations,
    beliefs: Beliefs,
    solved: Adjusted,
    clock: Parameter | None,
    factor: float,
) -> Mapping[str, Parameter]:
    """Each of ``names`` freed alone.

    Args:
        names: see :class:`v2hdm.ground.results.Parameter`.
        observations: matches between rows of the motion.
        beliefs: about poses and survey.
        solved: the solution without any of them.
        clock: its estimate, where the drive shows it.
        factor: of all variances; see :func:`v2hdm.ground.scatter.scatter`.
    """
    turns = clock_shows(beliefs.motion)
    out = {}
    for name in names:
        if name == "clock_s" and clock is not None:
            out[name] = replace(clock, sigma=clock.sigma * float(np.sqrt(factor)))
            continue
        value, sigma = _free(name, observations, beliefs, solved)
        # A fault widens the scatter; that it shows must not hang on it.
        told = sigma < _TOLD_SIGMA[name]
        sigma *= float(np.sqrt(factor))
        if name == "clock_s":
            told = False
        if name == "focal_scale":
            told = told and (turns or solved.mount.depression_rad > _STEEP_RAD)
        out[name] = Parameter(name, value, sigma, told, "" if told else _REMEDY[name])
    return out


def _free(name: str, observations: Observations, beliefs: Beliefs, solved: Adjusted) -> tuple[float, float]:
    if name in _FREE_CENTRE:
        axis, sigma_m = _FREE_CENTRE[name]
        wider = replace(beliefs, centre_sigma_m={**beliefs.centre_sigma_m, axis: sigma_m})
        used, believed, _ = wider.about(observations)
        adjusted = adjust(used, believed, solved.mount, near=solved)
        value = adjusted.mount.centre_vehicle[axis] - believed.centre_vehicle[axis]
        return float(value), float(np.sqrt(adjusted.covariance[CENTRE, CENTRE][axis, axis]))
    prior = beliefs.camera.centre_prior
    if name == "focal_scale" and prior is not None:
        # A longer focal length and a higher camera look alike; the survey tells them apart.
        beliefs = replace(beliefs, centre_sigma_m={2: float(prior.sigma_m[2])})
    used, believed, _ = beliefs.about(observations)
    adjusted = adjust(used, believed, solved.mount, free=name, near=solved)
    return adjusted.extra, float(np.sqrt(adjusted.covariance[6, 6]))
