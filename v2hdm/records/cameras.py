"""Cameras: intrinsics, mounting, place in the frames of their vehicle, and calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from v2hdm.doors import checked_class
from v2hdm.records.arrays import BoolArray, FloatArray

DISTORTION_COEFFICIENTS: Mapping[str, int] = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
"""Distortion models by their ROS ``camera_info`` name, with their number of coefficients."""


@dataclass(frozen=True)
class CameraInfo:
    """Intrinsics of one camera, as in a ROS ``camera_info``."""

    name: str
    width: int
    height: int
    intrinsic: FloatArray  # K (3 x 3), px
    distortion_model: str = "plumb_bob"
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)  # by :data:`DISTORTION_COEFFICIENTS`


@dataclass(frozen=True)
class CentrePrior:
    """Surveyed camera centre in the vehicle frame: ``centre_vehicle`` (3,) m, ``sigma_m`` (3,)."""

    centre_vehicle: FloatArray
    sigma_m: FloatArray


@dataclass(frozen=True)
class FrameStep:
    """An edge of a tree of frames; ``parent_from_child`` (4, 4) is None where the tree lacks it."""

    parent: str
    child: str
    parent_from_child: FloatArray | None


@dataclass(frozen=True)
class CameraFrames:
    """A camera's place in the tree of frames of its vehicle, by the tree's own names; empty if not stated."""

    vehicle: str = ""  # the frame that the drive's positions on the vehicle count from
    camera: str = ""  # the frame of the images
    height_m: float = 0.0  # of ``vehicle`` above the ground
    steps: tuple[FrameStep, ...] = ()  # from ``vehicle`` to ``camera``; none where the vehicle has no tree
    problem: str = ""  # why there are no steps
    states_height: bool = False  # of the camera above ``vehicle``, which a homography of the ground does not
    rectified_from_camera: FloatArray | None = None  # (3, 3), turn of images that were rectified, else None


@dataclass(frozen=True)
class GroundPlane:
    """The ground as a camera's images of its texture show it, a plane in the camera.

    ``plane_cam`` (4,) is its normal, upwards, and the camera's height above it, m; ``root_information``
    (3, 4) whitens deviations from that. ``by_lens`` (2, 4) is the plane's change by a relative error of the
    focal length, and by one of k1.
    """

    plane_cam: FloatArray
    root_information: FloatArray
    by_lens: FloatArray


@dataclass(frozen=True)
class Camera:
    """One camera of a drive: its intrinsics and approximate mounting."""

    info: CameraInfo
    # ``vehicle_from_pinhole_px`` (3 x 3): ``calibrated``, this vehicle's own, ``estimated``, borrowed
    ipm: Mapping[str, FloatArray]
    initial_ipm: str  # the IPM that mapping starts from
    roi_vehicle: FloatArray  # (N, 2) m, convex polygon of ground in which the IPM is trusted
    centre_prior: CentrePrior | None = None
    linear_response: bool = False  # grey proportional to radiance, else sRGB
    own_vehicle: BoolArray | None = None  # (height, width) pixels that show the vehicle
    mounting_sigma: tuple[float, float] = (0.0, 0.0)  # of a guessed horizon (rad) and log focal length
    read_out_s: float = 0.0  # first row to last, 0 for a global shutter; stamps refer to the middle row
    frames: CameraFrames = CameraFrames()
    ground_plane: GroundPlane | None = None


@checked_class
@dataclass(frozen=True)
class Calibration:
    """The calibration of one camera, with its extrinsic ``cam_from_vehicle`` (4, 4).

    ``covariance`` (6, 6) is that of its left-perturbation tangent, translation (m) then rotation (rad); None
    if unknown.

    >>> calibration = result.calibrations["front"]
    >>> sigma = np.sqrt(np.diag(calibration.covariance))
    >>> bool(sigma[:3].max() < 0.1 and np.rad2deg(sigma[3:].max()) < 0.5)
    True
    """

    info: CameraInfo
    cam_from_vehicle: FloatArray
    covariance: FloatArray | None = None
    frames: CameraFrames = CameraFrames()

    @property
    def centre_vehicle(self) -> FloatArray:
        """The camera's centre (3,) in the frame ``vehicle``: forward, left, up, m."""
        return np.asarray(-self.cam_from_vehicle[:3, :3].T @ self.cam_from_vehicle[:3, 3])
