"""Why images find no pose at their time: other units, another epoch, or poses too far apart."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from v2hdm.records import FloatArray

_UNITS: Mapping[str, float] = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}

UNITS: Mapping[str, float] = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""Units of times as files name them, and how many of each make a second."""

_LONGEST_S = 5.0
"""Poses and images of a drive are never recorded more seldom than this."""

_QUICKEST_S = 5e-4
"""Nor more often."""

_ALIKE = 5.0
"""Poses and images of one drive last equally long to within this factor."""

_LATEST_S = 1e11
"""Seconds since 1970 stay below this for three thousand years; larger stamps are in a smaller unit."""


def why_no_pose(
    image_stamp_s: FloatArray,
    pose_stamp_s: FloatArray,
    max_gap_s: float,
    asking: str = "images",
    asked: str = "poses",
) -> str:
    """The likely reason, and the remedy, that no image has a pose.

    Args:
        image_stamp_s: (N,) as they were read.
        pose_stamp_s: (P,) as they were read.
        max_gap_s: poses further apart are not interpolated across.
        asking: what is called images here.
        asked: what is called poses here.
    """
    images, poses = unit_of(image_stamp_s), unit_of(pose_stamp_s)
    if images is not None and images == poses:
        return f"all stamps are in {images}: divide them by {_UNITS[images]:g} to give seconds"
    if images is not None:
        return f"the {asking}' stamps are in {images}: divide them by {_UNITS[images]:g} to give seconds"
    if poses is not None:
        return f"the {asked}' stamps are in {poses}: divide them by {_UNITS[poses]:g} to give seconds"
    for unit, scale in _UNITS.items():
        ratio = np.ptp(image_stamp_s) / max(np.ptp(pose_stamp_s), 1e-9)
        for longer, size in ((asking, ratio), (asked, 1 / max(ratio, 1e-12))):
            if scale / _ALIKE < size < scale * _ALIKE:
                return f"the {longer}' stamps are in {unit}: divide them by {scale:g} to give seconds"
    if image_stamp_s[-1] < pose_stamp_s[0] or image_stamp_s[0] > pose_stamp_s[-1]:
        offset_s = float(pose_stamp_s[0] - image_stamp_s[0])
        when = "later" if offset_s > 0 else "earlier"
        return (
            f"the {asked} begin {abs(offset_s):.0f} s {when} than the {asking}: one of them is of another "
            "drive, "
            "or counts from another epoch (GPS time, time since start); put both on one clock"
        )
    apart_s = float(np.median(np.diff(pose_stamp_s))) if len(pose_stamp_s) > 1 else np.inf
    return (
        f"the {asked} are {apart_s:.3g} s apart, more than max_gap_s {max_gap_s:g}: record more of them, "
        "or set drive.max_gap_s where the vehicle drives that evenly"
    )


def unit_of(stamp_s: FloatArray) -> str | None:
    """The unit that stamps (N,) are in if they cannot be seconds, None where they can."""
    apart = float(np.median(np.diff(stamp_s))) if len(stamp_s) > 1 else 0.0
    if apart <= _LONGEST_S and stamp_s[-1] < _LATEST_S:
        return None
    for unit, scale in _UNITS.items():
        if _QUICKEST_S <= apart / scale <= 1.0 and stamp_s[-1] / scale < _LATEST_S:
            return unit
    return None
