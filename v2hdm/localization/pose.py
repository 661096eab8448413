"""A vehicle's pose at a time, and whether it can be relied on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from v2hdm.localization.rig import Turned
from v2hdm.records import FloatArray


class Status(Enum):
    """Whether the pose can be relied on: only while ``TRACKING``."""

    INITIALISING = "initialising"
    TRACKING = "tracking"
    LOST = "lost"


@dataclass(frozen=True)
class Pose:
    """Where the vehicle is at a time.

    Attributes:
        stamp_s: of the newest motion or image.
        status: only a tracked pose can be relied on.
        map_from_vehicle: (4, 4); None before any place was found.
        covariance: (3, 3) of x, y, m, and heading, rad, in the map; infinite before the place is sure.
        protection_m: ahead and to the left, bounds that one error in a thousand exceeds; else infinite.
        protection_rad: the same of the heading.
        motion: true over stated speed, the yaw rate's bias, rad/s, and how late the odometry's stamps are, s.
        matched: markings that the last look showed.
        matched_lines: pieces of solid lines that it showed on their lines.
        matched_areas: words, boxes and other symbols that it showed at their places.
        images_s: by camera the time of the newest image that is in it.
        reasons: sentences: why there is no pose, or what differs from map, calibration or odometry.
        turned: cameras whose mountings have changed.
    """

    stamp_s: float
    status: Status
    map_from_vehicle: FloatArray | None
    covariance: FloatArray
    protection_m: tuple[float, float]
    protection_rad: float
    motion: tuple[float, float, float]
    matched: int
    reasons: tuple[str, ...] = ()
    turned: tuple[Turned, ...] = ()
    matched_lines: int = 0
    matched_areas: int = 0
    images_s: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def unknown(cls, stamp_s: float, status: Status, reasons: tuple[str, ...]) -> Pose:
        """The pose of a vehicle whose place nothing has shown yet."""
        nothing = np.full((3, 3), np.inf)
        return cls(stamp_s, status, None, nothing, (np.inf, np.inf), np.inf, (1.0, 0.0, 0.0), 0, reasons)
