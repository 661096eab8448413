"""Cameras over the ground plane: inverse perspective mapping (IPM), projection, and mounting angles.

``vehicle_from_pinhole_px`` (3 x 3), the paper's H, maps pinhole pixels to the vehicle's plane z = 0; its
inverse is K [r1 r2 t] of ``cam_from_vehicle`` (Hartley and Zisserman, Multiple View Geometry, 2nd ed.,
eq. 8.1). :func:`pinhole_px_from_ground` and :func:`ground_from_pinhole_px` are signed so that the third
coordinate of ground in front of the camera is positive: the depth in m, or its inverse.
"""

from __future__ import annotations

import numpy as np

from v2hdm.geometry.rigid import (
    camera_centre,
    euler_from_rotation,
    exp,
    inverse,
    make_transform,
    rotation_from_euler,
)
from v2hdm.records import Camera, CameraInfo, FloatArray


def pinhole_px_from_ground(intrinsic: FloatArray, cam_from_ground: FloatArray) -> FloatArray:
    """Homography K [r1 r2 t] (..., 3, 3) from the plane z = 0 of a frame to pinhole pixels; K in px."""
    return np.asarray(intrinsic @ cam_from_ground[..., :3, :][..., [0, 1, 3]])


def ground_from_pinhole_px(intrinsic: FloatArray, cam_from_ground: FloatArray) -> FloatArray:
    """Inverse (..., 3, 3) of :func:`pinhole_px_from_ground`; LinAlgError for a centre on the ground."""
    return np.asarray(np.linalg.inv(pinhole_px_from_ground(intrinsic, cam_from_ground)), dtype=np.float64)


def ipm_from_extrinsic(info: CameraInfo, cam_from_vehicle: FloatArray) -> FloatArray:
    """IPM ``vehicle_from_pinhole_px`` (3 x 3, unit norm); LinAlgError for a camera centre on the ground."""
    ipm = ground_from_pinhole_px(info.intrinsic, cam_from_vehicle)
    return np.asarray(ipm / np.linalg.norm(ipm))


def extrinsic_from_ipm(info: CameraInfo, ipm: FloatArray) -> FloatArray:
    """The rigid ``cam_from_vehicle`` (4 x 4) nearest to an IPM (3 x 3), its camera above the ground.

    A homography from clicked points is not exactly K [r1 r2 t]. Its first two columns are replaced by their
    polar factor, the nearest orthonormal pair in the Frobenius norm (Zhang, A flexible new technique for
    camera calibration, 2000, appendix C), and the scale is the mean of their singular values.
    """
    columns = np.linalg.solve(info.intrinsic, np.linalg.inv(ipm))
    left, singular, right = np.linalg.svd(columns[:, :2], full_matrices=False)
    plane = left @ right
    translation = columns[:, 2] / singular.mean()
    normal = np.cross(plane[:, 0], plane[:, 1])
    sign = -1.0 if normal @ translation > 0 else 1.0
    cam_from_vehicle = np.eye(4)
    cam_from_vehicle[:3] = np.column_stack([sign * plane, normal, sign * translation])
    return cam_from_vehicle


def initial_extrinsic(camera: Camera) -> FloatArray:
    """The ``cam_from_vehicle`` (4, 4) nearest to the IPM that mapping starts from."""
    return extrinsic_from_ipm(camera.info, camera.ipm[camera.initial_ipm])


def facing_ipm(ipm: FloatArray, seen_vehicle: FloatArray) -> FloatArray:
    """The IPM (3 x 3) signed so that ground point ``seen_vehicle`` (2,), m, is in front of the camera."""
    # With ipm @ (u, v, 1) = w * ground, the solution is (u, v, 1) / w.
    in_front = np.linalg.solve(ipm, np.append(seen_vehicle, 1.0))[2] > 0
    return np.asarray(ipm if in_front else -ipm)


def flat_motion(dst_from_src: FloatArray) -> FloatArray:
    """Homography (..., 3, 3) that a planar motion (..., 4, 4) induces on the ground plane."""
    return np.asarray(dst_from_src[..., [0, 1, 3], :][..., [0, 1, 3]])


def apply_homography(dst_from_src: FloatArray, points_src: FloatArray) -> FloatArray:
    """Points (..., N, 2) mapped by a homography (..., 3, 3); at infinity inf or nan."""
    homogeneous = _homogeneous(dst_from_src, points_src)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(homogeneous[..., :2] / homogeneous[..., 2:])


def apply_in_front(dst_from_src: FloatArray, points_src: FloatArray) -> FloatArray:
    """:func:`apply_homography` for ground in front of the camera: nan on and above the horizon."""
    homogeneous = _homogeneous(dst_from_src, points_src)
    third = homogeneous[..., 2:]
    return np.asarray(homogeneous[..., :2] / np.where(third > 0, third, np.nan))


def homography_jacobian(dst_from_src: FloatArray, points_src: FloatArray) -> FloatArray:
    """Derivative (..., N, 2, 2) of :func:`apply_in_front` by the points; nan where the point is."""
    homogeneous = _homogeneous(dst_from_src, points_src)
    third = np.where(homogeneous[..., 2:] > 0, homogeneous[..., 2:], np.nan)
    mapped = (homogeneous[..., :2] / third)[..., None]
    slope = dst_from_src[..., None, :2, :2] - mapped * dst_from_src[..., None, 2:, :2]
    return np.asarray(slope / third[..., None])


def project_ground(
    intrinsic: FloatArray, cam_from_ground: FloatArray, points_ground: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pinhole pixels (..., N, 2) and depths (..., N), m, of ground points (..., N, 2), m.

    Behind the camera, at negative depth, they are pixels of the mirror image; at depth zero inf or nan.
    """
    homogeneous = _homogeneous(pinhole_px_from_ground(intrinsic, cam_from_ground), points_ground)
    depth_m = homogeneous[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(homogeneous[..., :2] / depth_m[..., None]), np.asarray(depth_m)


def direction_covariance(ray_ground: FloatArray, height_m: FloatArray, sigma_rad: float) -> FloatArray:
    """Covariance (..., 2, 2), m^2, of a ground point from an uncertain viewing direction.

    ``ray_ground`` (..., 2), m, leads from the camera's nadir to the point; ``sigma_rad`` is that of pitch and
    yaw. At height h and range r a pitch by d moves the point along the ray by (r^2 + h^2) / h * d,
    a yaw across it by r * d.
    """
    range_m = np.linalg.norm(ray_ground, axis=-1)
    return ray_covariance(ray_ground, (range_m**2 + height_m**2) / height_m * sigma_rad, range_m * sigma_rad)


def ray_covariance(ray_ground: FloatArray, along_m: FloatArray, across_m: FloatArray) -> FloatArray:
    """Covariances (..., 2, 2) of points with standard deviations (...) along and across rays (..., 2)."""
    along = ray_ground / np.maximum(np.linalg.norm(ray_ground, axis=-1, keepdims=True), 1e-9)
    outer = along[..., :, None] * along[..., None, :]
    along_m2 = np.square(along_m)[..., None, None]
    across_m2 = np.square(across_m)[..., None, None]
    return np.asarray(along_m2 * outer + across_m2 * (np.eye(2) - outer))


def _homogeneous(dst_from_src: FloatArray, points_src: FloatArray) -> FloatArray:
    """Points (..., N, 2) mapped by a homography (..., 3, 3), before the division: (..., N, 3)."""
    transposed = np.swapaxes(dst_from_src, -1, -2)
    return np.asarray(points_src @ transposed[..., :2, :] + transposed[..., 2:, :])


LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Columns: right, down and forward of a camera that looks along x, in forward-left-up axes."""


def mounting_angles(cam_from_vehicle: FloatArray) -> FloatArray:
    """Roll, pitch (down) and yaw (left), rad, about x, y, z: 0 for a camera looking along the vehicle's x."""
    return euler_from_rotation(cam_from_vehicle[:3, :3].T @ LEVEL.T)


def cam_from_mounting(xyz_m: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """``cam_from_vehicle`` (4, 4) of a camera with centre ``xyz_m`` (3,) and :func:`mounting_angles` (3,)."""
    roll_rad, pitch_rad, yaw_rad = np.asarray(angles_rad)[:, None]
    turn = rotation_from_euler(roll_rad, pitch_rad, yaw_rad)[0]
    return inverse(make_transform(turn @ LEVEL, xyz_m))


def angle_sigmas(cam_from_vehicle: FloatArray, covariance: FloatArray) -> FloatArray:
    """Standard deviations (3,) of :func:`mounting_angles`, rad; ``covariance`` (6, 6) of the left tangent."""
    step = 1e-6
    moved = [mounting_angles(exp(step * axis) @ cam_from_vehicle) for axis in np.eye(6)[3:]]
    jacobian = (np.array(moved) - mounting_angles(cam_from_vehicle)).T / step
    return np.asarray(np.sqrt(np.diag(jacobian @ covariance[3:, 3:] @ jacobian.T)))


def centre_sigmas(cam_from_vehicle: FloatArray, covariance: FloatArray) -> FloatArray:
    """Standard deviations (3,) of the centre in vehicle axes, m; ``covariance`` is the left tangent's."""
    # A left perturbation (v, w) of cam_from_vehicle moves the centre by -R'v.
    to_vehicle = cam_from_vehicle[:3, :3].T
    return np.asarray(np.sqrt(np.diag(to_vehicle @ covariance[:3, :3] @ to_vehicle.T)))


def mounting_words(cam_from_vehicle: FloatArray, covariance: FloatArray) -> tuple[list[str], list[str]]:
    """Roll, pitch and yaw, and forward, left and height of the centre, each with its standard deviation."""
    angles = np.degrees(mounting_angles(cam_from_vehicle))
    angle_sigma = np.degrees(angle_sigmas(cam_from_vehicle, covariance))
    centre = camera_centre(cam_from_vehicle)
    centre_sigma = centre_sigmas(cam_from_vehicle, covariance)
    turned = zip(("roll", "pitch", "yaw"), angles, angle_sigma, strict=True)
    placed = zip(("forward", "left", "height"), centre, centre_sigma, strict=True)
    return (
        [f"{word} {angle:.2f} +- {sigma:.2f} deg" for word, angle, sigma in turned],
        [f"{word} {value:.3f} +- {sigma:.3f} m" for word, value, sigma in placed],
    )
