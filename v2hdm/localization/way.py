"""The way that the odometry lays out, from where it began: before there is a place, all that is known."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from v2hdm.localization.motion import MotionLog, moved
from v2hdm.localization.places import vehicle_at
from v2hdm.records import FloatArray


@dataclass
class Way:
    """The pose (3,) of x, y, m, and heading, rad, that an odometry has reached at a time, and the length."""

    log: MotionLog
    pose: FloatArray = field(default_factory=lambda: np.zeros(3))
    stamp_s: float | None = None
    length_m: float = 0.0

    def follow(self, stamp_s: float) -> None:
        """Go on to a time."""
        if self.stamp_s is None:
            self.stamp_s = stamp_s
        if stamp_s > self.stamp_s:
            step = moved(self.log.pieces(self.stamp_s, stamp_s))
            self.pose = vehicle_at(self.pose, step)
            self.length_m += float(np.hypot(step[0], step[1]))
            self.stamp_s = stamp_s

    def follow_all_but(self, last_s: float) -> None:
        """Go on to so long before the newest sample: until then images of earlier times may come.

        The way begins with the odometry, for a detector starts seconds after a vehicle has.
        """
        if not self.log.stamps_s:
            return
        if self.stamp_s is None:
            self.stamp_s = self.log.stamps_s[0]
        self.follow(self.log.stamps_s[-1] - last_s)

    def at(self, stamp_s: float) -> FloatArray:
        """The pose at a time that it has passed."""
        if self.stamp_s is None or stamp_s >= self.stamp_s:
            return self.pose
        x, y, turn = moved(self.log.pieces(stamp_s, self.stamp_s))
        c = np.cos(turn)
        s = np.sin(turn)
        return vehicle_at(self.pose, np.array([-c * x - s * y, s * x - c * y, -turn]))
