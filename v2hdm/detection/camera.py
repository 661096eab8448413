"""What the detector works out once per camera: the band of rows with road in it, the lens, the ground.

Image points on the ground in metres, with the covariance that pixels and calibration leave them.

A camera on a vehicle as the detector takes it, from a finished calibration or from a rough description.

The pitch of a camera of which little is known, from the lines that its images show.

Lines painted along a road are parallel on the ground and meet on the horizon of the image. A line of the
image is u = p + q v in pinhole px, v down from the principal point. It passes through the vanishing point
(x, y) if p + q y = x, so that two lines of different slopes give both. Where the road bends its lines turn
together, which moves x alone. One vanishing point does not show the roll of the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.geometry.ipm import (
    apply_in_front,
    extrinsic_from_ipm,
    facing_ipm,
    ground_from_pinhole_px,
    homography_jacobian,
    ipm_from_extrinsic,
)
from v2hdm.geometry.lens import distort_points, has_distortion, undistort_points
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import (
    DISTORTION_COEFFICIENTS,
    BoolArray,
    Calibration,
    Camera,
    CameraInfo,
    FloatArray,
    LaneDetection,
)

_LUT_STEP_PX = 4
_HORIZON_MARGIN_PX = 16

FARTHEST_M = 60.0
"""Neither markings nor lines are looked for beyond this: networks are shown none beyond 50 m."""

_SURROUNDINGS_PX = 24
"""So far above the farthest ground what is there helps to tell what lies on it."""

FINE_ENOUGH_M = 0.007
"""Ground per pixel, across the view, of which half the resolution shows enough: a dash stays 10 px wide."""

ASIDE_RAD = np.deg2rad(60)
"""A camera that looks farther than this off the way that its vehicle drives, ahead or back, looks aside."""


class CameraView:
    """One camera as the detector sees it: fast lens and ground mappings, and the rows worth looking at.

    ``top`` and ``height`` are the band of image rows below the horizon of the camera's initial IPM
    (with a margin, since that IPM is coarse); ``height`` is a multiple of ``multiple`` where the
    image is tall enough. ``far_row``, by a multiple of ``multiple`` below ``top``, is the one from which on
    it is worth looking at for ground within :data:`FARTHEST_M`. From ``fine_row`` on (None if there is no
    such row) a pixel is less than :data:`FINE_ENOUGH_M` of ground wide. ``aside`` cameras look
    across the way that the vehicle drives. Points far from any lens singularity are assumed.
    """

    def __init__(self, camera: Camera, multiple: int = 16):
        self.camera = camera
        self.info = camera.info
        self.vehicle_from_pinhole_px: FloatArray = camera.ipm[camera.initial_ipm]
        self.pinhole_px_from_vehicle: FloatArray = np.asarray(np.linalg.inv(self.vehicle_from_pinhole_px))
        self._pinhole_lut = _build_pinhole_lut(camera) if has_distortion(camera.info) else None
        self._ground_from_pinhole_px = facing_ipm(
            self.vehicle_from_pinhole_px, camera.roi_vehicle.mean(axis=0)
        )
        cam_from_vehicle = extrinsic_from_ipm(self.info, self.vehicle_from_pinhole_px)
        ahead, left, _ = cam_from_vehicle[2, :3]
        self.aside = bool(np.arctan2(abs(left), abs(ahead)) > ASIDE_RAD)
        self.foot_vehicle = camera_centre(cam_from_vehicle)[:2]
        self.top, self.height = self._band_rows(multiple)
        spare = max(self.first_row_within(FARTHEST_M) - _SURROUNDINGS_PX - self.top, 0)
        self.far_row = self.top + spare // multiple * multiple
        self.fine_row = self._fine_row()

    def undistort(self, points_px: FloatArray) -> FloatArray:
        """Recorded pixels (N, 2) to pinhole pixels, from a table; within 1e-2 px of the lens model."""
        points = np.asarray(points_px, dtype=np.float64).reshape(-1, 2)
        if self._pinhole_lut is None or not len(points):
            return points.copy()
        rows, columns = self._pinhole_lut.shape[:2]
        cell = points / _LUT_STEP_PX
        first = np.minimum(np.maximum(np.floor(cell).astype(np.intp), 0), (columns - 2, rows - 2))
        right, down = np.hsplit(cell - first, 2)
        at = first[:, 0] + columns * first[:, 1]
        lut = self._pinhole_lut.reshape(-1, 2)
        upper = lut.take(at, axis=0) * (1 - right) + lut.take(at + 1, axis=0) * right
        at += columns
        lower = lut.take(at, axis=0) * (1 - right) + lut.take(at + 1, axis=0) * right
        return np.asarray(upper * (1 - down) + lower * down)

    def distort(self, points_pinhole_px: FloatArray) -> FloatArray:
        """Pinhole pixels (N, 2) to recorded pixels."""
        return distort_points(self.info, points_pinhole_px)

    def distort_jacobian(self, points_pinhole_px: FloatArray) -> FloatArray:
        """Derivative (N, 2, 2) of :meth:`distort`, by central differences over one pixel."""
        points = np.asarray(points_pinhole_px, dtype=np.float64).reshape(-1, 2)
        if self._pinhole_lut is None:
            return np.broadcast_to(np.eye(2), (len(points), 2, 2)).copy()
        steps = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
        moved = self.distort((points[:, None] + steps).reshape(-1, 2)).reshape(-1, 4, 2)
        return np.stack([moved[:, 0] - moved[:, 1], moved[:, 2] - moved[:, 3]], axis=2)

    def ground(self, points_pinhole_px: FloatArray) -> FloatArray:
        """Where pinhole pixels (N, 2) meet the ground, vehicle frame, m; NaN at and above the horizon."""
        points = np.asarray(points_pinhole_px, dtype=np.float64).reshape(-1, 2)
        return apply_in_front(self._ground_from_pinhole_px, points)

    def ground_jacobian(self, points_pinhole_px: FloatArray) -> FloatArray:
        """Derivative (N, 2, 2) of :meth:`ground`, m per px; NaN where that is NaN."""
        points = np.asarray(points_pinhole_px, dtype=np.float64).reshape(-1, 2)
        return homography_jacobian(self._ground_from_pinhole_px, points)

    def range_m(self, points_vehicle: FloatArray) -> FloatArray:
        """Distance on the ground from below the camera; NaN stays NaN."""
        return np.asarray(np.linalg.norm(points_vehicle - self.foot_vehicle, axis=-1))

    def coarse(self, rows_px: FloatArray) -> BoolArray:
        """Which rows (N,) lie so near that they are looked at in half the resolution."""
        first = np.inf if self.fine_row is None else self.fine_row
        return np.asarray(rows_px >= first)

    def inside(self, points_px: FloatArray, border_px: float) -> BoolArray:
        """Which recorded points (N, 2) lie at least ``border_px`` inside the image."""
        u, v = points_px[..., 0], points_px[..., 1]
        across = (u >= border_px) & (u <= self.info.width - 1 - border_px)
        return np.asarray(across & (v >= border_px) & (v <= self.info.height - 1 - border_px))

    def first_row_within(self, range_m: float) -> int:
        """The uppermost row of the band that shows ground within ``range_m`` of the camera's foot."""
        near = self.range_m(self._row_grid_vehicle()) <= range_m
        return max(self.top, int(np.argmax(near.any(axis=1)))) if near.any() else self.info.height

    def _row_grid_vehicle(self) -> FloatArray:
        """Ground points (H, 9, 2) of every row at nine columns, vehicle frame; nan above the horizon."""
        columns = np.linspace(0, self.info.width - 1, 9)
        rows = np.arange(self.info.height, dtype=np.float64)
        grid_px = np.stack(np.meshgrid(columns, rows), axis=-1)
        return self.ground(self.undistort(grid_px.reshape(-1, 2))).reshape(grid_px.shape)

    def _band_rows(self, multiple: int) -> tuple[int, int]:
        on_ground = np.any(np.isfinite(self._row_grid_vehicle()).all(axis=2), axis=1)
        first = int(np.argmax(on_ground))
        height = self.info.height - max(0, first - _HORIZON_MARGIN_PX)
        height = min(-(-height // multiple) * multiple, self.info.height)
        return self.info.height - height, height

    def _fine_row(self) -> int | None:
        middle = (self.info.width - 1) / 2
        rows = np.arange(self.top, self.info.height, dtype=np.float64)
        left, right = (
            self.ground(self.undistort(np.column_stack([np.full_like(rows, middle + side), rows])))
            for side in (-0.5, 0.5)
        )
        coarse = ~(np.linalg.norm(right - left, axis=1) <= FINE_ENOUGH_M)
        first = int(np.flatnonzero(coarse)[-1]) + 1 if coarse.any() else 0
        return self.top + first if first < len(rows) else None


def _build_pinhole_lut(camera: Camera) -> FloatArray:
    """Pinhole pixel of every ``_LUT_STEP_PX``-th recorded pixel, one cell beyond the image's far border."""
    columns = np.arange(0, camera.info.width + _LUT_STEP_PX, _LUT_STEP_PX, dtype=np.float64)
    rows = np.arange(0, camera.info.height + _LUT_STEP_PX, _LUT_STEP_PX, dtype=np.float64)
    grid_px = np.stack(np.meshgrid(columns, rows), axis=-1)
    return undistort_points(camera.info, grid_px.reshape(-1, 2)).reshape(*grid_px.shape)


@dataclass(frozen=True)
class GroundPoints:
    """Points on the ground plane: ``points_vehicle`` (N, 2), m, nan where a pixel shows no ground.

    ``by_px`` (N, 2, 2) and ``by_mounting`` (N, 2, 6) are their derivatives by the recorded pixel and by the
    tangent of ``cam_from_vehicle``, whose covariance is ``mounting_covariance`` (6, 6).
    """

    points_vehicle: FloatArray
    by_px: FloatArray
    by_mounting: FloatArray
    mounting_covariance: FloatArray

    def __getitem__(self, part: slice) -> GroundPoints:
        """Some of the points."""
        return GroundPoints(
            self.points_vehicle[part], self.by_px[part], self.by_mounting[part], self.mounting_covariance
        )

    def joint_covariance(self, covariance_px: FloatArray) -> FloatArray:
        """Covariance (2N, 2N), m^2, of the stacked points (x0, y0, x1, ...).

        ``covariance_px`` (2N, 2N) is that of their pixels (u0, v0, u1, ...). The rows and columns of points
        that are not on the ground are nan.
        """
        count = len(self.points_vehicle)
        blocks = np.zeros((count, 2, count, 2))
        blocks[range(count), :, range(count)] = self.by_px
        jacobian = blocks.reshape(2 * count, 2 * count)
        stacked = self.by_mounting.reshape(2 * count, 6)
        return np.asarray(
            jacobian @ covariance_px @ jacobian.T + stacked @ self.mounting_covariance @ stacked.T
        )

    def single_covariances(self, sigma_px: float | FloatArray) -> FloatArray:
        """Covariance (N, 2, 2), m^2, of each point, its pixel being off by ``sigma_px`` in u and v alike.

        ``sigma_px`` is one for all or one for each, (N,).
        """
        covariance = np.square(sigma_px)[..., None, None] * self.by_px @ np.swapaxes(self.by_px, 1, 2)
        return np.asarray(
            covariance + self.by_mounting @ self.mounting_covariance @ np.swapaxes(self.by_mounting, 1, 2)
        )


class Footprint:
    """Takes recorded pixels of one calibrated camera to the ground plane z = 0 of the vehicle.

    A pinhole pixel shows the ground point X where ``px(cam_from_vehicle X)`` equals it. Perturbing the pixel
    and, on the left, the transform, and holding that equality, gives ``dX = B (dpx - P [I | -[p]x] dxi)``,
    where ``P`` is the derivative of the projection at the camera point ``p`` and ``B`` the inverse of that
    along the ground.
    What is not in the covariance: how the vehicle's body pitches and rolls on its suspension, and that no
    road is a plane.

    Args:
        view: the camera.
        calibration: where it sits, and how well that is known; without covariance it counts as exact.
    """

    def __init__(self, view: CameraView, calibration: Calibration):
        self._view = view
        self._intrinsic = calibration.info.intrinsic
        self._cam_from_vehicle = calibration.cam_from_vehicle
        self._covariance = np.zeros((6, 6)) if calibration.covariance is None else calibration.covariance

    def of(self, points_px: FloatArray) -> GroundPoints:
        """Recorded pixels (N, 2) on the ground; best called once for all points of an image."""
        points_vehicle, by_px, by_mounting = self._linearised(points_px)
        return GroundPoints(points_vehicle, by_px, by_mounting, self._covariance)

    def _linearised(self, points_px: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Points (N, 2) and their derivatives by recorded pixel (N, 2, 2) and by the mounting (N, 2, 6)."""
        pinhole_px = self._view.undistort(points_px)
        points_vehicle = self._view.ground(pinhole_px)
        matrix = self._cam_from_vehicle
        cam = points_vehicle @ matrix[:3, :2].T + matrix[:3, 3]
        project = np.zeros((len(cam), 2, 3))
        project[:, :, :2] = self._intrinsic[:2, :2]
        project[:, :, 2] = self._intrinsic[:2, 2] - pinhole_px
        project /= cam[:, 2, None, None]
        by_pinhole = _inverse(project @ matrix[:3, :2])
        moved = np.zeros((len(cam), 3, 6))
        moved[:, range(3), range(3)] = 1.0
        x, y, z = cam.T
        moved[:, 0, 4], moved[:, 0, 5] = z, -y
        moved[:, 1, 3], moved[:, 1, 5] = -z, x
        moved[:, 2, 3], moved[:, 2, 4] = y, -x
        by_px = by_pinhole @ _inverse(self._view.distort_jacobian(pinhole_px))
        return points_vehicle, by_px, -by_pinhole @ project @ moved


def _inverse(matrices: FloatArray) -> FloatArray:
    """Inverses (N, 2, 2), by Cramer's rule so that nan stays where it is."""
    (a, b), (c, d) = matrices[:, 0].T, matrices[:, 1].T
    adjugate = np.stack([np.stack([d, -b], axis=1), np.stack([-c, a], axis=1)], axis=1)
    return np.asarray(adjugate / (a * d - b * c)[:, None, None])


_ROTATION_TOLERANCE = 1e-6
_BELOW_M = 0.1
_FARTHEST_M = 100.0


def camera_from_calibration(calibration: Calibration, linear_response: bool = False) -> Camera:
    """A camera whose IPM is the one of a finished calibration.

    Raises:
        MapFileError: the calibration cannot be that of a camera that looks at the ground.
    """
    _check(calibration)
    ipm = ipm_from_extrinsic(calibration.info, calibration.cam_from_vehicle)
    roi_vehicle = _seen_ground(calibration)
    return Camera(
        calibration.info, {"calibrated": ipm}, "calibrated", roi_vehicle, linear_response=linear_response
    )


def rough_calibration(
    name: str, width: int, height: int, height_m: float, pitch_deg: float, fov_deg: float
) -> Calibration:
    """A pinhole camera that looks straight ahead, for images of which nothing better is known.

    Good enough to tell markings by their rough size, not to measure with.

    Args:
        name: the camera's name.
        width: image width, px.
        height: image height, px.
        height_m: its height above the ground.
        pitch_deg: how far its axis points below the horizon.
        fov_deg: horizontal field of view.
    """
    focal_px = width / 2 / np.tan(np.deg2rad(fov_deg) / 2)
    intrinsic = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
    c, s = np.cos(np.deg2rad(pitch_deg)), np.sin(np.deg2rad(pitch_deg))
    cam_from_vehicle = np.eye(4)
    cam_from_vehicle[:3, :3] = [[0, -1, 0], [-s, 0, -c], [c, 0, -s]]
    cam_from_vehicle[:3, 3] = -cam_from_vehicle[:3, :3] @ [0, 0, height_m]
    return Calibration(CameraInfo(name, width, height, intrinsic), cam_from_vehicle)


def _seen_ground(calibration: Calibration) -> FloatArray:
    """A small square on the ground that the camera sees: around what the image's lowest row shows."""
    info = calibration.info
    below_px = np.array([[info.intrinsic[0, 2], info.height - 1.0]])
    ground = ground_from_pinhole_px(info.intrinsic, calibration.cam_from_vehicle)
    seen_vehicle = apply_in_front(ground, below_px)[0]
    if not np.isfinite(seen_vehicle).all():
        raise MapFileError(
            f"calibration of camera '{info.name}': the image's lowest row is above the horizon; "
            "mend cam_from_vehicle"
        )
    return np.asarray(seen_vehicle + _BELOW_M * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]))


def _check(calibration: Calibration) -> None:
    info, cam_from_vehicle = calibration.info, calibration.cam_from_vehicle
    rotation = cam_from_vehicle[:3, :3]
    focal_px = info.intrinsic[0, 0], info.intrinsic[1, 1]
    problem = None
    if info.distortion_model not in DISTORTION_COEFFICIENTS:
        known = ", ".join(DISTORTION_COEFFICIENTS)
        problem = f"unknown distortion_model '{info.distortion_model}'; known are {known}"
    elif len(info.distortion) != DISTORTION_COEFFICIENTS[info.distortion_model]:
        count = DISTORTION_COEFFICIENTS[info.distortion_model]
        problem = f"{info.distortion_model} has {count} coefficients, not {len(info.distortion)}; mend them"
    elif info.width < 1 or info.height < 1 or min(focal_px) <= 0:
        problem = "image size and focal lengths must be positive; mend them"
    elif np.abs(cam_from_vehicle).max() > _FARTHEST_M:
        problem = f"cam_from_vehicle puts the camera beyond {_FARTHEST_M:g} m from the vehicle; mend it"
    elif (
        np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROTATION_TOLERANCE
        or np.linalg.det(rotation) < 0
        or not np.array_equal(cam_from_vehicle[3], [0, 0, 0, 1])
    ):
        problem = "cam_from_vehicle is no rotation and translation; write it again with `python -m v2hdm.map`"
    elif camera_centre(cam_from_vehicle)[2] <= 0:
        problem = "cam_from_vehicle puts the camera on or under the ground; mend it"
    if problem:
        raise MapFileError(f"calibration of camera '{info.name}': {problem}")


_GUESS_SIGMA_RAD = np.deg2rad(6.0)
"""Standard deviation of a guess of the pitch."""

_PARALLEL_SIGMA_RAD = 0.015
"""Standard deviation of the directions of one road's lines; 0.012 rad in lanes/cluster, whose camera is
known."""

_POINT_SIGMA_PX = 1.0
"""Least standard deviation of a line beside its own points, px."""

_MOST_SIGMA_RAD = np.deg2rad(0.6)
"""A pitch of a larger standard deviation is not returned: of 80 up to 1 degree, ten were off by more than
that."""

_OUTLIER_SIGMAS = 2.0
"""Scale of Cauchy's loss: kerbs, arrows and letters point elsewhere."""

_STEPS = 20
_VOTES = 3
_AGREE_RAD = np.deg2rad(1.0)
"""A stream has the pitch that this number of images in a row gives within this range."""


@dataclass(frozen=True)
class Pitch:
    """How far a camera's axis points below the horizon, rad, and the standard deviation of that."""

    pitch_rad: float
    sigma_rad: float


def estimate_pitch(lanes: Sequence[LaneDetection], view: CameraView) -> Pitch | None:
    """The pitch of the camera from the lines found under a guess of it; None where they do not tell it.

    Args:
        lanes: Lines and pieces of paint of one image, or of several of the same camera.
        view: The camera as guessed; only its intrinsics and, weakly, its pitch are used.
    """
    lines = [line for lane in lanes if (line := _straight(lane, view)) is not None]
    focal_px = float(view.info.intrinsic[1, 1])
    guess_px = -focal_px * np.tan(guessed_pitch_rad(view))
    if len(lines) < 2:
        return None
    place, slope, covariance = (np.array(column) for column in zip(*lines, strict=True))
    x, y = float(np.median(place + slope * guess_px)), guess_px
    weight = np.ones(len(lines))
    for _ in range(_STEPS):
        design = np.column_stack([np.ones(len(lines)), -slope])
        gradient = np.array([1.0, y])
        model_px = _PARALLEL_SIGMA_RAD * focal_px * np.hypot(1, slope)
        variance = gradient @ covariance @ gradient + model_px**2
        weight = 1 / (1 + (place + slope * y - x) ** 2 / (variance * _OUTLIER_SIGMAS**2))
        rows = design * (weight / variance)[:, None]
        information = design.T @ rows + np.diag([0.0, (focal_px * _GUESS_SIGMA_RAD) ** -2])
        moment = rows.T @ place + [0.0, guess_px * (focal_px * _GUESS_SIGMA_RAD) ** -2]
        x, y = np.linalg.solve(information, moment).tolist()
    sigma_rad = float(np.sqrt(np.linalg.inv(information)[1, 1])) / focal_px
    return Pitch(float(np.arctan2(-y, focal_px)), sigma_rad) if sigma_rad < _MOST_SIGMA_RAD else None


@dataclass
class PitchVote:
    """Collects the pitch of each image of a stream that shows one, until several agree."""

    _told: list[float] = field(default_factory=list)
    _settled: bool = False

    def add(self, lanes: Sequence[LaneDetection], view: CameraView) -> float | None:
        """The pitch, rad, with the first image at which the last ones agree; None before and after that."""
        told = None if self._settled else estimate_pitch(lanes, view)
        if told is None:
            return None
        self._told.append(told.pitch_rad)
        last = self._told[-_VOTES:]
        self._settled = len(last) == _VOTES and float(np.ptp(last)) < _AGREE_RAD
        return float(np.mean(last)) if self._settled else None


def guessed_pitch_rad(view: CameraView) -> float:
    """The pitch of a camera as its view has it: how far its axis points below the horizon."""
    ahead = view.pinhole_px_from_vehicle[:, 0]
    direction = np.linalg.solve(view.info.intrinsic, ahead)
    return float(np.arctan2(-direction[1] * np.sign(direction[2]), abs(direction[2])))


def _straight(lane: LaneDetection, view: CameraView) -> tuple[float, float, FloatArray] | None:
    """A line's place on the principal point's row, its slope, and their covariance (2, 2); None if flat."""
    points = view.undistort(lane.points_px) - view.info.intrinsic[:2, 2]
    u, v = points.T
    down = v - v.mean()
    spread = float(down @ down)
    if len(points) < 3 or spread < 1.0:
        return None
    slope = float(down @ u) / spread
    rest = u - u.mean() - slope * down
    variance = max(float(rest @ rest) / len(points), _POINT_SIGMA_PX**2) * np.hypot(1, slope) ** 2
    variance_of_slope = variance * len(points) / spread
    # Neighbours err together: the scatter is taken as that of the mean, not of one point.
    from_mean = np.array([[1.0, -v.mean()], [0.0, 1.0]])
    covariance = from_mean @ np.diag([variance, variance_of_slope]) @ from_mean.T
    return float(u.mean() - slope * v.mean()), slope, covariance
