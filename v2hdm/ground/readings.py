"""How the recorded poses can be read, and under which reading the ground fits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from v2hdm.geometry.rigid import heading_rad
from v2hdm.ground.beliefs import Beliefs
from v2hdm.ground.matcher import Matcher
from v2hdm.ground.motion import motion_of
from v2hdm.ground.mount import Mount
from v2hdm.ground.pairs import spread_pairs, turning_pairs
from v2hdm.ground.results import Reading
from v2hdm.ground.start import Start, find_start
from v2hdm.records import Drive, IntArray

_PAIRS = 10
_APART_M = (1.2, 2.8)
"""Distance between the images of a pair: poses read wrongly move the ground further than the search."""

_TURN_RAD = np.deg2rad(2)
"""A turn between the images of a pair that is no noise of the path."""

_SEARCH_M = 0.6
_GRID_M = 0.06

_RIVAL = 0.5
"""As given, the share of matching patches must not fall below this part of another reading's."""

_CLEAR_SHARE = 0.2
"""Share from which on another reading is one: on even asphalt of real roads a fifth of the patches match."""


@dataclass(frozen=True)
class Readings:
    """The start as given, the shares of all readings and the best one."""

    start: Start
    shares: Mapping[Reading, float]
    best: Reading


def try_readings(drive: Drive, camera: str, matcher: Matcher, beliefs: Beliefs, others: bool) -> Readings:
    """Find a start and compare the readings of the poses; without ``others`` only the one as given."""
    start = find_start(matcher, beliefs, beliefs.guess)
    pairs = _telling_pairs(drive, camera)
    shares = {Reading.AS_GIVEN: 0.0}
    if start.mount is not None:
        shares[Reading.AS_GIVEN] = _share(matcher, beliefs, start.mount, pairs)
    if others:
        for reading in Reading:
            if reading is not Reading.AS_GIVEN:
                shares[reading] = _share_under(reading, drive, camera, matcher, beliefs, start.mount, pairs)
    best = max(shares, key=lambda reading: shares[reading])
    given = shares[Reading.AS_GIVEN]
    if shares[best] < _CLEAR_SHARE or given >= _RIVAL * shares[best]:
        best = Reading.AS_GIVEN
    return Readings(start, shares, best)


def _share_under(
    reading: Reading,
    drive: Drive,
    camera: str,
    matcher: Matcher,
    beliefs: Beliefs,
    found: Mount | None,
    pairs: IntArray,
) -> float:
    motion = motion_of(drive, camera, reading)
    backwards = reading is Reading.BACKWARDS
    guess = beliefs.guess if found is None else found
    guess = _turned(guess) if backwards else guess
    other = matcher.under(motion, turned=backwards)
    believed = replace(beliefs, motion=motion, guess=guess, surveyed=not backwards)
    if found is not None:
        return _share(other, believed, guess, pairs)
    start = find_start(other, believed, guess)
    return 0.0 if start.mount is None else _share(other, believed, start.mount, pairs)


def _telling_pairs(drive: Drive, camera: str) -> IntArray:
    """Those between which the vehicle turns most along its path; evenly spread ones on a straight route."""
    motion = motion_of(drive, camera, Reading.HEADING_FROM_PATH)
    poses = motion.poses()
    yaw = np.unwrap(heading_rad(poses))
    pairs = turning_pairs(motion.path_at_images(), yaw, _PAIRS, *_APART_M)
    if len(pairs) and np.median(np.abs(yaw[pairs[:, 1]] - yaw[pairs[:, 0]])) > _TURN_RAD:
        return pairs
    return spread_pairs(motion.path_at_images(), _PAIRS, *_APART_M)


def _share(matcher: Matcher, beliefs: Beliefs, mount: Mount, pairs: IntArray) -> float:
    return matcher.match(mount, beliefs.poses(), pairs, _SEARCH_M, _GRID_M).share


def _turned(mount: Mount) -> Mount:
    """A camera at the vehicle's other end that looks the other way."""
    half = np.diag([-1.0, -1.0, 1.0])
    return replace(
        mount,
        vehicle_from_cam_rotation=half @ mount.vehicle_from_cam_rotation,
        centre_vehicle=half @ mount.centre_vehicle,
    )
