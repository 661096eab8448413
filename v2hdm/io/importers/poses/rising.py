"""Times that must rise, brought into order where a recorder or network has mixed neighbours."""

from __future__ import annotations

import numpy as np

from v2hdm.errors import DriveError
from v2hdm.records import FloatArray, IntArray

_LATE_S = 1.0
"""A reading that comes later than this after its successor is of another clock or recording."""


def in_order(stamp_s: FloatArray, where: str, what: str = "line") -> IntArray:
    """Rows (K,) by time, of equal times the first.

    Raises:
        DriveError: there is none, one is not finite, or one is a second or more behind an earlier one.
    """
    if not len(stamp_s):
        raise DriveError(f"{where}: holds no pose; record some, or check what it is")
    if not np.isfinite(stamp_s).all():
        raise DriveError(
            f"{where}: {what} {int(np.argmin(np.isfinite(stamp_s))) + 1}: its time is not finite"
        )
    late_s = np.maximum.accumulate(stamp_s) - stamp_s
    if late_s.max() >= _LATE_S:
        k = int(np.argmax(late_s >= _LATE_S))
        raise DriveError(
            f"{where}: {what} {k + 1}: its time {stamp_s[k]:.3f} s is {late_s[k]:.3f} s before that of an "
            "earlier one: two clocks or two recordings in one; keep one of them"
        )
    return np.unique(stamp_s, return_index=True)[1]
