"""A camera over a road: its lens, the ground that its pixels show, its horizon, and where it is mounted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from v2hdm.errors import MapFileError, shown
from v2hdm.geometry.ipm import (
    apply_homography,
    apply_in_front,
    extrinsic_from_ipm,
    facing_ipm,
    ground_from_pinhole_px,
    homography_jacobian,
    ipm_from_extrinsic,
)
from v2hdm.geometry.lens import distort_jacobian, distort_points, has_distortion, undistort_points
from v2hdm.geometry.planar import cross
from v2hdm.geometry.rigid import camera_centre
from v2hdm.native import kernels
from v2hdm.records import DISTORTION_COEFFICIENTS, BoolArray, Calibration, Camera, CameraInfo, FloatArray

LUT_STEP_PX = 4  # distance between the nodes of the table of the lens, px
_HORIZON_MARGIN_PX = 16  # rows above the horizon of the initial IPM that are looked at

FARTHEST_M = 60.0  # distance, m, beyond which nothing is looked for: networks are shown none beyond 50 m
_SURROUNDINGS_PX = 24  # rows above the farthest ground that help to classify what lies on it

FINE_ENOUGH_M = 0.007
"""Ground per pixel, across the view, of which half the resolution shows enough: a dash stays 10 px wide.

With 0.010 an image costs a tenth less and 160 images of ports 1 and 2 (seeds 9001 and 9002) show as much.
But the worn head of an arrow becomes a diamond of the map of port 2, 31 of 38 lane lines of PandaSet's front
camera lie on paint instead of 46 of 50, and kept photographs show 0.073 instead of 0.053 false symbols each.
They name four more of 42 large diamonds, whose cameras are nearer to the ground than was assumed.
"""

ASIDE_RAD = np.deg2rad(60)
"""A camera that looks farther than this off the way that its vehicle drives, ahead or back, looks aside."""

_STANDING_RAD = np.deg2rad(3.0)
"""By which what stands may point beside the camera's foot, one sigma. Of 2 to 12 deg this tells arrows of
photographs best from what is named so (the least log loss)."""

_BESIDE_RAD = np.deg2rad(20.0)  # off the vehicle's way from which what stands is told from what lies along it

_LEAST_BELOW_PX = 4.0  # distance below the horizon, px, nearer than which nothing is known of the ground
_CURVE_UNIT_PX = 100.0  # unit of the distance below the horizon in lanes' curves: their parameters are alike
_PROBE_PX = 50.0  # distance below the horizon, px, at which the width of a metre of ground is measured

_ROTATION_TOLERANCE = 1e-6  # largest error of R R' - 1 of a stated rotation R
_SIGMAS = 2.0  # standard deviations of a guessed focal length within which it surely is
_BELOW_M = 0.1  # half the side, m, of the region of interest about the ground that the lowest pixel shows
_FARTHEST_MOUNT_M = 100.0  # largest coordinate of a camera on its vehicle, m


class Lens:
    """A lens with a table of its distortion, which cameras of one lens share."""

    def __init__(self, info: CameraInfo):
        self.info = info

    @cached_property
    def table(self) -> FloatArray:
        """The pinhole pixel of every few recorded ones and its slopes (rows, columns, 2, 4).

        The last are one cell beyond the image's border. What is read together lies together.
        """
        columns = np.arange(0.0, self.info.width + LUT_STEP_PX, LUT_STEP_PX)
        rows = np.arange(0.0, self.info.height + LUT_STEP_PX, LUT_STEP_PX)
        grid_px = np.stack(np.meshgrid(columns, rows), axis=-1)
        node = undistort_points(self.info, grid_px.reshape(-1, 2)).reshape(grid_px.shape)
        by_right = np.diff(node, axis=1)[:-1]
        by_down = np.diff(node, axis=0)
        return np.stack([node[:-1, :-1], by_right, by_down[:, :-1], np.diff(by_down, axis=1)], axis=-1)


class RoadCamera:
    """One camera with fast lens and ground mappings, and the image rows to search.

    Recorded pixels are those of the image, pinhole pixels those without distortion; points far from any lens
    singularity are assumed. ``top`` is the first image row below the horizon of the initial IPM, with a
    margin; from there on rows are a multiple of ``multiple`` where the image is tall enough. From
    ``far_row``, a multiple of it below ``top``, ground within :data:`FARTHEST_M` shows. From ``fine_row``
    (None if none) a pixel is less than :data:`FINE_ENOUGH_M` of ground wide. ``aside`` cameras look across
    the way that the vehicle drives. ``foot_vehicle`` (2,) lies below the camera.
    """

    def __init__(
        self,
        camera: Camera,
        multiple: int = 16,
        lens: Lens | None = None,
    ):
        self.camera = camera
        self.info = camera.info
        self.lens = lens if lens is not None and lens.info is camera.info else Lens(camera.info)
        self.vehicle_from_pinhole_px: FloatArray = camera.ipm[camera.initial_ipm]
        self.pinhole_px_from_vehicle: FloatArray = np.asarray(np.linalg.inv(self.vehicle_from_pinhole_px))
        self.distorted = has_distortion(camera.info)
        self._ground_from_pinhole_px = facing_ipm(
            self.vehicle_from_pinhole_px, camera.roi_vehicle.mean(axis=0)
        )
        cam_from_vehicle = extrinsic_from_ipm(self.info, self.vehicle_from_pinhole_px)
        ahead, left, _ = cam_from_vehicle[2, :3]
        self.aside = bool(np.arctan2(abs(left), abs(ahead)) > ASIDE_RAD)
        centre = camera_centre(cam_from_vehicle)
        self.foot_vehicle = centre[:2]
        self._height_m = float(centre[2])
        on_ground = np.any(np.isfinite(self._row_grid_vehicle()).all(axis=2), axis=1)
        height = self.info.height - max(0, int(np.argmax(on_ground)) - _HORIZON_MARGIN_PX)
        self.top = self.info.height - min(-(-height // multiple) * multiple, self.info.height)
        spare = max(self.first_row_within(self.perhaps_m(FARTHEST_M)) - _SURROUNDINGS_PX - self.top, 0)
        self.far_row = self.top + spare // multiple * multiple
        self.fine_row = self._fine_row()

    def undistort(self, points_px: FloatArray) -> FloatArray:
        """Recorded pixels (N, 2) to pinhole pixels, from a table; within 1e-2 px of the lens model."""
        points = np.array(points_px, dtype=np.float64, order="C").reshape(-1, 2)
        if not self.distorted or not len(points):
            return points
        table = self.lens.table
        compiled = kernels()
        if compiled is not None:
            compiled.undistort(points, table, LUT_STEP_PX)
            return points
        rows, columns = table.shape[:2]
        u, v = points.T / LUT_STEP_PX
        column = np.clip(u.astype(np.intp), 0, columns - 1)
        row = np.clip(v.astype(np.intp), 0, rows - 1)
        right = u - column
        down = v - row
        cells = table.reshape(-1, 8).take(columns * row + column, axis=0).reshape(-1, 2, 4)
        for axis in (0, 1):
            corner, by_right, by_down, by_right_and_down = cells[:, axis].T
            points[:, axis] = corner + by_right * right + (by_down + by_right_and_down * right) * down
        return points

    def distort(self, points_pinhole_px: FloatArray) -> FloatArray:
        """Pinhole pixels (N, 2) to recorded pixels."""
        return distort_points(self.info, points_pinhole_px)

    def distort_jacobian(self, points_pinhole_px: FloatArray) -> FloatArray:
        """Derivative (N, 2, 2) of :meth:`distort`."""
        points = np.asarray(points_pinhole_px, dtype=np.float64).reshape(-1, 2)
        if not self.distorted:
            return np.broadcast_to(np.eye(2), (len(points), 2, 2)).copy()
        return distort_jacobian(self.info, points)

    def ground(self, points_pinhole_px: FloatArray) -> FloatArray:
        """Where pinhole pixels (N, 2) meet the ground, vehicle frame, m; NaN at and above the horizon."""
        return apply_in_front(self._ground_from_pinhole_px, points_pinhole_px)

    def ground_jacobian(self, points_pinhole_px: FloatArray) -> FloatArray:
        """Derivative (N, 2, 2) of :meth:`ground`, m per px; NaN where that is NaN."""
        return homography_jacobian(self._ground_from_pinhole_px, points_pinhole_px)

    def unproject(self, points_px: FloatArray) -> FloatArray:
        """Where recorded pixels (..., 2) meet the ground, vehicle frame, m; NaN at and above the horizon."""
        return self.ground(self.undistort(points_px.reshape(-1, 2))).reshape(points_px.shape)

    def project(self, points_vehicle: FloatArray) -> FloatArray:
        """Ground points (N, 2), m, as recorded pixels (N, 2)."""
        return self.distort(apply_homography(self.pinhole_px_from_vehicle, points_vehicle))

    def range_m(self, points_vehicle: FloatArray) -> FloatArray:
        """Distance on the ground from below the camera; NaN stays NaN."""
        return np.asarray(np.linalg.norm(points_vehicle - self.foot_vehicle, axis=-1))

    def perhaps_m(self, range_m: float) -> float:
        """The distance of what may lie within a range, as the focal length is known."""
        return float(range_m * np.exp(_SIGMAS * self.camera.mounting_sigma[1]))

    def log_size_sigma(self, range_m: FloatArray) -> FloatArray:
        """Standard deviation of the logarithm of lengths on the ground at distances, m.

        Along the view they are h f / v^2 per px at v px below the horizon; across it half of that part is
        left.
        """
        horizon_rad, log_focal = self.camera.mounting_sigma
        return np.hypot(2 * horizon_rad * range_m / self._height_m, log_focal)

    def standing(self, points_vehicle: FloatArray, ahead: FloatArray) -> FloatArray:
        """How much (N,) lines at ground points (N, 2) look like edges of what stands, 0 to 1.

        Upright edges point to the camera's foot. Their directions ``ahead`` (N, 2) are of unit length. Along
        the vehicle's way, its x axis, lines of paint point there, too, and nothing is told.
        """
        from_foot = points_vehicle - self.foot_vehicle
        radial = from_foot / np.maximum(np.linalg.norm(from_foot, axis=1, keepdims=True), 1e-9)
        off = cross(radial, ahead) / np.sin(_STANDING_RAD)
        beside = np.minimum(np.abs(radial[:, 1]) / np.sin(_BESIDE_RAD), 1.0)
        return np.asarray(beside**2 * np.exp(-0.5 * off**2))

    def coarse(self, rows_px: FloatArray) -> BoolArray:
        """Which rows (N,) lie so near that they are looked at in half the resolution."""
        return np.asarray(rows_px >= (np.inf if self.fine_row is None else self.fine_row))

    def inside(self, points_px: FloatArray, border_px: float) -> BoolArray:
        """Which recorded points (..., 2) lie at least ``border_px`` inside the image."""
        u = points_px[..., 0]
        v = points_px[..., 1]
        across = (u >= border_px) & (u <= self.info.width - 1 - border_px)
        return np.asarray(across & (v >= border_px) & (v <= self.info.height - 1 - border_px))

    def footprint(self, points_px: FloatArray, calibration: Calibration) -> GroundPoints:
        """Recorded pixels (N, 2) on the ground with their derivatives; best called once for all of an image.

        A pinhole pixel shows the ground point X where ``px(cam_from_vehicle X)`` equals it. Perturbing the
        pixel and, on the left, the transform, and holding that equality, gives ``dX = B (dpx - P [I | -[p]x]
        dxi)``, where ``P`` is the derivative of the projection at the camera point ``p`` and ``B`` the
        inverse of that along the ground. Left out is how the vehicle's body pitches and rolls on
        its suspension, and that no road is a plane.
        """
        pinhole_px = self.undistort(points_px)
        points_vehicle = self.ground(pinhole_px)
        intrinsic = calibration.info.intrinsic
        matrix = calibration.cam_from_vehicle
        cam = points_vehicle @ matrix[:3, :2].T + matrix[:3, 3]
        pinhole_by_cam = np.zeros((len(cam), 2, 3))
        pinhole_by_cam[:, :, :2] = intrinsic[:2, :2]
        pinhole_by_cam[:, :, 2] = intrinsic[:2, 2] - pinhole_px
        pinhole_by_cam /= cam[:, 2, None, None]
        by_pinhole = _inverse(pinhole_by_cam @ matrix[:3, :2])
        cam_by_mounting = np.zeros((len(cam), 3, 6))
        cam_by_mounting[:, range(3), range(3)] = 1.0
        x, y, z = cam.T
        cam_by_mounting[:, 0, 4] = z
        cam_by_mounting[:, 0, 5] = -y
        cam_by_mounting[:, 1, 3] = -z
        cam_by_mounting[:, 1, 5] = x
        cam_by_mounting[:, 2, 3] = y
        cam_by_mounting[:, 2, 4] = -x
        return GroundPoints(
            points_vehicle=points_vehicle,
            by_px=by_pinhole @ _inverse(self.distort_jacobian(pinhole_px)),
            by_mounting=-by_pinhole @ pinhole_by_cam @ cam_by_mounting,
            mounting_covariance=np.zeros((6, 6))
            if calibration.covariance is None
            else calibration.covariance,
        )

    @cached_property
    def horizon(self) -> Horizon:
        """The camera's horizon."""
        return Horizon(self)

    def first_row_within(self, range_m: float) -> int:
        """The uppermost row from ``top`` on that shows ground within ``range_m`` of the camera's foot."""
        is_within = self.range_m(self._row_grid_vehicle()) <= range_m
        return max(self.top, int(np.argmax(is_within.any(axis=1)))) if is_within.any() else self.info.height

    def _row_grid_vehicle(self) -> FloatArray:
        """Ground points (H, 9, 2) of every row at nine columns, vehicle frame; nan above the horizon."""
        columns = np.linspace(0, self.info.width - 1, 9)
        rows = np.arange(self.info.height, dtype=np.float64)
        return self.unproject(np.stack(np.meshgrid(columns, rows), axis=-1))

    def _fine_row(self) -> int | None:
        """The first row from which on a pixel is less than :data:`FINE_ENOUGH_M` of ground wide, if any."""
        rows = np.arange(self.top, self.info.height, dtype=np.float64)
        columns = (self.info.width - 1) / 2 + np.array([-0.5, 0.5])
        ends = self.unproject(np.stack(np.meshgrid(columns, rows), axis=-1))
        coarse = ~(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) <= FINE_ENOUGH_M)
        first = int(np.flatnonzero(coarse)[-1]) + 1 if coarse.any() else 0
        return self.top + first if first < len(rows) else None


@dataclass(frozen=True)
class GroundPoints:
    """Points on the ground plane and their derivatives."""

    points_vehicle: FloatArray  # (N, 2) m, nan where a pixel shows no ground
    by_px: FloatArray  # (N, 2, 2) by the recorded pixel
    by_mounting: FloatArray  # (N, 2, 6) by the tangent of ``cam_from_vehicle``
    mounting_covariance: FloatArray  # (6, 6) of that

    def __getitem__(self, part: slice) -> GroundPoints:
        """Some of the points."""
        return GroundPoints(
            points_vehicle=self.points_vehicle[part],
            by_px=self.by_px[part],
            by_mounting=self.by_mounting[part],
            mounting_covariance=self.mounting_covariance,
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
        mounting = stacked @ self.mounting_covariance @ stacked.T
        return np.asarray(jacobian @ covariance_px @ jacobian.T + mounting)

    def single_covariances(self, sigma_px: float | FloatArray) -> FloatArray:
        """Covariance (N, 2, 2), m^2, of points whose pixels are off by ``sigma_px``, one or (N,)."""
        covariance = np.square(sigma_px)[..., None, None] * self.by_px @ np.swapaxes(self.by_px, 1, 2)
        mounting = self.by_mounting @ self.mounting_covariance @ np.swapaxes(self.by_mounting, 1, 2)
        return np.asarray(covariance + mounting)


def _inverse(matrices: FloatArray) -> FloatArray:
    """Inverses (N, 2, 2), by Cramer's rule so that nan stays where it is."""
    a, b = matrices[:, 0].T
    c, d = matrices[:, 1].T
    adjugate = np.stack([np.stack([d, -b], axis=1), np.stack([-c, a], axis=1)], axis=1)
    return np.asarray(adjugate / (a * d - b * c)[:, None, None])


class Horizon:
    """Pinhole pixels of one camera in axes along and below its horizon.

    ``centre_px`` is where along the horizon the camera looks. ``px_per_m`` is how many px along the horizon a
    metre of ground is wide at one px below it; it grows in proportion.
    """

    def __init__(self, camera: RoadCamera):
        row = camera.vehicle_from_pinhole_px[2]
        lowest = np.array([[(camera.info.width - 1) / 2, camera.info.height - 1.0]])
        sign = np.sign(float(row[:2] @ lowest[0] + row[2]))
        sign = sign if np.isfinite(camera.ground(lowest)).all() else -sign
        size = max(float(np.linalg.norm(row[:2])), 1e-12)
        self._down = sign * row[:2] / size
        self._along = np.array([self._down[1], -self._down[0]])
        self._shift = float(sign * row[2] / size)
        intrinsic = camera.info.intrinsic
        self.centre_px = float(self.coordinates(intrinsic[None, :2, 2])[0][0])
        beside = self.pinhole_px(self.centre_px + np.array([-0.5, 0.5]), np.full(2, _PROBE_PX))
        ground = camera.ground(beside)
        probe_px_per_m = 1.0 / max(float(np.linalg.norm(ground[1] - ground[0])), 1e-9)
        self.px_per_m = probe_px_per_m / _PROBE_PX
        range_m = float(camera.range_m(ground.mean(axis=0)))
        by_curvature = 0.5 * range_m**2 * probe_px_per_m * _PROBE_PX / _CURVE_UNIT_PX
        self._units = np.array([float(intrinsic[0, 0]), self.px_per_m * _CURVE_UNIT_PX, by_curvature])

    def parameters(self, line: tuple[float, float, float]) -> FloatArray:
        """The a, b and c (3,) of a line by direction, rad, place beside the camera, m, and curvature, 1/m."""
        return self._units * line

    def basis(self, below: FloatArray) -> FloatArray:
        """The factors (N, 3) of a curve's a, b and c at distances (N,) below the horizon, px."""
        v = np.maximum(below, _LEAST_BELOW_PX) / _CURVE_UNIT_PX
        phi = np.ones((len(v), 3))
        phi[:, 1] = v
        phi[:, 2] = 1.0 / v
        return phi

    def depth_m(self, below: FloatArray) -> FloatArray:
        """How far ahead of the camera the ground is (N,), m, at distances (N,) below the horizon, px."""
        return np.asarray(self._units[0] / (self.px_per_m * np.maximum(below, _LEAST_BELOW_PX)))

    def below_px(self, depth_m: float) -> float:
        """How far below the horizon, px, the ground at a depth is: the inverse of :meth:`depth_m`."""
        return float(self._units[0] / (self.px_per_m * depth_m))

    def coordinates(self, pinhole_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Position along (N,) and below (N,) the horizon, px, of pinhole pixels (N, 2)."""
        return pinhole_px @ self._along, pinhole_px @ self._down + self._shift

    def pinhole_px(self, along: FloatArray, below: FloatArray) -> FloatArray:
        """The pinhole pixels (N, 2) of :meth:`coordinates`."""
        return np.asarray(along[:, None] * self._along + (below - self._shift)[:, None] * self._down)


def camera_from_calibration(
    calibration: Calibration, linear_response: bool = False, mounting_sigma: tuple[float, float] = (0.0, 0.0)
) -> Camera:
    """A camera of a calibration that is ``mounting_sigma`` off; MapFileError where it sees no ground."""
    info = calibration.info
    cam_from_vehicle = calibration.cam_from_vehicle
    problem = _problem(calibration)
    if not problem:
        below_px = np.array([[info.intrinsic[0, 2], info.height - 1.0]])
        lowest = apply_in_front(ground_from_pinhole_px(info.intrinsic, cam_from_vehicle), below_px)[0]
        if not np.isfinite(lowest).all():
            problem = "the image's bottom row is above the horizon; fix cam_from_vehicle"
    if problem:
        raise MapFileError(f"calibration of camera '{info.name}': {problem}")
    ipm = ipm_from_extrinsic(info, cam_from_vehicle)
    roi_vehicle = lowest + _BELOW_M * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    camera = Camera(info, {"calibrated": ipm}, "calibrated", roi_vehicle)
    return replace(camera, linear_response=linear_response, mounting_sigma=mounting_sigma)


def rough_calibration(
    name: str,
    width: int,
    height: int,
    height_m: float,
    pitch_deg: float,
    fov_deg: float,
    roll_deg: float = 0.0,
) -> Calibration:
    """A pinhole camera that looks straight ahead, for images without a calibration.

    ``pitch_deg`` is below the horizon, ``fov_deg`` horizontal; ``roll_deg`` turns the image's right side
    down, on which the horizon then rises.
    """
    focal_px = width / 2 / np.tan(np.deg2rad(fov_deg) / 2)
    intrinsic = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
    c = np.cos(np.deg2rad(pitch_deg))
    s = np.sin(np.deg2rad(pitch_deg))
    pitched = np.array([[0, -1, 0], [-s, 0, -c], [c, 0, -s]])
    c = np.cos(np.deg2rad(roll_deg))
    s = np.sin(np.deg2rad(roll_deg))
    rolled = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    cam_from_vehicle = np.eye(4)
    cam_from_vehicle[:3, :3] = rolled @ pitched
    cam_from_vehicle[:3, 3] = -cam_from_vehicle[:3, :3] @ [0, 0, height_m]
    return Calibration(CameraInfo(name, width, height, intrinsic), cam_from_vehicle)


def _problem(calibration: Calibration) -> str | None:
    """The reason why a calibration cannot be used, if there is one."""
    info = calibration.info
    cam_from_vehicle = calibration.cam_from_vehicle
    rotation = cam_from_vehicle[:3, :3]
    count = DISTORTION_COEFFICIENTS.get(info.distortion_model)
    if count is None:
        models = ", ".join(DISTORTION_COEFFICIENTS)
        return f"unknown distortion_model {shown(info.distortion_model)}; known are {models}"
    if len(info.distortion) != count:
        return f"{info.distortion_model} has {count} coefficients, not {len(info.distortion)}; fix them"
    if info.width < 1 or info.height < 1 or min(info.intrinsic[0, 0], info.intrinsic[1, 1]) <= 0:
        return "image size and focal lengths must be positive; fix them"
    if np.abs(cam_from_vehicle).max() > _FARTHEST_MOUNT_M:
        return f"cam_from_vehicle puts the camera beyond {_FARTHEST_MOUNT_M:g} m from the vehicle; fix it"
    rigid = np.abs(rotation @ rotation.T - np.eye(3)).max() <= _ROTATION_TOLERANCE
    if not rigid or np.linalg.det(rotation) < 0 or not np.array_equal(cam_from_vehicle[3], [0, 0, 0, 1]):
        return "cam_from_vehicle is not a rotation and translation; write it again with `python -m v2hdm.map`"
    if camera_centre(cam_from_vehicle)[2] <= 0:
        return "cam_from_vehicle puts the camera on or under the ground; fix it"
    return None
