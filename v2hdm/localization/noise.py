"""How many times larger a detector's covariances are than it states, as a map that is right shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from v2hdm.localization.joint import Located

# The detector's covariances: how many times too small they may be at first, and of how many coordinates that
# is known; after how many coordinates half of it is forgotten.
_FACTOR = 2.0  # times at first
_FACTOR_COUNT = 60.0  # coordinates that say so
_FORGET = 600.0  # coordinates
_FACTORS = (0.3, 12.0)  # least and largest, times


@dataclass
class DetectorNoise:
    """How many times larger a detector's covariances are than stated, estimated from what fits the map."""

    squared: float = _FACTOR * _FACTOR_COUNT
    count: float = _FACTOR_COUNT

    @property
    def factor(self) -> float:
        """The factor of the covariances."""
        return float(np.clip(self.squared / self.count, *_FACTORS))

    def note(self, located: Located, factor: float) -> None:
        """Take the misfit of an image that was located with a factor."""
        keeps = 0.5 ** (located.misfit_freedom / _FORGET)
        self.squared = keeps * self.squared + factor * located.misfit
        self.count = keeps * self.count + located.misfit_freedom
