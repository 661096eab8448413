"""The vehicle's pose at any time within a recorded trajectory."""

from __future__ import annotations

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.records import FloatArray, GeodeticOrigin, Trajectory

_FARTHEST_M = 1e8
"""Coordinates on the earth end at ten thousand kilometres."""

_FARTHEST_FROM_ORIGIN_M = 1e5
"""A map is flat: a hundred kilometres from its origin the ground is 800 m below it."""


def check_trajectory(trajectory: Trajectory, origin: GeodeticOrigin | None, where: str) -> None:
    """Refuse poses that lie where no drive of this map can be.

    Raises:
        DriveError: a coordinate is of no place on the earth, or far from the map's ``origin`` on it.
    """
    farthest_m = float(np.abs(trajectory.map_from_vehicle[:, :3, 3]).max())
    if not farthest_m <= _FARTHEST_M:
        raise DriveError(
            f"{where}: a position is {farthest_m:.3g} m from zero, off the earth; mend the poses"
        )
    if origin is not None and farthest_m > _FARTHEST_FROM_ORIGIN_M:
        raise DriveError(
            f"{where}: the poses lie {farthest_m / 1e3:.0f} km from the map's origin, which is at latitude "
            f"{origin.latitude_deg:.4f}, longitude {origin.longitude_deg:.4f}: are they coordinates of a "
            "grid "
            "such as UTM? Then say so under poses with crs, or give the origin that they count from"
        )


def check_geodetic(geodetic: FloatArray, where: str) -> None:
    """Refuse latitudes, longitudes (degrees) and heights (m) (N, 3) that are of no place near the ground.

    Raises:
        DriveError: names the first such position.
    """
    off = (np.abs(geodetic) > [90.0, 180.0, 1e5]).any(axis=1)
    if off.any():
        row = int(np.argmax(off))
        latitude, longitude, height_m = geodetic[row]
        raise DriveError(
            f"{where}: position {row + 1}: latitude {latitude:g}, longitude {longitude:g}, height "
            f"{height_m:g} m: "
            "latitude must lie within +-90 and longitude within +-180 degrees; mend them"
        )
