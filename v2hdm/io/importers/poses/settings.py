"""What ``poses`` in ``drive.yaml`` may say beside its file or topic, the same for every format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.geometry.rigid import rotation_from_euler
from v2hdm.records import FloatArray
from v2hdm.store.files import take_array, take_choice, take_number, take_text

HEADINGS = ("true", "grid")
COMMON_KEYS = (
    "crs", "heading", "lever_arm_m", "mounting_rpy_deg", "max_sigma_m", "geoid_m", "epoch", "offset_s",
)  # fmt: skip

_MAX_SIGMA_M = 0.1
"""Positions that are stated to be less sure than this, m, are left out: RTK fixed is 0.02, float about "
"0.5."""


@dataclass(frozen=True)
class PoseSettings:
    """How poses are to be understood.

    Attributes:
        crs: system of the coordinates, such as EPSG:25832; None for the map's own, or WGS84.
        heading: north that headings count from, ``true`` or ``grid``; None where it is not said.
        lever_arm_m: (3,) the point that positions are of, in the vehicle frame; None where it is not said.
        vehicle_from_sensor: (3, 3) how the attitude's sensor is turned on the vehicle.
        max_sigma_m: positions stated to be less sure are left out.
        geoid_m: height of the geoid above the ellipsoid, for heights above the sea; None if not said.
        epoch: of the coordinates, in years; None if not said.
        offset_s: what is added to the recorded times.
    """

    crs: str | None
    heading: str | None
    lever_arm_m: FloatArray | None
    vehicle_from_sensor: FloatArray
    max_sigma_m: float
    geoid_m: float | None
    epoch: float | None
    offset_s: float


def take_pose_settings(entry: Mapping[str, Any], where: str) -> PoseSettings:
    """The settings of ``entry``, whose keys have been checked.

    Raises:
        DriveError: a value is of the wrong type or out of range.
    """

    def number(key: str) -> float | None:
        return None if key not in entry else take_number(entry[key], f"{where}, {key}", DriveError)

    def three(key: str) -> FloatArray | None:
        return None if key not in entry else take_array(entry[key], (3,), f"{where}, {key}", DriveError)

    heading = entry.get("heading")
    if heading is not None:
        take_choice(heading, HEADINGS, f"{where}, heading", DriveError)
    max_sigma_m = number("max_sigma_m") if "max_sigma_m" in entry else _MAX_SIGMA_M
    assert max_sigma_m is not None
    if max_sigma_m <= 0:
        raise DriveError(f"{where}, max_sigma_m: give a positive number of metres")
    rpy = three("mounting_rpy_deg")
    roll, pitch, yaw = np.radians(np.zeros(3) if rpy is None else rpy)[:, None]
    crs = entry.get("crs")
    if isinstance(crs, int) and not isinstance(crs, bool):
        crs = f"EPSG:{crs}"
    return PoseSettings(
        crs=None if crs is None else take_text(crs, f"{where}, crs", DriveError),
        heading=heading,
        lever_arm_m=three("lever_arm_m"),
        vehicle_from_sensor=rotation_from_euler(roll, pitch, yaw)[0],
        max_sigma_m=max_sigma_m,
        geoid_m=number("geoid_m"),
        epoch=number("epoch"),
        offset_s=number("offset_s") or 0.0,
    )
