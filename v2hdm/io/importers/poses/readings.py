"""What a pose file or topic states, before frames, antenna and noise are made of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from v2hdm.records import FloatArray

SIGMA_OF_QUALITY_M: Mapping[int, float] = {
    0: np.inf,  # no fix
    1: 3.0,  # single
    2: 1.0,  # differential
    3: 3.0,  # PPS
    4: 0.02,  # RTK, fixed
    5: 0.5,  # RTK, float
    6: np.inf,  # dead reckoning
    7: np.inf,  # typed in
    8: np.inf,  # simulated
    9: 1.0,  # satellite-based augmentation, as some receivers number it
}
"""Standard deviation of a position, a coordinate, m, by the quality of NMEA's GGA (0183, 4.11)."""


@dataclass(frozen=True)
class Attitudes:
    """Attitudes over time.

    Attributes:
        stamp_s: (A,) strictly rising.
        rotation: (A, 3, 3) reference from sensor; the reference is x east, y north, z up of the true or grid
            north at the place, or the map itself.
        sigma_rad: (A,) standard deviation of the heading, nan where it is not stated.
    """

    stamp_s: FloatArray
    rotation: FloatArray
    sigma_rad: FloatArray


@dataclass(frozen=True)
class Readings:
    """Positions over time, and attitudes, perhaps at other times.

    Attributes:
        stamp_s: (P,) strictly rising.
        points: (P, 3): x, y, z in m of the map or a projected system, or latitude and longitude in degrees
            and height above the ellipsoid in m.
        geodetic: whether they are latitudes and longitudes.
        sigma_m: (P,) standard deviation of a horizontal coordinate, nan where it is not stated, infinite
            where there was no fix.
        attitudes: None where the source has none.
        antenna: whether they are an antenna's, which seldom sits at the vehicle's origin.
    """

    stamp_s: FloatArray
    points: FloatArray
    geodetic: bool
    sigma_m: FloatArray
    attitudes: Attitudes | None
    antenna: bool = field(default=False)
