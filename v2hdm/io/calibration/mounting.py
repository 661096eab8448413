"""First guesses of a camera's mounting: IPM matrices or an extrinsic, region of interest, survey."""

from __future__ import annotations

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.ipm import cam_from_mounting, extrinsic_from_ipm, ipm_from_extrinsic
from v2hdm.geometry.planar import winding
from v2hdm.geometry.rigid import camera_centre, inverse
from v2hdm.io.safe.fields import recorded_distance
from v2hdm.records import BoolArray, CameraInfo, CentrePrior, FloatArray
from v2hdm.store.files import check_keys, take_array, take_mapping, take_text

IPM_NAMES = ("calibrated", "estimated")

_MOUNTING = ("xyz_m", "rpy_deg")
_SINGULAR = 1e-12  # reciprocal condition number, rows and columns scaled to unit norm
_ROTATION_TOLERANCE = 1e-4
_ROI_SAMPLES = 8  # points along each edge of a region of interest that are looked for in the image
_ROI_M, _ROI_HALF_WIDTH_M = (2.0, 20.0), 5.0  # default region of interest, ahead of a camera: from, to
_STEEPEST_RAY = 0.999


def take_ipm(content: object, where: str) -> FloatArray:
    """An invertible 3 x 3 homography ``vehicle_from_pinhole_px``, scaled to unit norm."""
    ipm = balanced = take_array(content, (3, 3), where, DriveError)
    invertible = ipm.any(axis=0).all() and ipm.any(axis=1).all()
    # Rows and columns of comparable norms: pixels and metres must not look singular.
    for axis in (1, 0) * 4 if invertible else ():
        balanced = balanced / np.linalg.norm(balanced, axis=axis, keepdims=True)
    if not invertible or 1.0 / np.linalg.cond(balanced) < _SINGULAR:
        raise DriveError(f"{where}: IPM matrix is not invertible; calibrate it from 4 or more point pairs")
    return np.asarray(ipm / np.linalg.norm(ipm))


def take_mounting(content: object, where: str) -> FloatArray:
    """``cam_from_vehicle`` (4, 4) of a camera's place in m and its roll, pitch (down), yaw (left) in deg."""
    entry = take_mapping(content, where, DriveError)
    check_keys(entry, _MOUNTING, (), where, DriveError)
    xyz_m, rpy_deg = (take_array(entry[key], (3,), f"{where}, {key}", DriveError) for key in _MOUNTING)
    return cam_from_mounting(xyz_m, np.deg2rad(rpy_deg))


def ipm_from_guess(info: CameraInfo, cam_from_vehicle: object, where: str) -> FloatArray:
    """The IPM of a camera at the guessed rigid ``cam_from_vehicle`` (4 x 4), which is above the ground."""
    guess = take_rigid(cam_from_vehicle, where)
    centre_vehicle = camera_centre(guess)
    if centre_vehicle[2] < 0.05:
        raise DriveError(
            f"{where}: puts the camera {centre_vehicle[2]:.3g} m above the ground; "
            "give cam_from_vehicle (vehicle points to camera points), not its inverse"
        )
    return ipm_from_extrinsic(info, guess)


def take_rigid(content: object, where: str) -> FloatArray:
    """``content`` as a rigid transform (4 x 4)."""
    transform = take_array(content, (4, 4), where, DriveError)
    rotation = transform[:3, :3]
    orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), atol=_ROTATION_TOLERANCE)
    if not orthonormal or np.linalg.det(rotation) < 0 or not np.array_equal(transform[3], [0, 0, 0, 1]):
        raise DriveError(f"{where}: not a rigid transform (rotation, translation, last row 0 0 0 1); mend it")
    return transform


def take_roi(content: object, where: str) -> FloatArray:
    """``content`` as a convex polygon (N, 2) on the ground, counter-clockwise, of three points or more."""
    roi = take_array(content, (-1, 2), where, DriveError)
    if len(roi) < 3:
        raise DriveError(f"{where}: a polygon needs at least 3 points, got {len(roi)}; add points")
    if not (turning := winding(roi)):
        raise DriveError(f"{where}: polygon is not convex; give its corners in order around the region")
    return roi if turning > 0 else roi[::-1].copy()


def check_roi_in_view(info: CameraInfo, ipm: FloatArray, roi_vehicle: FloatArray, where: str) -> None:
    """Refuse a region of interest that lies behind a camera of this IPM, or outside its image."""
    centre = roi_vehicle.mean(axis=0)
    edge = np.linspace(roi_vehicle, np.roll(roi_vehicle, -1, axis=0), _ROI_SAMPLES).reshape(-1, 2)
    points = np.vstack([centre + share * (edge - centre) for share in (0.0, 0.5, 1.0)])
    cam_from_ground = np.linalg.inv(ipm @ info.intrinsic)
    # Of a homography's two signs, one puts the camera above the ground. A mirrored one has it below: then
    # the image's lower edge, which shows ground, decides.
    if np.linalg.det(cam_from_ground) > 0:
        cam_from_ground = -cam_from_ground
    rays = np.column_stack([points, np.ones(len(points))]) @ cam_from_ground.T
    below_px = [0.5 * info.width, info.height - 1.0, 1.0]
    lowest = np.linalg.inv(cam_from_ground) @ np.linalg.solve(info.intrinsic, below_px)
    if (rays[:, 2] <= 0).all() and lowest[2] > 0:
        raise DriveError(f"{where}: lies behind the camera; give ground that it sees, x forward and y left")
    if not _in_image(info, rays if (rays[:, 2] > 0).any() else -rays).any():
        raise DriveError(f"{where}: lies outside the image, by the initial IPM; mend one of them")


def _in_image(info: CameraInfo, rays_cam: FloatArray) -> BoolArray:
    """Flags (N,) of the rays (N, 3) in the image."""
    across = np.linalg.norm(rays_cam[:, :2], axis=1)
    recorded = recorded_distance(info, np.arctan2(across, rays_cam[:, 2]))
    scale = np.where(across > 0, recorded / np.maximum(across, 1e-12), 0.0)
    pixels = np.column_stack([rays_cam[:, :2] * scale[:, None], np.ones(len(rays_cam))]) @ info.intrinsic.T
    inside = (pixels[:, :2] > -0.5) & (pixels[:, :2] < np.array([info.width, info.height]) - 0.5)
    return np.asarray(inside.all(axis=1) & (rays_cam[:, 2] > 0))


def roi_of_ipm(info: CameraInfo, ipm: FloatArray) -> FloatArray:
    """The region of interest (4, 2) of a camera for which none is stated."""
    return roi_ahead(inverse(extrinsic_from_ipm(info, ipm)))


def roi_ahead(vehicle_from_cam: FloatArray) -> FloatArray:
    """A rectangle (4, 2) on the ground in the direction in which a camera looks."""
    forward, down = vehicle_from_cam[:2, 2], vehicle_from_cam[:2, 1]
    # A camera that looks straight down has its image's top ahead.
    along = forward if np.linalg.norm(forward) > np.sqrt(1 - _STEEPEST_RAY**2) else -down
    along = along / np.linalg.norm(along)
    left = np.array([-along[1], along[0]])
    (near, far), half = _ROI_M, _ROI_HALF_WIDTH_M
    corners = [(near, -half), (far, -half), (far, half), (near, half)]
    return np.array([vehicle_from_cam[:2, 3] + ahead * along + side * left for ahead, side in corners])


def take_centre_prior(content: object, where: str) -> CentrePrior:
    """A surveyed camera centre: ``xyz`` in the vehicle frame and ``sigma_m``, for each axis or for all."""
    entry = take_mapping(content, where, DriveError)
    check_keys(entry, ("xyz", "sigma_m"), (), where, DriveError)
    sigma = entry["sigma_m"]
    sigmas = sigma if isinstance(sigma, list) else [sigma] * 3
    sigma_m = take_array(sigmas, (3,), f"{where}, sigma_m", DriveError)
    if (sigma_m <= 0).any():
        raise DriveError(f"{where}, sigma_m: must be positive; give the survey's standard deviation in m")
    return CentrePrior(take_array(entry["xyz"], (3,), f"{where}, xyz", DriveError), sigma_m)


def choose_initial(name: object, ipm: dict[str, FloatArray], where: str) -> str:
    """The name of the IPM to start from: the one asked for, or the only one there is."""
    if name is None and len(ipm) == 1:
        return next(iter(ipm))
    if name is None:
        raise DriveError(f"{where}: missing key 'initial_ipm'; choose from: {', '.join(ipm)}")
    initial = take_text(name, f"{where}, initial_ipm", DriveError)
    if initial not in ipm:
        names = ", ".join(ipm)
        raise DriveError(f"{where}: initial_ipm '{initial}' is not given under ipm; choose from: {names}")
    return initial
