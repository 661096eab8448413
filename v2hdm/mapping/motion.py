"""How the vehicle moves, from its recorded poses."""

from __future__ import annotations

import numpy as np

from v2hdm.geometry.rigid import inverse, log
from v2hdm.records import FloatArray, IntArray


def vehicle_twists(
    map_from_vehicle: FloatArray, stamp_s: FloatArray, visit: IntArray | None = None
) -> FloatArray:
    """Twists (F, 6) of the vehicle in its own frame, m/s then rad/s, at poses (F, 4, 4) at times (F,).

    Central differences, one-sided at the ends of each ``visit`` (F,), of one without; a single pose has no
    motion.
    """
    count = len(stamp_s)
    before, after = np.maximum(np.arange(count) - 1, 0), np.minimum(np.arange(count) + 1, count - 1)
    if visit is not None:
        own = np.arange(count)
        before = np.where(visit[before] == visit, before, own)
        after = np.where(visit[after] == visit, after, own)
    moved = inverse(map_from_vehicle[before]) @ map_from_vehicle[after]
    elapsed_s = stamp_s[after] - stamp_s[before]
    return np.asarray(log(moved) / np.where(elapsed_s > 0, elapsed_s, 1.0)[:, None])
