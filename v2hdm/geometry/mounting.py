"""How a camera sits on its vehicle, as angles and lengths that people read."""

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
from v2hdm.records import FloatArray

LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Columns: the right, down and forward of a camera that looks along x, in a frame of forward, left and up."""


def mounting_angles(cam_from_vehicle: FloatArray) -> FloatArray:
    """Roll, pitch (down) and yaw (left), rad, about x, y, z: 0 where it looks along the vehicle's x axis."""
    return euler_from_rotation(cam_from_vehicle[:3, :3].T @ LEVEL.T)


def cam_from_mounting(xyz_m: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """``cam_from_vehicle`` (4, 4) of a camera with centre ``xyz_m`` (3,) and :func:`mounting_angles` (3,)."""
    turn = rotation_from_euler(*np.asarray(angles_rad)[:, None])[0]
    return inverse(make_transform(turn @ LEVEL, xyz_m))


def angle_sigmas(cam_from_vehicle: FloatArray, covariance: FloatArray) -> FloatArray:
    """Standard deviations (3,) of :func:`mounting_angles`, rad, from the left tangent's covariance (6, 6)."""
    step = 1e-6
    moved = [mounting_angles(exp(step * axis) @ cam_from_vehicle) for axis in np.eye(6)[3:]]
    jacobian = (np.array(moved) - mounting_angles(cam_from_vehicle)).T / step
    return np.asarray(np.sqrt(np.diag(jacobian @ covariance[3:, 3:] @ jacobian.T)))


def centre_sigmas(cam_from_vehicle: FloatArray, covariance: FloatArray) -> FloatArray:
    """Standard deviations (3,) of the camera's centre along the vehicle's axes, m; arguments as above."""
    # A left perturbation (v, w) of cam_from_vehicle moves the centre by -R'v.
    to_vehicle = cam_from_vehicle[:3, :3].T
    return np.asarray(np.sqrt(np.diag(to_vehicle @ covariance[:3, :3] @ to_vehicle.T)))


def mounting_words(cam_from_vehicle: FloatArray, covariance: FloatArray) -> tuple[list[str], list[str]]:
    """Roll, pitch and yaw, and the place forward, left and height, each with its standard deviation."""
    angles = np.degrees(mounting_angles(cam_from_vehicle))
    angle_sigma = np.degrees(angle_sigmas(cam_from_vehicle, covariance))
    centre, centre_sigma = camera_centre(cam_from_vehicle), centre_sigmas(cam_from_vehicle, covariance)
    turned = zip(("roll", "pitch", "yaw"), angles, angle_sigma, strict=True)
    placed = zip(("forward", "left", "height"), centre, centre_sigma, strict=True)
    return (
        [f"{word} {angle:.2f} +- {sigma:.2f} deg" for word, angle, sigma in turned],
        [f"{word} {value:.3f} +- {sigma:.3f} m" for word, value, sigma in placed],
    )
