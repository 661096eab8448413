"""A mounting in words and angles, with standard deviations."""

from __future__ import annotations

import numpy as np

from v2hdm.geometry.mounting import angle_sigmas, mounting_angles
from v2hdm.geometry.rigid import camera_centre
from v2hdm.records import FloatArray

__all__ = ["angle_sigmas", "centre_sigmas", "mounting_angles", "mounting_lines"]


def centre_sigmas(cam_from_vehicle: FloatArray, covariance: FloatArray) -> FloatArray:
    """Standard deviations (3,) of the camera's centre in the vehicle frame, m."""
    # A left perturbation (v, w) of cam_from_vehicle moves the centre by -R'v.
    turn = cam_from_vehicle[:3, :3].T
    return np.asarray(np.sqrt(np.diag(turn @ covariance[:3, :3] @ turn.T)))


def mounting_lines(name: str, cam_from_vehicle: FloatArray, covariance: FloatArray) -> list[str]:
    """Lines for the terminal: the angles of a mounting, as docs/extrinsic.md counts them, and its centre."""
    angles = np.degrees(mounting_angles(cam_from_vehicle))
    angle_sigma = np.degrees(angle_sigmas(cam_from_vehicle, covariance))
    centre, centre_sigma = camera_centre(cam_from_vehicle), centre_sigmas(cam_from_vehicle, covariance)
    turned = (
        f"{word} {angle:.2f} +- {sigma:.2f} deg"
        for word, angle, sigma in zip(("roll", "pitch", "yaw"), angles, angle_sigma, strict=True)
    )
    placed = (
        f"{word} {value:.3f} +- {sigma:.3f} m"
        for word, value, sigma in zip(("forward", "left", "height"), centre, centre_sigma, strict=True)
    )
    return [f"{name}: {', '.join(turned)}", f"  centre {', '.join(placed)}"]
