"""How far the recorded poses of a set of images may be off, together."""

from __future__ import annotations

import numpy as np

from v2hdm.records import FloatArray, PoseNoise

HEAVE_SIGMA_M = 0.01
"""How far a vehicle's body moves up and down on its suspension on paved ground; the mapper's figure."""

_LEAST = 1e-6
"""Poses stated to be exact would make the matrix singular: m or rad."""

STATES = ("roll", "pitch", "yaw", "forward", "left", "up")
"""Errors of a pose, rad and m, in vehicle axes."""


def state_sigmas(noise: PoseNoise) -> FloatArray:
    """Standard deviations (6,) of a pose's :data:`STATES`."""
    tilt, position = noise.roll_pitch_rad, noise.position_m
    sigmas = [tilt, tilt, noise.heading_rad, position, position, HEAVE_SIGMA_M]
    return np.asarray(np.maximum(np.array(sigmas), _LEAST))


def pose_information(noise: PoseNoise, path_m: FloatArray, loosened: FloatArray) -> FloatArray:
    """Inverse covariance (6, I, I) of each state's errors at the images.

    Args:
        noise: as the drive states it; drifts tie images together that are near to each other on the path.
        path_m: (I,) distance driven at each image.
        loosened: (6,) factors on the standard deviations.
    """
    apart_m = np.abs(path_m[:, None] - path_m[None])
    drifts = (
        [(noise.roll_pitch_drift_rad, noise.roll_pitch_drift_over_m)] * 2
        + [(noise.heading_drift_rad, noise.heading_drift_over_m)]
        + [(noise.position_drift_m, noise.position_drift_over_m)] * 2
        + [(0.0, 1.0)]
    )
    out = []
    for sigma, (drift, over_m), factor in zip(state_sigmas(noise), drifts, loosened, strict=True):
        white = np.sqrt(max(sigma**2 - drift**2, _LEAST**2))
        covariance = white**2 * np.eye(len(path_m)) + drift**2 * np.exp(-apart_m / over_m)
        out.append(np.linalg.inv(factor**2 * covariance))
    return np.array(out)
