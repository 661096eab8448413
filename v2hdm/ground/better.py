"""The mapper's better start: cameras that begin where the ground says that they sit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.ground.results import GroundEstimate, GroundStatus, Reading
from v2hdm.records import Camera, Drive

GROUND_IPM = "ground"
"""Name of the IPM that the ground gives, beside those of the drive."""

_SURE_RAD = np.deg2rad(0.5)
"""An estimate with a larger standard deviation is no better than a guess."""


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
