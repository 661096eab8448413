"""Mounting, clock, lens and poses estimated from bare asphalt, without any marking."""

from v2hdm.ground.estimate import estimate_cameras, estimate_ground
from v2hdm.ground.results import (
    GroundEstimate,
    GroundOptions,
    GroundStatus,
    Parameter,
    Reading,
    better_start,
)  # fmt: skip

__all__ = [
    "GroundEstimate", "GroundOptions", "GroundStatus", "Parameter", "Reading", "better_start",
    "estimate_cameras", "estimate_ground",
]  # fmt: skip
