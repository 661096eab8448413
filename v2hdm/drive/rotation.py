"""Rotations in numpy for pose files: unit quaternions in the order x, y, z, w (TUM's and ROS')."""

from __future__ import annotations

import numpy as np

from v2hdm.records import FloatArray


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
    """Unit quaternions (N, 4), xyzw with w >= 0, of rotation matrices (N, 3, 3).

    Shepperd's method (Journal of Guidance and Control 1, 1978): of the four equivalent formulas,
    each matrix takes the one that divides by its largest component.
    """
    diagonal = np.diagonal(rotation, axis1=1, axis2=2)
    trace = diagonal.sum(axis=1)
    candidates = np.empty((len(rotation), 4, 4))
    for axis in range(3):
        second, third = (axis + 1) % 3, (axis + 2) % 3
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


def slerp(first: FloatArray, second: FloatArray, fraction: FloatArray) -> FloatArray:
    """Unit quaternions (N, 4) at ``fraction`` (N,) of the shorter way from ``first`` to ``second``.

    Shoemake, Animating rotation with quaternion curves, SIGGRAPH 1985.
    """
    cosine = np.sum(first * second, axis=1, keepdims=True)
    second = np.where(cosine < 0, -second, second)
    # atan2 of chord and sum keeps full precision for angles near zero, where arccos does not.
    angle = 2 * np.arctan2(
        np.linalg.norm(second - first, axis=1, keepdims=True),
        np.linalg.norm(second + first, axis=1, keepdims=True),
    )
    t = fraction[:, None]
    # sin(t a) / sin(a) as a ratio of sincs, which is t at a = 0.
    sinc = np.sinc(angle / np.pi)
    mixed = (
        first * (1 - t) * np.sinc((1 - t) * angle / np.pi) / sinc
        + second * t * np.sinc(t * angle / np.pi) / sinc
    )
    return np.asarray(mixed / np.linalg.norm(mixed, axis=1, keepdims=True))


def rotation_from_euler(roll_rad: FloatArray, pitch_rad: FloatArray, yaw_rad: FloatArray) -> FloatArray:
    """Rotation matrices (N, 3, 3) Rz(yaw) Ry(pitch) Rx(roll): REP-103's fixed-axis convention."""
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in (roll_rad, pitch_rad, yaw_rad))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
