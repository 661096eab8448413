"""Contradicted inputs in words: what is wrong by how much, and what to do."""

from __future__ import annotations

from collections.abc import Mapping

from v2hdm.adjust import Fault
from v2hdm.mapping.results import Contradiction

CHECKS: Mapping[Fault, str] = {
    Fault.CLOCK: "clock",
    Fault.FOCAL: "focal length",
    Fault.DISTORTION: "distortion",
    Fault.PRINCIPAL: "principal point",
    Fault.SLOPE: "slope",
    Fault.SURVEY: "survey",
    Fault.LEVER: "survey",
    Fault.SIZE: "known_sizes",
    Fault.CONTROL: "surveyed points",
    Fault.DATUM: "surveyed points",
}
"""The check that each fault is told by."""

_WAYS = (("behind", "ahead of"), ("to the right of", "to the left of"), ("below", "above"))
_MAP_AXES = ("east", "north")

_REMEDIES: Mapping[Fault, str] = {
    Fault.CLOCK: "synchronise the clocks of cameras and receiver, or shift the stamps by as much",
    Fault.FOCAL: "check fx and fy in camera_info against the resolution, or calibrate the lens anew",
    Fault.DISTORTION: "check distortion_coefficients (and the focal length) in camera_info, or "
    "calibrate anew",
    Fault.PRINCIPAL: "check cx and cy in camera_info against the image's size and crop, or calibrate anew",
    Fault.SLOPE: "record the height of the poses, or roll and pitch against the road",
    Fault.SURVEY: "measure the camera's centre anew, mind signs, axes and the origin on the ground "
    "under the axle",
    Fault.LEVER: "state the centres from the point that the poses are of, such as the antenna, or "
    "move the poses",
    Fault.SIZE: "measure the paint, or leave it out of mapping.known_sizes",
    Fault.CONTROL: "measure it anew, or leave it out of mapping.survey",
    Fault.DATUM: "check that survey and poses have the same datum and origin",
}


def _way(one: Contradiction) -> str:
    """How far and where to along an axis of the vehicle."""
    return f"{100 * abs(one.value):.0f} cm {_WAYS[one.axis][one.value > 0]}"


def remedy_of(one: Contradiction) -> str:
    """What to do about it."""
    return _REMEDIES[one.fault]


def wrong_as(one: Contradiction) -> str:
    """What is wrong by how much, as a clause."""
    whose = " and ".join(one.cameras)
    cm, off = 100 * one.value, abs(one.value)
    match one.fault:
        case Fault.CLOCK:
            late = "later" if one.value > 0 else "earlier"
            where = f" {one.about}" if one.about else ""
            return (
                f"the images of {whose}{where} were taken {1e3 * off:.0f} ms {late} than stamped: their "
                "clock is off"
            )
        case Fault.FOCAL:
            larger = "longer" if one.value > 0 else "shorter"
            return f"the focal length of {whose} is {100 * off:.1f} % {larger} than camera_info says"
        case Fault.DISTORTION:
            return f"the lens distortion of {whose} is not that of camera_info (k1 off by {one.value:+.3f})"
        case Fault.PRINCIPAL:
            way = ("right", "down")[one.axis]
            return f"the principal point of {whose} lies {one.value:+.0f} px {way} of where camera_info says"
        case Fault.SLOPE:
            return (
                f"the ground rises by {100 * one.value:+.1f} % to the {_MAP_AXES[one.axis]} under the poses"
            )
        case Fault.SURVEY:
            return f"the centre of {whose} lies {_way(one)} its survey"
        case Fault.LEVER:
            return (
                f"the centres of {whose} all lie {_way(one)} their surveys, as if the poses were of another "
                "point of the vehicle (antenna instead of axle)"
            )
        case Fault.SIZE:
            longer = "longer" if one.value > 0 else "shorter"
            return f"paint that known_sizes states as {one.about} is {100 * off:.1f} cm {longer}"
        case Fault.CONTROL:
            return f"the surveyed point {one.about} is {100 * off:.0f} cm off the marking's corner"
        case Fault.DATUM:
            return f"the surveyed points all lie {cm:+.0f} cm {_MAP_AXES[one.axis]} of the markings"
