"""Options and results of the ground's estimate, and the better start that they give the mapper."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.records import Calibration, Camera, Drive

GROUND_IPM = "ground"
"""Name of the IPM that the ground gives, beside those of the drive."""

_SURE_RAD = np.deg2rad(0.5)  # an estimate with a larger standard deviation is no better than a guess


@dataclass(frozen=True, kw_only=True)
class GroundOptions:
    """How the ground is matched.

    Attributes:
        pairs: image pairs that the mounting is found from.
        clock_pairs: further pairs, where speed or yaw rate change, for the clock.
        free: names of the parameters to free, one at a time, beside the mounting; see :class:`Parameter`.
        readings: whether to try how else the poses could be read.
    """

    pairs: int = 36
    clock_pairs: int = 16
    free: tuple[str, ...] = (
        "clock_s", "focal_scale", "distortion_k1", "grade", "up_m", "forward_m", "left_m",
    )  # fmt: skip
    readings: bool = True


class GroundStatus(Enum):
    """Whether the ground gave an answer."""

    FOUND = "found"
    NO_MATCH = "no match"
    """The ground moves between images otherwise than the poses as given say."""
    TOO_LITTLE = "too little"
    """Too little motion or ground in view."""
    NO_TEXTURE = "no texture"
    """Too few patches are found again to estimate a mounting, and none contradicts the poses."""


class Reading(Enum):
    """How the recorded poses can be read."""

    AS_GIVEN = "as given"
    HEADING_FROM_PATH = "heading from path"
    """The vehicle heads along its path, whatever its recorded yaw."""
    MIRRORED = "mirrored"
    """x and y of the positions are swapped, which mirrors the world; the vehicle heads along its path."""
    BACKWARDS = "backwards"
    """The camera looks the other way than its guess: front and rear are swapped."""


@dataclass(frozen=True)
class Parameter:
    """One quantity that the ground may contradict, freed beside the mounting.

    ``name`` is one of: ``clock_s`` (an image was taken so much later on the poses' clock than its stamp
    says), ``focal_scale`` (focal length / given one - 1), ``distortion_k1`` (k1 - given one), ``grade`` (rise
    of the poses over the ground, m per m driven), ``up_m``, ``forward_m`` and ``left_m`` (camera centre -
    stated one). Where this drive does not make it ``observable``, ``why_not`` says which drive would.
    """

    name: str
    value: float
    sigma: float
    observable: bool
    why_not: str = ""


@dataclass(frozen=True)
class GroundEstimate:
    """The mounting of one camera and the errors of a drive's statements, from bare ground.

    ``shares``: of the patches, how many find a partner under each reading of the poses; ``reading`` is the
    best one. ``calibration`` has ``cam_from_vehicle`` with its covariance, None unless ``status`` is FOUND.
    ``median_residual`` is in units of :data:`v2hdm.ground.adjust.PIXEL_SIGMA`: .3 to .5 on a clean drive.
    ``innovations`` are the root mean squares of the poses' estimated errors in their stated sigmas.
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


def better_start(drive: Drive, estimates: Mapping[str, GroundEstimate]) -> Drive:
    """The drive with its cameras started from the ground's mounting, where that is found and sure."""
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
    if np.sqrt(np.diag(calibration.covariance)[3:].max()) > _SURE_RAD:
        return camera
    ipm = {**camera.ipm, GROUND_IPM: ipm_from_extrinsic(camera.info, calibration.cam_from_vehicle)}
    return replace(camera, ipm=ipm, initial_ipm=GROUND_IPM)
