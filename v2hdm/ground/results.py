"""Options and results of the ground's estimate, and the initial IPM that it gives the mapping."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.records import Calibration, Camera, Drive, GroundPlane

GROUND_IPM = "ground"
"""Name of the ground's IPM, beside those of the drive."""

STEEP_RAD = np.deg2rad(10)
"""Least depression of a camera: seen flatter, focal length and height appear as a product, and lens
distortion looks like a curved road."""

_SURE_RAD = np.deg2rad(0.5)  # an estimate with a larger standard deviation is no better than a guess


@dataclass(frozen=True, kw_only=True)
class GroundOptions:
    """Options of ground matching.

    ``pairs`` of images fix the mounting, ``clock_pairs``, with changing speed or yaw rate, the clock.
    ``free`` names parameters to free one at a time, see :class:`Parameter`; ``readings`` also tries other
    readings of the poses.
    """

    pairs: int = 36
    clock_pairs: int = 16
    free: tuple[str, ...] = (
        "clock_s", "focal_scale", "distortion_k1", "grade", "up_m", "forward_m", "left_m",
    )  # fmt: skip
    readings: bool = True


class GroundStatus(Enum):
    """Outcome of the estimate."""

    FOUND = "found"
    NO_MATCH = "no match"
    """The ground's motion between images contradicts the poses as given."""
    TOO_LITTLE = "too little"
    """Too little motion, or ground in view."""
    NO_TEXTURE = "no texture"
    """Too few patches match to estimate a mounting, and none contradicts the poses."""


class Reading(Enum):
    """An interpretation of the recorded poses."""

    AS_GIVEN = "as given"
    HEADING_FROM_PATH = "heading from path"
    """The vehicle heads along its path; the recorded yaw is ignored."""
    MIRRORED = "mirrored"
    """x and y of positions are swapped, which mirrors the world; the vehicle heads along its path."""
    BACKWARDS = "backwards"
    """The camera looks opposite to its guess: front and rear are swapped."""


@dataclass(frozen=True)
class Parameter:
    """One quantity that the ground may contradict, freed beside the mounting.

    ``name`` is ``clock_s`` (exposure time on the poses' clock minus stamp), ``focal_scale`` (focal length
    over the given one, minus 1), ``distortion_k1`` (minus the given one), ``grade`` (rise of the poses over
    the ground, m per m driven), or ``up_m``, ``forward_m``, ``left_m`` (camera centre minus the stated one).
    If not ``observable``, ``why_not`` names a drive that would show it.
    """

    name: str
    value: float
    sigma: float
    observable: bool
    why_not: str = ""


@dataclass(frozen=True)
class GroundEstimate:
    """The mounting of one camera and the errors of a drive's statements, from bare ground.

    ``shares`` are the matched fractions of patches under each reading of the poses, ``reading`` the best.
    ``calibration`` has ``cam_from_vehicle`` with its covariance, None unless ``status`` is FOUND.
    ``median_residual`` is in units of :data:`v2hdm.ground.adjust.PIXEL_SIGMA`, 0.3 to 0.5 on a clean drive.
    ``innovations`` are the RMS of estimated pose errors in stated sigmas. ``plane`` is the ground in the
    camera, where there is a calibration.
    """

    camera: str
    status: GroundStatus
    shares: Mapping[Reading, float]
    reading: Reading
    calibration: Calibration | None
    parameters: Mapping[str, Parameter]
    median_residual: float
    innovations: Mapping[str, float]
    seconds: float
    plane: GroundPlane | None = None


def better_start(drive: Drive, estimates: Mapping[str, GroundEstimate]) -> Drive:
    """The drive with the ground's planes, its cameras started from the ground's mounting where certain."""
    cameras = {
        name: _started(camera, estimates[name]) if name in estimates else camera
        for name, camera in drive.cameras.items()
    }
    return replace(drive, cameras=cameras)


def _started(camera: Camera, estimate: GroundEstimate) -> Camera:
    calibration = estimate.calibration
    if estimate.status is not GroundStatus.FOUND or estimate.reading is not Reading.AS_GIVEN:
        return camera
    if calibration is None or calibration.covariance is None:
        return camera
    camera = replace(camera, ground_plane=estimate.plane)
    if np.sqrt(np.diag(calibration.covariance)[3:].max()) > _SURE_RAD:
        return camera
    ipm = {**camera.ipm, GROUND_IPM: ipm_from_extrinsic(camera.info, calibration.cam_from_vehicle)}
    return replace(camera, ipm=ipm, initial_ipm=GROUND_IPM)
