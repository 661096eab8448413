"""Rigid motions in numpy: transforms, tangents, Euler angles, quaternions and trajectories.

Frames and tangents are those of :mod:`v2hdm.geometry`; unit quaternions are x, y, z, w (as in TUM and ROS).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import cos, factorial, sin
from typing import Any

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.records import BoolArray, Drive, FloatArray, Image, Trajectory

SERIES_TERMS = 15  # terms in theta^2: exact in float64 for theta up to pi, as pi^(2 * 15) / 31! < 1e-18

EXP_SERIES = tuple(tuple(1 / factorial(2 * n + offset) for offset in (1, 2, 3)) for n in range(SERIES_TERMS))
"""Coefficients (terms, 3) of (-theta^2)^n in sin(theta) / theta, (1 - cos(theta)) / theta^2 and
(theta - sin(theta)) / theta^3."""

LEFT_JACOBIAN_SERIES = tuple(
    tuple((1 - n) / factorial(2 * n + offset) for offset in (2, 3))
    + tuple((n + 1) / factorial(2 * n + 2 + offset) for offset in (2, 3))
    for n in range(SERIES_TERMS)
)
"""Coefficients (terms, 4) of (-theta^2)^n with the powers ad, ad^2, ad^3, ad^4 in the sum of
ad^n / (n + 1)!, see :func:`left_jacobian`."""


def inverse(dst_from_src: FloatArray) -> FloatArray:
    """The inverse (..., 4, 4) of rigid transforms, by transposing their rotation."""
    return make_transform(np.swapaxes(dst_from_src[..., :3, :3], -1, -2), camera_centre(dst_from_src))


def camera_centre(cam_from_frame: FloatArray) -> FloatArray:
    """Origin (..., 3) of ``cam``, m, in the other frame."""
    rotation = cam_from_frame[..., :3, :3]
    return np.asarray(-(np.swapaxes(rotation, -1, -2) @ cam_from_frame[..., :3, 3:])[..., 0])


def ground_in_vehicle(map_from_vehicle: FloatArray, points_map: FloatArray) -> FloatArray:
    """Ground points (..., 2 or 3), m, of the map as (..., 2) in the vehicle frame at a pose (4, 4)."""
    if points_map.shape[-1] == 2:
        points_map = np.concatenate([points_map, np.zeros((*points_map.shape[:-1], 1))], axis=-1)
    return np.asarray(((points_map - map_from_vehicle[:3, 3]) @ map_from_vehicle[:3, :3])[..., :2])


def make_transform(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """The transforms (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    out = np.zeros((*np.shape(rotation)[:-2], 4, 4))
    out[..., :3, :3] = rotation
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1.0
    return out


def heading_rad(map_from_vehicle: FloatArray) -> FloatArray:
    """Headings (...), rad, of poses (..., 4, 4): counter-clockwise from the map's x axis."""
    return np.asarray(np.arctan2(map_from_vehicle[..., 1, 0], map_from_vehicle[..., 0, 0]))


def hat(vectors: FloatArray) -> FloatArray:
    """Skew matrices (..., 3, 3) of vectors (..., 3): ``hat(a) @ b == cross(a, b)``."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*np.shape(x), 3, 3)


def exp(tangents: FloatArray) -> FloatArray:
    """Rigid motions (..., 4, 4) of tangents (..., 6), for rotations up to pi, by Rodrigues' formula."""
    omega = hat(tangents[..., 3:])
    squared = omega @ omega
    sine, cosine, third = _even_series(tangents[..., 3:], EXP_SERIES)
    moved = (np.eye(3) + cosine * omega + third * squared) @ tangents[..., :3, None]
    return make_transform(np.eye(3) + sine * omega + cosine * squared, moved[..., 0])


def log(dst_from_src: FloatArray) -> FloatArray:
    """Tangents (..., 6) of rigid motions (..., 4, 4), with rotations of at most pi."""
    matrices = dst_from_src.reshape(-1, 4, 4)
    quaternion = quaternion_from_rotation(matrices[:, :3, :3])
    half_sine = np.linalg.norm(quaternion[:, :3], axis=1, keepdims=True)
    half_angle = np.arctan2(half_sine, quaternion[:, 3:])
    scale = np.where(half_sine > 0, 2 * half_angle / np.where(half_sine > 0, half_sine, 1.0), 2.0)
    rotation = scale * quaternion[:, :3]
    omega = hat(rotation)
    _, cosine, third = _even_series(rotation, EXP_SERIES)
    by_translation = np.eye(3) + cosine * omega + third * omega @ omega
    translation = np.linalg.solve(by_translation, matrices[:, :3, 3:])[..., 0]
    return np.concatenate([translation, rotation], axis=1).reshape(*dst_from_src.shape[:-2], 6)


def adjoint(dst_from_src: FloatArray) -> FloatArray:
    """Matrices (..., 6, 6) that map tangents of ``src`` to ``dst``: ``A exp(x) = exp(adjoint(A) x) A``."""
    rotation = dst_from_src[..., :3, :3]
    out = np.zeros((*dst_from_src.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    out[..., :3, 3:] = hat(dst_from_src[..., :3, 3]) @ rotation
    return out


def left_jacobian(tangents: FloatArray) -> FloatArray:
    """Left Jacobian (..., 6, 6) of SE(3): ``exp(x + dx) = exp(left_jacobian(x) @ dx) @ exp(x)``.

    The sum of ad^n / (n + 1)!, closed by ad^5 = -2 theta^2 ad^3 - theta^4 ad (Barfoot, State Estimation for
    Robotics, 2nd ed., section 8.1.5), for rotations up to pi.
    """
    ad = np.zeros((*tangents.shape[:-1], 6, 6))
    ad[..., :3, :3] = ad[..., 3:, 3:] = hat(tangents[..., 3:])
    ad[..., :3, 3:] = hat(tangents[..., :3])
    first, second, third, fourth = _even_series(tangents[..., 3:], LEFT_JACOBIAN_SERIES)
    eye = np.eye(6)
    return np.asarray(eye + ad @ (first * eye + ad @ (second * eye + ad @ (third * eye + fourth * ad))))


def rotation_from_vector(vector_rad: FloatArray) -> FloatArray:
    """The rotation matrix (3, 3) of a rotation vector (3,)."""
    import cv2  # which reading settings does without

    return np.asarray(cv2.Rodrigues(np.asarray(vector_rad, dtype=np.float64))[0])


def rotation_from_quaternion(quaternion: FloatArray) -> FloatArray:
    """Rotation matrices (N, 3, 3) of unit quaternions (N, 4), xyzw."""
    x, y, z, w = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def quaternion_from_rotation(rotation: FloatArray) -> FloatArray:
    """Unit quaternions (N, 4), xyzw with w >= 0, of rotation matrices (N, 3, 3), by Shepperd (1978)."""
    diagonal = np.diagonal(rotation, axis1=1, axis2=2)
    trace = diagonal.sum(axis=1)
    candidates = np.empty((len(rotation), 4, 4))
    for axis in range(3):
        second = (axis + 1) % 3
        third = (axis + 2) % 3
        candidates[:, axis, axis] = 1 + 2 * diagonal[:, axis] - trace
        candidates[:, axis, second] = rotation[:, second, axis] + rotation[:, axis, second]
        candidates[:, axis, third] = rotation[:, third, axis] + rotation[:, axis, third]
        candidates[:, axis, 3] = rotation[:, third, second] - rotation[:, second, third]
    candidates[:, 3, :3] = candidates[:, :3, 3]
    candidates[:, 3, 3] = 1 + trace
    best = np.argmax(np.column_stack([diagonal, trace]), axis=1)
    quaternion = candidates[np.arange(len(rotation)), best]
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    return np.asarray(np.where(quaternion[:, 3:] < 0, -quaternion, quaternion))


def rotation_from_euler(roll_rad: FloatArray, pitch_rad: FloatArray, yaw_rad: FloatArray) -> FloatArray:
    """Rotation matrices (N, 3, 3) Rz(yaw) Ry(pitch) Rx(roll): REP-103's fixed-axis convention."""
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in (roll_rad, pitch_rad, yaw_rad))
    return np.moveaxis(np.array(_euler_rows(cr, sr, cp, sp, cy, sy)), -1, 0)


def rotation_from_angles(roll_rad: float, pitch_rad: float, yaw_rad: float) -> FloatArray:
    """The rotation matrix (3, 3) of :func:`rotation_from_euler` for three numbers, in a tenth of its time."""
    cosines_and_sines = (part(angle) for angle in (roll_rad, pitch_rad, yaw_rad) for part in (cos, sin))
    return np.array(_euler_rows(*cosines_and_sines))


def _euler_rows(cr: Any, sr: Any, cp: Any, sp: Any, cy: Any, sy: Any) -> list[list[Any]]:
    """Rows of Rz(yaw) Ry(pitch) Rx(roll) by cosines and sines of roll, pitch and yaw."""
    return [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]


def euler_from_rotation(rotation: FloatArray) -> FloatArray:
    """Roll, pitch and yaw (3,), rad, of a rotation (3, 3): :func:`rotation_from_euler` inverted."""
    flat = float(np.hypot(rotation[0, 0], rotation[1, 0]))
    pitch = np.arctan2(-rotation[2, 0], flat)
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0]) if flat > 0 else 0.0
    # Taken about the axis across the heading, roll stays exact at a pitch of 90 degrees.
    across = rotation.T @ [-np.sin(yaw), np.cos(yaw), 0.0]
    return np.array([np.arctan2(-across[2], across[1]), pitch, yaw])


def _even_series(rotation: FloatArray, coefficients: tuple[tuple[float, ...], ...]) -> list[FloatArray]:
    """Power series in -theta^2 by Horner's rule, theta = |rotation|, each (..., 1, 1)."""
    if rotation.ndim == 1:
        return _even_series_of_one(rotation, coefficients)
    x = -np.square(rotation).sum(axis=-1)[..., None, None, None]
    terms = np.array(coefficients)
    total = terms[-1]
    for term in terms[-2::-1]:
        total = term + total * x
    return list(np.moveaxis(total, -1, 0))


def _even_series_of_one(
    rotation: FloatArray, coefficients: tuple[tuple[float, ...], ...]
) -> list[FloatArray]:
    """The same for one vector (3,), in numbers of Python, which take a tenth of numpy's time."""
    x = -float(rotation @ rotation)
    sums = []
    for terms in zip(*coefficients, strict=True):
        total = 0.0
        for term in reversed(terms):
            total = term + total * x
        sums.append(np.full((1, 1), total))
    return sums


def interpolate(
    trajectory: Trajectory, stamp_s: FloatArray, max_gap_s: float
) -> tuple[FloatArray, BoolArray]:
    """Poses (N, 4, 4) at ``stamp_s`` (N,), position linear, rotation by slerp, and their validity (N,).

    Nothing is extrapolated: outside the recorded time, and strictly between two poses more than ``max_gap_s``
    apart, the flag is False and the pose that of the nearest recorded one.
    """
    recorded = trajectory.stamp_s
    stamp_s = np.asarray(stamp_s, dtype=np.float64)
    after = np.clip(np.searchsorted(recorded, stamp_s, side="left"), 0, len(recorded) - 1)
    before = np.where(recorded[after] == stamp_s, after, np.maximum(after - 1, 0))
    span_s = recorded[after] - recorded[before]
    inside = (stamp_s >= recorded[0]) & (stamp_s <= recorded[-1]) & (span_s <= max_gap_s)
    with np.errstate(divide="ignore", invalid="ignore"):
        linear = np.where(span_s > 0, (stamp_s - recorded[before]) / span_s, 0.0)
    fraction = np.clip(np.where(inside, linear, np.round(linear)), 0.0, 1.0)

    first = trajectory.map_from_vehicle[before]
    second = trajectory.map_from_vehicle[after]
    turn = log(inverse(first) @ second)
    turn[:, :3] = 0.0
    points = first[:, :3, 3] + fraction[:, None] * (second[:, :3, 3] - first[:, :3, 3])
    return make_transform((first @ exp(fraction[:, None] * turn))[:, :3, :3], points), inside


def in_order(image: Image) -> tuple[int, float, str]:
    """The sort key of a drive's images."""
    return image.session, image.taken_s, image.camera


def with_clock_offsets(
    drive: Drive, offset_s: Mapping[str, float], max_gap_s: float, session: int = 0
) -> Drive:
    """The drive with images of a session re-posed by its cameras' clock offsets.

    ``offset_s`` is by camera the time of exposure minus the stamp, s. Images that fall outside the trajectory
    or in a gap above ``max_gap_s`` are left out. Raises DriveError without a trajectory, or if a camera keeps
    no image.
    """
    root = drive.sessions[session].root
    trajectory = drive.sessions[session].trajectory
    if trajectory is None:
        raise DriveError(f"{root}: holds no trajectory to interpolate new poses from")
    images: list[Image] = [image for image in drive.images if image.session != session]
    for name in dict.fromkeys(image.camera for image in drive.images if image.session == session):
        images_of_camera = [
            image for image in drive.images if (image.session, image.camera) == (session, name)
        ]
        if offset_s.get(name):
            taken_s = np.array([image.stamp_s + offset_s[name] for image in images_of_camera])
            poses, inside = interpolate(trajectory, taken_s, max_gap_s)
            images_of_camera = [
                replace(images_of_camera[n], map_from_vehicle=poses[n], clock_offset_s=offset_s[name])
                for n in np.flatnonzero(inside).tolist()
            ]
        if not images_of_camera:
            raise DriveError(
                f"{root}: {1e3 * offset_s[name]:.0f} ms after their stamps, no image of '{name}' "
                "has a pose; record poses as long as images"
            )
        images += images_of_camera
    return replace(drive, images=tuple(sorted(images, key=in_order)))
