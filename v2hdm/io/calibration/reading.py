"""Reading one camera's calibration, and the first guess of its mounting.

A calibration is our own YAML or ROS' ``camera_info``, as a file or message. A guess is an IPM matrix or an
extrinsic, with a region of interest and a surveyed camera centre.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from v2hdm.errors import DriveError, MapFileError, V2hdmError, shown
from v2hdm.geometry.frames import nodes_of
from v2hdm.geometry.ipm import cam_from_mounting, extrinsic_from_ipm, ipm_from_extrinsic
from v2hdm.geometry.planar import winding
from v2hdm.geometry.rigid import camera_centre, inverse, make_transform, rotation_from_quaternion
from v2hdm.records import (
    DISTORTION_COEFFICIENTS,
    BoolArray,
    Calibration,
    CameraFrames,
    CameraInfo,
    CentrePrior,
    FloatArray,
    FrameStep,
)
from v2hdm.safe.fields import (
    check_camera,
    recorded_distance,
    take_covariance,
    take_frame,
    take_frame_height,
    take_size_px,
)
from v2hdm.safe.texts import take_camera_name
from v2hdm.store.files import check_keys, load_yaml, take_array, take_mapping, take_number, take_text
from v2hdm.store.names import CALIBRATIONS

_SIZE = ("image_width", "image_height")
_INFO = ("camera_name", *_SIZE, "camera_matrix", "distortion_model", "distortion_coefficients")
_OPTIONAL = (
    "vehicle_from_pinhole_px", "translation_sigma_m", "rotation_sigma_deg", "covariance", "clock_offset_s",
    "clock_sigma_s", "read_out_s", "read_out_sigma_s", "drive", "date", "verdict",
    "vehicle_frame", "vehicle_frame_height_m", "frame", "transforms", "rectification",
)  # fmt: skip
_EDGE = ("frame_id", "child_frame_id")
_IGNORED = ("rectification_matrix", "projection_matrix")  # of stereo rectification, not of recorded images
_OF_OPENCV = ("dt", "type_id")  # OpenCV adds these to its matrices; numbers tell their type themselves
_LEAST_COEFFICIENTS = 4  # fewer may be k1 k2 p1, or the three of a radial lens, as MATLAB counts them
_MODELS = dict.fromkeys(("", "none", "radtan", "brown_conrady"), "plumb_bob")
_MODELS |= dict.fromkeys(("fisheye", "kannala_brandt", "kannala_brandt4", "kb4"), "equidistant")
"""Our lenses by the names that drivers, OpenCV and Kalibr have for them."""


@dataclass(frozen=True)
class Provenance:
    """The source of a calibration."""

    drive: str | None = None  # name of the drive
    date: str | None = None  # of the run, ISO 8601
    verdict: str | None = None  # status of the run's verdict

    @classmethod
    def today(cls, drive: str, verdict: Mapping[str, Any]) -> Provenance:
        """The provenance of a run of today (UTC) over ``drive``, with its verdict as JSON."""
        return cls(drive, datetime.now(UTC).date().isoformat(), str(verdict["status"]))


def read_calibration(path: Path) -> Calibration:
    """Read our own calibration; raises MapFileError when it is missing, damaged or of another format."""
    content = load_yaml(path, MapFileError)
    if "cam_from_vehicle" not in content:
        raise MapFileError(f"{path}: no cam_from_vehicle: give a calibration_<camera>.yaml of V2HDM")
    check_keys(content, (*_INFO, "cam_from_vehicle"), _OPTIONAL, str(path), MapFileError)

    def array(key: str, *shape: int) -> Any:
        return take_array(content[key], shape, f"{path}: {key}", MapFileError)

    name = take_camera_name(content["camera_name"], f"{path}: camera_name", MapFileError)
    width, height = (take_size_px(content[key], f"{path}: {key}", MapFileError) for key in _SIZE)
    model = take_text(content["distortion_model"], f"{path}: distortion_model", MapFileError)
    distortion = tuple(array("distortion_coefficients", -1).tolist())
    info = CameraInfo(name, width, height, array("camera_matrix", 3, 3), model, distortion)
    if len(info.distortion) == DISTORTION_COEFFICIENTS.get(info.distortion_model):
        check_camera(info, str(path), MapFileError)
    covariance = None
    if "covariance" in content:
        covariance = take_covariance(content["covariance"], 6, f"{path}: covariance", MapFileError)
    return Calibration(info, array("cam_from_vehicle", 4, 4), covariance, _take_frames(content, str(path)))


def _take_frames(content: Mapping[str, Any], where: str) -> CameraFrames:
    """The frames that a calibration states, and the edges between them."""
    names = {
        key: take_frame(content[key], f"{where}: {key}", MapFileError)
        for key in ("vehicle_frame", "frame")
        if content.get(key) is not None
    }
    height_m = take_frame_height(
        content.get("vehicle_frame_height_m", 0.0), f"{where}: vehicle_frame_height_m", MapFileError
    )
    entries = content.get("transforms") or []
    if not isinstance(entries, list):
        raise MapFileError(f"{where}: transforms: expected a list, got {shown(entries)}; leave it out")
    steps = tuple(
        _take_step(entry, f"{where}: transforms, {number}") for number, entry in enumerate(entries, start=1)
    )
    turn = content.get("rectification")
    rectification = None if turn is None else take_rotation(turn, f"{where}: rectification", MapFileError)
    frames = CameraFrames(
        names.get("vehicle_frame", ""), names.get("frame", ""), height_m, steps,
        rectified_from_camera=rectification,
    )  # fmt: skip
    if steps and nodes_of(frames)[-1] != frames.camera:
        raise MapFileError(
            f"{where}: transforms do not lead from vehicle_frame to frame; keep them as the run wrote them"
        )
    return frames


def _take_step(content: object, where: str) -> FrameStep:
    """An edge of a tree, as :func:`v2hdm.io.calibration.writing.edge_entry` writes it."""
    entry = take_mapping(content, where, MapFileError)
    check_keys(entry, ("frame_id", "child_frame_id"), ("translation", "rotation"), where, MapFileError)
    parent, child = (take_frame(entry[key], f"{where}, {key}", MapFileError) for key in _EDGE)
    if "translation" not in entry and "rotation" not in entry:
        return FrameStep(parent, child, None)
    numbers = {}
    for key, axes in (("translation", "xyz"), ("rotation", "xyzw")):
        values = take_mapping(entry.get(key), f"{where}, {key}", MapFileError)
        check_keys(values, axes, (), f"{where}, {key}", MapFileError)
        numbers[key] = np.array(
            [take_number(values[axis], f"{where}, {key}, {axis}", MapFileError) for axis in axes]
        )
    norm = float(np.linalg.norm(numbers["rotation"]))
    if abs(norm - 1) > _ROTATION_TOLERANCE:
        raise MapFileError(f"{where}, rotation: quaternion of norm {norm:.6g} instead of 1; fix it")
    rotation = rotation_from_quaternion(numbers["rotation"][None] / norm)[0]
    return FrameStep(parent, child, make_transform(rotation, numbers["translation"]))


def read_provenance(path: Path) -> Provenance:
    """The provenance that our own calibration states; errors as :func:`read_calibration`."""
    content = load_yaml(path, MapFileError)
    verdict = content.get("verdict")
    stated = {key: content.get(key) for key in ("drive", "date")}
    stated["verdict"] = verdict.get("status") if isinstance(verdict, dict) else None
    texts = {
        key: None if value is None else take_text(value, f"{path}: {key}", MapFileError)
        for key, value in stated.items()
    }
    return Provenance(**texts)


def trusted_calibrations(path: Path) -> dict[str, Calibration]:
    """The calibrations of a result folder or a file, by camera; MapFileError if none, or one of a FAIL."""
    files = sorted(path.glob(CALIBRATIONS)) if path.is_dir() else [path]
    if not files:
        raise MapFileError(f"{path}: has no {CALIBRATIONS}; give a result of map or calibrate ground")
    calibration_of_camera = {}
    for file in files:
        calibration = read_calibration(file)
        calibration_of_camera[calibration.info.name] = calibration
        if read_provenance(file).verdict == "FAIL":
            raise MapFileError(
                f"{file}: the verdict on its drive is FAIL, so it cannot be relied on: docs/verdict.md"
            )
    return calibration_of_camera


def read_camera_info(path: Path) -> CameraInfo:
    """Read the ``camera_info`` file of ROS at ``path``; errors as in :func:`take_camera_info`."""
    return take_camera_info(load_yaml(path, DriveError), str(path))


def take_camera_info(content: Mapping[str, Any], where: str) -> CameraInfo:
    """The intrinsics in the entries of a ``camera_info`` file; raises DriveError where one is wrong."""
    check_keys(content, _INFO, _IGNORED, where, DriveError)
    stated = take_text(content["distortion_model"], f"{where}: distortion_model", DriveError)
    distortion = take_matrix(content["distortion_coefficients"], f"{where}: distortion_coefficients").ravel()
    lens = _lens_of(stated, distortion, where, "convert the calibration to")
    count = len(lens.coefficients)
    # Of a message drivers leave out zeros; a file that lacks numbers was cut, or names the wrong model.
    if len(distortion) < (_LEAST_COEFFICIENTS if lens.model == "plumb_bob" else count):
        raise DriveError(
            f"{where}: distortion_coefficients: {lens.model} has {count} coefficients, "
            f"got {len(distortion)}; complete them (zeros where unused) or give the right model"
        )
    name = take_text(content["camera_name"], f"{where}: camera_name", DriveError)
    width, height = (take_size_px(content[key], f"{where}: {key}", DriveError) for key in _SIZE)
    at = f"{where}: camera_matrix"
    intrinsic = take_matrix(content["camera_matrix"], at)
    if intrinsic.shape != (3, 3):
        raise DriveError(f"{at}: expected 3 x 3, got {intrinsic.shape[0]} x {intrinsic.shape[1]}; fix it")
    has_focals = intrinsic[0, 0] > 0 and intrinsic[1, 1] > 0
    zeros = intrinsic[[0, 1, 2, 2], [1, 0, 0, 1]]
    if not has_focals or zeros.any() or intrinsic[2, 2] != 1:
        raise DriveError(f"{at}: not of the form fx 0 cx, 0 fy cy, 0 0 1 with positive fx, fy; fix it")
    info = CameraInfo(name, width, height, intrinsic, lens.model, lens.coefficients)
    return check_camera(info, where, DriveError)


class Lens(NamedTuple):
    """A distortion model of ours and all of its coefficients."""

    model: str
    coefficients: tuple[float, ...]


def _lens_of(stated: str, distortion: FloatArray, where: str, advice: str) -> Lens:
    """The lens of a model's ``stated`` name and its numbers (N,); DriveError with ``advice`` for others.

    k3 and those after it are zero where they are not given.
    """
    model = _MODELS.get(stated.strip().lower().replace("-", "_").replace(" ", "_"), stated)
    if model not in DISTORTION_COEFFICIENTS:
        models = ", ".join(DISTORTION_COEFFICIENTS)
        raise DriveError(f"{where}: unknown distortion_model {shown(model)}; {advice} one of: {models}")
    count = DISTORTION_COEFFICIENTS[model]
    if model != "equidistant" and 0 < len(distortion) < _LEAST_COEFFICIENTS:
        raise DriveError(
            f"{where}: {len(distortion)} distortion coefficients leave open which they are; give k1 k2 p1 p2 "
            "and k3, with zeros where unused"
        )
    if distortion[count:].any():
        raise DriveError(
            f"{where}: {model} has {count} coefficients, got {len(distortion)}; {advice} one of: "
            f"{', '.join(DISTORTION_COEFFICIENTS)}"
        )
    return Lens(model, (*distortion[:count].tolist(), *(0.0,) * (count - len(distortion))))


def take_matrix(content: object, where: str) -> FloatArray:
    """A matrix of ``rows``, ``cols`` and ``data``, as ROS and OpenCV write it; raises DriveError."""
    entry = take_mapping(content, where, DriveError)
    check_keys(entry, ("rows", "cols", "data"), _OF_OPENCV, where, DriveError)
    rows, cols = (take_size_px(entry[key], f"{where}, {key}", DriveError) for key in ("rows", "cols"))
    data = take_array(entry["data"], (-1,), f"{where}, data", DriveError)
    if len(data) != rows * cols:
        raise DriveError(f"{where}: {rows} x {cols} does not fit its {len(data)} numbers; fix one of them")
    return data.reshape(rows, cols)


class Intrinsics(NamedTuple):
    """The lens of a camera, and the turn (3, 3) of its images from its frame where they were rectified."""

    info: CameraInfo
    rectified_from_camera: FloatArray | None = None


def info_of(fields: Any, name: str, where: str, rectified: bool = False) -> Intrinsics:
    """The intrinsics of a ``CameraInfo`` message; DriveError if not calibrated, cut, or an unknown model.

    Of images that were ``rectified`` they are those of P, without a distortion, and R is their turn.
    """
    intrinsic = info_numbers(fields, "k").reshape(3, -1)
    distortion = info_numbers(fields, "d")
    stated = fields.distortion_model
    if min(fields.width, fields.height) <= 0:
        raise DriveError(f"{where}: states no size of the image; give camera_info as a file")
    if not intrinsic.any():
        raise DriveError(f"{where}: the camera is not calibrated (K is zero); give camera_info as a file")
    turn = None
    if rectified:
        projection = info_numbers(fields, "p").reshape(3, -1)
        intrinsic = rectified_matrix(intrinsic, distortion, projection, where)
        distortion = np.zeros(0)
        stated = "plumb_bob"
        turn = rectifying_turn(info_numbers(fields, "r").reshape(3, -1), f"{where}, R")
    region = (fields.roi.width, fields.roi.height)
    is_cropped = region not in ((0, 0), (fields.width, fields.height))  # the whole image may be stated, too
    if max(fields.binning_x, fields.binning_y) > 1 or is_cropped:
        raise DriveError(f"{where}: its images are binned or cropped; give camera_info as a file")
    lens = _lens_of(stated, distortion, where, "give camera_info as a file with")
    info = CameraInfo(name, int(fields.width), int(fields.height), intrinsic, lens.model, lens.coefficients)
    return Intrinsics(check_camera(info, where, DriveError), turn)


def rectified_matrix(
    intrinsic: FloatArray, distortion: FloatArray, projection: FloatArray, where: str
) -> FloatArray:
    """The camera matrix (3, 3) of rectified images: of P (3, 4), or K of a lens without a distortion."""
    if projection.any():
        return projection[:, :3]
    if distortion.any():
        raise DriveError(
            f"{where}: states no P for its rectified images; set rectified: false beside it if they are as "
            "the lens makes them, or give a camera_info file that states P"
        )
    return intrinsic


def rectifying_turn(rotation: FloatArray, where: str) -> FloatArray:
    """The turn (3, 3) of rectified images, of R; none where R is zeros, for not stated."""
    return take_rotation(rotation.tolist(), where, DriveError) if rotation.any() else np.eye(3)


def info_numbers(fields: Any, key: str) -> FloatArray:
    """The numbers (N,) that a ``CameraInfo`` message has under a key of ROS 2, such as k, or of ROS 1: K."""
    values = getattr(fields, key, None)
    values = getattr(fields, key.upper()) if values is None else values
    return np.array(values, dtype=np.float64).reshape(-1)


def read_rectification(path: Path) -> FloatArray:
    """The turn (3, 3) of rectified images in a ``camera_info`` file that we wrote of a message."""
    content = load_yaml(path, DriveError)
    return take_matrix(content["rectification_matrix"], f"{path}: rectification_matrix")


def take_rotation(content: object, where: str, error: type[V2hdmError]) -> FloatArray:
    """``content`` as a rotation (3, 3); ``error`` where it is none."""
    rotation = take_array(content, (3, 3), where, error)
    limited = np.clip(rotation, -2.0, 2.0)  # larger numbers belong to no rotation, and their squares overflow
    if not (np.abs(limited @ limited.T - np.eye(3)).max() < _ROTATION_TOLERANCE < np.linalg.det(limited)):
        raise error(f"{where}: is not a rotation (rows of length 1, at right angles); fix it")
    return np.asarray(rotation)


IPM_NAMES = ("calibrated", "estimated")

_MOUNTING = ("xyz_m", "rpy_deg")
_SINGULAR = 1e-12  # least reciprocal condition number of an IPM, rows and columns scaled to unit norm; chosen
_ROTATION_TOLERANCE = 1e-4  # largest error of an entry of a rotation times its transpose; chosen
_LOWEST_CAMERA_M = 0.05  # least height of a camera above the ground, m: below, a transform seems inverted

_ROI_SAMPLES = 8  # points along each edge of a region of interest that are looked for in the image; chosen
_ROI_M = (2.0, 20.0)  # nearest and farthest distance ahead of the default region of interest, m; chosen
_ROI_HALF_WIDTH_M = 5.0  # half the width of the default region of interest, m; chosen
_STEEPEST_RAY = 0.999  # sine of the pitch, 87.4 deg, from which a camera counts as looking straight down


def take_ipm(content: object, where: str) -> FloatArray:
    """An invertible 3 x 3 homography ``vehicle_from_pinhole_px``, scaled to unit norm."""
    ipm = take_array(content, (3, 3), where, DriveError)
    ipm = ipm / max(float(np.abs(ipm).max()), np.finfo(float).tiny)  # squares of its numbers are numbers
    if _is_singular(ipm):
        raise DriveError(f"{where}: IPM matrix is not invertible; calibrate it from 4 or more point pairs")
    return np.asarray(ipm / np.linalg.norm(ipm))


def _is_singular(matrix: FloatArray) -> bool:
    if not (matrix.any(axis=0).all() and matrix.any(axis=1).all()):
        return True
    # Rows and columns of comparable norms: pixels and metres must not look singular.
    with np.errstate(all="ignore"):  # numbers so unlike that their squares are 0
        for axis in (1, 0) * 4:
            matrix = matrix / np.linalg.norm(matrix, axis=axis, keepdims=True)
    if not np.isfinite(matrix).all():
        return True
    return bool(1.0 / np.linalg.cond(matrix) < _SINGULAR)


def take_mounting(content: object, where: str) -> FloatArray:
    """``cam_from_vehicle`` (4, 4) of a camera's place in m and its roll, pitch (down), yaw (left) in deg."""
    entry = take_mapping(content, where, DriveError)
    check_keys(entry, _MOUNTING, (), where, DriveError)
    xyz_m, rpy_deg = (take_array(entry[key], (3,), f"{where}, {key}", DriveError) for key in _MOUNTING)
    return cam_from_mounting(xyz_m, np.deg2rad(rpy_deg))


def ipm_from_guess(info: CameraInfo, cam_from_vehicle: object, where: str, frame: str = "") -> FloatArray:
    """The IPM of a camera at the guessed rigid ``cam_from_vehicle`` (4 x 4), which is above the ground.

    ``frame`` is the vehicle's name for the frame that the guess counts from.
    """
    guess = take_rigid(cam_from_vehicle, where)
    centre_vehicle = camera_centre(guess)
    if centre_vehicle[2] < _LOWEST_CAMERA_M:
        raise DriveError(
            f"{where}: puts the camera {centre_vehicle[2]:.3g} m above the ground; if "
            f"{frame or 'the vehicle frame'} is higher than that, state vehicle_frame_height_m, its height; "
            "give cam_from_vehicle (vehicle points to camera points), not its inverse"
        )
    return ipm_from_extrinsic(info, guess)


def take_rigid(content: object, where: str) -> FloatArray:
    """``content`` as a rigid transform (4 x 4)."""
    transform = take_array(content, (4, 4), where, DriveError)
    rotation = transform[:3, :3]
    orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), atol=_ROTATION_TOLERANCE)
    if not orthonormal or np.linalg.det(rotation) < 0 or not np.array_equal(transform[3], [0, 0, 0, 1]):
        raise DriveError(f"{where}: not a rigid transform (rotation, translation, last row 0 0 0 1); fix it")
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
        raise DriveError(f"{where}: lies behind the camera; give ground in its view, x forward and y left")
    ahead = rays if (rays[:, 2] > 0).any() else -rays
    if not _in_image(info, ahead).any():
        raise DriveError(f"{where}: lies outside the image, according to the initial IPM; fix one of them")


def _in_image(info: CameraInfo, rays_cam: FloatArray) -> BoolArray:
    """Flags (N,) of the rays (N, 3) in the image."""
    across = np.linalg.norm(rays_cam[:, :2], axis=1)
    recorded = recorded_distance(info, np.arctan2(across, rays_cam[:, 2]))
    scale = np.where(across > 0, recorded / np.maximum(across, 1e-12), 0.0)
    pixels = np.column_stack([rays_cam[:, :2] * scale[:, None], np.ones(len(rays_cam))]) @ info.intrinsic.T
    inside = (pixels[:, :2] > -0.5) & (pixels[:, :2] < np.array([info.width, info.height]) - 0.5)
    return np.asarray(inside.all(axis=1) & (rays_cam[:, 2] > 0))


def roi_where_it_looks(info: CameraInfo, ipm: FloatArray, where: str) -> FloatArray:
    """The region of interest (4, 2) of a camera for which none is stated: a rectangle where it looks.

    DriveError where it sees no ground there: then its direction is wrong, which ``where`` states.
    """
    vehicle_from_cam = inverse(extrinsic_from_ipm(info, ipm))
    roi_vehicle = _roi_ahead(vehicle_from_cam)
    try:
        check_roi_in_view(info, ipm, roi_vehicle, where)
    except DriveError:
        up_deg = np.degrees(np.arcsin(np.clip(vehicle_from_cam[2, 2], -1.0, 1.0)))
        axis = f"{abs(up_deg):.0f} deg {'up' if up_deg > 0 else 'down'}"
        raise DriveError(
            f"{where}: its image shows no ground {_ROI_M[0]:g} to {_ROI_M[1]:g} m away, for its axis points "
            f"{axis}: fix its angles, which are 0 for a level look ahead; of a matrix or a frame, z is the "
            "way that the camera looks"
        ) from None
    return roi_vehicle


def _roi_ahead(vehicle_from_cam: FloatArray) -> FloatArray:
    forward = vehicle_from_cam[:2, 2]
    down = vehicle_from_cam[:2, 1]
    # A camera that looks straight down has its image's top ahead.
    along = forward if np.linalg.norm(forward) > np.sqrt(1 - _STEEPEST_RAY**2) else -down
    along = along / np.linalg.norm(along)
    left = np.array([-along[1], along[0]])
    (nearest_m, farthest_m) = _ROI_M
    half = _ROI_HALF_WIDTH_M
    corners = [(nearest_m, -half), (farthest_m, -half), (farthest_m, half), (nearest_m, half)]
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
        raise DriveError(
            f"{where}: initial_ipm {shown(initial)} is not given under ipm; choose from: {names}"
        )
    return initial
