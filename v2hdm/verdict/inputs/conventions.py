"""The conventions of poses that users mix up, each with how to undo it and what to write instead."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from v2hdm.geometry.rigid import quaternion_from_rotation, rotation_from_quaternion
from v2hdm.records import FloatArray

Undo = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class Convention:
    """A usual mistake: ``undo`` takes positions (P, 3) and rotations (P, 3, 3) to what they should be."""

    undo: Undo
    says: str


def _turned(sign: float, offset_deg: float) -> Undo:
    """Undo a yaw that is ``sign`` times the true one plus an offset: true yaw = sign * yaw + offset."""

    def undo(position: FloatArray, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
        forward = rotation[:, :2, 0]
        yaw = sign * np.arctan2(forward[:, 1], forward[:, 0]) + np.deg2rad(offset_deg)
        true = np.tile(np.eye(3), (len(yaw), 1, 1))
        true[:, 0, 0], true[:, 1, 0] = np.cos(yaw), np.sin(yaw)
        true[:, 0, 1], true[:, 1, 1] = -np.sin(yaw), np.cos(yaw)
        return position, true

    return undo


def _reordered(position: FloatArray, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    quaternion = quaternion_from_rotation(rotation)
    return position, rotation_from_quaternion(quaternion[:, [1, 2, 3, 0]])


def _inverted(position: FloatArray, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    back = np.swapaxes(rotation, 1, 2)
    return -(back @ position[:, :, None])[:, :, 0], back


def _axes(matrix: list[list[float]]) -> Undo:
    def undo(position: FloatArray, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
        return position, np.asarray(rotation @ np.array(matrix))

    return undo


CONVENTIONS: Mapping[str, Convention] = {
    "quaternion order": Convention(
        _reordered, "the quaternions are in the order qw qx qy qz; write them as qx qy qz qw"
    ),
    "z down": Convention(
        _axes([[1, 0, 0], [0, -1, 0], [0, 0, -1]]),
        "the vehicle's z axis points down (x forward, y right); turn the attitude to x forward, y left, z up",
    ),
    "optical frame": Convention(
        _axes([[0, -1, 0], [0, 0, -1], [1, 0, 0]]),
        "the poses are those of a camera (z forward); give those of the vehicle (x forward, y left, z up)",
    ),
    "from north": Convention(
        _turned(-1, 90),
        "yaw counts clockwise from north; write yaw = 90 deg - it, counter-clockwise from east",
    ),
    "clockwise": Convention(_turned(-1, 0), "yaw counts clockwise; write it with the other sign"),
    "90 ahead": Convention(_turned(1, -90), "yaw is 90 deg too large, as if y were forward; subtract 90 deg"),
    "90 behind": Convention(_turned(1, 90), "yaw is 90 deg too small, counted from north; add 90 deg"),
    "inverse": Convention(
        _inverted, "the poses are vehicle_from_map; write their inverse, the vehicle in the map"
    ),
    "south": Convention(_turned(-1, 180), "yaw counts clockwise from west; write yaw = 180 deg - it"),
    "from south": Convention(_turned(-1, -90), "yaw counts clockwise from south; write yaw = -90 deg - it"),
}
"""The usual mistakes, the likelier first."""

REFLECTED = ("from north", "clockwise", "south", "from south")
"""Conventions of yaw that poses alone cannot tell from a path whose axes are swapped."""

AXES_SWAPPED = (
    "x and y of the positions are swapped or one has the wrong sign, which mirrors the world; write x east "
    "and y north"
)
