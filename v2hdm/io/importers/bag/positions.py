"""Which topic of a bag states where the vehicle was on the Earth, and which one its heading.

Topics of poses are alike by their types: wheels, an IMU or a camera count from where they started, a filter's
local estimate drifts, and some drivers publish what they never measured. What the first messages show decides
where it can; else the candidates are named.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from v2hdm.io.importers.bag import messages as kinds
from v2hdm.io.importers.bag.samples import PoseSample, Samples

_MAPS = ("map", "utm", "earth", "world", "enu", "global", "gnss", "gps")
"""Frames, by their last names, that stand still on the Earth (REP-105), and usual other names of them."""

_OF_EARTH = re.compile(r"gnss|gps|rtk|global|novatel|applanix|navsat|(?<![a-z])(ins|fix)(?![a-z])")
_OF_START = re.compile(
    r"wheel|imu|encoder|visual|(?<![a-z])(vo|vio|svo|orb|scan|icp|goal)(?![a-z])|lidar|laser|slam|rtabmap|rf2o|t265"
    r"|diff_drive|velocity_controller|dead|local(?!i)|initial"
)
_MOVES_M = 2.0  # from where a vehicle moves for sure, m: more than a standing receiver wanders; chosen
_STANDS_M = 0.2  # up to which a pose stays where it is, m; chosen
_RARE = 20  # times fewer messages than another topic's that make a topic none of poses; chosen
_SURE_HEADING_RAD = np.deg2rad(20)  # a heading with a larger sigma is none; chosen


class Reference(enum.IntEnum):
    """The origin that a topic's poses count from, as far as its type, frame and name tell."""

    START = 0
    OPEN = 1
    EARTH = 2


class Candidate(NamedTuple):
    """A topic of poses or headings; ``doubt`` is why it cannot be the one, empty where nothing shows that."""

    sample: PoseSample
    reference: Reference
    doubt: str

    @property
    def about(self) -> str:
        """The topic with what tells it from others."""
        sample = self.sample
        facts = [sample.kind.rpartition("/")[2]]
        if np.isfinite(sample.rate_hz):
            facts.append(f"{sample.rate_hz:.3g} Hz")
        if sample.parent:
            facts.append(f"in {sample.parent}")
        if np.isfinite(sample.sigma_m):
            facts.append(f"sigma {sample.sigma_m:.2g} m")
        if self.doubt:
            facts.append(self.doubt)
        return f"{sample.name} ({', '.join(facts)})"


def position_candidates(
    samples: Samples, max_sigma_m: float, is_linked: Callable[[str], bool], has_heading: bool = False
) -> list[Candidate]:
    """All topics of poses, the best first; ``is_linked`` tells whether a frame is fixed on the vehicle.

    A position with a larger sigma than ``max_sigma_m`` is of no use, nor is an antenna's without a heading,
    which is of another topic unless it is known, ``has_heading``.
    """
    poses = list(samples.poses.values())
    moved_m = max((pose.moved_m for pose in poses if np.isfinite(pose.moved_m)), default=0.0)
    most = max((pose.messages for pose in poses), default=0)
    is_any_linked = any(is_linked(pose.frame) for pose in poses if pose.frame)
    has_heading = has_heading or any(not heading.doubt for heading in heading_candidates(samples, moved_m))
    candidates = []
    for pose in poses:
        doubt = pose.problem or _doubt_of(pose, moved_m, max_sigma_m)
        if not doubt and pose.kind == kinds.FIX and not has_heading:
            doubt = "no topic has its headings"
        if not doubt and pose.messages * _RARE < most:
            doubt = f"only {pose.messages} messages"
        if not doubt and pose.kind == kinds.ODOMETRY and is_any_linked and pose.frame:
            doubt = "" if is_linked(pose.frame) else f"of {pose.frame}, which is not fixed on the vehicle"
        candidates.append(Candidate(pose, _reference_of(pose), doubt))
    return sorted(candidates, key=_rank)


def heading_candidates(samples: Samples, moved_m: float) -> list[Candidate]:
    """All topics of headings alone, two antennas' first; the vehicle has ``moved_m`` meanwhile."""
    candidates = []
    for heading in samples.headings.values():
        doubt = heading.problem
        if not doubt and not heading.has_heading:
            doubt = "it measures no orientation"
        if not doubt and not heading.is_turned and moved_m > _MOVES_M:
            doubt = "its orientation is never set"
        if not doubt and heading.sigma_rad > _SURE_HEADING_RAD:
            doubt = f"its heading has a sigma of {np.degrees(heading.sigma_rad):.3g} deg"
        reference = Reference.EARTH if heading.kind == kinds.QUATERNION else Reference.OPEN
        candidates.append(Candidate(heading, reference, doubt))
    return sorted(candidates, key=_rank)


def the_one(candidates: Sequence[Candidate]) -> Candidate | None:
    """The candidate that none of the others equals; None where several are as good, or there is none."""
    fitting = [candidate for candidate in candidates if not candidate.doubt] or list(candidates)
    best = [candidate for candidate in fitting if candidate.reference == fitting[0].reference]
    return best[0] if len(best) == 1 else None


def _doubt_of(pose: PoseSample, moved_m: float, max_sigma_m: float) -> str:
    is_antenna = pose.kind in (kinds.FIX, kinds.NMEA)
    if not is_antenna and not pose.has_heading:
        return "its orientations are not rotations"
    if not is_antenna and not pose.is_turned and moved_m > _MOVES_M:
        return "its orientation is never set"
    if pose.sigma_m > max_sigma_m:
        return f"more than {max_sigma_m:g} m" if np.isfinite(pose.sigma_m) else "no fix"
    if moved_m > _MOVES_M and pose.moved_m < _STANDS_M:
        return "it stays where it is while others move"
    return ""


def _reference_of(pose: PoseSample) -> Reference:
    if pose.kind in (kinds.FIX, kinds.NMEA):
        return Reference.EARTH
    name = pose.name.lower()
    is_of_earth = bool(_OF_EARTH.search(name))
    if _OF_START.search(name) and not is_of_earth:
        return Reference.START
    in_map = pose.parent.rpartition("/")[2].lower() in _MAPS
    return Reference.EARTH if in_map or is_of_earth else Reference.OPEN


def _rank(candidate: Candidate) -> tuple[object, ...]:
    sample = candidate.sample
    sigma_m = sample.sigma_m if np.isfinite(sample.sigma_m) else np.inf
    return (bool(candidate.doubt), -candidate.reference, sigma_m, -sample.messages, sample.name)
